"""Validation of the arguments of public functions and classes by their annotations, before anything is computed."""

from __future__ import annotations

import functools
import importlib
import inspect
import os
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .docstrings import described
from .errors import ConfigError, DomainError, PachonError, PrescriptionError, nearest, shown
from .units import has_unit, in_unit, is_quantity, real_numbers

Target = TypeVar("Target", bound=Callable[..., Any])
#: Function of an argument's name and value: the value as the callee takes it, or a _MismatchError.
_Check = Callable[[str, Any], Any]
#: Attribute of a checked function with the replacements of arguments that it no longer takes.
_REMOVED = "removed_arguments"
#: Arms of the union that ArrayLike is; ``ArrayLike | None`` is one flat union with them.
_ARRAY_ARMS = frozenset(get_args(ArrayLike)) or frozenset({ArrayLike})


class _MismatchError(Exception):
    """Value that an annotation does not allow; `words` are those of which one is expected."""

    def __init__(self, name: str, value: Any, expected: str, words: Sequence[str] = ()) -> None:
        super().__init__(name)
        self.name, self.value, self.expected, self.words = name, value, expected, tuple(words)

    def as_error(self, word_error: type[PachonError]) -> PachonError:
        """Return the error of pachon: of its kind for words, with the nearest of them, else a DomainError."""
        text = f"{self.name} = {shown(self.value)}: expected {self.expected}"
        hint = nearest(self.value, self.words) if isinstance(self.value, str) else ""
        kind = word_error if self.words else DomainError
        return kind(f"{text}; {hint}" if hint else text, key=self.name)


def check_prescription(target: Target) -> Target:
    """Check arguments as :func:`check_arguments` does; a word that is none of several is a PrescriptionError."""
    return check_arguments(target, PrescriptionError)


def check_arguments(target: Target, word_error: type[PachonError] = ConfigError) -> Target:
    """Check the arguments of a function, or of constructor and public methods of a class, by their annotations.

    A value of the wrong kind is a DomainError, or a ConfigError (`word_error`) where one of several words is expected;
    it names argument, value and what was expected. Checked are numbers, texts, paths, functions, classes, and sequences
    and mappings of them. Arguments annotated as arrays take real numbers: no boolean values, texts, times, complex
    numbers or objects. Masked ones become NaN; quantities keep their unit. Those annotated as boolean arrays take True
    and False, and 1 and 0. A quantity where plain numbers are expected is converted to the unit in square brackets of
    the docstring, of a method or, where that has none, of its class.

    Keyword arguments annotated as ``**options: Unpack[SomeTypedDict]`` are checked, and shown in the signature, as if
    each key of the TypedDict were a parameter.

    Names of arguments are checked by Python (TypeError). One that the function no longer takes, or that is a field of
    another argument, is a ConfigError that says what replaces it (:func:`removed_arguments`). Shapes, ranges and NaN
    are checked by the function itself.
    """
    if not inspect.isclass(target):
        return cast(Target, _checked(target, (target,), word_error))
    for name, member in list(vars(target).items()):
        if name.startswith("_") and name != "__init__":
            continue
        if isinstance(member, (classmethod, staticmethod)):
            setattr(target, name, type(member)(_checked(member.__func__, (member, target), word_error)))
        elif inspect.isfunction(member):
            setattr(target, name, _checked(member, (member, target), word_error))
    return target


def removed_arguments(**replacements: str) -> Callable[[Target], Target]:
    """Name what replaces arguments that a function no longer takes; it stands above :func:`check_arguments`.

    Fields of objects that the function takes, as `size` of ``stamps=Stamps(size=...)``, need no line of their own.
    """

    def decorate(function: Target) -> Target:
        function.__dict__[_REMOVED].update(replacements)
        return function

    return decorate


