"""Ellipticities of stacks on the sky, against moments carried from the axes of the stack to west and north."""

import numpy as np
import pytest
from astropy.io import fits

from pachon.core.docstrings import described
from pachon.core.products import Stamp
from pachon.core.units import ARCMIN
from pachon.studies.visits.stack import PsfStack

RNG = np.random.default_rng(3)


def stack_along(axes, g):
    """Return a stack whose axes are d(x, y)/d(xi, eta), of PSFs of ellipticities [n] along them."""
    n = len(g)
    sky = RNG.uniform(-10.0, 10.0, (n, 2)) * ARCMIN
    places, one, stamps = sky @ axes.T, np.ones(n), np.zeros((n, 3, 3), dtype=np.float32)
    model = {f"model_{key}": 0.0 * one for key in ("e1", "e2", "size")}
    shapes = {"e1": g.real, "e2": g.imag, "size": 1e-6 * one} | model
    return PsfStack(2, *sky.T, *places.T, one > 0, np.full(n, 2), stamps, stamps, **shapes)


def shape_of(q):
    return (q[0, 0] - q[1, 1] + 2j * q[0, 1]) / (np.trace(q) + 2.0 * np.sqrt(np.linalg.det(q)))


@pytest.mark.parametrize("mirrored", [1.0, -1.0])
@pytest.mark.parametrize("angle", [0.0, 40.0, 200.0])
def test_moments_are_carried_to_west_and_north(angle, mirrored, tmp_path):
    turn = np.deg2rad(angle)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ np.diag([mirrored, 1.0])
    g = RNG.normal(0.0, 0.1, 6) + 1j * RNG.normal(0.0, 0.1, 6)
    stack = stack_along(axes, g)
    to_sky = np.diag([-1.0, 1.0]) @ np.linalg.inv(axes)
    for one, e1, e2 in zip(g, stack.e1_sky, stack.e2_sky, strict=True):
        round_part, square = 1.0 + abs(one) ** 2, 2.0 * np.array([[one.real, one.imag], [one.imag, -one.real]])
        expected = shape_of(to_sky @ (round_part * np.eye(2) + square) @ to_sky.T)
        assert complex(e1, e2) == pytest.approx(expected, abs=1e-12)
    units = {"e1": "", "e2": "", "size": "rad", "model_e1": "", "model_e2": "", "model_size": "rad"}
    assert {name: described(PsfStack, name).unit for name in units} == units
    stack.write_product(tmp_path / "stack.fits", Stamp("0", 1))
    table = fits.getdata(tmp_path / "stack.fits", "POINTS")
    assert np.array_equal(table["E1_SKY"], stack.e1_sky)
    # Units of angle there and back: rounding.
    assert np.allclose(PsfStack.read(tmp_path / "stack.fits").e2_sky, stack.e2_sky, rtol=0, atol=1e-14)
