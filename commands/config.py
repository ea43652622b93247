"""The command ``pachon config``: keys of configurations, explained."""

from __future__ import annotations

import json
import re
from difflib import get_close_matches
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument

from ..core.errors import UnknownNameError, shown
from ..core.terminal import print_line
from . import completion
from .choices import names
from .config_examples import EXAMPLES
from .config_kinds import KINDS, model_of
from .options import Json, TableFile
from .tables import Rows, plain_table, print_json, wide_console, write_rows

if TYPE_CHECKING:
    from ..core.key_descriptions import KeyDescription

app = typer.Typer()
#: Least likeness of whole keys, as difflib has it: their kinds and sections are alike often.
_NEAR = 0.85
#: Columns of the table of keys.
_HEADINGS = ("key", "default", "values", "meaning")


@app.command("config")
def config_command(
    words: Annotated[
        list[str] | None,
        names(completion.config_keys, metavar="KEY", help="Kind, section or key: run.psf.engine.", kind=Argument),
    ] = None,
    table: TableFile = None,
    as_json: Json = False,
) -> None:
    """Explain the keys of configurations: type, default, choices, meaning, and an example to copy.

    A key is set in a YAML file, or by `--set KEY=VALUE` of the commands that take the configuration. Keys without a
    kind are those of a run. Without a key the kinds are listed.

    **Examples**

    - `pachon config`: the kinds of configurations, and the commands that take them
    - `pachon config run.reconstruction.model`: one key
    - `pachon config run.atmosphere`: a section
    - `pachon config sweep --json`
    """
    # `run focal_plane.budget` is as good as `run.focal_plane.budget`.
    key = ".".join(words or ())
    if not key:
        kinds = _kind_rows()
        write_rows(kinds, table)
        if as_json:
            entries = {kind: {"commands": k.commands.split(", "), "text": k.text} for kind, k in KINDS.items()}
            print_json({"kinds": entries})
        else:
            kinds.show()
        return
    kind, descriptions = keys_of(key)
    write_rows(Rows(_HEADINGS, [_key_cells(description) for description in descriptions]), table)
    if as_json:
        summaries = [d.summary() | {"unit": unit_of(d), "example": example(d)} for d in descriptions]
        print_json({"kind": kind, "commands": KINDS[kind].commands.split(", "), "keys": summaries})
    elif len(descriptions) == 1:
        _show_key(kind, descriptions[0])
    else:
        _show_keys(kind, descriptions)


def keys_of(text: str) -> tuple[str, list[KeyDescription]]:
    """Return the kind that a text names, and the keys of it that are meant: all, a section, or one.

    Raises
    ------
    UnknownNameError
        If there is no such key; with the nearest.
    """
    from ..core.key_descriptions import describe_keys
    from .stored_names import stored_names

    first, _, inner_key = text.partition(".")
    holders = [kind for kind, keys in stored_names()["keys"].items() if text in keys]
    kind, key = (first, inner_key) if first in KINDS else ((holders or [*KINDS])[0], text)
    descriptions = describe_keys(model_of(kind))
    exact = [d for d in descriptions if d.key == key]
    within = [d for d in descriptions if not key or d.key.startswith((f"{key}.", f"{key}[]."))]
    if exact or within:
        return kind, [*exact, *within]
    kinds = [kind] if first in KINDS else [*KINDS]
    names: dict[str, str] = {}
    for name in kinds:
        for listed_key in stored_names()["keys"][name]:
            # Keys of the run within another file are those of runs.
            if len(kinds) == 1 or not listed_key.startswith("run."):
                names.setdefault(listed_key, f"{name}.{listed_key}")
    raise UnknownNameError(f"unknown key {shown(text)}: {_nearest_keys(kinds[0], key, names)}")


