"""
Sensitivity to degrees of freedom
=================================

The exact derivative of every Zernike term at every field by every parameter, in one call; the singular values say
which combinations can be told apart.
"""

import numpy as np

import pachon

telescope = pachon.load_telescope("lsst_v3.3_r")
motions = ["M2.dx", "M2.dz", "M2.ry", "Camera.dx", "Camera.dz", "Camera.ry", "M1.Z6"]
fields = np.deg2rad([[0.0, 0.0], [1.0, 0.0], [0.0, 1.5]])
matrix = pachon.sensitivity(telescope, motions, fields, n_zernike=15)
for name, rms in zip(motions, matrix.rms, strict=True):
    print(f"{name:10s} {rms:10.4g} m of wavefront a unit")
values, modes = matrix.modes()
print("singular values:", np.round(values, 4))
matrix.plot().savefig("sensitivity.png")

# %%
# More: :doc:`derivatives <../explanation/derivatives>`.
