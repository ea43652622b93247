"""Toleranced merits: second derivatives and compensators against brute force, methods against each other, yields."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import pachon
from pachon.design.optimize.merit import Beams
from pachon.design.tolerancing.criterion import Criterion
from pachon.design.tolerancing.monte_carlo import Yield, monte_carlo
from pachon.design.tolerancing.toleranced_merit import TolerancedMerit
from pachon.models.parameters.degrees_of_freedom import DegreesOfFreedom
from pachon.models.parameters.parameters import apply
from pachon.models.parameters.tolerances import Tolerance

FIELDS = np.deg2rad([[0.0, 0.0], [0.0, 8.0], [0.0, -11.0]])
TOLERANCES = (
    Tolerance("S3.dy", 15e-6),
    Tolerance("S4.thickness", 20e-6, "normal"),
    Tolerance("S1.curvature", 0.05),
    Tolerance("S6.n", 2e-4, "end_point"),
)


#: Heights of the image [m] whose parabola of mean squares is exact but for rounding.
FOCI = np.array([-5e-5, 0.0, 5e-5])


@pytest.fixture(scope="module")
def triplet():
    return pachon.load_telescope("tests/data/zmx/lens1.zmx")


@pytest.fixture(scope="module")
def built(triplet):
    dof = DegreesOfFreedom.of_parameters(triplet, [*(t.name for t in TOLERANCES), "Image.dz"])
    criterion = Criterion.of("spots", triplet, Beams.of(triplet, FIELDS, n_pupil=3))
    return TolerancedMerit.of(triplet, TOLERANCES, ("Image.dz",), dof, criterion)


def test_second_derivatives(triplet, built):
    """Central differences of the least mean square radius itself, refocused by brute force."""
    names = [t.name for t in TOLERANCES]
    steps = np.array([5e-6, 1e-5, 0.02, 1e-4])

    def least_square(values):
        moved = apply(triplet, dict(zip(names, values, strict=True)))
        squares = [np.sum(built.criterion.judge.residuals(apply(moved, {"Image.dz": h})) ** 2) for h in FOCI]
        # The mean square radius of given rays is quadratic in the focus.
        a, b, c = np.polyfit(FOCI, squares, 2)
        return c - b**2 / (4 * a)

    start, gradient, hessian = built.second_order[:3]
    assert start == pytest.approx(least_square(np.zeros(4)), rel=1e-6)
    scale = np.sqrt(np.outer(np.diag(hessian), np.diag(hessian)))
    for i in range(4):
        a = steps[i] * np.eye(4)[i]
        # Terms of third order in the steps, some 1e-3 of the whole.
        slope = (least_square(a) - least_square(-a)) / (2 * steps[i])
        assert gradient[i] == pytest.approx(slope, rel=1e-3, abs=1e-13 / steps[i])
        for j in range(i + 1):
            b = steps[j] * np.eye(4)[j]
            ends = least_square(a + b), least_square(a - b), least_square(b - a), least_square(-a - b)
            mixed = (ends[0] - ends[1] - ends[2] + ends[3]) / (4 * steps[i] * steps[j])
            assert abs(hessian[i, j] - mixed) < 2e-3 * scale[i, j]


def test_quadratic_compensation_is_the_best_focus(triplet, built):
    """The minimum over the compensator is what a search of the focus finds."""
    deviations = np.array([[1e-5, 2e-5, -0.05, -2e-4]])
    found = built.quadratic(deviations)[0]
    moved = apply(triplet, dict(zip([t.name for t in TOLERANCES], deviations[0], strict=True)))
    best = minimize_scalar(
        lambda h: np.linalg.norm(built.criterion.judge.residuals(apply(moved, {"Image.dz": h}))),
        bounds=(-1e-4, 1e-4),
        method="bounded",
    ).fun
    assert found == pytest.approx(best, rel=2e-3)
    assert best > 1.002 * built.nominal


def test_transfer_is_that_along_the_field_wherever_the_field_lies(triplet):
    """A lens of revolution has the same merit at fields on any meridian."""
    slope = np.tan(np.deg2rad(11.0))
    fields = np.arctan(slope * np.array([[[0.0, 1.0]], [[np.sqrt(0.5), np.sqrt(0.5)]], [[-0.6, 0.8]]]))
    along_y, *others = (
        Criterion.of("mtf", triplet, Beams.of(triplet, field, n_pupil=3), frequency=2e4).measure(triplet)
        for field in fields
    )
    # The lattice of pupil points has square symmetry; directions of x and y give 0.016 less.
    assert others == pytest.approx([along_y, along_y], abs=4e-3)


@pytest.mark.slow
def test_methods_and_their_yields_agree(triplet):
    """Tolerances of good work: merits within 2 per cent of their spread, yields within their binomial errors."""
    how = dict(merit="spots", n=100, seed=2, compensators=["Image.dz"])
    request = pachon.Request.of(triplet, FIELDS, n_pupil=3)
    linear, quadratic, traced = (
        monte_carlo(request, TOLERANCES, method=m, **how) for m in ("linear", "quadratic", "traced")
    )
    assert np.array_equal(linear.deviations, traced.deviations)
    spread = traced.merit.std()
    assert spread > 0.02 * traced.nominal
    requirement = float(np.median(traced.merit))
    exact = traced.yield_at(requirement)
    assert exact.fraction == pytest.approx(0.5, abs=0.01)
    for other in (linear, quadratic):
        assert np.sqrt(np.mean((other.merit - traced.merit) ** 2)) < 0.02 * spread
        found = other.yield_at(requirement)
        assert found.low <= exact.fraction <= found.high


@pytest.fixture(scope="module")
def ritchey_chretien():
    telescope = pachon.models.two_mirror("ritchey-chretien", 1.0, 8.0, primary_f_number=2.5)
    return pachon.Request.of(telescope, np.deg2rad([[0.0, 0.0], [0.0, 0.2]]), n_pupil=3)


@pytest.mark.parametrize("merit", ["spots", "wavefront"])
def test_large_moves_of_a_compensator_end_in_the_best_focus(ritchey_chretien, merit):
    """A primary of a radius 0.3 % off moves the focus by 77 mm: spots were four times too large."""
    telescope = ritchey_chretien.telescope
    tolerance = Tolerance("M1.radius", 3e-3 * telescope.surface("M1").shape.radius, "end_point")
    how = dict(n=1, seed=1, compensators=["Detector.dz"], method="traced")
    draws = monte_carlo(ritchey_chretien, [tolerance], merit, **how)
    moved = pachon.models.apply_changes(telescope, {"M1.radius_mm": 1e3 * float(draws.deviations[0, 0])})
    best = pachon.optimize(moved, ["Detector.dz"], merit, np.deg2rad([[0.0, 0.0], [0.0, 0.2]]), n_pupil=3)
    assert draws.merit[0] == pytest.approx(best.merits[1], rel=1e-4)
    assert draws.moves[0, 0] == pytest.approx(best.changes[0], rel=1e-4)
    assert abs(best.changes[0]) > 0.07


@pytest.mark.parametrize("merit", ["spots", "wavefront"])
def test_quadratic_merits_beside_large_moves_of_a_compensator(ritchey_chretien, merit):
    """The focus moves by 13 mm: at a fixed focus, differences made half of the telescopes better than designed."""
    tolerance = Tolerance("M1.radius", 5e-4 * ritchey_chretien.telescope.surface("M1").shape.radius, "end_point")
    how = dict(n=4, seed=1, compensators=["Detector.dz"])
    quadratic, traced = (
        monte_carlo(ritchey_chretien, [tolerance], merit, method=method, **how) for method in ("quadratic", "traced")
    )
    # Terms of third order.
    assert quadratic.merit == pytest.approx(traced.merit, rel=5e-3)
    assert quadratic.moves == pytest.approx(traced.moves, rel=0.02)


def test_end_points():
    tolerance = Tolerance("a", 3.0, "end_point")
    values = tolerance.draw(1, 10_000)
    assert set(values) == {-3.0, 3.0}
    # Five standard errors of the mean.
    assert abs(values.mean()) < 5 * 3.0 / 100
    assert tolerance.spread == 3.0


def test_yield_and_its_interval():
    """Wilson's interval holds the fractions p whose own deviation, sqrt(p (1 - p) / n), reaches the one found."""
    merits = np.concatenate([np.zeros(30), np.ones(9), [np.nan]])
    found = Yield.of(merits, 0.5)
    assert found.fraction == 0.75
    for edge in (found.low, found.high):
        assert abs(edge - 0.75) == pytest.approx(np.sqrt(edge * (1 - edge) / 40))
    larger = Yield.of(merits, 0.5, larger=True)
    assert larger.fraction == pytest.approx(9 / 40)
    everything = Yield.of(np.zeros(10), 0.5)
    assert everything.high == pytest.approx(1.0)
    assert everything.low < 1.0


@pytest.mark.long
@pytest.mark.parametrize("fields", [[[0.0, 0.0], [0.0, 8.0], [0.0, -11.0]], [[0.0, 8.0]]])
def test_a_tilt_that_hardly_acts_on_the_fields_stays_small(triplet, fields):
    """All fields on one axis leave a tilt open, one field the tilt against the focus; least squares would take 260 deg.

    Merits are then those of the focus alone.
    """
    tolerances = (Tolerance("S3.rx", 1e-3), Tolerance("S3.ry", 1e-3))
    request = pachon.Request.of(triplet, np.deg2rad(fields), n_pupil=3)
    how = dict(merit="spots", n=5, seed=4)
    focus = monte_carlo(request, tolerances, method="traced", compensators=["Image.dz"], **how)
    free = ["Image.dz", "Image.ry"] if len(fields) > 1 else ["Image.dz", "Image.rx"]
    for method in ("traced", "linear", "quadratic"):
        found = monte_carlo(request, tolerances, method=method, compensators=free, **how)
        assert np.all(np.abs(found.moves[:, 1]) < 0.02)
        assert found.merit == pytest.approx(focus.merit, rel=5e-3)
