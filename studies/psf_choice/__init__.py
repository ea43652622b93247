"""How many stars, which order, components and basis serve a PSF model best."""
