"""Pages of results: which one shows a folder, a file or a result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import ProductError
from ..design.tolerancing.monte_carlo import MonteCarlo
from ..reconstruction.focal_plane_psf.file import is_model
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from ..sensing.result import DonutFit

if TYPE_CHECKING:
    from bokeh.document import Document

    from .donut_views import DonutBench
    from .focal_views import FocalBench
    from .page_session import PageSession
    from .tolerance_views import ToleranceBench

#: Results that have a page.
DeskResult = MonteCarlo | DonutFit | FocalPlanePsf
#: Name of a page, and what makes its sessions.
NamedPage = tuple[str, "Callable[[Document | None], PageSession]"]


def result_page(result: DeskResult) -> NamedPage:
    """Return the page of a result."""
    if isinstance(result, MonteCarlo):
        from .tolerance_views import ToleranceBench

        return _tolerance_page(ToleranceBench.of(result))
    if isinstance(result, FocalPlanePsf):
        from .focal_views import FocalBench

        return _focal_page(FocalBench("model", result))
    from .donut_views import DonutBench

    return _donut_page(DonutBench.of(result))


def folder_page(folder: Path) -> NamedPage:
    """Return the page of a folder of products; ProductError where it has none."""
    from .run_session import RunSession
    from .run_views import RunBench
    from .tolerance_views import ToleranceBench, is_tolerance_folder
    from .visit_session import NightSession, StackSession
    from .visit_views import NightBench, StackBench, is_night, stacks_in

    name = folder.resolve().name
    if is_tolerance_folder(folder):
        return _tolerance_page(ToleranceBench.read(folder))
    if is_night(folder):
        night = NightBench(folder)
        return name, lambda document: NightSession(night, document)
    if stacks_in(folder):
        stacks = StackBench(folder)
        return name, lambda document: StackSession(stacks, document)
    if not any(folder.glob("ccd_*.fits")):
        text = (
            "expected the folder of a run (ccd_*.fits), of visits (visits, stack_*.fits) or of tolerances (draws.ecsv)"
        )
        raise ProductError(text, file=folder)
    run = RunBench(folder)
    return name, lambda document: RunSession(run, document)


def table_page(path: Path) -> NamedPage:
    """Return the page of a focal-plane model or a table of donuts; ProductError where it is none."""
    if is_model(path):
        from .focal_views import FocalBench

        return _focal_page(FocalBench.read(path))
    from .donut_views import DonutBench

    return _donut_page(DonutBench.read(path))


def _tolerance_page(bench: ToleranceBench) -> NamedPage:
    from .sweep_session import SweepSession

    return bench.name, lambda document: SweepSession(bench, document)


def _donut_page(bench: DonutBench) -> NamedPage:
    from .donut_session import DonutSession

    return bench.name, lambda document: DonutSession(bench, document)


def _focal_page(bench: FocalBench) -> NamedPage:
    from .focal_session import FocalSession

    return bench.name, lambda document: FocalSession(bench, document)
