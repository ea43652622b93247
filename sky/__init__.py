"""Galaxies on the sky: populations, catalogues, stamps of real mosaics, and their Fourier transforms."""

from ..core.deprecation import public_names as _public_names

__getattr__, __dir__, __all__ = _public_names(__name__, __file__)
