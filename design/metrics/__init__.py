"""Metrics of a design from rays and wavefronts."""
