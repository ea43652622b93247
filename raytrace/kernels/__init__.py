"""Warp kernels and functions of the forward trace, on packets of rays."""

# Kernels of one module, all of which are defined before one of them is compiled.
from . import opds as opds
from . import pupil as pupil
from . import trace as trace
