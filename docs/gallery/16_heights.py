"""
Heights of a focal plane
========================

The heights of 189 CCDs, drawn from the budget of Jee & Tyson (2011), Table 1, beside those of LSSTCam as built.
"""

from matplotlib.figure import Figure

import pachon

drawn = pachon.FocalPlane.from_budget("lsst", seed=1)
built = pachon.FocalPlane.as_measured("lsstcam")
figure = Figure(figsize=(12, 4.6), layout="constrained")
for plane, axes in zip((drawn, built), figure.subplots(1, 2), strict=True):
    summary = plane.summary()
    print(f"{plane}: rms {summary['rms_height_um']:.2f} um, peak to valley {summary['peak_to_valley_um']:.1f} um")
    plane.plot(ax=axes)
figure.savefig("heights.png")

# %%
# More: :doc:`the camera as built <../howto/camera>`.

# %%
# Heights by hand on the :doc:`desk <../howto/desk>`, live in the notebook of this page:
pachon.open_desk("lsst_v3.3_r")
