"""Arguments are checked by their annotations: what passes is unchanged, what does not is one line with its name."""

import gc
import inspect
import pickle
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, TypedDict, Unpack

import numpy as np
import pytest
from astropy import units as u
from astropy.table import Column, MaskedColumn
from astropy.utils.masked import Masked
from numpy.typing import ArrayLike, NDArray

import pachon
from pachon.core.arguments import check_arguments
from pachon.core.errors import ConfigError, DomainError, PachonError, shown
from pachon.core.units import metres, pure_numbers, require_count, require_positive


@check_arguments
def example(
    number: float = 0.0,
    count: int | None = None,
    *,
    values: ArrayLike | None = None,
    flags: ArrayLike | NDArray[np.bool_] | None = None,
    plain: np.ndarray | None = None,
    pair: tuple[float, float] = (0.0, 0.0),
    names: Iterable[str] = (),
    rows: Sequence[int] = (),
    way: Literal["up", "down"] = "up",
    path: str | Path = "",
    done: Callable[[int], None] | None = None,
    sizes: Mapping[str, float] | None = None,
    rays: "pachon.Rays | None" = None,
):
    return number, count, values, flags, plain, pair, names, rows, way, path, done, sizes, rays


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("number", 1), ("number", np.float32(1.0)), ("number", np.array(2.0)), ("count", np.int64(3)), ("count", None),
        ("values", 1.5), ("flags", np.array([True])), ("pair", (1, 2.0)), ("names", ["a"]), ("way", "down"),
        ("path", "a/b"), ("done", print), ("sizes", {"a": 1.0}),
    ],
)  # fmt: skip
def test_values_of_their_kind_pass(name, value):
    assert value in example(**{name: value})


@check_arguments
def masked(mask: NDArray[np.bool_] | Sequence[NDArray[np.bool_]] | None = None):
    return mask


def test_masks_are_boolean_or_ones_and_zeros():
    flags = np.array([[True, False], [False, True]])
    assert masked(flags) is flags
    assert masked(flags.tolist()) == flags.tolist()
    for kind in (np.uint8, np.int64):
        found = masked(flags.astype(kind))
        assert found.dtype == bool
        np.testing.assert_array_equal(found, flags)
    for one, other in zip(masked([flags, flags[:1]]), (flags, flags[:1]), strict=True):
        np.testing.assert_array_equal(one, other)
    for wrong in (2 * flags.astype(int), flags.astype(float), "mask", [flags, np.array([2, 1])], 1 * flags * u.m):
        with pytest.raises(DomainError, match=r"mask.* = .*: expected an array of True and False, or of 1 and 0"):
            masked(wrong)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("number", True, "a number"), ("number", np.timedelta64(1, "s"), "a number"), ("number", 1 * u.m, "a number"),
        ("number", "1", "a number"), ("count", 1.0, "a whole number"), ("values", "abc", "real numbers"),
        ("values", [True, False], "real numbers"), ("values", np.array([1 + 1j]), "real numbers"),
        ("values", np.array(["2026-01-01"], dtype="M8[D]"), "real numbers"), ("values", [[1.0], [1.0, 2.0]], "real"),
        ("values", np.array([None]), "real numbers"), ("plain", [1.0] * u.m, "numbers without a unit"),
        ("pair", (1.0,), "a sequence of 2"), ("names", "abc", "a sequence"), ("rows", {1: 2}, "a sequence"),
        ("path", 5, "a path"), ("path", "a\0b", "a path"), ("path", "x" * 300, "a path"), ("done", 1, "a function"),
        ("sizes", [1.0], "a mapping"), ("rays", 1.0, "a Rays"), ("way", "left", "one of up, down"),
    ],
)  # fmt: skip
def test_other_values_are_one_line_with_their_name(name, value, expected):
    with pytest.raises(PachonError, match=f"^{name} = .*: expected {expected}") as caught:
        example(**{name: value})
    assert "\n" not in str(caught.value)
    assert caught.value.key == name
    assert isinstance(caught.value, ConfigError if name == "way" else DomainError)


def test_elements_are_named():
    with pytest.raises(DomainError, match=r"^names\[1\] = 2: expected a text"):
        example(names=["a", 2])
    with pytest.raises(DomainError, match=r"^sizes\['b'\] = 'x': expected a number"):
        example(sizes={"a": 1.0, "b": "x"})


