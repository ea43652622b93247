"""The wave engine against plain sums over the pupil, closed forms, and the spot diagram."""

import math

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.turbulence import diffraction_otf
from pachon.wavefront.psf.image_plane import ImagePlane
from pachon.wavefront.psf.wave import WavePsfEngine
from pachon.wavefront.pupil_optics import trace_pupils

FOCAL_LENGTH = 10.31
PLANE = ImagePlane(31, 10e-6, 4e-6)
ONE_WAVE = np.array([620e-9])
STILL = np.zeros((1, 2))
STAR = np.zeros((1, 2)), np.zeros((1, 2))


def small_atmosphere(seed=4, **options):
    small = {"exposure": 0.2, "screen_size": 256, "screen_length": 40.96, "fine_size": 512, "fine_pixel": 0.02}
    return Atmosphere.from_site("cerro_pachon", seed, **(small | options))


def test_against_a_plain_sum_over_the_pupil(polynomial_pupil):
    """Field, sign and scale: |sum A exp(i k (w - X.J^-T p))|^2, averaged over each pixel by Gauss's rule."""
    jacobian = np.array([[10.3, 0.6], [-0.2, 10.6]])
    telescope = polynomial_pupil(
        defocus=0.3e-6, coma=0.5e-6, tilt=(2e-7, -3e-7), cut=0.6, jacobian=jacobian, diameter=2.0, obscuration=0.4
    )
    plane = ImagePlane(9, 5e-6, 0.0)
    wavelengths = np.array([500e-9, 650e-9])
    dispersion = np.array([[2e-7, 1e-7], [-3e-7, 4e-7]])
    spacing = 0.05
    engine = WavePsfEngine(
        telescope, wavelengths, plane, dispersion=dispersion, pupil_spacing=spacing, padding=True, threads=1
    )
    offset = np.array([[0.3, -0.2]])
    image = engine.render(np.zeros((1, 2)), offset).image[0]

    focal = math.sqrt(np.linalg.det(jacobian))
    line = spacing * (np.arange(-30, 30) + 0.5)
    pupil = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    optics = telescope.trace(telescope, np.zeros((1, 2)), wavelengths, pupil)
    # direction cosines of the light at the focus
    cosines = pupil @ np.linalg.inv(jacobian)
    node, weight = np.polynomial.legendre.leggauss(8)
    expected = np.zeros((9, 9))
    for wave, wavelength in enumerate(wavelengths):
        k = 2 * np.pi / wavelength
        lit = optics.lit[0, wave]
        field = np.exp(1j * k * optics.path[0, wave, lit])
        shift = jacobian @ dispersion[wave] + offset[0] * 5e-6
        x, y = ((plane.pixel_centers[:, None] + 2.5e-6 * node).ravel() - s for s in shift)
        to_x = np.exp(-1j * k * np.outer(x, cosines[lit, 0]))
        to_y = np.exp(-1j * k * np.outer(y, cosines[lit, 1]))
        square = np.abs((to_y * field) @ to_x.T) ** 2
        mean = np.einsum("iajb,a,b->ij", square.reshape(9, 8, 9, 8), weight / 2, weight / 2)
        expected += mean * (plane.pixel_size * spacing / (wavelength * focal)) ** 2
    expected /= optics.lit.sum()
    # Single precision of the phase and of the transform.
    np.testing.assert_allclose(image, expected, atol=2e-6 * expected.max())


def test_perfect_optics_have_the_transfer_function_of_the_annulus(polynomial_pupil):
    telescope = polynomial_pupil()
    engine = WavePsfEngine(telescope, ONE_WAVE, PLANE, dispersion=STILL, threads=1, pupil_spacing=0.02)
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


