"""The layered atmosphere: geometry, streams, frozen flow, and what it refuses."""

import dataclasses
import math
import pickle
import re
import weakref

import numpy as np
import pytest
from astropy import units as u

from pachon.core import memory
from pachon.core.errors import ConfigError, DomainError, PrescriptionError, UnknownNameError
from pachon.models.io.site_file import load_site
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.layer_screens import SLOPE_LAG
from pachon.wavefront.atmosphere.screen_sampling import ScreenSampling
from pachon.wavefront.atmosphere.turbulence import path_variance, structure_function

SMALL = {"screen_size": 512, "screen_length": 81.92, "fine_size": 512, "fine_pixel": 0.02}
LAYERS = ("altitudes", "weights", "wind_speeds", "wind_directions")


def small_atmosphere(seed=2, site="cerro_pachon", exposure=2.0, **options):
    """Return an atmosphere of small screens; options are those of screens, layers and `from_site`."""
    sampling = {f.name: options.pop(f.name) for f in dataclasses.fields(ScreenSampling) if f.name in options}
    layers = {name: options.pop(name) for name in LAYERS if name in options}
    site = (load_site(site) if isinstance(site, str) else site).with_layers(**layers)
    return Atmosphere.from_site(site, seed, exposure=exposure, screens=ScreenSampling(**SMALL | sampling), **options)


def test_default_atmosphere_of_the_site():
    atmosphere = Atmosphere.from_site("cerro_pachon", 2)
    # Jee & Tyson (2011), section 3, and the project's physics notes.
    np.testing.assert_allclose(atmosphere.altitudes, [0.0, 2580.0, 5160.0, 7730.0, 12890.0, 15460.0])
    np.testing.assert_allclose(atmosphere.weights, [0.652, 0.172, 0.055, 0.025, 0.074, 0.022])
    assert (atmosphere.r0, atmosphere.outer_scale, atmosphere.exposure) == (0.16, 25.0, 15.0)
    assert (atmosphere.screen_size, atmosphere.screen_length) == (8192, 1300.0)
    assert atmosphere.cutoff == 1.4 / 0.16
    assert len(atmosphere.times) == 300
    assert (atmosphere.screen_pixel, atmosphere.fine_length) == (1300.0 / 8192, pytest.approx(43.008))
    speeds = np.hypot(*atmosphere.velocities.T)
    np.testing.assert_allclose(speeds, load_site("cerro_pachon").wind_speeds)
    assert speeds.max() <= 20.0 + 1e-9
    assert np.all((atmosphere.offsets >= 0.0) & (atmosphere.offsets < 1300.0))


def test_layers_at_other_altitudes_share_their_screens():
    air = small_atmosphere()
    lifted = air.at_altitudes([200.0, *air.altitudes[1:]])
    assert lifted.screens("slopes") is air.screens("slopes")
    direction = np.array([0.01, 0.0, -1.0])
    moved = lifted.pupil_centers(direction) - air.pupil_centers(direction)
    # A layer h away is crossed at -h tan(angle) of the pupil's centre.
    np.testing.assert_allclose(moved, [[-2.0, 0.0], *[[0.0, 0.0]] * 5], atol=1e-12)
    for altitudes in ([0.0], [-1.0, *air.altitudes[1:]], [np.nan, *air.altitudes[1:]]):
        with pytest.raises(DomainError, match="expected 6 distances of 0 m or more"):
            air.at_altitudes(altitudes)


def test_times_are_the_middles_of_even_steps():
    atmosphere = small_atmosphere(exposure=1.0, time_step=0.3)
    np.testing.assert_allclose(atmosphere.times, [0.125, 0.375, 0.625, 0.875])
    assert len(small_atmosphere(exposure=0.01, time_step=0.05).times) == 1
    assert len(small_atmosphere(exposure=3.0, time_step=0.005).times) == 600


