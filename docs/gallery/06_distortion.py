"""
Distortion and plate scale
==========================

Where stars land, against a scaled picture of the sky; and the world coordinates of one CCD made of the same chief
rays.
"""

import numpy as np

import pachon

telescope = pachon.load_telescope("lsst_v3.3_r")
radii, angles = np.meshgrid(np.deg2rad([0.4, 0.8, 1.2, 1.6]), np.arange(8) * np.pi / 4)
fields = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1).reshape(-1, 2)
distortion = pachon.distortion(telescope, fields)
print("distortion against the scale on the axis [%]:", np.round(distortion.percent_of_axis_scale[:4], 4))
wcs = pachon.ccd_wcs(telescope, pachon.lsst_camera(), "R22_S11", pointing=np.deg2rad([53.1, -27.8]))
print(f"WCS of R22_S11: largest error {wcs.error * 206264.8 * 1e3:.4f} mas")
distortion.plot().savefig("distortion.png")

# %%
# More: :doc:`images and world coordinates <../howto/images>`.
