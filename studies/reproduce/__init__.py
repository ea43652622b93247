"""Reproduction of the figures of Jee & Tyson (2011)."""
