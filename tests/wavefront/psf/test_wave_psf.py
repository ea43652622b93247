"""The wave engine against plain sums over the pupil, closed forms, and the spot diagram."""

import itertools
import math

import numpy as np
import pytest

import pachon
from pachon.core import memory
from pachon.core.errors import DomainError
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.screen_sampling import ScreenSampling
from pachon.wavefront.atmosphere.turbulence import diffraction_otf
from pachon.wavefront.psf.engine import PsfInputs
from pachon.wavefront.psf.image_plane import ImagePlane
from pachon.wavefront.psf.wave import WaveEngine
from pachon.wavefront.pupil_optics import trace_pupils

FOCAL_LENGTH = 10.31
PLANE = ImagePlane(31, 10e-6, 4e-6)
ONE_WAVE = np.array([620e-9])
STILL = np.zeros((1, 2))
STAR = np.zeros((1, 2)), np.zeros((1, 2))


def small_atmosphere(seed=4, exposure=0.2, fine_pixel=0.02):
    screens = ScreenSampling(256, 40.96, 512, fine_pixel)
    return Atmosphere.from_site("cerro_pachon", seed, exposure=exposure, screens=screens)


@pytest.mark.long
@pytest.mark.parametrize(("fine_pixel", "allowed"), [(None, 2e-6), (0.02, 1e-4), (0.0173, 1e-4)])
def test_against_a_plain_sum_over_the_pupil(polynomial_pupil, fine_pixel, allowed):
    """Sign and scale: |sum A exp(i k (w + psi - X.J^-T p))|^2, averaged over time and, by Gauss's rule, pixels."""
    jacobian = np.array([[10.3, 0.6], [-0.2, 10.6]])
    pupil = polynomial_pupil(
        defocus=0.3e-6,
        coma=0.5e-6,
        tilt=(2e-7, -3e-7),
        cut=(0.6, -0.1),
        jacobian=jacobian,
        diameter=2.0,
        obscuration=0.4,
    )
    plane = ImagePlane(9, 5e-6, 0.0)
    wavelengths = np.array([500e-9, 650e-9])
    dispersion = np.array([[2e-7, 1e-7], [-3e-7, 4e-7]])
    spacing = 0.05
    atmosphere = None if fine_pixel is None else small_atmosphere(exposure=0.1, fine_pixel=fine_pixel)
    inputs = pupil.inputs(wavelengths, plane, dispersion=dispersion, atmosphere=atmosphere)
    engine = WaveEngine(pupil_spacing=spacing, padding=True).renderer(inputs)
    field, offset = np.array([0.02, -0.01]), np.array([[0.3, -0.2]])
    image = engine.render(field[None], offset).image[0]

    focal = math.sqrt(np.linalg.det(jacobian))
    line = spacing * (np.arange(-30, 30) + 0.5)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    optics = pupil.trace(None, np.zeros((1, 2)), wavelengths, points)
    paths = np.zeros((1, len(points)))
    if atmosphere is not None:
        paths = np.zeros((len(atmosphere.times), len(points)))
        for layer, scale in itertools.product(range(6), ("low", "high")):
            places = [
                atmosphere.screen_coordinates(*points.T, layer, field=tuple(np.tan(field)), time=float(time))
                for time in atmosphere.times
            ]
            paths += atmosphere.path(*np.moveaxis(places, 1, 0), layer, scale=scale)
    # direction cosines of the light at the focus
    cosines = points @ np.linalg.inv(jacobian)
    node, weight = np.polynomial.legendre.leggauss(8)
    expected = np.zeros((9, 9))
    for wave, wavelength in enumerate(wavelengths):
        k = 2 * np.pi / wavelength
        lit = optics.lit[0, wave]
        shift = jacobian @ dispersion[wave] + offset[0] * 5e-6
        x, y = ((plane.pixel_centers[:, None] + 2.5e-6 * node).ravel() - s for s in shift)
        to_x = np.exp(-1j * k * np.outer(x, cosines[lit, 0]))
        to_y = np.exp(-1j * k * np.outer(y, cosines[lit, 1]))
        for path in paths:
            wavefront = np.exp(1j * k * (optics.path[0, wave, lit] + path[lit]))
            square = np.abs((to_y * wavefront) @ to_x.T) ** 2
            mean = np.einsum("iajb,a,b->ij", square.reshape(9, 8, 9, 8), weight / 2, weight / 2)
            expected += mean * (plane.pixel_size * spacing / (wavelength * focal)) ** 2 / len(paths)
    expected /= optics.lit.sum()
    # Single precision of the phase and of the transform; paths of 10 waves leave 1e-5 of a radian in every screen.
    np.testing.assert_allclose(image, expected, atol=allowed * expected.max())


