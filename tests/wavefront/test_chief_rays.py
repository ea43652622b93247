"""Field angles of detector positions: the chief ray of each must land there."""

import dataclasses

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.raytrace.rays import field_angles, field_direction

POSITIONS = np.array([[0.0, 0.0], [0.21, 0.15], [-0.12, 0.25], [0.3, -0.02], [-0.001, 0.002]])


def landing(telescope, fields, projection):
    """Landing points of the chief rays of field angles, x and y of the detector."""
    ends = [
        pachon.trace(
            telescope, pachon.launch_rays(telescope, f, telescope.default_wavelength, ([0.0], [0.0]), projection)
        )
        for f in fields
    ]
    return telescope.surfaces[-1].to_local(np.concatenate([end.position for end in ends]))[:, :2]


@pytest.mark.parametrize("projection", ["zemax", "gnomonic", "postel"])
def test_chief_rays_land_at_the_positions(lsst_r, projection):
    fields = pachon.fields_at(lsst_r, POSITIONS, projection=projection)
    assert np.abs(landing(lsst_r, fields, projection) - POSITIONS).max() < 1e-12


@pytest.mark.parametrize("angle", [30.0, 45.0, 90.0, 137.0, 180.0, -60.0])
def test_a_rotated_detector(lsst_r, angle):
    rotated = lsst_r.perturbed("Detector", tilt=(0.0, 0.0, np.deg2rad(angle)))
    fields = pachon.fields_at(rotated, POSITIONS)
    assert np.abs(landing(rotated, fields, "zemax") - POSITIONS).max() < 1e-12
    # The same field points as those of the unrotated detector, at the positions in the telescope's own x and y.
    there = POSITIONS @ rotated.surfaces[-1].matrix[:2, :2].T
    assert np.abs(fields - pachon.fields_at(lsst_r, there)).max() < 1e-14


@pytest.mark.parametrize("angle", [0.0, 30.0, 137.0])
def test_a_shifted_and_tilted_camera(lsst_r, angle):
    tilt = (2e-3, -3e-3, np.deg2rad(angle))
    moved = lsst_r.perturbed("Camera", tilt=tilt).perturbed(
        "Detector", shift=(2e-3, -1e-3, 1e-4), tilt=(1e-3, 0.0, 0.0)
    )
    fields = pachon.fields_at(moved, POSITIONS, projection="gnomonic")
    assert np.abs(landing(moved, fields, "gnomonic") - POSITIONS).max() < 1e-12


def test_points_outside_the_field_are_refused(lsst_r):
    for telescope in (lsst_r, lsst_r.perturbed("Detector", tilt=(0.0, 0.0, 1.0))):
        with pytest.raises(DomainError, match="outside the field"):
            pachon.fields_at(telescope, [[3.0, 0.0]])


def test_an_image_that_does_not_move_is_refused(lsst_r):
    # A focal length of zero: all chief rays meet where the centre of the pupil lies.
    surfaces = (dataclasses.replace(lsst_r.surfaces[-1], vertex=(0.0, 0.0, lsst_r.stop_z)),)
    blind = dataclasses.replace(lsst_r, surfaces=surfaces, group_frames={}, groups={})
    with pytest.raises(DomainError, match="no chief ray that lands there was found"):
        pachon.fields_at(blind, [[0.1, 0.0]])


def test_an_unknown_projection_is_refused(lsst_r):
    with pytest.raises(ConfigError, match="projection = 'gnomic': expected one of zemax, gnomonic, postel"):
        pachon.fields_at(lsst_r, POSITIONS, projection="gnomic")


@pytest.mark.parametrize("projection", ["zemax", "gnomonic", "postel"])
def test_field_angles_invert_field_direction(projection):
    angles = np.array([[0.0, 0.0], [0.01, -0.03], [0.2, 0.1]])
    light = field_direction(angles[:, 0], angles[:, 1], projection)
    # Rounding of sines and tangents of angles of order one.
    assert np.abs(field_angles(light[:, :2] / -light[:, 2:], projection) - angles).max() < 1e-15
