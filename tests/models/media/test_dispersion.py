"""Dispersion formulas against themselves written out once more, published indices and batoid."""

import math

import numpy as np
import pytest

from pachon.core.errors import DomainError, PrescriptionError
from pachon.models.media.dispersion import FORMULAS, Dispersion, model_glass
from pachon.models.media.medium import ConstantIndex, RelativeToAir, Sellmeier

RANGE = (0.3e-6, 2.5e-6)
# Coefficients of no glass in particular: every term shows.
A = (2.3, -0.011, 0.013, 8e-4, -9e-5, 5e-6, 1.1e-6, 2e-7, -3e-8)


def restated(name, w, a):
    """The formulas of the Zemax glass catalogue as its manual prints them, w in um."""
    square = {
        "schott": lambda: a[0] + a[1] * w**2 + a[2] / w**2 + a[3] / w**4 + a[4] / w**6 + a[5] / w**8,
        "extended": lambda: restated("schott", w, a) ** 2 + a[6] / w**10 + a[7] / w**12,
        "extended_2": lambda: restated("schott", w, a) ** 2 + a[6] * w**4 + a[7] * w**6,
        "extended_3": lambda: (
            a[0]
            + a[1] * w**2
            + a[2] * w**4
            + a[3] / w**2
            + a[4] / w**4
            + a[5] / w**6
            + a[6] / w**8
            + a[7] / w**10
            + a[8] / w**12
        ),
        "sellmeier_2": lambda: 1 + a[0] + a[1] * w**2 / (w**2 - a[2] ** 2) + a[3] / (w**2 - a[4] ** 2),
        "sellmeier_4": lambda: a[0] + a[1] * w**2 / (w**2 - a[2]) + a[3] * w**2 / (w**2 - a[4]),
        "handbook_1": lambda: a[0] + a[1] / (w**2 - a[2]) - a[3] * w**2,
        "handbook_2": lambda: a[0] + a[1] * w**2 / (w**2 - a[2]) - a[3] * w**2,
    }
    if name in ("schott", "sumita"):
        return math.sqrt(square["schott"]())
    if name in square:
        return math.sqrt(square[name]())
    pole = 1 / (w**2 - 0.028)
    if name == "herzberger":
        return a[0] + a[1] * pole + a[2] * pole**2 + a[3] * w**2 + a[4] * w**4 + a[5] * w**6
    if name == "conrady":
        return a[0] + a[1] / w + a[2] / w**3.5
    if name == "buchdahl":
        shift = w - a[3]
        return a[0] + a[1] * shift / (1 + 2.5 * shift) + a[2] * shift**2 / (1 + 2.5 * shift) ** 2
    assert name == "cauchy"
    return a[0] + a[1] / w**2 + a[2] / w**4 + a[3] / w**6


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("w", [0.35, 0.5876, 1.0, 2.2])
def test_each_formula_is_the_one_of_the_manual(name, w):
    coefficients = A[: FORMULAS[name].size]
    medium = Dispersion(name, coefficients, RANGE)
    # Powers and their sums in another order: rounding.
    assert float(medium.index(w * 1e-6)) == pytest.approx(restated(name, w, coefficients), rel=1e-14)


def test_coefficients_left_out_at_the_end_are_zero():
    short, padded = Dispersion("schott", (2.25,), RANGE), Dispersion("schott", (2.25, 0, 0, 0, 0, 0), RANGE)
    assert float(short.index(5e-7)) == float(padded.index(5e-7)) == 1.5


def test_sumita_is_batoids():
    batoid = pytest.importorskip("batoid")
    coefficients = (2.2718929, -0.010108077, 0.010592509, 2.0816965e-4, -7.6472538e-6, 4.9240991e-7)
    w = np.linspace(0.35e-6, 1.2e-6, 31)
    peer = batoid.SumitaMedium(coefficients)
    # Same formula in float64: rounding only.
    assert np.allclose(
        Dispersion("sumita", coefficients, RANGE).index(w), [peer.getN(v) for v in w], rtol=0, atol=1e-14
    )


def test_schotts_old_coefficients_of_bk7_give_its_indices():
    # Schott's catalogue of 1967 and its lines d, F, C, 1.01398 um (t); five to six decimals.
    bk7 = Dispersion(
        "schott", (2.2718929, -1.0108077e-2, 1.0592509e-2, 2.0816965e-4, -7.6472538e-6, 4.9240991e-7), RANGE
    )
    found = bk7.index(np.array([0.5875618, 0.4861327, 0.6562725, 1.01398]) * 1e-6)
    assert found == pytest.approx([1.51680, 1.52238, 1.51432, 1.50731], abs=6e-6)


