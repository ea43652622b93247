import numpy as np
import pytest
from astropy import units as u

from pachon.core.errors import ConfigError, DomainError
from pachon.core.plotting import png_bytes
from pachon.design.metrics.distortion import distortion, field_lattice
from pachon.models.first_order import first_order
from pachon.models.io.prescription import load_telescope


def test_a_mirror_with_its_stop_at_the_vertex_has_none(paraboloid):
    result = distortion(paraboloid(2.0, 20.0))
    # The chief ray is reflected at the vertex: r = f tan(theta), exactly.
    assert result.focal_length == pytest.approx(2.0, rel=1e-12)
    assert result.axis_focal_length == pytest.approx(2.0, rel=1e-9)
    assert np.nanmax(np.abs(result.percent)) < 1e-9
    assert np.linalg.norm(result.shift, axis=-1).max() < 1e-14
    assert png_bytes(result.plot()).startswith(b"\x89PNG")


def test_a_stop_in_front_of_a_mirror_distorts_as_a_traced_ray_says(paraboloid):
    focal_length, stop = 2.0, 1.5
    angles = np.deg2rad([0.1, 0.3, 0.5])
    fields = np.concatenate(
        [np.stack([angles * np.cos(t), angles * np.sin(t)], -1) for t in (0.0, 2 * np.pi / 3, 4 * np.pi / 3)]
    )
    result = distortion(paraboloid(focal_length, 20.0, stop_z=stop), fields, projection="gnomonic")
    landing = []
    for slope in angles:
        # From (stop, 0) with this slope to y^2 / 4f = z, reflected there, on to z = f; in a plane with the axis.
        y = np.roots([slope / (4 * focal_length), 1.0, -slope * stop])
        y = y[np.argmin(np.abs(y))]
        normal = np.array([-y / (2 * focal_length), 1.0])
        light = np.array([slope, -1.0])
        back = light - 2 * (light @ normal) / (normal @ normal) * normal
        landing.append(y + (focal_length - y**2 / (4 * focal_length)) * back[0] / back[1])
    assert np.linalg.norm(result.position, axis=-1) == pytest.approx(np.tile(np.abs(landing), 3), rel=1e-12)
    scale = (np.abs(landing) * angles).sum() / (angles**2).sum()
    assert result.focal_length == pytest.approx(scale, rel=1e-12)
    expected = 100 * (np.abs(landing) / (scale * angles) - 1)
    assert result.percent == pytest.approx(np.tile(expected, 3), abs=1e-9)
    axis = 100 * (np.abs(landing) / (focal_length * angles) - 1)
    assert result.percent_of_axis_scale == pytest.approx(np.tile(axis, 3), abs=1e-6)


@pytest.mark.parametrize("band", ["g", "r", "y"])
def test_the_lsst_stays_below_a_tenth_of_a_per_cent(band):
    telescope = load_telescope(f"lsst_v3.3_{band}")
    for reference in ("chief", "centroid"):
        result = distortion(telescope, field_lattice(telescope, 9), reference=reference, sampling="rings")
        summary = result.summary()
        assert summary["largest_percent"] < 0.1
        assert summary["largest_percent_of_axis_scale"] < 0.1
        # A lattice out to 1.75 deg; the edge is 0.086 % larger than the axis.
        assert summary["largest_percent_of_axis_scale"] == pytest.approx(0.086, abs=0.004)
    assert result.axis_focal_length == pytest.approx(first_order(telescope).focal_length, rel=1e-4)


def test_a_turned_or_shifted_detector_is_no_distortion(lsst_r):
    fields = field_lattice(lsst_r, 7)
    plain = distortion(lsst_r, fields)
    turned = distortion(lsst_r.perturbed("Detector", shift=(1e-3, -2e-3, 0.0), tilt=(0.0, 0.0, 0.7)), fields)
    assert turned.percent == pytest.approx(plain.percent, abs=1e-8, nan_ok=True)
    assert turned.focal_length == pytest.approx(plain.focal_length, rel=1e-12)
    # In the detector's own axes, the axis lies the other way.
    c, s = np.cos(0.7), np.sin(0.7)
    assert turned.center == pytest.approx(np.array([[c, s], [-s, c]]) @ [-1e-3, 2e-3], abs=1e-12)


def test_landing_points_are_those_of_batoid(lsst_r):
    batoid = pytest.importorskip("batoid")
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    fields = np.deg2rad([[0.0, 0.0], [1.0, 0.2], [-0.4, 1.6], [1.2, -1.2]])
    result = distortion(lsst_r, fields, 622e-9)
    for field, position in zip(fields, result.position, strict=True):
        ray = batoid.RayVector.fromStop(
            0.0, 0.0, optic=optic, wavelength=622e-9, theta_x=field[0], theta_y=field[1], projection="zemax"
        )
        optic.trace(ray)
        assert position == pytest.approx(ray.r[0, :2], abs=1e-13)


def test_pictures_of_scattered_fields(lsst_r):
    result = distortion(lsst_r, [[0.0, 0.0], [1.0, 0.3], [-0.5, 1.1], [0.2, -1.3]] * u.deg)
    assert png_bytes(result.plot()).startswith(b"\x89PNG")


def test_bad_input_is_refused(lsst_r):
    with pytest.raises(DomainError, match="at least three points that are not on a line"):
        distortion(lsst_r, np.deg2rad([[0.0, 0.0], [0.0, 0.5], [0.0, 1.0]]))
    with pytest.raises(ConfigError, match="reference = 'spot'"):
        distortion(lsst_r, reference="spot")
    with pytest.raises(DomainError, match="across = 4: expected an odd"):
        field_lattice(lsst_r, 4)


def test_shifts_of_fields_off_any_lattice_are_lines_from_where_they_are_predicted(lsst_r):
    result = distortion(lsst_r, np.deg2rad([[0.0, 0.0], [1.0, 0.3], [-0.5, 1.1], [0.2, -1.3]]))
    (lines,) = result.plot().axes[0].collections
    start, end = np.moveaxis(np.array(lines.get_segments()), 1, 0)
    assert start == pytest.approx(1e3 * result.predicted)
    drawn = (end - start) / (1e3 * result.shift)
    assert drawn == pytest.approx(np.full_like(drawn, drawn[0, 0]))
