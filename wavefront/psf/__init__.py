"""PSF engines and their kernels."""
