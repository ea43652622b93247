"""
An image of the sky, at two depths
==================================

A hundred arc seconds of one CCD: galaxies like those of the Ultra Deep Field under optics, CCD heights and the mean
over all turbulence, in 15 s and in 6000 s. The stretch is asinh.
"""

import numpy as np
from matplotlib.figure import Figure

import pachon

run = pachon.Configuration(
    ccds=("R22_S11",), psf={"engine": "long_exposure", "stamp": 63, "n_pupil": 300}, stars={"truth": 30}
)
experiment = pachon.Experiment.from_config(run)
galaxies = pachon.GalaxyPopulation(faintest=28.0, seed=1)
with experiment.screens():
    scene = pachon.draw_ccd(
        experiment,
        "R22_S11",
        galaxies.galaxies_in,
        pointing=np.deg2rad([53.1, -27.8]),
        window=pachon.Window(1800, 1800, 500, 500),
    )
figure = Figure(figsize=(11, 5.2), layout="constrained")
for part, exposures in zip(figure.subfigures(1, 2), (1, 400), strict=True):
    image = scene.exposed(pachon.Exposure("r", time=15.0, exposures=exposures))
    image.plot(ax=part)
    peak = image.image.max() / np.sqrt(np.median(image.variance))
    print(f"{exposures} exposures: {len(image.objects['MAG'])} objects, brightest pixel {peak:.0f} rms above the sky")
figure.savefig("sky_image.png")
image.write("image.fits")

# %%
# More: :doc:`images of CCDs <../howto/images>`.