def _checked(
    function: Callable[..., Any], documented: Sequence[Any], word_error: type[PachonError]
) -> Callable[..., Any]:
    if not set(inspect.get_annotations(function)) - {"return"}:
        return function

    unpacked = _unpacked_options(function)

    @functools.cache
    def checks() -> dict[str, _Check | None]:
        # At the first call: an annotation may name a class of a module that is imported after this one, and many
        # functions are never called.
        parameters = inspect.signature(function).parameters.values()
        named = {p.name: _parameter_check(function, p.name) for p in parameters if p.kind is not p.VAR_KEYWORD}
        return named | {name: _annotation_check(kind) for name, kind in unpacked.items()}

    @functools.wraps(function)
    def checked(*args: Any, **options: Any) -> Any:
        parameter_checks = checks()
        # Each value of ``*names`` is checked on its own.
        places = list(parameter_checks.items())
        places += places[-1:] * (len(args) - len(places))
        try:
            checked_args = [
                v if check is None else check(name, v) for v, (name, check) in zip(args, places, strict=False)
            ]
            for name, value in options.items():
                if (check := parameter_checks.get(name)) is not None:
                    options[name] = check(name, value)
                elif name not in parameter_checks and (replacement := _replacement(function, checked, name)):
                    text = f"{name}: no argument of {function.__qualname__}; expected {replacement}"
                    raise ConfigError(text, key=name)
                elif unpacked and name not in parameter_checks:
                    raise TypeError(f"{function.__qualname__}() got an unexpected keyword argument {name!r}")
        except _MismatchError as problem:
            name = problem.name.partition("[")[0]
            # Most calls come without quantities: what they cost is paid here, where plain numbers were expected.
            units = (described(target, name).unit for target in documented)
            if has_unit(problem.value) and (unit := next(filter(None, units), None)):
                if name in options:
                    options[name] = _plain_numbers(options[name], unit, name)
                else:
                    at = [*parameter_checks].index(name)
                    args = (*args[:at], _plain_numbers(args[at], unit, name), *args[at + 1 :])
                return checked(*args, **options)
            raise problem.as_error(word_error) from None
        try:
            return function(*checked_args, **options)
        except MemoryError as problem:
            reason = str(problem) or "not enough memory"
            raise DomainError(f"{function.__qualname__}: {reason}; expected arguments that need less") from None

    checked.__dict__[_REMOVED] = {}
    if unpacked:
        checked.__dict__["__signature__"] = _expanded_signature(function, unpacked)
    return checked


def _unpacked_options(function: Callable[..., Any]) -> dict[str, Any]:
    """Return name and type of each key of ``**options: Unpack[SomeTypedDict]`` of a function; empty without one."""
    parameters = inspect.signature(function).parameters.values()
    annotation = next((p.annotation for p in parameters if p.kind is p.VAR_KEYWORD), None)
    if isinstance(annotation, str) and annotation.startswith("Unpack["):
        annotation = eval(annotation, function.__globals__)
    if get_origin(annotation) is not typing.Unpack:
        return {}
    (options,) = get_args(annotation)
    return typing.get_type_hints(options)


def _expanded_signature(function: Callable[..., Any], unpacked: Mapping[str, Any]) -> inspect.Signature:
    """Return the signature of a function with a keyword for each unpacked option."""
    signature = inspect.signature(function)
    named = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    keyword = inspect.Parameter.KEYWORD_ONLY
    options = [inspect.Parameter(name, keyword, default=None, annotation=kind) for name, kind in unpacked.items()]
    return signature.replace(parameters=[*named, *options])


def _replacement(function: Callable[..., Any], checked: Callable[..., Any], name: str) -> str | None:
    """Return what replaces an argument: as the function says, or an object that it takes and that has such a field."""
    if name in checked.__dict__[_REMOVED]:
        return str(checked.__dict__[_REMOVED][name])
    try:
        annotations = typing.get_type_hints(function)
    except NameError:
        return None
    for parameter, annotation in annotations.items():
        for kind in (annotation, *get_args(annotation)):
            if parameter != "return" and name in getattr(kind, "__dataclass_fields__", ()):
                return f"{parameter}={kind.__name__}({name}=...)"
    return None


def _plain_numbers(value: Any, unit: str, name: str) -> Any:
    """Return a quantity, or a sequence of them, as plain numbers in a unit; an array where it is one."""
    return in_unit(value, unit, name).tolist()


def _parameter_check(function: Callable[..., Any], name: str) -> _Check | None:
    """Return the check of a parameter; None where any value will do."""
    if name not in function.__annotations__:
        return None
    holder = types.SimpleNamespace(__annotations__={name: function.__annotations__[name]})
    names = dict(inspect.unwrap(function).__globals__)
    try:
        return _annotation_check(typing.get_type_hints(holder, names)[name])
    except NameError as missing:
        # Imported for type checkers only: a package, or a class that some callee checks.
        try:
            names[missing.name] = importlib.import_module(str(missing.name))
        except ImportError:
            return None
        return _annotation_check(typing.get_type_hints(holder, names)[name])


