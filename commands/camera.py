"""The command ``pachon camera``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument

from .inputs import configured_experiment, warnings_shown
from .options import Json, Picture, picture_kind
from .tables import Rows, print_json

if TYPE_CHECKING:
    from ..models.camera.focal_plane import FocalPlane

app = typer.Typer()


@app.command("camera")
def camera_command(
    heights: Annotated[
        str, Argument(metavar="HEIGHTS", help="lsstcam, an ECSV or FITS file of heights, or a configuration (.yaml).")
    ] = "lsstcam",
    picture: Picture = None,
    as_json: Json = False,
) -> None:
    """Show statistics of the heights of the CCDs, by vendor, and draw a map of them.

    Heights are along +z of the telescope frame, the direction of the light at the detector.

    **Examples**

    - `pachon camera`: LSSTCam as built
    - `pachon camera metrology.fits --picture heights.pdf`
    - `pachon camera pachon_run/config.yaml --json`
    """
    from dataclasses import asdict

    from ..core.files import write_bytes
    from ..core.plotting import picture_bytes
    from ..models.camera.height_statistics import height_statistics
    from ..pipeline.report.tables import HEIGHT_CAPTION, HEIGHT_COLUMNS, height_rows

    kind = picture_kind(picture)
    plane = _focal_plane(heights)
    statistics = height_statistics(plane)
    if as_json:
        metrics = {name: asdict(group) for name, group in statistics.items()}
        residual = None if plane.residual is None else dict(zip(plane.names, plane.residual, strict=True))
        print_json({"heights": heights, "statistics_m": metrics, "fit_residual_m": residual})
        if picture is None:
            return
    from ..pipeline.report.height_plots import vendor_heights_plot

    path = Path(f"camera_{Path(heights).stem}.png") if picture is None else picture
    write_bytes(path, picture_bytes(vendor_heights_plot(plane, f"CCD heights: {Path(heights).stem}"), kind))
    if not as_json:
        Rows(HEIGHT_COLUMNS, height_rows(statistics), HEIGHT_CAPTION).show()
        print(f"picture: {path.resolve()}")


def _focal_plane(heights: str) -> FocalPlane:
    from ..core.errors import HeightWarning
    from ..models.camera.camera import load_camera
    from ..pipeline.experiment import measured_focal_plane

    if Path(heights).suffix.lower() in (".yaml", ".yml"):
        return configured_experiment(Path(heights)).focal_plane
    with warnings_shown(HeightWarning):
        return measured_focal_plane(heights, load_camera("lsst"))
