"""Public functions called with one wrong argument: an error of pachon that names it, never a hang, crash or raw error.

``pytest -m slow tests/contracts/test_wrong_arguments.py -s`` makes every call and prints the counts by outcome; the
short run makes every fiftieth.
"""

import inspect
import warnings
import zlib
from collections import Counter
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from bounds import CHARACTERS, LINES, MEMORY_OF_CALL, Hang, bounded
from public_names import public_functions

from pachon.core.errors import PachonError

#: Share of the calls in the short run.
SHARE = 480


class Surprise:
    """An object of no kind, whose text is a book."""

    def __repr__(self):
        return "a line\n" * 10000


def is_numbers(value):
    try:
        return np.size(value) > 0 and np.asarray(value).dtype.kind in "iuf"
    except (TypeError, ValueError):
        return False


def wrong_kinds(value, optional):
    """Values of a kind that the argument does not take; each must be refused."""
    yield "object", Surprise()
    if value is not None and not optional:
        yield "None", None
    if is_numbers(value):
        array = np.asarray(value)
        yield "text", "text"
        yield "complex", array * 1j if array.ndim else 1j
        yield "datetime", np.full(array.shape, np.datetime64("2026-01-01")) if array.ndim else datetime(2026, 1, 1)
        yield "timedelta", np.full(array.shape, np.timedelta64(1, "s"))
        yield "bool", array.astype(bool) if array.ndim else True
        yield "texts", array.astype(str)
        if not isinstance(value, tuple):
            # Each element of a tuple is checked on its own.
            yield "objects", np.array(array, dtype=object) if array.ndim else np.array(Surprise())
        yield "mapping", {"a": 1.0}
        yield "unit", array * u.kg
        if array.ndim and not isinstance(value, tuple):
            yield "ragged", [[*np.ravel(array), 1.0], [1.0, 2.0, 3.0], [1.0]]
    elif isinstance(value, bool):
        yield "text", "yes"
        yield "number", 0.5
    elif isinstance(value, str):
        yield "number", 5
        yield "array", np.zeros(3)
    elif isinstance(value, Path):
        yield "number", 5
        yield "array", np.zeros((100, 100))
        yield "zero byte", "a\0b"
    else:
        yield "text", "text"
        yield "number", 5
        yield "array", np.zeros((100, 100))


def wrong_values(value):
    """Values of the right kind that make no sense, or may make none; each is refused or leads to a result."""
    if isinstance(value, str):
        yield "unknown", "no such word"
        yield "empty", ""
        yield "long", "x" * 100_000
    elif isinstance(value, Path):
        yield "missing", value.with_name("nothing here")
        yield "folder", value.parent
        yield "long", value.with_name("x" * 5000)
    elif is_numbers(value) and not isinstance(value, bool):
        array = np.asarray(value)
        whole = array.dtype.kind in "iu"
        yield "negative", -1 - np.abs(array) if array.ndim else -1 - abs(value)
        yield "zero", array * 0 if array.ndim else value * 0
        yield "huge", array.astype(np.int64) + 10**12 if whole else array * 1e300 + 1e300
        if not array.ndim:
            yield "huge", 10**30 if whole else 1e300
            yield "list", [value, value, value]
        if not whole:
            spoilt = array.copy()
            spoilt[(0,) * array.ndim] = np.nan
            yield "one nan", spoilt
            yield "nan", np.full_like(array, np.nan) if array.ndim else np.nan
            yield "infinite", np.full_like(array, np.inf) if array.ndim else np.inf
            yield "masked", np.ma.masked_array(array, mask=np.ones(array.shape, bool))
        yield "empty", np.array([])
        yield "empty list", []
        yield "deep", array[None, None, None, None]
        if array.ndim:
            yield "0-d", float(array.flat[0])
            yield "shorter", array[:-1]
            yield "longer", np.concatenate([array, array])
            yield "flat", array.ravel() if array.ndim > 1 else array[:, None]
        yield "big", np.zeros((200, 200))
    elif type(value) in (list, tuple):
        yield "empty", type(value)()
        yield "texts", type(value)(["x"] * len(value))
        yield "longer", value + value


