"""The model of a donut: against brute force, and its derivatives against central differences."""

from dataclasses import replace

import numpy as np
import pytest
from donut_images import PIXEL, SIZE, WAVELENGTH, donut
from scipy.optimize import brentq
from scipy.special import gamma, j0, kv

import pachon
from pachon.models.aperture import Complement, Union
from pachon.raytrace.rays import field_direction
from pachon.sensing.degrees import FreedomRays
from pachon.sensing.donut_rays import ZernikeRays
from pachon.sensing.image_model import STRENGTH, ImageGrid, LandedLight
from pachon.sensing.likelihood import Stamp, model_image, normal_equations
from pachon.sensing.pixel_kernel import PixelKernel, SharpCore
from pachon.sensing.pupil_cells import lit_lattice, pupil_cells
from pachon.sensing.seeing import Seeing
from pachon.sensing.solve import Group, after_step, solve
from pachon.sensing.stamps import Pixels
from pachon.wavefront.atmosphere.turbulence import long_exposure_fwhm
from pachon.wavefront.chief_rays import image_jacobians
from pachon.wavefront.psf.pupil_rims import pupil_rims

NOLL = np.arange(4, 12)
FIELD = np.deg2rad([1.2, 0.4])


def stamp_of(
    tel, across, *, blur=0.0, size=SIZE, outer_scale=25.0, image=None, reach=0.0, side=1, rims=None, sharp=False
):
    direction = field_direction(*FIELD)
    cells = pupil_cells(tel, direction, WAVELENGTH, across)
    rays = ZernikeRays(tel, direction, np.array([WAVELENGTH]), np.ones(1), cells, NOLL)
    jacobian = image_jacobians(tel, direction[None], WAVELENGTH)[0]
    seeing = Seeing(WAVELENGTH, outer_scale)
    image = np.zeros((size, size)) if image is None else image
    pixels = Pixels(image, np.full(image.shape, 500.0), np.ones(image.shape, dtype=bool)).binned(side)
    grid = ImageGrid(pixels, PIXEL, seeing, jacobian, blur, rays.footprint, sharp, reach, rims)
    return Stamp(pixels.image, pixels.variance, pixels.used, grid, rays)


@pytest.mark.parametrize(("across", "width"), [(43, 0.019), (49, 0.019), (61, 0.019), (61, 0.005)])
def test_cells_lose_the_light_of_vanes_that_are_narrower_than_they_are(across, width):
    """DECam's of 19 mm lie between the points of a lattice: 4e-3 of the light, and 23 nm of wavefront."""
    decam, direction = pachon.load_telescope("decam"), field_direction(*np.deg2rad((0.5, 0.4)))
    spider = next(s for s in decam.surfaces if s.name == "SPIDER")
    vanes = tuple(replace(vane, width=width) for vane in spider.aperture.part.parts)
    narrow = replace(spider, aperture=Complement(Union(vanes)))
    telescope = replace(decam, surfaces=tuple(narrow if s is spider else s for s in decam.surfaces))
    coarse, fine = (pupil_cells(telescope, direction, WAVELENGTH, n) for n in (across, 100))
    assert coarse.area * coarse.side**2 == pytest.approx(fine.area * fine.side**2, rel=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [0.0, 200e-9])
def test_image_is_that_of_brute_force(behind_focus, amplitude):
    wave = amplitude * np.array([1.0, -0.5, 0.7, 0.4, -0.6, 0.3, 0.2, -0.3])
    expected = donut(
        behind_focus, FIELD, zernikes=[0.0, 0.0, 0.0, *wave], blur=1.3, shift=(0.3, -0.2), flux=1.0, rays=1200
    )
    stamp = stamp_of(behind_focus, 60, blur=1.3 * PIXEL)
    model = model_image(stamp, np.array([1.0, 0.3, -0.2, *[0.0] * 4]), wave)
    # Bins of a quarter pixel, and one ray more or less in those on the rims.
    np.testing.assert_allclose(model, expected, atol=5e-3 * expected.max())
    assert model.sum() == pytest.approx(expected.sum(), abs=1e-4)


