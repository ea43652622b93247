"""Files of ray-optics (.roa)."""
