"""Public functions called with one number at an extreme: an error of pachon, or a result that is finite or flagged.

``pytest -m slow tests/contracts/test_extremes.py -s`` makes every call, by package, and prints the counts by outcome;
``-k "all_extremes and models"`` those of one package. The short run makes some thousand. Files and calls that once
failed are in the corpus (``test_failed_calls.py``).
"""

import dataclasses
import inspect
import warnings
import zlib
from collections import Counter

import numpy as np
import pytest
from bounds import CHARACTERS, LINES, MEMORY_OF_CALL, Hang, bounded
from test_wrong_arguments import LONG, is_numbers

from pachon.core.errors import PachonError

#: One of so many calls is made in the short run, and of functions that take a second.
SHARE = 800
SHARE_OF_COSTLY = 2000
COSTLY = ("check_orientation", "choose_glasses", "fit_donuts", "shim")
#: Packages of public functions, each a part of the long run.
PACKAGES = ("core", "models", "raytrace", "wavefront", "design", "sky", "sensing", "measure", "reconstruction",
            "pipeline", "imaging", "studies", "testing", "desk")  # fmt: skip
#: Processor time of a call [s].
SECONDS = 10.0
#: Sizes of numbers, with both signs.
POWERS = (3, 6, 9, 12, 15, 20, 30, 40, 50, 100, 200, 300)
SIZES = (0.0, 5e-324, *(10.0**-power for power in reversed(POWERS)), *(10.0**power for power in POWERS))
#: Whole numbers.
COUNTS = (0, -1, 2**15, -(2**15), 10**6, 2**31, -(2**31), 2**32, 2**63 - 1, -(2**63))
#: Factors of the valid value.
FACTORS = (1e-12, 1e-9, 1e-6, 1e-3, -1.0, 1e3, 1e6, 1e9, 1e12)
#: Values that make sense, of which the call takes many seconds: all glasses of a catalogue, a hundred square degrees.
ENDURING = {
    ("choose_glasses", "nearest", f"{2**15}"),
    ("choose_glasses", "nearest", f"{10**6}"),
    ("draw_galaxies", "region", "times 1000"),
}
#: Depth to which results are searched.
DEPTH = 4
#: Words in the names of attributes that say which results hold.
FLAGS = ("pairs", "flag", "status", "usable", "valid", "lit", "converged", "weight", "mask", "reason", "lost")


def extremes(value):
    """Values of the right kind at the ends of what numbers can be."""
    array = np.asarray(value)
    if array.dtype.kind in "iu":
        for number in COUNTS:
            yield f"{number}", np.full_like(array, number, dtype=np.int64) if array.ndim else number
        yield "int8", array.astype(np.int8) if array.ndim else np.int8(array)
        return
    numbers = [sign * size for size in SIZES for sign in ((1, -1) if size else (1,))] + [np.nan, np.inf, -np.inf]
    for number in numbers:
        yield f"{number:g}", np.full_like(array, number) if array.ndim else float(number)
        if array.size > 1 and not isinstance(value, tuple):
            spoilt = array.copy()
            spoilt[(0,) * array.ndim] = number
            yield f"first {number:g}", spoilt
    for factor in FACTORS:
        yield f"times {factor:g}", array * factor if array.ndim else float(value) * factor
    if not array.ndim:
        yield "float32", np.float32(value)
        yield "array", np.asarray(value)
    elif not isinstance(value, tuple):
        yield "float32", array.astype(np.float32)
        yield "float16", array.astype(np.float16)
        yield "big endian", array.astype(">f8")
        yield "backwards", np.ascontiguousarray(array[::-1])[::-1]
        yield "read only", _read_only(array)
        yield "endless", np.broadcast_to(array, (10**9, *array.shape))
        yield "many", np.broadcast_to(array.ravel()[0], (10**9, *array.shape[1:]))


def _read_only(array):
    frozen = array.copy()
    frozen.setflags(write=False)
    return frozen


def numbers_of(result, depth=DEPTH):
    """Yield the name and numbers of every array and number of a result."""
    if isinstance(result, (float, np.floating, np.ndarray)):
        if np.asarray(result).dtype.kind == "f":
            yield "", np.asarray(result)
    elif depth and isinstance(result, (tuple, list)):
        for element in result[:20]:
            yield from numbers_of(element, depth - 1)
    elif depth and isinstance(result, dict):
        for name, element in list(result.items())[:40]:
            yield from ((f"{name}.{inner}", a) for inner, a in numbers_of(element, depth - 1))
    elif depth and dataclasses.is_dataclass(result) and not isinstance(result, type):
        for field in dataclasses.fields(result):
            element = getattr(result, field.name, None)
            yield from ((f"{field.name}.{inner}", a) for inner, a in numbers_of(element, depth - 1))


