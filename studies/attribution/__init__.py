"""Causes of PSF ellipticity, one switched off at a time."""
