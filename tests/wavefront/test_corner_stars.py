"""Stars on the corner sensors: where they land, and the telescope with its detector at the height of each."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.raytrace.rays import field_direction
from pachon.wavefront.chief_rays import chief_rays
from pachon.wavefront.pupil_optics import trace_pupils

LSST = pachon.load_telescope("lsst_v3.3_r")


@pytest.mark.parametrize("kind", ["wavefront", "guider"])
def test_chief_rays_land_on_the_sensors(kind):
    stars = pachon.corner_stars(LSST, kind=kind, n=3)
    assert len(stars) == 24
    assert stars.sensors[:4] == (stars.focal_plane.names[0],) * 3 + (stars.focal_plane.names[1],)
    end = chief_rays(LSST, field_direction(*stars.fields.T), LSST.default_wavelength)
    assert end.position[:, :2] == pytest.approx(stars.positions, abs=1e-11)
    index = stars.focal_plane.ccd_at(*stars.positions.T)
    assert [stars.focal_plane.names[i] for i in index] == list(stars.sensors)


@pytest.mark.parametrize("telescope", [LSST, LSST.with_rotator(0.4)], ids=["level", "rotated"])
def test_the_telescope_of_a_star_has_its_detector_where_the_sensor_is(telescope):
    stars = pachon.corner_stars(telescope, heights="lsstcam")
    pupil = np.array([(3.9, 0.0), (0.0, -3.0), (-2.0, 2.5)])
    on_sensors = trace_pupils(telescope, stars.fields, [620e-9], pupil, focal_plane=stars.focal_plane)
    for i in (0, 3, 7):
        moved = trace_pupils(stars.telescope_of(i), stars.fields[i : i + 1], [620e-9], pupil)
        # The tangent planes touch 0.15 mm from each other, where the chief ray meets the nominal plane and the sensor.
        # A sensor whose rim stands 5 um behind its middle turns by 4e-6 over that distance; at the rim of the donut,
        # 0.7 mm away, where rays come in at a slope of 0.5, that is a nanometre or a few.
        assert moved.displacement[0] == pytest.approx(on_sensors.displacement[i], abs=1e-8)
        assert np.hypot(*moved.displacement[0, 0, 0]) > 5e-4


def test_numbers_of_stars_are_checked():
    with pytest.raises(DomainError, match="n = 0: expected a whole number of at least 1"):
        pachon.corner_stars(LSST, n=0)


@pytest.mark.parametrize("name", ["decam", "auxtel"])
def test_telescopes_whose_field_is_smaller_are_refused(name):
    """Eight sensors of the LSST were placed at 1.5 degrees of DECam, whose field ends at 1.25."""
    with pytest.raises(DomainError, match=r"^sensors of the LSST camera up to .* deg from the axis: expected"):
        pachon.corner_stars(pachon.load_telescope(name))
