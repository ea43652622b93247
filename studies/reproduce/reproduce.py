"""The figures of Jee & Tyson (2011) made again: which there are, and the making of some or all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...core.errors import ConfigError, unknown_name
from ...core.files import make_folder, write_json
from ...core.version import VERSION
from . import atmosphere, optics, reconstruction
from .parts import SCALES, Bench, Reproduced, Scale


@dataclass(frozen=True)
class Figure:
    """One figure of the paper that can be made.

    Attributes
    ----------
    title : str
        What it shows.
    make : callable
        Makes it from a bench.
    minutes : tuple of float
        About how long it takes on two cores at the scales ``small`` and ``paper``, without the pipeline's run.
    of_run : bool
        Whether it shows the pipeline's run.
    """

    title: str
    make: Callable[[Bench], Reproduced]
    minutes: tuple[float, float]
    of_run: bool = False


FIGURES: dict[str, Figure] = {
    "fig1": Figure("optical layout and CCD mosaic", optics.layout, (0.05, 0.05)),
    "fig2": Figure("encircled energy over the field", optics.encircled_energy_over_field, (0.2, 1.5)),
    "fig3": Figure("atmospheric dispersion", atmosphere.dispersion, (0.02, 0.02)),
    "fig4": Figure("the six phase screens", atmosphere.screens, (0.05, 0.3)),
    "fig5": Figure("the PSF against exposure time", atmosphere.speckles, (0.3, 11.0)),
    "fig6": Figure("ellipticity by the atmosphere alone", atmosphere.ellipticity, (0.3, 15.0)),
    "fig7": Figure("heights of the focal plane", optics.heights, (0.05, 0.05)),
    "fig8": Figure("whiskers of the optics alone", optics.whiskers_of_optics, (0.3, 7.0)),
    "fig9": Figure("mean PSF, eigen-PSFs and eigenvalues", reconstruction.eigen_psfs, (0.05, 0.1), of_run=True),
    "fig11": Figure("whiskers with the atmosphere", reconstruction.whiskers_of_stars, (0.2, 0.6), of_run=True),
    "fig12": Figure("whiskers of the residual", reconstruction.whiskers_of_residual, (0.05, 0.2), of_run=True),
    "fig13": Figure("scatter of the ellipticity", reconstruction.scatter, (0.05, 0.1), of_run=True),
    "fig14": Figure("correlation of the ellipticity", reconstruction.correlation, (0.05, 0.1), of_run=True),
    "table1": Figure("height budget of the focal plane", optics.height_budget, (0.05, 0.05)),
}
#: Figures of the paper that are not offered, and what they would need.
_NOT_OFFERED = {"fig10": "galaxies", **dict.fromkeys(("fig15", "fig16", "fig17", "fig18"), "galaxies or many visits")}
_RUN_MINUTES = (0.5, 24.0)
_ALL = "all"


def chosen_figures(names: Iterable[str]) -> tuple[str, ...]:
    """Return the figures that are meant, each once, in the order of the paper; ``all`` stands for every one.

    Raises
    ------
    UnknownNameError
        If the paper has no such figure; the nearest names are offered.
    ConfigError
        If the figure needs what there is not.
    """
    wanted = set()
    for name in names:
        if name in _NOT_OFFERED:
            raise ConfigError(
                f"{name}: not offered, since it needs {_NOT_OFFERED[name]}; expected {_ALL} or some of"
                f" {', '.join(FIGURES)}"
            )
        if name == _ALL:
            wanted |= set(FIGURES)
        elif name in FIGURES:
            wanted.add(name)
        else:
            raise unknown_name("figure", name, (*FIGURES, _ALL))
    return tuple(name for name in FIGURES if name in wanted)


def scale_of(name: str) -> Scale:
    """Return a scale by name.

    Raises
    ------
    UnknownNameError
        If there is none of that name.
    """
    if name not in SCALES:
        raise unknown_name("scale", name, SCALES)
    return SCALES[name]


def expected_minutes(names: Iterable[str], scale: Scale) -> float:
    """Return about how many minutes some figures take on two cores."""
    column = list(SCALES).index(scale.name) if scale.name in SCALES else 0
    figures = [FIGURES[name] for name in names]
    return sum(f.minutes[column] for f in figures) + _RUN_MINUTES[column] * any(f.of_run for f in figures)


def reproduce(names: Iterable[str], bench: Bench) -> dict[str, Any]:
    """Make figures of the paper again, and write pictures, data and, when all are made, ``summary.json``.

    All files have the same bytes for the same scale and seed, whenever and with however many threads they are made.

    Parameters
    ----------
    names : iterable of str
        Figures, as :func:`chosen_figures` takes them.
    bench : Bench
        Scale, folder, seed, threads.

    Returns
    -------
    dict
        For each figure title, what the paper says, what came out here, the verdict with its reason, the figures
        measured and the files written; with the scale and the seed: the content of ``summary.json``.

    Raises
    ------
    PachonError
        If there is no such figure, or a file cannot be written.
    """
    chosen = chosen_figures(names)
    make_folder(bench.folder)
    made = {}
    for name in chosen:
        figure = FIGURES[name]
        if figure.of_run:
            # A run tells of its own stages, so it goes before that of the figure.
            _ = bench.pipeline
        with bench.reporter.stage(f"{name}: {figure.title}"):
            result = figure.make(bench)
            files = result.write(bench.folder, name, bench)
        made[name] = {
            "title": figure.title,
            "paper": result.paper,
            "here": result.here,
            "verdict": result.verdict,
            "why": result.why,
            "measured": result.measured,
            "files": files,
        }
    summary = {"pachon": VERSION, "scale": bench.scale.name, "seed": bench.seed, "figures": made}
    if len(made) == len(FIGURES):
        write_json(bench.folder / "summary.json", summary)
    return summary


def reproduce_at(
    names: Iterable[str], scale: str, folder: Path, *, seed: int = 1, threads: int | None = None, reporter: Any = None
) -> dict[str, Any]:
    """Make figures at a scale by name: see :func:`reproduce`. Says beforehand about how long it takes."""
    chosen = chosen_figures(names)
    bench = Bench(scale_of(scale), folder, seed, threads)
    if reporter is not None:
        bench.reporter = reporter
    minutes = expected_minutes(chosen, bench.scale)
    long = f"about {minutes:.0f} minutes" if minutes >= 1.5 else f"about {max(60.0 * minutes, 1.0):.0f} s"
    bench.reporter.line(f"{len(chosen)} figures at the scale {scale}: {long} on two cores")
    return reproduce(chosen, bench)