def _annotation_check(kind: Any) -> _Check | None:
    """Return the check of an annotation; None where any value will do."""
    origin = get_origin(kind) or kind
    # From NumPy 2.5 on Python 3.12 these are aliases (PEP 695), before it the types that the aliases stand for.
    if kind == ArrayLike:
        return _real_array
    if origin in (Union, types.UnionType):
        arms = list(get_args(kind))
        if str in arms and any(arm is Path or get_origin(arm) is os.PathLike for arm in arms):
            # Names of bundled files, too, are texts that may be paths.
            non_path_arms = [a for a in arms if a not in (str, Path, type(None)) and get_origin(a) is not os.PathLike]
            return _union_check([_valid_path, *filter(None, map(_annotation_check, non_path_arms))], type(None) in arms)
        arrays = [_real_array] if set(arms) >= _ARRAY_ARMS else []
        non_array_arms = [a for a in arms if a is not type(None) and not (arrays and a in _ARRAY_ARMS)]
        checks = [_annotation_check(arm) for arm in non_array_arms]
        return None if None in checks else _union_check([*arrays, *filter(None, checks)], type(None) in arms)
    if origin is Literal:
        return _word_check(get_args(kind))
    if origin in _SEQUENCES:
        return _sequence_check(origin, get_args(kind))
    if origin in (Mapping, dict):
        return _mapping_check(get_args(kind))
    if origin in _PLAIN_CLASSES:
        return _class_check(*_PLAIN_CLASSES[origin])
    if origin is np.ndarray or origin is NDArray:
        return _boolean_array if kind == NDArray[np.bool_] else _unitless_array
    if origin is Path:
        return lambda name, value: Path(_valid_path(name, value))
    if origin is Any or not inspect.isclass(origin) or getattr(origin, "_is_protocol", False):
        return None
    expected = f"{'an' if origin.__name__[0] in 'AEIO' else 'a'} {origin.__name__}"
    # Names are easily taken for the objects that a function loads by them.
    loader = getattr(origin, "LOADER", "")
    return _class_check((origin,), f"{expected}, as of {loader}" if loader else expected)


#: Classes of values that plain annotations allow, and their description in messages.
_PLAIN_CLASSES: dict[Any, tuple[tuple[Any, ...], str]] = {
    bool: ((bool, np.bool_), "True or False"),
    int: ((int, np.integer), "a whole number"),
    float: ((float, int, np.floating, np.integer), "a number"),
    str: ((str,), "a text"),
    os.PathLike: ((os.PathLike,), "a path"),
    Callable: ((Callable,), "a function"),
}
#: Types that Python and NumPy take for whole numbers, and that are refused here.
_NO_NUMBERS = (bool, np.timedelta64)
#: Longest path of common systems [characters].
_LONGEST_PATH = 4096
#: Longest name of a file or folder of common systems [characters].
_LONGEST_NAME = 255
_SEQUENCES = (tuple, list, Sequence, Iterable)
#: Most elements of a sequence that are checked one by one: an array of some bytes may show a number a billion times.
_MOST_ELEMENTS = 10**7


def _class_check(accepted: tuple[Any, ...], expected: str) -> _Check:
    numbers = int in accepted

    def check(name: str, value: Any) -> Any:
        if numbers and type(value) is np.ndarray and value.ndim == 0:
            value = value[()]
        if not isinstance(value, accepted) or (numbers and isinstance(value, _NO_NUMBERS)):
            raise _MismatchError(name, value, expected)
        return value

    return check


def _real_array(name: str, value: Any) -> Any:
    if type(value) is float or type(value) is int:
        return value
    numbers = real_numbers(value)
    if numbers is None:
        raise _MismatchError(name, value, "real numbers")
    return numbers


def _unitless_array(name: str, value: Any) -> Any:
    if is_quantity(value):
        raise _MismatchError(name, value, "numbers without a unit")
    return np.asarray(_real_array(name, value))


def _boolean_array(name: str, value: Any) -> Any:
    try:
        flags = np.asarray(value)
    except (ValueError, OverflowError):
        flags = np.empty(0)
    if flags.dtype.kind == "b":
        return value
    # Masks are often stored as whole numbers, for lack of a type for them.
    if flags.dtype.kind not in "iu" or is_quantity(value) or not np.isin(flags, (0, 1)).all():
        raise _MismatchError(name, value, "an array of True and False, or of 1 and 0")
    return flags.astype(bool)


