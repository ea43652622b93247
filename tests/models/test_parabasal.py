"""First-order properties about the chief ray, in two planes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_first_order import SYSTEMS, telescope_of

import pachon
from pachon.core.errors import DomainError
from pachon.models.first_order import first_order
from pachon.models.grating import Grating
from pachon.models.parabasal import parabasal_optics, stop_center_point
from pachon.models.shapes.freeform import Biconic, Toroid
from pachon.models.shapes.polynomial import XYPolynomial
from pachon.models.shapes.shape import Conic, Plane, Sphere
from pachon.models.shapes.sum import Sum
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM
from pachon.models.thin_lens import ThinLens
from pachon.pipeline.report.info import describe, figure_rows
from pachon.raytrace.rays import Rays

DATA = Path(__file__).parents[1] / "data"


def turned_about_x(telescope, name, angle):
    return telescope.perturbed(name, tilt=(angle, 0.0, 0.0))


@pytest.mark.parametrize("system", SYSTEMS)
def test_on_an_axis_it_is_the_paraxial_trace(system):
    rows, stop_z, diameter = SYSTEMS[system]
    telescope = telescope_of(rows, stop_z=stop_z, diameter=diameter)
    optics, paraxial = parabasal_optics(telescope), first_order(telescope)
    last_z = rows[-1][0]
    # Along the light behind the last surface.
    sense = 1.0 if (paraxial.focus_z > last_z) == (paraxial.back_focus > 0) else -1.0
    for value, expected in (
        (optics.focal_length, abs(paraxial.focal_length)),
        (optics.f_number, abs(paraxial.f_number)),
        (optics.plate_scale, abs(paraxial.plate_scale)),
        (optics.back_focus, paraxial.back_focus),
        (optics.exit_pupil_distance, sense * (paraxial.exit_pupil_z - last_z)),
        (optics.exit_pupil_diameter, paraxial.exit_pupil_diameter),
    ):
        assert value == pytest.approx([expected] * 2, rel=1e-12)


def test_parallel_chief_rays_cross_in_the_exit_pupil():
    rows, stop_z, diameter = SYSTEMS["lens"]
    lens = replace(telescope_of(rows, stop_z=stop_z, diameter=diameter), object_distance=stop_z + 3.0)
    telecentric = lens.with_design(stop="s1", telecentric=True)
    optics, paraxial = parabasal_optics(telecentric), first_order(telecentric)
    assert optics.exit_pupil_distance == pytest.approx(optics.back_focus, rel=1e-12)
    assert optics.exit_pupil_diameter == pytest.approx([paraxial.exit_pupil_diameter] * 2, rel=1e-12)


def test_a_stop_far_from_the_axis_is_met_in_its_middle():
    """Rounding is that of metres, in a beam of a millimetre."""
    mirror = telescope_of([(0.0, 4.0, -1.0, None)], stop_z=1.0, diameter=1e-3)
    stop = Surface("stop", Interaction.PASS, Plane(), (0.0, 0.0, 0.8), VACUUM)
    for height in np.linspace(1.5, 2.5, 20):
        # A paraboloid sends the ray at 2 m, where it is 0.5 m high, through its focus at 2 m.
        placed = replace(stop, vertex=(0.0, float(height) * (2.0 - 0.8) / (2.0 - height**2 / 8.0), 0.8))
        telescope = replace(mirror, surfaces=(mirror.surfaces[0], placed), pupil_center=(0.0, 2.0))
        x, y = stop_center_point(telescope.with_design(stop="stop"), telescope.default_wavelength)
        assert (x, y) == pytest.approx((0.0, height), abs=1e-14)


def test_a_tilted_mirror_has_the_foci_of_coddington():
    """Of a sphere hit at the angle i, R cos(i) / 2 in the plane of incidence and R / (2 cos i) across it."""
    telescope = telescope_of([(0.0, 4.0, 0.0, None)], stop_z=0.5, diameter=0.1)
    for angle in (0.1, 0.7, 1.2):
        tilted = turned_about_x(telescope, "s0", angle)
        optics = parabasal_optics(tilted)
        assert optics.focal_length == pytest.approx([2.0 * np.cos(angle), 2.0 / np.cos(angle)], rel=1e-13)
        assert optics.back_focus == pytest.approx([2.0 * np.cos(angle), 2.0 / np.cos(angle)], rel=1e-13)
        # The pupil, 0.5 m in front.
        for k, f in enumerate(optics.focal_length):
            assert optics.exit_pupil_distance[k] == pytest.approx(1.0 / (1.0 / f - 1.0 / 0.5), rel=1e-12)
            assert optics.exit_pupil_diameter[k] == pytest.approx(0.1 / abs(1.0 - 0.5 / f), rel=1e-12)


def test_an_off_axis_paraboloid_of_90_degrees():
    telescope = pachon.load_telescope(DATA / "zmx" / "zmax_37992.zmx")
    optics = parabasal_optics(telescope)
    assert optics.focal_length == pytest.approx([0.1906, 0.1906], rel=1e-12)
    assert optics.back_focus == pytest.approx([0.1906, 0.1906], rel=1e-12)
    rows = dict(figure_rows(describe(telescope)))
    assert rows["focal lengths"] == "190.6, 190.6 mm"
    assert "first-order figures" not in rows


def off_axis():
    """Two mirrors off their axes, one of them a freeform, and a tilted thick plate."""
    telescope = telescope_of(
        [(0.0, 3.0, -0.8, None), (1.0, 2.5, -2.0, None), (0.1, np.inf, 0.0, 1.5), (0.05, np.inf, 0.0, 1.0)],
        stop_z=0.3,
        diameter=0.02,
    )
    shapes = {
        "s0": Conic(3.0, -0.8),
        "s1": Sum((Conic(2.5, -2.0), XYPolynomial(((0, 2, 0.01), (2, 1, 0.02))))),
        "s2": Toroid(1.7, 5.0),
        "s3": Biconic(-3.0, 2.0, 0.3, 0.1),
    }
    for name, shape in shapes.items():
        telescope = telescope.with_shape(name, shape)
    telescope = telescope.perturbed("s0", shift=(0.0, -0.2, 0.0))
    telescope = telescope.perturbed("s1", shift=(0.01, 0.05, 0.0), tilt=(0.02, 0.01, 0.3))
    telescope = telescope.perturbed("s2", tilt=(0.2, 0.1, 0.4))
    return telescope.perturbed("s3", tilt=(0.2, -0.1, 0.0))


def neighbours(telescope, step):
    """Return positions and directions behind the last surface by four coordinates at the pupil, by differences."""
    origin = np.array([0.0, 0.0, telescope.stop_z])

    def traced(at):
        direction = np.array([at[2], at[3], -1.0]) / np.sqrt(1.0 + at[2] ** 2 + at[3] ** 2)
        start = origin + np.array([at[0], at[1], 0.0]) - 2.0 * direction
        end = pachon.trace(telescope, Rays(start[None], direction[None], np.zeros(1), telescope.default_wavelength))
        return np.concatenate([end.position[0], end.direction[0]])

    chief = traced(np.zeros(4))
    change = np.stack([(traced(step * e) - traced(-step * e)) / (2.0 * step) for e in np.eye(4)], axis=1)
    return chief, change


def ruled():
    """The same with grooves on a mirror and on a side of the plate."""
    telescope = off_axis()
    first, second, front, back = telescope.surfaces
    grooves = Grating(-1, 40.0, 0.3), Grating(2, 30.0, -0.4)
    surfaces = replace(first, grating=grooves[0]), second, replace(front, grating=grooves[1]), back
    return replace(telescope, surfaces=surfaces)


def test_a_thin_lens_behind_a_tilted_mirror():
    """Two powers and their distance: 1/f = 1/f1 + 1/f2 - d / (f1 f2), f1 those of Coddington."""
    mirror = turned_about_x(telescope_of([(0.0, 4.0, 0.0, None)], stop_z=0.5, diameter=0.1), "s0", 0.25 * np.pi)
    normal = mirror.surfaces[0].matrix[:, 2]
    light = np.array([0.0, 0.0, -1.0]) + 2.0 * normal[2] * normal  # behind the mirror
    axes = np.column_stack([[1.0, 0.0, 0.0], np.cross(light, [1.0, 0.0, 0.0]), light])
    rotation = tuple(tuple(row) for row in axes.tolist())
    for side in (0.0, 0.01):
        place = tuple((0.3 * light + [side, 0.0, 0.0]).tolist())
        lens = Surface("lens", Interaction.THIN_LENS, Plane(), place, VACUUM, None, rotation, thin_lens=ThinLens(0.4))
        telescope = replace(mirror, surfaces=(*mirror.surfaces, lens))
        if side:
            with pytest.raises(DomainError, match="thin lens lens of test: expected one about the chief ray"):
                parabasal_optics(telescope)
        else:
            first = 2.0 * np.array([np.sqrt(0.5), np.sqrt(2.0)])
            expected = 1.0 / (1.0 / first + 1.0 / 0.4 - 0.3 / (first * 0.4))
            assert parabasal_optics(telescope).focal_length == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("make", [off_axis, ruled])
def test_real_rays_near_the_chief_ray(make):
    telescope = make()
    optics = parabasal_optics(telescope)
    _, change = neighbours(telescope, 1e-5)
    # Errors of the differences: squares of 1e-5, and rounding of 1e-16 over it.
    power = np.linalg.svd(change[3:, :2])[1]
    assert sorted(optics.plate_scale) == pytest.approx(sorted(power), rel=1e-8)
    # Where neighbours come closest to the chief ray: between both foci they are lines, at right angles.
    chief, _ = neighbours(telescope, 1e-5)
    across = np.linalg.svd(chief[None, 3:])[2][1:]
    height, turn = across @ change[:3], across @ change[3:]
    for distances, columns in ((optics.back_focus, slice(0, 2)), (optics.exit_pupil_distance, slice(2, 4))):
        for distance in distances:
            squeezed = np.linalg.svd(height[:, columns] + distance * turn[:, columns])[1]
            assert squeezed[1] < 1e-7 * squeezed[0]


@pytest.mark.parametrize("name", ["auxtel", "rubin_v3.14_r"])
def test_telescopes_off_their_axis_are_close_to_principal_rays(name):
    telescope = pachon.load_telescope(name)
    optics = parabasal_optics(telescope)
    rays = pachon.design.principal_rays(telescope, [(0.0, 0.0)], telescope.default_wavelength)
    # Real rays at 1 % of the pupil, and plate scales on a detector that is out of focus.
    assert optics.focal_length == pytest.approx(1.0 / rays.plate_scale[0], rel=1e-4)
    distance = optics.exit_pupil_distance - optics.detector_distance
    assert distance == pytest.approx(rays.exit_pupil_distance[0], rel=1e-4)
    assert optics.exit_pupil_diameter == pytest.approx(rays.exit_pupil_diameter[0], rel=1e-3)
    assert dict(figure_rows(describe(telescope)))["focal lengths"].endswith(" m")


def test_light_that_stays_parallel_has_no_focus():
    mirror = telescope_of([(0.0, 4.0, -1.0, None), (1.5, 1.0, -1.0, None)], stop_z=0.5, diameter=0.1)
    optics = parabasal_optics(turned_about_x(replace(mirror, surfaces=mirror.surfaces[:1]), "s0", 0.0))
    assert np.isfinite(optics.focal_length).all()
    afocal = parabasal_optics(mirror)
    assert np.isinf(afocal.focal_length).all()
    assert np.isinf(afocal.back_focus).all()
    flat = replace(mirror, surfaces=(replace(mirror.surfaces[0], shape=Plane()),))
    assert np.isinf(parabasal_optics(turned_about_x(flat, "s0", 0.4)).focal_length).all()


def test_a_cylinder_has_a_focus_in_one_plane():
    telescope = telescope_of([(0.0, 4.0, 0.0, None)], stop_z=0.5, diameter=0.1)
    for shape, expected in ((Toroid(np.inf, 3.0), (1.5, np.inf)), (Toroid(3.0, np.inf), (np.inf, 1.5))):
        optics = parabasal_optics(telescope.with_shape("s0", shape))
        assert optics.focal_length == pytest.approx(expected, rel=1e-12)
        assert optics.back_focus == pytest.approx(expected, rel=1e-12)


def test_what_has_no_chief_ray_is_an_error():
    telescope = telescope_of([(0.0, 4.0, 0.0, None)], stop_z=0.5, diameter=0.1)
    with pytest.raises(DomainError, match="chief ray of test does not meet surface s0"):
        parabasal_optics(telescope.perturbed("s0", shift=(5.0, 0.0, 0.0)))
    with pytest.raises(DomainError, match="at least one mirror or lens surface"):
        parabasal_optics(replace(telescope, surfaces=(replace(telescope.surfaces[0], interaction=Interaction.PASS),)))
    glass = telescope_of([(0.0, np.inf, 0.0, 1.5), (-0.1, np.inf, 0.0, 1.0)], stop_z=0.5, diameter=0.1)
    glass = glass.with_shape("s1", Sphere(9.0))
    with pytest.raises(DomainError, match="totally reflected at surface s1"):
        parabasal_optics(turned_about_x(glass, "s1", 0.9))
    mirror = replace(telescope.surfaces[0], grating=Grating(1, 3000.0))
    with pytest.raises(DomainError, match="has no such order of the grating surface s0"):
        parabasal_optics(replace(telescope, surfaces=(mirror,)))
