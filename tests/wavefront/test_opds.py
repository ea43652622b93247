"""Maps of many fields at once against maps of single fields, for which all rays are traced and stored."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.models.shapes.mesh import MeshSurface
from pachon.models.shapes.polynomial import ZernikeSag

# Rounding of 30 m of path, in two orders of the last sums.
ROUNDING = 1e-13


def field_disc(n, radius_deg=1.75, seed=0):
    rng = np.random.default_rng(seed)
    radius, angle = np.deg2rad(radius_deg) * np.sqrt(rng.uniform(0, 1, n)), rng.uniform(0, 2 * np.pi, n)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def assert_same(telescope, fields, **options):
    maps = pachon.wavefront_opds(telescope, fields, 620e-9, **options)
    assert len(maps) == len(fields)
    for i, field in enumerate(fields):
        one = pachon.wavefront_opd(telescope, field, 620e-9, **options)
        assert np.array_equal(one.lit, maps.lit[i])
        assert np.allclose(one.value, maps.value[i], rtol=0, atol=ROUNDING, equal_nan=True)
        assert np.allclose(one.center, maps.centers[i], rtol=0, atol=1e-14)
        assert np.isclose(one.rms, maps.rms[i], rtol=0, atol=ROUNDING)
        assert one.radius == maps.radius
    assert np.array_equal(one.x, maps.x)
    assert np.array_equal(one.y, maps.y)
    return maps


@pytest.mark.long
def test_maps_equal_those_of_single_fields(lsst_r):
    maps = assert_same(lsst_r, field_disc(6), grid=21)
    # Part of the pupil is lit, and vignetting differs from field to field.
    assert len(set(maps.lit.sum(axis=(1, 2)))) > 1
    assert np.allclose(maps.waves, maps.value / 620e-9, equal_nan=True)


@pytest.mark.long
def test_a_disturbed_telescope_and_any_pupil_points(lsst_r, annulus_points):
    tilted = lsst_r.perturbed("Camera", shift=(1e-3, 0, 1e-4), tilt=(1e-3, -2e-3, 0.3))
    tilted = tilted.with_deformation("M1", ZernikeSag((0, 0, 0, 0, 1e-7), 4.18, 2.558))
    tilted = replace(tilted, reference_sphere_radius=3.0)
    assert_same(tilted, field_disc(3), pupil=annulus_points(70), projection="postel")


def test_ccds_at_their_heights(lsst_r):
    focal_plane = pachon.FocalPlane.from_budget("lsst", seed=2)
    fields = pachon.fields_at(lsst_r, [[0.0, 0.0], [0.131, 0.21], [-0.09, 0.044]])
    maps = assert_same(lsst_r, fields, grid=15, focal_plane=focal_plane)
    flat = pachon.wavefront_opds(lsst_r, fields, 620e-9, grid=15)
    assert np.nanmax(np.abs(maps.value - flat.value)) > 1e-8


@pytest.mark.parametrize("model", ["rubin_v3.14_r", "lsst_v3.3_r_obstructed", "hsc"])
def test_deformations_vanes_and_baffles(model):
    telescope = pachon.load_telescope(model)
    assert_same(telescope, field_disc(2, 0.5), grid=17)


def test_a_near_object(lsst_r):
    assert_same(dataclasses.replace(lsst_r, object_distance=1000.0), field_disc(2), grid=15)


def test_a_telescope_without_apertures(lsst_r):
    bare = dataclasses.replace(
        lsst_r, surfaces=tuple(dataclasses.replace(s, aperture=None) for s in lsst_r.surfaces), obstructions=()
    )
    # From inside the pupil, so that all light arrives.
    maps = assert_same(bare, field_disc(2), pupil=([0.0, 1.0, 2.0], [0.5, 0.0, -1.0]))
    assert maps.lit.all()


@pytest.mark.long
def test_neither_batches_nor_threads_matter(lsst_r):
    fields, done = field_disc(5), []
    # Of a million points a batch holds a few fields only.
    together = pachon.wavefront_opds(lsst_r, fields, 620e-9, grid=1024, threads=3, progress=done.append)
    assert len(done) > 1
    assert sum(done) == len(fields)
    last = pachon.wavefront_opds(lsst_r, fields[-2:], 620e-9, grid=1024, threads=1)
    assert np.array_equal(last.value, together.value[-2:], equal_nan=True)


def test_a_dark_map_has_no_rms(lsst_r):
    # In the shadow of the hole of M1 no light passes at all.
    maps = pachon.wavefront_opds(lsst_r, (0.0, 0.01), 620e-9, ([0.0, 0.5], [0.1, 0.0]))
    assert np.isnan(maps.value).all()
    assert np.isnan(maps.rms).all()
    assert maps.fields.shape == (1, 2)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (dict(fields=[[0.0, 0.0, 0.0]]), DomainError, r"fields of shape \(1, 3\)"),
        (dict(fields=[[0.0, 0.0], [0.1, 0.0]]), DomainError, "2.5 deg"),
        (dict(wavelength=5e-6), DomainError, "wavelength = 5000 nm"),
        (dict(grid=8, pupil=([3.0], [0.0])), ConfigError, "one of them"),
        (dict(sphere_radius=1.0), ConfigError, "telescope=replace.telescope, reference_sphere_radius="),
        (dict(projection="mercator"), ConfigError, "projection"),
    ],
)
def test_bad_arguments(lsst_r, change, error, words):
    with pytest.raises(error, match=words):
        pachon.wavefront_opds(lsst_r, **(dict(fields=[[0.0, 0.0]], wavelength=620e-9) | change))


def test_a_chief_ray_between_ccds_is_named(lsst_r):
    focal_plane = pachon.FocalPlane.flat("lsst")
    # Half a raft and half a gap from the centre, along x.
    gap = pachon.fields_at(lsst_r, [[0.0635, 0.0]])
    with pytest.raises(DomainError, match=r"field = \(\S+, \S+\) deg: the chief ray lands between the CCDs"):
        pachon.wavefront_opds(lsst_r, np.concatenate([[[0.0, 0.0]], gap]), 620e-9, grid=4, focal_plane=focal_plane)


def test_a_lost_chief_ray_is_named(lsst_r):
    tilted = lsst_r.perturbed("M2", tilt=(0.5, 0.0, 0.0))
    with pytest.raises(DomainError, match=r"field = \(0, 0\) deg: the chief ray does not reach the image"):
        pachon.wavefront_opds(tilted, [[0.0, 0.0]], 620e-9, grid=4)


def test_a_mesh_before_the_first_aperture(lsst_r):
    """The part up to the first aperture, traced beforehand, has the facets of the whole telescope."""
    m1 = lsst_r.surface("M1")
    u = np.linspace(-4.4, 4.4, 81)
    x, y = (v.ravel() for v in np.meshgrid(u, u))
    corner = (np.arange(80)[:, None] * 81 + np.arange(80)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 82], corner[:, None] + [0, 82, 81]])
    mesh = MeshSurface(np.stack([x, y, m1.shape.sag(x, y)], axis=-1), faces, smooth=True)
    faceted = lsst_r.with_shape("M1", mesh)
    open_m1 = tuple(dataclasses.replace(s, aperture=None) if s.name == "M1" else s for s in faceted.surfaces)
    maps = assert_same(dataclasses.replace(faceted, surfaces=open_m1), field_disc(2), grid=15)
    assert maps.lit.any()
