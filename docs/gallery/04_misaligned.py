"""
A misaligned mirror
===================

Moving M2 sideways makes coma that is the same all over the field, and astigmatism that grows with it. ``perturbed``
returns a new telescope.
"""

import numpy as np

import pachon

telescope = pachon.paul_baker()
fields = np.deg2rad([[0.0, 0.0], [0.0, 0.25], [0.0, 0.5]])
moved = telescope.perturbed("M2", shift=(100e-6, 0.0, 0.0))
before = pachon.wavefront_zernikes(telescope, fields)
after = pachon.wavefront_zernikes(moved, fields)
change = (after.coefficients - before.coefficients) * 1e9
print("coma Z8 [nm] by field:", np.round(change[:, 7], 2))
print("astigmatism Z5 [nm] by field:", np.round(change[:, 4], 3))
after.plot().savefig("misaligned.png")

# %%
# More: :doc:`perturbations and degrees of freedom <../howto/perturbations>`.
