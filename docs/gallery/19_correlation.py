"""
Ellipticity correlations
========================

A shear field of one spatial wave, sampled at random places: the correlation function shows its scale.
"""

import numpy as np

import pachon

rng = np.random.default_rng(4)
x, y = rng.uniform(-0.01, 0.01, (2, 800))
e1 = 0.03 * np.cos(2 * np.pi * x / 0.01) + 0.01 * rng.normal(size=800)
e2 = 0.01 * rng.normal(size=800)
found = pachon.shear_correlation(x, y, e1, e2, bins=pachon.SeparationBins(3e-4, 1.2e-2, 12))
print(f"xi+ at {found.r_arcmin[0]:.1f} arcmin: {found.xi_plus[0]:.2e} +- {found.error_plus[0]:.0e}")
print(f"expected at small separations: 0.03^2/2 = {0.03**2 / 2:.2e}")
found.plot().savefig("correlation.png")

# %%
# More: :doc:`diagnostics <../howto/diagnostics>`.
