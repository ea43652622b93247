"""Textbook designs found again: achromat, triplet, Ritchey-Chretien, a corrector of another glass; configurations."""

import functools
from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError, UnknownNameError
from pachon.design.optimize import glass_choice
from pachon.design.optimize.merit import Beams, SpotMerit
from pachon.design.optimize.optimize import optimize
from pachon.models.io.glass_catalogue import GlassCatalogue
from pachon.models.media.medium import abbe_number
from pachon.models.parameters.parameters import apply
from pachon.models.shapes.shape import Plane, Sphere
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope

D, F, C = 587.5618e-9, 486.1327e-9, 656.2725e-9
ACHROMAT = ["S1.curvature", "S2.curvature", "S3.curvature"]


@pytest.fixture(scope="module")
def doublet(lens):
    """Crown and flint, cemented, nearly flat: powers far from those of an achromat of f = 100 mm."""
    flat = lens([(np.inf, 4.0, "N-BK7"), (np.inf, 2.0, "F2"), (np.inf, 100.0, "")], pupil=5.0, field_deg=0.5)
    return apply(flat, {"S1.curvature": -10.0, "S2.curvature": 5.0})


def test_an_achromatic_doublet(doublet):
    """Powers of thin lenses in contact: V1 / (V1 - V2) and -V2 / (V1 - V2) of the whole."""
    found = optimize(
        doublet, ACHROMAT, "spots", [[0.0, 0.0]], [D, F, C], targets=[pachon.design.FocalLength(0.1)], n_pupil=3
    )
    crown, flint = (found.telescope.surface(name).medium_after for name in ("S1", "S2"))
    first, second, third = (-found.telescope.surface(name).shape.curvature for name in ("S1", "S2", "S3"))
    v1, v2 = abbe_number(crown), abbe_number(flint)
    powers = (float(crown.index(D)) - 1.0) * (first - second), (float(flint.index(D)) - 1.0) * (second - third)
    # The lenses are 6 mm thick, on 100 mm.
    assert powers[0] == pytest.approx(10.0 * v1 / (v1 - v2), rel=0.01)
    assert powers[1] == pytest.approx(-10.0 * v2 / (v1 - v2), rel=0.01)
    assert found.operands[0].end == pytest.approx(0.1, rel=1e-5)
    # Secondary spectrum is left: between the foci of d and F lie f (P1 - P2) / (V1 - V2), less than f / 2000.
    assert found.merits[1] < 1e-6 < 0.9e-3 < found.merits[0]


def test_two_numbers(doublet):
    """The rms of the spots leaves penalties out, the other number holds them."""
    target = pachon.design.FocalLength(0.2, weight=1.0)
    found = optimize(
        doublet,
        ["S1.curvature"],
        "spots",
        [[0.0, 0.0]],
        targets=[target],
        solver=pachon.design.LeastSquares(max_steps=1),
        n_pupil=3,
    )
    alone = SpotMerit(doublet, Beams.of(doublet, [[0.0, 0.0]], n_pupil=3)).residuals(doublet)
    assert found.merits[0] == pytest.approx(np.linalg.norm(alone), rel=1e-12)
    penalty = 0.2 - pachon.design.FocalLength(0.2).measure(doublet)
    assert found.history[0] == pytest.approx(np.hypot(found.merits[0], penalty), rel=1e-12)
    assert found.summary()["rms_start_m"] == found.merits[0]


def test_a_radius_passes_through_a_plane(lens):
    """The best shape is bent the other way than the start; as a radius it would have to pass through infinity."""
    start = lens([(60.0, 4.0, "N-BK7"), (400.0, 100.0, "")], pupil=5.0, field_deg=0.5)
    found = optimize(start, ["S2.radius"], "spots", [[0.0, 0.0]], targets=[pachon.design.FocalLength(0.065)], n_pupil=3)
    curvature = optimize(
        start, ["S2.curvature"], "spots", [[0.0, 0.0]], targets=[pachon.design.FocalLength(0.065)], n_pupil=3
    )
    assert found.start_values[0] == pytest.approx(-0.4)
    assert found.values[0] > 0
    assert found.values[0] == pytest.approx(1.0 / curvature.values[0], rel=1e-9)
    assert found.telescope.surface("S2").shape.radius == pytest.approx(found.values[0], rel=1e-12)
    # The same in both: an error and an effect per unit, over the derivative of the radius.
    slope = curvature.values[0] ** 2
    assert found.uncertainty[0] * slope == pytest.approx(curvature.uncertainty[0], rel=1e-5)
    assert found.effect[0] / slope == pytest.approx(curvature.effect[0], rel=1e-5)


