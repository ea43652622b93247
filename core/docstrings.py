"""Units and descriptions of attributes and arguments, read from docstrings."""

from __future__ import annotations

import functools
import inspect
import re
from typing import Any, NamedTuple

_SECTION = re.compile(r"^(\w[\w ]*)\n-{3,}$", flags=re.M)
_ENTRY = re.compile(r"^(\w[\w, ]*) : .*$", flags=re.M)
_SHAPE = re.compile(r",? (?:of )?(?:same )?(?:shape )?\[(?:n|n[xy]|n_\w+|k|\d+)(?:, [^]]*)?\](?: bool)?")
_MARKUP = re.compile(r":\w+:`[~.]*([^`]*)`|``?([^`]*)``?")
#: Names of units in docstrings that astropy spells in another way.
_SPELLINGS = {"electrons": "electron", "pixels": "pixel", "cycles": "1", " a ": "/", "deg C": "deg_C", "AB ": ""}


class Description(NamedTuple):
    """Meaning of an attribute, from the docstrings of its class."""

    unit: str  #: as astropy parses it; empty for pure numbers
    text: str  #: its first sentence


def described(kind: Any, name: str) -> Description:
    """Return unit and meaning of an attribute of a class, or of an argument of a class or function."""
    member = inspect.getattr_static(kind, name, None)
    text = inspect.getdoc(member) if isinstance(member, (property, functools.cached_property)) else None
    if text is None:
        lists = (_documented_entries(base.__doc__) for base in getattr(kind, "__mro__", [kind]) if base.__doc__)
        text = next((entries[name] for entries in lists if name in entries), "")
    return Description(_unit_of(text), _first_sentence(text))


def _documented_entries(docstring: str) -> dict[str, str]:
    """Return the entries of the sections Attributes and Parameters of a docstring, by name."""
    meanings = {}
    sections = _SECTION.split(inspect.cleandoc(docstring))
    for title, body in zip(sections[1::2], sections[2::2], strict=True):
        if title in ("Attributes", "Parameters"):
            entries = _ENTRY.split(body)
            for names, meaning in zip(entries[1::2], entries[2::2], strict=True):
                meanings.update(dict.fromkeys(names.split(", "), " ".join(meaning.split())))
    return meanings


def _first_sentence(text: str) -> str:
    sentence = re.split(r"(?<=[^.][\w\])])\. |\n\n", text)[0]
    return _MARKUP.sub(r"\1\2", _SHAPE.sub("", " ".join(sentence.split()))).rstrip(".")


@functools.cache
def _unit_of(text: str) -> str:
    """Return the first unit in square brackets, as astropy spells it; empty where there is none."""
    from astropy import units as u

    for unit_text in re.findall(r"\[([^][,]*[A-Za-z][^][,]*)\]", _SHAPE.sub("", text)):
        for spelling, astropy_spelling in _SPELLINGS.items():
            unit_text = unit_text.replace(spelling, astropy_spelling)
        try:
            # What follows says what they are counted from, as in "pixels from the centre".
            return str(u.Unit(re.split(" from | of ", unit_text)[0]).to_string())
        except ValueError:
            continue
    return ""
