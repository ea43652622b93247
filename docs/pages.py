"""Pages of the documentation that are made when it is built: references of commands and public names."""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import inspect
import re
import shutil
from pathlib import Path
from textwrap import dedent

ROOT = Path(__file__).parents[1]
#: Title and introduction of the reference of each layer.
LAYERS = {
    "models": (
        "Models",
        "What exists: telescopes, surfaces, shapes, apertures, media, sites, cameras and their heights.",
    ),
    "raytrace": ("Rays", "Launching and tracing rays."),
    "wavefront": ("Wavefronts and PSFs", "Optical path differences, Zernikes, the atmosphere, PSFs."),
    "design": ("Optical design", "Metrics, images, sensitivity, tolerances, optimisation."),
    "sky": ("Galaxies", "Populations, mosaics and catalogues of galaxies."),
    "sensing": ("Wavefront sensing", "Wavefronts and degrees of freedom from donuts."),
    "measure": ("Shapes and catalogues", "Shapes, correlations, rho statistics; objects on images, galaxy fits."),
    "reconstruction": ("PSF models", "Models of a CCD, of the focal plane, of your own stars; files of Piff."),
    "pipeline": ("Runs", "One run: configuration, stars, products, diagnostics."),
    "imaging": ("Images of CCDs", "World coordinates, scenes, exposures, catalogues of images."),
    "studies": ("Studies", "Made of many runs: sweeps, baselines, shims, alignment, visits."),
    "": ("GalSim", "Needs `pip install 'pachon[galsim]'`."),
    "desk": ("The desk", "Live views in a browser and in notebooks; needs `pip install 'pachon[desk]'`."),
    "testing": ("Tests of your own", "For the tests of your own project."),
    "core": ("Errors", "Every error of pachon is a `PachonError`: one line, with `file` and `key` as fields."),
}


@functools.cache
def public_names() -> dict[str, list[str]]:
    """Return the public names of each layer, such as "design.throughput": those of pachon itself come first."""
    names: dict[str, list[str]] = {layer: [] for layer in LAYERS}
    for module, name in _listed("pachon"):
        names[module.partition(".")[0]].append(name)
    for layer in filter(None, LAYERS):
        if (ROOT / layer / "__init__.pyi").is_file():
            names[layer] += [f"{layer}.{name}" for _, name in _listed(layer)]
    for layer, module in (("core", "errors"), ("testing", "testing")):
        if importlib.util.find_spec(f"pachon.{module}") and f"from . import {module} " in _stub("pachon"):
            names[layer] += [f"{module}.{name}" for name in importlib.import_module(f"pachon.{module}").__all__]
    return names


def _stub(folder: str) -> str:
    return (ROOT / folder / "__init__.pyi").read_text(encoding="utf-8")


def _listed(folder: str) -> list[tuple[str, str]]:
    """Return module and name of each line of a stub; of its modules, GalSim's alone."""
    imports = [node for node in ast.parse(_stub(folder)).body if isinstance(node, ast.ImportFrom)]
    pairs = [(node.module or "", alias.asname or alias.name) for node in imports for alias in node.names]
    return [(module, name) for module, name in pairs if module or name == "galsim"]


@functools.cache
def full_names() -> dict[str, str]:
    """Return the full spelling of each public name by its last part."""
    return {name.rpartition(".")[2]: f"pachon.{name}" for names in public_names().values() for name in names}


def provisional() -> list[str]:
    """Return the full spellings of the names whose form may still change."""
    if not importlib.util.find_spec("pachon.core.stability"):
        return []
    return sorted(importlib.import_module("pachon.core.stability").PROVISIONAL)


def file_names() -> dict[str, str]:
    """Return the pages of names that differ from another's by capitals alone, which some file systems do not tell."""
    names = list(full_names().values())
    classes = {name.lower() for name in names if name.rpartition(".")[2][0].isupper()}
    return {name: f"{name}_function" for name in names if name.lower() in classes and name.rpartition(".")[2].islower()}


def api_page(layer: str) -> str:
    """Return the list of a layer's public names as MyST, each with a page that autosummary makes."""
    title, text = LAYERS[layer]
    names = "\n".join(f"   pachon.{name}" for name in public_names()[layer])
    return (
        f"# {title}\n\n{text}\n\n```{{eval-rst}}\n.. autosummary::\n   :toctree: .\n   :nosignatures:\n\n{names}\n```\n"
    )


def api_index() -> str:
    """Return the page of all layers."""
    lines = "".join(f"- [{title}]({layer or 'galsim'}.md): {text}\n" for layer, (title, text) in LAYERS.items())
    pages = "\n".join(layer or "galsim" for layer in LAYERS)
    return f"# Public names\n\n{lines}\n```{{toctree}}\n:hidden:\n\n{pages}\n```\n"


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


def saved_pictures(block: object, variables: dict[str, object], settings: dict[str, object]) -> str:
    """Move the pictures that a block of the gallery has saved into its page."""
    from sphinx_gallery.scrapers import figure_rst

    pictures = sorted(Path(variables["src_file"]).parent.glob("*.png"), key=lambda path: path.stat().st_mtime)
    targets = [target for _, target in zip(pictures, variables["image_path_iterator"], strict=False)]
    for picture, target in zip(pictures, targets, strict=True):
        shutil.move(picture, target)
    return figure_rst(targets, settings["src_dir"])


def setup(app: object) -> dict[str, bool]:
    """Connect the pages to a build of Sphinx."""
    app.connect("config-inited", _write_references)
    app.connect("missing-reference", _public_reference)
    return {"parallel_read_safe": False}


def _write_references(app: object, config: object) -> None:
    folder = Path(app.srcdir) / "reference"
    texts = {f"api/{layer or 'galsim'}": api_page(layer) for layer in LAYERS}
    texts |= {f"commands/{name}": text for name, text in command_pages().items()}
    texts |= {"commands/index": command_index(), "api/index": api_index()}
    for name, text in texts.items():
        path = folder / f"{name}.md"
        path.parent.mkdir(exist_ok=True)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _public_reference(app: object, environment: object, node: object, content: object) -> object:
    """Return the link to a public name that a docstring names by its module, as in ``wavefront.opd.wavefront_opd``."""
    target = full_names().get(node.get("reftarget", "").rpartition(".")[2])
    if node.get("refdomain") != "py" or target in (None, node["reftarget"]):
        return None
    domain = environment.get_domain("py")
    return domain.resolve_xref(environment, node["refdoc"], app.builder, node["reftype"], target, node, content)
