"""Diffraction images and what is measured on them."""
