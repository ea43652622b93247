"""
Spot diagrams
=============

Sizes of spots at three fields of the Paul-Baker telescope, all units attached: a result becomes an astropy table with
``to_table()``.
"""

import astropy.units as u
import numpy as np

import pachon

telescope = pachon.paul_baker()
fields = np.deg2rad([[0.0, 0.0], [0.0, 0.25], [0.0, 0.5]])
spots = pachon.spots(telescope, fields)
table = spots.to_table()
print(table["rms_radius"].to(u.nm))
print(table["rms_radius"].info.description)
spots.plot().savefig("spots.png")

# %%
# The command: ``pachon spots paul_baker --json``.
