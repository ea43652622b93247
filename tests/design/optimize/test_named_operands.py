"""Operands by their names in Zemax and CODE V: optiland's numbers, closed forms, brute force, pachon's analyses."""

import re
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.commands.cli import main
from pachon.core.errors import ConfigError, DomainError, PachonError, UnknownNameError
from pachon.design.optimize.jacobian import ParameterColumns
from pachon.design.optimize.operand import check_operands
from pachon.design.optimize.operand_names import NAMES, entry_fields
from pachon.models.first_order import first_order
from pachon.models.parameters.parameters import apply, parse_parameters

#: The field of the file, and 0.7 of it.
EDGE = (0.0, float(np.deg2rad(12.000000333930423)))
ZONE = (0.0, 0.7 * EDGE[1])
COLORS = (4.861327e-07, 6.562725e-07)
MM = 1e-3
DEG = float(np.deg2rad(1.0))
#: optiland 0.6.3 of the triplet, saved by pachon as .json: f2, F/#, EPL, XPL, XPD, total track, and its Seidel sums S
#: [mm] of opposite sign as W = S/8, S/2, S/2, S/4, S/2 in waves of 0.5875618 um.
OPTILAND = {
    "EFFL": 24.999997034243705 * MM,
    "EFLX": 24.999997034243705 * MM,
    "EFLY": 24.999997034243705 * MM,
    "ISFN": 24.999997034243705 / 8.333333969116211,
    "EPDI": 8.333333969116211 * MM,
    "ENPP": 11.587317697842895 * MM,
    "EXPP": -21.91319134228302 * MM,
    "EXPD": 7.352987158912921 * MM,
    "TOTR": 31.86940729618072 * MM,
    "SPHA": 0.018775050511236843 / 8 / 5.875618e-4,
    "COMA": -0.004674813663517442 / 2 / 5.875618e-4,
    "ASTI": -0.001125262750408451 / 2 / 5.875618e-4,
    "FCUR": 0.011876490323331329 / 4 / 5.875618e-4,
    "DIST": 0.0011522347963347267 / 2 / 5.875618e-4,
}
RAYS = ("REAX", "REAY", "REAZ", "REAA", "REAB", "REAC", "RAID")
#: optiland's rays, in mm and degrees: field and pupil point, surface, and the numbers in the order of RAYS.
OPTILAND_RAYS = [
    (
        (0.0, 0.0),
        (0.0, 0.8),
        "S3",
        (0, 2.3567765635267883, -0.2267278225748175, 0, -0.030993568078152095, 0.9995195839691113, 21.351385049035272),
    ),
    (
        EDGE,
        (0.0, 0.7),
        "Image",
        (0, 5.2717718718556155, 0, 0, 0.11988993747487414, 0.992787189125782, 6.885750603346361),
    ),
    (
        ZONE,
        (-0.5, -0.3),
        "S3",
        (
            1.4592442842782738,
            -1.180309975553309,
            -0.143299828378888,
            -0.01807747475491013,
            0.14120264076984054,
            0.9898156490711334,
            26.464755226806766,
        ),
    ),
]


@pytest.fixture(scope="module")
def triplet():
    return pachon.load_telescope("tests/data/zmx/lens1.zmx")


@pytest.fixture(scope="module")
def biconvex(lens):
    """R 50 mm and -40 mm, 6 mm thick, 20 mm of light, its focus some 40 mm behind."""
    return lens([(50.0, 6.0, "N-BK7"), (-40.0, 40.0, "")], pupil=20.0, field_deg=1.0)


def measured(name, telescope, **numbers):
    return pachon.operand(name, 0.0, **numbers).measure(telescope)


@pytest.mark.parametrize("name", OPTILAND)
def test_first_order_and_seidel_numbers_are_those_of_optiland(triplet, name):
    # Sums of eight terms of double precision each.
    assert measured(name, triplet) == pytest.approx(OPTILAND[name], rel=1e-11)


@pytest.mark.parametrize(("field", "pupil", "surface", "expected"), OPTILAND_RAYS)
def test_real_rays_are_those_of_optiland(triplet, field, pupil, surface, expected):
    units = (MM, MM, MM, 1.0, 1.0, 1.0, DEG)
    for name, number, unit in zip(RAYS, expected, units, strict=True):
        found = measured(name, triplet, surface=surface, field=field, pupil=pupil) / unit
        # optiland's intersections are iterated to about 1e-11 mm.
        assert found == pytest.approx(number, rel=1e-9, abs=2e-9), name


