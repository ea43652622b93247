"""Galaxies on the sky: populations, catalogues, stamps of real mosaics, and their Fourier transforms."""