def test_names_of_arguments_are_left_to_python():
    with pytest.raises(TypeError, match="unexpected keyword"):
        example(unknown=1)


def test_arrays_that_need_nothing_are_the_same_object():
    values = np.arange(3.0)
    assert example(values=values)[2] is values
    assert example(plain=values)[4] is values


def test_masked_values_are_nan():
    for masked in (
        np.ma.masked_array([1, 2, 3], mask=[False, True, False]),
        [np.ma.masked_array(1), np.ma.masked, 3],
        MaskedColumn([1.0, 2.0, 3.0], mask=[False, True, False]),
    ):
        np.testing.assert_array_equal(np.asarray(example(values=masked)[2], dtype=float), [1.0, np.nan, 3.0])
    whole = example(values=np.ma.masked_array([1, 2], mask=False))[2]
    assert type(whole) is np.ndarray
    assert whole.dtype.kind == "i"
    lengths = Masked([1.0, 2.0] * u.mm, mask=[False, True])
    np.testing.assert_array_equal(metres(lengths, "x"), [1e-3, np.nan])


def test_columns_keep_their_unit():
    np.testing.assert_allclose(metres(Column([1.0, 2.0], unit="mm"), "x"), [1e-3, 2e-3])
    np.testing.assert_array_equal(pure_numbers(Column([1.0, 2.0], unit="pix"), "x"), [1.0, 2.0])
    np.testing.assert_allclose(metres([1.0 * u.mm, 2.0 * u.m], "x"), [1e-3, 2.0])


def test_numbers_without_a_unit():
    np.testing.assert_array_equal(pure_numbers([1, 2] * u.one, "x"), [1.0, 2.0])
    with pytest.raises(DomainError, match=r"^x = .*: expected real numbers without a unit"):
        pure_numbers([1.0] * u.m, "x")


def test_counts_and_positive_numbers():
    assert require_count(np.int64(3), "n", 1) == require_count(3.0, "n", 1) == 3
    for value in (0, 2.5, np.nan, "3", True, None, 10**9):
        with pytest.raises(DomainError, match=r"^n = "):
            require_count(value, "n", 1)
    for value in (0.0, -1.0, np.nan, np.inf, 1e300, True, "1", [1.0, 2.0], None, 1 * u.m):
        with pytest.raises(DomainError, match=r"^x = "):
            require_positive(value, "x")


class Endless:
    def __repr__(self):
        return "line\n" * 100_000


@pytest.mark.parametrize(
    "value", [Endless(), "x" * 10**6, list(range(10**6)), np.zeros((500, 500)), 10**3000, {1: Endless()}]
)
def test_values_are_shown_on_one_short_line(value):
    assert len(shown(value)) <= 80
    assert "\n" not in shown(value)


def test_no_message_is_longer_than_a_few_lines():
    error = DomainError("x" * 10**6, file="/y" * 10**5)
    assert len(str(error)) < 1000
    assert error.file == "/y" * 10**5
    assert "\n" not in str(DomainError("a\nb"))


def test_masked_stars_and_pixels():
    """Masked stars are left out of correlations; masked pixels of stars have no weight in moments and fits."""
    rng = np.random.default_rng(1)
    x, y, e1, e2 = rng.uniform(-0.01, 0.01, (4, 200))
    bins = pachon.SeparationBins(1e-3, 1e-2, 3, exact=True)
    outlier = np.arange(200) >= 150
    spoilt = np.ma.masked_array(np.where(outlier, 100.0, e1), mask=outlier)
    found = pachon.shear_correlation(x, y, spoilt, e2, bins=bins)
    alone = pachon.shear_correlation(x[:150], y[:150], e1[:150], e2[:150], bins=bins)
    np.testing.assert_array_equal(found.xi_plus, alone.xi_plus)
    grid = np.mgrid[-7:8, -7:8]
    stamps = np.stack([np.exp(-0.5 * (grid**2).sum(axis=0) / w**2) for w in (1.5, 1.8, 2.0)])
    bad = stamps.copy()
    bad[1, 7, 9] = 50.0
    masked = np.ma.masked_array(bad, mask=bad == 50.0)
    shapes = pachon.measure_shapes(masked, 1e-6, 4e-6)
    right = pachon.measure_shapes(stamps, 1e-6, 4e-6)
    np.testing.assert_array_equal(shapes.e1[[0, 2]], right.e1[[0, 2]])
    assert abs(shapes.e1[1] - right.e1[1]) < 1e-6  # a Gaussian star is filled by a Gaussian
    at = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    options = {"recipe": "paper", "n_components": 1, "order": 0}
    model = pachon.PsfModel.fit(masked, at, **options)
    same = pachon.PsfModel.fit(bad, at, masks=bad == 50.0, **options)
    np.testing.assert_array_equal(model.mean, same.mean)


