"""Tolerances of a telescope: sensitivity, inverse sensitivity, Monte Carlo, yield."""