def test_focal_length_is_paraxial_wherever_the_detector_is(triplet):
    moved = apply(triplet, {"Image.dz": -1e-3})
    expected = first_order(triplet).focal_length
    assert pachon.design.FocalLength(1.0).measure(moved) == pytest.approx(expected, rel=1e-12)
    # The chief rays leave the exit pupil, 21.9 mm in front of the detector, and spread further.
    assert pachon.design.ImageScale(1.0).measure(moved) / expected - 1.0 > 3e-2
    assert pachon.design.FNumber(1.0).measure(moved) == pytest.approx(expected / triplet.pupil_diameter, rel=1e-12)


def test_focal_length_of_telescopes_of_mirrors(lsst_r):
    cassegrain = pachon.load_telescope("tests/data/zmx/HoO-V2C18Ex03.zmx")
    for telescope in (lsst_r, cassegrain, pachon.load_telescope("paul_baker")):
        expected = first_order(telescope).focal_length
        assert measured("EFFL", telescope) == pytest.approx(expected, rel=1e-11)
        assert measured("EFLY", telescope, first=telescope.surface_names[0]) == pytest.approx(expected, rel=1e-11)


def test_focal_length_of_a_folded_telescope(paraboloid):
    """A flat mirror at 45 degrees changes the place of the focus, not the focal length."""
    from dataclasses import replace

    from pachon.models.shapes.shape import Plane
    from pachon.models.surface import Interaction, Surface
    from pachon.models.telescope import VACUUM

    straight = paraboloid(2.0, 10.0)
    tilt = np.sqrt(0.5)
    axes = ((1.0, 0.0, 0.0), (0.0, tilt, tilt), (0.0, -tilt, tilt))
    fold = Surface("Fold", Interaction.MIRROR, Plane(), (0.0, 0.0, 1.5), VACUUM, rotation=axes)
    detector = replace(
        straight.surfaces[-1], vertex=(0.0, -0.5, 1.5), rotation=((1.0, 0, 0), (0, 0, 1.0), (0, -1.0, 0))
    )
    folded = replace(straight, surfaces=(straight.surfaces[0], fold, detector))
    for meridian in ("x", "y"):
        found = abs(pachon.design.FocalLength(1.0, meridian=meridian).measure(folded))
        assert found == pytest.approx(2.0, rel=1e-11)


def test_focal_length_of_one_lens_of_several(triplet):
    """Hecht, Optics, chapter 6: the lensmaker's formula of a thick lens."""
    front, back = triplet.surface("S1"), triplet.surface("S2")
    n = float(front.medium_after.index(triplet.default_wavelength) / triplet.medium_before.index(5.875618e-7))
    r1, r2, d = -1.0 / front.shape.curvature, -1.0 / back.shape.curvature, front.vertex[2] - back.vertex[2]
    power = (n - 1.0) * (1.0 / r1 - 1.0 / r2 + (n - 1.0) * d / (n * r1 * r2))
    assert measured("EFLY", triplet, first="S1", last="S2") == pytest.approx(1.0 / power, rel=1e-12)


def test_meridians_of_a_cylinder(lens):
    from dataclasses import replace

    from pachon.models.shapes.freeform import Biconic

    flat = lens([(np.inf, 2.0, "N-BK7"), (np.inf, 80.0, "")], pupil=5.0, field_deg=1.0)
    cylinder = replace(flat.surfaces[0], shape=Biconic(radius_x=-0.05, radius_y=np.inf))
    telescope = replace(flat, surfaces=(cylinder, *flat.surfaces[1:]))
    n = float(cylinder.medium_after.index(telescope.default_wavelength))
    # A flat back surface: f = R / (n - 1), whatever the thickness.
    assert measured("EFLX", telescope) == pytest.approx(0.05 / (n - 1.0), rel=1e-9)
    assert measured("EFFL", telescope) == pytest.approx(0.05 / (n - 1.0), rel=1e-9)
    with pytest.raises(DomainError, match="expected one with a focus"):
        measured("EFLY", telescope)


