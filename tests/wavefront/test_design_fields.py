"""Requests without fields or wavelengths: what the design data of a telescope state."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.io.prescription import load_telescope
from pachon.models.paraxial import stop_image
from pachon.raytrace.rays import object_points

DATA = Path(__file__).parents[1] / "data" / "zmx"


@pytest.fixture(scope="module")
def lens():
    return load_telescope(DATA / "lens1.zmx")


def landing(telescope):
    """Where the chief rays of the telescope's own fields land [m]."""
    return pachon.Request.of(telescope).bundles(telescope.default_wavelength).chief_landing()


def test_the_fields_of_a_file_are_its_own(lens):
    request = pachon.Request.of(lens)
    assert np.rad2deg(request.fields) == pytest.approx(
        np.array([[0, 0], [0, 8.485281610363037], [0, 12.000000333930423]]), abs=1e-13
    )
    assert np.array_equal(request.wavelengths, lens.design_data.wavelengths)
    assert request.middle == lens.default_wavelength
    assert pachon.Request.of(lens, one_wavelength=True).wavelength == lens.default_wavelength
    # What is given goes before what is stated.
    other = pachon.Request.of(lens, (0.0, 0.01), 6e-7)
    assert (other.fields.tolist(), other.wavelength) == ([[0.0, 0.01]], 6e-7)


def test_the_primary_wavelength_is_the_reference_wherever_it_stands(lens):
    waves = lens.design_data.wavelengths
    turned = lens.with_design(wavelengths=(waves[1], waves[0], waves[2]), wavelength_weights=(2.0, 1.0, 1.0))
    request = pachon.Request.of(turned)
    assert request.middle == lens.default_wavelength
    assert request.weights == pytest.approx([0.5, 0.25, 0.25], rel=1e-15)
    assert request.middle_index == 0
    # The same light in another order makes the same spots about the same chief ray.
    weighted = lens.with_design(wavelength_weights=(1.0, 2.0, 1.0))
    one, other = (pachon.spots(t, n_pupil=4, reference="chief") for t in (weighted, turned))
    assert one.reference_point == pytest.approx(other.reference_point, abs=1e-15)
    assert one.rms_radius == pytest.approx(other.rms_radius, rel=1e-12)


def test_other_projections_have_the_same_light(lens):
    one, *others = (pachon.Request.of(lens, projection=p) for p in ("zemax", "gnomonic", "postel"))
    for other in others:
        assert other.directions == pytest.approx(one.directions, abs=1e-15)


def test_object_heights_are_those_of_the_object(lens):
    heights = ((0.0, 0.0), (0.01, -0.02))
    finite = replace(lens, object_distance=0.4).with_design(field_type="object_height", fields=heights)
    points = object_points(finite, pachon.Request.of(finite).directions)
    assert points[:, :2] == pytest.approx(np.array(heights), abs=1e-16)
    assert points[:, 2] == pytest.approx(0.4, abs=1e-16)


@pytest.mark.parametrize("aiming", ["off", "paraxial", "real"])
@pytest.mark.parametrize("distance", [np.inf, 0.4])
def test_real_image_heights_are_where_chief_rays_land(lens, aiming, distance):
    heights = np.array([(0.0, 0.0), (1e-3, -2e-3), (0.0, 4e-3)])
    telescope = replace(lens, object_distance=distance).with_design(
        field_type="real_image_height", fields=tuple(map(tuple, heights.tolist())), aiming=aiming
    )
    # The search ends at 1e-12 of the largest height; with aiming each chief ray is good to that as well.
    assert landing(telescope) == pytest.approx(heights, abs=1e-13)


def test_paraxial_image_heights_are_the_limit_of_real_ones(lens):
    def stated(kind, size):
        return lens.with_design(field_type=kind, fields=((0.0, size),))

    small = 1e-6
    assert landing(stated("paraxial_image_height", small))[0, 1] == pytest.approx(small, rel=1e-7)
    # Distortion grows with the square of the height.
    large = landing(stated("paraxial_image_height", 1e-3))[0, 1] / 1e-3 - 1.0
    half = landing(stated("paraxial_image_height", 5e-4))[0, 1] / 5e-4 - 1.0
    assert abs(large) > 1e-5
    assert large / half == pytest.approx(4.0, rel=0.1)
    # From the angle: the focal length of a lens whose image is in its focus is its scale.
    assert abs(stop_image(lens).image_scale) == pytest.approx(pachon.first_order(lens).focal_length, rel=0.01)


