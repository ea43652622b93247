"""Telescopes of batoid, in its own YAML."""

#: Key of the outermost optic, by which a file is known as batoid's.
ROOT = "opticalSystem"