def test_shapes_follow_the_wavelength():
    medium = Dispersion("cauchy", (1.5, 0.004), RANGE)
    assert medium.index(np.full((2, 3), 5e-7)).shape == (2, 3)
    assert medium.index(5e-7).shape == ()


def test_media_are_hashable_and_equal_whatever_their_name():
    one, other = Dispersion("cauchy", (1.5,), RANGE, "a"), Dispersion("cauchy", (1.5,), RANGE, "b")
    assert one == other
    assert len({one, other}) == 1


@pytest.mark.parametrize("w", [0.29e-6, 2.51e-6, float("nan")])
def test_a_wavelength_out_of_range_is_refused(w):
    with pytest.raises(DomainError, match="expected 300 to 2500 nm"):
        Dispersion("schott", (2.25,), RANGE).index(w)


def test_a_formula_without_a_real_index_is_refused():
    with pytest.raises(DomainError, match=r"wavelength = 500 nm: .* no real index"):
        Dispersion("schott", (1.0, -8.0), RANGE).index([3e-7, 5e-7])
    with pytest.raises(DomainError, match="no real index"):
        Sellmeier((3.0,), (0.3,), RANGE).index(5e-7)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("shot", (1.0,), RANGE), "formula = 'shot': expected one of schott"),
        (("conrady", (1.0, 0, 0, 0), RANGE), "expected 1 to 3 finite numbers for conrady"),
        (("schott", (), RANGE), "expected 1 to 6"),
        (("schott", (float("nan"),), RANGE), "expected 1 to 6 finite"),
        (("schott", (2.0,), (1e-6, 1e-7)), "wavelength_range"),
    ],
)
def test_impossible_numbers_are_refused(arguments, expected):
    with pytest.raises(PrescriptionError, match=expected):
        Dispersion(*arguments)


# Name, Sellmeier B and C, nd, Vd, deviation of P_gF: Schott's catalogue of 2017.
GLASSES = [
    ((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653), 1.5168, 64.17, -0.0009),
    ((1.34317774, 0.241144399, 0.994317969), (0.00704687339, 0.0229005, 92.7508526), 1.62041, 60.32, -0.0011),
    ((1.34533359, 0.209073176, 0.937357162), (0.00997743871, 0.0470450767, 111.886764), 1.62004, 36.37, 0.0002),
    ((1.73848403, 0.311168974, 1.17490871), (0.0136068604, 0.0615960463, 121.922711), 1.78472, 25.76, 0.0142),
]


@pytest.mark.parametrize(("b", "c", "nd", "vd", "deviation"), GLASSES)
def test_a_model_glass_is_close_to_the_glass_of_its_figures(b, c, nd, vd, deviation):
    model, glass = model_glass(nd, vd, deviation), Sellmeier(b, c)
    # The bounds of the docstring.
    for w, bound in [(0.40, 5e-4), (0.55, 4e-6), (0.71, 3e-4), (1.0, 8e-4), (1.55, 2e-3)]:
        assert float(model.index(w * 1e-6) - glass.index(w * 1e-6)) == pytest.approx(0, abs=bound)


def test_a_model_glass_has_the_figures_it_was_made_of():
    model = model_glass(1.6, 40.0, 0.01)
    d, f, c, g = (float(model.index(w * 1e-6)) for w in (0.5875618, 0.4861327, 0.6562725, 0.4358343))
    # Newton's method to rounding; the Abbe number divides a difference of 1e-2.
    assert d == pytest.approx(1.6, abs=1e-14)
    assert (d - 1) / (f - c) == pytest.approx(40.0, rel=1e-12)
    assert (g - f) / (f - c) == pytest.approx(0.6438 - 0.001682 * 40.0 + 0.01, rel=1e-11)


def test_a_model_glass_without_dispersion_is_constant():
    assert model_glass(1.5, 0.0) == ConstantIndex(1.5)


@pytest.mark.parametrize("figures", [(0.0, 60.0, 0.0), (float("nan"), 60.0, 0.0), (1.5, -3.0, 0.0), (1.5, 60.0, 5.0)])
def test_a_model_glass_of_impossible_figures_is_refused(figures):
    with pytest.raises(PrescriptionError, match="expected the numbers of a glass"):
        model_glass(*figures)


def test_figures_relative_to_air_are_multiplied_by_that_of_the_air_at_the_wavelength_in_air():
    air = ConstantIndex(1.0003)
    figures = Dispersion("cauchy", (1.5, 0.004), RANGE)
    expected = 1.0003 * (1.5 + 0.004 / (0.5 / 1.0003) ** 2)
    assert float(RelativeToAir(figures, air).index(0.5e-6)) == pytest.approx(expected, rel=1e-15)
