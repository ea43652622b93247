"""The corner rafts: places and heights of wavefront sensors and guiders against metrology of the camera as built."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError
from pachon.models.camera.cameras import load_camera
from pachon.models.camera.corner_rafts import WAVEFRONT_OFFSET, corner_focal_plane

KINDS = ("wavefront", "guider")


@pytest.mark.parametrize("kind", KINDS)
def test_sensors_stand_where_metrology_has_them(kind):
    measured = {s.name: s.center for s in pachon.models.corner_sensors("lsstcam") if s.kind == kind}
    camera = corner_focal_plane(kind).camera
    assert sorted(camera.ccd_names) == sorted(measured)
    assert list(camera.ccd_names) == sorted(camera.ccd_names)
    for name, center in zip(camera.ccd_names, camera.centers, strict=True):
        assert center == pytest.approx(measured[name], abs=1e-9)  # the table has its places in 0.1 um


@pytest.mark.parametrize("kind", KINDS)
def test_sensors_do_not_overlap_and_lie_beside_the_mosaic(kind):
    camera, mosaic = load_camera(f"lsst_{kind}"), pachon.lsst_camera()
    corners = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]) * (0.5 * camera.shortest_side)
    for i, center in enumerate(camera.centers):
        apart = np.abs(np.delete(camera.centers, i, axis=0) - center).max(axis=1)
        assert apart.min() > camera.shortest_side
        assert (mosaic.ccd_at(*(center + corners).T) < 0).all()


def test_nominal_halves_stand_on_either_side_of_the_focus():
    plane = corner_focal_plane()
    for name, height in zip(plane.names, plane.height(*plane.camera.centers.T), strict=True):
        assert height == {"SW0": WAVEFRONT_OFFSET, "SW1": -WAVEFRONT_OFFSET}[name[4:]]
    assert not plane.measured.any()
    guiders = corner_focal_plane("guider")
    assert not guiders.height(*guiders.camera.centers.T).any()


@pytest.mark.parametrize("kind", KINDS)
def test_measured_heights_are_those_of_each_sensor(kind):
    plane = corner_focal_plane(kind, "lsstcam")
    assert plane.measured.all()
    rng = np.random.default_rng(3)
    for sensor in pachon.models.corner_sensors("lsstcam"):
        if sensor.kind == kind:
            # Within the squares and the measured part.
            reach = np.minimum((0.5 * plane.camera.shortest_side), np.array(sensor.half_size)) - 0.5e-3
            x, y = (sensor.center + reach * rng.uniform(-1.0, 1.0, (20, 2))).T
            assert plane.height(x, y) == pytest.approx(sensor.height(x, y), abs=1e-12)


def test_unknown_kinds_and_heights_are_refused():
    with pytest.raises(ConfigError, match="kind = 'donut': expected one of wavefront, guider"):
        corner_focal_plane("donut")
    with pytest.raises(ConfigError, match="heights = 'lsst': expected one of nominal, lsstcam"):
        corner_focal_plane(heights="lsst")
