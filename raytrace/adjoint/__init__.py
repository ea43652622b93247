"""Exact derivatives by backward passes through the surfaces."""

# Kernels of one module, all of which are defined before one of them is compiled.
from . import backward_kernels as backward_kernels
from . import sphere_kernels as sphere_kernels
