"""Rays through Zemax files: against a trace restated in Zemax's own frame, at focal points, and after writing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.aperture import Circle, Complement, Ellipse, Rectangle
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.shapes.freeform import Biconic, OddAsphere, Toroid
from pachon.models.shapes.grid import GridSag
from pachon.models.shapes.polynomial import XYPolynomial, ZernikeSag
from pachon.models.shapes.shape import Conic
from pachon.models.shapes.sum import Sum
from pachon.raytrace.rays import field_direction, object_points

DATA = Path(__file__).parents[1] / "data" / "zmx"
FILES = sorted(DATA.glob("*.zmx"))


def disc(telescope, n=60, fill=0.9):
    """Points [m] spread over the entrance pupil."""
    r = 0.5 * telescope.pupil_diameter * fill * np.sqrt((np.arange(n) + 0.5) / n)
    angle = np.arange(n) * np.pi * (3 - np.sqrt(5))
    return r * np.cos(angle), r * np.sin(angle)


def rotation(x, y, z):
    """Right-handed rotations about x, the new y and the new z [deg], columns the new axes."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.deg2rad([x, y, z])), np.sin(np.deg2rad([x, y, z]))
    return (
        np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        @ np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    )


class ZemaxTrace:
    """Rays [n, 3] in the local frame of one surface after another, as Zemax walks through a lens; millimetres."""

    def __init__(self, points, directions):
        self.p, self.d = points, directions

    def thickness(self, t):
        self.p = self.p - [0, 0, t]

    def coordinate_break(self, dx=0.0, dy=0.0, tilt=(0.0, 0.0, 0.0)):
        axes = rotation(*tilt)
        self.p, self.d = (self.p - [dx, dy, 0]) @ axes, self.d @ axes

    def meet(self, sag):
        """Go to z = sag(x, y); Newton's method with slopes by complex steps, which have no rounding of differences."""
        t = -self.p[:, 2] / self.d[:, 2]
        for _ in range(30):
            step = (t + 1e-30j)[:, None]
            x, y, z = (self.p + step * self.d).T
            off = z - sag(x, y)
            t = t - off.real / (off.imag / 1e-30)
        self.p = self.p + t[:, None] * self.d

    def mirror(self, sag):
        self.meet(sag)
        x, y, _ = self.p.T
        sx, sy = sag(x + 1e-30j, y).imag / 1e-30, sag(x, y + 1e-30j).imag / 1e-30
        normal = np.stack([-sx, -sy, np.ones_like(sx)], axis=-1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        self.d = self.d - 2 * np.sum(self.d * normal, axis=1, keepdims=True) * normal


def conic(c, k):
    return lambda x, y: c * (x**2 + y**2) / (1 + np.sqrt(1 - (1 + k) * c**2 * (x**2 + y**2)))


def toroid(c, k, radius):
    # The circle about an axis at `radius` along z that the profile's point of this y runs on.
    return lambda x, y: radius - np.sqrt((radius - conic(c, k)(0, y)) ** 2 - x**2)


def zemax_rays(telescope, tx, ty, px, py, stop):
    """Rays of a field (tx, ty) [rad] of the file through points [mm] of the pupil at `stop` [mm]."""
    d = np.array([np.tan(tx), np.tan(ty), 1.0])
    d /= np.linalg.norm(d)
    points = np.stack([px, py, np.full_like(px, stop)], axis=-1)
    return ZemaxTrace(points, np.tile(d, (len(px), 1)))


@pytest.mark.parametrize("field", [(0.0, 0.0), (0.012, 0.0), (-0.01, 0.007)])
def test_tilted_mirrors_against_a_trace_in_zemaxs_frame(field):
    telescope = load_telescope(DATA / "HoO-V2C18Ex46.zmx")
    px, py = disc(telescope)
    rays = pachon.launch_rays(telescope, field, 550e-9, (px, py))
    ours = pachon.trace(telescope, rays)
    # Half a turn about y: x and z change sign, of fields and pupil points too.
    z = zemax_rays(telescope, -field[0], field[1], -px * 1e3, py * 1e3, 160.0)
    # The file, surface by surface.
    z.thickness(160.0)
    z.coordinate_break(tilt=(-3.5, 0, 0))
    z.mirror(conic(-9.852216748768472150e-04, -4.278))
    z.coordinate_break(tilt=(-3.5, 0, 0))
    z.thickness(-160.36)
    z.coordinate_break(tilt=(-3.32, 0, 0))
    z.mirror(toroid(9.562789274375549983e-04, 0.0, 1035.0))
    z.coordinate_break(tilt=(3.32, 0, 0))
    z.thickness(206.80004397784717)
    z.coordinate_break(dy=24.073899767516576)
    z.meet(lambda x, y: 0 * x)
    image = telescope.surfaces[-1]
    local = image.to_local(ours.position) * 1e3
    # Rounding over half a metre of path: 1e-13 of it.
    assert local[:, 0] == pytest.approx(-z.p[:, 0], abs=2e-10)
    assert local[:, 1] == pytest.approx(z.p[:, 1], abs=2e-10)
    direction = ours.direction @ image.matrix
    assert direction == pytest.approx(z.d * [-1, 1, -1], abs=1e-12)


def test_fold_mirrors_lead_up_and_back():
    telescope = load_telescope(DATA / "simple_fold_mirror_up.zmx")
    px, py = disc(telescope)
    result = pachon.trace(telescope, pachon.launch_rays(telescope, (0, 0), 550e-9, (px, py)))
    # Two flat mirrors at 45 degrees shift the beam by 50 mm along y and leave it parallel.
    assert result.position[:, 0] == pytest.approx(px, abs=1e-16)
    assert result.position[:, 1] == pytest.approx(py + 0.05, abs=1e-16)
    assert result.direction == pytest.approx(np.tile([0, 0, -1.0], (len(px), 1)), abs=1e-15)


def test_an_off_axis_paraboloid_focuses_in_its_focus():
    telescope = load_telescope(DATA / "zmax_37992.zmx")
    result = pachon.trace(telescope, pachon.launch_rays(telescope, (0, 0), 587.6e-9, disc(telescope)))
    # The vertex is 190.6 mm off the axis, the focus half its radius of 190.6 mm in front of it.
    assert result.position == pytest.approx(np.tile([0, -0.1906, 0.0953], (60, 1)), abs=1e-15)
    assert not np.any(result.status)
    # Seen from the mirror's middle the focus lies at a right angle, and the image plane is across the beam there.
    assert telescope.surfaces[-1].matrix[:, 2] == pytest.approx([0, 1, 0], abs=1e-15)


def test_a_lens_of_a_finite_object_images_it():
    # US patent 5 831 776: 4 to 1, numerical aperture 0.15 at the object; the file has image heights up to 12 mm.
    telescope = load_telescope(DATA / "US05831776-1.zmx")
    ty = telescope.field_radius
    point = pachon.launch_rays(telescope, (0, ty), 248e-9, ([0.0], [0.0])).position[0]
    # The file's own semi-diameter of the object is 47.9946 mm, for the real image height of 12 mm; this is the paraxial
    # one, and the fields of the file are by the real chief ray.
    assert point[1] == pytest.approx(-47.9946e-3, rel=2e-4)
    fields = pachon.Request.of(telescope).fields
    own = object_points(telescope, field_direction(*fields.T))
    assert own[2, 1] * 1e3 == pytest.approx(-47.9946, abs=5e-5)
    px, py = disc(telescope, fill=0.95)
    landed = pachon.trace(telescope, pachon.launch_rays(telescope, (0, ty), 248e-9, (px, py)))
    assert landed.position[:, 1].mean() == pytest.approx(12e-3, rel=5e-4)
    # As the file stands, defocused by some micrometres at f/0.83.
    assert np.ptp(landed.position, axis=0).max() < 1e-5
    edge = pachon.trace(
        telescope, pachon.launch_rays(telescope, (0, 0), 248e-9, ([0.0], [0.5 * telescope.pupil_diameter]))
    )
    # Four times the object's aperture, by the sine condition.
    assert abs(edge.direction[0, 1]) == pytest.approx(0.6, abs=2e-3)
    rays = pachon.launch_rays(telescope, (0, ty), 248e-9, disc(telescope))
    assert np.ptp(rays.position, axis=0).max() == 0
    assert rays.position[0, 2] == pytest.approx(telescope.object_distance, rel=1e-15)
    # Chief rays are parallel to the axis, and the field is the direction to the middle of the first surface.
    chief = pachon.launch_rays(telescope, (0.01, ty), 248e-9, ([0.0], [0.0]))
    assert np.array_equal(chief.direction[0], [0, 0, -1])
    height = telescope.object_distance - telescope.stop_z
    assert chief.position[0, :2] == pytest.approx(-height * np.tan([0.01, ty]), rel=1e-14)


def test_what_needs_plane_waves_refuses_a_finite_object():
    from pachon.raytrace.rays import field_direction, parallel_rays

    telescope = load_telescope(DATA / "US05831776-1.zmx")
    with pytest.raises(DomainError, match="expected an object at infinity"):
        parallel_rays(telescope, field_direction(0, 0)[None], 248e-9, np.zeros((1, 2)))


def landing(telescope, field):
    rays = pachon.launch_rays(telescope, field, telescope.default_wavelength, disc(telescope))
    return pachon.trace(telescope, rays)


def assert_same_rays(one, other, tolerance):
    field = (0.3 * one.field_radius, -0.6 * one.field_radius)
    a, b = landing(one, field), landing(other, field)
    # The origin of what is read is the first surface with power: rays may be shifted along z as a whole.
    shift = other.surfaces[-1].vertex[2] - one.surfaces[-1].vertex[2]
    assert np.array_equal(a.status, b.status)
    assert b.position == pytest.approx(a.position + np.array([0, 0, shift]), abs=tolerance, nan_ok=True)
    assert b.direction == pytest.approx(a.direction, abs=1e-13, nan_ok=True)


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_a_file_written_back_has_the_same_rays(tmp_path, path):
    # A stop that is off the axis is not written, so that nothing can be aimed at it.
    telescope = load_telescope(path).with_design(aiming="off")
    save_telescope(telescope, tmp_path / "again.zmx")
    again = load_telescope(tmp_path / "again.zmx")
    assert again.surface_names == telescope.surface_names
    assert again.object_distance == pytest.approx(telescope.object_distance, rel=1e-14)
    # Rounding of positions of up to a metre.
    assert_same_rays(telescope, again, 1e-15)


@pytest.mark.parametrize("name", ["lsst_v3.3_r", "paul_baker"])
def test_a_bundled_telescope_written_as_zemax_has_the_same_rays(tmp_path, name):
    telescope = load_telescope(name)
    save_telescope(telescope, tmp_path / "again.zmx")
    again = load_telescope(tmp_path / "again.zmx")
    assert again.pupil_diameter == telescope.pupil_diameter
    assert again.stop_z == pytest.approx(telescope.stop_z, abs=1e-15)
    # Rounding over 30 m of path.
    assert_same_rays(telescope, again, 1e-14)


def test_a_perturbed_telescope_survives_coordinate_breaks(tmp_path):
    telescope = load_telescope("lsst_v3.3_r").perturbed("M2", shift=(1e-3, -2e-3, 3e-3), tilt=(2e-3, -1e-3, 0.4))
    telescope = telescope.perturbed("L1", tilt=(-1e-3, 2e-3, -0.7))
    save_telescope(telescope, tmp_path / "again.zmx")
    again = load_telescope(tmp_path / "again.zmx")
    assert_same_rays(telescope, again, 1e-14)
    for surface in telescope.surfaces:
        assert again.surface(surface.name).matrix == pytest.approx(surface.matrix, abs=1e-15)


BASE = Conic(19.0, -1.1)
X, Y = np.meshgrid(np.linspace(-4.5, 4.5, 19), np.linspace(-4.5, 4.5, 17))
FIGURES = {
    "Zernike": Sum((BASE, ZernikeSag((0.0, 1e-6, -2e-6, 3e-6, 4e-6, -5e-6, 6e-6, 7e-6, 8e-6, -9e-6, 1e-6), 4.2))),
    "annular Zernike": Sum((BASE, ZernikeSag((0.0, 1e-6, -2e-6, 3e-6, 4e-6, -5e-6, 6e-6, 7e-6, 8e-6), 4.2, 2.5))),
    "polynomial": Sum((BASE, XYPolynomial(((1, 0, 1e-6), (2, 1, -2e-7), (0, 3, 3e-7), (3, 1, 1e-8))))),
    "grid": Sum((BASE, GridSag(X[0], Y[:, 0], 1e-6 * np.sin(X) * np.cos(0.7 * Y)))),
    "biconic": Biconic(19.0, 19.001, -1.1, -1.2),
    "toroid": Toroid(19.01, 19.0, -1.1),
    "odd asphere": OddAsphere(19.0, -1.1, (0.0, 1e-7, 2e-7, -1e-8)),
}


@pytest.mark.parametrize("name", FIGURES)
def test_figures_survive_being_written(tmp_path, name):
    telescope = load_telescope("lsst_v3.3_r")
    surfaces = tuple(replace(s, shape=FIGURES[name]) if s.name == "M1" else s for s in telescope.surfaces)
    telescope = replace(telescope, surfaces=surfaces)
    save_telescope(telescope, tmp_path / "again.zmx")
    # Slopes are multiplied by 10 m of focal length; the annular terms go through a solution good to rounding.
    assert_same_rays(telescope, load_telescope(tmp_path / "again.zmx"), 1e-13 if "annular" in name else 2e-14)


@pytest.mark.parametrize(
    "aperture",
    [
        Complement(Circle(1.5, 0.5, 1.0)),
        Rectangle(5.0, 6.0, 0.5, -0.2),
        Complement(Rectangle(1.0, 2.0, 0.5, 1.0)),
        Ellipse(2.5, 3.0, 0.5, -0.2),
        Complement(Ellipse(1.0, 2.0, 0.5, 1.0)),
    ],
    ids=["obscuration", "rectangle", "rectangular obscuration", "ellipse", "elliptical obscuration"],
)
def test_apertures_survive_being_written(tmp_path, aperture):
    telescope = load_telescope("lsst_v3.3_r")
    surfaces = tuple(replace(s, aperture=aperture) if s.name == "M1" else s for s in telescope.surfaces)
    telescope = replace(telescope, surfaces=surfaces, pupil_obscuration=0.0)
    save_telescope(telescope, tmp_path / "again.zmx")
    assert_same_rays(telescope, load_telescope(tmp_path / "again.zmx"), 1e-14)
