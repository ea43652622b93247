"""A run: stars, PSFs, shapes, PSF models, correlations, products."""
