"""The long-exposure engine: against brute force over the pupil, closed forms and the mean of the fast engine."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.optimize import brentq

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.models.aperture import Circle, Complement
from pachon.models.shapes.shape import Plane
from pachon.models.surface import Interaction, Surface
from pachon.pipeline.config import Configuration
from pachon.pipeline.experiment import Experiment
from pachon.raytrace.rays import field_direction
from pachon.wavefront.aberration import ResidualWavefront
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.screen_sampling import ScreenSampling
from pachon.wavefront.atmosphere.turbulence import diffraction_otf, long_exposure_fwhm, structure_function
from pachon.wavefront.chief_rays import fields_at
from pachon.wavefront.psf.clear_pupil import SpokePupil, clear_edges
from pachon.wavefront.psf.engine import PsfInputs
from pachon.wavefront.psf.fast import FastEngine
from pachon.wavefront.psf.image_plane import ImagePlane
from pachon.wavefront.psf.long_exposure import PUPIL_POINTS, LongExposureEngine
from pachon.wavefront.psf.psf import DARK, make_psfs
from pachon.wavefront.psf.pupil_lattice import PupilLattice
from pachon.wavefront.psf.stamps import Stamps
from pachon.wavefront.pupil_optics import trace_pupils

FOCAL_LENGTH = 10.31
PLANE = ImagePlane(31, 10e-6, 4e-6)
ONE_WAVE = np.array([620e-9])
R0, OUTER_SCALE = 0.16, 25.0


def air(seed=1, **options):
    return Atmosphere.from_site("cerro_pachon", seed, **({"r0": R0, "outer_scale": OUTER_SCALE} | options))


def renderer_for(telescope, wavelengths=ONE_WAVE, plane=PLANE, n_pupil=None, **options):
    options = {"atmosphere": air(), "threads": 1} | options
    make = partial(PsfInputs, telescope) if isinstance(telescope, pachon.Telescope) else telescope.inputs
    return LongExposureEngine(n_pupil).renderer(make(wavelengths, plane, **options))


def moments(image):
    """Ellipticities (a-b)/(a+b), size [pixels] and centroid [pixels] under a Gaussian weight of 0.7 arcsec."""
    sigma = 3.5 / np.sqrt(8 * np.log(2))
    grid = np.arange(len(image)) - len(image) // 2
    x, y = np.meshgrid(grid, grid)
    cx = cy = 0.0
    for _ in range(60):
        light = image * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2) / sigma**2)
        light = light / light.sum()
        cx, cy = (light * x).sum(), (light * y).sum()
    xx, xy, yy = ((light * a * b).sum() for a, b in ((x - cx, x - cx), (x - cx, y - cy), (y - cy, y - cy)))
    area = np.sqrt(xx * yy - xy * xy)
    scale = xx + yy + 2 * area
    return np.array([(xx - yy) / scale, 2 * xy / scale]), np.sqrt(area), np.array([cx, cy])


def full_width(image, place=(0.0, 0.0)):
    """Full width at half maximum of a smooth fit to log-image against the distance from a place [pixels]."""
    grid = np.arange(len(image)) - len(image) // 2
    radius = np.hypot(grid - place[0], (grid - place[1])[:, None])
    near = radius < 8.0
    weight = np.exp(-0.5 * (radius[near] / 2.5) ** 2)
    fit = np.polynomial.Polynomial.fit(radius[near] ** 2, np.log(image[near]), 4, w=weight)
    return 2 * brentq(lambda r: fit(0.0) - fit(r * r) - np.log(2.0), 0.5, 6.0)


def image_of(otf, k, plane=PLANE):
    """Pixel values of the image with a transfer function [ky, kx] on the focal plane, by plain sums."""
    to_pixels = np.exp(1j * np.outer(plane.pixel_centers, k))
    scale = (plane.pixel_size * abs(k[1] - k[0]) / (2 * np.pi)) ** 2
    return scale * (to_pixels @ otf @ to_pixels.T).real


def brute_force(telescope, field, wavelength, *, spacing=0.0125, longest=1.0, aberration=None):
    """The mean image as wave optics has it: the autocorrelation of the pupil's field, times the mean of turbulence.

    The pupil lattice is square in q = f J^-T p, the direction cosines at the focus, so that baselines are square in
    wavenumbers on the focal plane; the phase is the traced path, not where rays land.
    """
    jacobian = trace_pupils(telescope, field[None], [wavelength], np.zeros((1, 2))).jacobian[0]
    focal = np.sqrt(np.linalg.det(jacobian))
    size = int(np.ceil((1.01 * telescope.pupil_diameter + longest) / spacing / 8)) * 8
    line = (np.arange(size) - size // 2) * spacing
    p = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) @ jacobian / focal
    radius = np.hypot(*p.T) / (0.5 * telescope.pupil_diameter)
    inside = np.flatnonzero((radius < 1.0) & (radius >= telescope.pupil_obscuration))
    optics = trace_pupils(telescope, field[None], [wavelength], p[inside], aberration=aberration)
    lit = optics.lit[0, 0]
    pupil = np.zeros(size * size, dtype=complex)
    pupil[inside[lit]] = np.exp(2j * np.pi / wavelength * optics.path[0, 0, lit])
    step = np.arange(-int(longest / spacing), int(longest / spacing) + 1)
    otf = np.fft.ifft2(np.abs(np.fft.fft2(pupil.reshape(size, size))) ** 2)[np.ix_(step, step)] / lit.sum()
    k = -2 * np.pi * spacing / (wavelength * focal) * step
    along = np.stack(np.meshgrid(k, k), axis=-1) @ jacobian * wavelength / (2 * np.pi)
    structure = structure_function(np.hypot(along[..., 0], along[..., 1]), R0, OUTER_SCALE)
    otf *= np.exp(-0.5 * (2 * np.pi / wavelength) ** 2 * structure) * PLANE.transfer(k, k[:, None])
    return image_of(otf, k), lit.sum() * spacing**2


@pytest.mark.long
@pytest.mark.parametrize(
    ("field_deg", "defocus", "residual", "shape", "place"),
    [
        # What is left of e is from bends of the wavefront within a baseline and from the points of the pupil, 4e-5
        # each at the heights that CCDs have, and 1e-4 each at 20 um of defocus at the edge of the field.
        ((0.0, 0.0), 10e-6, 0.0, 1e-6, 1e-6),
        pytest.param((0.8, 0.6), 0.0, 0.0, 6e-5, 1e-3, marks=pytest.mark.slow),
        pytest.param((-0.9, 1.07), -10e-6, 0.0, 6e-5, 1e-3, marks=pytest.mark.slow),
        ((-0.9, 1.07), 10e-6, 0.2e-6, 6e-5, 1e-3),
        ((1.5, -0.8), 20e-6, 0.0, 2e-4, 3e-3),
        pytest.param((-0.2, -1.74), -20e-6, 0.0, 2e-4, 3e-3, marks=pytest.mark.slow),
    ],
)
def test_against_brute_force_over_the_pupil(lsst_r, field_deg, defocus, residual, shape, place):
    """To multiply the image of all rays by the transfer function of diffraction would be wrong by 1e-3 in e."""
    telescope = lsst_r.perturbed("Detector", shift=(0.0, 0.0, defocus))
    field = np.radians(field_deg)
    aberration = ResidualWavefront.draw(telescope, residual, seed=2) if residual else None
    expected, _ = brute_force(telescope, field, 620e-9, aberration=aberration)
    stars = renderer_for(telescope, aberration=aberration).render(field[None], np.zeros((1, 2)))
    (e, size, center), (e_wave, size_wave, center_wave) = moments(stars.image[0]), moments(expected)
    np.testing.assert_allclose(e, e_wave, atol=shape)
    assert size == pytest.approx(size_wave, rel=3e-4)
    assert full_width(stars.image[0], center) == pytest.approx(full_width(expected, center_wave), rel=5e-4)
    np.testing.assert_allclose(center, center_wave, atol=place)
    # The far wings differ: the period of the two images does.
    np.testing.assert_allclose(stars.image[0], expected, atol=2e-3 * expected.max())


def theory(plane, wavelength=620e-9, shift=(0.0, 0.0), margin=1.25, diameter=8.36, obscuration=0.612):
    """The image of perfect optics, by a plain sum over frequencies; it comes round after so many sides of the stamp."""
    k = 2 * np.pi / (margin * plane.side) * np.arange(-round(45 * margin), round(45 * margin) + 1)
    b = k * wavelength * FOCAL_LENGTH / (2 * np.pi)
    b = np.hypot(b, b[:, None])
    otf = diffraction_otf(b, diameter, obscuration)
    otf *= np.exp(-0.5 * (2 * np.pi / wavelength) ** 2 * structure_function(b, R0, OUTER_SCALE))
    ramp = np.exp(-1j * k * shift[0]) * np.exp(-1j * k * shift[1])[:, None]
    return image_of(otf * ramp * plane.transfer(k, k[:, None]), k, plane)


def test_perfect_optics_give_the_long_exposure_in_closed_form(polynomial_pupil):
    telescope = polynomial_pupil()
    plane = ImagePlane(61, 5e-6, 1e-6)
    star = np.zeros((1, 2)), np.array([[0.3, -0.2]])
    shift = (1.5e-6, -1e-6)
    expected = theory(plane, shift=shift)
    # Sixteen spokes for the rim, whose piece across a baseline goes as |cos|, leave 3e-5; many spokes leave what is
    # wrong for these small pixels with frequencies beyond that of 1e-5 left out.
    for n_pupil, allowed in ((None, 5e-5), (2000, 2e-5)):
        image = renderer_for(telescope, plane=plane, n_pupil=n_pupil).render(*star).image[0]
        np.testing.assert_allclose(image, expected, atol=allowed * expected.max())
    # The wings of an image that does not come round so soon are fainter, by up to 3e-4 of the peak in the corners.
    np.testing.assert_allclose(image, theory(plane, shift=shift, margin=4.0), atol=4e-4 * expected.max())


def test_wings_come_round_where_pixels_are_cut_off(polynomial_pupil):
    """61 pixels of which 47 stay: the image comes round after them all, not after 1.25 times as many."""
    plane = ImagePlane(61, 5e-6, 1e-6, room=14)
    image = renderer_for(polynomial_pupil(), plane=plane).render(np.zeros((1, 2)), np.zeros((1, 2))).image[0]
    expected = theory(plane, margin=1.0)
    np.testing.assert_allclose(image, expected, atol=5e-5 * expected.max())
    # A third of the light at the rim is theirs.
    assert image[0].mean() == pytest.approx(expected[0].mean(), rel=0.05)
    assert image[0].mean() > 1.3 * theory(plane)[0].mean()


def test_width_of_perfect_optics(polynomial_pupil):
    plane = ImagePlane(121, 2.5e-6, 0.0)
    image = renderer_for(polynomial_pupil(), plane=plane).render(np.zeros((1, 2)), np.zeros((1, 2))).image[0]
    falling = image[60, 60:100]
    width = 2 * np.interp(-0.5 * image.max(), -falling, np.arange(40)) * 2.5e-6 / FOCAL_LENGTH
    expected = long_exposure_fwhm(620e-9, R0, OUTER_SCALE, diameter=8.36, obscuration=0.612)
    # Pixels of a tenth of the width: 0.5 um^2 of variance beside the 104 um^2 of a Gaussian as wide.
    assert width == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("rim", [0.0, 0.15])
def test_defocus_and_coma_against_brute_force_over_a_circle(polynomial_pupil, rim):
    """Rims inside of the traced rings and a skewed Jacobian; the wavefront is known in closed form."""
    inner, outer = 4.18 * 0.612 + rim, 4.18 - 2 * rim
    jacobian = np.array([[10.3, 0.9], [-0.5, 10.8]])
    telescope = polynomial_pupil(clear=(inner, outer), defocus=1.5e-6, coma=0.6e-6, jacobian=jacobian)
    stars = renderer_for(telescope).render(np.array([[0.01, 0.0]]), np.zeros((1, 2)))
    assert stars.lit_fraction[0, 0] == pytest.approx((outer**2 - inner**2) / (4.18**2 * (1 - 0.612**2)), rel=1e-12)

    spacing, reach, wavenumber = 0.0125, 60, 2 * np.pi / 620e-9
    line = spacing * (np.arange(-360, 360) + 0.5)
    x, y = line, line[:, None]
    square = (x * x + y * y) / 4.18**2
    radius = np.hypot(x, y)
    wave = np.zeros((1024, 1024), dtype=complex)
    path = 1.5e-6 * square + 0.6e-6 * square * x / 4.18
    wave[:720, :720] = np.where((radius >= inner) & (radius < outer), np.exp(1j * wavenumber * path), 0.0)
    step = np.arange(-reach, reach + 1)
    otf = np.fft.ifft2(np.abs(np.fft.fft2(wave)) ** 2)[np.ix_(step, step)] / np.count_nonzero(wave)
    b = -spacing * np.stack(np.meshgrid(step, step), axis=-1)
    k = wavenumber * b @ np.linalg.inv(jacobian)
    structure = structure_function(np.hypot(b[..., 0], b[..., 1]), R0, OUTER_SCALE)
    otf *= np.exp(-0.5 * wavenumber**2 * structure) * PLANE.transfer(k[..., 0], k[..., 1])
    # k . X is wavenumber b . J^-1 X
    pixels = np.stack(np.meshgrid(PLANE.pixel_centers, PLANE.pixel_centers), axis=-1).reshape(-1, 2)
    angle = pixels @ np.linalg.inv(jacobian).T
    to_x, to_y = (np.exp(-1j * wavenumber * spacing * np.outer(angle[:, axis], step)) for axis in (0, 1))
    expected = ((to_y @ otf) * to_x).sum(axis=1).real.reshape(31, 31)
    expected *= (PLANE.pixel_size * spacing / 620e-9) ** 2 / np.linalg.det(jacobian)
    (e, size, center), (e_wave, size_wave, center_wave) = moments(stars.image[0]), moments(expected)
    assert np.hypot(*e_wave) > 0.01
    np.testing.assert_allclose(e, e_wave, atol=6e-5)
    assert size == pytest.approx(size_wave, rel=2e-4)
    np.testing.assert_allclose(center, center_wave, atol=5e-4)
    # Wings come round at another distance.
    np.testing.assert_allclose(stars.image[0], expected, atol=5e-4 * expected.max())


def test_an_image_on_the_axis_is_round(lsst_r):
    image = renderer_for(lsst_r).render(np.zeros((1, 2)), np.zeros((1, 2))).image[0]
    for turned in (image.T, image[::-1], image[:, ::-1]):
        # Landing points and sums in single precision.
        np.testing.assert_allclose(turned, image, atol=2e-6 * image.max())
    np.testing.assert_allclose(moments(image)[0], 0.0, atol=1e-6)


@pytest.mark.slow
def test_mean_of_many_exposures_of_the_fast_engine(polynomial_pupil):
    """Defocused and comatic, so that the optics share in the width and the shape."""
    telescope = polynomial_pupil(defocus=1.2e-6, coma=0.8e-6)
    fields = np.stack(np.meshgrid([-0.02, 0.0, 0.02], [-0.02, 0.02]), axis=-1).reshape(-1, 2)
    total = np.zeros((31, 31))
    for seed in range(8):
        screens = ScreenSampling(2048, 327.68, cutoff=6.25)
        atmosphere = air(seed, exposure=15.0, time_step=0.15, screens=screens)
        fast = FastEngine().renderer(telescope.inputs(ONE_WAVE, PLANE, atmosphere=atmosphere))
        total += fast.render(fields, np.zeros((6, 2))).image.sum(axis=0)
    image = renderer_for(telescope).render(np.zeros((1, 2)), np.zeros((1, 2))).image[0]
    (e, size, center), (e_mean, size_mean, center_mean) = moments(image), moments(total)
    # The mean over eight exposures has a noise of 0.5 % in width and of 2e-3 in e; the fast engine leaves diffraction
    # the same for all rays, 0.5 %.
    assert full_width(total, center_mean) == pytest.approx(full_width(image, center), rel=0.02)
    assert size_mean == pytest.approx(size, rel=0.02)
    np.testing.assert_allclose(e_mean, e, atol=6e-3)


def test_bytes_do_not_depend_on_threads_batches_or_company(lsst_r):
    rng = np.random.default_rng(1)
    fields, offsets = rng.uniform(-0.02, 0.02, (7, 2)), rng.uniform(-0.5, 0.5, (7, 2))
    wavelengths = np.array([550e-9, 620e-9, 690e-9])

    def images(select, threads):
        return renderer_for(lsst_r, wavelengths, threads=threads).render(fields[select], offsets[select]).image

    everything = images(slice(None), 1)
    np.testing.assert_array_equal(images(slice(None), 3), everything)
    np.testing.assert_array_equal(images(slice(2, 5), 2), everything[2:5])
    np.testing.assert_array_equal(images([6, 0], 1), everything[[6, 0]])


def test_no_random_numbers_and_no_screens(lsst_r, monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("a screen was asked for")

    monkeypatch.setattr(Atmosphere, "screens", refuse)
    psfs = [
        make_psfs(lsst_r, [[0.01, 0.005]], ONE_WAVE, engine="long_exposure", atmosphere=air(seed), threads=1)
        for seed in (1, 2)
    ]
    np.testing.assert_array_equal(psfs[0].image, psfs[1].image)
    assert psfs[0].image.sum() == pytest.approx(1.0, abs=1e-6)
    assert psfs[0].flags.tolist() == [0]


def test_offset_moves_the_image(lsst_r):
    engine = renderer_for(lsst_r)
    field = np.array([[0.012, -0.02]])
    image = engine.render(field, np.zeros((1, 2))).image[0]
    moved = engine.render(field, np.array([[2.0, -3.0]])).image[0]
    # Phases in single precision, over some ten turns.
    np.testing.assert_allclose(moved[:-3, 2:], image[3:, :-2], atol=3e-6 * image.max())
    half = engine.render(field, np.array([[0.37, -0.21]])).image[0]
    # The weight has not the shape of the image, and pixels sample it a little differently.
    np.testing.assert_allclose(moments(half)[2] - moments(image)[2], [0.37, -0.21], atol=1e-3)


def test_recentred_star_is_drawn_elsewhere(lsst_r):
    engine = renderer_for(lsst_r)
    fields, offsets = np.array([[0.012, -0.02], [0.0, 0.01]]), np.array([[0.1, 0.2], [0.3, -0.4]])
    shift = np.array([[0.5, -0.25], [0.125, 0.75]])
    given = []
    stars = engine.render(fields, offsets, lambda images: given.append(images) or shift)
    np.testing.assert_array_equal(given[0], engine.render(fields, offsets).image)
    np.testing.assert_array_equal(stars.image, engine.render(fields, offsets - shift).image)
    np.testing.assert_array_equal(stars.offset, offsets - shift)


@pytest.mark.parametrize("tilt", [(3e-6, 0.0), (0.0, -2e-6)])
def test_tilt_and_dispersion_move_the_image(polynomial_pupil, tilt):
    jacobian = np.array([[10.3, 0.5], [-0.4, 10.6]])
    dispersion = np.array([[1e-6, -2e-6]])
    star = np.zeros((1, 2)), np.array([[0.25, -0.4]])
    moved = renderer_for(polynomial_pupil(tilt=tilt, jacobian=jacobian), dispersion=dispersion).render(*star).image
    shift = (jacobian @ (np.array(tilt) + dispersion[0]))[None] / 10e-6
    plain = renderer_for(polynomial_pupil(jacobian=jacobian)).render(star[0], star[1] + shift).image
    np.testing.assert_allclose(moved, plain, atol=2e-6 * plain.max())


def test_wavelengths_add_up(lsst_r):
    wavelengths = np.array([550e-9, 620e-9, 690e-9])
    star = np.array([[0.015, 0.02]]), np.zeros((1, 2))
    dispersion = np.array([[4e-6, 0.0], [0.0, 0.0], [-4e-6, 1e-6]])
    image = renderer_for(lsst_r, wavelengths, dispersion=dispersion).render(*star).image
    # Reference points and rims belong to the middle wavelength, so it goes along with each of the others.
    parts = [
        renderer_for(lsst_r, wavelengths[[w, 1, 1]], dispersion=dispersion[[w, 1, 1]]).render(*star).image
        for w in (0, 2)
    ]
    middle = renderer_for(lsst_r, wavelengths[[1]]).render(*star).image
    # Single precision, and frequencies that reach a little farther at one wavelength than at another (1e-5).
    np.testing.assert_allclose(image, sum(parts) - middle, atol=1e-5 * image.max())


def test_spokes_integrate_polynomials_exactly():
    pupil = SpokePupil.fill(8.36, 0.612, 80)
    assert (pupil.n_spoke, len(pupil.radius), len(pupil.points)) == (16, 5, 80)
    weight = np.repeat(pupil.quadrature, pupil.n_spoke) / pupil.n_spoke
    assert weight.sum() == pytest.approx(1.0, rel=1e-14)
    x, y = pupil.points.T
    a, b = 4.18 * 0.612, 4.18
    for power in (1, 2, 3):
        mean = (b ** (2 * power + 2) - a ** (2 * power + 2)) / ((power + 1) * (b * b - a * a))
        assert weight @ (x * x + y * y) ** power == pytest.approx(mean, rel=1e-13)
    for odd in (x, y, x * y, x * x - y * y, x**3 - 3 * x * y * y):
        assert weight @ odd == pytest.approx(0.0, abs=1e-12)
    for count in (10, 33, 80, 1000, 20000):
        assert len(SpokePupil.fill(8.36, 0.612, count).points) == pytest.approx(count, rel=0.4)


@pytest.mark.parametrize("perturbation", [{}, {"shift": (4e-3, -2e-3, 0.0), "tilt": (1e-3, 2e-3, 0.0)}])
def test_edges_are_where_the_trace_vignettes(lsst_r, perturbation):
    telescope = lsst_r.perturbed("Camera", **perturbation) if perturbation else lsst_r
    fields = np.radians([[0.0, 0.0], [0.7, 0.7], [-1.4, 0.3], [0.3, -1.7], [1.2, 1.25]])
    unit = SpokePupil.fill(8.36, 0.612, 200).unit
    edges = clear_edges(telescope, field_direction(*fields.T), unit, 620e-9, threads=1)
    radius = 4.18 * np.sqrt(np.linspace(0.612**2, 1.0, 202)[1:-1])
    points = (radius[:, None, None] * unit).reshape(-1, 2)
    lit = trace_pupils(telescope, fields, ONE_WAVE, points).lit[:, 0].reshape(len(fields), len(radius), -1)
    expected = (radius[:, None] > edges[:, None, :, 0]) & (radius[:, None] < edges[:, None, :, 1])
    # Rims are found to some 5 mm of the 1600 of a spoke, and points stand 5 to 8 mm apart.
    assert np.mean(lit != expected) < 2e-3
    for star in range(len(fields)):
        assert abs(np.mean(lit[star], axis=0) - np.mean(expected[star], axis=0)).max() < 0.01


def test_a_vignetted_star(lsst_r):
    field = np.radians([[1.05, 1.4]])
    stars = renderer_for(lsst_r).render(field, np.zeros((1, 2)))
    _, area = brute_force(lsst_r, field[0], 620e-9)
    assert stars.lit_fraction.shape == (1, 1)
    # Sixteen spokes, against a lattice: its rim is cut along its cells.
    assert stars.lit_fraction[0, 0] == pytest.approx(area / (np.pi * 4.18**2 * (1 - 0.612**2)), abs=1e-3)
    assert stars.lit_fraction[0, 0] < 0.91


def test_a_dark_star(lsst_r):
    limit = 0.9 * lsst_r.field_limit
    psfs = make_psfs(
        lsst_r,
        [[limit, 0.0], [0.0, 0.0]],
        ONE_WAVE,
        atmosphere=air(),
        threads=1,
        engine="long_exposure",
        stamps=Stamps(9),
    )
    assert psfs.lit_fraction[0].max() == 0.0
    assert psfs.flags.tolist() == [DARK, 0]
    assert not psfs.image[0].any()
    assert psfs.image[1].sum() == pytest.approx(1.0, abs=1e-6)


def test_shape_moves_smoothly_with_the_telescope(lsst_r):
    """Third differences over steps of 0.1 mm: a count of rays would jump by 1e-4 as points are lit or go dark."""
    field = np.radians([[1.1, 1.25]])
    e = []
    for step in range(7):
        telescope = lsst_r.perturbed("Camera", shift=(1e-4 * step, 0.0, 0.0))
        e.append(moments(renderer_for(telescope).render(field, np.zeros((1, 2))).image[0])[0])
    e = np.array(e)
    assert np.abs(np.diff(e, axis=0)).max() > 5e-4
    # The rims themselves have corners, where one aperture takes over from another.
    assert np.abs(np.diff(e, 3, axis=0)).max() < 3e-6


def test_heights_of_the_ccds(lsst_r):
    plane = pachon.FocalPlane.from_budget("lsst", seed=1)
    fields = fields_at(lsst_r, plane.camera.centers[[94, 10]])
    options = {"engine": "long_exposure", "atmosphere": air(), "threads": 1}
    uneven, flat, none = (
        make_psfs(lsst_r, fields, ONE_WAVE, focal_plane=given, **options)
        for given in (plane, pachon.FocalPlane.flat("lsst"), None)
    )
    # Where the chief ray lands is found to 1e-14 m, on another way: far below single precision.
    np.testing.assert_allclose(flat.image, none.image, atol=1e-7)
    assert np.abs(uneven.image - flat.image).max() > 1e-3 * flat.image.max()
    assert uneven.lit_fraction.shape == (2, 1)


def test_needs_turbulence(lsst_r):
    with pytest.raises(ConfigError, match="engine = 'long_exposure': expected an atmosphere"):
        make_psfs(lsst_r, [[0.0, 0.0]], ONE_WAVE, engine="long_exposure")
    with pytest.raises(DomainError, match="n_pupil = 5"):
        renderer_for(lsst_r, n_pupil=5)


def test_in_a_run():
    config = Experiment.from_config(Configuration.model_validate({"psf": {"engine": "long_exposure"}})).config
    assert config.psf.n_pupil == PUPIL_POINTS == 80
    given = {"psf": {"engine": "long_exposure"}, "atmosphere": {"enabled": False}}
    with pytest.raises(ConfigError, match=r"psf\.engine = long_exposure: expected atmosphere\.enabled = true"):
        Experiment.from_config(Configuration.model_validate(given))


def test_large_stamps(lsst_r):
    star = np.array([[0.01, 0.015]]), np.zeros((1, 2))
    large = renderer_for(lsst_r, plane=ImagePlane(101, 10e-6, 4e-6)).render(*star).image[0]
    small = renderer_for(lsst_r).render(*star).image[0]
    # The wings of the small stamp come round (GRID_MARGIN).
    np.testing.assert_allclose(large[35:66, 35:66], small, atol=3e-3 * small.max())
    np.testing.assert_allclose(large[40:61, 40:61], small[5:26, 5:26], atol=3e-4 * small.max())


def test_even_stamps_of_coarse_pixels(lsst_r):
    """A coarse pixel holds the light of four fine ones; the star stands where these meet."""
    field = np.array([[0.01, 0.015]])
    coarse = renderer_for(lsst_r, plane=ImagePlane(16, 20e-6, 4e-6)).render(field, np.zeros((1, 2))).image[0]
    fine = renderer_for(lsst_r, plane=ImagePlane(32, 10e-6, 4e-6)).render(field, np.array([[-0.5, -0.5]])).image[0]
    assert coarse.shape == (16, 16)
    # Coarse pixel 8 is that of the star, and fine pixels 15 and 16 are on either side of it.
    expected = fine[1:31, 1:31].reshape(15, 2, 15, 2).sum(axis=(1, 3))
    # Both leave out frequencies where 1e-5 is left.
    np.testing.assert_allclose(coarse[1:, 1:], expected, atol=2e-5 * expected.max())


@pytest.mark.parametrize("field_deg", [(1.2, 1.2), (-1.2166, -1.6195), (-1.52, -1.27)])
def test_clear_pupil_is_that_of_traced_rays_to_the_last_corner(lsst_r, field_deg):
    """Against rays counted on a fine lattice, out to where a crescent of 2 % of the pupil is all that is lit."""
    fields = np.radians([field_deg])
    lattice = PupilLattice.fill(lsst_r.pupil_diameter, lsst_r.pupil_obscuration, 0.04)
    wavelength = np.array([620e-9])
    lit = trace_pupils(lsst_r, fields, wavelength, lattice.points).lit[0, 0]
    angle = 2.0 * np.pi * (np.arange(720) + 0.5) / 720
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    direction = field_direction(fields[:, 0], fields[:, 1])
    edges = clear_edges(lsst_r, direction, unit, float(wavelength[0]))[0]
    area = np.pi / 720 * np.sum(edges[:, 1] ** 2 - edges[:, 0] ** 2)
    counted = lit.sum() * lattice.spacing**2
    # Parabolas through three rays place the rims to a millimetre or so inside the field, to centimetres in its corners.
    assert area == pytest.approx(counted, rel=3e-3, abs=0.05)
    assert counted > 0.4


def test_a_disc_in_the_way_leaves_the_clear_pupil_of_traced_rays(lsst_r):
    """A camera body above M1, whose shadow runs over the pupil as the field grows."""
    plane = Surface("body", Interaction.PASS, Plane(), (0.0, 0.0, 9.0), lsst_r.medium_before, Complement(Circle(2.75)))
    shaded = replace(lsst_r, surfaces=(plane, *lsst_r.surfaces))
    fields = np.radians([(1.0, 0.9)])
    lattice = PupilLattice.fill(lsst_r.pupil_diameter, lsst_r.pupil_obscuration, 0.02)
    angle = 2.0 * np.pi * (np.arange(720) + 0.5) / 720
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    direction = field_direction(fields[:, 0], fields[:, 1])
    areas = []
    for telescope in (lsst_r, shaded):
        lit = trace_pupils(telescope, fields, np.array([620e-9]), lattice.points).lit[0, 0]
        edges = clear_edges(telescope, direction, unit, 620e-9)[0]
        areas.append(np.pi / 720 * np.sum(edges[:, 1] ** 2 - edges[:, 0] ** 2))
        # Parabolas place rims to a millimetre, and spokes near a corner of two rims by more.
        assert areas[-1] == pytest.approx(lit.sum() * lattice.spacing**2, rel=3e-3)
    assert areas[1] < 0.98 * areas[0]


@pytest.mark.parametrize("size", [24, 25])
def test_pixels_are_those_of_a_larger_stamp(lsst_r, size):
    """Rows are sampled in pairs about the middle pixel; the first row of an even number has no opposite one.

    Wings that wrap around change the larger stamp by 1e-4 of the peak at most.
    """

    def light(size):
        stamps = Stamps(size, offsets=[[0.3, -1.7]])
        arguments = {"atmosphere": air(), "stamps": stamps, "engine": "long_exposure", "threads": 1}
        psf = make_psfs(lsst_r, np.deg2rad([[0.5, -0.3]]), ONE_WAVE, **arguments)
        return psf.image[0] * psf.inside[0]

    large, middle = light(41), slice(20 - size // 2, 20 - size // 2 + size)
    assert light(size) == pytest.approx(large[middle, middle], abs=2e-4 * large.max())