def test_limits_that_nobody_stated(lens):
    """Curvatures stay below one over the clear radius, thicknesses above zero."""
    start = lens([(20.0, 4.0, "N-BK7"), (-20.0, 15.0, "")], pupil=16.0, field_deg=0.5)
    pull = [pachon.design.FocalLength(2e-3, weight=100.0)]
    variables = ["S1.radius", "S2.radius", "S1.thickness"]
    found = optimize(
        start,
        variables,
        "spots",
        [[0.0, 0.0]],
        targets=pull,
        n_pupil=2,
        solver=pachon.design.LeastSquares(max_steps=15),
    )
    assert np.all(np.abs(found.values[:2]) >= 8e-3)
    assert found.values[2] >= 0.0


def ritchey_chretien(conics):
    """f = 10 m, a primary of 2.5 m, focus 0.5 m behind its vertex; and the conics of the closed form."""
    first, whole, behind = 2.5, 10.0, 0.5
    magnification = whole / first
    apart = (whole * first - first * behind) / (whole + first)
    to_focus = magnification * (first - apart)
    assert to_focus - apart == pytest.approx(behind)
    second_radius = 2.0 * to_focus / (magnification - 1.0)
    shapes = [pachon.Conic(r, k) if k else Sphere(r) for r, k in zip((2.0 * first, second_radius), conics, strict=True)]
    surfaces = (
        Surface("M1", Interaction.MIRROR, shapes[0], (0.0, 0.0, 0.0), VACUUM),
        Surface("M2", Interaction.MIRROR, shapes[1], (0.0, 0.0, apart), VACUUM),
        Surface("Image", Interaction.DETECTOR, Plane(), (0.0, 0.0, apart - to_focus), VACUUM),
    )
    telescope = Telescope(
        "ritchey_chretien", surfaces, 0.0, 1.0, 0.0, 5.0, 10.0, np.deg2rad(0.2), np.deg2rad(1.0), (3e-7, 1e-6), 5e-7
    )
    # Wilson, Reflecting Telescope Optics I, eqs. 3.109 and 3.114, with m = -magnification there.
    m = magnification
    k1 = -1.0 - 2.0 / m**3 * to_focus / apart
    k2 = -1.0 - 2.0 / (m - 1.0) ** 3 * (m * (2.0 * m - 1.0) + to_focus / apart)
    return telescope, (k1, k2)


def test_a_ritchey_chretien_from_spheres():
    """No spherical aberration and no coma: the conics of the closed form."""
    spheres, wanted = ritchey_chretien((0.0, 0.0))
    fields = np.deg2rad([[0.0, 0.0], [0.0, 0.05], [0.0, 0.1]])
    free = ["Image.dz", "Image.rx"]
    found = optimize(spheres, ["M1.conic", "M2.conic", *free], "spots", fields, n_pupil=5)
    # A little coma is left, for less astigmatism: square of the field over the focal ratio, (0.1 deg * 10)^2 = 3e-4.
    assert found.values[0] == pytest.approx(wanted[0], abs=5e-4)
    assert found.values[1] == pytest.approx(wanted[1], abs=5e-3)
    closed, _ = ritchey_chretien(wanted)
    best = optimize(closed, free, "spots", fields, n_pupil=5)
    assert 0.99 * best.merits[1] < found.merits[1] <= best.merits[1]
    assert found.merits[0] > 1000 * found.merits[1]


TRIPLET = [
    (20.0, 5.0, "N-SK16"),
    (np.inf, 3.0, ""),
    (-15.0, 1.2, "N-SF2"),
    (15.0, 3.0, ""),
    (np.inf, 2.0, "N-LAK9"),
    (-15.0, 18.0, ""),
]


