"""What exists: prescriptions, glasses, cameras, sites and their files. NumPy only, no Warp."""
