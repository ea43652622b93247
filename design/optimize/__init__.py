"""Derivatives of wavefronts and spots, merit functions, optimisation."""
