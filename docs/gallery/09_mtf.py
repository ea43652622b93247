"""
Modulation transfer
===================

Contrast of a sinusoidal pattern against its frequency, with the diffraction limit of the same pupil.
"""

import numpy as np

import pachon

telescope = pachon.paul_baker()
mtf = pachon.mtf(telescope, np.deg2rad([[0.0, 0.0], [0.0, 0.5]]), 620e-9, n_pupil=96)
half = mtf.frequency_at(0.5) * 1e-3
print("contrast of 50 % at [cycles/mm], tangential and sagittal:")
print(np.round(half, 1))
mtf.plot().savefig("mtf.png")

# %%
# The command: ``pachon mtf paul_baker``.
