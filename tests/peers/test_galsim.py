"""The atmosphere against GalSim: its theory, its screens, and its photons through the same screens."""

import importlib.util
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pachon.measure.shapes import fwhm
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.screen_sampling import ScreenSampling

galsim = pytest.importorskip("galsim")

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def study():
    """The benchmark that compares the two atmospheres, as a module."""
    spec = importlib.util.spec_from_file_location("atmosphere_vs_galsim", BENCHMARKS / "atmosphere_vs_galsim.py")
    module = importlib.util.module_from_spec(spec)
    # Its dataclasses look their module up by name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.long
def test_screens_have_the_structure_function_of_galsims_von_karman_profile():
    # A fixed modulus leaves no luck of the draw in the mean over a periodic screen.
    air = Atmosphere.from_site(
        "cerro_pachon",
        4,
        screens=ScreenSampling(
            screen_size=1024, screen_length=163.84, fine_size=1024, fine_pixel=0.02, fixed_modulus=True
        ),
        exposure=5.0,
    )
    profile = galsim.VonKarman(lam=500.0, r0_500=0.16, L0=25.0)
    layers = range(air.layer_count)
    low = [air.low_screen(n, "samples").astype(float) for n in layers]
    high = [air.high_screen(n, "samples").astype(float) for n in layers]
    for lag in (2, 5, 20, 100):
        path = sum(np.mean((np.roll(screen, -lag, axis=1) - screen) ** 2) for screen in low)
        path += sum(np.mean((np.roll(screen, -8 * lag, axis=1) - screen) ** 2) for screen in high)
        phase = path * (2.0 * math.pi / 500e-9) ** 2
        # A screen of 164 m lacks the modes longer than itself, 0.2 % of the variance; the fine one those below 4 cm.
        assert phase == pytest.approx(profile._structure_function(lag * 0.16), rel=0.01)


@pytest.mark.long
def test_screens_are_as_strong_as_galsims_screens(study):
    """Both draw the modes up to GalSim's own cut-off, 0.2/r0 cycles a metre; only the random numbers differ."""
    size = 1024
    screens = ScreenSampling(screen_size=size, screen_length=162.5)
    theirs = study.galsim_layers(Atmosphere.from_site("cerro_pachon", 4, exposure=5.0, screens=screens), 4)
    screens = replace(screens, cutoff=2.0 * math.pi * theirs[0].kmax)
    air = Atmosphere.from_site("cerro_pachon", 4, exposure=5.0, screens=screens)
    u, v = np.meshgrid(*[np.arange(size) * air.screen_pixel] * 2)
    for layer in range(air.layer_count):
        ours = air.low_screen(layer, "samples").astype(float)
        path = 1e-9 * theirs[layer].wavefront(u, v, 0.0)
        for lag, luck in ((1, 0.02), (4, 0.04)):
            ratio = [np.mean((np.roll(screen, -lag, axis=1) - screen) ** 2) for screen in (ours, path)]
            # Some 70 000 modes make the differences over a pixel, the long ones of them most: 0.5 % of luck a screen.
            assert ratio[0] / ratio[1] == pytest.approx(1.0, abs=luck), (layer, lag)


@pytest.mark.slow
def test_stars_through_galsims_own_screens(study):
    """Light through the same air at the same time: any slip of sign, axis, wind or height would show."""
    screens = ScreenSampling(screen_size=1024, screen_length=162.5)
    air = Atmosphere.from_site("cerro_pachon", 4, exposure=5.0, time_step=0.01, screens=screens)
    fields = study.FIELD * np.array([[0.0, 0.0], [1.0, 0.3], [-0.7, 0.8], [0.2, -1.0], [-0.9, -0.6], [0.6, 0.9]])
    layers = study.galsim_layers(air, 4)
    photons = 500_000
    images = study.galsim_stars(layers, fields, galsim.BaseDeviate(3), photons, exposure=5.0)
    ours = study.pachon_stars(study.long_paraboloid(), study.through_galsim_screens(air, layers), fields)
    e, theirs = study.ellipticity(ours), study.ellipticity(images)
    # Photons leave 0.4 / sqrt(500 000) = 0.0006 in a component; winds or heights wrong by a tenth would make 0.0045.
    assert np.std(theirs) > 0.006
    np.testing.assert_allclose(e, theirs, atol=0.0025)
    # The two kicks differ in width by half a per cent; the mean of six noisy widths is good to as much.
    assert np.mean(fwhm(ours, study.PIXEL) / fwhm(images, study.PIXEL)) == pytest.approx(1.0, abs=0.015)


@pytest.mark.slow
def test_atmosphere_alone_makes_the_same_stars_as_galsims(study):
    comparison = study.compare(range(20), exposures=16, stars=16, photons=50_000)
    width, width_error = comparison.ratio("fwhm")
    variance, variance_error = comparison.ratio("variance")
    # The comparison must be able to see what it is to exclude.
    assert width_error < 0.005
    assert variance_error < 0.12
    assert width == pytest.approx(1.0, abs=0.015)
    assert variance == pytest.approx(1.0, abs=0.15)
    # Through the same screens no luck is left.
    assert comparison.ratio("variance", "shared")[0] == pytest.approx(1.0, abs=0.15)
    assert comparison.correlation > 0.99
    # The part of xi+ that differs over the field: positive, falling through zero, negative beyond, and the same on both
    # sides within the luck of twenty seeds.
    (ours, our_error), (theirs, their_error) = (comparison.mean(side, "xi within") for side in ("pachon", "galsim"))
    for xi in (ours, theirs):
        assert xi[0] > xi[2] > xi[4]
        assert xi[1] > 0.0 > xi[-1]
    assert np.all(np.abs(ours - theirs) < 4.0 * np.hypot(our_error, their_error))
