"""Telescopes of batoid, in its own YAML."""
