"""Slopes of aberrations across the pupil: of defocus in closed form and by random points, and over the field."""

import math

import numpy as np
import pytest

import pachon
from pachon.models.ideal_telescope import ideal_telescope
from pachon.raytrace.rays import field_direction
from pachon.wavefront.psf import pupil_means
from pachon.wavefront.psf.clear_pupil import lit_fractions
from pachon.wavefront.psf.psf import psf_inputs
from pachon.wavefront.psf.pupil_means import PupilMeans
from pachon.wavefront.psf.stamps import Stamps

DEFOCUS = 0.3e-6


@pytest.fixture(scope="module")
def telescope():
    return ideal_telescope(pachon.load_telescope("lsst_v3.3_r"), 1e5)


def slopes_of(telescope, coefficient, gradient=(0.0, 0.0)):
    diameter, obscuration = telescope.pupil_diameter, telescope.pupil_obscuration
    aberration = pachon.wavefront.ResidualWavefront([coefficient], diameter, obscuration, [gradient])
    inputs, _ = psf_inputs(telescope, [(0.0, 0.0)], [620e-9], None, None, aberration, Stamps(), 1)
    return PupilMeans.of(inputs)


def test_defocus(telescope):
    """Slopes of Noll's Z4 on an annulus are 4 sqrt(3) c / (1 - obscuration^2) of the place over the radius.

    The first step holds pairs of points up to a twelfth of the diameter apart, 3 % less alike than a point with itself;
    the others are those of 3000 random points. At some fields points on the rim are dark.
    """
    inner, radius = telescope.pupil_obscuration, 0.5 * telescope.pupil_diameter
    slope = 4.0 * math.sqrt(3.0) * DEFOCUS / ((1.0 - inner**2) * radius)
    got = slopes_of(telescope, DEFOCUS)
    assert got.aberration[0] == pytest.approx(slope**2 * 0.5 * (1.0 + inner**2), rel=0.03)
    random = np.random.default_rng(3)
    distance = np.sqrt(random.uniform(inner**2, 1.0, 3000))
    angle = random.uniform(0.0, 2.0 * math.pi, 3000)
    place = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    apart, product = 0.5 * np.hypot(*(place[:, None] - place).T).ravel(), (place @ place.T).ravel()
    for step in (1, 3, 6, 9):
        near = np.maximum(1.0 - np.abs(12.0 * apart - step), 0.0)
        expected = slope**2 * (near @ product) / near.sum()
        assert got.aberration[step] == pytest.approx(expected, abs=0.03 * slope**2)
    assert got.relative_square(np.deg2rad([[0.0, 0.0], [1.0, -1.2]])) == pytest.approx([1.0, 1.0], abs=5e-3)


def test_over_the_field(telescope):
    """Defocus in proportion to the field along x: its square is a parabola, and its mean over the field a quarter."""
    radius = telescope.field_radius
    got = slopes_of(telescope, 0.0, (DEFOCUS / radius, 0.0))
    assert got.aberration[0] == pytest.approx(0.25 * slopes_of(telescope, DEFOCUS).aberration[0], rel=0.1)
    places = radius * np.array([[0.0, 0.5], [0.6, 0.0], [-0.6, 0.3]])
    one = got.relative_square(radius * np.array([[1.0, 0.0]]))[0]
    assert got.relative_square(places) / one == pytest.approx([0.0, 0.36, 0.36], abs=5e-3)


def test_light_of_a_vignetted_pupil():
    """HSC is cut from one side, the more the farther from the axis: far pairs of points are dark, near ones are not."""
    hsc = pachon.load_telescope("hsc")
    inputs, _ = psf_inputs(hsc, [(0.0, 0.0)], [760e-9], None, None, None, Stamps(), 1)
    got = PupilMeans.of(inputs)
    assert 0.7 < got.lit[0] < 0.9
    assert got.lit[8] < 0.8 * got.lit[0]
    levels = np.array(got.lit_levels)
    assert len(levels) > 2
    assert (np.diff(levels[:, 0]) > 0.0).all()
    # Of the darkest pupils mostly near pairs are left.
    assert (np.diff(levels[:, 6] / levels[:, 0]) > 0.0).all()


def test_pupils_over_the_field_are_those_of_its_stars():
    """Light of a star between the nodes, by counting rays: HSC loses a third of it, AuxTel none."""
    hsc = pachon.load_telescope("hsc")
    inputs, _ = psf_inputs(hsc, [(0.0, 0.0)], [760e-9], None, None, None, Stamps(), 1)
    pupils = PupilMeans.of(inputs).pupils
    places = hsc.field_radius * np.array([[0.3, 0.1], [-0.5, 0.6], [0.9, -0.1], [0.0, -0.97]])
    light = np.einsum("nk,kij->n", pupils.weights(np.tan(places)), pupils.light) / pupils.full.sum()
    expected = lit_fractions(hsc, field_direction(*np.tan(places).T, "gnomonic"), 760e-9)
    assert expected[-1] < 0.72
    np.testing.assert_allclose(light, expected, atol=0.015)
    auxtel = pachon.load_telescope("auxtel")
    inputs, _ = psf_inputs(auxtel, [(0.0, 0.0)], [760e-9], None, None, None, Stamps(), 1)
    assert PupilMeans.of(inputs).pupils is None


def test_light_at_the_corners_of_the_camera():
    """Of the LSST's light a third is left at 2 degrees, beyond the field of view; within it hardly any is lost."""
    lsst = pachon.load_telescope("lsst_v3.3_r")
    inputs, _ = psf_inputs(lsst, [(0.0, 0.0)], [620e-9], None, None, None, Stamps(), 1)
    levels = np.array(PupilMeans.of(inputs).lit_levels)
    assert levels[0, 0] < 0.35
    assert levels[-1, 0] > 0.95


def test_optics_without_aberrations(telescope):
    got = slopes_of(telescope, 0.0)
    assert min(got.lit[:6]) > 0.95
    assert got.aberration == pytest.approx(np.zeros(13), abs=1e-16)
    assert np.isfinite(got.relative_square(np.zeros((1, 2)))).all()
    assert len(got.lit_levels) == 1


@pytest.mark.parametrize("dark", ["diagonals", "ring"])
def test_rings_end_before_dark_pupils(monkeypatch, dark):
    """Light may be lost between the directions that are looked at, or in the middle of the field alone."""

    def lit(telescope, directions, wavelength, points, threads):
        x, y = (directions[:, :2] / telescope.field_radius).T
        radius = np.hypot(x, y)
        lost = np.minimum(np.abs(x), np.abs(y)) > 0.5 if dark == "diagonals" else np.abs(radius - 0.8) < 0.04
        inside = points[None, :, 0] < telescope.pupil_diameter * (0.5 - 0.4 * radius[:, None])
        return np.where(lost[:, None], 0.0, inside)

    telescope = pachon.load_telescope("hsc")
    monkeypatch.setattr(pupil_means, "lit_points", lit)
    pupils = pupil_means._field_pupils.__wrapped__(telescope, "gnomonic", 760e-9)
    assert (pupils.light.sum(axis=(1, 2)) > 0.05 * pupils.full.sum()).all()
    assert 0.5 < pupils.radius[-1] / telescope.field_radius < 0.8
