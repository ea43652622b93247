"""Validation of files by pydantic: strict sections, checked values, and errors of one line.

A file is a tree of :class:`Section`. :func:`validated` reports the first problem with file, path of keys, value and
expected value. Nothing here is imported with ``import pachon``: pydantic takes longer than all else.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Self, TypeVar, Union, get_args, get_origin

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError, core_schema

from .errors import ConfigError, PachonError, cut_short, nearest
from .yaml_reader import as_number

Model = TypeVar("Model", bound=BaseModel)


def plain_number(value: Any) -> Any:
    """Return text that is a number as the number, and other values unchanged."""
    # YAML 1.1 reads 1e-9, without a point, as text.
    number = as_number(value) if isinstance(value, str) else None
    return value if number is None else number


Real = Annotated[float, BeforeValidator(plain_number), Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, BeforeValidator(plain_number), Field(strict=True, allow_inf_nan=False, gt=0)]
NotNegative = Annotated[float, BeforeValidator(plain_number), Field(strict=True, allow_inf_nan=False, ge=0)]
Count = Annotated[int, Field(strict=True, ge=1)]
Whole = Annotated[int, Field(strict=True, ge=0)]
Fraction = Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=0, le=1)]
Switch = Annotated[bool, Field(strict=True)]


class Section(BaseModel):
    """Immutable mapping of a file; unknown keys are errors."""

    # Built when first used: sections may hold one another.
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _only_known_keys(cls, content: Any) -> Any:
        if isinstance(content, dict):
            allowed_keys = cls.keys()
            for key in content:
                if key not in allowed_keys:
                    raise unknown_key(key, allowed_keys)
            cls.check(content)
        return content

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:
        """Raise :func:`expected` or :func:`problem` for keys that exclude or need one another."""

    @classmethod
    def keys(cls) -> list[str]:
        """Return the keys of the section as they stand in a file."""
        return [field.alias or name for name, field in cls.model_fields.items()]


def validated(
    model: type[Model],
    content: Any,
    source: str,
    error: type[PachonError] = ConfigError,
    context: Any = None,
    *,
    drop: Callable[[PachonError], None] | None = None,
) -> Model:
    """Return the model of the plain mappings, lists and values of a file, of which `source` is the name in messages.

    Raises `error` with the first problem, in one line, if a key is unknown or missing or a value is not as expected.
    `context` is that of the validators, such as the units of the file. With `drop`, unknown keys are left out of the
    content, and it is called with the error of each.
    """
    while True:
        try:
            return model.model_validate(content, context=context)
        except ValidationError as problems:
            # A misspelt key is the likelier cause of the other problems, so it goes first.
            errors = _of_unions(problems.errors(include_url=False), content)
            first = min(errors, key=lambda p: p["type"] != "unknown_key")
            first_error = _one_line_error(first, content, source, error, others=errors, model=model)
            if drop is None or first["type"] != "unknown_key":
                raise first_error from None
            drop(first_error)
            del first["input"][first["ctx"]["key"]]


def problems_of(
    model: type[BaseModel], content: Any, source: str, error: type[PachonError] = ConfigError, context: Any = None
) -> list[PachonError]:
    """Return the errors of all problems that :func:`validated` would find one after the other; unknown keys first.

    Unknown keys are taken out of the content.
    """
    all_errors: list[PachonError] = []
    while True:
        try:
            # Validators write into the context.
            model.model_validate(content, context=None if context is None else dict(context))
        except ValidationError as problems:
            errors = _of_unions(problems.errors(include_url=False), content)
            unknown = [p for p in errors if p["type"] == "unknown_key"]
            all_errors += [_one_line_error(p, content, source, error, model=model) for p in unknown or errors]
            for unknown_problem in unknown:
                del unknown_problem["input"][unknown_problem["ctx"]["key"]]
            if unknown:
                continue
        return all_errors


def unknown_key(key: str, allowed: list[str]) -> PydanticCustomError:
    """Return the error of a validator of a section with an unknown key."""
    return PydanticCustomError("unknown_key", "unknown key", {"key": key, "allowed": allowed})


def expected(text: str, key: str = "") -> PydanticCustomError:
    """Return the error of a value, or of that under a key of a section, that is missing or not as expected."""
    return PydanticCustomError("expected", "expected", {"expected": text, "key": key})


def one_of(choices: Iterable[str], value: object) -> str:
    """Return the expected value where it is one of several names, the nearest in parentheses."""
    names = list(choices)
    near = nearest(value, names, n=1)
    return f"one of {', '.join(names)}" + (f" ({near})" if near else "")


def either(content: Mapping[str, Any], key: str, alternatives: Iterable[str]) -> None:
    """Raise unless a section has one key, or else all of its alternatives."""
    for alternative in alternatives:
        if (key in content) == (alternative in content):
            raise expected(f"{key} or {alternative}, not both", alternative)


@dataclass(frozen=True, eq=False)
class Tagged:
    """Discriminated union of sections by kind, as an annotation.

    `kind` is a function from a mapping to its kind, one of the keys of `classes`; it raises :func:`expected`. The value
    is the object that a section builds or, where `built` is False, the section itself. `key`, for JSON schemas, is that
    under which the kind stands.
    """

    classes: Mapping[str, type[Section]]
    kind: Callable[[dict[str, Any]], str]
    built: bool = True
    key: str = ""

    @classmethod
    def by_value(cls, key: str, classes: Mapping[str, type[Section]]) -> Tagged:
        """Return the union of sections whose kind stands under a key."""

        def kind(content: dict[str, Any]) -> str:
            value = content.get(key)
            if not isinstance(value, str) or value not in classes:
                raise expected(one_of(classes, value), key)
            return value

        return cls(classes, kind, key=key)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        # Tags stand in the locations of errors; the brackets tell them from keys.
        choices: Any = {f"<{kind}>": handler.generate_schema(section) for kind, section in self.classes.items()}
        union: Any = core_schema.tagged_union_schema(
            choices, discriminator=lambda content: f"<{self.kind(content)}>", metadata={"tag_key": self.key}
        )
        if self.built:
            union = core_schema.no_info_after_validator_function(_build, union)
        return core_schema.no_info_before_validator_function(self._check, union)

    def _check(self, content: Any) -> Any:
        if not isinstance(content, dict):
            raise expected("a mapping of keys to values")
        self.kind(content)
        return content


def _build(section: Parameters) -> Any:
    try:
        return section.build()
    except PachonError as error:
        raise problem(f": {error}" if error.file else f".{error}") from None


@dataclass(frozen=True, eq=False)
class WrittenAs:
    """Conversion of a value to its form in a file, as an annotation."""

    convert: Callable[[Any], Any]


class Parameters(Section):
    """Section whose values are the positional arguments of a dataclass or function, for reading and writing alike.

    The two numbers under a key of `pairs` are two arguments. A value is written by :class:`WrittenAs` of its type.
    """

    make: ClassVar[Callable[..., Any]]
    parameters: ClassVar[tuple[str, ...]]
    pairs: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def of(cls, make: Callable[..., Any], **fields: Any) -> type[Self]:
        """Return the subclass for a constructor; fields are types, or types and defaults, in its order."""
        entries: Any = {key: field if isinstance(field, tuple) else (field, ...) for key, field in fields.items()}
        section = create_model(cls.__name__, __base__=cls, **entries)
        section.make, section.parameters = staticmethod(make), tuple(fields)
        return section

    def build(self) -> Any:
        """Return the object that the section describes."""
        values = [(getattr(self, key), key in self.pairs) for key in self.parameters]
        return self.make(*(v for value, pair in values for v in (value if pair else (value,))))

    @classmethod
    def written(cls, built: Any) -> dict[str, Any]:
        """Return the section of an object that it builds."""
        values = (getattr(built, field.name) for field in fields(built))
        section = {key: (next(values), next(values)) if key in cls.pairs else next(values) for key in cls.parameters}
        for key, value in section.items():
            for how in cls.model_fields[key].metadata:
                section[key] = how.convert(value) if isinstance(how, WrittenAs) else section[key]
        return section


def written(classes: Mapping[str, type[Parameters]], built: Any) -> tuple[str, dict[str, Any]] | None:
    """Return kind and section of an object, or None where no section builds objects of its class."""
    for kind, section in classes.items():
        if isinstance(section.make, type) and isinstance(built, section.make):
            return kind, section.written(built)
    return None


def problem(text: str, key: str = "") -> PydanticCustomError:
    """Return the error of a validator whose text stands right behind the path."""
    return PydanticCustomError("problem", "problem", {"text": text, "key": key})


def checked(convert: Callable[[Any], Any], text: str) -> BeforeValidator:
    """Return a validator that converts a value; where the conversion gives None, the value is not as expected."""

    def convert_or_raise(value: Any) -> Any:
        converted = convert(value)
        if converted is None:
            raise expected(text)
        return converted

    return BeforeValidator(convert_or_raise)


#: Validator of an optional section: a key without a value is an error.
mapping = checked(lambda value: value if isinstance(value, dict) else None, "a mapping of keys to values")


def known_keys(model: type[BaseModel]) -> tuple[str, ...]:
    """Return all keys of a model, with dots between sections."""
    keys: list[str] = []
    for name, field in model.model_fields.items():
        section, key = field.annotation, field.alias or name
        if isinstance(section, type) and issubclass(section, BaseModel):
            keys += [f"{key}.{inner}" for inner in known_keys(section)]
        else:
            keys.append(key)
    return tuple(keys)


def whole_number_keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Yield the keys of a model whose values are whole numbers, with dots between sections."""
    for name, field in model.model_fields.items():
        section, key = field.annotation, f"{prefix}{field.alias or name}"
        if isinstance(section, type) and issubclass(section, BaseModel):
            yield from whole_number_keys(section, f"{key}.")
        elif _is_whole(section):
            yield key


