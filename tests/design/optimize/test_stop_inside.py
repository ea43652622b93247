"""A lens whose stop is inside and whose file aims no rays: the pupil follows the stop through every change."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes

import pachon
from pachon.core.errors import PrescriptionWarning
from pachon.design.optimize.aimed_rays import AimedRays
from pachon.design.optimize.jacobian import ParameterColumns
from pachon.design.tolerancing.monte_carlo import monte_carlo
from pachon.models.first_order import first_order, footprints
from pachon.models.io.prescription import WRITTEN
from pachon.models.parameters.parameters import apply, parse_parameters
from pachon.models.parameters.tolerances import Tolerance
from pachon.models.paraxial import following_stop
from pachon.raytrace.adjoint.backward_pass import image_gradient
from pachon.studies.tolerance.file import ToleranceFile
from pachon.studies.tolerance.study import run_tolerances

LENSES = Path(__file__).parents[2] / "data"
FILE = LENSES / "lensfiles" / "stop_inside.zmx"
VARIABLES = [*(f"S{i}.radius" for i in range(1, 7)), "S2.thickness", "S4.thickness", "S6.thickness"]
BOUNDS = {"S2.thickness": (2e-3, 12e-3), "S4.thickness": (2e-3, 12e-3)}
RINGS = 3


@pytest.fixture(scope="module")
def lens():
    return pachon.load_telescope(FILE)


@pytest.fixture
def typed(tmp_path):
    """``typed((surface, old, new), ...)``: the lens of the file with lines of surfaces typed anew, its pupil too."""

    def load(*edits, aperture="ENPD 10"):
        head, *blocks = re.split(r"(?=SURF \d)", FILE.read_text().replace("ENPD 10", aperture))
        for surface, old, new in edits:
            assert old in blocks[surface]
            blocks[surface] = blocks[surface].replace(old, new)
        path = tmp_path / "typed.zmx"
        path.write_text("".join([head, *blocks]))
        return pachon.load_telescope(path)

    return load


def filled_spots(telescope, n_pupil=RINGS):
    """Rms spot radius over the fields [m], as ``pachon spots --aiming real`` has it."""
    radii = pachon.spots(telescope.with_design(aiming="real"), n_pupil=n_pupil).rms_radius
    return float(np.sqrt(np.mean(radii**2)))


@pytest.fixture(scope="module")
def optimum(lens):
    return pachon.optimize(
        lens,
        VARIABLES,
        "spots",
        bounds=BOUNDS,
        targets=[pachon.design.FocalLength(0.05)],
        n_pupil=RINGS,
        solver=pachon.design.LeastSquares(tolerance=1e-3),
    )


@pytest.mark.long
@pytest.mark.parametrize("ending", [ending for ending in WRITTEN if ending != ".yml"])
def test_what_is_reported_is_what_the_saved_lens_does(lens, optimum, tmp_path, ending):
    path = tmp_path / f"better{ending}"
    with warnings.catch_warnings():
        # CODE V has rays aimed at the stop.
        warnings.filterwarnings("ignore", message=".* does not state how rays are aimed", category=PrescriptionWarning)
        pachon.save_telescope(optimum.telescope, path)
    again = pachon.load_telescope(path)
    assert again.design_data.stop == "S4"
    assert "pachon entrance pupil" not in path.read_text()
    assert again.stop_z - again.surfaces[0].vertex[2] == pytest.approx(
        optimum.telescope.stop_z - optimum.telescope.surfaces[0].vertex[2], abs=1e-15
    )
    assert optimum.merits[0] == pytest.approx(filled_spots(lens), rel=1e-9)
    # Numbers of the file are rounded in their last digits.
    assert optimum.merits[1] == pytest.approx(filled_spots(again), rel=1e-9)
    assert optimum.merits[1] < 0.25 * optimum.merits[0]


@pytest.mark.long
def test_the_result_has_the_aiming_of_the_file(lens, optimum):
    after = optimum.telescope
    assert (lens.design_data.aiming, after.design_data.aiming) == ("off", "off")
    assert pachon.models.with_floating_pupil(after).stop_z == pytest.approx(after.stop_z, abs=1e-16)
    assert not np.isclose(after.stop_z, lens.stop_z, rtol=0, atol=5e-4)
    assert after.pupil_diameter == lens.pupil_diameter
    assert optimum.filled_stops == ("S4",)
    assert np.array_equal(optimum.remeasured[:, 0], optimum.merits)
    for telescope, found in zip((lens, after), optimum.remeasured[:, 1], strict=True):
        plain = pachon.spots(telescope, n_pupil=RINGS).rms_radius
        assert found == pytest.approx(np.sqrt(np.mean(plain**2)), rel=1e-12)
    assert optimum.is_better
    summary = optimum.summary()
    assert summary["rays_fill"] == ["S4"]
    assert summary["rms_end_without_aiming_m"] == optimum.remeasured[1, 1]


@pytest.mark.long
def test_a_lens_that_got_worse_is_not_called_better(lens):
    """A focal length that spoils the spots."""
    target = pachon.design.FocalLength(0.055, weight=10.0)
    worse = pachon.optimize(
        lens, ["S1.radius"], targets=[target], n_pupil=2, solver=pachon.design.LeastSquares(max_steps=5)
    )
    assert worse.merits[1] > worse.merits[0]
    assert worse.remeasured[1, 0] == pytest.approx(filled_spots(worse.telescope, 2), rel=1e-9)
    assert not worse.is_better


def through_stop(telescope, field, relative):
    """Solve for the ray that meets the stop at a point in units of its radius; return where it lands [m].

    The radius is that of the ray on the axis at the rim of the entrance pupil.
    """
    stop, light = telescope.surface_names.index("S4"), telescope.default_wavelength

    def met(at, points):
        rays = pachon.launch_rays(telescope, at, light, np.transpose(points))
        ends = pachon.trace(telescope, rays, surfaces="all", threads=1)
        return [telescope.surfaces[i].to_local(ends[i].position)[:, :2] for i in (stop, -1)]

    def solved(at, target, point):
        step = 1e-6 * np.eye(2)
        for _ in range(5):
            # Newton's method, with derivatives by differences.
            here, *sides = met(at, np.stack([point, *(point + step), *(point - step)]))[0]
            slopes = np.transpose(np.subtract(sides[:2], sides[2:])) / 2e-6
            point = point - np.linalg.solve(slopes, here - target)
        assert met(at, point[None])[0][0] == pytest.approx(target, abs=1e-15)
        return point

    axis = solved((0.0, 0.0), np.zeros(2), np.zeros(2))
    rim = met((0.0, 0.0), axis[None] + [0.0, 0.5 * telescope.pupil_diameter])[0][0]
    return met(field, solved(field, np.hypot(*rim) * relative, 5e-3 * relative)[None])[1][0]


@pytest.mark.long
@pytest.mark.parametrize("field_deg", [pytest.param((0.0, 0.0), marks=pytest.mark.slow), (4.0, 14.0)])
def test_derivatives_of_landing_points_are_those_of_rays_solved_anew(lens, field_deg):
    """Brute force: lenses with one change, and rays that are searched for through their stops."""
    steps = {
        "S1.curvature": 1e-3,
        "S2.thickness": 1e-5,
        "S3.dy": 1e-5,
        "S1.rx": 1e-4,
        "S4.dx": 1e-5,
        "S5.curvature": 1e-3,
    }
    field, relative = np.deg2rad(field_deg), np.array([[0.0, 0.0], [0.5, -0.7]])
    request = pachon.Request.of(following_stop(lens), [field])
    columns = ParameterColumns.at(following_stop(lens), parse_parameters(steps, lens))
    aimed = AimedRays(columns, request, lens.default_wavelength, 0.5 * lens.pupil_diameter * relative)
    forward = aimed.forward()
    found = aimed.derivatives(forward, image_gradient(forward))
    for i, point in enumerate(relative):
        assert forward.image[:, i] == pytest.approx(through_stop(lens, field, point), abs=1e-13)
        for p, (address, step) in enumerate(steps.items()):
            sides = {k: through_stop(apply(lens, {address: k * step}), field, point) for k in (1, -1, 2, -2)}
            # Differences without their error of third order, of points that are found to 1e-15 m.
            numeric = (8 * (sides[1] - sides[-1]) - (sides[2] - sides[-2])) / (12 * step)
            assert found[:, i, p] == pytest.approx(numeric, rel=1e-7, abs=2e-9), address


@pytest.mark.long
def test_sensitivities_are_those_of_rays_that_fill_the_stop(lens):
    """Without a word about aiming they are those with it, which brute force has tested."""
    names, fields = ["S1.dy", "S2.thickness", "S4.rx"], np.deg2rad([[0.0, 0.0], [0.0, 15.0]])
    plain, aimed = (
        pachon.sensitivity(t, names, fields, n_pupil=4, n_zernike=8) for t in (lens, lens.with_design(aiming="real"))
    )
    assert np.array_equal(plain.matrix, aimed.matrix)
    assert np.array_equal(plain.zernikes, aimed.zernikes)


@pytest.mark.long
def test_tolerances_fill_the_stop_of_every_lens(lens, typed):
    file = ToleranceFile.model_validate(
        {
            "telescope": str(FILE), "rings": RINGS, "draws": 2,
            "tolerances": [{"name": "S2.thickness_um", "size": 200}, {"name": "S1.curvature", "size": 0.1}],
        }
    )  # fmt: skip
    study = run_tolerances(lens, file)
    assert study.nominal == pytest.approx(filled_spots(lens), rel=1e-9)
    assert study.lower[0] == pytest.approx(filled_spots(typed((2, "DISZ 6.0", "DISZ 5.8"))), rel=1e-9)
    assert study.upper[0] == pytest.approx(filled_spots(typed((2, "DISZ 6.0", "DISZ 6.2"))), rel=1e-9)
    # The curvature of the telescope has the other sign: its z axis is against the light.
    assert study.upper[1] == pytest.approx(filled_spots(typed((1, "CURV 0.0461", "CURV 0.0460"))), rel=1e-9)
    assert "rays fill the stop S4" in study.criterion.definition
    frozen = apply(lens, {"S2.thickness": 2e-4})
    radii = pachon.spots(frozen, n_pupil=RINGS).rms_radius
    assert abs(np.sqrt(np.mean(radii**2)) / study.upper[0] - 1.0) > 5e-3


@pytest.mark.long
def test_drawn_lenses_fill_their_stop(lens, typed):
    fields = np.array(lens.design_data.fields)
    found = monte_carlo(
        pachon.Request.of(lens, fields, n_pupil=RINGS), [Tolerance("S2.thickness", 2e-4)], "spots", n=2, method="traced"
    )
    for deviation, merit in zip(found.deviations[:, 0], found.merit, strict=True):
        drawn = typed((2, "DISZ 6.0", f"DISZ {6.0 + 1e3 * float(deviation)!r}"))
        assert merit == pytest.approx(filled_spots(drawn), rel=1e-9)


#: A stop of 3.6 mm in place of a pupil of 10 mm.
STATED = (4, "  TYPE", "  DIAM 3.6 1\n  TYPE")
CHANGES = {"S2.thickness_mm": 1.0, "S1.curvature": 2.0}
TYPED_CHANGES = ((2, "DISZ 6.0", "DISZ 7.0"), (1, "CURV 0.0461", "CURV 0.0441"))


@pytest.mark.parametrize("aperture", ["ENPD 10", "FLOA"])
def test_the_pupil_of_a_changed_lens_is_that_of_its_file(typed, aperture):
    """A stated diameter stays; that of a stated stop follows."""
    start = typed(STATED, aperture=aperture)
    changed = pachon.models.apply_changes(start, CHANGES)
    expected = typed(STATED, *TYPED_CHANGES, aperture=aperture)
    assert changed.design_data == start.design_data
    assert changed.stop_z == pytest.approx(expected.stop_z, abs=1e-15)
    assert abs(changed.stop_z - start.stop_z) > 1e-3
    assert changed.pupil_diameter == pytest.approx(expected.pupil_diameter, rel=1e-13)
    assert (changed.pupil_diameter == start.pupil_diameter) == (aperture == "ENPD 10")
    one, other = (pachon.spots(t, n_pupil=RINGS).rms_radius for t in (changed, expected))
    assert one == pytest.approx(other, rel=1e-9)


def test_changes_at_zero_change_nothing(lens):
    assert pachon.models.apply_changes(lens, {"S2.thickness_mm": 0.0, "S1.dy_um": 0.0}) == lens


@pytest.mark.parametrize("aiming", ["off", "paraxial", "real"])
def test_edges_are_held_where_the_light_goes_in_the_lens_as_it_is(typed, aiming):
    """The clear radius of a surface is that of light through the stop, not through the pupil at the start."""
    start, expected = (t.with_design(aiming=aiming) for t in (typed(), typed(*TYPED_CHANGES)))
    changed = apply(start, {"S2.thickness": 1e-3, "S1.curvature": 2.0})
    for surface in ("S1", "S5"):
        edge = pachon.design.EdgeThickness(surface, minimum=0.0)
        assert edge.measure(changed) == pytest.approx(edge.measure(expected), abs=1e-15)
        # Light through the pupil where it was.
        frozen = footprints(changed, changed.field_radius)[[int(surface[1]) - 1, int(surface[1])]].max()
        assert abs(edge.measure(changed) - replace(edge, radius=float(frozen)).measure(changed)) > 1e-5


@pytest.mark.slow
def test_an_edge_is_held_on_the_optimum_as_it_is_saved(lens, tmp_path):
    """The lens before would go below it."""
    how = dict(
        bounds={"S2.thickness": BOUNDS["S2.thickness"]},
        n_pupil=2,
        solver=pachon.design.LeastSquares(tolerance=1e-4, max_steps=40),
    )
    free = pachon.optimize(lens, ["S1.radius", "S2.thickness", "S6.thickness"], **how).telescope
    least = pachon.design.EdgeThickness("S1", minimum=1.0).measure(free) + 2e-4
    edge = pachon.design.EdgeThickness("S1", minimum=least, weight=10.0)
    held = pachon.optimize(lens, ["S1.radius", "S2.thickness", "S6.thickness"], targets=[edge], **how)
    pachon.save_telescope(held.telescope, tmp_path / "held.zmx")
    saved = edge.measure(pachon.load_telescope(tmp_path / "held.zmx"))
    assert held.operands[0].end == pytest.approx(saved, abs=1e-12)
    assert saved == pytest.approx(least, abs=2e-5)


def test_a_focal_ratio_follows_a_stop_of_stated_size(typed):
    """With a stop of one size the pupil follows it: the focal ratio is that of first order, its derivatives too."""
    start = following_stop(typed(STATED, aperture="FLOA"))
    ratio, focal = pachon.design.FNumber(5.0), pachon.design.FocalLength(0.05)
    names, values = ["S1.curvature", "S2.thickness", "S6.curvature"], np.array([2.0, 1e-3, 0.0])
    parameters = parse_parameters(names, start)
    columns = ParameterColumns.at(start, parameters, values)
    number, found = ratio.gradient(columns)

    def first_order_ratio(change, place):
        changes = dict(zip(parameters, values + change * (np.arange(3) == place), strict=True))
        return first_order(pachon.models.with_floating_pupil(apply(start, changes))).f_number

    diameter = pachon.models.with_floating_pupil(columns.telescope).pupil_diameter
    assert number == pytest.approx(focal.measure(columns.telescope) / diameter, rel=1e-12)
    assert number == pytest.approx(first_order_ratio(0.0, 0), rel=1e-11)
    assert diameter != pytest.approx(start.pupil_diameter, rel=1e-2)
    by_focal_length = focal.gradient(columns)[1] / diameter
    for place, step in enumerate((1e-2, 1e-6, 1e-2)):
        numeric = (first_order_ratio(step, place) - first_order_ratio(-step, place)) / (2.0 * step)
        # Steps are a thousandth of the numbers: their square, over some length of the lens.
        assert found[place] == pytest.approx(numeric, rel=1e-6)
    assert found[2] == by_focal_length[2]


@pytest.mark.long
def test_a_near_object_keeps_its_cone_of_light(tmp_path):
    """The relay has a working focal ratio, which the change makes untrue: the angle of the beam stays."""
    relay = pachon.load_telescope(LENSES / "lenses" / "relay.zmx")
    relay = relay.with_design(field_type="object_height", fields=((0.0, 0.0), (0.0, 0.004)), field_weights=())
    assert relay.design_data.aiming == "off"
    found = pachon.optimize(
        relay, ["A1.curvature", "A3.thickness"], n_pupil=2, solver=pachon.design.LeastSquares(max_steps=4)
    )
    assert found.remeasured[1, 0] == pytest.approx(found.merits[1], rel=1e-9)
    before, after = relay, found.telescope
    slopes = [0.5 * t.pupil_diameter / (t.object_distance - t.stop_z) for t in (before, after)]
    assert slopes[1] == pytest.approx(slopes[0], rel=1e-13)
    assert after.stop_z != before.stop_z
    pachon.save_telescope(after, tmp_path / "after.zmx")
    again = pachon.load_telescope(tmp_path / "after.zmx")
    assert again.design_data.stop == relay.design_data.stop
    assert filled_spots(again, 2) == pytest.approx(found.merits[1], rel=1e-9)


@pytest.mark.parametrize("name", ["lsst_v3.3_r", "paul_baker", "lenses/doublet.zmx", "lenses/ritchey_chretien.zmx"])
def test_telescopes_without_a_stop_inside_stay_as_they_are(name):
    telescope = pachon.load_telescope(str(LENSES / name) if name.endswith("zmx") else name)
    assert following_stop(telescope) is telescope
    first = telescope.surface_names[0]
    assert pachon.models.apply_changes(telescope, {f"{first}.dz_m": 5e-5}) == apply(telescope, {f"{first}.dz": 5e-5})


@pytest.mark.long
def test_the_picture_prints_what_spots_measures(lens, optimum):
    figure = optimum.plot()
    printed = [
        float(label.split()[1])
        for axes in figure.findobj(Axes)
        if (label := axes.get_xlabel()).startswith("rms ") and label.endswith("µm")
    ]
    telescopes = (lens, optimum.telescope)
    measured = [pachon.spots(t.with_design(aiming="real")).rms_radius * 1e6 for t in telescopes]
    # Three digits are printed.
    assert printed == pytest.approx(np.concatenate(measured), rel=5e-3)


def at_stop(telescope, field_deg):
    """Where the chief ray of a field meets the stop, in its own axes [m]."""
    rays = pachon.launch_rays(telescope, np.deg2rad(field_deg), telescope.default_wavelength, ([0.0], [0.0]))
    stop = telescope.surface_names.index(telescope.design_data.stop)
    end = pachon.trace(telescope, rays, surfaces="all", threads=1)[stop]
    return telescope.surfaces[stop].to_local(end.position[0])[:2]


SIDEWAYS = {"S1.dy_mm": 0.2, "S2.rx_mrad": 3.0, "S3.dx_um": 100.0, "S2.thickness_mm": 0.5}


def test_a_pupil_moves_sideways_with_the_image_of_its_stop(lens, tmp_path):
    changed = pachon.models.apply_changes(lens, SIDEWAYS)
    assert changed.design_data.aiming == "off"
    assert np.hypot(*changed.pupil_center) > 5e-5
    assert np.abs(at_stop(changed, (0.0, 0.0))).max() < 1e-15
    frozen = replace(changed, pupil_center=(0.0, 0.0))
    assert np.abs(at_stop(frozen, (0.0, 0.0))).max() > 3e-5
    # Chief rays of the field miss the middle by the aberration of the pupil, as they did before.
    before, after, with_frozen = (at_stop(t, (0.0, 14.0)) for t in (lens, changed, frozen))
    assert np.abs(after - before).max() < 0.5 * np.abs(with_frozen - before).max()
    pachon.save_telescope(changed, tmp_path / "changed.yaml")
    assert pachon.load_telescope(tmp_path / "changed.yaml").pupil_center == pytest.approx(changed.pupil_center)
    # Small changes have small effects: rays are launched as before.
    little = pachon.models.apply_changes(lens, {"S1.dy_um": 1e-3})
    assert pachon.spots(little, n_pupil=2).rms_radius == pytest.approx(
        pachon.spots(lens, n_pupil=2).rms_radius, rel=1e-5
    )


def test_a_pupil_follows_degrees_of_freedom_and_temperature(lens):
    """Warmer, by what a stop of the same image would be: the pupil of the lens computed anew."""
    warm = pachon.models.DegreesOfFreedom((pachon.models.thermal(lens, 2e-4),)).apply(lens, [50.0])
    assert warm.stop_z == pytest.approx(pachon.models.with_floating_pupil(warm).stop_z, abs=1e-16)
    # All lengths grow by one per cent, but for that of the first vertex at the origin.
    assert warm.stop_z == pytest.approx(1.01 * lens.stop_z, rel=1e-4)
    vector = pachon.sensitivity(lens, ["S1.dy"], [0.0, 0.0], n_pupil=3, n_zernike=4).parameters
    assert np.abs(at_stop(vector.apply(lens, [1e-4]), (0.0, 0.0))).max() < 1e-15


def test_a_fold_mirror_changes_nothing_of_the_pupil(typed, tmp_path):
    """The lens with 40 mm of air in front of its middle element, straight and with a mirror of 45 degrees in it."""
    straight = typed((2, "DISZ 6.0", "DISZ 40.0"), aperture="ENPD 5")
    head, *blocks = re.split(r"(?=SURF \d)", (tmp_path / "typed.zmx").read_text())
    turn = "SURF 0\n  TYPE COORDBRK\n  CURV 0.0\n  PARM 3 45\n  DISZ {}\n"
    mirror = "SURF 0\n  TYPE STANDARD\n  CURV 0.0\n  DISZ 0\n  GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0\n"
    behind = [re.sub(r"(CURV|DISZ) (?=[-\d])", r"\1 -", block).replace("--", "") for block in blocks[3:]]
    front = [*blocks[:2], blocks[2].replace("DISZ 40.0", "DISZ 20.0")]
    parts = [*front, turn.format(0), mirror, turn.format(-20.0), *behind]
    text = head + "".join(re.sub(r"SURF \d+", f"SURF {i}", part) for i, part in enumerate(parts))
    (tmp_path / "folded.zmx").write_text(text)
    folded = pachon.load_telescope(tmp_path / "folded.zmx")
    changes = {"S1.curvature": 0.5}
    for one, other in ((straight, folded), tuple(pachon.models.apply_changes(t, changes) for t in (straight, folded))):
        assert other.stop_z == pytest.approx(one.stop_z, abs=1e-15)
        assert other.pupil_diameter == one.pupil_diameter
        points = np.deg2rad([[0.0, 0.0], [0.0, 2.0]])
        assert pachon.spots(other, points, n_pupil=2).rms_radius == pytest.approx(
            pachon.spots(one, points, n_pupil=2).rms_radius, rel=1e-9
        )
    pachon.save_telescope(folded, tmp_path / "again.zmx")
    assert "pachon entrance pupil" not in (tmp_path / "again.zmx").read_text()
