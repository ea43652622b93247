"""Shapes, correlations, star selection; objects on images and fits of galaxies."""
