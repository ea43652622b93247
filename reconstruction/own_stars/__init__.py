"""PSF models of stars from other programs."""
