"""Ray aiming: rays reach the stop where they should, in Zemax's sense, against a root finder ray by ray."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import root

import pachon
from pachon.core.errors import ConfigError, DomainError, PrescriptionError
from pachon.models.design_data import DesignData
from pachon.models.io.prescription import load_telescope
from pachon.raytrace.aiming import stop_of
from pachon.raytrace.rays import Rays
from pachon.raytrace.smooth_pupil import FEWEST, pupil_nodes, smooth_pupil

DATA = Path(__file__).parents[1] / "data" / "zmx"
WIDE = DATA / "circular_aperture_example_with_aperture.zmx"
PUPIL = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -1.0], [0.8, 0.0], [-0.5, 0.6]])


@pytest.fixture(scope="module")
def wide():
    return load_telescope(WIDE)


def at_stop(telescope, rays):
    """Where rays meet the stop, x and y in its own frame [m]."""
    index = telescope.surface_names.index(telescope.design_data.stop)
    met = pachon.trace(telescope, rays, "all", threads=1)[index]
    return telescope.surfaces[index].to_local(met.position)[:, :2]


def launched(telescope, field, points):
    radius = 0.5 * telescope.pupil_diameter
    return pachon.launch_rays(telescope, field, telescope.default_wavelength, tuple(radius * points.T))


@pytest.mark.parametrize("aiming", ["paraxial", "real"])
@pytest.mark.parametrize("degrees", [(0.0, 0.0), (0.0, 35.0), (0.0, 50.0), (-20.0, 30.0)])
def test_rays_of_a_wide_angle_lens_fill_the_stop(wide, degrees, aiming):
    telescope = wide.with_design(aiming=aiming)
    rays = launched(telescope, np.deg2rad(degrees), PUPIL)
    # Broyden's method ends at 1e-12 of the radius of the stop, some 10 mm.
    assert at_stop(telescope, rays) == pytest.approx(stop_of(telescope).radius * PUPIL, abs=2e-14)
    # The light of a star is parallel whatever is aimed at.
    slopes = np.tan(np.deg2rad(degrees))
    assert rays.direction[:, :2] / -rays.direction[:, 2:] == pytest.approx(np.tile(slopes, (5, 1)), abs=1e-14)


def test_the_radius_of_the_stop_is_that_of_the_paraxial_or_the_real_marginal_ray(wide):
    off = wide.with_design(aiming="off")
    rim = at_stop(off, launched(off, (0.0, 0.0), np.array([[0.0, 1.0]])))[0, 1]
    assert stop_of(wide.with_design(aiming="real")).radius == pytest.approx(rim, rel=1e-12)
    # Near the axis real rays are paraxial: the error falls as the square of the height.
    small = 1e-4
    near = at_stop(off, launched(off, (0.0, 0.0), np.array([[0.0, small]])))[0, 1] / small
    assert stop_of(wide).radius == pytest.approx(near, rel=1e-8)
    assert abs(rim / near - 1.0) > 1e-3
    stated = wide.with_design(aperture="stop", aperture_value=4e-3, aiming="real")
    assert stop_of(stated).radius == 4e-3


@pytest.mark.long
def test_aimed_rays_are_those_of_a_root_finder(wide):
    """Brute force: scipy's root per ray, on the plane of the entrance pupil, of the un-aimed lens."""
    field = np.deg2rad((10.0, 33.0))
    aimed = launched(wide, field, PUPIL)
    plain = wide.with_design(aiming="off")
    for point, position in zip(PUPIL, aimed.position, strict=True):

        def miss(q, point=point):
            rays = launched(plain, field, np.array([q]))
            return (at_stop(plain, rays)[0] - stop_of(wide).radius * point) * 1e3

        found = root(miss, [0.3, 0.8] + 0.9 * point, tol=1e-11)
        assert np.abs(found.fun).max() < 1e-10
        # Rays are parallel: the difference across the beam counts.
        start = launched(plain, field, found.x[None])
        assert position == pytest.approx(start.position[0], abs=1e-12)


def test_a_batch_may_be_split(wide):
    field = np.deg2rad((0.0, 47.0))
    together = launched(wide, field, PUPIL)
    one = [launched(wide, field, PUPIL[i : i + 1]) for i in range(len(PUPIL))]
    assert np.array_equal(together.position, np.concatenate([rays.position for rays in one]))


def test_without_aiming_nothing_changes(wide):
    """Points of the plane of the entrance pupil, to the last bit, for a telescope without design data too."""
    bare = replace(wide, design_data=DesignData())
    for telescope in (bare, wide.with_design(aiming="off")):
        rays = launched(telescope, (0.0, 0.2), PUPIL)
        assert isinstance(rays, Rays)
        down = rays.position + rays.direction * ((telescope.stop_z - rays.position[:, 2:]) / rays.direction[:, 2:])
        assert down[:, :2] == pytest.approx(0.5 * telescope.pupil_diameter * PUPIL, abs=1e-15)
    assert np.array_equal(launched(bare, (0.0, 0.2), PUPIL).position, rays.position)


