"""The command ``pachon desk``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from ..core.terminal import print_line
from . import completion
from .choices import names

if TYPE_CHECKING:
    from bokeh.document import Document

    from ..desk.bench import Bench
    from ..desk.run_session import RunSession
    from ..desk.session import Session
    from ..desk.state import DeskState

app = typer.Typer()


@app.command("desk")
def desk_command(
    model: Annotated[
        str,
        names(
            completion.either(completion.bundled_models, completion.files(*completion.LENSES)),
            metavar="MODEL|FILE|RUN",
            help="Bundled telescope, its file, a state that a desk saved (.yaml), or the folder of a run.",
            kind=typer.Argument,
        ),
    ] = "lsst_v3.3_r",
    port: Annotated[int, Option(min=1, max=65535, help="Port; where it is taken, the next free one.")] = 5006,
    browser: Annotated[bool, Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
    export: Annotated[
        Path | None, Option("--export", metavar="PAGE.html", help="Write the page to a file, and serve nothing.")
    ] = None,
) -> None:
    """Turn a telescope by hand, live in a browser: sliders, spots, wavefront, images and whiskers.

    Bodies, bending modes, radii of lenses, heights of CCDs, wavelength, field and seeing have sliders; spots, OPD,
    Zernikes, images, encircled energy, whiskers and the layout follow. States are undone, compared, saved and loaded.
    The folder of a run shows its stars in place of a telescope: noise-free, observed, model and residuals, CCD by CCD.
    The page is served to this machine alone, at an address with a token, until Ctrl-C. It needs `pachon[desk]`.

    **Examples**

    - `pachon desk`: the LSST in r
    - `pachon desk hsc --no-browser --port 8000`
    - `pachon desk my_lens.zmx`
    - `pachon desk desk.yaml`: a state that was saved
    - `pachon desk pachon_run`: the stars of a run: whiskers, stamps, residuals and correlations
    - `pachon desk desk.yaml --export desk.html`: one page that needs no network
    """
    from ..core.errors import ConfigError

    try:
        import bokeh  # noqa: F401 - the extra
    except ImportError:
        raise ConfigError("pachon desk needs Bokeh: pip install 'pachon[desk]'") from None
    from ..desk.page import export_page, show_in
    from ..desk.server import open_server, serve

    name, new_session = _opened(model)
    if export is not None:
        export_page(new_session(None), export)
        print_line(f"page: {export.resolve()}")
        return
    server, address = open_server(lambda document: show_in(new_session(document), document), port)
    if f":{port}/" not in address:
        print_line(f"port {port} is taken; the next free one is used", error=True)
    with suppress(KeyboardInterrupt):
        print_line(f"desk of {name}: {address} (Ctrl-C ends it)")
        serve(server, address, browser=browser)


def _opened(model: str) -> tuple[str, Callable[[Document | None], Session | RunSession]]:
    """Return the name of what is shown, and the function that makes a session of it."""
    from ..desk.run_session import RunSession
    from ..desk.run_views import RunBench
    from ..desk.session import Session

    if Path(model).is_dir():
        run = RunBench(Path(model))
        return run.folder.resolve().name, lambda document: RunSession(run, document)
    bench, state = _bench_and_state(model)
    return bench.nominal.name, lambda document: Session(bench, state, document)


def _bench_and_state(model: str) -> tuple[Bench, DeskState]:
    """Return the bench and the state of a telescope, or of the file of a state."""
    from dataclasses import replace

    from ..core.errors import error_context
    from ..desk.bench import Bench
    from ..desk.state import DeskState, is_state_file

    path = Path(model)
    if not is_state_file(path):
        bench = Bench(model)
        return bench, bench.start
    state = DeskState.from_file(path)
    beside = path.parent / state.model
    if beside.is_file():
        state = replace(state, model=str(beside))
    with error_context(file=path):
        bench = Bench(state.model)
        return bench, bench.check(state)