def test_variance_of_all_layers_and_scales_is_that_of_the_turbulence():
    atmosphere = small_atmosphere(fixed_modulus=True, weights=[0.6, 0.1, 0.1, 0.1, 0.05, 0.053])
    # Rounded to three figures, as published weights are.
    assert atmosphere.weights.sum() == pytest.approx(1.0, rel=1e-14)
    layers = range(atmosphere.layer_count)
    low = [np.mean(atmosphere.low_screen(n, "samples").astype(float) ** 2) for n in layers]
    high = [np.mean(atmosphere.high_screen(n, "samples").astype(float) ** 2) for n in layers]
    # Squared amplitudes go with the weights (float32).
    np.testing.assert_allclose(low / np.sum(low), atmosphere.weights, rtol=1e-5)
    np.testing.assert_allclose(high / np.sum(high), atmosphere.weights, rtol=1e-5)
    # A screen of side L lacks its mean, 0.265 (L0/L)^2 of the variance.
    expected = path_variance(0.16, 25.0) * (1.0 - 0.265 * (25.0 / 81.92) ** 2)
    assert np.sum(low) + np.sum(high) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("scale", ["low", "high"])
def test_path_passes_through_the_samples(scale):
    atmosphere = small_atmosphere()
    make = atmosphere.low_screen if scale == "low" else atmosphere.high_screen
    pixel = atmosphere.screen_pixel if scale == "low" else atmosphere.fine_pixel
    samples = make(1, "samples")
    index = np.arange(40)
    # float32
    read = atmosphere.path(index * pixel, 3 * pixel, 1, scale=scale)
    np.testing.assert_allclose(read, samples[3, :40], atol=5e-6 * samples.std())


def test_screens_are_periodic():
    atmosphere = small_atmosphere()
    x, y = np.array([3.3, 70.1]), np.array([0.2, 11.0])
    for scale, side in (("low", atmosphere.screen_length), ("high", atmosphere.fine_length)):
        here = atmosphere.path(x, y, 2, scale=scale)
        # Rounding of the coordinates.
        np.testing.assert_allclose(atmosphere.path(x - 2 * side, y + side, 2, scale=scale), here, atol=1e-15)


def test_layers_are_crossed_where_the_light_comes_from_and_the_wind_has_blown():
    atmosphere = small_atmosphere(wind_directions=[0.0, math.pi / 2, 0.0, 0.0, 0.0, 0.0])
    speeds = load_site("cerro_pachon").wind_speeds
    x, y = atmosphere.screen_coordinates(1.0, 2.0, 0, field=(0.01, -0.02), time=3.0)
    # The ground layer is the same for all fields; it moves towards +x, so later light meets what lay at smaller x.
    np.testing.assert_allclose(atmosphere.offsets[0] + [1.0 - 3.0 * speeds[0], 2.0], [x, y], rtol=1e-12)
    x, y = atmosphere.screen_coordinates(1.0, 2.0, 1, field=(0.01, -0.02), time=3.0)
    # Light that travels towards +x crossed the layer at smaller x.
    expected = atmosphere.offsets[1] + [1.0 - 25.8, 2.0 + 51.6 - 3.0 * speeds[1]]
    np.testing.assert_allclose([x, y], expected, rtol=1e-12)


def test_turbulence_stays_the_same_all_through_the_exposure():
    """Interpolated anywhere between the samples, whenever, the structure function is the same: r0 does not drift."""
    atmosphere = small_atmosphere(weights=[1.0], altitudes=[0.0], wind_speeds=[13.7], wind_directions=[0.4])
    step = 0.32
    axis = np.arange(256) * step
    x, y = np.meshgrid(axis, axis)
    measured = []
    for time in (0.0, 3.71, 7.5, 15.0):
        places = atmosphere.screen_coordinates(x, y, 0, time=time)
        path = atmosphere.path(*places, 0, scale="low")
        measured.append([np.mean((path - np.roll(path, -lag, axis=1)) ** 2) for lag in (1, 4, 16)])
    # The same periodic field on shifted grids; modes beyond the Nyquist limit of the grid of 0.32 m shift by 1e-3.
    np.testing.assert_allclose(measured, np.broadcast_to(measured[0], (4, 3)), rtol=3e-3)


def test_slopes_of_the_fast_engine_are_the_gradient_of_the_path():
    """Packed slopes at the samples against differences of the spline; only a lag makes them less."""
    atmosphere = small_atmosphere()
    index = np.arange(0, 512, 5)
    x, y = np.meshgrid(index * atmosphere.screen_pixel, index * atmosphere.screen_pixel)
    counts = atmosphere.slope_screen(1)[np.ix_(index, index)]
    slopes = np.stack([counts.astype(np.int16), counts >> 16]) * atmosphere.slope_unit(1)
    h = 0.5 * SLOPE_LAG if SLOPE_LAG else 1e-3
    spline = np.stack(
        [
            atmosphere.path(x + h, y, 1) - atmosphere.path(x - h, y, 1),
            atmosphere.path(x, y + h, 1) - atmosphere.path(x, y - h, 1),
        ]
    ) / (2 * h)
    # A difference over the lag falls off along its own axis only, the sinc of the slopes with the wavenumber.
    assert np.sqrt(np.mean((slopes - spline) ** 2)) < 0.03 * np.std(spline)


