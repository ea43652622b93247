"""Pages of results: which one shows a folder, a file or a result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import PachonError, ProductError
from ..design.tolerancing.monte_carlo import MonteCarlo
from ..reconstruction.focal_plane_psf.file import is_model
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from ..sensing.result import DonutFit

if TYPE_CHECKING:
    from bokeh.document import Document

    from .donut_views import DonutBench
    from .focal_views import FocalBench
    from .page_session import PageSession
    from .sweep_views import PointsBench

#: Digits of the number of a point, at most.
_DIGITS = 12
#: Results that have a page.
DeskResult = MonteCarlo | DonutFit | FocalPlanePsf
#: Name of a page, and what makes its sessions.
NamedPage = tuple[str, "Callable[[Document | None], PageSession]"]


def result_page(result: DeskResult) -> NamedPage:
    """Return the page of a result."""
    if isinstance(result, MonteCarlo):
        from .tolerance_views import ToleranceBench

        return points_page(ToleranceBench.of(result))
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
        return points_page(ToleranceBench.read(folder))
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


def points_page(bench: PointsBench) -> NamedPage:
    """Return the page of the points of a study, and of the point that the address of the page asks for."""
    return bench.name, lambda document: _points_session(bench, document)


def _points_session(bench: PointsBench, document: Document | None) -> PageSession:
    from .session import Session
    from .sweep_session import SweepSession

    context = None if document is None else document.session_context
    request = None if context is None else context.request
    number = [] if request is None else request.arguments.get("point", [])
    if not number:
        return SweepSession(bench, document)
    try:
        return Session(*bench.opened(int(number[0][:_DIGITS])), document)
    except PachonError as error:
        return SweepSession(bench, document, str(error))
    except ValueError:
        return SweepSession(bench, document, "point: expected a whole number")


def _donut_page(bench: DonutBench) -> NamedPage:
    from .donut_session import DonutSession

    return bench.name, lambda document: DonutSession(bench, document)


def _focal_page(bench: FocalBench) -> NamedPage:
    from .focal_session import FocalSession

    return bench.name, lambda document: FocalSession(bench, document)