@pytest.mark.parametrize("tilt", [(3e-6, 0.0), (0.0, -2e-6)])
def test_tilt_dispersion_and_offset_move_the_image(polynomial_pupil, tilt):
    """By exactly the Jacobian times the angle, whatever the wavelength: the image is the unmoved one, elsewhere."""
    jacobian = np.array([[10.3, 0.5], [-0.4, 10.6]])
    dispersion = np.array([[1e-6, -2e-6]])
    offset = np.array([[0.25, -0.4]])
    shift = offset + (jacobian @ (np.array(tilt) + dispersion[0]))[None] / 10e-6
    for wavelength in (500e-9, 600e-9, 700e-9):
        wave = np.array([wavelength])
        options = {"threads": 1, "pupil_spacing": 0.015, "padding": False}
        moved = WavePsfEngine(
            polynomial_pupil(tilt=tilt, jacobian=jacobian), wave, PLANE, dispersion=dispersion, **options
        )
        image = moved.render(np.zeros((1, 2)), offset).image
        plain = WavePsfEngine(polynomial_pupil(jacobian=jacobian), wave, PLANE, dispersion=STILL, **options)
        expected = plain.render(np.zeros((1, 2)), shift).image
        np.testing.assert_allclose(image, expected, atol=1e-6 * expected.max())


def test_layers_bend_light_by_their_gradient_where_it_crosses_them(polynomial_pupil, single_modes):
    jacobian = np.array([[10.3, 0.5], [-0.4, 10.6]])
    telescope = polynomial_pupil(jacobian=jacobian)
    engine = WavePsfEngine(
        telescope, ONE_WAVE, PLANE, dispersion=STILL, atmosphere=single_modes, threads=1, pupil_spacing=0.04
    )
    still = WavePsfEngine(telescope, ONE_WAVE, PLANE, dispersion=STILL, threads=1, pupil_spacing=0.04, padding=False)
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


def dots(telescope, engine, pupil, lit):
    """Return what the pupil lets through at lattice points alone, and their places [m]."""
    at = np.array([np.argmin(np.hypot(*(engine._lattice.points - point).T)) for point in pupil])
    optics = telescope.trace(telescope, np.zeros((1, 2)), np.ones(len(lit)), engine._lattice.points)
    optics.lit[...] = False
    optics.lit[0][:, at] = lit
    return optics, engine._lattice.points[at]


def test_light_is_conserved(polynomial_pupil):
    """Parseval: each wavelength's mean intensity on its grid is its share of the lit points."""
    telescope = polynomial_pupil(defocus=1e-6)
    atmosphere = small_atmosphere(exposure=0.05)
    wavelengths = np.array([550e-9, 700e-9])
    engine = WavePsfEngine(telescope, wavelengths, PLANE, dispersion=np.zeros((2, 2)), atmosphere=atmosphere, threads=1)
    rng = np.random.default_rng(0)
    lit = rng.random((2, 1000)) < np.array([[0.9], [0.5]])
    optics, _ = dots(telescope, engine, rng.uniform(-2.9, 2.9, (1000, 2)), lit)
    intensity = engine._expose(np.zeros(2), optics)
    # Single-precision transforms.
    share = optics.lit[0].sum(axis=1) / optics.lit.sum()
    np.testing.assert_allclose(intensity.mean(axis=(1, 2)), share, rtol=1e-5)


@pytest.mark.parametrize("fine_pixel", [0.02, 0.0173])
def test_phase_of_the_atmosphere_against_plain_numpy(polynomial_pupil, fine_pixel):
    """The path between points of the pupil, read off the fringes of two at a time."""
    telescope = polynomial_pupil()
    atmosphere = small_atmosphere(exposure=0.05, fine_pixel=fine_pixel)
    engine = WavePsfEngine(telescope, ONE_WAVE, PLANE, dispersion=STILL, atmosphere=atmosphere, threads=1)
    field = np.array([0.02, -0.01])
    rng = np.random.default_rng(1)
    for _ in range(8):
        optics, pupil = dots(telescope, engine, rng.uniform(-2.9, 2.9, (2, 2)), np.ones((1, 2), dtype=bool))
        path = np.zeros(2)
        for layer in range(6):
            x, y = atmosphere.screen_coordinates(
                *pupil.T, layer, field=tuple(np.tan(field)), time=float(atmosphere.times[0])
            )
            for scale in ("low", "high"):
                path += atmosphere.path(x, y, layer, scale=scale)
        intensity = engine._expose(field, optics)[0]
        # Intensity 1 + cos(k (path_a - path_b) - the phase ramp of their distance).
        steps = np.rint((pupil[0] - pupil[1]) / engine._lattice.spacing)
        line = 2 * np.pi * np.arange(engine._size) / engine._size
        ramp = line * steps[0] + line[:, None] * steps[1]
        expected = 1 + np.cos(2 * np.pi / 620e-9 * (path[0] - path[1]) - ramp)
        # Paths of 10 waves in single precision leave 1e-5 of a radian in every layer and scale.
        np.testing.assert_allclose(intensity, expected, atol=2e-3)


