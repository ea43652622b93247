"""Shims: motions of rafts or CCDs that make the images of a focal plane sharper."""
