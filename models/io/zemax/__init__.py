"""Zemax lens files (.zmx)."""
