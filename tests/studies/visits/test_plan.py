import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.pipeline.config import Configuration, with_options
from pachon.studies.visits.config import STACK_STAMP, VisitsConfig
from pachon.studies.visits.plan import Visit, plan_visits
from pachon.studies.visits.psf_visit import StackFrame
from pachon.studies.visits.sky_points import draw_points

LIGHT = 620e-9


def test_positions_are_those_of_the_world_coordinates_of_a_ccd(lsst_r):
    # Both know the telescope from its rays alone; world coordinates are fitted, to a thousandth of an arcsecond.
    camera = pachon.FocalPlane.flat().camera
    for ccd in ("R22_S11", "R34_S12"):
        wcs = pachon.ccd_wcs(lsst_r, camera, ccd, position_angle=0.7, wavelength=LIGHT)
        pixels = np.array([[10.0, 20.0], [3000.0, 500.0], [2000.0, 4000.0]])
        found = Visit(1, 1, roll=0.7).on_detector(lsst_r, wcs.to_sky(pixels), LIGHT)
        # The pixels' x and y run along y and x of the focal plane: 4096 and 4004 of them.
        from_middle = (found - camera.centers[camera.ccd_index(ccd)])[:, ::-1]
        np.testing.assert_allclose(from_middle / camera.pixel_size + [2047.5, 2001.5], pixels, atol=0.006)


