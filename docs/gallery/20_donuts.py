"""
Wavefronts from donuts
======================

A star 1.5 mm out of focus through a misaligned telescope: the fit returns what the telescope has beyond the one
believed in.
"""

import numpy as np

import pachon

believed = pachon.load_telescope("lsst_v3.3_r").perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))
true = believed.perturbed("M2", shift=(200e-6, 0.0, 0.0))
field = np.deg2rad([[0.6, 0.9]])
air = pachon.Atmosphere.from_site("cerro_pachon", seed=2, exposure=15.0)
given = {"atmosphere": air, "electrons": 2e7, "sky": 100.0, "seed": 3}
drawn = pachon.draw_donuts(true, field, 622e-9, stamps=pachon.Stamps(160), **given)
model = pachon.DonutModel(diffraction=True)
fit = pachon.fit_donuts(believed, drawn.images, field, 622e-9, sky_variance=drawn.sky_variance, model=model)
before, after = (pachon.wavefront_zernikes(t, field, 622e-9).coefficients[0] for t in (believed, true))
for k, j in enumerate(fit.noll[:5]):
    expected = (after - before)[j - 1] * 1e9
    print(f"Z{j}: {fit.zernikes[0, k] * 1e9:+7.1f} +- {fit.errors[0, k] * 1e9:4.1f} nm, in truth {expected:+7.1f} nm")
fit.plot().savefig("donuts.png")

# %%
# More: :doc:`donuts <../explanation/donuts>`.

# %%
# Image, model and Zernikes on the :doc:`desk <../howto/desk>`, live in the notebook of this page:
pachon.open_desk(fit)
