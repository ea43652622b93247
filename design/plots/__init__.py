"""Plots of design studies."""