@pytest.mark.long
def test_perfect_optics_have_the_transfer_function_of_the_annulus(polynomial_pupil):
    telescope = polynomial_pupil()
    engine = WaveEngine(pupil_spacing=0.02).renderer(telescope.inputs(ONE_WAVE, PLANE, threads=1))
    stars = engine.render(*STAR)
    step = 0.02
    b = step * np.arange(-430, 431)
    k = 2 * np.pi * b / (620e-9 * FOCAL_LENGTH)
    spectrum = diffraction_otf(np.hypot(b, b[:, None]), 8.36, 0.612) * PLANE.transfer(k, k[:, None])
    to_pixels = np.exp(1j * np.outer(PLANE.pixel_centers, k))
    expected = (to_pixels @ spectrum @ to_pixels.T).real * (PLANE.pixel_size * step / (620e-9 * FOCAL_LENGTH)) ** 2
    # The rim of the pupil is cut along grid cells: 2 cm of 836, over some 2000 cells of random error.
    np.testing.assert_allclose(stars.image[0], expected, atol=5e-4 * expected.max())
    assert stars.lit_fraction[0, 0] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("tilt", [(3e-6, 0.0), pytest.param((0.0, -2e-6), marks=pytest.mark.slow)])
def test_tilt_dispersion_and_offset_move_the_image(polynomial_pupil, tilt):
    """By exactly the Jacobian times the angle, whatever the wavelength: the image is the unmoved one, elsewhere."""
    jacobian = np.array([[10.3, 0.5], [-0.4, 10.6]])
    dispersion = np.array([[1e-6, -2e-6]])
    offset = np.array([[0.25, -0.4]])
    shift = offset + (jacobian @ (np.array(tilt) + dispersion[0]))[None] / 10e-6
    for wavelength in (500e-9, 600e-9, 700e-9):
        wave = np.array([wavelength])
        engine = WaveEngine(pupil_spacing=0.015, padding=False)
        moved = engine.renderer(
            polynomial_pupil(tilt=tilt, jacobian=jacobian).inputs(wave, PLANE, dispersion=dispersion)
        )
        image = moved.render(np.zeros((1, 2)), offset).image
        plain = engine.renderer(polynomial_pupil(jacobian=jacobian).inputs(wave, PLANE))
        expected = plain.render(np.zeros((1, 2)), shift).image
        np.testing.assert_allclose(image, expected, atol=1e-6 * expected.max())


def test_layers_bend_light_by_their_gradient_where_it_crosses_them(polynomial_pupil, single_modes):
    jacobian = np.array([[10.3, 0.5], [-0.4, 10.6]])
    telescope = polynomial_pupil(jacobian=jacobian)
    engine = WaveEngine(pupil_spacing=0.04).renderer(
        telescope.inputs(ONE_WAVE, PLANE, atmosphere=single_modes, threads=1)
    )
    still = WaveEngine(pupil_spacing=0.04, padding=False).renderer(telescope.inputs(ONE_WAVE, PLANE, threads=1))
    line = np.arange(-4.18, 4.18, 0.2)
    pupil = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    radius = np.hypot(*pupil.T)
    pupil = pupil[(radius < 4.18) & (radius > 0.612 * 4.18)]
    for field in np.array([[0.03, 0.0], [-0.02, -0.03]]):
        image = engine.render(field[None], np.zeros((1, 2))).image
        bend = np.zeros(2)
        for time in single_modes.times:
            for layer in (0, 1):
                place = pupil - single_modes.altitudes[layer] * np.tan(field)
                place = place - single_modes.velocities[layer] * time + single_modes.offsets[layer]
                bend += np.mean([single_modes.slope(layer, *at) for at in place], axis=0) / len(single_modes.times)
        expected = still.render(field[None], (jacobian @ bend)[None] / 10e-6).image
        # The slopes spread by up to 3 % of 1.5 pixels over pupil and time, which blurs the image a little.
        np.testing.assert_allclose(image, expected, atol=5e-3 * expected.max())


