"""Addresses of parameters, what they do, and the motions that belong to them."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.core.errors import ConfigError, DomainError, PachonError, UnknownNameError
from pachon.models.parameters.parameters import (
    Parameter,
    apply,
    parse_parameters,
    twists,
    usual_parameters,
    with_shape_terms,
)
from pachon.models.parameters.shape_terms import term_polynomial, term_unit
from pachon.models.shapes.freeform import Toroid
from pachon.models.shapes.polynomial import XYPolynomial, ZernikeSag
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane
from pachon.models.shapes.sum import Sum
from pachon.models.surface import Interaction


@pytest.mark.parametrize(
    ("address", "kind", "unit"),
    [
        ("M2.dx", "motion", "m"),
        ("Camera.rz", "motion", "rad"),
        ("M1.radius", "shape", "m"),
        ("M1.curvature", "shape", "1/m"),
        ("M1.conic", "shape", ""),
        ("M1.a6", "shape", "m^-5"),
        ("L1_exit.a4", "shape", "m^-3"),
        ("M1.Z5", "shape", "m"),
        ("L1_entrance.n", "index", ""),
        ("silica.n", "index", ""),
    ],
)
def test_addresses(lsst_r, address, kind, unit):
    found = Parameter.parse(address, lsst_r)
    assert (found.address, found.kind, found.unit) == (address, kind, unit)


@pytest.mark.parametrize(
    ("address", "error", "words"),
    [
        ("M7.dx", UnknownNameError, "M7.*did you mean M"),
        ("M1.connic", UnknownNameError, "connic.*did you mean conic"),
        ("Camera.radius", UnknownNameError, "motion of group Camera"),
        ("M1", ConfigError, "M1.*expected"),
        ("silica.dx", UnknownNameError, "silica.*dx.*expected one of n"),
        ("M1.n", DomainError, "M1.n.*refracting"),
        ("M1.Z0", UnknownNameError, "Z0"),
        ("M1.a5", UnknownNameError, "a5"),
        ("Detector.radius", UnknownNameError, "radius"),
        ("__import__('os').x", UnknownNameError, "unknown surface, group or medium"),
    ],
)
def test_bad_addresses_are_one_line(lsst_r, address, error, words):
    with pytest.raises(error, match=words) as caught:
        Parameter.parse(address, lsst_r)
    assert isinstance(caught.value, PachonError)
    assert "\n" not in str(caught.value)


def test_lists(lsst_r):
    names = [p.address for p in parse_parameters(["M2.*", "M1.Z4-6", "M1.conic"], lsst_r)]
    assert names == [f"M2.{m}" for m in ("dx", "dy", "dz", "rx", "ry", "rz")] + ["M1.Z4", "M1.Z5", "M1.Z6", "M1.conic"]
    with pytest.raises(ConfigError, match=r"M1.Z5.*more than once"):
        parse_parameters(["M1.Z5", "M1.Z4-6"], lsst_r)
    with pytest.raises(ConfigError, match="Z6-4"):
        parse_parameters(["M1.Z6-4"], lsst_r)
    with pytest.raises(ConfigError, match="at least one"):
        parse_parameters([], lsst_r)


def test_the_only_mirror_moves_and_not_a_plane_in_front_of_it(lsst_r):
    plane = replace(lsst_r.surface("Detector"), name="Stop", interaction=Interaction.PASS)
    single = replace(lsst_r, surfaces=(plane, lsst_r.surface("M1"), lsst_r.surface("Detector")), groups={})
    assert [p.address for p in usual_parameters(single)] == ["M1.dx", "M1.dy", "M1.dz", "M1.rx", "M1.ry"]


def test_usual_parameters(lsst_r):
    bodies = dict.fromkeys(p.target for p in usual_parameters(lsst_r))
    assert list(bodies) == ["M2", "M3", "Camera"]
    assert len(usual_parameters(lsst_r)) == 15


def test_zero_is_the_telescope_itself(lsst_r):
    assert apply(lsst_r, {"M2.dx": 0.0, "M1.Z5": 0.0, "L1_entrance.n": 0.0, "M1.a10": 0.0}) == lsst_r


def test_values_are_changes(lsst_r):
    changed = apply(
        lsst_r, {"M1.conic": 0.01, "M1.Z5": 2e-6, "M1.Z7": 1e-6, "L1_entrance.n": 1e-4, "M2.rx": 1e-3, "M2.dz": 5e-4}
    )
    shape = changed.surface("M1").shape
    assert isinstance(shape, Sum)
    assert shape.parameters["conic"] == pytest.approx(-1.205, abs=1e-15)
    added = shape.parts[1]
    # Over the rims of the mirror's own aperture.
    assert added == ZernikeSag((0.0,) * 4 + (2e-6, 0.0, 1e-6), 4.18, 2.558)
    w = 620e-9
    glass = lsst_r.surface("L1_entrance").medium_after.index(w)
    assert changed.surface("L1_entrance").medium_after.index(w) - glass == pytest.approx(1e-4, abs=1e-15)
    assert changed.surface("L2_entrance").medium_after.index(w) == glass
    expected = lsst_r.perturbed("M2", shift=(0, 0, 5e-4), tilt=(1e-3, 0, 0)).surface("M2")
    assert changed.surface("M2") == expected
    melt = apply(lsst_r, {"silica.n": 1e-4})
    for surface, other in zip(melt.surfaces, lsst_r.surfaces, strict=True):
        change = surface.medium_after.index(w) - other.medium_after.index(w)
        assert change == pytest.approx(1e-4 if other.medium_after.name == "silica" else 0.0, abs=1e-15)
    again = apply(changed, {"L1_entrance.n": -1e-4, "M1.Z5": -2e-6})
    assert again.surface("L1_entrance").medium_after.index(w) == pytest.approx(float(glass), abs=1e-15)
    assert again.surface("M1").shape.parameters["Z5"] == 0.0


def test_groups_move_before_what_they_hold(lsst_r):
    values = {"L1.rx": 1e-3, "Camera.ry": 2e-3, "Camera.dx": 1e-3}
    by_hand = lsst_r.perturbed("Camera", shift=(1e-3, 0, 0), tilt=(0, 2e-3, 0)).perturbed("L1", tilt=(1e-3, 0, 0))
    assert apply(lsst_r, values) == by_hand


def test_bad_values(lsst_r):
    with pytest.raises(DomainError, match=r"M2.dx = nan"):
        apply(lsst_r, {"M2.dx": np.nan})
    with pytest.raises(PachonError, match="radius"):
        apply(lsst_r, {"M1.radius": -19.835})


def test_zernike_needs_rims(lsst_r):
    from dataclasses import replace

    surface = lsst_r.surface("M1")
    bare = replace(lsst_r, surfaces=(replace(surface, aperture=None), *lsst_r.surfaces[1:]))
    with pytest.raises(DomainError, match=r"M1.*rims"):
        Parameter.parse("M1.Z5", bare)


def test_twists_are_the_derivatives_of_frames(lsst_r, slope):
    """Nested bodies at finite angles: vertices and axes of all surfaces against central differences."""
    addresses = [f"{b}.{m}" for b in ("L1_exit", "L1", "Camera", "M2") for m in ("dx", "dy", "dz", "rx", "ry", "rz")]
    parameters = parse_parameters(addresses, lsst_r)
    values = np.random.default_rng(2).normal(size=len(addresses)) * 0.02
    found = twists(lsst_r, parameters, values)
    start = apply(lsst_r, dict(zip(addresses, values, strict=True)))
    vertices = np.array([s.vertex for s in start.surfaces])
    axes = np.array([s.matrix for s in start.surfaces])
    for row in range(len(addresses)):

        def frames(h, row=row):
            moved = apply(lsst_r, dict(zip(addresses, values + h * np.eye(len(values))[row], strict=True)))
            return np.concatenate(
                [[s.vertex for s in moved.surfaces], *np.array([s.matrix.T for s in moved.surfaces]).swapaxes(0, 1)]
            )

        v, w = found[row, :, :3], found[row, :, 3:]
        expected = np.concatenate([v + np.cross(w, vertices), *(np.cross(w, axes[:, :, i]) for i in range(3))])
        # Fourth-order differences with a step of 1e-3: 1e-12, and rounding 1e-15 / 1e-3.
        assert np.abs(slope(frames, 1e-3) - expected).max() < 1e-11


@pytest.mark.parametrize(
    ("shape", "name"),
    [
        (EvenAsphere(5.0, -1.0, (1e-3, 1e-4)), "a6"),
        (ZernikeSag((0.0,) * 12, 2.0, 0.5), "Z11"),
        (XYPolynomial(((2, 1, 0.1), (0, 3, 0.2))), "x2y1"),
        (Sum((Conic(3.0, 0.0), ZernikeSag((0.0,) * 9, 2.0))), "Z9"),
    ],
)
def test_polynomials_are_the_derivatives_of_the_sag(shape, name):
    x, y = np.random.default_rng(1).uniform(-1, 1, (2, 20))
    polynomial = term_polynomial(shape, name)
    f, fx, fy = shape.sag_derivative(name, x, y)
    assert np.allclose(polynomial.value(x, y), f, atol=1e-14)
    assert np.allclose(polynomial.gradient(x, y), (fx, fy), atol=1e-13)


def test_what_is_no_polynomial():
    assert term_polynomial(Conic(3.0, 0.0), "radius") is None
    assert term_unit(XYPolynomial(((2, 1, 0.1),)), "x2y1") == "m^-2"
    assert term_unit(XYPolynomial(((1, 0, 0.1),)), "x1y0") == ""
    toroid = Toroid(4.0, -6.0, -0.7, (2e-3, -1e-3))
    assert [term_unit(toroid, name) for name in ("radius_x", "conic_y", "y2", "y4")] == ["m", "", "m^-1", "m^-3"]


def test_new_terms_change_no_sag(lsst_r):
    parameters = parse_parameters(["M1.Z4-11", "M1.a12", "L1_exit.a4", "L1_exit.conic"], lsst_r)
    present = with_shape_terms(lsst_r, parameters)
    for p in parameters:
        assert p.name in present.surface(p.target).shape.parameters
    x = np.linspace(-0.7, 0.7, 9)
    for name in ("M1", "L1_exit"):
        assert np.array_equal(present.surface(name).shape.sag(x, 0.1), lsst_r.surface(name).shape.sag(x, 0.1))


FLAT_PLATE = EvenAsphere(np.inf, 0.0, (1e-3,))
POWER = XYPolynomial(((2, 0, 2e-3), (0, 2, 2e-3)))


@pytest.mark.parametrize("shape", [Plane(), FLAT_PLATE, POWER, Sum((FLAT_PLATE, POWER)), ZernikeSag((0.0, 1e-6), 1.0)])
def test_powers_are_added_to_flat_plates(lsst_r, shape):
    plates = tuple(replace(s, shape=shape) if s.name == "L1_exit" else s for s in lsst_r.surfaces)
    plate = replace(lsst_r, surfaces=plates)
    changed = apply(plate, {Parameter.parse("L1_exit.a6", plate): 0.5})
    x, y = np.array([0.1, -0.3]), np.array([0.2, 0.4])
    added = changed.surface("L1_exit").shape.sag(x, y) - shape.sag(x, y)
    assert added == pytest.approx(0.5 * np.hypot(x, y) ** 6, abs=1e-17)


def test_a_flat_surface_has_no_radius_to_change(lsst_r):
    plates = tuple(replace(s, shape=FLAT_PLATE) if s.name == "L1_exit" else s for s in lsst_r.surfaces)
    with pytest.raises(DomainError, match=r"^L1_exit.radius: expected L1_exit.curvature, for L1_exit is flat$"):
        Parameter.parse("L1_exit.radius", replace(lsst_r, surfaces=plates))
