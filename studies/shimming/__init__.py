"""Shims: motions of rafts or CCDs that improve the images over a focal plane."""
