"""Images of CCDs: stars and galaxies under the PSF of a run, with noise, as FITS files."""
