"""The command ``pachon desk``."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from ..core.terminal import print_line
from . import completion
from .choices import names

app = typer.Typer()


@app.command("desk")
def desk_command(
    model: Annotated[
        str,
        names(
            completion.models,
            metavar="MODEL|FILE|FOLDER|SWEEP",
            help="Bundled telescope, its file, a state that a desk saved (.yaml), a sweep, a table of donuts, a "
            "focal-plane model, or the folder of a run, of visits or of tolerances.",
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
    The store of a sweep shows its points: plots with one selection, effects of the parameters, points that open.
    Folders of pachon tolerance and pachon visits, tables of pachon donuts, and focal-plane models have pages of their
    own.
    The page is served to this machine alone, at an address with a token, until Ctrl-C. It needs `pachon[desk]`.

    **Examples**

    - `pachon desk`: the LSST in r
    - `pachon desk hsc --no-browser --port 8000`
    - `pachon desk my_lens.zmx`
    - `pachon desk desk.yaml`: a state that was saved
    - `pachon desk pachon_run`: the stars of a run: whiskers, stamps, residuals and correlations
    - `pachon desk heights.sweep`: the points of a sweep
    - `pachon desk desk.yaml --export desk.html`: one page that needs no network
    """
    from ..desk.opened import open_desk

    desk = open_desk(model)
    if export is not None:
        desk.export(export)
        print_line(f"page: {export.resolve()}")
        return
    from ..desk.server import open_server, serve

    server, address = open_server(desk.show_in, port)
    if f":{port}/" not in address:
        print_line(f"port {port} is taken; the next free one is used", error=True)
    with suppress(KeyboardInterrupt):
        print_line(f"desk of {desk.name}: {address} (Ctrl-C ends it)")
        serve(server, address, browser=browser)
