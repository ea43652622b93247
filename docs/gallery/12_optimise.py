"""
Refocus by optimisation
=======================

M2 is displaced by 50 um; the camera's focus and two motions compensate, with exact derivatives.
"""

import numpy as np

import pachon

telescope = pachon.load_telescope("lsst_v3.3_r").perturbed("M2", shift=(50e-6, 0.0, 50e-6))
fields = np.deg2rad([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]])
found = pachon.optimize(telescope, ["Camera.dz", "Camera.dx", "Camera.ry"], "spots", fields)
print(found)
for name, change, error in zip(found.to_table()["address"], found.changes, found.uncertainty, strict=True):
    print(f"{name:10s} {change:+.4g} +- {error:.1g}")
found.plot().savefig("optimum.png")

# %%
# The command: ``pachon optimize lsst_v3.3_r --variables Camera.dz,Camera.dx``.

# %%
# The telescope on the :doc:`desk <../howto/desk>`, live in the notebook of this page:
pachon.open_desk(found.telescope)
