"""CODE V lens files (.seq)."""
