"""Models of the PSF over a CCD."""
