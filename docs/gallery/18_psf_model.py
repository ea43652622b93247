"""
A PSF model from noisy stars
============================

Forty stars whose width and ellipticity change over the CCD; the model predicts the PSF between them.
"""

import numpy as np

import pachon

rng = np.random.default_rng(1)
y, x = np.mgrid[-12:13, -12:13]
places = rng.uniform(-1.0, 1.0, (40, 2))


def star(px, py):
    """A Gaussian, rounder and narrower towards the middle."""
    width, e = 2.0 + 0.2 * px * py, 0.04 * px
    return np.exp(-0.5 * ((x / (width * (1 + e))) ** 2 + (y / (width * (1 - e))) ** 2))


stamps = np.array([star(*place) for place in places])
stamps = 1e5 * stamps / stamps.sum(axis=(1, 2), keepdims=True)
model = pachon.PsfModel.fit(
    rng.poisson(stamps + 100.0) - 100.0, places, basis="pixels", interpolation="polynomial", order=2
)
truth = star(0.5, -0.5)
predicted = model.at([(0.5, -0.5)])[0]
print(model)
print(f"rms error between the stars: {np.std(predicted - truth / truth.sum()) / predicted.max():.1e} of the peak")
pachon.PsfModel.fit(stamps, places, n_components=3, order=2).plot().savefig("psf_model.png")

# %%
# Choices, measured: :doc:`PSF models <../howto/psf_models>`.