def _is_whole(annotation: Any) -> bool:
    """Return whether values of a type are whole numbers, or open."""
    if get_origin(annotation) is Annotated:
        return _is_whole(get_args(annotation)[0])
    arms = [arm for arm in get_args(annotation) if arm is not NoneType]
    return annotation is int or (len(arms) == 1 and get_origin(annotation) in (Union, UnionType) and _is_whole(arms[0]))


def key_description(model: type[BaseModel], key: str) -> str:
    """Return the description of a key of a model, with dots between sections; empty where there is none."""
    first, _, inner_key = key.partition(".")
    for name, field in model.model_fields.items():
        if (field.alias or name) == first:
            section = field.annotation
            if inner_key and isinstance(section, type) and issubclass(section, BaseModel):
                return key_description(section, inner_key)
            return "" if inner_key else field.description or ""
    return ""


def json_text(value: Any) -> str:
    """Return a value as JSON, cut short."""
    return cut_short(json.dumps(value, ensure_ascii=False, default=str))


_EXPECTED = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "string_type": "a text",
    "tuple_type": "a list",
    "dict_type": "a mapping of keys to values",
    "model_type": "a mapping of keys to values",
    "model_attributes_type": "a mapping of keys to values",
    "none_required": "nothing",
}
_LIMITS = {"greater_than": ("gt", "above"), "greater_than_equal": ("ge", "from"), "less_than_equal": ("le", "up to")}