def test_streams_are_separate_and_repeatable():
    first, again = small_atmosphere(), small_atmosphere()
    assert first.low_screen(3).tobytes() == again.low_screen(3, threads=1).tobytes()
    assert first.high_screen(3).tobytes() == again.high_screen(3, threads=3).tobytes()
    np.testing.assert_array_equal(first.velocities, again.velocities)
    np.testing.assert_array_equal(first.offsets, again.offsets)
    # Another fine grid, exposure or weight of other layers leaves the low screens and the winds as they were.
    other = small_atmosphere(fine_size=256, exposure=3.0, ground_lift=200.0)
    assert other.low_screen(3).tobytes() == first.low_screen(3).tobytes()
    np.testing.assert_array_equal(other.velocities, first.velocities)
    fewer = small_atmosphere(altitudes=[0.0, 5000.0], weights=[0.5, 0.5], wind_speeds=[5.0, 10.0])
    np.testing.assert_array_equal(fewer.offsets, first.offsets[:2])
    for changed in (small_atmosphere(seed=3), small_atmosphere(epoch=1)):
        assert not np.array_equal(changed.velocities, first.velocities)
        assert not np.array_equal(changed.low_screen(3), first.low_screen(3))
    # Layers are independent too: 3 outer scales on a side leave correlations of some 0.1.
    correlation = np.corrcoef(first.low_screen(2).ravel(), first.low_screen(3).ravel())[0, 1]
    assert abs(correlation) < 0.4


@pytest.mark.parametrize(
    ("kind", "size", "dtype"), [("slopes", 512, np.int32), ("low", 512, np.float32), ("high", 512, np.float32)]
)
def test_screens_are_kept_until_released(kind, size, dtype):
    atmosphere = small_atmosphere()
    screens = atmosphere.screens(kind)
    assert screens.dtype == dtype
    assert screens.shape == (6, size, size)
    assert atmosphere.screens(kind) is screens
    make = {"slopes": atmosphere.slope_screen, "low": atmosphere.low_screen, "high": atmosphere.high_screen}[kind]
    np.testing.assert_array_equal(screens[4], make(4))
    with pytest.raises(ValueError, match="read-only"):
        screens[0, 0, 0] = 1
    atmosphere.release()
    anew = atmosphere.screens(kind)
    assert anew is not screens
    np.testing.assert_array_equal(anew, screens)
    with pytest.raises(UnknownNameError, match="unknown kind"):
        atmosphere.screens("fine")


def test_rows_that_light_crosses_are_made_when_they_are_asked_for():
    air, whole = small_atmosphere(), small_atmosphere().screens("slopes")
    rows = np.zeros((6, 512), dtype=bool)
    rows[:, 200] = True
    rows[3] = False
    screens = air.screens("slopes", None, rows)
    # The block of 128 rows of the one that was asked for; the other layer was not asked for.
    for layer in (0, 5):
        np.testing.assert_array_equal(screens[layer, 128:256], whole[layer, 128:256])
    made = air.screens("slopes", None, rows)
    assert made is screens
    # More rows than those: now all of them.
    rows[0, 300] = True
    assert air.screens("slopes", None, rows) is screens
    np.testing.assert_array_equal(screens[0], whole[0])
    assert air.screens("slopes") is screens
    np.testing.assert_array_equal(screens, whole)


def test_releasing_one_atmosphere_empties_no_other():
    air = small_atmosphere(time_step=0.1)
    part, higher = air.at_times(air.times[5:8]), air.at_altitudes(air.altitudes + 100.0)
    screens, freed = air.screens("slopes"), []
    weakref.finalize(screens.base, freed.append, True)
    assert part.screens("slopes") is screens
    assert higher.screens("slopes") is screens
    del screens
    part.release()
    air.release()
    assert higher.screens("slopes") is part.screens("slopes"), "shared again, not made a second time"
    part.release()
    assert not freed
    # Memory is freed with the last user, whether it is released or gone.
    del higher
    assert not freed, "only a release frees what another atmosphere may want again"
    air.release()
    assert freed
    anew = part.screens("slopes")
    weakref.finalize(anew.base, freed.append, True)
    del anew, part, air
    assert len(freed) == 2