def test_working_focal_ratio_of_a_paraboloid(paraboloid):
    """The marginal ray of a paraboloid meets the axis at the angle 2 atan(D / 4 f)."""
    telescope = paraboloid(2.0, 2.0)
    angle = 2.0 * np.arctan(1.0 / 8.0)
    assert measured("WFNO", telescope) == pytest.approx(0.5 / np.sin(angle), rel=1e-12)
    assert measured("ISFN", telescope) == pytest.approx(2.0, rel=1e-12)


def test_paraxial_image_heights(triplet):
    infinite = measured("PIMH", triplet)
    assert infinite == pytest.approx(first_order(triplet).focal_length * np.tan(triplet.field_radius), rel=1e-12)
    near = pachon.load_telescope("tests/data/zmx/US05831776-1.zmx")
    optics = first_order(near)
    object_height = np.tan(near.field_radius) * (near.object_distance - near.stop_z)
    assert measured("PMAG", near) == pytest.approx(optics.magnification, rel=1e-12)
    assert abs(measured("PIMH", near)) == pytest.approx(abs(optics.magnification * object_height), rel=1e-12)


def test_colour_by_brute_force(triplet):
    """Axial: real rays close to the axis. Lateral: real chief rays of a small field, scaled to the edge."""
    foci = []
    for w in COLORS:
        rays = pachon.launch_rays(triplet, (0.0, 0.0), w, ([0.0], [1e-4 * triplet.pupil_diameter]))
        end = pachon.trace(triplet, rays)
        foci.append(-end.position[0, 1] / end.direction[0, 1] * abs(end.direction[0, 2]))
    # Spherical aberration goes as the square of the height, 4e-8 of some tenths of a millimetre over 0.07 mm.
    assert measured("AXCL", triplet, wavelengths=COLORS) == pytest.approx(foci[0] - foci[1], rel=1e-6)
    small = 1e-4
    heights = []
    for w in COLORS:
        rays = pachon.launch_rays(triplet, (0.0, small), w, ([0.0], [0.0]))
        heights.append(pachon.trace(triplet, rays).position[0, 1])
    expected = (heights[0] - heights[1]) * np.tan(triplet.field_radius) / np.tan(small)
    # Third-order terms of the small field are 1e-8; positions of 1e-17 m over differences of 1e-9 m.
    assert measured("LACL", triplet, wavelengths=COLORS) == pytest.approx(expected, rel=1e-6)


def test_seidel_numbers_of_surfaces_add_up(triplet):
    names = [name for name in triplet.surface_names if name not in ("S5", "Image")]
    total = sum(measured("SPHA", triplet, surface=name) for name in names)
    assert measured("SPHA", triplet) == pytest.approx(total, rel=1e-12)
    diagram = pachon.design.seidel_diagram(triplet, field=triplet.field_radius)
    found = [measured(name, triplet) for name in ("SPHA", "COMA", "ASTI", "FCUR", "DIST")]
    assert found == pytest.approx(list(diagram.total[:5]), rel=1e-12)


def test_rays_and_paths_against_the_chief_ray(triplet):
    pupil = (0.3, -0.6)
    points = 0.5 * triplet.pupil_diameter * np.array([(0.0, 0.0), pupil]).T
    rays = pachon.launch_rays(triplet, EDGE, triplet.default_wavelength, tuple(points))
    chief, ray = pachon.trace(triplet, rays).position[:, :2]
    # The axes of the file: x is reversed.
    x, y = (ray - chief) * [-1.0, 1.0]
    where = {"field": EDGE, "pupil": pupil}
    found = [measured(name, triplet, **where) for name in ("TRAX", "TRAY", "TRAR")]
    assert found == pytest.approx([x, y, np.hypot(x, y)], rel=1e-9)
    opd = pachon.wavefront_opd(triplet, EDGE, triplet.default_wavelength, (points[0, 1:], points[1, 1:])).value
    assert measured("OPDC", triplet, **where) == pytest.approx(float(opd[0]) / triplet.default_wavelength, rel=1e-9)


