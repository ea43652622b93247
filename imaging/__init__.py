"""Images of CCDs: stars and galaxies under the PSF of a run, with noise, as FITS files."""

from ..core.deprecation import public_names as _public_names

__getattr__, __dir__, __all__ = _public_names(__name__, __file__)