@pytest.mark.long
def test_coarse_cells_give_the_image_of_fine_ones(behind_focus):
    wave = 200e-9 * np.array([1.0, -0.5, 0.7, 0.4, -0.6, 0.3, 0.2, -0.3])
    star = np.array([1.0, 0.3, -0.2, 0.0, 10.0, 0.0, 0.0])
    coarse, fine = (model_image(stamp_of(behind_focus, n), star, wave) for n in (60, 150))
    # Third moments of cells of a pixel on the rims.
    np.testing.assert_allclose(coarse, fine, atol=6e-3 * fine.max())


@pytest.mark.parametrize("side", [2, 3])
@pytest.mark.parametrize("companion", [(), (0.3, 12.0, -7.5)])
def test_summed_pixels_have_the_model_of_the_sums(behind_focus, side, companion):
    """The unknowns stay those of the detector's pixels, also where pixels are left over at the end."""
    star, wave = np.array([1e6, 1.2, -0.7, 3.0, 5.0, 0.1, -0.2, *companion]), 60e-9 * np.cos(np.arange(len(NOLL)))
    # FWHM of two sums, as the fit has it.
    blur = 0.85 * side * PIXEL
    single, summed = (
        model_image(stamp_of(behind_focus, 60, side=k, blur=blur, reach=60 * PIXEL), star, wave) for k in (1, side)
    )
    n = SIZE // side
    expected = single[: n * side, : n * side].reshape(n, side, n, side).sum(axis=(1, 3))
    # The spline of the coarser grid leaves 1e-3 beyond its Nyquist frequency.
    np.testing.assert_allclose(summed, expected, atol=2e-3 * expected.max())


@pytest.mark.long
@pytest.mark.parametrize(
    ("companion", "diffracted"),
    [((), False), ((0.3, 12.0, -7.5), False), ((0.3, 12.0, -7.5, 0.1, -20.0, 3.0), False), ((), True)],
    ids=["one", "two", "three", "diffracted"],
)
def test_derivatives_are_central_differences(behind_focus, companion, diffracted):
    rims = pupil_rims(behind_focus, field_direction(*FIELD), WAVELENGTH) if diffracted else None
    stamp = stamp_of(behind_focus, 80, reach=60 * PIXEL if companion else 0.0, rims=rims)
    star, wave = np.array([1e6, 1.2, -0.7, 3.0, 9.0, 0.1, -0.2, *companion]), 60e-9 * np.cos(np.arange(len(NOLL)))
    joined = np.concatenate([star, wave])
    steps = np.concatenate(
        [[1e3, 3e-2, 3e-2, 1.0, 0.05, 0.1, 0.1], np.full(len(companion), 0.02), np.full(len(NOLL), 5e-9)]
    )
    landing, response = stamp.rays.landing(wave), stamp.rays.response(wave)
    at_rims = stamp.rays.at_rims(rims, landing, response) if diffracted else None
    light = LandedLight(landing, stamp.rays.weights(wave), stamp.rays.spread(landing), at_rims)
    image, columns, scales = stamp.grid.derivatives(star, light, response, stamp.rays.rates)
    np.testing.assert_allclose(image, model_image(stamp, star, wave), atol=1e-6 * image.max())
    for k, step in enumerate(steps):
        ends = []
        for sign in (1.0, -1.0):
            moved = joined.copy()
            moved[k] += sign * step
            ends.append(model_image(stamp, moved[: len(star)], moved[len(star) :]))
        expected = (ends[0] - ends[1]) / (2.0 * step)
        # The spread of the cells moves with the wavefront too, and so do the widths of the strips along the rims: the
        # columns leave that out. Without derivatives of the rims' places, those of a diffracted image are 18 % off.
        bound = 3e-2 if diffracted else 2e-2
        assert np.linalg.norm(columns[..., k] * scales[k] - expected) < bound * np.linalg.norm(expected)


