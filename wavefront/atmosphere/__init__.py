"""Turbulence, phase screens, refraction."""