@pytest.mark.long
def test_padding_changes_nothing_that_the_detector_sees(polynomial_pupil):
    inputs = polynomial_pupil(defocus=0.5e-6).inputs(ONE_WAVE, PLANE, atmosphere=small_atmosphere(), threads=1)
    images = [WaveEngine(padding=padding).renderer(inputs).render(*STAR).image for padding in (False, True)]
    # exp(-17) is left of a baseline of 1.5 m by charge diffusion; single precision is more.
    np.testing.assert_allclose(images[0], images[1], atol=3e-6 * images[1].max())


@pytest.mark.long
def test_a_grid_is_as_wide_as_the_diffusion_demands(polynomial_pupil):
    """Less diffusion: baselines beyond 1.5 m count, those of the whole diameter do not."""
    plane = ImagePlane(31, 10e-6, 2.2e-6)
    inputs = polynomial_pupil(defocus=0.5e-6).inputs(ONE_WAVE, plane, atmosphere=small_atmosphere())
    narrow, chosen, padded = (WaveEngine(padding=padding).renderer(inputs) for padding in (False, None, True))
    assert narrow._size < chosen._size < 0.75 * padded._size
    images = [engine.render(*STAR).image for engine in (narrow, chosen, padded)]
    errors = [np.abs(image - images[2]).max() / images[2].max() for image in images[:2]]
    assert errors[1] < 3e-6 < errors[0]


@pytest.mark.long
def test_grid_is_padded_where_it_must_be(polynomial_pupil):
    """All baselines are kept without an atmosphere, and where charge diffusion leaves some of the long ones."""
    sharp, pupil = ImagePlane(31, 10e-6, 0.5e-6), polynomial_pupil(diameter=3.0)
    for plane, atmosphere, padded in (
        (PLANE, small_atmosphere(), False),
        (PLANE, None, True),
        (sharp, small_atmosphere(), True),
    ):

        def image(**padding):
            inputs = pupil.inputs(ONE_WAVE, plane, atmosphere=atmosphere)  # noqa: B023
            return WaveEngine(**padding).renderer(inputs).render(*STAR).image

        chosen = image()
        np.testing.assert_array_equal(chosen, image(padding=padded))
        assert not np.array_equal(chosen, image(padding=not padded))


@pytest.mark.parametrize("field_deg", [(0.0, 0.0), (0.6, 1.1)])
def test_image_points_the_way_of_the_spot_diagram(lsst_r, field_deg):
    """A defocused, decentred camera: centroid, ellipticity and skewness of the image are those of the rays."""
    telescope = lsst_r.perturbed("Camera", shift=(3e-3, 1.5e-3, 30e-6))
    field = np.radians([field_deg])
    wave = np.array([lsst_r.default_wavelength])
    plane = ImagePlane(61, 3e-6, 1e-6)
    engine = WaveEngine().renderer(PsfInputs(telescope, wave, plane, threads=1))
    image = engine.render(field, np.zeros((1, 2))).image[0]
    x, y = np.meshgrid(plane.pixel_centers, plane.pixel_centers)

    line = np.arange(-4.18, 4.18, 0.05)
    pupil = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    optics = trace_pupils(telescope, field, wave, pupil)
    spots = optics.displacement[0, 0][optics.lit[0, 0]].astype(float)

    def moments(weights, x, y):
        weights = weights / weights.sum()
        center = np.array([(weights * x).sum(), (weights * y).sum()])
        dx, dy = x - center[0], y - center[1]
        second = np.array([(weights * dx * dx).sum(), (weights * dx * dy).sum(), (weights * dy * dy).sum()])
        radius = dx * dx + dy * dy
        return center, second, np.array([(weights * radius * dx).sum(), (weights * radius * dy).sum()])

    # Diffraction throws light far out, which has infinite second moments: count that within 75 um, some of it still.
    near = np.hypot(x, y) < 75e-6
    center, second, third = moments(image * near, x, y)
    ray_center, ray_second, ray_third = moments(np.ones(len(spots)), *spots.T)
    assert np.hypot(*spots.T).max() < 70e-6
    size = math.sqrt(ray_second[0] + ray_second[2])
    np.testing.assert_allclose(center, ray_center, atol=0.03 * size)
    np.testing.assert_allclose(second, ray_second, atol=0.12 * size**2)
    assert np.hypot(*ray_third) > 0.1 * size**3
    np.testing.assert_allclose(third, ray_third, atol=0.35 * np.hypot(*ray_third))