def test_an_image_height_that_no_chief_ray_reaches_is_said(lens):
    far = lens.with_design(field_type="real_image_height", fields=((0.0, 0.0), (0.0, 0.5)))
    with pytest.raises(DomainError, match=r"field = \(0, 500\) mm on the image: no chief ray of lens1 lands there"):
        pachon.Request.of(far)


def test_vignetting_factors_choose_the_rays_of_their_field(lens):
    """Rays of a vignetted field are those of the points that Zemax's formula makes, launched one by one."""
    factors = ((0.0,) * 5, (0.0, 0.0, 0.2, 0.4, 0.0), (0.1, -0.2, 0.3, 0.5, 0.3))
    telescope = lens.with_design(vignetting=factors)
    request = pachon.Request.of(telescope, n_pupil=2)
    rays = request.launch(request.middle)
    px, py = request.unit_pupil.T
    n, radius = len(px), 0.5 * lens.pupil_diameter
    for i, (dx, dy, cx, cy, angle) in enumerate(factors):
        x, y = dx + (1 - cx) * px, dy + (1 - cy) * py
        x, y = np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y
        expected = pachon.launch_rays(lens, tuple(request.fields[i]), request.middle, (radius * x, radius * y))
        assert rays.position[i * n : (i + 1) * n] == pytest.approx(expected.position, abs=1e-16)
    # Fields that are given have none.
    assert pachon.Request.of(telescope, request.fields).vignetting is None
    # A part of the request has the factors of its fields.
    assert np.array_equal(request.at_fields(slice(1, 3)).vignetting, factors[1:])


@pytest.mark.parametrize("aiming", ["off", "real"])
def test_every_function_has_the_same_rays(lens, aiming):
    """Wavefronts of one field, of many fields and of bundles agree, with vignetting factors and aiming."""
    telescope = lens.with_design(aiming=aiming)
    fields, w = pachon.Request.of(telescope).fields, telescope.default_wavelength
    radius = 0.5 * telescope.pupil_diameter
    x, y = np.array([0.0, 0.3, 0.0, -0.6]) * radius, np.array([0.0, 0.4, 0.9, 0.2]) * radius
    many = pachon.wavefront_opds(telescope, fields, w, (x, y)).value
    bundles = pachon.Request.of(telescope).bundles(w, np.stack([x, y], axis=-1))
    opd = bundles.opd(telescope.reference_sphere_radius)
    for i, field in enumerate(fields):
        one = pachon.wavefront_opd(telescope, tuple(field), w, (x, y))
        # Aimed rays are good to 1e-12 of 3 mm, in a converging beam of f/3.
        assert one.value == pytest.approx(many[i], abs=2e-15 if aiming == "off" else 1e-14)
        assert one.value == pytest.approx(opd[i], abs=2e-15 if aiming == "off" else 1e-14)


def test_zernikes_of_aimed_and_vignetted_fields_are_those_of_their_rays(lens):
    telescope = lens.with_design(aiming="paraxial", vignetting=((0.0,) * 5, (0.0, 0.1, 0.2, 0.4, 0.0), (0.0,) * 5))
    found = pachon.wavefront_zernikes(telescope, jmax=11, n_pupil=6)
    request = pachon.Request.of(telescope, n_pupil=6, one_wavelength=True)
    value = request.bundles(request.wavelength).opd(telescope.reference_sphere_radius)
    # Gauss quadrature: a Zernike coefficient is the weighted mean of the wavefront times the polynomial.
    r2 = (request.unit_pupil**2).sum(axis=1)
    z4 = np.sqrt(3.0) * (2.0 * r2 - 1.0)
    assert found.coefficients[:, 3] == pytest.approx((request.pupil.weights * z4 * value).sum(axis=1), abs=1e-13)


def test_image_heights_need_a_stop_that_is_not_at_the_image(lens):
    at_image = lens.with_design(stop=lens.surface_names[-1], field_type="paraxial_image_height")
    with pytest.raises(DomainError, match="paraxial_image_height: expected a stop that is not at the image"):
        pachon.Request.of(at_image)
