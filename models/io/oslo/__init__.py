"""Lens files of OSLO (.len)."""