@pytest.mark.long
@pytest.mark.parametrize(
    ("strength", "blur", "companion"),
    [(0.0, 0.0, ()), pytest.param(1.0, 0.0, (), marks=pytest.mark.slow), (2.5, 0.4, (0.3, 12.0, -7.5))],
)
def test_derivatives_of_sharp_images_are_central_differences(behind_focus, strength, blur, companion):
    stamp = stamp_of(behind_focus, 120, blur=blur * PIXEL, reach=60 * PIXEL, sharp=True)
    star, wave = np.array([1e6, 1.2, -0.7, 3.0, strength, 0.1, -0.2, *companion]), 60e-9 * np.cos(np.arange(len(NOLL)))
    joined = np.concatenate([star, wave])
    steps = np.concatenate(
        [[1e3, 3e-2, 3e-2, 1.0, 0.05, 0.1, 0.1], np.full(len(companion), 0.02), np.full(len(NOLL), 2e-8)]
    )
    landing, response = stamp.rays.landing(wave), stamp.rays.response(wave)
    light = LandedLight(landing, stamp.rays.weights(wave), stamp.rays.spread(landing))
    image, columns, scales = stamp.grid.derivatives(star, light, response, stamp.rays.rates)
    np.testing.assert_allclose(image, model_image(stamp, star, wave), atol=1e-6 * image.max())
    # All light is on the stamp, but for the air's wings.
    assert (image - 3.0).sum() == pytest.approx(1e6 * (1.3 if companion else 1.0), rel=2e-3)
    # Of the wavefront every third term: all go the same way.
    for k in (*range(len(star)), *range(len(star), len(steps), 3)):
        if k == STRENGTH and strength == 0.0:
            continue
        step = steps[k]
        ends = [
            model_image(stamp, *np.split(joined + sign * step * np.eye(len(joined))[k], [len(star)]))
            for sign in (1.0, -1.0)
        ]
        expected = (ends[0] - ends[1]) / (2.0 * step)
        # Kernels without air have corners, that of pixels and cells, over which differences are means.
        assert np.linalg.norm(columns[..., k] * scales[k] - expected) < 0.06 * np.linalg.norm(expected)


@pytest.mark.parametrize("strength", [0.0, 0.6, 2.5])
def test_sharp_images_summed_in_pairs_are_those_of_summed_pixels(behind_focus, strength):
    """The core and the smooth rest of the air add up: images of one grid are those of another."""
    star, wave = np.array([1e6, 1.2, -0.7, 0.0, strength, 0.0, 0.0]), 60e-9 * np.cos(np.arange(len(NOLL)))
    stamp = stamp_of(behind_focus, 180, size=90, sharp=True)
    single = model_image(stamp, star, wave)
    pixels = Pixels(np.zeros((90, 90)), np.full((90, 90), 500.0), np.ones((90, 90), dtype=bool)).binned(2)
    jacobian = image_jacobians(behind_focus, field_direction(*FIELD)[None], WAVELENGTH)[0]
    grid = ImageGrid(pixels, PIXEL, Seeing(WAVELENGTH, 25.0), jacobian, 0.0, stamp.rays.footprint, sharp=True)
    summed = model_image(replace(stamp, grid=grid, image=pixels.image), star, wave)
    expected = single.reshape(45, 2, 45, 2).sum(axis=(1, 3))
    np.testing.assert_allclose(summed, expected, atol=5e-3 * expected.max())


@pytest.mark.parametrize(("cell", "rms"), [(0.6, 0.0), (0.3, 0.4)])
def test_kernels_of_pixels_have_the_moments_of_evenly_lit_cells(cell, rms):
    """Sum, mean and variance of a cell, a pixel and a blur, from many places of the cell in a pixel."""
    places = 5.0 + (np.arange(200) + 0.5) / 200
    values, first = PixelKernel(cell, 1.0, rms).taps(places)
    away = first + np.arange(len(values[0]))[:, None] - places
    np.testing.assert_allclose(values[0].sum(axis=0), 1.0, atol=2e-4)
    assert (values[0] * away).sum(axis=0).mean() == pytest.approx(0.0, abs=1e-4)
    variance = (values[0] * away**2).sum(axis=0).mean()
    assert variance == pytest.approx(cell**2 / 12.0 + 1.0 / 12.0 + rms**2, abs=1e-3)


