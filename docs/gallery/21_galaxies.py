"""
Galaxies of a patch of sky
==========================

Galaxies drawn with the counts of the LSST Science Book, lensed, and written as a table.
"""

import numpy as np
from matplotlib.figure import Figure

import pachon

side = np.deg2rad(0.05)
galaxies = pachon.draw_galaxies(((-side, side), (-side, side)), faintest=25.0, seed=1)
lensed = galaxies.sheared(0.05, 0.0)
print(galaxies)
print(f"mean e1 before {np.mean(galaxies.e1):+.4f}, after {np.mean(lensed.e1):+.4f} for a shear of 0.05")
galaxies.write("galaxies.fits")
figure = Figure(figsize=(6, 3.4), layout="constrained")
axes = figure.subplots()
axes.hist(galaxies.magnitude, bins=np.arange(18, 25.5, 0.5), log=True)
axes.set(xlabel="magnitude", ylabel="galaxies in 0.01 square degrees")
figure.savefig("galaxies.png")

# %%
# More: :doc:`galaxies <../howto/galaxies>`.