@functools.cache
def published():
    """A Cooke triplet, f/3 and +-12 degrees, from the examples of ray-optics; at its best focus."""
    start = pachon.load_telescope("tests/data/zmx/lens1.zmx")
    fields = np.deg2rad([[0.0, 0.0], [0.0, 8.485281], [0.0, 12.0]])
    return optimize(start, ["Image.dz"], "spots", fields, [F, D, C]), fields


@pytest.mark.slow
def test_a_triplet_from_a_poor_start(lens):
    """Two surfaces flat, spots of 3 mm: in the end not worse than the published one, with limits on the glass."""
    reference, fields = published()
    poor = lens(TRIPLET, pupil=8.333333, field_deg=12.0, stop=11.587)
    variables = [f"S{i}.curvature" for i in range(1, 7)] + [f"S{i}.thickness" for i in (1, 2, 4, 5, 6)]
    operands = [
        # The focal length of the start is seven times that wanted: with a weight of 1 it decides where the search goes.
        pachon.design.FocalLength(pachon.design.FocalLength(1.0).measure(reference.telescope), weight=0.3),
        pachon.design.CenterThickness("S1", minimum=1e-3, maximum=6e-3),
        pachon.design.CenterThickness("S5", minimum=1e-3, maximum=3e-3),
        *(pachon.design.EdgeThickness(name, minimum=0.5e-3) for name in ("S1", "S5")),
        *(pachon.design.EdgeThickness(name, minimum=0.1e-3) for name in ("S2", "S4")),
        pachon.design.TotalLength(maximum=35e-3),
    ]
    found = optimize(
        poor, variables, "spots", fields, [F, D, C], targets=operands, solver=pachon.design.LeastSquares(max_steps=300)
    )
    assert found.merits[0] > 2e-3
    assert found.merits[1] <= reference.merits[1]
    for one in found.operands[1:]:
        # Penalties give way by a fraction of a micrometre.
        assert one.operand.minimum is None or one.end >= one.operand.minimum - 1e-6
        assert one.operand.maximum is None or one.end <= one.operand.maximum + 1e-6
    assert found.operands[0].end == pytest.approx(found.operands[0].operand.value, rel=1e-4)


@pytest.mark.slow
def test_a_corrector_of_another_glass():
    """The three lenses of the LSST of BK7 in place of silica, in six bands at once."""
    glass = replace(GlassCatalogue.bundled().in_vacuum("N-BK7"), name="N-BK7")
    fields = np.deg2rad([[0.0, 0.0], [0.0, 0.8], [0.0, 1.3], [0.0, 1.75]])
    designs = [pachon.load_telescope(f"lsst_v3.3_{band}") for band in "ugrizy"]
    lenses = [f"L{i}_{side}" for i in (1, 2, 3) for side in ("entrance", "exit")]
    changed = []
    for design in designs:
        surfaces = tuple(
            replace(s, medium_after=glass) if s.name in lenses and s.name.endswith("entrance") else s
            for s in design.surfaces
        )
        changed.append(replace(design, surfaces=surfaces))
    variables = [f"{name}.curvature" for name in lenses]
    variables += ["L1_exit.thickness", "L2_exit.thickness", "M3.thickness", "Detector.dz", "L2_exit.conic"]
    found = optimize(changed, variables, "spots", fields, n_pupil=4, solver=pachon.design.LeastSquares(max_steps=80))
    before = optimize(designs, ["Detector.dz"], "spots", fields, n_pupil=4)
    # In the beginning the images are lost; in the end they are as they were within a few tens of per cent.
    assert found.merits[0] > 50 * before.merits[1]
    assert found.merits[1] < 1.5 * before.merits[1]
    assert [t.name for t in found.telescopes] == [t.name for t in designs]
    first, *others = found.telescopes
    for other in others:
        assert other.surface("L1_entrance").shape == first.surface("L1_entrance").shape


@pytest.fixture(scope="module")
def zoom(doublet):
    """Two lenses that share radii; the second is focused elsewhere."""
    return doublet, replace(apply(doublet, {"S3.thickness": 2e-3}), name="near")


