"""Catalogues of objects on images: detection, stars, fits of galaxies, shear calibration."""