def test_other_screens_are_not_shared():
    air = small_atmosphere()
    screens = air.screens("low")
    for other in (dataclasses.replace(air, r0=0.2), small_atmosphere(epoch=1)):
        assert other.store is not air.store
        assert not np.array_equal(other.screens("low"), screens)
    same = dataclasses.replace(small_atmosphere(), store=air.store)
    assert same.screens("low") is screens
    # Screens are not sent to other processes: they make their own.
    sent = pickle.loads(pickle.dumps(air))
    assert sent.store.key == air.store.key
    assert sent.screens("low") is not screens
    np.testing.assert_array_equal(sent.screens("low"), screens)


@pytest.mark.parametrize("radius", [4.0, pytest.param(45.0, marks=pytest.mark.slow)])
def test_rows_under_the_light_of_stars(radius):
    """Brute force: every star, every time step, points around the rim of the pupil."""
    air = small_atmosphere(time_step=0.1)
    slopes = np.random.default_rng(1).uniform(-2e-3, 2e-3, (5, 2))
    directions = np.column_stack([slopes, -np.ones(5)])
    rows = air.rows_under(directions, radius)
    crossed = np.zeros_like(rows)
    for slope in slopes:
        for time in air.times:
            for y in np.linspace(-radius, radius, 601):
                place = y - air.altitudes * slope[1] - air.velocities[:, 1] * time + air.offsets[:, 1]
                crossed[np.arange(6), np.floor(place / 0.16 + 0.5).astype(int) % 512] = True
    assert np.all(rows[crossed])
    # Few rows besides: two on either side, and half a sample of rounding.
    assert np.all(rows.sum(axis=1) <= crossed.sum(axis=1) + 7)
    assert rows.all() == (radius > 0.5 * 81.92)
    assert not air.rows_under(np.empty((0, 3)), radius).any()


def test_the_same_air_at_other_times():
    air = small_atmosphere(time_step=0.1)
    part = air.at_times(air.times[5:8])
    np.testing.assert_array_equal(part.times, air.times[5:8])
    assert part.exposure == pytest.approx(0.3)
    # Screens made through either are kept for both, whoever comes first.
    assert part.screens("low") is air.screens("low")
    assert air.screens("slopes") is part.screens("slopes")
    # A finer look at the whole of it is what the site gives for that step.
    fine, anew = air.at_times((np.arange(40) + 0.5) * 0.05, 2.0), small_atmosphere(time_step=0.05)
    np.testing.assert_allclose(fine.times, anew.times, rtol=1e-14)
    assert fine.exposure == anew.exposure
    np.testing.assert_array_equal(fine.screens("slopes"), anew.screens("slopes"))
    for times, exposure, text in [
        ([], None, "expected a list of finite times"),
        ([0.1, math.nan], None, "expected a list of finite times"),
        ([0.05, 0.15, 0.35], None, "middles of 3 equal steps of 0.1 s"),
        ([0.15, 0.05], None, "middles of 2 equal steps"),
        (air.times, 3.0, "equal steps of 0.15 s"),
        (air.times, -1.0, "exposure = -1.0"),
    ]:
        with pytest.raises(DomainError, match=text):
            air.at_times(times, exposure)


def test_ground_lift_and_zenith_angle():
    lifted = small_atmosphere(ground_lift=200.0)
    np.testing.assert_allclose(lifted.altitudes[:2], [200.0, 2580.0])
    low = small_atmosphere(ground_lift=200.0, zenith_angle=60.0 * u.deg)
    # Along a line at 60 degrees everything is twice as far and the turbulence twice as strong.
    np.testing.assert_allclose(low.altitudes[:2], [400.0, 5160.0])
    assert low.r0 == pytest.approx(0.16 * 0.5**0.6)
    assert lifted.cutoff == pytest.approx(1.4 / 0.16)
    # 1.4 / 0.106 m would be beyond half the Nyquist limit.
    assert low.cutoff == pytest.approx(0.5 * np.pi / low.screen_pixel)


