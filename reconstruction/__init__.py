"""PSF models: bases, interpolations and recipes; the whole focal plane; own stars; files of Piff."""
