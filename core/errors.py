"""Exceptions for bad input: each a subclass of :class:`PachonError` with a text of one line.

Errors of values are ValueErrors too, those of names KeyErrors: code that catches the built-in ones need not know these.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from reprlib import Repr
from typing import Any, ParamSpec, Self, TypeVar

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
#: Longest text of a value in a message [characters].
_MAX_VALUE = 80
#: Longest text of a path in a message [characters].
_MAX_PATH = 200
#: Longest message [characters].
_MAX_MESSAGE = 600
_REPR = Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = _MAX_VALUE
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = _REPR.maxset = 8


class PachonError(Exception):
    """Base of all errors that a user can cause and correct.

    Its text is ``subject: file, place: problem``, without the parts that are None.

    Parameters
    ----------
    problem : str
        Key, value and expected value.
    subject : str, optional
        Object that could not be computed, such as ``"CCD R22_S11"``.
    file : str or path, optional
        File with the error.
    place : str, optional
        Part of the file, such as ``"line 3, surface 2"``.
    key : str, optional
        Key with the error, with dots between sections; it stands in `problem` as well.
    """

    def __init__(
        self,
        problem: str = "",
        *,
        subject: str | None = None,
        file: str | os.PathLike[str] | None = None,
        place: str | None = None,
        key: str | None = None,
    ) -> None:
        # Some texts hold what a library says of a file, and names out of it.
        problem = cut_short(" ".join(problem.split("\n")), _MAX_MESSAGE)
        super().__init__(problem)
        self.problem = problem
        self.subject = subject
        self.file = None if file is None else os.fspath(file)
        self.place = place
        self.key = key

    def __str__(self) -> str:
        return self.reason if self.subject is None else f"{self.subject}: {self.reason}"

    @property
    def reason(self) -> str:
        """Text of the error without its subject."""
        where = ", ".join(cut_short(location, _MAX_PATH) for location in (self.file, self.place) if location)
        return f"{where}: {self.problem}" if where else self.problem

    def within(
        self,
        *,
        subject: str | None = None,
        file: str | os.PathLike[str] | None = None,
        place: str | None = None,
        key: str | None = None,
    ) -> Self:
        """Return the same error in a wider context; an error of the same file already has it.

        `key` is the section of the error's own key, or the key that names another file with the error.
        """
        if file is not None and self.file == os.fspath(file):
            return self
        if file is None and not key:
            # A subject that an inner context has stated is not repeated.
            stated = subject is not None and (f"{self.subject}:".startswith(f"{subject}:") or subject == self.file)
            full_subject = ": ".join(text for text in (None if stated else subject, self.subject) if text)
            return type(self)(
                self.problem, subject=full_subject or None, file=self.file, place=self.place, key=self.key
            )
        inner = self.file is None and self.subject is None
        # A problem that begins with a key goes on with its section, one that begins with a name or a word does not.
        join = ": " if not inner or self.problem.startswith(("unknown ", "'")) else "."
        problem = join.join(filter(None, (key, self.problem if inner else str(self))))
        keys = ".".join(filter(None, (key, self.key))) if inner else key
        return type(self)(problem, subject=subject, file=file, place=place, key=keys or None)

    def followed_by(self, text: str) -> Self:
        """Return the same error with a further part of its problem."""
        problem = f"{self.problem}; {text}"
        return type(self)(problem, subject=self.subject, file=self.file, place=self.place, key=self.key)

    def renamed(self, key: str) -> Self:
        """Return the same error with another name of its key, such as that of a command's option."""
        problem = self.problem.replace(self.key, key) if self.key else self.problem
        return type(self)(problem, subject=self.subject, file=self.file, place=self.place, key=key)


class PrescriptionError(PachonError, ValueError):
    """Malformed prescription or site file."""


class PrescriptionWarning(UserWarning):
    """Part of a prescription that is not understood and left out, or that data contradict."""


class PrescriptionNote(PrescriptionWarning):
    """How a part of a lens file is read that other programs read otherwise; no fault of the file."""


class HeightWarning(UserWarning):
    """Measured heights with gaps, without some CCDs, or of an unlikely size."""


class WcsWarning(UserWarning):
    """World coordinates that are known with errors only."""


class ConfigError(PachonError, ValueError):
    """Malformed configuration file or option."""


class UnknownNameError(PachonError, KeyError):
    """Unknown name of a model, surface, CCD or site."""


class DomainError(PachonError, ValueError):
    """Value outside the domain of a model."""


class ProductError(PachonError):
    """Product that cannot be read or written."""


def shown(value: object) -> str:
    """Return a value as messages show it: on one line, cut short, and large arrays by type and shape."""
    shape = getattr(value, "shape", None)
    if shape == ():
        # Numbers and quantities of NumPy and astropy without their types.
        return cut_short(str(value), _MAX_VALUE)
    if isinstance(shape, tuple) and getattr(value, "size", 0) > 8:
        kind = getattr(value, "dtype", None)
        return f"{type(value).__name__} of shape {shape}" + ("" if kind is None else f" and type {kind}")
    return cut_short(" ".join(_REPR.repr(value).split()), _MAX_VALUE)


def cut_short(text: str, length: int = 60) -> str:
    """Return a text of at most `length` characters."""
    return text if len(text) <= length else text[: length - 3] + "..."


def attempt(
    function: Callable[_Arguments, _Result], *arguments: _Arguments.args, **options: _Arguments.kwargs
) -> _Result | PachonError:
    """Return what a function returns, or the PachonError that it raises."""
    try:
        return function(*arguments, **options)
    except PachonError as error:
        return error


@contextmanager
def error_context(**context: Any) -> Iterator[None]:
    """Raise errors of the block again within a wider context; keywords as in :meth:`PachonError.within`."""
    try:
        yield
    except PachonError as error:
        raise error.within(**context) from None


def check_choice(name: str, value: object, choices: Iterable[str]) -> None:
    """Raise a ConfigError if an argument is not one of the choices."""
    if value not in (allowed := tuple(choices)):
        hint = nearest(value, allowed, n=1)
        expected_text = f"expected one of {', '.join(allowed)}" + (f"; {hint}" if hint else "")
        raise ConfigError(f"{name} = {shown(value)}: {expected_text}")


def check_unique(kind: str, names: Sequence[str]) -> None:
    """Raise a ConfigError if a name of a kind occurs twice."""
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{kind} {name!r} occurs more than once: expected unique names")


def unknown_name(kind: str, name: str, allowed: Iterable[str]) -> UnknownNameError:
    """Return the error for an unknown name of a kind, such as ``"CCD"``, with the nearest of the allowed names."""
    names = list(allowed)
    listed_names = ", ".join(names) if len(names) <= 12 else f"{len(names)} names such as {', '.join(names[:3])}"
    hint = nearest(name, names, n=4, cutoff=0.5) or f"expected one of {listed_names}"
    return UnknownNameError(f"unknown {kind} {shown(name)}: {hint}")


def nearest(name: object, names: Iterable[str], n: int = 2, cutoff: float = 0.6) -> str:
    """Return the names nearest to a name, as "did you mean"; empty where none is near."""
    if len(str(name)) > _MAX_VALUE:
        # Comparing takes a time that grows with the square of the length.
        return ""
    lowered = {key.lower(): key for key in names}
    near = [lowered[key] for key in get_close_matches(str(name).lower(), list(lowered), n=n, cutoff=cutoff)]
    return f"did you mean {' or '.join(near)}?" if near else ""