def _valid_path(name: str, value: Any) -> str | os.PathLike[str]:
    if not isinstance(value, (str, os.PathLike)):
        raise _MismatchError(name, value, "a path")
    text = os.fspath(value)
    if "\0" in text or len(text) > _LONGEST_PATH or max(map(len, Path(text).parts), default=0) > _LONGEST_NAME:
        limits = f"at most {_LONGEST_PATH} characters, {_LONGEST_NAME} of them between slashes, and no zero byte"
        raise _MismatchError(name, value, f"a path of {limits}")
    return value


def _word_check(words: tuple[Any, ...]) -> _Check:
    def check(name: str, value: Any) -> Any:
        if not (isinstance(value, str) and value in words):
            named_words = [word for word in words if word]
            expected = f"one of {', '.join(named_words)}" if len(named_words) > 1 else named_words[0]
            raise _MismatchError(name, value, expected, named_words)
        return value

    return check


def _union_check(checks: list[_Check], optional: bool) -> _Check:
    def check(name: str, value: Any) -> Any:
        if optional and value is None:
            return None
        problems = []
        for arm_check in checks:
            try:
                return arm_check(name, value)
            except _MismatchError as problem:
                # Its traceback would hold this frame, which holds it: a ring that keeps the arrays of all callers until
                # Python looks for such garbage.
                problems.append(problem.with_traceback(None))
        # Of a sequence whose elements are wrong, the element is the likelier mistake.
        inner = next((p for p in problems if p.name != name), None)
        several = list(dict.fromkeys(p.expected for p in problems))
        expected = " or ".join(several) if len(several) < 4 else f"one of {', '.join(several)}"
        words = [word for p in problems for word in p.words]
        raise inner or _MismatchError(name, value, expected, words)

    return check


def _sequence_check(kind: Any, elements: tuple[Any, ...]) -> _Check:
    fixed = kind is tuple and Ellipsis not in elements
    checks = [_annotation_check(element) for element in elements if element is not Ellipsis] or [None]
    expected = f"a sequence of {len(checks)}" if fixed else "a sequence"
    simple = {element for element in elements if element is not Ellipsis}
    numeric = bool(simple) and simple <= {int, float}
    simple = simple if kind is tuple and len(simple) == 1 and get_origin(*simple) is None else set()

    def check(name: str, value: Any) -> Any:
        # Most tuples come from pachon itself, and are as they should be.
        if (
            type(value) is tuple
            and simple
            and simple.issuperset(map(type, value))
            and (not fixed or len(value) == len(checks))
        ):
            return value
        refused = (str, bytes) if kind is Iterable else (str, bytes, Mapping)
        # To Python, an array without axes is iterable too.
        single = isinstance(value, np.ndarray) and not value.ndim
        if single or isinstance(value, refused) or not isinstance(value, Iterable):
            raise _MismatchError(name, value, expected)
        if isinstance(value, Mapping):
            value = list(value)
        if not isinstance(value, (list, tuple, np.ndarray)):
            # An iterator can be used once only.
            return value
        if numeric and isinstance(value, np.ndarray) and value.dtype.kind == "O":
            raise _MismatchError(name, value, f"{expected} of numbers")
        if len(value) > _MOST_ELEMENTS:
            raise _MismatchError(name, value, f"{expected} of at most {_MOST_ELEMENTS}")
        if fixed and len(value) != len(checks):
            raise _MismatchError(name, value, expected)
        element_checks = checks if fixed else checks * len(value)
        pairs = enumerate(zip(value, element_checks, strict=True))
        elements = [v if check is None else check(f"{name}[{i}]", v) for i, (v, check) in pairs]
        return tuple(elements) if kind is tuple else elements

    return check


def _mapping_check(kinds: tuple[Any, ...]) -> _Check:
    check_key, check_value = (_annotation_check(kind) for kind in kinds) if kinds else (None, None)

    def check(name: str, value: Any) -> Any:
        if not isinstance(value, Mapping):
            raise _MismatchError(name, value, "a mapping")
        for key, entry in value.items():
            if check_key is not None:
                check_key(f"key of {name}", key)
            if check_value is not None:
                check_value(f"{name}[{key!r}]", entry)
        return value

    return check
