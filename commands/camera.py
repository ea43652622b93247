"""The command ``pachon camera``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument

from ..core.file_names import file_name
from ..core.terminal import print_line
from .inputs import configured_experiment, warnings_shown
from .options import Json, Picture, picture_kind
from .tables import Rows, print_json

if TYPE_CHECKING:
    from ..models.camera.camera import Camera
    from ..models.camera.focal_plane import FocalPlane

app = typer.Typer()


@app.command("camera")
def camera_command(
    heights: Annotated[
        str,
        Argument(
            metavar="CAMERA | HEIGHTS",
            help="Bundled camera, or camera file (.yaml); lsstcam, or heights (.ecsv, .fits); or a configuration.",
        ),
    ] = "lsstcam",
    picture: Picture = None,
    as_json: Json = False,
) -> None:
    """List and draw the CCDs of a camera; or show statistics of their heights, by vendor, and draw a map of them.

    Heights are along +z of the telescope frame, the direction of the light at the detector.

    **Examples**

    - `pachon camera hsc`: the CCDs of Hyper Suprime-Cam
    - `pachon camera my_camera.yaml --json`
    - `pachon camera`: heights of LSSTCam as built
    - `pachon camera metrology.fits --picture heights.pdf`
    - `pachon camera pachon_run/config.yaml --json`
    """
    from dataclasses import asdict

    from ..core.files import write_bytes
    from ..core.plotting import picture_bytes
    from ..models.camera.height_statistics import height_statistics
    from ..pipeline.report.tables import HEIGHT_CAPTION, HEIGHT_COLUMNS, height_rows

    kind = picture_kind(picture)
    camera = _listed_camera(heights)
    if camera is not None:
        _show_camera(camera, picture, kind, as_json)
        return
    plane = _focal_plane(heights)
    statistics = height_statistics(plane)
    if as_json:
        metrics = {name: asdict(group) for name, group in statistics.items()}
        residual = None if plane.residual is None else dict(zip(plane.names, plane.residual, strict=True))
        print_json({"heights": heights, "statistics_m": metrics, "fit_residual_m": residual})
        if picture is None:
            return
    from ..pipeline.report.height_plots import vendor_heights_plot

    path = Path(f"camera_{file_name(Path(heights).stem)}.png") if picture is None else picture
    write_bytes(path, picture_bytes(vendor_heights_plot(plane, f"CCD heights: {Path(heights).stem}"), kind))
    if not as_json:
        Rows(HEIGHT_COLUMNS, height_rows(statistics), HEIGHT_CAPTION).show()
        print_line(f"picture: {path.resolve()}")


def _listed_camera(name: str) -> Camera | None:
    """Return the camera of a name or of a camera file; None of anything else."""
    from ..core.errors import unknown_name
    from ..models.camera.cameras import CAMERAS, ENDINGS, load_camera
    from ..models.io.camera_file import is_camera_file
    from ..models.io.heights.zernike_table import AS_MEASURED

    path = Path(name)
    ending = path.suffix.lower()
    if name in CAMERAS or (ending in ENDINGS and is_camera_file(path)):
        return load_camera(name)
    if not ending and name not in AS_MEASURED:
        raise unknown_name("camera", name, (*CAMERAS, *AS_MEASURED))
    return None


def _show_camera(camera: Camera, picture: Path | None, kind: str, as_json: bool) -> None:
    """Print the CCDs of a camera, and draw them."""
    from ..core.files import write_bytes
    from ..core.plotting import picture_bytes
    from ..pipeline.report.camera_plot import camera_plot
    from ..pipeline.report.tables import CAMERA_CAPTION, CAMERA_COLUMNS, camera_rows

    rows = camera_rows(camera)
    if as_json:
        ccds = [dict(zip(CAMERA_COLUMNS, row, strict=True)) for row in rows]
        print_json({"camera": camera.name, "pixel_um": round(camera.pixel_size * 1e6, 9), "ccds": ccds})
        if picture is None:
            return
    path = Path(f"camera_{file_name(camera.name)}.png") if picture is None else picture
    write_bytes(path, picture_bytes(camera_plot(camera), kind))
    if not as_json:
        Rows(CAMERA_COLUMNS, [[str(cell) for cell in row] for row in rows], CAMERA_CAPTION).show()
        print_line(f"picture: {path.resolve()}")


def _focal_plane(heights: str) -> FocalPlane:
    from ..core.errors import HeightWarning
    from ..models.camera.cameras import load_camera
    from ..pipeline.experiment import measured_focal_plane

    if Path(heights).suffix.lower() in (".yaml", ".yml"):
        return configured_experiment(Path(heights)).focal_plane
    with warnings_shown(HeightWarning):
        return measured_focal_plane(heights, load_camera("lsst"))
