"""Optics interpolated over the field, against rays."""

import numpy as np
import pytest

import pachon
from pachon.raytrace.rays import field_direction
from pachon.wavefront.psf import field_optics as field_optics_module
from pachon.wavefront.psf import statistical
from pachon.wavefront.psf.clear_pupil import SpokePupil, clear_edges
from pachon.wavefront.psf.field_optics import LANDING_ERROR, field_optics
from pachon.wavefront.pupil_optics import trace_pupils

WAVES = (545e-9, 703e-9)
# The last one is beyond the field of view, in the corner of a camera.
FIELDS = np.deg2rad([[0.0, 0.0], [0.52, -0.31], [-1.1, 0.83], [0.2, 1.71], [1.42, 1.41]])
SLOPES = np.tan(FIELDS)


@pytest.fixture(scope="module")
def lsst():
    return pachon.load_telescope("lsst_v3.3_r").perturbed("M2", shift=(3e-4, 0.0, 2e-5), tilt=(2e-5, 1e-5, 0.0))


@pytest.fixture(scope="module")
def plane():
    return pachon.FocalPlane.from_budget("lsst", seed=1)


def spokes(telescope):
    return SpokePupil.fill(telescope.pupil_diameter, telescope.pupil_obscuration, 80)


@pytest.mark.parametrize("rotator_deg", [0.0, 37.0])
def test_optics_are_those_of_rays(lsst, plane, rotator_deg):
    lsst = lsst.with_rotator(np.radians(rotator_deg))
    aberration = pachon.wavefront.ResidualWavefront.draw(lsst, 0.1e-6, 1, 0)
    fields = pachon.fields_at(lsst, plane.camera.centers[::23], WAVES[1])
    optics = field_optics(lsst, WAVES, spokes(lsst))
    for focal_plane, stars in ((plane, fields), (None, FIELDS)):
        interpolated, edges = optics.at(stars, np.tan(stars), focal_plane, aberration, 1)
        traced = trace_pupils(lsst, stars, WAVES, optics.pupil, focal_plane=focal_plane, aberration=aberration)
        for name in ("displacement", "reference_points"):
            np.testing.assert_allclose(getattr(interpolated, name), getattr(traced, name), atol=LANDING_ERROR)
        np.testing.assert_allclose(interpolated.reference_cosines, traced.reference_cosines, atol=1e-9)
        np.testing.assert_allclose(interpolated.jacobian, traced.jacobian, atol=1e-5)
        of_rays = clear_edges(lsst, field_direction(*stars.T), optics.unit, WAVES[1])
        # A squared distance of 1e-8 m^2 at half a metre.
        np.testing.assert_allclose(edges, of_rays, atol=1e-7)
        # Points on the rims themselves are lit or not.
        radius = np.hypot(*optics.pupil.T).reshape(1, -1, len(optics.unit))
        beside = (np.abs(radius[..., None] - edges[:, None]) > 5e-3).all(axis=-1).reshape(len(stars), 1, -1)
        assert (interpolated.lit == traced.lit)[np.broadcast_to(beside, traced.lit.shape)].all()


def test_the_fewest_points_that_engines_take(lsst):
    """Ten points make two rings of four."""
    pupil = SpokePupil.fill(lsst.pupil_diameter, lsst.pupil_obscuration, 10)
    optics = field_optics(lsst, WAVES, pupil)
    np.testing.assert_array_equal(optics.pupil, pupil.points)


def test_any_angle_of_the_rotator_has_the_same_polynomials(lsst):
    tilted = lsst.perturbed(lsst.surfaces[-1].name, tilt=(1e-5, 2e-5, 0.0))
    field_optics_module._field_optics.cache_clear()
    for angle in (0.0, 0.7, -3.0):
        field_optics(lsst.with_rotator(angle), WAVES, spokes(lsst))
    assert field_optics_module._field_optics.cache_info().currsize == 1
    field_optics(tilted, WAVES, spokes(lsst))
    assert field_optics_module._field_optics.cache_info().currsize == 2


def test_a_star_depends_on_no_other(lsst, plane):
    optics = field_optics(lsst, WAVES, spokes(lsst))
    together, edges = optics.at(FIELDS, SLOPES, None, None, 2)
    for star in range(len(FIELDS)):
        alone, of_one = optics.at(FIELDS[star : star + 1], SLOPES[star : star + 1], None, None, 1)
        assert alone.displacement.tobytes() == together.displacement[star].tobytes()
        assert of_one.tobytes() == edges[star].tobytes()


def test_a_star_between_ccds_is_an_error(lsst, plane):
    gap = pachon.fields_at(lsst, plane.camera.centers[:1] + np.array([0.0209, 0.0]))
    with pytest.raises(pachon.errors.DomainError, match="lands between the CCDs"):
        field_optics(lsst, WAVES, spokes(lsst)).at(gap, np.tan(gap), plane, None)


def test_what_is_not_smooth_is_traced(lsst, monkeypatch):
    monkeypatch.setattr(field_optics_module, "LANDING_ERROR", 1e-15)
    assert field_optics_module._field_optics.__wrapped__(lsst, WAVES, 5, 16) is None


@pytest.mark.long
def test_shapes_are_those_of_traced_stars(lsst, monkeypatch):
    air = pachon.Atmosphere.from_site("cerro_pachon", 4, exposure=10.0)

    def shapes():
        return pachon.psf_moments(lsst, FIELDS[:4], WAVES, atmosphere=air, engine="statistical", threads=1)

    interpolated = shapes()
    # Some stars beyond the polynomials, and none within.
    monkeypatch.setattr(field_optics_module, "_REACHES", (0.6,))
    small = field_optics_module._field_optics.__wrapped__(lsst, WAVES, 5, 12)
    monkeypatch.setattr(statistical, "field_optics", lambda *_: small)
    partly = shapes()
    monkeypatch.setattr(statistical, "field_optics", lambda *_: None)
    traced = shapes()
    for moments in (interpolated, partly):
        for name in ("e1", "e2", "g1", "g2"):
            np.testing.assert_allclose(getattr(moments, name), getattr(traced, name), atol=1e-6)
        np.testing.assert_allclose(moments.size, traced.size, rtol=1e-6)
    assert partly.e1[2:].tobytes() == traced.e1[2:].tobytes()