def test_padding_changes_nothing_that_the_detector_sees(polynomial_pupil):
    telescope = polynomial_pupil(defocus=0.5e-6)
    atmosphere = small_atmosphere()
    images = [
        WavePsfEngine(telescope, ONE_WAVE, PLANE, dispersion=STILL, atmosphere=atmosphere, threads=1, padding=padding)
        .render(*STAR)
        .image
        for padding in (False, True)
    ]
    # exp(-17) is left of a baseline of 1.5 m by charge diffusion; single precision is more.
    np.testing.assert_allclose(images[0], images[1], atol=3e-6 * images[1].max())


def test_grid_is_padded_where_it_must_be(polynomial_pupil):
    telescope, atmosphere = polynomial_pupil(), small_atmosphere()

    def size(plane, atmosphere, **options):
        engine = WavePsfEngine(telescope, ONE_WAVE, plane, dispersion=STILL, atmosphere=atmosphere, **options)
        return engine._size * engine._lattice.spacing

    sharp = ImagePlane(31, 10e-6, 0.5e-6)
    assert size(PLANE, atmosphere) < 12.0
    assert size(PLANE, None) > 2 * 8.36
    assert size(sharp, atmosphere) > 2 * 8.36
    assert size(sharp, atmosphere, padding=False) < 12.0


@pytest.mark.parametrize("field_deg", [(0.0, 0.0), (0.6, 1.1)])
def test_image_points_the_way_of_the_spot_diagram(lsst_r, field_deg):
    """A defocused, decentred camera: centroid, ellipticity and skewness of the image are those of the rays."""
    telescope = lsst_r.perturbed("Camera", shift=(3e-3, 1.5e-3, 30e-6))
    field = np.radians([field_deg])
    wave = np.array([lsst_r.default_wavelength])
    plane = ImagePlane(61, 3e-6, 1e-6)
    engine = WavePsfEngine(telescope, wave, plane, dispersion=STILL, threads=1)
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


def test_bytes_do_not_depend_on_threads_batches_or_company(lsst_r):
    atmosphere = small_atmosphere(exposure=0.1)
    fields = np.array([[0.0, 0.0], [0.01, 0.02], [-0.02, 0.005]])
    offsets = np.array([[0.0, 0.0], [0.3, -0.2], [0.1, 0.4]])
    wavelengths = np.array([550e-9, 690e-9])

    def images(select, threads):
        engine = WavePsfEngine(
            lsst_r, wavelengths, PLANE, dispersion=np.zeros((2, 2)), atmosphere=atmosphere, threads=threads
        )
        return engine.render(fields[select], offsets[select]).image

    everything = images(slice(None), 1)
    np.testing.assert_array_equal(images(slice(None), 3), everything)
    np.testing.assert_array_equal(images(slice(1, 2), 2), everything[1:2])


def test_heights_of_the_ccds_defocus_the_image(lsst_r):
    """A flat CCD plane gives the image of no CCDs at all; that of a height budget does not."""
    field = np.radians([[0.02, 0.03]])
    options = {"dispersion": STILL, "threads": 1}
    image = {
        name: WavePsfEngine(lsst_r, ONE_WAVE, PLANE, focal_plane=plane, **options)
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


def test_refuses_bad_spacing(polynomial_pupil):
    with pytest.raises(DomainError, match="pupil_spacing"):
        WavePsfEngine(polynomial_pupil(), ONE_WAVE, PLANE, dispersion=STILL, pupil_spacing=0.0)
