"""Open a desk from Python: its document, its page in a file, and its server for notebooks."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, DomainError, ProductError
from ..design.tolerancing.monte_carlo import MonteCarlo
from ..models.telescope import Telescope
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from ..sensing.result import DonutFit

if TYPE_CHECKING:
    from bokeh.document import Document
    from bokeh.server.server import Server

    from .bench import Bench
    from .page_session import PageSession
    from .state import DeskState

#: Height of a desk in a notebook [pixels].
_HEIGHT = 860
#: Ending of the stores of sweeps, which no telescope has.
_SWEEP = ".sweep"


class Desk:
    """A desk that is open: notebooks show it live.

    Its server listens at this machine alone, at an address with a token, from when a notebook first shows it until
    :meth:`close`. It draws between the cells, while the kernel is idle.
    """

    def __init__(self, name: str, new_session: Callable[[Document | None], PageSession]) -> None:
        self.name, self._new_session = name, new_session
        self._server: Server | None = None
        self._address = ""

    def show_in(self, document: Document) -> None:
        """Make a document the page of a new session."""
        from .page import show_in

        show_in(self._new_session(document), document)

    def document(self) -> Document:
        """Return a Bokeh document with all pictures and controls; no browser is needed."""
        from bokeh.document import Document

        document = Document()
        self.show_in(document)
        return document

    def export(self, path: str | os.PathLike[str]) -> None:
        """Write a page that needs no network and no server."""
        from .page import export_page

        export_page(self._new_session(None), Path(path))

    @property
    def address(self) -> str:
        """Address of the live page; the server starts when it is first asked for.

        Raises
        ------
        DomainError
            Where no event loop runs, as one does in notebooks.
        """
        from .server import open_server

        if self._server is None:
            try:
                asyncio.get_running_loop()
            except RuntimeError:
                raise DomainError("no event loop runs: expected a notebook; `pachon desk` serves without one") from None
            self._server, self._address = open_server(self.show_in)
        return self._address

    def close(self) -> None:
        """End the server."""
        if self._server is not None:
            self._server.stop()
            self._server, self._address = None, ""

    def __repr__(self) -> str:
        return f"Desk({self.name!r})"

    def _repr_html_(self) -> str:
        """Return the frame that notebooks show."""
        try:
            address = self.address
        except DomainError as error:
            return f"<p>{escape(repr(self))}: {escape(str(error))}</p>"
        style = f"width:100%;height:{_HEIGHT}px;border:0"
        return f'<iframe src="{escape(address)}" title="desk of {escape(self.name)}" style="{style}"></iframe>'


@check_arguments
def open_desk(
    source: str | os.PathLike[str] | Telescope | MonteCarlo | DonutFit | FocalPlanePsf = "lsst_v3.3_r",
) -> Desk:
    """Open the live views of a telescope, or of what was computed.

    Parameters
    ----------
    source : str, path, Telescope, MonteCarlo, DonutFit or FocalPlanePsf
        Bundled telescope, its file, a state that a desk saved, the folder of a run, of visits or of tolerances, the
        store of a sweep, a table of donuts, the file of a focal-plane model, a telescope, or a result of
        :func:`~pachon.monte_carlo`, :func:`~pachon.run_tolerances`, :func:`~pachon.fit_donuts` or
        :meth:`~pachon.FocalPlanePsf.fit`. States of a telescope name its file
        ``NAME.yaml``, which :func:`~pachon.save_telescope` writes.

    Raises
    ------
    ConfigError
        If Bokeh is missing, or the file of a state is wrong.
    DomainError, ProductError, UnknownNameError
        If the source is nothing of these.

    Examples
    --------
    In a notebook the last line of a cell shows the desk: ``pachon.open_desk("hsc")``.
    """
    try:
        import bokeh  # noqa: F401 - the extra
    except ImportError:
        raise ConfigError("pachon desk needs Bokeh: pip install 'pachon[desk]'") from None
    from .bench import Bench
    from .donut_views import is_table
    from .result_pages import folder_page, points_page, result_page, table_page
    from .session import Session
    from .state import is_state_file
    from .sweep_views import SweepBench, is_store
    from .tolerance_views import is_tolerance_folder

    if isinstance(source, MonteCarlo | DonutFit | FocalPlanePsf):
        return Desk(*result_page(source))
    if not isinstance(source, Telescope):
        path = Path(source)
        if path.is_dir():
            return Desk(*folder_page(path))
        if is_store(path):
            if is_tolerance_folder(path.parent):
                return Desk(*folder_page(path.parent))
            return Desk(*points_page(SweepBench(path)))
        if is_table(path):
            return Desk(*table_page(path))
        if path.suffix == _SWEEP and not path.exists():
            raise ProductError("no such file", file=path)
    if isinstance(source, Telescope) or not is_state_file(Path(source)):
        bench = Bench(source if isinstance(source, Telescope) else os.fspath(source))
        state = bench.start
    else:
        bench, state = _loaded(Path(source))
    return Desk(bench.nominal.name, lambda document: Session(bench, state, document))


def _loaded(path: Path) -> tuple[Bench, DeskState]:
    """Return the bench and the state of a file that a desk saved."""
    from dataclasses import replace

    from ..core.errors import error_context
    from ..core.files import path_beside
    from .bench import Bench
    from .state import DeskState

    state = DeskState.from_file(path)
    state = replace(state, model=path_beside(path.parent, state.model))
    with error_context(file=path):
        bench = Bench(state.model)
        return bench, bench.check(state)