def test_evenly_spaced_cells_light_pixels_evenly():
    """A few per cent nearer to each other than the kernels have it, too: 3 % of light by single boxes."""
    places = 20.0 + 0.52 * np.arange(100)
    values, first = PixelKernel(0.5, 1.0, 0.0).taps(places)
    pixels = np.zeros(100)
    np.add.at(pixels, first + np.arange(len(values[0]))[:, None], values[0])
    np.testing.assert_allclose(pixels[25:65] * 0.52, 1.0, atol=2e-3)


def test_deposits_are_sums_over_points():
    """Oracle: the sums restated, of points on a grid, at its edge and far beside it."""
    rng = np.random.default_rng(4)
    (ny, nx), count, pad = (12, 15), 60, 20
    places = rng.uniform(-9.0, 9.0, (count, 2))
    spread = 0.02 * rng.normal(size=(count, 2, 2))
    spread[:, 1, 0] = spread[:, 0, 1]
    weights, response, rates = rng.random(count), rng.normal(size=(2, count, 11)), rng.normal(size=(count, 3))
    scale, head = 2.5, 7
    kernel = PixelKernel(0.7, 1.0, 0.4)
    expected = np.zeros((ny + 2 * pad, nx + 2 * pad, head + 14))
    for (px, py), moments, w, r, rate in zip(places, spread, weights, response.swapaxes(0, 1), rates, strict=True):
        (x, first_x), (y, first_y) = (kernel.taps(np.array([p + 0.5 * (n - 1)])) for p, n in ((px, nx), (py, ny)))
        x, y = x[..., 0], y[..., 0]

        def image(i, j, x=x, y=y, moments=moments):
            value = np.outer(y[j] + 0.5 * moments[1, 1] * y[j + 2], x[i] + 0.5 * moments[0, 0] * x[i + 2])
            return (value + moments[0, 1] * np.outer(y[j + 1], x[i + 1]))[..., None]

        row, column = pad + first_y[0], pad + first_x[0]
        out = expected[row : row + len(y[0]), column : column + len(x[0])]
        out[..., :3] += w * np.concatenate([image(0, 0), image(1, 0), image(0, 1)], axis=-1)
        out[..., head : head + 11] += scale * w * (image(1, 0) * r[0] + image(0, 1) * r[1])
        out[..., head + 11 :] += image(0, 0) * rate
    far = np.array([[500.0, 0.0], [-1e7, 3.0]])
    places, spread, weights, rates = (np.concatenate([v, v[:2]]) for v in (places, spread, weights, rates))
    places[count:], response = far, np.concatenate([response, response[:, :2]], axis=1)
    core = SharpCore((ny, nx), 1.0, 0.4, np.diag([0.7, 0.7]))
    columns = core.deposit(places, spread, 0.0).derivatives(weights, response, rates, scale, head)
    expected = expected[pad:-pad, pad:-pad]
    # Single precision.
    np.testing.assert_allclose(columns.reshape(expected.shape), expected, atol=2e-6 * np.abs(expected).max())


@pytest.mark.parametrize(("before", "change"), [(10.0, 3.0), (1e-3, 1e3), (0.4, -0.1)])
def test_steps_of_the_strength_are_those_of_the_exponent(before, change):
    """Closed form: the exponent of the air's transfer goes as the power 5/3 of the strength."""
    joined, step = np.zeros(9), np.zeros(9)
    joined[STRENGTH], step[STRENGTH] = before, change
    exponent = before ** (5.0 / 3.0) + 5.0 / 3.0 * before ** (2.0 / 3.0) * change
    assert after_step(joined, step, [9])[STRENGTH] == pytest.approx(exponent**0.6)


def test_curvature_is_that_of_the_pixels_in_use(behind_focus):
    """Fits without clipped pixels share the derivatives of the fit before."""
    stamp = stamp_of(behind_focus, 30)
    star, wave = np.array([1e6, 0.0, 0.0, 0.0, 9.0, 0.0, 0.0]), np.zeros(len(NOLL))
    whole = normal_equations(stamp, star, wave)
    used = np.arange(SIZE)[:, None] % 2 == np.zeros(SIZE, dtype=int)
    half = normal_equations(replace(stamp, used=used), star, wave)
    other = normal_equations(replace(stamp, used=~used), star, wave)
    np.testing.assert_allclose(
        half.curvature + other.curvature, whole.curvature, rtol=1e-4, atol=1e-6 * whole.curvature.max()
    )
    np.testing.assert_array_equal(normal_equations(stamp, star, wave).curvature, whole.curvature)


