"""
Tolerances by Monte Carlo
=========================

Thousands of telescopes drawn within tolerances, each refocused, from one sensitivity matrix.
"""

import numpy as np

import pachon

telescope = pachon.paul_baker()
tolerances = [
    pachon.Tolerance("M2.dx", 400e-6),
    pachon.Tolerance("M2.dz", 400e-6),
    pachon.Tolerance("M2.ry", 100e-6),
    pachon.Tolerance("M3.dx", 400e-6),
]
fields = np.deg2rad([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3], [-0.3, -0.3]])
drawn = pachon.monte_carlo(
    telescope, tolerances, "wavefront", n=2000, seed=1, fields=fields, compensators=["Detector.dz"]
)
print(f"as designed {drawn.nominal * 1e9:.1f} nm; 95 % of the telescopes below {drawn.at_most(0.95) * 1e9:.0f} nm")
drawn.plot().savefig("tolerances.png")

# %%
# More: :doc:`perturbations and tolerances <../howto/perturbations>`.

# %%
# The drawn telescopes on the :doc:`desk <../howto/desk>`, live in the notebook of this page:
pachon.open_desk(drawn)
