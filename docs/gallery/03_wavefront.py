"""
A wavefront and its Zernike terms
=================================

The optical path difference of one field point over the entrance pupil, and its annular Zernike terms in Noll's order.
"""

import numpy as np

import pachon

telescope = pachon.load_telescope("lsst_v3.3_r")
opd = pachon.wavefront_opd(telescope, np.deg2rad([0.0, 1.2]), 620e-9, grid=48)
fit = pachon.fit_zernikes(opd, pupil_radius=4.18, obscuration=telescope.pupil_obscuration)
print(opd)
for j in (4, 7, 11):
    print(f"Z{j:<2d} {fit.coefficients[j - 1] * 1e9:8.2f} nm")
opd.plot(fit, name=telescope.name).savefig("wavefront.png")

# %%
# Signs and frames: :doc:`conventions <../explanation/conventions>`.
