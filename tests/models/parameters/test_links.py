"""Pickups and solves, against the same telescopes with the linked values typed by hand, and differences."""

from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError, PrescriptionError
from pachon.design.optimize.jacobian import ParameterColumns
from pachon.design.optimize.merit import Beams, SpotMerit
from pachon.design.optimize.variables import free_variables
from pachon.models.parameters.parameters import apply, parse_parameters

LENS = Path(__file__).parents[2] / "data" / "zmx" / "lens1.zmx"
FIELDS = np.deg2rad([[0.0, 0.0], [0.0, 8.0]])


@pytest.fixture(scope="module")
def lens():
    return pachon.load_telescope(LENS)


def linked(lens, *links):
    return lens.with_design(
        pickups=tuple(one for one in links if isinstance(one, pachon.models.Pickup)),
        solves=tuple(one for one in links if isinstance(one, pachon.models.Solve)),
    )


def bare(telescope):
    return telescope.with_design(pickups=(), solves=())


def same(one, other):
    """Compare shapes, media and places of the surfaces."""
    for a, b in zip(one.surfaces, other.surfaces, strict=True):
        assert a.shape.parameters == pytest.approx(b.shape.parameters, rel=1e-12)
        assert a.vertex == pytest.approx(b.vertex, abs=1e-15)
        assert a.medium_after == b.medium_after


def thickness(telescope, name):
    i = telescope.surface_names.index(name)
    return telescope.surfaces[i].vertex[2] - telescope.surfaces[i + 1].vertex[2]


def test_values_follow_as_if_typed_by_hand(lens):
    radii = {n: lens.surface(n).shape.radius for n in ("S1", "S7")}
    telescope = linked(
        lens,
        pachon.models.Pickup("S7", "radius", "S1", scale=radii["S7"] / radii["S1"]),
        pachon.models.Pickup("S4", "radius", "S7", scale=2.0, offset=lens.surface("S4").shape.radius - 2 * radii["S7"]),
        pachon.models.Pickup("S6", "conic", "S1", scale=-1.0),
        pachon.models.Pickup(
            "S6", "thickness", "S1", scale=0.5, offset=thickness(lens, "S6") - 0.5 * thickness(lens, "S1")
        ),
        pachon.models.Pickup("S6", "glass", "S1"),
    )
    changed = apply(telescope, {"S1.radius": 2e-4, "S1.conic": 0.1, "S1.thickness": 1e-4, "S1.n": 1e-3, "S3.n": 2e-3})
    by_hand = {
        "S1.radius": 2e-4,
        "S7.radius": 2e-4 * radii["S7"] / radii["S1"],
        # A follower of a follower.
        "S4.radius": 4e-4 * radii["S7"] / radii["S1"],
        "S1.conic": 0.1,
        "S6.conic": -0.1,
        "S1.thickness": 1e-4,
        "S6.thickness": 5e-5,
        "S1.n": 1e-3,
        "S6.n": 1e-3,
        "S3.n": 2e-3,
    }
    same(changed, apply(lens, by_hand))
    assert changed.design_data.pickups == telescope.design_data.pickups
    # A curvature is the reciprocal; a change of the follower comes on top, motions are not followed.
    start = 1 / radii["S1"]
    bent = apply(telescope, {free_variables([telescope], ["S1.radius"])[0].parameters[0]: 1e-2})
    assert bent.surface("S7").shape.radius == pytest.approx(radii["S7"] / radii["S1"] / (start + 1e-2), rel=1e-12)
    own = apply(telescope, {"S7.radius": 1e-4, "S1.radius": 2e-4})
    expected = radii["S7"] + 1e-4 + 2e-4 * radii["S7"] / radii["S1"]
    assert own.surface("S7").shape.radius == pytest.approx(expected, rel=1e-14)
    assert apply(telescope, {"S1.dy": 1e-4}).surface("S7") == lens.surface("S7")
    # `perturbed` keeps the links.
    assert telescope.perturbed("S1", shift=(0, 0, 1e-4)).design_data == telescope.design_data


def test_the_back_focus_is_solved_for(lens):
    telescope = linked(lens, pachon.models.Solve("S7", "marginal_height"))
    for change in ({"S1.radius": 3e-4}, {"S2.thickness": 2e-4}, {"S3.n": 1e-3}, {"S3.radius": 1e-4, "S7.conic": 0.2}):
        changed = apply(telescope, change)
        # The image stands in the paraxial focus of the same lens with any back focus.
        focus = pachon.first_order(apply(lens, change)).focus_z
        assert changed.surfaces[-1].vertex[2] == pytest.approx(focus, abs=1e-15)
    # The height of 0.1 mm: a ray through the rim of the pupil falls by it in proportion to the distance.
    high = apply(linked(lens, pachon.models.Solve("S7", "marginal_height", 1e-4)), {"S1.thickness": 1e-4})
    optics = pachon.first_order(high)
    before_focus = high.surfaces[-1].vertex[2] - optics.focus_z
    assert before_focus == pytest.approx(1e-4 * 2 * optics.f_number, rel=1e-9)
    # A tilted telescope keeps its thickness.
    tilted = apply(telescope.perturbed("S3", tilt=(1e-3, 0, 0)), {"S1.radius": 3e-4})
    assert thickness(tilted, "S7") == thickness(lens, "S7")