def test_checked_classes_stay_themselves():
    circle = pachon.models.Circle(1.0)
    assert pickle.loads(pickle.dumps(circle)) == circle
    assert pachon.models.Circle.__init__.__doc__ == circle.__init__.__doc__
    assert pachon.trace.__name__ == "trace"
    assert "telescope" in pachon.trace.__wrapped__.__annotations__


def test_many_threads_may_make_the_first_call():
    @check_arguments
    def first(a: float, b: ArrayLike, *more: int):
        return a, b, more

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(lambda i: first(float(i), 1.0, 2, 3), range(8))) == {
            (float(i), 1.0, (2, 3)) for i in range(8)
        }
    with pytest.raises(DomainError, match="more = 'x': expected a whole number"):
        first(1.0, 1.0, 2, "x")


def test_a_name_in_place_of_a_telescope_is_told_what_loads_it():
    with pytest.raises(pachon.errors.DomainError) as caught:
        pachon.spots("lsst_v3.3_r")
    assert (
        str(caught.value) == "telescope = 'lsst_v3.3_r': expected a Telescope, as of pachon.load_telescope or a Request"
    )


class _Sizes(TypedDict, total=False):
    width: float | None
    kind: Literal["round", "square"] | None


@check_arguments
def _area(factor: float, **sizes: Unpack[_Sizes]) -> float:
    return factor * sizes["width"] ** 2


def test_unpacked_keywords_are_checked_and_shown_as_parameters():
    assert list(inspect.signature(_area).parameters) == ["factor", "width", "kind"]
    assert _area(2.0, width=3.0, kind="round") == 18.0
    with pytest.raises(DomainError, match=r"^width = 'wide': expected a number$"):
        _area(2.0, width="wide")
    with pytest.raises(ConfigError, match=r"^kind = 'oval': expected one of round, square$"):
        _area(2.0, kind="oval")
    with pytest.raises(TypeError, match=r"_area\(\) got an unexpected keyword argument 'height'"):
        _area(2.0, height=1.0)


class _Large:
    """Something large of a caller."""


def test_checks_hold_nothing_of_their_callers():
    """A value that only a later arm of a union takes left a ring of frames, with all that callers had."""

    @check_arguments
    def either(value: int | str | None = None) -> object:
        return value

    def caller() -> weakref.ref:
        large = _Large()
        either("text")
        return weakref.ref(large)

    gc.disable()
    try:
        assert caller()() is None
    finally:
        gc.enable()


def test_methods_have_the_units_of_their_class():
    """Their docstrings say that arguments are as in the class: quantities were refused as no numbers."""
    layers = {"altitudes": [0.0, 5.0] * u.km, "weights": [0.4, 0.6], "wind_speeds": [18.0, 36.0] * u.km / u.hour}
    site = pachon.models.load_site("cerro_pachon").with_layers(**layers)
    assert site.altitudes == pytest.approx([0.0, 5000.0])
    assert site.wind_speeds == pytest.approx([5.0, 10.0])
    assert pachon.Stamps.of_camera("lsst", jitter=1.0 * u.arcsec).jitter == pytest.approx(np.pi / 648000)
    assert pachon.Air.at_humidity(0.5, pressure=750.0 * u.hPa).pressure == pytest.approx(75000.0)
    with pytest.raises(DomainError, match=r"^altitudes = .*: expected a unit that converts to m"):
        site.with_layers(altitudes=[0.0, 5.0] * u.s)


def test_pixels_of_tables_are_pure_numbers():
    """Tables of our own results have places in pixels, and functions that take such places refused them."""
    assert pure_numbers([1.0, 2.0] * u.pix, "x").tolist() == [1.0, 2.0]
    assert pachon.measure.match_positions([3.0] * u.pix, [4.0] * u.pix, [3.1], [4.0], 1.0).tolist() == [0]
    for other in ([1.0] * u.m, [1.0] * u.mag, [1.0] * u.pix**2):
        with pytest.raises(DomainError, match="expected real numbers without a unit"):
            pure_numbers(other, "x")
