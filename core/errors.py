"""Every exception that pachon raises for bad input: one clear line, a subclass of :class:`PachonError`."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class PachonError(Exception):
    """Base of all errors that a user can cause and mend."""


class PrescriptionError(PachonError):
    """A prescription or site file is malformed."""


class PrescriptionWarning(UserWarning):
    """Something in a lens file that a lenient reader left out."""


class ConfigError(PachonError):
    """A configuration file or option is malformed."""


class UnknownNameError(PachonError):
    """A name (model, surface, CCD, site) does not exist."""


class DomainError(PachonError):
    """A value lies outside what the model covers."""


class ProductError(PachonError):
    """A product cannot be read or written."""


def unknown_name(kind: str, name: str, allowed: Iterable[str]) -> UnknownNameError:
    """Return the error for an unknown name, with the nearest known names.

    Parameters
    ----------
    kind : str
        What the name should be: ``"model"``, ``"CCD"``, ``"surface"``.
    name : str
        The name given.
    allowed : iterable of str
        The names that exist.
    """
    names = list(allowed)
    lowered = {n.lower(): n for n in names}
    near = [lowered[m] for m in get_close_matches(str(name).lower(), list(lowered), n=4, cutoff=0.5)]
    if near:
        hint = "did you mean " + " or ".join(near) + "?"
    elif len(names) <= 12:
        hint = "expected one of " + ", ".join(names)
    else:
        hint = f"expected one of {len(names)} names such as {', '.join(names[:3])}"
    return UnknownNameError(f"unknown {kind} {name!r}: {hint}")
