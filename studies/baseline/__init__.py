"""Baselines for regression tests."""
