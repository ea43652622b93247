"""The corpus of calls that once failed: an error of pachon in one line, or a result that is finite or flagged.

Files that once failed are beside them in the corpus (``test_wrong_files.py``).
"""

import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml
from bounds import CHARACTERS
from test_extremes import extremes, kind_of

import pachon

CALLS = yaml.safe_load((Path(__file__).parent / "corpus" / "calls.yaml").read_text())


def value_of(call, argument, value):
    """Return the value of an argument: a number fills the array of the valid call, a name is one of an extreme."""
    valid = call[1][argument]
    if isinstance(value, str) and value.startswith("times "):
        return np.asarray(valid) * float(value.removeprefix("times "))
    if isinstance(value, str):
        return dict(extremes(valid))[value]
    if isinstance(value, list) or not np.ndim(valid):
        return value
    return tuple(np.full_like(valid, value)) if isinstance(valid, tuple) else np.full_like(valid, value)


@pytest.mark.parametrize(("function", "argument", "value", "before", "now"), CALLS, ids=lambda v: str(v))
def test_calls_that_once_failed(function, argument, value, before, now, table):
    call = table[function]
    kind, text = kind_of(*call, {argument: value_of(call, argument, value)})
    expected, _, said = now.partition(": ")
    assert kind == expected, text
    assert said in text
    assert len(text.splitlines()) <= 1
    assert len(text) <= CHARACTERS


Y, X = np.mgrid[:3, :25, :25][1:].astype(float)


@pytest.mark.parametrize("image", [np.ones_like(X), X, X + 2.0 * Y], ids=["constant", "ramp", "plane"])
def test_what_has_no_source_is_flagged(image):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert (pachon.measure_shapes(image, 1e-6, 4e-6).flags != 0).all()
        assert not pachon.adaptive_moments(image, 1e-6).usable.any()