@pytest.mark.long
def test_gradient_is_that_of_the_loss(behind_focus):
    star, wave = np.array([1e6, 0.2, 0.1, 3.0, 9.0, 0.1, 0.0]), np.zeros(len(NOLL))
    image = model_image(stamp_of(behind_focus, 40), np.array([1.1e6, 0.0, 0.0, 0.0, 9.5, 0.0, 0.0]), wave + 20e-9)
    stamp = stamp_of(behind_focus, 40, image=image)
    found = normal_equations(stamp, star, wave)
    for k, step in [(0, 1e3), (1, 1e-2), (3, 0.1), (4, 1e-2), (6, 1e-2)]:
        ends = [normal_equations(stamp, star + sign * step * np.eye(7)[k], wave).loss for sign in (1.0, -1.0)]
        assert found.gradient[k] == pytest.approx(-0.5 * (ends[0] - ends[1]) / (2.0 * step), rel=1e-3)


@pytest.mark.long
def test_gradient_by_degrees_of_freedom_has_that_of_the_rims(behind_focus):
    """The rims of the first normal equations move with the telescope already: without that, 5 % is missing."""
    freedoms = pachon.load_degrees_of_freedom("lsst").select(["M2_dx", "Camera_dz", "M1M3_B2"])
    direction = field_direction(*FIELD)
    stamp = stamp_of(behind_focus, 40, rims=pupil_rims(behind_focus, direction, WAVELENGTH))
    rays = FreedomRays(
        behind_focus, direction, np.array([WAVELENGTH]), np.ones(1), stamp.rays.cells, freedoms, stamp.rays.footprint
    )
    assert (rays.count, stamp.rays.count) == (3, len(NOLL))
    star, steps = np.array([1e6, 0.0, 0.0, 3.0, 5.0, 0.0, 0.0]), np.array([4.0, 0.4, 0.004])
    image = model_image(replace(stamp, rays=rays), star, 20.0 * steps)
    stamp = replace(stamp, rays=rays, image=image)
    gradient = normal_equations(stamp, star, np.zeros(3)).gradient[7:]
    for k, step in enumerate(steps):
        ends = [normal_equations(stamp, star, sign * step * np.eye(3)[k]).loss for sign in (1.0, -1.0)]
        assert gradient[k] == pytest.approx(-0.5 * (ends[0] - ends[1]) / (2.0 * step), rel=3e-2)


@pytest.mark.parametrize("outer_scale", [25.0, np.inf])
def test_seeing_has_the_width_of_the_long_exposure(outer_scale):
    seeing = Seeing(WAVELENGTH, outer_scale)
    # Kolmogorov's is von Karman's at an outer scale beyond all else, which goes as its power of -1/3.
    expected = long_exposure_fwhm(WAVELENGTH, 0.15, min(outer_scale, 1e9))
    assert float(seeing.fwhm(np.array(1.0 / 0.15))) == pytest.approx(expected, rel=2e-3)
    assert seeing.strength(expected) == pytest.approx(1.0 / 0.15, rel=2e-3)


@pytest.mark.parametrize(("wavelength", "r0"), [(971e-9, 0.15), (2.2e-6, 0.15), (2.2e-6, 0.4)])
def test_seeing_of_long_wavelengths(wavelength, r0):
    """The outer scale leaves a core without width in weak turbulence of the table: the y band ended in an error."""
    baseline, k = np.linspace(1e-6, 100.0, 20001), 2.0 * np.pi / wavelength
    x = 2.0 * np.pi * baseline / 25.0
    # Conan 2000: phase variance 0.0863 (L0/r0)^(5/3), and the transfer function less that of the core.
    constant = gamma(11.0 / 6.0) * gamma(5.0 / 6.0) / (2.0 * np.pi ** (8.0 / 3.0))
    constant *= (24.0 / 5.0 * gamma(6.0 / 5.0)) ** (5.0 / 6.0)
    variance = constant * (25.0 / r0) ** (5.0 / 3.0) * (500e-9 / wavelength) ** 2
    correlation = 2.0 ** (1.0 / 6.0) / gamma(5.0 / 6.0) * x ** (5.0 / 6.0) * kv(5.0 / 6.0, x)
    light = baseline * (np.exp(-variance * (1.0 - correlation)) - np.exp(-variance))
    half = brentq(lambda angle: light @ (j0(k * baseline * angle) - 0.5), 0.0, 2.0 * wavelength / r0)
    seeing = Seeing(wavelength, 25.0)
    # Between strengths of the table the width is good to 0.3 %.
    assert float(seeing.fwhm(np.array(1.0 / r0))) == pytest.approx(2.0 * half, rel=4e-3)
    assert seeing.strength(2.0 * half) == pytest.approx(1.0 / r0, rel=4e-3)


