"""Errors and warnings of pachon; all errors are subclasses of :class:`pachon.PachonError`."""

from .core.errors import ConfigError as ConfigError
from .core.errors import DomainError as DomainError
from .core.errors import HeightWarning as HeightWarning
from .core.errors import PrescriptionError as PrescriptionError
from .core.errors import PrescriptionNote as PrescriptionNote
from .core.errors import PrescriptionWarning as PrescriptionWarning
from .core.errors import ProductError as ProductError
from .core.errors import UnknownNameError as UnknownNameError
from .core.errors import WcsWarning as WcsWarning

__all__ = [
    "ConfigError",
    "DomainError",
    "HeightWarning",
    "PrescriptionError",
    "PrescriptionNote",
    "PrescriptionWarning",
    "ProductError",
    "UnknownNameError",
    "WcsWarning",
]