def test_fans_have_the_transverse_aberration(triplet):
    fans = pachon.ray_fans(triplet, [EDGE], [triplet.default_wavelength], n_points=5)
    found = [measured("TRAY", triplet, field=EDGE, pupil=(0.0, p)) for p in (-1.0, -0.5, 0.5, 1.0)]
    assert found == pytest.approx(list(fans.along[0, 0, 0, [0, 1, 3, 4]]), rel=1e-8)


def test_foci_of_a_field_point_are_those_of_the_analysis(triplet):
    curvature = pachon.field_curvature(triplet, [EDGE], [triplet.default_wavelength])
    assert measured("FCGT", triplet, field=EDGE) == pytest.approx(curvature.tangential[0, 0], rel=1e-12)
    assert measured("FCGS", triplet, field=EDGE) == pytest.approx(curvature.sagittal[0, 0], rel=1e-12)


@pytest.mark.long
def test_contrast_is_that_of_the_analysis_and_of_a_perfect_pupil(triplet, paraboloid):
    half_cutoff = 0.5e5
    # Closed form of a circular pupil at half the cut-off, 1 / (wavelength f/#); the focal ratio of a paraboloid of f/20
    # is exact but for the sine condition, 1e-4, and the lattice has 256 points.
    expected = 2.0 / np.pi * (np.arccos(0.5) - 0.5 * np.sqrt(0.75))
    on_axis = {"field": (0.0, 0.0), "frequency": half_cutoff}
    assert measured("MTFA", paraboloid(), **on_axis) == pytest.approx(expected, rel=1e-3)
    curves = pachon.mtf(triplet, [EDGE], triplet.default_wavelength, n_pupil=96)
    where = {"field": EDGE, "frequency": 2e4, "wavelengths": (triplet.default_wavelength,), "n_pupil": 96}
    sagittal, tangential, mean = (measured(name, triplet, **where) for name in ("MTFS", "MTFT", "MTFA"))
    assert sagittal == pytest.approx(np.interp(2e4, curves.frequency, curves.sagittal[0]), abs=1e-12)
    assert tangential == pytest.approx(np.interp(2e4, curves.frequency, curves.tangential[0]), abs=1e-12)
    assert mean == pytest.approx(0.5 * (sagittal + tangential), abs=1e-15)


def test_lengths_of_a_lens(biconvex, triplet):
    assert measured("TOTR", biconvex) == pytest.approx(46e-3)
    assert measured("OAL", biconvex) == pytest.approx(6e-3)
    assert measured("TTHI", biconvex) == pytest.approx(46e-3)
    assert measured("TTHI", biconvex, first="S1", last="S1") == pytest.approx(6e-3)
    assert measured("CVVA", biconvex, surface="S1") == pytest.approx(20.0)
    assert measured("CVVA", biconvex, surface="S2") == pytest.approx(-25.0)
    assert measured("COVA", biconvex, surface="S1") == 0.0
    # Thicknesses of the file in mm; the stop divides an interval of air.
    air, glass = (2.6377501487731934, 0.7544687986373901, 1.6761058568954468), (5.514017105, 1.017357349, 1.609628081)
    assert measured("MNCA", triplet) == pytest.approx(min(air) * MM)
    assert measured("MXCA", triplet) == pytest.approx(max(air) * MM)
    assert measured("MNCG", triplet) == pytest.approx(min(glass) * MM)
    assert measured("MXT", triplet) == pytest.approx(max(glass) * MM)
    assert measured("MNCT", triplet, first="S2", last="S7") == pytest.approx(min(air) * MM)
    assert measured("MXCA", triplet, first="S7", last="S7") == pytest.approx(18.660079956 * MM)
    edges = [measured("ETVA", triplet, surface=name) for name in ("S1", "S3", "S6")]
    assert measured("MNEG", triplet) == min(edges)
    assert measured("MXEG", triplet) == max(edges)
    # optiland 0.6.3: edge_thickness at its semi-apertures, which are those of the paraxial light too.
    assert edges[:2] == pytest.approx([3.47893204 * MM, 2.01840078 * MM], abs=1e-11)


