"""
Diffraction images and encircled energy
=======================================

The image of a star by a Fourier sum over the exact wavefront, and the circle that holds most of its light.
"""

import numpy as np

import pachon

telescope = pachon.paul_baker()
fields = np.deg2rad([[0.0, 0.0], [0.0, 0.45]])
psf = pachon.fft_psf(telescope, fields, 620e-9, pixel=0.5e-6, pixels=48)
energy = pachon.encircled_energy(telescope, fields, 620e-9, n_pupil=96)
print("Strehl ratio:", np.round(psf.strehl, 4), " FWHM [um]:", np.round(psf.fwhm * 1e6, 2))
print("80 % of the light within [um]:", np.round(energy.radius_holding(0.8) * 1e6, 2))
psf.plot().savefig("psf.png")

# %%
# More: :doc:`images of a design <../howto/design_images>`.
