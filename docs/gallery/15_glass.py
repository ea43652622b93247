"""
Glass and air
=============

Refractive indices by the formulas of glass catalogues and by Ciddor's air, with units as they come.
"""

import astropy.units as u
import numpy as np
from matplotlib.figure import Figure

import pachon

silica = pachon.Sellmeier(B=(0.6961663, 0.4079426, 0.8974794), C=(0.0684043**2, 0.1162414**2, 9.896161**2))
air = pachon.Air(pressure=750 * u.hPa, temperature=278.0)
print(f"fused silica at 587.6 nm: {silica.index(587.5618 * u.nm):.6f}")
print(f"air of a mountain at 620 nm: 1 + {(air.index(620 * u.nm) - 1) * 1e6:.2f}e-6")
waves = np.linspace(320, 1060, 80) * u.nm
figure = Figure(figsize=(6, 3.4), layout="constrained")
axes = figure.subplots()
axes.plot(waves.value, silica.index(waves))
axes.set(xlabel="wavelength [nm]", ylabel="refractive index", title="fused silica (Malitson 1965)")
figure.savefig("glass.png")

# %%
# AGF catalogues are read by ``GlassCatalogue.read``.
