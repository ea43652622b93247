"""Reproduction of figures of Jee & Tyson (2011), some or all."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ...core.errors import unknown_name
from ...core.files import make_folder, write_json
from ...core.long_work import Execution
from ...core.version import VERSION
from ...wavefront.psf.engines import EngineName
from . import atmosphere, focal_plane, optics, reconstruction, screens, visits
from .bench import SCALES, Bench, Scale
from .figure import Figure


def _number(figure: Figure) -> tuple[str, int]:
    kind = figure.name.rstrip("0123456789")
    return kind, int(figure.name.removeprefix(kind))


_MODULES = (optics, screens, atmosphere, focal_plane, reconstruction, visits)
_FIGURES = [value for module in _MODULES for value in vars(module).values() if isinstance(value, Figure)]
#: Figures and tables in the order of the paper.
FIGURES = {figure.name: figure for figure in sorted(_FIGURES, key=_number)}
# Approximate time of the run, of the visits and of their galaxies, at the scales `small` and `paper` [min].
_SHARED_MINUTES = {"of_run": (0.2, 24.0), "of_visits": (0.2, 90.0), "of_galaxies": (0.7, 600.0)}
_ALL = "all"


def chosen_figures(names: Iterable[str]) -> tuple[str, ...]:
    """Return figures by name, each once, in the order of the paper; ``all`` stands for every one."""
    figure_names = set()
    for name in names:
        if name == _ALL:
            figure_names |= set(FIGURES)
        elif name in FIGURES:
            figure_names.add(name)
        else:
            raise unknown_name("figure", name, (*FIGURES, _ALL))
    return tuple(name for name in FIGURES if name in figure_names)


def expected_minutes(names: Iterable[str], scale: Scale) -> float:
    """Return the approximate time of figures on two cores [min]."""
    column = list(SCALES).index(scale.name) if scale.name in SCALES else 0
    figures = [FIGURES[name] for name in names]
    shared = sum(m[column] for need, m in _SHARED_MINUTES.items() if any(getattr(f, need) for f in figures))
    return sum(f.minutes[column] for f in figures) + shared


def reproduce(names: Iterable[str], bench: Bench) -> dict[str, Any]:
    """Reproduce figures of the paper: pictures, data and, for all of them, ``summary.json``.

    Files have the same bytes for the same scale and seed, on any number of threads. Returned is the content of
    ``summary.json``: scale, seed, and for each figure title, statement of the paper, result, verdict with its reason,
    metrics and files.
    """
    figure_names = chosen_figures(names)
    make_folder(bench.folder)
    figure_summaries = {}
    for name in figure_names:
        figure = FIGURES[name]
        if figure.of_run:
            # The run has progress bars of its own, which end before that of the figure.
            _ = bench.pipeline
        if figure.of_visits:
            _ = bench.galaxies if figure.of_galaxies else bench.stack
        with bench.reporter.stage(f"{name}: {figure.title}"):
            result = figure.make(bench)
            files = result.write(name, bench)
        figure_summaries[name] = {
            "title": figure.title,
            "paper": figure.paper,
            "here": result.here,
            "verdict": result.verdict,
            "why": result.why,
            "measured": result.measured,
            "files": files,
        }
    origin = {"pachon": VERSION, "scale": bench.scale.name, "seed": bench.seed, "engine": bench.engine}
    summary = {**origin, "figures": figure_summaries}
    if len(figure_summaries) == len(FIGURES):
        write_json(bench.folder / "summary.json", summary)
    return summary


def reproduce_at(
    names: Iterable[str],
    scale: str,
    folder: Path,
    *,
    seed: int = 1,
    engine: EngineName = "fast",
    execution: Execution | None = None,
) -> dict[str, Any]:
    """Reproduce figures at a scale given by name, after a line with the expected time: see :func:`reproduce`.

    `engine` makes the PSFs of the run and of the visits, Figs. 9 and 11 to 18.
    """
    figure_names = chosen_figures(names)
    if scale not in SCALES:
        raise unknown_name("scale", scale, SCALES)
    bench = Bench(SCALES[scale], folder, seed, execution or Execution(), engine)
    minutes = expected_minutes(figure_names, bench.scale)
    long = f"about {minutes:.0f} minutes" if minutes >= 1.5 else f"about {max(60.0 * minutes, 1.0):.0f} s"
    bench.reporter.line(f"{len(figure_names)} figures at the scale {scale}: {long} on two cores")
    return reproduce(figure_names, bench)