def _missing_key(problem: Mapping[str, Any], content: Any) -> str:
    """Return the path of the key that is missing, or an empty text where the problem is another one."""
    key = problem.get("ctx", {}).get("key") if problem["type"] == "expected" else None
    if problem["type"] != "missing" and (not key or key in problem["input"]):
        return ""
    return _key_path([*problem["loc"], *filter(None, [key])], content)


def _one_line_error(
    problem: Mapping[str, Any],
    content: Any,
    source: str,
    error: type[PachonError],
    *,
    others: Iterable[Mapping[str, Any]] = (),
    model: type[BaseModel],
) -> PachonError:
    """Return the error of a problem; one of a missing key names those that `others` miss too.

    A key that is unknown at the top of a file, but known in sections of its model, is said to be theirs.
    """
    kind, value, limits = problem["type"], problem["input"], problem.get("ctx", {})
    path = _key_path([*problem["loc"], *filter(None, [limits.get("key")])], content)
    if kind == "unknown_key":
        key, allowed_keys = limits["key"], limits["allowed"]
        inner = [known for known in known_keys(model) if known.endswith(f".{key}")] if path == key else []
        hint = f"did you mean {' or '.join(inner[:2])}?" if inner else nearest(key, allowed_keys)
        hint = hint or f"expected one of {', '.join(allowed_keys)}"
        return error(f"unknown key {path} = {_value_text(error, value[key])}: {hint}", file=source, key=path)
    if kind == "problem":
        return error(f"{path}{limits['text']}", file=source, key=path)
    if limits.get("key"):
        kind, value = ("expected", value[limits["key"]]) if limits["key"] in value else ("missing", None)
    if kind == "missing":
        also = [key for key in dict.fromkeys(_missing_key(p, content) for p in others) if key not in ("", path)]
        also_text = ", ".join(also[:8] + ["..."] * (len(also) > 8))
        return error(f"{path} is missing" + (f"; also {also_text}" if also else ""), file=source, key=path)
    text = _expected_text(kind, limits, value, problem["msg"])
    return error(f"{path} = {_value_text(error, value)}: expected {text}", file=source, key=path)


