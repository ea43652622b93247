"""A rim that stands elsewhere, in fits of several donuts: one set of its motions for all of them."""

from dataclasses import replace

import numpy as np
import pytest
from donut_images import PIXEL, WAVELENGTH, donut, noisy

import pachon

MODEL = pachon.DonutModel(
    air=pachon.DonutAir(fwhm=0.0),
    detector=pachon.DonutDetector(pixel_size=PIXEL, diffusion=PIXEL),
    diffraction=False,
    neighbours=False,
)
NOISE = 1000.0
#: The filter bounds the light of four donuts, and not that of the last.
FIELDS = np.deg2rad(
    [*(1.745 * np.array([np.cos(a), np.sin(a)]) for a in np.deg2rad([53.0, 143.0, 233.0, 323.0])), (0.7, 0.6)]
)


@pytest.fixture(scope="module")
def larger_filter(behind_focus):
    """Donuts of a filter 8 mm larger, M2 and camera off, and the wavefronts of these."""
    surfaces = tuple(
        replace(s, aperture=replace(s.aperture, radius=s.aperture.radius + 8e-3)) if s.name.startswith("Filter") else s
        for s in behind_focus.surfaces
    )
    true = replace(behind_focus, surfaces=surfaces).perturbed("M2", shift=(1e-4, 0.5e-4, 0.0))
    true = true.perturbed("Camera", shift=(0.0, 2e-4, 5e-6))
    images = np.array([noisy(donut(true, field, rays=700), NOISE, i) for i, field in enumerate(FIELDS)])
    before, after = (
        pachon.wavefront_zernikes(t, FIELDS, WAVELENGTH, jmax=22).coefficients[:, 3:] for t in (behind_focus, true)
    )
    return images, after - before


def fitted(telescope, images, kind):
    return pachon.fit_donuts(
        telescope, images, FIELDS, WAVELENGTH, sky_variance=NOISE, pixel_size=PIXEL, model=MODEL, fit=kind, threads=1
    )


def assert_found(fit, truth):
    """Errors within 30 nm, as claimed, and one rim for the donuts that it bounds."""
    errors = fit.zernikes - truth
    assert np.linalg.norm(errors, axis=1).max() < 30e-9
    squares = [e @ np.linalg.solve(c, e) for e, c in zip(errors, fit.covariance, strict=True)]
    # Of 19 terms, all donuts by the same ones: 2 is three standard deviations.
    assert np.mean(squares) / 19 < 2.0
    assert {"Filter_entrance, Filter_exit"} == set(fit.rims["rim"])
    assert set(fit.rims["donut"]) <= {0, 1, 2, 3}
    assert len(fit.rims) >= 3
    for motion in ("x", "y", "growth"):
        assert np.ptp(fit.rims[motion]) == 0.0
    moved = [bool(pachon.sensing.DonutFlag(int(f)) & pachon.sensing.DonutFlag.RIM_MOVED) for f in fit.flags]
    assert moved == [i in fit.rims["donut"] for i in range(len(FIELDS))]


@pytest.mark.long
def test_field_terms_with_a_rim_that_one_donut_tells(behind_focus, larger_filter):
    """31 to 55 nm wrong, with 21 to 32 claimed, where each donut has the rim of its own fit."""
    images, truth = larger_filter
    assert_found(fitted(behind_focus, images, pachon.sensing.FieldTerms([1, 2, 3])), truth)


@pytest.mark.slow
def test_degrees_of_freedom_with_a_rim_elsewhere(behind_focus, larger_filter):
    images, truth = larger_filter
    freedoms = pachon.load_degrees_of_freedom("lsst")
    freedoms = freedoms.select([name for name in freedoms.names if "_B" not in name])
    assert_found(fitted(behind_focus, images, pachon.sensing.TelescopeFreedoms(freedoms)), truth)
