"""Shapes, star selection, correlations, diagnostics."""
