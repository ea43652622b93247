"""Choice of a PSF model: number of stars, order, components, basis."""
