"""Refractive media: constant, Sellmeier and other dispersion formulas, tables, air."""