def test_a_visit_points_where_it_says(lsst_r):
    visit = Visit(1, 1, roll=2.0, pointing=(0.01, -0.02))
    np.testing.assert_allclose(visit.matrix @ visit.matrix.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(visit.matrix) == pytest.approx(1.0)
    center = visit.on_detector(lsst_r, np.array([visit.pointing]), LIGHT)
    np.testing.assert_allclose(center, 0.0, atol=1e-12)


def test_the_roll_is_the_position_angle_of_y():
    visit = Visit(1, 1, roll=np.deg2rad(30.0))
    # A source towards +y of the telescope lies 30 degrees from north through east.
    sky = 1e-3 * np.array([[np.sin(visit.roll), np.cos(visit.roll)]])
    x, y, _ = -visit.directions(sky)[0]
    assert y > 0.0
    assert x == pytest.approx(0.0, abs=1e-18)


def test_jacobians_are_differences_of_positions(lsst_r):
    visit = Visit(3, 3, 0.7, (0.01, -0.004))
    sky = np.random.default_rng(0).uniform(-0.015, 0.015, (5, 2)) + visit.pointing
    found, step = visit.jacobians(lsst_r, sky, LIGHT), 1e-4
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        ends = [visit.on_detector(lsst_r, sky + sign * shift, LIGHT) for sign in (1, -1)]
        np.testing.assert_allclose(found[:, :, axis], (ends[0] - ends[1]) / (2 * step), atol=1e-6)


def test_a_visit_does_not_depend_on_how_many_follow():
    few, many = plan_visits(3, 5, dither=0.01), plan_visits(40, 5, dither=0.01)
    assert many[:3] == few
    assert few[0] == Visit(0, 0)
    assert [v.epoch for v in plan_visits(3, 5, first_epoch=7)] == [7, 8, 9]
    radius = np.array([np.hypot(*v.pointing) for v in many[1:]])
    assert radius.max() < 0.01
    # Even over the disc: the mean of the squares is half that of the radius, 12 % for 39 visits.
    assert np.mean(radius**2) / 0.01**2 == pytest.approx(0.5, abs=0.15)
    assert {v.roll for v in plan_visits(3, 6)[1:]}.isdisjoint(v.roll for v in few)


@pytest.mark.parametrize(("count", "dither", "named"), [(0, 0.0, "visits = 0"), (2, 0.2, "dither = 11.4592 deg")])
def test_plans_that_cannot_be(count, dither, named):
    with pytest.raises(DomainError, match=named):
        plan_visits(count, 1, dither=dither)


def test_points_of_the_sky_do_not_depend_on_its_size():
    small, large = (draw_points(3, radius, 0.004, 10, 6) for radius in (0.006, 0.011))
    within = np.hypot(*large.sky.T) <= 0.006
    assert set(map(tuple, small.sky)) == set(map(tuple, large.sky[within]))
    assert len(large) == pytest.approx(16 * np.pi * (0.011 / 0.004) ** 2, rel=0.1)
    assert large.star.mean() == pytest.approx(10 / 16, abs=0.03)
    assert np.isnan(large.quantile[~large.star]).all()
    # More stars leave the first ones, and all places, where they were.
    more = draw_points(3, 0.006, 0.004, 12, 6)
    assert set(map(tuple, small.sky)) <= set(map(tuple, more.sky))


def test_angles_are_drawn_or_listed():
    plain, drawn = plan_visits(40, 5, dither=0.01), plan_visits(40, 5, dither=0.01, rotators_deg="random")
    # Rolls and pointings are those without a rotator.
    assert [(v.roll, v.pointing, v.epoch) for v in drawn] == [(v.roll, v.pointing, v.epoch) for v in plain]
    assert drawn[0].rotator_deg is None
    angles = np.array([v.rotator_deg for v in drawn[1:]])
    # Even over +-90 degrees: the rms is 90 / sqrt(3) = 52, to 10 % for 39 visits.
    assert np.abs(angles).max() < 90.0
    assert angles.std() == pytest.approx(52.0, rel=0.2)
    few = plan_visits(3, 5, rotators_deg="random", rotator_limit_deg=10.0)
    assert [v.rotator_deg for v in few[1:]] == pytest.approx(angles[:2] / 9.0)
    listed = plan_visits(2, 5, rolls_deg=[0.0, 30.0, 60.0], rotators_deg=[-20.0, 45.0])
    assert [v.rotator_deg for v in listed] == [-20.0, 45.0]
    assert [v.roll for v in listed] == pytest.approx([0.0, np.pi / 6])
    with pytest.raises(DomainError, match=r"^rotator_deg: 2 angles for 3 visits, expected one for each$"):
        plan_visits(3, 5, rotators_deg=[1.0, 2.0])


def test_a_camera_turned_back_by_the_roll_stands_still_on_the_sky(lsst_r):
    sky = np.random.default_rng(2).uniform(-0.01, 0.01, (6, 2))
    still = Visit(0, 0).on_detector(lsst_r, sky, LIGHT)
    turned = Visit(1, 1, roll=np.deg2rad(25.0), rotator_deg=25.0)
    found = turned.on_detector(lsst_r.with_rotator(np.deg2rad(turned.rotator_deg)), sky, LIGHT)
    np.testing.assert_allclose(found, still, atol=1e-9)


@pytest.mark.parametrize(
    ("telescope", "ccds"),
    [
        (None, tuple(f"R22_S{i}{j}" for i in range(3) for j in range(3))),
        ("hsc", ("hsc034", "hsc041", "hsc042", "hsc049", "hsc050", "hsc057", "hsc058", "hsc065", "hsc066")),
        ("decam", ("S3", "S4", "S5", "S10", "S11", "N3", "N4", "N10", "N11")),
        ("auxtel", ("RXX_S00",)),
    ],
)
def test_visits_of_every_camera_have_the_ccds_in_its_middle(telescope, ccds):
    # Those of the LSST's raft R22 were asked of every camera.
    assert VisitsConfig(run=Configuration(telescope=telescope)).experiment().config.ccds == ccds


def test_stamps_cover_the_same_angle_on_every_camera():
    # 49 and 31 pixels of AuxTel are 4.7 and 3.0 arcsec of the 9.8 and 6.2 of the LSST.
    for telescope, in_visits, in_stacks in ((None, 49, 31), ("auxtel", 103, 65), ("decam", 49, 31)):
        experiment = VisitsConfig(run=Configuration(telescope=telescope)).experiment()
        assert (experiment.config.psf.stamp, StackFrame.of(experiment, STACK_STAMP).size) == (in_visits, in_stacks)
    given = VisitsConfig(run=with_options(Configuration(telescope="auxtel"), psf__stamp=61))
    assert given.experiment().config.psf.stamp == 61