def test_configurations_share_variables_and_have_their_own(zoom):
    first, second = zoom
    targets = [pachon.design.FocalLength(0.1)]
    both = [
        first,
        pachon.design.DesignConfiguration(second, weight=3.0, operands=[pachon.design.TotalLength(maximum=0.2)]),
    ]
    variables = ["S1.curvature", "S2.curvature", "near:S3.thickness"]
    found = optimize(both, variables, "spots", [[0.0, 0.0]], targets=targets, n_pupil=3)
    assert found.addresses == ("S1.curvature", "S2.curvature", "near:S3.thickness")
    one, other = found.telescopes
    assert one.surface("S1").shape == other.surface("S1").shape
    assert one.surfaces[-1].vertex == first.surfaces[-1].vertex
    assert other.surfaces[-1].vertex != second.surfaces[-1].vertex
    assert [(o.configuration, o.operand.kind) for o in found.operands] == [
        ("lens", "focal_length"),
        ("near", "focal_length"),
        ("near", "total_length"),
    ]
    # The mean square has the weights 1 to 3.
    squares = [SpotMerit(t, Beams.of(t, [[0.0, 0.0]], n_pupil=3)).residuals(t) for t in (first, second)]
    expected = np.sqrt(0.25 * squares[0] @ squares[0] + 0.75 * squares[1] @ squares[1])
    assert found.merits[0] == pytest.approx(expected, rel=1e-12)
    assert found.history[-1] < found.history[0]


def test_restarts_keep_the_best_and_depend_on_the_seed_alone(doublet):
    how = dict(merit="spots", fields=[[0.0, 0.0]], targets=[pachon.design.FocalLength(0.1)], n_pupil=2)
    # Goals held beyond their weights are those of the best end, after the restarts: left to the weights.
    alone = optimize(
        doublet, ACHROMAT, solver=pachon.design.LeastSquares(max_steps=4, constraint_tolerance=np.inf), **how
    )
    solver = pachon.design.LeastSquares(max_steps=4, restarts=2, seed=3, spread=0.5, constraint_tolerance=np.inf)
    found, again = (optimize(doublet, ACHROMAT, solver=solver, **how) for _ in range(2))
    assert np.array_equal(found.changes, again.changes)
    assert found.history[-1] <= alone.history[-1]
    # Before the first step the telescope is as it was, whichever start leads to the end.
    assert found.history[0] == alone.history[0]


@pytest.mark.slow
def test_glasses_of_a_catalogue(lens):
    """A doublet of two crowns becomes one of crown and flint, as good as with glasses that do not exist."""
    crowns = lens([(np.inf, 4.0, "N-BK7"), (np.inf, 2.0, "N-BAK4"), (np.inf, 100.0, "")], pupil=5.0, field_deg=0.5)
    start = apply(crowns, {"S1.curvature": -15.0, "S2.curvature": 5.0})
    how = dict(
        fields=[[0.0, 0.0]],
        wavelengths=[D, F, C],
        targets=[pachon.design.FocalLength(0.1)],
        n_pupil=3,
        solver=pachon.design.LeastSquares(max_steps=60),
    )
    plain = optimize(start, ACHROMAT, "spots", **how)
    found = pachon.design.choose_glasses(start, ACHROMAT, ["N-BAK4"], nearest=3, **how)
    assert [t.name for t in found.trials][3:] == ["N-BAK4"]
    assert found.trials[3].rms == pytest.approx(plain.merits[1], rel=1e-3)
    assert found.optimum.telescope.surface("S2").medium_after.name == found.glasses["N-BAK4"]
    assert found.glasses["N-BAK4"] in GlassCatalogue.bundled()
    assert found.optimum.merits[1] == pytest.approx(min(t.rms for t in found.trials), rel=1e-3)
    assert found.optimum.merits[1] < 0.5 * plain.merits[1]
    assert found.optimum.start_telescopes == (start,)
    assert found.optimum.values == pytest.approx(found.optimum.start_values + found.optimum.changes)
    assert found.optimum.operands[0].start == pytest.approx(pachon.design.FocalLength(0.1).measure(start), rel=1e-12)
    assert found.summary()["glasses"] == found.glasses
    with pytest.raises(UnknownNameError, match=r"N-FK5.*N-BAK4"):
        pachon.design.choose_glasses(start, ACHROMAT, ["N-FK5"], **how)