def flags_of(result, depth=3):
    """Return the values of what says which results hold, as texts, by name."""
    if isinstance(result, dict):
        members = list(result.items())[:40]
    elif isinstance(result, (tuple, list)):
        members = [(str(i), element) for i, element in enumerate(result[:20])]
    else:
        members = [(name, _attribute(result, name)) for name in dir(result) if not name.startswith("_")]
    values = {}
    for name, value in members:
        if any(word in str(name) for word in FLAGS) and not callable(value):
            values[name] = np.array2string(np.asarray(value)) if np.size(value) < 1000 else str(np.sum(value))
        elif depth and (isinstance(value, (dict, tuple, list)) or dataclasses.is_dataclass(value)):
            values |= {f"{name}.{inner}": text for inner, text in flags_of(value, depth - 1).items()}
    return values


def _attribute(result, name):
    try:
        return getattr(result, name)
    except Exception:
        return None


def outcome(function, arguments):
    """Return the kind of a call's outcome, what it said, the numbers that are not finite, and its flags.

    A result says what the documentation of its class does.
    """
    try:
        with bounded(MEMORY_OF_CALL, SECONDS), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = function(**arguments)
            spoilt = {name or "result" for name, array in numbers_of(result) if not np.isfinite(array).all()}
            return "finite", inspect.getdoc(type(result)) or "", spoilt, flags_of(result)
    except PachonError as error:
        text = str(error)
        return ("refused" if len(text.splitlines()) <= LINES and len(text) <= CHARACTERS else "long"), text, set(), {}
    except Hang:
        return "hang", "", set(), {}
    except Exception as error:
        return "raw", f"{type(error).__name__}: {str(error)[:200]}", set(), {}


def kind_of(function, arguments, changed, valid=None):
    """Return the kind of the outcome of a call of which arguments are changed, and what it said.

    `valid` is the outcome of the call as it was; it is made anew where there are numbers that are not finite.
    """
    kind, text, spoilt, flags = outcome(function, arguments | changed)
    if kind == "finite":
        valid = (outcome(function, arguments) if spoilt else ("", "", set(), {})) if valid is None else valid
        documentation, text = f"{inspect.getdoc(function)}\n{text}", ", ".join(sorted(spoilt - valid[2]))
        if text:
            infinite = any(np.isinf(value).any() for value in changed.values() if np.size(value) < 10**6)
            documented = "NaN" in documentation or ("infinite" in documentation and infinite)
            kind = "flagged" if flags != valid[3] else "documented" if documented else "silent"
    elif valid is not None and (kind, text) == valid[:2] and text:
        # The example is refused as it is, for a file that is not there.
        kind = "refused"
    return kind, text


def outcomes(label, function, arguments, chosen):
    """Yield kind and description of the calls that are chosen by their number."""
    valid = None
    number = 0
    for name, value in arguments.items():
        if not is_numbers(value) or isinstance(value, bool):
            continue
        for change, extreme in extremes(value):
            number += 1
            if not chosen(number) or (label, name) in {call[:2] for call in LONG} or (label, name, change) in ENDURING:
                continue
            valid = valid or outcome(function, arguments)
            kind, text = kind_of(function, arguments, {name: extreme}, valid)
            yield kind, f"{kind:9s}{label}({name}={change}): {text[:300]}"


#: What may come of an extreme: NaN where results say which of them hold, or where the documentation speaks of it.
GOOD = ("refused", "finite", "flagged", "documented")


def check(table, chosen):
    counts, bad = Counter(), []
    for label, (function, arguments) in table.items():
        if inspect.ismethod(function) or callable(function):
            for kind, text in outcomes(label, function, arguments, lambda n, label=label: chosen(label, n)):
                counts[kind] += 1
                if kind not in GOOD:
                    bad.append(text)
                    print(text, flush=True)
    print(dict(counts))
    assert not bad, "\n".join(bad)


@pytest.mark.long
def test_some_extremes(table):
    def chosen(label, number):
        share = SHARE_OF_COSTLY if label in COSTLY else SHARE
        return zlib.crc32(label.encode()) % share == number % share

    check(table, chosen)


def package(function):
    """Return the name of the package that a public function, class or method comes from."""
    return function.__module__.split(".")[1]


@pytest.mark.long
def test_every_package_is_a_part(table):
    assert {package(function) for function, _ in table.values()} == set(PACKAGES)


@pytest.mark.slow
@pytest.mark.parametrize("part", PACKAGES)
def test_all_extremes(part, table):
    check({label: call for label, call in table.items() if package(call[0]) == part}, lambda label, n: True)