@pytest.mark.parametrize("strength", [4.0, 6.7, 12.0])
def test_errors_of_the_seeing_are_by_its_slope(strength):
    """By the ratio of width and strength they were 7 to 14 % too small: the outer scale makes the width steeper."""
    ends = [long_exposure_fwhm(WAVELENGTH, 1.0 / s, 25.0) for s in (0.99 * strength, 1.01 * strength)]
    expected = 0.3 * (ends[1] - ends[0]) / (0.02 * strength)
    found = Seeing(WAVELENGTH, 25.0).fwhm_error(np.array([strength, np.nan]), np.array([0.3, np.nan]))
    assert found[0] == pytest.approx(expected, rel=5e-3)
    assert np.isnan(found[1])
    # Where the seeing is given.
    assert Seeing(WAVELENGTH, 25.0).fwhm_error(np.array(0.0), np.array(0.0)) == 0.0


def test_cells_measure_areas_and_moments(focused):
    cells = pupil_cells(focused, field_direction(0.0, 0.0), WAVELENGTH, 24)
    radius, inner = 0.5 * focused.pupil_diameter, 0.5 * focused.pupil_diameter * focused.pupil_obscuration
    x, y = cells.points.T
    # Mean square radius of the annulus: of the centroids plus that within the cells.
    square = cells.weights @ (x**2 + y**2 + cells.moments[:, 0, 0] + cells.moments[:, 1, 1])
    assert square == pytest.approx(0.5 * (radius**2 + inner**2), rel=2e-4)
    assert abs(cells.weights @ x) < 1e-4
    assert abs(cells.weights @ y) < 1e-4


def test_fine_lattices_find_the_rims_of_coarse_ones():
    """Every point is as if it were traced: rings, a chord of light between them and a spot."""

    def lit(points):
        x, y = np.moveaxis(points, -1, 0)
        radius = np.hypot(x, y)
        return (radius < 0.93) & (radius > 0.55) & (y > -0.8) & (np.hypot(x - 0.7, y) > 0.04)

    along = np.linspace(-1.0, 1.0, 400)
    points = np.stack(np.meshgrid(along, along), axis=-1)
    np.testing.assert_array_equal(lit_lattice(lit, points), lit(points))


def test_a_search_neither_starts_nor_steps_where_light_has_no_direction(behind_focus):
    stamp = stamp_of(behind_focus, 30)
    maps, prior, star = np.eye(len(NOLL))[None], np.zeros(len(NOLL)), np.array([1e5, 0.0, 0.0, 0.0, 5.0, 0.0, 0.0])
    # 10 m of wavefront on a pupil of 4 m: slopes beyond a right angle.
    steep = np.full(len(NOLL), 10.0)
    assert np.isnan(model_image(stamp, star, steep)).all()
    solution = solve(Group((stamp,), maps, prior), [star], steep)
    assert not solution.converged
    assert solution.loss == np.inf
    np.testing.assert_array_equal(solution.shared, steep)
    # A spread of light so wide that nothing but such wavefronts explains it: the search stays where light lands.
    noise = np.random.default_rng(1).poisson(1e4, stamp.image.shape).astype(float)
    solution = solve(Group((replace(stamp, image=noise),), maps, prior), [star], np.zeros(len(NOLL)))
    assert np.isfinite(solution.loss)
