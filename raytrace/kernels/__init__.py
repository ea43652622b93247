"""Warp kernels and functions of the forward trace, on packets of rays."""
