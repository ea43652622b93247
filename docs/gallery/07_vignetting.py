"""
Vignetting, and which surface blocks
====================================

The lit fraction of the pupil against field, and the footprints of the beams on two surfaces.
"""

import numpy as np

import pachon

telescope = pachon.load_telescope("lsst_v3.3_r")
fields = np.deg2rad([[0.0, r] for r in (0.0, 0.8, 1.2, 1.5, 1.75)])
light = pachon.vignetting(telescope, fields, n_pupil=4096)
print("light relative to the axis:", np.round(light.relative, 3), "+-", np.round(light.error.max(), 4))
beams = pachon.footprint(telescope, ["M2", "Filter_entrance"], fields[[0, 2, 4]])
print(beams.to_table()["name", "blocked_fraction"])
beams.plot().savefig("footprint.png")

# %%
# The commands: ``pachon vignetting``, ``pachon footprint``.
