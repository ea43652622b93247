"""Shear from linear functionals of deconvolved images."""
