"""Sphinx extension: a page of each command, made of the texts and options that `--help` prints.

Newer versions of Typer carry a click of their own, which sphinx-click does not read.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from textwrap import dedent


def command_pages() -> dict[str, str]:
    """Return a page of MyST by the name of its command, with the commands of a group on the page of the group."""
    import typer

    from pachon.commands.cli import app

    return {
        name: "\n".join(["#" + line if line.startswith("# ") and i else line for i, line in enumerate(text)])
        for name, command in typer.main.get_command(app).commands.items()
        for text in [_command_lines(f"pachon {name}", command)]
    }


def command_index() -> str:
    """Return the page of all commands by the panels of the help."""
    import typer

    from pachon.commands.cli import app

    panels: dict[str, list[str]] = {}
    for name, command in typer.main.get_command(app).commands.items():
        summary = " ".join(inspect.cleandoc(command.help or "").split("\n\n")[0].split())
        panels.setdefault(command.rich_help_panel, []).append(f"- [`pachon {name}`]({name}.md): {summary}\n")
    return "\n".join(
        [
            "# Commands\n",
            "`pachon COMMAND --help` prints the same; `python -m pachon` is `pachon`. Exit status: 0 done, 1 a check "
            "failed, 2 bad input, in one line. With `--json`, standard output is that JSON and nothing else.\n",
            *(f"## {panel}\n\n{''.join(lines)}" for panel, lines in panels.items()),
            "```{toctree}\n:hidden:\n:glob:\n\n*\n```\n",
        ]
    )


def _command_lines(name: str, command: object) -> list[str]:
    """Return the lines of a command's reference: its help, its options, and those of the commands below it."""
    text = inspect.cleandoc(command.help or "").replace("\b\n", "").replace("**Examples**", "*Examples*")
    # Indented blocks stand behind items of lists, which would take them for text.
    text = re.sub(r"\n\n((?: {4}.*\n?)+)", lambda m: f"\n\n```text\n{dedent(m[1]).rstrip()}\n```\n", text)
    rows = [row for parameter in command.params if (row := _option_row(parameter))]
    table = ["| option | meaning |", "|---|---|", *rows, ""] if rows else []
    below = [
        line for key, sub in getattr(command, "commands", {}).items() for line in _command_lines(f"{name} {key}", sub)
    ]
    return [f"# {name}", "", text, "", *table, *below]


def _option_row(parameter: object) -> str:
    """Return the row of an option or argument in a table."""
    names = [*getattr(parameter, "opts", ()), *getattr(parameter, "secondary_opts", ())]
    if getattr(parameter, "hidden", False) or "--help" in names:
        return ""
    if getattr(parameter, "param_type_name", "") == "argument":
        names = [parameter.metavar or parameter.name.upper()]
    default = getattr(parameter, "default", None)
    shown = "" if default in (None, False, (), []) or callable(default) else f" Default: {default}."
    text = " ".join((getattr(parameter, "help", "") or "").split()).replace("|", "\\|")
    return f"| {', '.join(f'`{n}`' for n in names)} | {text}{shown} |".replace("X,Y | R", "X,Y or R")


def setup(app: object) -> dict[str, bool]:
    """Write the pages at the start of a build, those that are new or have changed."""
    app.connect("config-inited", _write_pages)
    return {"parallel_read_safe": True}


def _write_pages(app: object, config: object) -> None:
    folder = Path(app.srcdir) / "reference" / "commands"
    folder.mkdir(exist_ok=True)
    for name, text in {**command_pages(), "index": command_index()}.items():
        path = folder / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
