"""Tolerances of files as degrees of freedom: elements, compounds, irregularities, what replaces what."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError, PachonError, UnknownNameError
from pachon.models.media.medium import abbe_number
from pachon.models.shapes.freeform import Biconic, Toroid
from pachon.models.shapes.polynomial import XYPolynomial
from pachon.models.shapes.shape import EvenAsphere
from pachon.models.shapes.sum import Sum
from pachon.studies.tolerance.file import ToleranceFile, load_tolerances
from pachon.studies.tolerance.plan import tolerance_plan, with_elements

LENS = Path(__file__).parents[2] / "data" / "zmx" / "lens1.zmx"


@pytest.fixture(scope="module")
def triplet():
    return pachon.load_telescope(LENS)


def plan_of(triplet, **content):
    return tolerance_plan(ToleranceFile.model_validate(content), triplet)


def moved(plan, **values):
    names = {name.replace(".", "_").replace(" ", "_"): name for name in plan.degrees_of_freedom.names}
    return plan.degrees_of_freedom.apply(plan.telescope, {names[k]: v for k, v in values.items()})


def test_elements_are_groups(triplet, lsst_r):
    lens, names = with_elements(triplet)
    assert names == ("L1", "L2", "L3")
    assert [lens.groups[n] for n in names] == [("S1", "S2"), ("S3", "S4"), ("S6", "S7")]
    telescope, known = with_elements(lsst_r)
    # The camera's own groups are its elements.
    assert known == ("L1", "L2", "Filter", "L3")
    assert dict(telescope.groups) == dict(lsst_r.groups)
    glued = replace(triplet.surface("S2"), medium_after=triplet.surface("S3").medium_after)
    cemented = replace(triplet, surfaces=tuple(glued if s.name == "S2" else s for s in triplet.surfaces))
    together, names = with_elements(cemented)
    assert together.groups[names[0]] == ("S1", "S2", "S3", "S4")


def test_tolerances_of_all_surfaces_elements_and_gaps(triplet):
    plan = plan_of(
        triplet,
        surfaces={"radius_percent": 0.1},
        elements={"thickness_um": 10, "tilt_arcmin": 1, "wedge_arcmin": 1, "index": 1e-4, "abbe_percent": 0.5},
        gaps={"thickness_um": 20},
    )
    names = [t.name for t in plan.tolerances]
    assert names[:6] == [f"S{i}.radius_percent" for i in (1, 2, 3, 4, 6, 7)]
    assert {n for n in names if n.startswith("L2")} == {
        "L2.rx_arcmin",
        "L2.ry_arcmin",
        "L2.wedge_x_arcmin",
        "L2.wedge_y_arcmin",
    }
    thicknesses = {t.name: t.size for t in plan.tolerances if "thickness" in t.name}
    assert thicknesses == {f"S{i}.thickness_um": 10 if i in (1, 3, 6) else 20 for i in (1, 2, 3, 4, 6)}
    assert {n for n in names if n.endswith((".n", "abbe_percent"))} == {
        f"S{i}.{what}" for i in (1, 3, 6) for what in ("n", "abbe_percent")
    }


def test_percentages_of_radii_that_are_two_or_none(triplet):
    plate = Sum((EvenAsphere(np.inf, 0.0, (1.0,)), XYPolynomial(((2, 0, 1.0), (0, 2, 1.0)))))
    shapes = {"S1": Toroid(0.02, np.inf, 0.0, ()), "S2": Biconic(0.05, -0.04, 0.0, -1.0), "S3": plate}
    surfaces = tuple(replace(s, shape=shapes.get(s.name, s.shape)) for s in triplet.surfaces)
    plan = plan_of(replace(triplet, surfaces=surfaces), surfaces={"radius_percent": 1})
    names = [t.name for t in plan.tolerances]
    assert names[:4] == ["S1.radius_x_percent", "S2.radius_x_percent", "S2.radius_y_percent", "S4.radius_percent"]
    changed = moved(plan, S2_radius_y_percent=2.0).surface("S2").shape
    assert (changed.radius_x, changed.radius_y) == (0.05, pytest.approx(-0.0408))
    with pytest.raises(DomainError, match=r"S3.radius: expected S3.curvature, for S3 is flat"):
        plan_of(plan.telescope, tolerances=[{"name": "S3.radius_percent", "size": 1}])


def test_what_the_numbers_mean(triplet):
    plan = plan_of(
        triplet,
        surfaces={"radius_percent": 0.1},
        elements={"wedge_arcmin": 1, "abbe_percent": 0.5, "decentre_um": 5},
        tolerances=[{"name": "S2.radius_mm", "size": 1}, {"name": "S3.dz_um", "size": 4}],
    )
    changed = moved(plan, S1_radius_percent=2.0)
    assert changed.surface("S1").shape.radius == pytest.approx(1.02 * triplet.surface("S1").shape.radius)
    arcmin = np.deg2rad(1 / 60)
    wedge = moved(plan, L2_wedge_x_arcmin=3.0)
    assert wedge.surface("S3") == triplet.surface("S3")
    assert wedge.surface("S4").matrix == pytest.approx(
        triplet.perturbed("S4", tilt=(3 * arcmin, 0, 0)).surface("S4").matrix
    )
    glass = moved(plan, S6_abbe_percent=-10.0).surface("S6").medium_after
    assert abbe_number(glass) == pytest.approx(0.9 * abbe_number(triplet.surface("S6").medium_after))
    both = moved(plan, L1_dx_um=7.0)
    assert [both.surface(n).vertex[0] for n in ("S1", "S2", "S3")] == pytest.approx([7e-6, 7e-6, 0.0])
    assert moved(plan, S2_radius_mm=1.0).surface("S2").shape.radius == pytest.approx(0.1812574754401636 + 1e-3)


def test_an_irregularity_has_its_rms(triplet):
    """Draws of its terms add up to a sag of that rms over the clear aperture, falling with the radial order."""
    plan = plan_of(triplet, tolerances=[{"name": "S3.irregularity_nm", "size": 50, "zernikes": [5, 15], "power": 3}])
    sizes = {t.name: t.size for t in plan.tolerances}
    assert len(sizes) == 11
    assert np.sqrt(sum(s**2 for s in sizes.values())) == pytest.approx(50)
    # Noll 5 has the radial order 2, 11 the order 4.
    ratio = sizes["S3.irregularity_nm Z5"] / sizes["S3.irregularity_nm Z11"]
    assert ratio == pytest.approx((4 / 2) ** 1.5)
    rng = np.random.default_rng(4)
    y, x = np.mgrid[-1:1:41j, -1:1:41j]
    inside = np.hypot(x, y) <= 1
    radius = pachon.design.optimize.geometry_operands.clear_radius(triplet, "S3")
    squares = []
    for _ in range(40):
        values = {t.name: t.size * rng.normal() for t in plan.tolerances}
        shape = plan.degrees_of_freedom.apply(plan.telescope, values).surface("S3").shape
        sag = shape.sag(x[inside] * radius, y[inside] * radius) - triplet.surface("S3").shape.sag(
            x[inside] * radius, y[inside] * radius
        )
        squares.append(np.mean(sag**2))
    # Forty sums of eleven squares, few of them large: 5 standard errors are 25 per cent.
    assert np.sqrt(np.mean(squares)) == pytest.approx(50e-9, rel=0.25)


def test_single_tolerances_replace_those_of_all(triplet):
    plan = plan_of(
        triplet,
        surfaces={"irregularity_nm": 40, "radius_percent": 0.1},
        tolerances=[
            {"name": "S1.irregularity_nm", "size": 10, "zernikes": [5, 6]},
            {"name": "S1.radius_percent", "size": 0.3, "distribution": "normal"},
        ],
        distribution="end_point",
    )
    found = {t.name: t for t in plan.tolerances}
    assert {n for n in found if n.startswith("S1.irr")} == {"S1.irregularity_nm Z5", "S1.irregularity_nm Z6"}
    assert len([n for n in found if n.startswith("S2.irr")]) == 11
    assert (found["S1.radius_percent"].size, found["S1.radius_percent"].distribution) == (0.3, "normal")
    assert found["S2.radius_percent"].distribution == "end_point"


def test_groups_and_mirrors(lsst_r):
    """A group of the telescope tilts about its own pivot; mirrors have radii and irregularities as lenses do."""
    content = {"surfaces": {"irregularity_nm": 20}, "tolerances": [{"name": "Camera.tilt_arcmin", "size": 1}]}
    plan = plan_of(lsst_r, **content)
    assert {"M1.irregularity_nm Z5", "M3.irregularity_nm Z15", "L3_exit.irregularity_nm Z9"} <= {
        t.name for t in plan.tolerances
    }
    tilted = moved(plan, Camera_rx_arcmin=2.0)
    expected = lsst_r.perturbed("Camera", tilt=(np.deg2rad(2.0 / 60.0), 0.0, 0.0))
    for name in ("L1_entrance", "Detector"):
        assert tilted.surface(name).vertex == pytest.approx(expected.surface(name).vertex, abs=1e-12)


def test_a_mirror_within_glass_has_no_index_of_its_own(triplet):
    """Light of a Mangin mirror is in the glass of its first surface until it leaves."""
    front, back = triplet.surface("S1"), triplet.surface("S2")
    mirror = replace(back, interaction=pachon.Interaction.MIRROR, medium_after=front.medium_after)
    mangin = replace(triplet, surfaces=tuple(mirror if s.name == "S2" else s for s in triplet.surfaces))
    plan = plan_of(mangin, elements={"index": 1e-4, "abbe_percent": 1.0, "thickness_um": 5})
    names = {t.name for t in plan.tolerances}
    assert {"S1.n", "S1.abbe_percent", "S2.thickness_um"} <= names
    assert not {"S2.n", "S2.abbe_percent"} & names


def test_named_degrees_of_freedom(lsst_r):
    content = dict(degrees_of_freedom="lsst", tolerances=[{"name": "M1M3_B3", "size": 0.1}], compensators=["Camera_dz"])
    plan = plan_of(lsst_r, **content)
    assert plan.degrees_of_freedom.names == ("M1M3_B3", "Camera_dz")
    assert plan.degrees_of_freedom.units == ("um", "um")


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        ({}, ConfigError, "tolerances = \\[\\]"),
        ({"tolerances": [{"name": "S9.dz_um", "size": 1}]}, UnknownNameError, r"tolerances.0.*S9"),
        ({"tolerances": [{"name": "S1.dz", "size": 1}]}, ConfigError, r"tolerances.0.S1.dz: .*unit"),
        ({"tolerances": [{"name": "S1.wedge_arcmin", "size": 1}]}, UnknownNameError, r"wedge.*L1"),
        ({"tolerances": [{"name": "Image.irregularity_nm", "size": 1}]}, ConfigError, "clear aperture"),
        ({"tolerances": [{"name": "S1.irregularity_nm", "size": 1, "zernikes": [9, 5]}]}, ConfigError, "rise, from 4"),
        ({"tolerances": [{"name": "S1.dz_um", "size": 1, "limit": 2}]}, ConfigError, "truncated"),
        (
            {"tolerances": [{"name": "S1.dz_um", "size": 1}], "compensators": ["S1.dz_um"]},
            ConfigError,
            "either a tolerance or a compensator",
        ),
        (
            {"tolerances": [{"name": "S1.dz_um", "size": 1}], "compensators": ["X.dz_um"]},
            UnknownNameError,
            "compensators.*X",
        ),
        ({"tolerances": [{"name": "L2.decentre", "size": 5}]}, ConfigError, "unit at the end, such as L2.decentre_um"),
        ({"tolerances": [{"name": "L2.tilt_mm", "size": 5}]}, ConfigError, "unit at the end, such as L2.tilt_arcmin"),
    ],
)
def test_wrong_tolerances(triplet, content, error, words):
    with pytest.raises(error, match=words):
        plan_of(triplet, **content)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("merit: beauty", "merit.*spots"),
        ("sirfaces: {}", "unknown key sirfaces.*surfaces"),
        ("elements: {wedge_arcmin: -1}", "elements.wedge_arcmin"),
        ("merit: mtf", "frequency_per_mm"),
        ("{merit: ee80, method: linear}", "method = 'linear'.*ee80"),
        ("draws: 0", "draws"),
    ],
)
def test_wrong_files(tmp_path, text, words):
    path = tmp_path / "tol.yaml"
    path.write_text(text)
    with pytest.raises(PachonError, match=words) as caught:
        load_tolerances(path, "paul_baker")
    assert str(path) in str(caught.value)


def test_a_file_without_a_telescope(tmp_path):
    path = tmp_path / "tol.yaml"
    path.write_text("draws: 5")
    with pytest.raises(ConfigError, match="telescope is missing"):
        load_tolerances(path)


def test_a_compensator_without_effect(triplet):
    content = {"tolerances": [{"name": "S1.dx_um", "size": 1}], "compensators": ["Image.dx_um"], "draws": 2, "rings": 2}
    with pytest.raises(DomainError, match=r"compensator 'Image.dx_um' has no effect"):
        pachon.run_tolerances(triplet, ToleranceFile.model_validate(content))


def test_what_follows_other_values_has_no_tolerance_of_its_own(triplet):
    pickups = (pachon.models.Pickup("S7", "radius", "S1"), pachon.models.Pickup("S6", "glass", "S1"))
    solves = (pachon.models.Solve("S4", "edge_thickness", 1e-3, radius=1e-3),)
    linked = triplet.with_design(pickups=pickups, solves=solves)
    content = {
        "surfaces": {"radius_percent": 0.1},
        "elements": {"index": 1e-3, "thickness_um": 5},
        "gaps": {"thickness_um": 5},
    }
    names = [{t.name for t in plan_of(one, **content).tolerances} for one in (triplet, linked)]
    assert names[0] - names[1] == {"S7.radius_percent", "S6.n", "S4.thickness_um"}
    assert names[1] < names[0]


def test_a_quantity_in_another_unit_is_the_same_one(triplet):
    """Of the list it replaces that of all surfaces; twice in the list it is refused."""
    plan = plan_of(triplet, surfaces={"radius_percent": 0.1}, tolerances=[{"name": "S3.radius_um", "size": 5}])
    assert [t.name for t in plan.tolerances if t.name.startswith("S3.")] == ["S3.radius_um"]
    names = [{"name": f"S3.radius_{unit}", "size": 1} for unit in ("mm", "percent")]
    with pytest.raises(ConfigError, match=r"tolerances\.1\.S3\.radius_percent is S3.radius_mm once more"):
        plan_of(triplet, tolerances=names)