def _expected_text(kind: str, limits: Mapping[str, Any], value: Any, message: str) -> str:
    """Return what was expected in place of a value, by the kind of its problem."""
    if kind == "expected":
        return str(limits["expected"])
    if kind == "literal_error":
        return one_of(str(limits["expected"]).replace(" or ", ", ").replace("'", "").split(", "), value)
    if kind in _LIMITS:
        name, word = _LIMITS[kind]
        return f"a number {word} {limits[name]:g}"
    return _EXPECTED.get(kind, message)


#: Names of types in the locations of pydantic: tuple[float, ...], literal['random'], str, PhotometrySection.
_TYPE_NAME = re.compile(r".*[\[(].*|str|int|float|bool|\w+Section")


def _of_unions(errors: Iterable[Any], content: Any) -> list[Any]:
    """Return the problems with those of each value that may be of several types as one, or as those deepest in it."""
    places = [(_union_place(problem, content), problem) for problem in errors]
    merged: list[Any] = []
    done = set()
    for place, problem in places:
        if place is None:
            merged.append(problem)
        elif place not in done:
            done.add(place)
            of_value = [p for other_place, p in places if other_place == place]
            depth = max(len(p["loc"]) for p in of_value)
            if depth > len(place) + 1:
                merged += [
                    p | {"loc": (*place, *p["loc"][len(place) + 1 :])} for p in of_value if len(p["loc"]) == depth
                ]
                continue
            value = problem["input"]
            texts = [_expected_text(p["type"], p.get("ctx", {}), value, p["msg"]) for p in of_value]
            text = ", or ".join(dict.fromkeys(texts))
            merged.append(problem | {"type": "expected", "loc": place, "ctx": {"expected": text}})
    return merged


def _union_place(problem: Mapping[str, Any], content: Any) -> tuple[int | str, ...] | None:
    """Return the location of the value that a problem is of, with the name of a type behind it; None of others."""
    location = problem["loc"]
    for depth, component in enumerate(location):
        if isinstance(component, str) and component.startswith("<"):
            continue
        try:
            content = content[component]
        except (LookupError, TypeError):
            is_type = isinstance(component, str) and _TYPE_NAME.fullmatch(component)
            return tuple(location[:depth]) if is_type else None
    return None


def _value_text(error: type[PachonError], value: Any) -> str:
    """Return a shortened value: as JSON in configurations, else as Python writes it."""
    return json_text(value) if error is ConfigError else cut_short(repr(value))


#: Keys that tell the entries of a list apart in messages, by the key of the list.
_LABELS = {"layers": "altitude", "shape": "shape"}


def _key_path(location: Iterable[int | str], content: Any) -> str:
    """Return a location as a path of keys: ``surfaces[M1].radius``; tags, in angle brackets, are left out."""
    path = label = ""
    for component in location:
        if isinstance(component, str) and component.startswith("<"):
            continue
        inside = (isinstance(content, dict) and component in content) or (
            isinstance(content, list) and isinstance(component, int) and component < len(content)
        )
        content = content[component] if inside else None
        if isinstance(component, int):
            path += f"[{content.get(label, component) if isinstance(content, dict) else component}]"
        else:
            path += f".{component}" if path else component
            label = _LABELS.get(component, "name")
    return path
