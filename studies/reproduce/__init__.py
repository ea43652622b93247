"""The figures of Jee & Tyson (2011)."""
