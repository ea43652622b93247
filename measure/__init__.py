"""Shapes, correlations, star selection; objects on images and fits of galaxies."""

from ..core.deprecation import public_names as _public_names

__getattr__, __dir__, __all__ = _public_names(__name__, __file__)