def test_an_edge_and_a_chief_ray_are_solved_for(lens):
    edge = apply(linked(lens, pachon.models.Solve("S1", "edge_thickness", 8e-4, radius=4e-3)), {"S1.radius": 2e-4})
    first, second = edge.surface("S1"), edge.surface("S2")
    there = [float(s.shape.sag(0.0, 4e-3)) + s.vertex[2] for s in (first, second)]
    assert there[0] - there[1] == pytest.approx(8e-4, rel=1e-12)
    # The chief ray leaves the exit pupil with a slope by Lagrange's invariant: the diameters of the pupils.
    chief = apply(linked(lens, pachon.models.Solve("S7", "chief_height", 5e-3)), {"S1.thickness": 1e-5})
    optics = pachon.first_order(chief)
    slope = np.tan(lens.field_radius) * optics.entrance_pupil_diameter / optics.exit_pupil_diameter
    assert optics.exit_pupil_z - chief.surfaces[-1].vertex[2] == pytest.approx(5e-3 / slope, rel=1e-12)
    with pytest.raises(DomainError, match=r"solve S1.edge_thickness: expected surfaces that reach"):
        apply(linked(lens, pachon.models.Solve("S1", "edge_thickness", 8e-4, radius=1.0)), {"S1.radius": 2e-4})


@pytest.mark.long
def test_derivatives_are_those_of_differences(lens):
    radii = {n: lens.surface(n).shape.radius for n in ("S1", "S7")}
    telescope = linked(
        lens,
        pachon.models.Pickup("S7", "radius", "S1", offset=radii["S7"] - radii["S1"]),
        pachon.models.Pickup("S6", "glass", "S1"),
        pachon.models.Solve("S7", "marginal_height"),
        pachon.models.Solve("S3", "edge_thickness", 2e-3, radius=2e-3),
    )
    merit = SpotMerit(telescope, Beams.of(telescope, FIELDS, n_pupil=2))
    names = ("S1.radius", "S3.radius", "S1.n", "S2.thickness", "S3.dy")
    parameters = (*parse_parameters(names, telescope), free_variables([telescope], ["S4.radius"])[0].parameters[0])
    start = np.array([1e-5, 1e-5, 1e-5, 1e-5, 1e-6, 1e-3])
    values, slopes = merit.derivatives(ParameterColumns.at(telescope, parameters, start))

    def residuals(changes):
        return merit.residuals(apply(telescope, dict(zip(parameters, changes, strict=True))))

    assert values == pytest.approx(residuals(start), abs=1e-15)
    for i, step in enumerate((1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-4)):
        moved = step * np.eye(len(parameters))[i]
        # Differences of fourth order: the third derivatives go out.
        near, far = (residuals(start + k * moved) - residuals(start - k * moved) for k in (1, 2))
        expected = (8 * near - far) / (12 * step)
        assert np.abs(slopes[:, i] - expected).max() < 1e-6 * np.abs(expected).max(), parameters[i].address


@pytest.mark.long
def test_an_optimum_keeps_the_links(lens):
    telescope = linked(lens, pachon.models.Solve("S7", "marginal_height"))
    # The image of the file is out of focus: the solve is met from the start.
    shifted = telescope.perturbed("Image", shift=(0, 0, -1e-3))
    optimum = pachon.optimize(
        shifted, ["S1.radius", "S4.radius"], "spots", FIELDS, n_pupil=2, solver=pachon.design.LeastSquares(max_steps=3)
    )
    found, start = optimum.telescope, optimum.start_telescopes[0]
    assert start.surfaces[-1].vertex[2] == pytest.approx(pachon.first_order(start).focus_z, abs=1e-15)
    stated = telescope.with_design(aperture="f_number", aperture_value=pachon.first_order(lens).f_number)
    bent = pachon.optimize(
        stated, ["S1.radius"], "spots", FIELDS, n_pupil=2, solver=pachon.design.LeastSquares(max_steps=3)
    ).telescope.design_data
    assert (bent.aperture, bent.aperture_value) == ("entrance_pupil", lens.pupil_diameter)
    assert found.surface("S1") != lens.surface("S1")
    assert found.surfaces[-1].vertex[2] == pytest.approx(pachon.first_order(found).focus_z, abs=1e-12)
    with pytest.raises(ConfigError, match=r"variable S7.thickness follows other values"):
        pachon.optimize(telescope, ["S7.thickness"], "spots", FIELDS, n_pupil=2)


@pytest.mark.parametrize(
    ("links", "words"),
    [
        ([("S7", "radius", "S7")], "another surface than S7"),
        ([("S7", "colour", "S1")], "expected one of radius"),
        ([("S9", "radius", "S1")], "'S9': expected the name of a surface"),
        ([("S7", "radius", "S1"), ("S7", "radius", "S2")], "follows another value already"),
        ([("S7", "radius", "S1"), ("S1", "radius", "S7")], "follows itself"),
        ([("S7", "radius", "S1", 0.0)], "scale = 0.0"),
        ([("S7", "glass", "S1", 2.0)], "no scale"),
        ([("Image", "thickness", "S1")], "a surface with another one behind it"),
    ],
)
def test_wrong_pickups_are_one_line(lens, links, words):
    with pytest.raises(PrescriptionError, match=words):
        linked(lens, *(pachon.models.Pickup(*one) for one in links))


@pytest.mark.parametrize(
    ("solve", "words"),
    [
        (("S7", "height"), "expected one of marginal_height"),
        (("S7", "marginal_height", 0.0, 1.0), "for an edge thickness alone"),
        (("S7", "edge_thickness", 1e-3), "expected a positive one"),
        (("S7", "chief_height", float("inf")), "expected finite numbers"),
    ],
)
def test_wrong_solves_are_one_line(lens, solve, words):
    with pytest.raises(PrescriptionError, match=words):
        linked(lens, pachon.models.Solve(*solve))