@pytest.mark.parametrize("name", ["EFFL", "EFLX", "ISFN"])
def test_exact_derivatives_of_the_focal_length(triplet, slope, name):
    parameters = parse_parameters(["S1.curvature", "S3.thickness", "N-SF2.n", "S4.conic"], triplet)
    operand = pachon.operand(name, 1.0)
    assert operand.exact
    _, change = operand.gradient(ParameterColumns.at(triplet, parameters))
    for i, (parameter, step) in enumerate(zip(parameters, (1e-2, 1e-6, 1e-5, 1e-3), strict=True)):
        numeric = slope(lambda h, p=parameter: operand.measure(apply(triplet, {p: h})), step)
        # The conic constant changes nothing near the axis.
        assert change[i] == pytest.approx(numeric, rel=1e-6, abs=1e-10)


@pytest.mark.long
def test_an_optimum_holds_named_operands(biconvex):
    targets = [
        pachon.operand("EFFL", 45e-3, weight=10.0),
        pachon.operand("CTGT", 7e-3, surface="S1", weight=10.0),
        pachon.operand("PIMH", maximum=1.0),
    ]
    variables = ["S1.radius", "S1.thickness", "S2.thickness"]
    result = pachon.optimize(
        biconvex, variables, targets=targets, n_pupil=3, solver=pachon.design.LeastSquares(max_steps=20)
    )
    ends = {change.operand.label: change.end for change in result.operands}
    assert ends["EFFL"] == pytest.approx(first_order(result.telescope).focal_length, rel=1e-10)
    assert ends["EFFL"] == pytest.approx(45e-3, rel=1e-4)
    assert ends["CTGT(S1)"] >= 7e-3 - 1e-6


def test_targets_of_limits():
    assert pachon.operand("CTGT", 2e-3, surface="S1").goal_text(MM) == ">= 2"
    assert pachon.operand("MXCG", 2e-3).goal_text(MM) == "<= 2"
    assert pachon.operand("CTVA", 2e-3, surface="S1").goal_text(MM) == "= 2"
    assert pachon.operand("EFFL", minimum=0.04, maximum=0.06).message_goal == "EFFL >= 40, <= 60 mm"


@pytest.mark.parametrize(
    ("operands", "words"),
    [
        ((("EFFL", 0.05, {}), ("EFFL", 0.06, {})), "operands EFFL = 50 mm and EFFL = 60 mm contradict each other"),
        ((("EFFL", 0.05, {}), ("EFL", 0.06, {})), "operands EFFL = 50 mm and EFL = 60 mm contradict each other"),
        ((("CTGT", 5e-3, {"surface": "S1"}), ("CTLT", 4e-3, {"surface": "S1"})), "CTGT(S1) >= 5 mm and CTLT(S1) <= 4"),
        ((("CTVA", 5e-3, {"surface": "S1"}), ("CT", 5e-3, {"surface": "S1"})), "CT(S1) is given twice"),
        ((("MNCG", 1e-3, {}), ("MNT", 2e-3, {})), "operand MNT is given twice"),
    ],
)
def test_contradictory_operands(operands, words):
    with pytest.raises(ConfigError, match=re.escape(words)) as caught:
        check_operands(tuple(pachon.operand(name, value, **numbers) for name, value, numbers in operands))
    assert "\n" not in str(caught.value)


def test_a_minimum_and_a_maximum_may_stand_apart():
    check_operands((pachon.operand("CTGT", 1e-3, surface="S1"), pachon.operand("CTLT", 2e-3, surface="S1")))
    native = (pachon.design.FocalLength(minimum=0.04), pachon.operand("EFFL", maximum=0.05))
    check_operands(native)
    with pytest.raises(ConfigError, match=r"focal_length >= 40 mm and EFFL = 30 mm contradict"):
        check_operands((native[0], pachon.operand("EFFL", 0.03)))


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: pachon.operand("EFFK", 1.0), UnknownNameError, "did you mean EFFL"),
        (lambda: pachon.operand("MTFA", 0.5, field=EDGE), ConfigError, "MTFA: frequency is missing"),
        (lambda: pachon.operand("CTGT", 1.0, surfaces="S1"), UnknownNameError, "did you mean surface"),
        (lambda: pachon.operand("CTGT", 1.0, minimum=2.0, surface="S1"), ConfigError, "target and minimum are given"),
        (lambda: pachon.operand("EFFL"), ConfigError, "EFFL: expected either a value"),
        (lambda: pachon.operand("MTFA", 0.5, field=EDGE, frequency=-1.0), DomainError, "frequency"),
    ],
)
def test_wrong_operands_in_one_line(make, error, words):
    with pytest.raises(error, match=words) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "numbers", "words"),
    [
        ("REAY", {"surface": "S33"}, "S33"),
        ("EFLY", {"first": "S2", "last": "S1"}, "expected the last not in front"),
        ("MNCG", {"first": "S2", "last": "S2"}, "expected glass between"),
        ("SPHA", {"surface": "Image"}, "expected a mirror or lens surface"),
        ("AXCL", {"wavelengths": (1e-7, 5e-7)}, "1e-07|100"),
    ],
)
def test_numbers_that_a_telescope_does_not_have(biconvex, name, numbers, words):
    with pytest.raises(PachonError, match=words) as caught:
        measured(name, biconvex, **numbers)
    assert "\n" not in str(caught.value)


