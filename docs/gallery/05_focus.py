"""
Through focus
=============

Spot size, wavefront and Strehl ratio while the detector moves along its axis, and where each field is sharpest.
"""

import numpy as np

import pachon

telescope = pachon.paul_baker()
fields = np.deg2rad([[0.0, 0.0], [0.0, 0.4]])
focus = pachon.through_focus(telescope, fields, defocus=np.linspace(-260e-6, -60e-6, 25))
print("best focus of each field [um]:", np.round(focus.best_spot * 1e6, 3))
print(f"of both together: {focus.best_common * 1e6:.3f} um")
focus.plot().savefig("focus.png")

# %%
# The command: ``pachon focus paul_baker``.
