"""PSF engines of a wide-angle lens whose rays are aimed at the stop: each star has pupil points of its own."""

from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.models.io.prescription import load_telescope
from pachon.wavefront.pupil_optics import trace_pupils

WIDE = Path(__file__).parents[2] / "data" / "zmx" / "circular_aperture_example_with_aperture.zmx"


@pytest.fixture(scope="module")
def wide():
    return load_telescope(WIDE)


@pytest.mark.long
@pytest.mark.parametrize(
    "engine",
    ["fast", pytest.param("wave", marks=pytest.mark.slow), pytest.param("long_exposure", marks=pytest.mark.slow)],
)
def test_every_engine_has_the_light_that_the_apertures_leave(wide, engine):
    spots = pachon.spots(wide, sampling="spiral", n_pupil=4000, threads=1)
    options = {"engine": engine, "stamps": pachon.Stamps(41, pixel_size=1e-6), "threads": 1}
    if engine == "long_exposure":
        options["atmosphere"] = pachon.Atmosphere.from_site(
            "cerro_pachon", seed=1, screens=pachon.ScreenSampling(screen_size=512, screen_length=40.0), exposure=0.1
        )
    psf = pachon.make_psfs(wide, spots.fields, [587e-9], **options)
    # Lattices of some thousand points: half a per cent of the pupil.
    assert psf.lit_fraction[:, 0] == pytest.approx(spots.lit_fraction, abs=5e-3)
    assert spots.lit_fraction[-1] < 0.8


def test_pupils_of_stars_are_those_of_a_request(wide):
    fields = np.deg2rad([[0.0, 0.0], [0.0, 35.0], [10.0, 50.0]])
    waves = np.array([587e-9, 600e-9])
    points = 0.5 * wide.pupil_diameter * np.array([[0.3, 0.4], [-0.9, 0.1], [0.0, -0.5]])
    optics = trace_pupils(wide, fields, waves, points, threads=1)
    for w, wavelength in enumerate(waves):
        bundles = pachon.Request.of(wide, fields, wavelength).bundles(wavelength, points)
        away = bundles.landing() - (optics.reference_points @ wide.surfaces[-1].matrix)[:, None, :2]
        # Single precision of micrometres.
        assert optics.displacement[:, w] == pytest.approx(away, abs=1e-9)
        assert np.array_equal(optics.lit[:, w], bundles.lit)