def test_an_exposure_may_be_as_long_as_no_layer_comes_round():
    assert small_atmosphere(exposure=4.09).exposure == 4.09
    assert small_atmosphere(exposure=1e4, time_step=1e4, wind_speeds=[0.0] * 6).exposure == 1e4


def test_winds_blow_as_the_site_says_and_at_random_where_it_does_not():
    site = load_site("cerro_pachon")
    directions = (0.0, None, math.pi / 2, None, None, math.pi)
    windy = dataclasses.replace(site, wind_directions=directions)
    mixed = small_atmosphere(site=windy)
    random = small_atmosphere()
    for layer, direction in enumerate(directions):
        speed = site.wind_speeds[layer]
        if direction is None:
            np.testing.assert_array_equal(mixed.velocities[layer], random.velocities[layer])
        else:
            expected = speed * np.array([math.cos(direction), math.sin(direction)])
            np.testing.assert_allclose(mixed.velocities[layer], expected, atol=1e-12)
    # Another exposure turns the random winds only; layers of one's own have none of the site's.
    later = small_atmosphere(site=windy, epoch=1)
    np.testing.assert_allclose(later.velocities[[0, 2, 5]], mixed.velocities[[0, 2, 5]])
    assert not np.allclose(later.velocities[[1, 3, 4]], mixed.velocities[[1, 3, 4]])
    own = small_atmosphere(site=windy, altitudes=np.arange(6) * 1e3)
    np.testing.assert_array_equal(own.velocities, random.velocities)


def test_screens_that_do_not_fit_in_memory_are_refused(monkeypatch):
    atmosphere = small_atmosphere()
    kept = 6 * 512 * 512 * 4
    needed = atmosphere.screen_bytes(["low"])
    # The modes of a screen and their columns come on top of what is kept.
    assert kept < needed < 1.5 * kept
    assert atmosphere.screen_bytes(["low", "high"]) > 2 * kept
    monkeypatch.setattr(memory, "available_bytes", lambda: needed)
    atmosphere.screens("low")
    atmosphere.release()
    monkeypatch.setattr(memory, "available_bytes", lambda: 5_000_000)
    with pytest.raises(DomainError, match=r"screen_size = 512 in 6 layers: needs about .* of memory, 5.0 MB are free"):
        atmosphere.screens("low")
    monkeypatch.setattr(memory, "available_bytes", lambda: None)
    atmosphere.screens("low")


def test_quantities_and_sites_are_accepted():
    site = load_site("cerro_pachon")
    atmosphere = Atmosphere.from_site(site, 2, r0=16.0 * u.cm, outer_scale=0.025 * u.km, exposure=2.0)
    assert atmosphere.r0 == pytest.approx(0.16)
    assert atmosphere.outer_scale == pytest.approx(25.0)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"r0": 0.0}, "r0 = 0.0: expected a positive"),
        ({"r0": -0.1}, "r0 = -0.1"),
        ({"outer_scale": 0.0}, "outer_scale = 0.0"),
        ({"exposure": 0.0}, "exposure = 0.0"),
        ({"exposure": math.inf}, "exposure = inf"),
        ({"time_step": -1.0}, "time_step = -1.0"),
        ({"screen_size": 0}, "screen_size = 0: expected a whole number of samples from 4"),
        ({"time_step": 1e-12}, "time_step = 1e-12: expected at most 10000000 steps in 2 s"),
        ({"r0": [0.1, 0.2]}, "r0 = array([0.1, 0.2])"),
        ({"screen_size": 10**6}, "screen_size = 1000000"),
        ({"screen_size": 512.5}, "screen_size = 512.5"),
        ({"fine_size": "many"}, "fine_size = 'many'"),
        ({"screen_length": 0.0}, "screen_length = 0.0"),
        ({"fine_pixel": 0.0}, "fine_pixel = 0.0"),
        ({"cutoff": 0.0}, "cutoff = 0.0: expected a positive"),
        ({"cutoff": 30.0}, "cutoff = 30 rad/m: expected between the lowest mode and the Nyquist limit of the low"),
        ({"cutoff": 0.07}, "cutoff = 0.07 rad/m"),
        ({"cutoff": 0.3}, "Nyquist limit of the high screens, 0.6136 to 157.1 rad/m"),
        ({"ground_lift": -1.0}, "ground_lift = -1.0"),
        ({"zenith_angle": 1.5}, "zenith_angle = 1.5: expected 0 to 1.3963 rad"),
        ({"seed": -1}, "seed = -1"),
        ({"seed": 1.5}, "seed = 1.5"),
        ({"epoch": -1}, "epoch = -1"),
    ],
)
def test_bad_arguments_are_named(options, text):
    with pytest.raises(DomainError, match=re.escape(text)):
        small_atmosphere(**options)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        # The fastest layer of the site, 20 m/s, comes round after 4.096 s.
        ({"exposure": 4.1}, "screen_length = 81.92: expected more than 82 m, which layer 5 at 15460 m drifts in 4.1 s"),
        ({"wind_speeds": [50.0, 0.0, 0.0, 0.0, 0.0, 0.0]}, "expected more than 100 m, which layer 0 at 0 m drifts"),
    ],
)
def test_screens_that_come_round_are_refused_where_they_are_made(options, text):
    atmosphere = small_atmosphere(**options)
    with pytest.raises(DomainError, match=re.escape(text)):
        atmosphere.screens("low")


