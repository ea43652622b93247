"""
Stars through optics and air
============================

PSFs on real CCD heights with the mean over all turbulence, and their shapes.
"""

import numpy as np

import pachon

telescope = pachon.load_telescope("lsst_v3.3_r")
heights = pachon.FocalPlane.from_budget("lsst", seed=1)
fields = pachon.fields_at(telescope, [(0.0, 0.0), (0.1, 0.05), (0.2, -0.15), (0.28, 0.1)])
air = pachon.Atmosphere.from_site("cerro_pachon", seed=2, exposure=15.0)
psfs = pachon.make_psfs(telescope, fields, [620e-9], focal_plane=heights, atmosphere=air, engine="long_exposure")
shapes = pachon.measure_shapes(psfs.image, psfs.pixel_scale, weight_fwhm=np.deg2rad(0.7 / 3600))
print(psfs)
print("e1:", np.round(shapes.e1, 4), " e2:", np.round(shapes.e2, 4))
psfs.plot().savefig("psfs.png")

# %%
# Engines and their limits: :doc:`atmosphere and PSF engines <../explanation/psf_engines>`.