def test_the_page_lists_every_name():
    page = (Path(__file__).parents[3] / "docs" / "reference" / "operands.md").read_text(encoding="utf-8")
    listed = re.findall(r"`([A-Z]{2,4})`", page.partition("## What is not there")[0])
    assert sorted(set(listed)) == sorted(NAMES)


def test_the_command_lists_and_measures(capsys):
    assert main(["operands"]) == 0
    assert "effective focal length" in capsys.readouterr().out
    assert main(["operands", "tests/data/zmx/lens1.zmx", "--operand", "REAY surface=Image field_deg=0,12"]) == 0
    assert "REAY(Image, 0 12 deg, 0 0)" in capsys.readouterr().out
    assert main(["operands", "tests/data/zmx/lens1.zmx", "--operand", "EFFK"]) == 2
    assert "did you mean EFFL" in capsys.readouterr().err
    assert main(["operands", "--operand", "EFFL"]) == 2
    assert "expected the telescope" in capsys.readouterr().err


def test_the_command_measures_what_needs_no_keys(capsys):
    import json

    assert main(["operands", "paul_baker", "--json"]) == 0
    rows = {row["operand"]: row for row in json.loads(capsys.readouterr().out)["operands"]}
    assert rows["EFFL"]["number"] == pytest.approx(33600.0, rel=1e-12)
    # A telescope of mirrors has no glass: the reason stands in place of a number.
    assert rows["MNCG"]["number"] is None
    assert "expected glass" in rows["MNCG"]["definition"]


@pytest.mark.long
@pytest.mark.parametrize("address", ["S1.curvature", pytest.param("S3.thickness", marks=pytest.mark.slow)])
def test_numbers_are_smooth_where_derivatives_are_differences(triplet, address):
    """Central differences of two steps agree: no noise and no jumps at the size of the solver's steps."""
    numbers = {"surface": "S3", "field": EDGE, "pupil": (0.1, 0.7), "first": "S3", "last": "S4"}
    step = {"S1.curvature": 1e-3, "S3.thickness": 1e-6}[address]
    for name, entry in NAMES.items():
        if name.startswith("MTF"):
            continue
        keys = {k: v for k, v in numbers.items() if k in entry_fields(entry)}
        if name in ("MNCA", "MNEA", "MXCA", "MXEA"):
            keys |= {"last": "S6"}
        operand = pachon.operand(name, 0.0, **keys)
        moved = [operand.measure(apply(triplet, {address: sign * step * f})) for f in (1.0, 0.5) for sign in (1, -1)]
        wide, narrow = (moved[0] - moved[1]) / (2.0 * step), (moved[2] - moved[3]) / step
        # Third order of the steps, and rounding of 1e-14 of the number over the step.
        assert wide == pytest.approx(narrow, rel=1e-4, abs=1e-12 * max(1e-3, abs(moved[0])) / step), name


def test_focal_length_of_a_lens_for_a_near_object():
    """That of parallel light all the same; this lens states a numerical aperture, which a distant object has not."""
    near = pachon.load_telescope("tests/data/zmx/US05831776-1.zmx")
    # The power of 40 surfaces almost cancels: a hundredth of that of its elements.
    assert measured("EFFL", near) == pytest.approx(first_order(near).focal_length, rel=1e-8)
