"""Pages of the documentation that are made when it is built: outputs of the gallery, references of API and commands."""

from __future__ import annotations

import ast
import contextlib
import functools
import importlib
import inspect
import io
import operator
import os
import re
from pathlib import Path
from textwrap import dedent

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"```python\n(.*?)```\n", flags=re.S)
#: Classes of others whose members are not listed.
_FOREIGN = "tuple, IntEnum, int, Exception, BaseModel"
_PICTURE = re.compile(r'savefig\("(.*?\.png)"')
#: Title and introduction of the reference of each layer.
LAYERS = {
    "core": ("Errors", "Every error of pachon is a `PachonError`: one line, with `file` and `key` as fields."),
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
    "testing": ("Tests of your own", "For the tests of your own project."),
}


def public_names() -> dict[str, list[str]]:
    """Return the public names of each layer, such as "design.throughput": those of pachon itself come first."""
    found: dict[str, list[str]] = {layer: [] for layer in LAYERS}
    for name in _listed("pachon"):
        found[name[0].partition(".")[0]].append(name[1])
    for layer in LAYERS:
        if (ROOT / layer / "__init__.pyi").is_file() and layer:
            found[layer] += [f"{layer}.{name}" for _, name in _listed(layer)]
    found["core"] += [f"errors.{name}" for name in importlib.import_module("pachon.errors").__all__]
    found["testing"] += [f"testing.{name}" for name in importlib.import_module("pachon.testing").__all__]
    return found


def _listed(folder: str) -> list[tuple[str, str]]:
    """Return module and name of each line of a stub; of its modules, GalSim's alone."""
    tree = ast.parse((ROOT / folder / "__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    pairs = [(node.module or "", alias.asname or alias.name) for node in imports for alias in node.names]
    return [(module, name) for module, name in pairs if module or name == "galsim"]


def api_page(layer: str) -> str:
    """Return the reference of a layer's public names as MyST with directives of autodoc."""
    from pachon.core.stability import stability

    title, text = LAYERS[layer]
    parts = [f"# {title}\n\n{text}\n"]
    for name in public_names()[layer]:
        value = operator.attrgetter(name)(importlib.import_module("pachon"))
        if inspect.ismodule(value):
            kind, options = "automodule", "   :members:\n"
        elif inspect.isclass(value):
            kind, options = (
                "autoclass",
                f"   :members:\n   :inherited-members: {_FOREIGN}\n",
            )
        else:
            kind, options = "autofunction", ""
        mark = "*provisional*: its form may still change.\n\n" if stability(f"pachon.{name}") == "provisional" else ""
        directive = f"```{{eval-rst}}\n.. {kind}:: pachon.{name}\n{options}```\n"
        parts.append(f"## {name.rpartition('.')[2]}\n\n{mark}{directive}")
    return "\n".join(parts)


def command_page() -> str:
    """Return the reference of all commands and their options as MyST."""
    import typer

    from pachon.commands.cli import app

    parts = [
        "# Commands\n",
        "`pachon COMMAND --help` prints the same; `python -m pachon` is `pachon`. Exit status: 0 done, 1 a check "
        "failed, 2 bad input, in one line. With `--json`, standard output is that JSON and nothing else.\n",
    ]
    for name, command in sorted(_commands(typer.main.get_command(app), "pachon")):
        text = inspect.cleandoc(command.help or "").replace("\b\n", "").replace("**Examples**", "*Examples*")
        # Indented blocks stand behind items of lists, which would take them for text.
        text = re.sub(r"\n\n((?: {4}.*\n?)+)", lambda m: f"\n\n```text\n{dedent(m[1]).rstrip()}\n```\n", text)
        parts += [f"## {name}\n", text + "\n"]
        rows = [row for parameter in command.params if (row := _option_row(parameter))]
        if rows:
            parts.append("| option | meaning |\n|---|---|\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


def _commands(command: object, name: str) -> list[tuple[str, object]]:
    """Return all commands of a group with their full names."""
    found = []
    for key, below in getattr(command, "commands", {}).items():
        full = f"{name} {key}"
        found += [(full, below), *_commands(below, full)]
    return found


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


def run_page(text: str, folder: Path) -> str:
    """Run the blocks of a page in a folder, and return the page with what they print and draw behind each.

    The picture that a block saves as ``name.png`` stands behind it.
    """
    names: dict[str, object] = {}

    def shown(match: re.Match[str]) -> str:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(match[1], "example", "exec"), names)
        output = f"```text\n{printed.getvalue()}```\n" if printed.getvalue() else ""
        pictures = "".join(f"![{name}](made/{name})\n" for name in _PICTURE.findall(match[1]))
        return f"{match[0]}\n{output}\n{pictures}"

    folder.mkdir(parents=True, exist_ok=True)
    before = Path.cwd()
    os.chdir(folder)
    try:
        return BLOCK.sub(shown, text)
    finally:
        os.chdir(before)


def setup(app: object) -> dict[str, bool]:
    """Connect the pages to a build of Sphinx."""
    app.connect("builder-inited", _write_references)
    app.connect("source-read", _run_example)
    app.connect("autodoc-process-docstring", _attributes_as_parameters, priority=400)
    app.connect("missing-reference", _public_reference)
    return {"parallel_read_safe": False}


def _write_references(app: object) -> None:
    folder = Path(app.srcdir) / "reference"
    folder.mkdir(exist_ok=True)
    for layer in LAYERS:
        (folder / f"api_{layer or 'galsim'}.md").write_text(api_page(layer), encoding="utf-8")
    (folder / "commands.md").write_text(command_page(), encoding="utf-8")


def _public_reference(app: object, environment: object, node: object, content: object) -> object:
    """Return the link to a public name that a docstring names by its module, as in ``wavefront.opd.wavefront_opd``."""
    target = _all_public().get(node.get("reftarget", "").rpartition(".")[2])
    if node.get("refdomain") != "py" or target is None or target == node["reftarget"]:
        return None
    domain = environment.get_domain("py")
    return domain.resolve_xref(environment, node["refdoc"], app.builder, node["reftype"], target, node, content)


@functools.cache
def _all_public() -> dict[str, str]:
    """Return the full spelling of each public name by its last part."""
    return {name.rpartition(".")[2]: f"pachon.{name}" for names in public_names().values() for name in names}


def _attributes_as_parameters(*event: object) -> None:
    """Rename lists of attributes, arguments of dataclasses: napoleon splits "x, y : float" in parameters alone."""
    lines = event[-1]
    assert isinstance(lines, list)
    lines[:] = ["Parameters" if line == "Attributes" else line for line in lines]


def _run_example(app: object, name: str, source: list[str]) -> None:
    if name.startswith("gallery/") and name != "gallery/index":
        importlib.import_module("pachon")
        source[0] = run_page(source[0], Path(app.srcdir) / "gallery" / "made")
