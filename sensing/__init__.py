"""Wavefront sensing: maximum-likelihood fits of out-of-focus stars (donuts) and in-focus stars."""