def said(function, arguments):
    """Return the kind of the outcome of a call and what it said."""
    try:
        with bounded(MEMORY_OF_CALL), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            function(**arguments)
    except PachonError as error:
        text = str(error)
        return ("refused" if len(text.splitlines()) <= LINES and len(text) <= CHARACTERS else "long"), text
    except Hang:
        return "hang", ""
    except Exception as error:
        return "raw", f"{type(error).__name__}: {str(error)[:200]}"
    return "accepted", ""


def mutated(function, arguments):
    """Return argument, name of the change, changed arguments and whether they must be refused."""
    parameters = inspect.signature(function).parameters
    for name, value in arguments.items():
        optional = "None" in str(parameters[name].annotation)
        kinds = [(True, *change) for change in wrong_kinds(value, optional)]
        for must, change, wrong in kinds + [(False, *change) for change in wrong_values(value)]:
            yield name, change, arguments | {name: wrong}, must


#: Wrong kinds that are none: masks of True and False, labels of any kind, integers as objects, None among numbers,
#: mappings by name; or another error of the example comes first.
FINE = {
    ("mask", "bool"),
    ("indices", "bool"),
    ("terms", "objects"),
    ("wind_directions", "objects"),
    ("exposures", "array"),
    *((name, "mapping") for name in ("reflectivity", "expansion", "values")),
    ("pointing", "unit"),
    *(("patch", change) for change in ("None", "bool", "complex", "texts", "objects", "unit")),
    *((name, "unit") for name in ("wavelengths", "pixel_size", "diffusion", "jitter")),
}


#: Values that make sense, of which the call takes seconds: a whole report, images without sky.
LONG = {("design_report", "fields", "zero"), ("check_orientation", "sky_variance", "zero")}


def outcomes(label, function, arguments, chosen):
    """Yield outcome and description of the calls that are chosen by their number."""
    valid = None
    for number, (name, change, wrong, must) in enumerate(mutated(function, arguments)):
        if not chosen(number) or (label, name, change) in LONG:
            continue
        valid = valid or said(function, arguments)
        kind, text = said(function, wrong)
        if kind == valid[0] and text == valid[1]:
            kind = "accepted"
        told = isinstance(wrong[name], (str, Path)) and str(wrong[name])[:30] in text
        if kind == "refused" and name.rstrip("s") not in text and not told:
            # Of a value out of range the cause may lie in several arguments.
            kind = "unnamed" if must and (name, change) not in FINE else "told"
        if kind == "accepted" and must and (name, change) not in FINE:
            kind = "silent"
        yield kind, f"{kind:9s}{label}({name}={change}): {text[:300]}"


#: What may come of a wrong argument: refused by name, told what is wrong (for a value out of range), or a result.
GOOD = ("refused", "told", "accepted")


def check(table, chosen):
    counts, bad = Counter(), []
    for label, (function, arguments) in table.items():
        for kind, text in outcomes(label, function, arguments, lambda n, label=label: chosen(label, n)):
            counts[kind] += 1
            if kind not in GOOD:
                bad.append(text)
    print(dict(counts))
    assert not bad, "\n".join(bad)


def test_every_public_function_has_a_call(table):
    assert not public_functions() - set(table)


@pytest.mark.long
def test_some_wrong_arguments(table):
    check(table, lambda label, n: zlib.crc32(label.encode()) % SHARE == n % SHARE)


@pytest.mark.slow
def test_all_wrong_arguments(table):
    check(table, lambda label, n: True)


@pytest.mark.slow
def test_a_call_that_does_not_end_is_found():
    def endless():
        while True:
            pass

    assert said(endless, {}) == ("hang", "")
    assert said(lambda: bytearray(10 * MEMORY_OF_CALL), {})[0] == "raw"
