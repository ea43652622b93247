"""Draws against their closed-form moments; Monte Carlos against brute force, and traced ones against linear ones."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError, PachonError, UnknownNameError
from pachon.core.files import json_text
from pachon.design.optimize.optimize import optimize
from pachon.design.tolerancing.monte_carlo import monte_carlo
from pachon.models.io.grid_file import write_grid
from pachon.models.parameters.degrees_of_freedom_file import load_degrees_of_freedom
from pachon.models.parameters.tolerances import Tolerance, draw
from pachon.models.shapes.grid import GridSag

FIELDS = np.deg2rad([[0.0, 0.0], [0.0, 1.0], [-1.2, 0.6]])


@pytest.mark.parametrize(
    ("tolerance", "variance"),
    [
        (Tolerance("a", 3.0), 3.0),
        (Tolerance("a", 3.0, "normal"), 9.0),
        # Tabulated: the variance of a unit normal cut at one and at two standard deviations.
        (Tolerance("a", 3.0, "truncated", 3.0), 9.0 * 0.2911251),
        (Tolerance("a", 3.0, "truncated", 6.0), 9.0 * 0.7737413),
    ],
)
def test_moments(tolerance, variance):
    assert tolerance.spread**2 == pytest.approx(variance, rel=1e-6)
    n = 200_000
    values = tolerance.draw(5, n)
    # Five standard errors of the mean and of the variance (at most that of a normal distribution).
    assert abs(values.mean()) < 5 * np.sqrt(variance / n)
    assert abs(values.var() - variance) < 5 * variance * np.sqrt(2 / n)
    if tolerance.distribution != "normal":
        edge = tolerance.limit or tolerance.size
        assert 0.99 * edge < np.abs(values).max() <= edge


def test_draws_are_streams_of_their_own():
    a, b, c = Tolerance("a", 1.0), Tolerance("b", 1.0, "normal"), Tolerance("c", 1.0, "truncated", 2.0)
    all_three = draw([a, b, c], 3, 50)
    assert all_three.shape == (50, 3)
    assert np.array_equal(draw([c, a], 3, 50), all_three[:, [2, 0]])
    assert np.array_equal(draw([a, b, c], 3, 7), all_three[:7])
    assert not np.array_equal(draw([a, b, c], 4, 50), all_three)
    # Equal distributions are still independent: five standard errors of a correlation.
    same = draw([Tolerance("a", 1.0), Tolerance("b", 1.0)], 3, 10_000)
    assert abs(np.corrcoef(same.T)[0, 1]) < 0.05


def rms_wavefront(telescope, fields, wavelength):
    """Brute force: rms over lit points of a fine grid, piston and tilt taken off, mean square over fields."""
    squares = []
    for field in fields:
        opd = pachon.wavefront_opd(telescope, field, wavelength, grid=96)
        squares.append(np.mean(opd.without_tilt[opd.lit] ** 2))
    return np.sqrt(np.mean(squares))


def test_the_merit_is_the_rms_of_the_wavefront(lsst_r):
    tolerance = [Tolerance("M2.dx", 200e-6)]
    request = pachon.Request.of(lsst_r, FIELDS, 620e-9, n_pupil=6)
    found = monte_carlo(request, tolerance, n=2, seed=1, method="traced")
    # Quadrature over the pupil against a grid of cells at its rims: a per cent.
    assert found.nominal == pytest.approx(rms_wavefront(lsst_r, FIELDS, 620e-9), rel=0.015)
    for values, merit in zip(found.deviations, found.merit, strict=True):
        moved = lsst_r.perturbed("M2", shift=(values[0], 0, 0))
        assert merit == pytest.approx(rms_wavefront(moved, FIELDS, 620e-9), rel=0.015)
        assert merit > 1.01 * found.nominal


@pytest.mark.parametrize("merit", ["wavefront", "spots"])
@pytest.mark.parametrize("compensators", [pytest.param((), marks=pytest.mark.slow), ("Camera_dz", "M2_rx", "M1M3_B2")])
def test_linear_and_traced_agree(lsst_r, merit, compensators):
    dof = load_degrees_of_freedom("lsst")

    def worst(size):
        tolerances = [
            Tolerance(
                name, size * (2.0 if unit == "arcsec" else 10.0 if "_d" in name else 0.01), "truncated", size * 20.0
            )
            for name, unit in zip(dof.names, dof.units, strict=True)
            if name not in compensators
        ]
        both = [
            monte_carlo(
                lsst_r,
                tolerances,
                merit,
                4,
                2,
                degrees_of_freedom=dof,
                compensators=compensators,
                method=m,
                fields=FIELDS,
            )
            for m in ("linear", "traced")
        ]
        assert np.array_equal(both[0].deviations, both[1].deviations)
        assert np.array_equal(both[0].moves, both[1].moves)
        # The deviations matter, so that agreement is about them.
        assert np.abs(both[0].merit / both[0].nominal - 1).max() > 0.02 * size
        # What stays of rows vignetted differently is left out: both methods have the rays of the undisturbed telescope.
        assert both[0].nominal == pytest.approx(both[1].nominal, rel=1e-6)
        return np.abs(both[0].merit - both[1].merit).max() / both[0].nominal

    small, large = worst(0.25), worst(1.0)
    assert large < 5e-3
    # What the derivatives leave out is of second order in the deviations (and in those that compensators move back).
    assert small < large / 4.0 or small < 1e-7


def test_contributions_add_in_squares(lsst_r):
    """The mean square merit is that of the telescope as it is, plus the contributions squared, exactly in the mean."""
    tolerances = [Tolerance("M2.dz", 10e-6), Tolerance("Camera.rx", 3e-5, "normal"), Tolerance("M2.dx", 5e-5, "normal")]
    n = 20_000
    found = monte_carlo(lsst_r, tolerances, n=n, seed=4, fields=FIELDS, compensators=["Camera.dz"])
    expected = found.nominal**2 + (found.contribution**2).sum()
    error = (found.merit**2).std() / np.sqrt(n)
    assert abs((found.merit**2).mean() - expected) < 5 * error
    assert error < 0.01 * expected
    # The camera's focus makes up for M2's but for the field-dependent part.
    free = monte_carlo(lsst_r, tolerances, n=2, seed=4, fields=FIELDS)
    assert found.contribution[0] < 0.1 * free.contribution[0]
    assert found.nominal <= free.nominal


def test_compensators_are_where_an_optimisation_puts_them(lsst_r):
    tolerances = [Tolerance("M2.dz", 20e-6), Tolerance("M2.rx", 2e-5)]
    free = ["Camera.dz", "Camera.rx"]
    found = monte_carlo(lsst_r, tolerances, n=2, seed=9, fields=FIELDS, compensators=free, method="traced")
    for values, moves, merit in zip(found.deviations, found.moves, found.merit, strict=True):
        moved = lsst_r.perturbed("M2", shift=(0, 0, values[0]), tilt=(values[1], 0, 0))
        best = optimize(moved, free, "wavefront", FIELDS, n_pupil=6)
        # Linear compensation of deviations this small, against the solver's: the merit is flat about its least.
        assert merit == pytest.approx(best.history[-1], rel=1e-3)
        assert moves == pytest.approx(best.changes, rel=0.02, abs=2e-7)


def test_many_draws_are_the_same_for_a_seed(lsst_r):
    tolerances = [Tolerance("M2.dz", 20e-6), Tolerance("Camera.ry", 2e-5, "normal")]
    fields = pachon.design.optimize.sensitivity.field_rings(lsst_r)
    requests = [pachon.Request.of(lsst_r, fields, n_pupil=6, threads=threads) for threads in (1, 2)]
    one, two = (monte_carlo(request, tolerances, n=500, seed=3) for request in requests)
    assert np.array_equal(one.merit, monte_carlo(lsst_r, tolerances, n=500, seed=3).merit)
    assert np.array_equal(one.merit, two.merit)
    shares = [one.at_most(s) for s in (0.1, 0.5, 0.9)]
    assert shares == sorted(shares)
    assert np.mean(one.merit <= one.at_most(0.9)) == pytest.approx(0.9, abs=0.003)


def test_progress_summary_and_picture(lsst_r):
    told = []
    found = monte_carlo(
        lsst_r, [Tolerance("M2.dz", 2e-5)], "spots", 3, 0, method="traced", progress=told.append, fields=FIELDS
    )
    assert told == [1, 1, 1]
    summary = json.loads(json_text(found.summary()))
    assert summary["draws"] == 3
    assert summary["lost"] == 0
    assert summary["tolerances"] == ["M2.dz"]
    assert summary["units"] == ["m"]
    figure = found.plot()
    assert "µm" in figure.axes[0].get_xlabel()
    assert [text.get_text() for text in figure.axes[1].get_yticklabels()] == ["M2.dz"]


def test_lost_telescopes_count_as_the_worst(lsst_r):
    found = monte_carlo(lsst_r, [Tolerance("M2.rx", 0.4)], n=6, seed=0, method="traced", fields=FIELDS[:1])
    assert np.isnan(found.merit).any()
    assert found.at_most(1.0) == np.inf
    assert found.summary()["lost"] == int(np.isnan(found.merit).sum())
    found.plot()


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (dict(tolerances=[]), ConfigError, "at least one"),
        (dict(tolerances=[Tolerance("M2.dz", 1e-6)] * 2), ConfigError, "'M2.dz' occurs more than once"),
        (dict(tolerances=[Tolerance("M2.dq", 1e-6)]), UnknownNameError, "dq"),
        (dict(compensators=["M2.dz"]), ConfigError, "either a tolerance or a compensator"),
        (dict(compensators=["M2.rz"], fields=FIELDS), DomainError, "compensator 'M2.rz' has no effect"),
        (dict(merit="beauty"), ConfigError, "beauty"),
        (dict(method="guess"), ConfigError, "guess"),
        (dict(n=0), DomainError, "n = 0"),
        (dict(n=2.5), DomainError, "n = 2.5"),
        (dict(seed=-1), DomainError, "seed = -1"),
        (dict(wavelengths=[6e-7]), ConfigError, r"wavelengths: no argument of monte_carlo; expected a Request"),
        (dict(threads=1), ConfigError, r"threads: no argument of monte_carlo; expected a Request"),
        (dict(degrees_of_freedom=load_degrees_of_freedom("lsst")), UnknownNameError, "M2_dz"),
    ],
)
def test_bad_arguments(lsst_r, change, error, words):
    with pytest.raises(error, match=words) as caught:
        monte_carlo(lsst_r, **(dict(tolerances=[Tolerance("M2.dz", 1e-6)], fields=FIELDS[:1]) | change))
    assert "\n" not in str(caught.value)


def test_fields_stand_in_a_request_or_beside_a_telescope(lsst_r):
    with pytest.raises(ConfigError, match=r"fields = .*: given beside a Request, which has its own"):
        monte_carlo(pachon.Request.of(lsst_r, FIELDS[:1]), [Tolerance("M2.dz", 1e-6)], fields=FIELDS[:1])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("a", -1.0), "size = -1.0"),
        (("a", np.nan), "size = nan"),
        (("a", 1.0, "cauchy"), "cauchy"),
        (("a", 1.0, "truncated"), "limit = None"),
        (("a", 1.0, "normal", 2.0), "limit = 2.0"),
        (("a", 1.0, "truncated", -2.0), "limit = -2.0"),
    ],
)
def test_bad_tolerances(arguments, words):
    with pytest.raises(PachonError, match=words):
        Tolerance(*arguments)


def test_the_page_runs(tmp_path, monkeypatch, capsys):
    page = (Path(__file__).parents[3] / "docs" / "howto" / "perturbations.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in re.findall(r"```python\n(.*?)```", page, flags=re.S):
        exec(compile(block, "perturbations.md", "exec"), names)
    assert "as designed" in capsys.readouterr().out
    assert (tmp_path / "monte_carlo.png").read_bytes().startswith(b"\x89PNG")
    (example,) = re.findall(r"```yaml\n(.*?)```", page, flags=re.S)
    for mode in ("m1m3_mode_1", "m1m3_mode_2"):
        nodes = np.linspace(-4.3, 4.3, 12)
        write_grid(GridSag(nodes, nodes, np.outer(nodes, nodes) / 18.0), tmp_path / f"{mode}.fits")
    (tmp_path / "modes.yaml").write_text(example)
    dof = pachon.load_degrees_of_freedom(tmp_path / "modes.yaml")
    assert dof.apply(names["telescope"], np.ones(4)) != names["telescope"]


@pytest.mark.parametrize("merit", ["wavefront", "spots"])
@pytest.mark.parametrize(
    ("tolerances", "compensators"),
    [
        # By symmetry the focus does not respond to a decentre, nor a tilt to a focus, to first order.
        ([Tolerance("M2.dx", 1e-3)], ["Camera.dz"]),
        ([Tolerance("M2.dx", 1e-3)], ["Camera.rx"]),
        ([Tolerance("M2.dz", 1e-4)], ["Camera.rx", "Camera.dz"]),
    ],
)
def test_quadratic_merit_where_compensators_do_not_respond_to_first_order(lsst_r, merit, tolerances, compensators):
    request = pachon.Request.of(lsst_r, [[0.0, 0.0]], n_pupil=4)
    traced, quadratic = (
        monte_carlo(request, tolerances, merit, 4, 3, compensators=compensators, method=method).merit
        for method in ("traced", "quadratic")
    )
    # Terms of third order in deviations of a millimetre.
    assert quadratic == pytest.approx(traced, rel=1e-3)


def test_quadratic_compensators_are_those_of_telescopes_that_are_refocused(lsst_r):
    request = pachon.Request.of(lsst_r, FIELDS, n_pupil=4)
    tolerances = (Tolerance("M2.dz", 3e-5), Tolerance("M2.rx", 1e-4))
    how = dict(n=3, seed=3, compensators=("Camera.dz", "Camera.rx"))
    quadratic, traced = (monte_carlo(request, tolerances, method=m, **how) for m in ("quadratic", "traced"))
    # Terms of second order, and a merit that is flat to 1e-4 about its least.
    assert quadratic.moves == pytest.approx(traced.moves, rel=0.02, abs=1e-7)
    assert quadratic.merit == pytest.approx(traced.merit, rel=1e-3)
