"""Wavefront sensing: maximum-likelihood fits of out-of-focus stars (donuts) and in-focus stars."""

from ..core.deprecation import public_names as _public_names

__getattr__, __dir__, __all__ = _public_names(__name__, __file__)