@pytest.mark.long
def test_bytes_do_not_depend_on_threads_batches_or_company(lsst_r):
    atmosphere = small_atmosphere(exposure=0.1)
    fields = np.array([[0.0, 0.0], [0.01, 0.02], [-0.02, 0.005]])
    offsets = np.array([[0.0, 0.0], [0.3, -0.2], [0.1, 0.4]])
    wavelengths = np.array([550e-9, 690e-9])

    def images(select, threads):
        engine = WaveEngine().renderer(
            PsfInputs(lsst_r, wavelengths, PLANE, dispersion=np.zeros((2, 2)), atmosphere=atmosphere, threads=threads)
        )
        return engine.render(fields[select], offsets[select]).image

    everything = images(slice(None), 1)
    np.testing.assert_array_equal(images(slice(None), 3), everything)
    np.testing.assert_array_equal(images(slice(1, 2), 2), everything[1:2])


@pytest.mark.long
def test_heights_of_the_ccds_defocus_the_image(lsst_r):
    """A flat CCD plane gives the image of no CCDs at all; that of a height budget does not."""
    # A small stamp needs few points of the pupil.
    field, stamp = np.radians([[0.02, 0.03]]), ImagePlane(15, 10e-6, 4e-6)
    options = {"dispersion": STILL, "threads": 1}
    image = {
        name: WaveEngine()
        .renderer(PsfInputs(lsst_r, ONE_WAVE, stamp, focal_plane=plane, **options))
        .render(field, np.zeros((1, 2)))
        .image[0]
        for name, plane in (
            ("none", None),
            ("flat", pachon.FocalPlane.flat("lsst")),
            ("bumpy", pachon.FocalPlane.from_budget("lsst", seed=1)),
        )
    }
    # Where the chief ray lands is found to 1e-14 m, on another way: far below single precision.
    np.testing.assert_allclose(image["flat"], image["none"], atol=1e-6)
    assert np.abs(image["bumpy"] - image["none"]).max() > 1e-3


@pytest.mark.parametrize("spacing", [0.0, np.nan])
def test_refuses_bad_spacing(spacing):
    with pytest.raises(DomainError, match="pupil_spacing"):
        WaveEngine(pupil_spacing=spacing)


def test_large_stamps_in_parts(polynomial_pupil, monkeypatch):
    """Pixels take turns, so that stamps of hundreds of pixels do not take tens of gigabytes for themselves."""
    inputs = polynomial_pupil(diameter=2.0, coma=0.5e-6).inputs(ONE_WAVE, PLANE)
    whole = WaveEngine().renderer(inputs).render(*STAR).image
    monkeypatch.setattr("pachon.wavefront.psf.wave._PAIRS", 2**10)
    np.testing.assert_allclose(WaveEngine().renderer(inputs).render(*STAR).image, whole, rtol=0, atol=1e-12)


def test_a_grid_larger_than_memory(polynomial_pupil, monkeypatch):
    inputs = polynomial_pupil(diameter=2.0).inputs(ONE_WAVE, PLANE)
    monkeypatch.setattr(memory, "available_bytes", lambda: 10**9)
    WaveEngine().renderer(inputs)
    with pytest.raises(DomainError, match=r"points across the wave engine.s grid, 0.0001 m apart: needs about .* GB"):
        WaveEngine(pupil_spacing=1e-4).renderer(inputs)
