"""Stacks of the images of visits: drawing, resampling onto tiles of the sky, measurement."""