def _nearest_keys(kind: str, key: str, names: dict[str, str]) -> str:
    """Return the keys that are likely to be meant: those nearest, of the same last word, or with the word in theirs."""
    sections = {path.rpartition(".")[0]: name.rpartition(".")[0] for path, name in names.items() if "." in path}
    paths = sections | names
    near = get_close_matches(key.lower(), paths, n=2, cutoff=_NEAR)
    word = key.rpartition(".")[2].lower()
    last_words = {path: path.rpartition(".")[2].lower() for path in names}
    if not near:
        near = [path for path, last in last_words.items() if last == word]
    if not near:
        near = [path for path, last in last_words.items() if word and word in last]
    if not near:
        similar = get_close_matches(word, set(last_words.values()), n=1)
        near = [path for path, last in last_words.items() if last in similar]
    if near:
        return f"did you mean {' or '.join(paths[path] for path in near[:3])}?"
    return f"expected a key of {kind}, which pachon config {kind} lists, or one of {', '.join(KINDS)}"


def example(description: KeyDescription) -> str | None:
    """Return a value of a key, as ``key=value``; None of keys in lists and of the file's own names."""
    if "[]" in description.key or ".NAME" in description.key:
        return None
    last = description.key.rpartition(".")[2]
    other_words = [word for word in description.choices if word != description.default]
    value = EXAMPLES.get(description.key, EXAMPLES.get(last, description.default))
    if other_words:
        value = other_words[0]
    elif isinstance(description.default, bool):
        value = not description.default
    return f"{description.key}={value if isinstance(value, str) else json.dumps(value)}"


def unit_of(description: KeyDescription) -> str:
    """Return the unit of a key, which its meaning has in brackets; empty where there is none."""
    match = re.search(r"\[((?:1/)?[A-Za-z%][^][]*)\]", description.description)
    return match[1] if match else ""


def _kind_rows() -> Rows:
    """Return the kinds of configurations."""
    rows = [(kind, entry.commands, entry.text) for kind, entry in KINDS.items()]
    return Rows(("kind", "commands", "decides"), rows, "pachon config KIND lists its keys.", left=3)


def _key_cells(description: KeyDescription) -> tuple[str, ...]:
    """Return key, default, values and meaning of a key."""
    values = ", ".join(description.choices) or description.type
    return description.key, _default_text(description), values, description.description


def _show_keys(kind: str, descriptions: list[KeyDescription]) -> None:
    table = plain_table()
    for name, width in zip(_HEADINGS, (None, 24, 30, None), strict=True):
        table.add_column(name, max_width=width, no_wrap=name == "key")
    for description in descriptions:
        table.add_row(*_key_cells(description))
    wide_console().print(table)
    print_line(f"{len(descriptions)} keys of {kind}, set by pachon {KINDS[kind].commands}")
    print_line("A dash: open, as the meaning says. One key: pachon config KEY")


def _show_key(kind: str, description: KeyDescription) -> None:
    rows: list[tuple[str, str]] = [
        ("key", f"{kind}.{description.key}"),
        ("meaning", description.description),
        ("type", "" if description.choices else description.type),
        ("unit", unit_of(description)),
        ("choices", ", ".join(description.choices)),
        ("default", _default_text(description)),
        ("commands", KINDS[kind].commands),
    ]
    if (text := example(description)) is not None:
        command = KINDS[kind].commands.partition(",")[0]
        value = f"'{text}'" if set(text) & set(' {}[]()*?$&;"') else text
        rows += [("in a file", _yaml_line(text)), ("in a command", f"pachon {command} --set {value}")]
    table = plain_table(show_header=False)
    for name, text in rows:
        if text:
            table.add_row(name, text)
    wide_console().print(table, highlight=False)


def _default_text(description: KeyDescription) -> str:
    """Return the default as YAML has it; a dash where it is open."""
    if description.required:
        return "has to be given"
    default = description.default
    return "-" if default is None else default if isinstance(default, str) else json.dumps(default)


def _yaml_line(text: str) -> str:
    """Return ``a.b=value`` as a line of YAML: ``a: {b: value}``."""
    key, _, value = text.partition("=")
    *sections, last = key.split(".")
    return "".join(f"{name}: {{" for name in sections) + f"{last}: {value}" + "}" * len(sections)