@pytest.mark.parametrize(
    ("layers", "text"),
    [
        ({"weights": [1.0, 2.0]}, "expected an altitude, weight and wind for each"),
        ({"weights": [0.0] * 6}, "weights = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0): expected fractions from 0 that sum to 1"),
        ({"weights": [2.0, -1.0, 0.0, 0.0, 0.0, 0.0]}, "weights = (2.0, -1.0, 0.0, 0.0, 0.0, 0.0): expected fractions"),
        ({"weights": [0.5, 0.1, 0.1, 0.1, 0.1, 0.106]}, "sum to 1, not 1.006"),
        ({"weights": [math.nan] * 6}, "weights = (nan"),
        ({"wind_speeds": [math.nan] * 6}, "wind_speeds = (nan"),
        ({"altitudes": [5e3, 0.0, 1e3, 2e3, 3e3, 4e3]}, "altitudes = (5000.0, 0.0"),
    ],
)
def test_bad_layers_of_a_site_are_named(layers, text):
    with pytest.raises(PrescriptionError, match=re.escape(text)):
        small_atmosphere(**layers)


@pytest.mark.parametrize(
    ("name", "replacement"),
    [(f.name, f"screens=ScreenSampling({f.name}=...)") for f in dataclasses.fields(ScreenSampling)]
    + [(name, f"site=load_site(...).with_layers({name}=...)") for name in LAYERS],
)
def test_arguments_of_earlier_versions_name_their_place(name, replacement):
    with pytest.raises(ConfigError) as caught:
        Atmosphere.from_site("cerro_pachon", 1, **{name: 1})
    assert str(caught.value) == f"{name}: no argument of Atmosphere.from_site; expected {replacement}"


def test_bad_layers_scales_and_sites_are_named():
    atmosphere = small_atmosphere()
    with pytest.raises(DomainError, match="layer = 6: expected 0 to 5"):
        atmosphere.low_screen(6)
    with pytest.raises(UnknownNameError, match="unknown scale 'lo': did you mean low"):
        atmosphere.path(0.0, 0.0, 0, scale="lo")
    with pytest.raises(UnknownNameError, match="unknown stencil"):
        atmosphere.high_screen(0, "cubic")
    with pytest.raises(UnknownNameError):
        Atmosphere.from_site("cerro_pacho", 2)


@pytest.mark.slow
def test_full_size_screens_follow_theory():
    """The default grids, 8192 x 8192 over 1.3 km and 3072 x 3072 over 43 m, without noise."""
    atmosphere = Atmosphere.from_site("cerro_pachon", 2, screens=ScreenSampling(fixed_modulus=True))
    low, high = atmosphere.low_screen(0, "samples"), atmosphere.high_screen(0, "samples")
    # Two coarse pixels, 0.3174 m, and more: there the fine screens no longer change from one sample to the next.
    for lag in (2, 4, 16, 63, 157):
        b = lag * atmosphere.screen_pixel
        coarse = np.mean((np.roll(low, -lag, axis=1) - low) ** 2, dtype=np.float64)
        fine = np.mean((np.roll(high, -round(b / atmosphere.fine_pixel), axis=1) - high) ** 2, dtype=np.float64)
        ratio = (coarse + fine) / (atmosphere.weights[0] * structure_function(b, 0.16, 25.0))
        assert ratio == pytest.approx(1.0, abs=0.01)
