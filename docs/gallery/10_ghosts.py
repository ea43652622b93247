"""
Ghosts of a bright star
=======================

Every pair of reflections at glass surfaces and the detector, brightest irradiance first.
"""

import numpy as np

import pachon

telescope = pachon.load_telescope("lsst_v3.3_r")
ghosts = pachon.ghosts(telescope, np.deg2rad([0.0, 0.7]), reflectivity=0.01, n_pupil=8000)
print(ghosts.to_table()["first", "second", "flux", "diameter"][:4])
print(f"all ghosts: {100 * ghosts.flux:.2f} % of the star's light")
ghosts.plot().savefig("ghosts.png")

# %%
# The command: ``pachon ghosts lsst_v3.3_r``.