def test_glasses_stay_where_no_other_is_better(doublet, monkeypatch):
    """Of two crowns no achromat can be made."""
    how = {"fields": [[0.0, 0.0]], "wavelengths": [D, F, C], "targets": [pachon.design.FocalLength(0.1)], "n_pupil": 3}
    monkeypatch.setattr(glass_choice, "_nearest", lambda *_: ["N-BK7"])
    found = pachon.design.choose_glasses(doublet, ACHROMAT, ["F2"], **how)
    assert found.glasses == {"F2": "F2"}
    assert found.optimum.telescope.surface("S2").medium_after == doublet.surface("S2").medium_after
    assert found.optimum.merits[1] < found.optimum.merits[0]
    assert [trial.name for trial in found.trials] == ["N-BK7", "F2"]
    assert found.trials[1].rms < 0.1 * found.trials[0].rms
    # At one wavelength an Abbe number has no effect, which was said of a variable that nobody had named.
    with pytest.raises(ConfigError, match="wavelengths: expected several"):
        pachon.design.choose_glasses(doublet, ACHROMAT, ["F2"], **{**how, "wavelengths": [D]})


@pytest.mark.long
def test_motions_beside_glasses_count_from_the_telescope_as_it_was(lens, monkeypatch):
    """Glass by glass all is optimised again; the limits and numbers of a motion are those of all of it."""
    crowns = lens([(np.inf, 4.0, "N-BK7"), (np.inf, 2.0, "N-BAK4"), (np.inf, 100.0, "")], pupil=5.0, field_deg=0.5)
    # A glass that the catalogue does not have cannot stay.
    own = glass_choice._with_medium(crowns, "N-BAK4", crowns.surface("S2").medium_after, "crown")
    start = apply(own, {"S1.curvature": -15.0, "S2.curvature": 5.0})
    monkeypatch.setattr(glass_choice, "_nearest", lambda *_: ["N-SF5"])
    found = pachon.design.choose_glasses(
        start,
        [*ACHROMAT, "Image.dz"],
        ["crown"],
        fields=[[0.0, 0.0]],
        wavelengths=[D, F, C],
        targets=[pachon.design.FocalLength(0.11)],
        bounds={"Image.dz": (-2e-3, 2e-3)},
        n_pupil=2,
        solver=pachon.design.LeastSquares(max_steps=12, constraint_tolerance=np.inf),
    )
    assert found.glasses == {"crown": "N-SF5"}
    moved = found.optimum.telescope.surfaces[-1].vertex[2] - start.surfaces[-1].vertex[2]
    assert moved == pytest.approx(-2e-3, rel=1e-6)
    assert (found.optimum.start_values[3], found.optimum.values[3]) == (0.0, pytest.approx(moved))
    assert found.optimum.start_values[:3] == pytest.approx([-15.0, 5.0, 0.0])
    assert found.optimum.values == pytest.approx(found.optimum.start_values + found.optimum.changes)


@pytest.mark.parametrize(
    ("variables", "options", "error", "words"),
    [
        (["far:S1.curvature"], {}, UnknownNameError, "far"),
        (["S9.curvature"], {}, UnknownNameError, "S9"),
        ([], {}, ConfigError, "variables"),
        (["S1.curvature", "S1.curvature"], {}, ConfigError, "more than once"),
        (["S1.radius"], {"bounds": {"S1.radius": (-1.0, 1.0)}}, DomainError, "one sign"),
        (
            ["S1.curvature"],
            {"merit": pachon.design.WavefrontError(np.zeros((1, 1, 1)))},
            ConfigError,
            "2 configurations",
        ),
    ],
)
def test_wrong_configurations(zoom, variables, options, error, words):
    with pytest.raises(error, match=words):
        optimize(zoom, variables, fields=[[0.0, 0.0]], **options)


def test_configurations_need_names_of_their_own(doublet):
    with pytest.raises(ConfigError, match=r"configuration 'lens'.*unique"):
        optimize([doublet, doublet], ["S1.curvature"], "spots", [[0.0, 0.0]])
    with pytest.raises(ConfigError, match="at least one configuration"):
        optimize([], ["S1.curvature"])
