"""Simulated stars and exposures of CCDs."""
