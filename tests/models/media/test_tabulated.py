"""Tabulated indices against batoid, and what the interpolation promises."""

import numpy as np
import pytest

from pachon.core.errors import DomainError, PrescriptionError
from pachon.models.media.tabulated import TabulatedIndex

WAVES = (0.4e-6, 0.5e-6, 0.65e-6, 0.8e-6, 1.1e-6)
INDICES = (1.53, 1.521, 1.515, 1.511, 1.506)


def test_linear_is_batoids():
    batoid = pytest.importorskip("batoid")
    w = np.linspace(WAVES[0], WAVES[-1], 41)
    peer = batoid.TableMedium(WAVES, INDICES)
    # The same straight lines: rounding.
    found = TabulatedIndex(WAVES, INDICES, "linear").index(w)
    assert np.allclose(found, [peer.getN(v) for v in w], rtol=0, atol=1e-14)


@pytest.mark.parametrize("kind", ["monotone", "linear"])
def test_the_table_is_met_at_its_entries(kind):
    assert TabulatedIndex(WAVES, INDICES, kind).index(WAVES) == pytest.approx(INDICES, rel=1e-15)


def test_monotone_has_no_extremum_of_its_own():
    medium = TabulatedIndex(WAVES, (1.53, 1.52999, 1.515, 1.51499, 1.506))
    assert np.all(np.diff(medium.index(np.linspace(WAVES[0], WAVES[-1], 500))) < 0)


def test_monotone_is_close_to_the_glass_that_was_tabulated():
    def cauchy(w):
        return 1.5 + 0.0042 / (w * 1e6) ** 2

    w = np.linspace(0.4e-6, 1.0e-6, 25)
    between = np.linspace(0.41e-6, 0.99e-6, 101)
    # A cubic with slopes good to second order, steps of 25 nm: some 1e-5.
    assert TabulatedIndex(tuple(w), tuple(cauchy(w))).index(between) == pytest.approx(cauchy(between), abs=1.5e-5)


def test_a_wavelength_outside_the_table_is_refused():
    with pytest.raises(DomainError, match="expected 400 to 1100 nm for this table"):
        TabulatedIndex(WAVES, INDICES).index(1.2e-6)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (((5e-7,), (1.5,)), "at least two"),
        (((6e-7, 5e-7), (1.5, 1.5)), "rising"),
        (((5e-7, 6e-7), (1.5,)), "expected 2 positive numbers"),
        (((5e-7, 6e-7), (1.5, -1.5)), "expected 2 positive numbers"),
        (((5e-7, 6e-7), (1.5, 1.4), "cubic"), "interpolation = 'cubic'"),
    ],
)
def test_impossible_tables_are_refused(arguments, expected):
    with pytest.raises(PrescriptionError, match=expected):
        TabulatedIndex(*arguments)
