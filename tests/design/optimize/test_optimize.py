"""Optimisation: exact derivatives of merits, a misaligned LSST recovered, the Paul-Baker found again from spheres."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import ConfigError, DomainError, UnknownNameError
from pachon.design.optimize.jacobian import ParameterColumns
from pachon.design.optimize.merit import Beams, SpotMerit, WavefrontMerit
from pachon.design.optimize.optimize import optimize, wavefronts
from pachon.design.optimize.problem import DesignProblem
from pachon.design.optimize.solver import LeastSquares
from pachon.design.optimize.targets import FocalLength, ImageScale, Target
from pachon.models.first_order import first_order
from pachon.models.parameters.parameters import apply, parse_parameters
from pachon.models.shapes.shape import Conic
from pachon.raytrace.rays import RayStatus

FIELDS = np.deg2rad([[0.0, 0.0], [0.0, 0.2], [0.3, 0.2]])
HEXAPODS = [f"{body}.{motion}" for body in ("M2", "Camera") for motion in ("dx", "dy", "dz", "rx", "ry")]


@pytest.fixture(scope="module")
def paul_baker():
    return pachon.load_telescope("paul_baker")


@pytest.mark.parametrize("kind", ["spots", "spots from chief", "wavefront", "wavefront to a goal"])
def test_derivatives_of_merits(paul_baker, slope, kind):
    rays = Beams.of(paul_baker, FIELDS, [5e-7, 7e-7], field_weights=[1.0, 2.0, 1.0], sampling="rings", n_pupil=3)
    if kind.startswith("spots"):
        merit = SpotMerit(paul_baker, rays, "chief" if "chief" in kind else "centroid")
    else:
        goal = 1e-7 * np.random.default_rng(3).normal(size=(3, 2, len(rays.request.pupil)))
        merit = WavefrontMerit(paul_baker, rays, goal if "goal" in kind else None)
    parameters = parse_parameters(["M2.dx", "M3.rx", "M2.radius", "M1.conic", "Detector.dz"], paul_baker)
    start = np.array([1e-4, 1e-5, 1e-3, 1e-3, 1e-4])
    values, found = merit.derivatives(ParameterColumns.at(paul_baker, parameters, start))

    def residuals(changes):
        return merit.residuals(apply(paul_baker, dict(zip(parameters, changes, strict=True))))

    assert np.allclose(values, residuals(start), atol=1e-14)
    for i, step in enumerate([1e-3, 1e-4, 1e-3, 1e-3, 1e-3]):
        numeric = slope(lambda h, i=i: residuals(start + h * np.eye(5)[i]), step)
        # Paths of 50 m are good to 1e-14 m.
        assert np.abs(found[:, i] - numeric).max() < 1e-7 * np.abs(numeric).max() + 1e-14 / step


def test_spot_merit_is_the_rms_radius(paul_baker):
    moved = apply(paul_baker, {"Detector.dz": 2e-4})
    rays = Beams.of(moved, FIELDS, sampling="square", n_pupil=16)
    total = 0.0
    for field in FIELDS:
        launched = pachon.launch_rays(moved, field, moved.default_wavelength, rays.request.pupil.points.T)
        end = pachon.trace(moved, launched)
        landing = end.position[end.status == RayStatus.OK, :2]
        total += np.mean(np.sum((landing - landing.mean(axis=0)) ** 2, axis=1)) / len(FIELDS)
    found = SpotMerit(moved, rays).residuals(moved)
    assert np.sum(found**2) == pytest.approx(total, rel=1e-12)


def test_a_misaligned_lsst_is_recovered_from_its_wavefronts(lsst_r):
    """Ten motions of M2 and the camera, random within tolerances, from wavefronts at 13 field points."""
    angle = np.deg2rad(np.arange(0, 360, 60))
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    fields = np.deg2rad(np.concatenate([[[0.0, 0.0]], 1.0 * ring, 1.6 * ring @ [[0.8, 0.6], [-0.6, 0.8]]]))
    for seed in (1, 2, 3):
        tolerance = np.array([5e-4, 5e-4, 5e-5, 1e-4, 1e-4] * 2)
        truth = np.random.default_rng(seed).normal(size=10) * tolerance
        measured = wavefronts(apply(lsst_r, dict(zip(HEXAPODS, truth, strict=True))), Beams.of(lsst_r, fields))
        merit = pachon.design.WavefrontError(measured)
        found = optimize(lsst_r, HEXAPODS, merit, fields, solver=pachon.design.LeastSquares(tolerance=1e-14))
        # Wavefronts are good to 1e-14 m; the motion that shows least makes 2e-4 m of wavefront per m.
        assert np.abs(found.changes - truth).max() < 1e-9
        assert found.history[0] > 1e-7
        assert found.history[-1] < 1e-13
        assert found.collinear == ()
        # Error bars from what is left, which is rounding: of the right size, not wildly small.
        assert np.all(np.abs(found.changes - truth) < 30 * found.uncertainty + 1e-12)


def test_paul_baker_is_found_again_from_spheres():
    """At f/16 third order is nearly all there is, so the best conics are those of the derivation."""
    design = pachon.paul_baker(4.0, 16.0, field_radius=np.deg2rad(0.25))
    spheres = design
    for name in ("M1", "M2"):
        spheres = spheres.with_shape(name, Conic(design.surface(name).shape.radius, 0.0))
    poor = apply(spheres, {"M3.radius": 0.2, "Detector.dz": 0.15})
    fields = np.deg2rad([[0.0, 0.0], [0.0, 0.12], [0.0, 0.18], [0.0, 0.25]])
    variables = ["M1.conic", "M2.conic", "M3.conic", "M3.radius", "Detector.dz"]
    found = optimize(poor, variables, "spots", fields, targets=[FocalLength(64.0)])
    assert found.history[0] > 1e-3
    best = found.telescope
    conics = [best.surface(name).shape.conic for name in ("M1", "M2", "M3")]
    expected = [design.surface(name).shape.conic for name in ("M1", "M2", "M3")]
    # Fifth order moves the balance by some 1e-4: the square of the aperture angle is 1e-3.
    assert np.abs(np.array(conics) - expected).max() < 1e-3
    assert best.surface("M3").shape.radius == pytest.approx(design.surface("M3").shape.radius, rel=1e-4)
    assert first_order(best).focal_length == pytest.approx(64.0, abs=1e-5)
    # At least as good as the design itself at its best focus.
    refocused = optimize(design, ["Detector.dz"], "spots", fields)
    assert found.history[-1] <= refocused.history[-1] * 1.0001


def test_compensators_and_bounds(paul_baker):
    tilted = apply(paul_baker, {"M3.rx": 2e-4, "Detector.dz": 3e-4})
    compensated = optimize(tilted, ["M2.dy", "M2.rx", "Detector.dz", "Detector.rx"], "spots", FIELDS)
    aligned = optimize(paul_baker, ["Detector.dz"], "spots", FIELDS)
    assert compensated.history[-1] < 1.5 * aligned.history[-1]
    limits = {"M1.conic": (-1.0, -0.9), "Detector.dz": (-2e-5, 2e-5)}
    bounded = optimize(paul_baker, ["M1.conic", "Detector.dz"], "spots", FIELDS, bounds=limits)
    conic, height = bounded.values
    assert -1.0 <= conic <= -0.9
    assert abs(height) <= 2e-5
    assert bounded.telescope.surface("M1").shape.conic == conic
    assert abs(aligned.changes[0]) > 2e-5


def test_focal_length(lsst_r, paul_baker, slope):
    # Chief rays 1e-4 rad apart land 3e-3 m apart, good to 1e-15 m; distortion goes as the square of the angle.
    assert abs(ImageScale(33.6, weight=2.0).residuals(paul_baker)[0]) < 2 * 1e-7 * 33.6
    assert abs(FocalLength(33.6, weight=2.0).residuals(paul_baker)[0]) < 1e-11
    # The LSST's detector is a little out of the paraxial focus, which changes its scale by some 1e-5.
    length = first_order(lsst_r).focal_length
    assert abs(FocalLength(length).residuals(lsst_r)[0]) < 1e-11
    assert 1e-6 * length < abs(ImageScale(length).residuals(lsst_r)[0]) < 3e-5 * length
    parameters = parse_parameters(["M2.radius", "M3.dz"], paul_baker)
    _, found = ImageScale(30.0).derivatives(ParameterColumns.at(paul_baker, parameters))
    for i, parameter in enumerate(parameters):
        numeric = slope(lambda h, p=parameter: ImageScale(30.0).residuals(apply(paul_baker, {p: h})), 1e-3)
        # 1e-15 m on 3 mm over steps of 1e-3, some 1e-8 of slopes near 1.
        assert found[0, i] == pytest.approx(numeric[0], rel=1e-6)


def test_targets_of_ones_own(paul_baker):
    """Hold the distance of two mirrors while another pulls at it."""

    def distance(telescope):
        return telescope.surface("M2").vertex[2] - telescope.surface("M3").vertex[2]

    wanted = distance(paul_baker) + 1e-3
    found = optimize(
        paul_baker,
        ["M2.dz", "Detector.dz", "M3.radius"],
        "spots",
        FIELDS,
        targets=[Target(distance, wanted, weight=10.0)],
    )
    assert distance(found.telescope) == pytest.approx(wanted, abs=1e-6)


def test_collinear_variables_are_named(paul_baker):
    found = optimize(paul_baker, ["M1.radius", "M1.curvature", "Detector.dz"], "spots", FIELDS)
    assert len(found.collinear) == 1
    assert "M1.radius" in found.collinear[0]
    assert "M1.curvature" in found.collinear[0]
    assert np.isfinite(found.covariance).all()


@pytest.mark.parametrize("variable", ["M2.rz", "Detector.dx"])
@pytest.mark.parametrize("merit", ["spots", "wavefront"])
def test_a_variable_without_effect_is_named(paul_baker, variable, merit):
    with pytest.raises(DomainError, match=rf"{variable} has no effect"):
        optimize(paul_baker, ["Detector.dz", variable], merit, FIELDS)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (dict(merit="beauty"), ConfigError, "beauty"),
        (dict(merit=SpotMerit), ConfigError, r"merit = .*: expected 'spots', 'wavefront', a SpotSize"),
        (dict(variables=["M9.dz"]), UnknownNameError, "M9"),
        (dict(bounds={"M1.conic": (0, 1)}), ConfigError, "M1.conic"),
        (dict(bounds={"Detector.dz": (1e-3, 2e-3)}), DomainError, "Detector.dz"),
        (dict(merit=pachon.design.WavefrontError(np.zeros((3, 1, 5)))), DomainError, "goal of shape"),
        (dict(field_weights=[1.0, 2.0]), ConfigError, "field_weights: .* expected it in a DesignConfiguration"),
        (dict(sampling="rings"), ConfigError, "sampling: no argument of optimize; expected it in a DesignConf"),
        (dict(goal=np.zeros((3, 1, 5))), ConfigError, r"goal: .* expected merit=WavefrontError\(goal\)"),
        (dict(reference="chief"), ConfigError, r"reference: .* expected merit=SpotSize\(reference\)"),
        (dict(max_steps=3), ConfigError, r"max_steps: .* expected it in solver=LeastSquares"),
        (dict(fields=[[0.5, 0.0]]), DomainError, "deg"),
    ],
)
def test_bad_arguments(paul_baker, change, error, words):
    with pytest.raises(error, match=words):
        optimize(paul_baker, **(dict(variables=["Detector.dz"], fields=FIELDS) | change))


def test_bad_options(paul_baker):
    with pytest.raises(ConfigError, match="reference = 'mean': expected one of centroid, chief"):
        pachon.design.SpotSize("mean")
    with pytest.raises(DomainError, match="restarts"):
        pachon.design.LeastSquares(restarts=-1)
    with pytest.raises(DomainError, match="field_weights"):
        optimize(pachon.design.DesignConfiguration(paul_baker, FIELDS, field_weights=[1.0, 2.0]), ["Detector.dz"])


def test_what_is_the_default_may_be_said(paul_baker):
    """Names and objects, defaults said or not: the same numbers."""
    plain = optimize(paul_baker, ["Detector.dz", "M2.dx"], "spots", FIELDS)
    state = pachon.design.DesignConfiguration(paul_baker, FIELDS, sampling="gauss", n_pupil=6, projection="zemax")
    said = optimize(
        state,
        ["Detector.dz", "M2.dx"],
        pachon.design.SpotSize("centroid"),
        solver=pachon.design.LeastSquares(1e-10, 200),
    )
    for name in ("changes", "history", "covariance"):
        assert np.array_equal(getattr(said, name), getattr(plain, name))
    # Rays that are said are those of the measurement too.
    for optimum, rings in ((plain, None), (said, 6)):
        radii = pachon.spots(optimum.telescope, FIELDS, n_pupil=rings).rms_radius
        assert optimum.merits[1] == pytest.approx(np.sqrt(np.mean(radii**2)), rel=1e-9)
    assert said.merit_name == plain.merit_name == "spots"


def test_no_light(paul_baker):
    from pachon.models.aperture import Circle

    closed = tuple(replace(s, aperture=Circle(1e-3)) if s.name == "M2" else s for s in paul_baker.surfaces)
    with pytest.raises(DomainError, match="no ray reaches the image"):
        optimize(replace(paul_baker, surfaces=closed), ["Detector.dz"], "spots", FIELDS)


@pytest.mark.long
def test_a_start_from_which_rays_get_lost_on_the_way(paul_baker):
    """A step that throws rays off the mirrors is taken back, not raised."""
    poor = apply(paul_baker, {"M2.dz": -1.5, "Detector.dz": 0.5})
    found = optimize(poor, ["M2.radius", "M3.radius", "Detector.dz"], "spots", FIELDS, n_pupil=6)
    assert found.history[-1] < found.history[0]
    assert np.all(np.diff(found.history[:-1]) <= 0)
    # The start has rays that miss; the end has all of its own, and is measured with them.
    assert found.history[-1] == pytest.approx(found.merits[1], rel=1e-9)
    assert found.merits[1] > 1.01 * found.history[-2]


def test_the_merit_of_cut_pupils_is_that_of_spots():
    """At the edge of the field six rings, which the solver has, are some per cent off."""
    hsc, fields = pachon.load_telescope("hsc"), np.deg2rad([[0.0, 0.5], [0.0, 0.74]])
    found = optimize(hsc, ["Detector.dz"], "spots", fields)

    def rms(**options):
        return np.sqrt(np.mean(pachon.spots(found.telescope, fields, **options).rms_radius ** 2))

    assert found.merits[1] == pytest.approx(rms(), rel=1e-9)
    assert found.merits[1] == pytest.approx(rms(sampling="spiral", n_pupil=50000), rel=0.02)
    assert found.history[-1] == pytest.approx(rms(n_pupil=6), rel=0.01)
    assert abs(rms(n_pupil=6) / rms() - 1.0) > 0.03


def test_summary_and_picture(paul_baker):
    found = optimize(paul_baker, ["Detector.dz", "M2.dx"], "wavefront", FIELDS)
    summary = found.summary()
    assert summary["variables"] == ["Detector.dz", "M2.dx"]
    assert summary["rms_end_m"] <= summary["rms_start_m"]
    assert found.plot().get_axes()


class BrokenProblem(DesignProblem):
    """Residual x - 1, a hundredth of it beyond 1, with half of the slope; no derivatives beyond `last`."""

    def __init__(self, last):
        super().__init__((), [SimpleNamespace(address="S1.conic")])
        self.last = last

    def residuals(self, changes):
        return np.where(changes < 1.0, 1.0, 0.01) * (changes - 1.0)

    def linear(self, changes):
        return self.residuals(changes), np.full((1, 1), 0.5 if changes[0] <= self.last else np.nan)

    def stated_rms(self, residuals):
        return float(np.linalg.norm(residuals))


def test_a_step_to_where_derivatives_end_is_made_shorter():
    """The first step would lead to 2, as a conic may lead to the equator of a surface."""
    box, start, effect = (np.array([-np.inf]), np.array([np.inf])), np.zeros(1), np.ones(1)
    assert LeastSquares().resume(BrokenProblem(1.5), box, start, effect) == pytest.approx([1.0])
    with pytest.raises(DomainError, match=r"no derivatives on the way of S1.conic: expected bounds"):
        LeastSquares().resume(BrokenProblem(-1.0), box, start, effect)


def test_a_focus_on_the_reference_sphere_is_no_solution():
    """Paths to a focus are equal, so that a lens whose focus lay on its sphere had 55 nm, and spots of 3 mm."""
    lens = pachon.models.singlet(diameter=0.02, f_number=5.0, field_radius=np.deg2rad(2.0))
    # Its first surface and the place of the detector, for another focal length.
    target = FocalLength(0.22)
    found = optimize(lens, ["S1.radius", "S2.thickness"], "wavefront", [[0.0, 0.0]], targets=[target], n_pupil=3)
    spots = optimize(lens, ["S1.radius", "S2.thickness"], "spots", [[0.0, 0.0]], targets=[target], n_pupil=3)
    assert found.values == pytest.approx(spots.values, rel=1e-3)
    assert pachon.spots(found.telescope, [[0.0, 0.0]]).rms_radius[0] < 5e-6


def test_a_random_start_without_derivatives_is_left_out():
    """Only the telescope as it is has derivatives; of the random starts most are beyond."""
    problem = BrokenProblem(1.5)
    parameter = SimpleNamespace(kind="shape", name="conic")
    problem.variables = [SimpleNamespace(address="S1.conic", parameters=(parameter,), solver_start=10.0)]
    box, start, effect = (np.array([-np.inf]), np.array([np.inf])), np.zeros(1), np.ones(1)
    found = LeastSquares(restarts=5, spread=1.0).solve(problem, box, (), problem.residuals(start), effect)
    assert found.changes == pytest.approx([1.0])


def test_goals_in_a_unit(paul_baker):
    """Numbers of a goal in nanometres were taken for metres."""
    rays = Beams.of(paul_baker, FIELDS, [5e-7], sampling="rings", n_pupil=3)
    goal = 1e-7 * np.random.default_rng(3).normal(size=(len(FIELDS), 1, len(rays.request.pupil)))
    goals = (goal, 1e9 * goal * u.nm)
    in_metres, in_nanometres = (pachon.design.WavefrontError(g).rms(paul_baker, rays) for g in goals)
    assert in_nanometres == pytest.approx(in_metres, rel=1e-12)
    with pytest.raises(DomainError, match=r"goal = .*: expected a unit that converts to m"):
        pachon.design.WavefrontError(goal * u.kg)
