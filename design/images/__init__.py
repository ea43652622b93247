"""Diffraction images, encircled energy and modulation transfer."""