def test_the_stop_behind_a_lens_of_a_finite_object():
    """One thin-ish lens, the object 300 mm in front: rays start at the object and fill the stop behind the lens."""
    telescope = replace(load_telescope(DATA / "lens1.zmx"), object_distance=0.3).with_design(aiming="real")
    for ty in (0.0, 0.1, 0.2):
        rays = launched(telescope, (0.0, ty), PUPIL)
        assert np.ptp(rays.position, axis=0).max() == 0
        assert rays.position[0, 1] == pytest.approx(-np.tan(ty) * (0.3 - telescope.stop_z), abs=1e-15)
        assert at_stop(telescope, rays) == pytest.approx(stop_of(telescope).radius * PUPIL, abs=1e-14)


def test_a_mirror_in_front_of_the_stop_keeps_the_sense_of_the_pupil():
    """Aimed rays go to the rays without aiming as the pupil becomes small: none is turned round."""
    telescope = load_telescope(DATA / "lens1.zmx")
    assert telescope.design_data.stop is not None
    aimed = launched(telescope.with_design(aiming="paraxial"), (0.0, 0.0), 1e-3 * PUPIL)
    plain = launched(telescope, (0.0, 0.0), 1e-3 * PUPIL)
    assert aimed.position == pytest.approx(plain.position, abs=1e-10)


def test_a_field_that_no_ray_can_reach_is_said():
    telescope = replace(load_telescope(DATA / "lens1.zmx"), field_limit=np.deg2rad(84.0))
    field = np.deg2rad((0.0, 40.0))
    # Brute force: rays all over the plane of the pupil, of which none comes to the stop at all.
    y = np.linspace(-40.0, 40.0, 40001)
    reached = at_stop(telescope, launched(telescope, field, np.stack([0 * y, y], axis=-1)))[:, 1]
    assert np.isnan(reached).all()
    with pytest.raises(
        DomainError, match=r"field = \(0, 40\) deg: no ray from this field reaches its point of the stop"
    ):
        launched(telescope.with_design(aiming="paraxial"), field, PUPIL)


def test_a_stop_that_cannot_be_found_is_said(wide):
    with pytest.raises(PrescriptionError, match=r"stop = 'S99': expected the name of a surface, such as 'S1'"):
        wide.with_design(stop="S99")
    with pytest.raises(PrescriptionError, match="aiming = 'real': expected a surface that is the stop"):
        wide.with_design(stop=None, aiming="real")
    with pytest.raises(PrescriptionError, match="aiming = 'true': expected one of off, paraxial, real"):
        wide.with_design(aiming="true")
    with pytest.raises(PrescriptionError, match="aiming = 'paraxial': expected a surface that is the stop"):
        pachon.load_telescope("auxtel").with_design(aiming="paraxial")
    with pytest.raises(
        ConfigError, match=r"aiming: no argument of Request\.of; expected telescope=telescope\.with_des"
    ):
        pachon.Request.of(wide, aiming="paraxial")


@pytest.mark.long
@pytest.mark.parametrize(("degrees", "aiming"), [((0.0, 50.0), "paraxial"), ((-20.0, 30.0), "real")])
def test_very_many_rays_are_those_found_one_by_one(wide, degrees, aiming):
    """A polynomial and one step of Newton's method, against the search ray by ray."""
    telescope = wide.with_design(aiming=aiming)
    angle = np.arange(FEWEST) * 2.399963
    points = (np.sqrt((np.arange(FEWEST) + 0.5) / FEWEST) * [np.cos(angle), np.sin(angle)]).T
    many, field = launched(telescope, np.deg2rad(degrees), points), np.deg2rad(degrees)
    some = np.arange(0, FEWEST, 97)
    assert at_stop(telescope, many) == pytest.approx(stop_of(telescope).radius * points, abs=2e-14)
    few = launched(telescope, field, points[some])
    assert many.position[some] == pytest.approx(few.position, abs=1e-13)


def test_rays_that_polynomials_do_not_find_are_searched_for():
    """A map with a fold outside the unit disk: found within it; beyond, what the search says."""

    def stop(points):
        # x - x^3 / 6 folds at x = sqrt(2).
        return np.stack([points[:, 0] - points[:, 0] ** 3 / 6.0, points[:, 1]], axis=-1)

    asked = []

    def search(target):
        asked.append(len(target))
        found = np.array([[min(np.roots([-1 / 6, 0, 1, -x]).real, key=abs), y] for x, y in target])
        found[np.abs(target[:, 0]) > 0.9] = np.nan
        return found

    x = np.linspace(-0.94, 0.94, 1001)
    target = np.stack([x, 0.1 * x], axis=-1)
    points = smooth_pupil(target, search(pupil_nodes(target)), stop, search)
    known = np.isfinite(points[:, 0])
    assert stop(points[known]) == pytest.approx(target[known], abs=1e-13)
    assert known[np.abs(x) <= 0.9].all()
    # The nodes, and what Newton's method has not found: far from every ray.
    assert sum(asked[1:]) < 100
