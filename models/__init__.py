"""Physical models: telescopes, surfaces, media, cameras, sites and their files. NumPy only, no Warp."""
