"""The command ``pachon camera``."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer
from typer import Argument

from ..core.errors import ConfigError
from ..core.file_names import file_name
from ..core.number_text import counted
from ..core.terminal import print_line
from . import completion
from .choices import names
from .completion import YAML
from .inputs import configured_experiment, warnings_shown
from .options import Json, NoPicture, Picture, Settings, TableFile, picture_kind
from .tables import Rows, print_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..models.camera.camera import Camera
    from ..models.camera.focal_plane import FocalPlane

app = typer.Typer()
#: Table, content of the JSON, and function that draws the picture.
_Content: TypeAlias = "tuple[Rows, dict[str, Any], Callable[[], Figure]]"


@app.command("camera")
def camera_command(
    heights: Annotated[
        str,
        names(
            completion.either(completion.cameras, completion.files(*completion.YAML, *completion.HEIGHTS)),
            metavar="CAMERA|HEIGHTS",
            help="Bundled camera, or camera file (.yaml); lsstcam, or heights (.ecsv, .fits); or a configuration.",
            kind=Argument,
        ),
    ] = "lsstcam",
    of_camera: Annotated[
        str | None,
        names(
            completion.either(completion.cameras, completion.files(*completion.YAML)),
            "--camera",
            metavar="CAMERA",
            help="Camera, or camera file, whose heights a file has; lsst by default.",
        ),
    ] = None,
    settings: Settings = None,
    picture: Picture = None,
    no_picture: NoPicture = False,
    table: TableFile = None,
    as_json: Json = False,
) -> None:
    """List and draw the CCDs of a camera; or show statistics of their heights, by vendor, and draw a map of them.

    Heights are along +z of the detector: with the light in the LSST, DECam and HSC, against it behind the primary
    mirror of a Cassegrain.

    **Examples**

    - `pachon camera hsc`: the CCDs of Hyper Suprime-Cam
    - `pachon camera my_camera.yaml --json`
    - `pachon camera`: heights of LSSTCam as built
    - `pachon camera metrology.fits --picture heights.pdf`
    - `pachon camera my_metrology.ecsv --camera my_camera.yaml`: heights of another camera than the LSST
    - `pachon camera pachon_run/config.yaml --json`
    - `pachon camera pachon_run/config.yaml --set focal_plane.ccd=false`: without heights of single CCDs
    """
    from ..core.files import write_bytes
    from ..core.plotting import picture_bytes
    from ..models.io.heights.file import ENDINGS

    kind = picture_kind(picture, no_picture)
    drawn = not no_picture and (picture is not None or not as_json)
    camera = _listed_camera(heights)
    if settings and Path(heights).suffix.lower() not in YAML:
        raise ConfigError(f"--set: expected a configuration in place of {heights}, whose keys it sets")
    if settings and camera is not None:
        raise ConfigError(f"--set: expected a configuration, whose keys it sets; {heights} is a camera")
    if of_camera is not None and Path(heights).suffix.lower() not in ENDINGS:
        raise ConfigError(f"--camera = {of_camera}: expected a file of heights in place of {heights}")
    rows, content, draw = _listed(camera) if camera is not None else _heights(heights, of_camera, settings or ())
    name = file_name(camera.name if camera is not None else Path(heights).stem)
    files = {}
    if drawn:
        files["picture"] = picture or Path(f"camera_{name}.png")
        write_bytes(files["picture"], picture_bytes(draw(), kind))
    if table is not None:
        files["table"] = table
        rows.write(table)
    if as_json:
        print_json(content)
        return
    rows.show()
    for what, path in files.items():
        print_line(f"{what}: {path.resolve()}")


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


def _listed(camera: Camera) -> _Content:
    """Return the CCDs of a camera as a table and for JSON, and the function that draws them."""
    from ..pipeline.report.camera_plot import camera_plot
    from ..pipeline.report.tables import CAMERA_CAPTION, CAMERA_COLUMNS, camera_rows

    rows = camera_rows(camera)
    ccds = [dict(zip(CAMERA_COLUMNS, row, strict=True)) for row in rows]
    content = {"camera": camera.name, "pixel_um": round(camera.pixel_size * 1e6, 9), "ccds": ccds}
    side = f"{camera.pixel_size * 1e6:.4g} µm"
    verdict = f"{camera.name} has {counted(len(camera), 'CCD')} with pixels of {side}."
    headings = [re.sub(r"_(mm|deg)$", r" [\1]", name) for name in CAMERA_COLUMNS]
    table = Rows(headings, [[str(cell) for cell in row] for row in rows], CAMERA_CAPTION, verdict=verdict)
    return table, content, lambda: camera_plot(camera)


def _heights(heights: str, camera: str | None, settings: Sequence[str]) -> _Content:
    """Return the statistics of heights as a table and for JSON, and the function that draws a map."""
    from dataclasses import asdict

    from ..models.camera.height_statistics import height_statistics
    from ..pipeline.report.height_plots import vendor_heights_plot
    from ..pipeline.report.tables import HEIGHT_CAPTION, HEIGHT_COLUMNS, height_rows

    plane = _focal_plane(heights, camera, settings)
    statistics = height_statistics(plane)
    residual = None if plane.residual is None else dict(zip(plane.names, plane.residual, strict=True))
    metrics = {name: asdict(group) for name, group in statistics.items()}
    content = {"heights": heights, "statistics_m": metrics, "fit_residual_m": residual}
    title = f"CCD heights: {Path(heights).stem}"
    together = statistics["all"]
    verdict = (
        f"The heights of {counted(together.n_ccd, 'CCD')} have {1e6 * together.rms:.3g} µm rms; 95 % of them lie "
        f"within {1e6 * together.width95:.3g} µm."
    )
    table = Rows(HEIGHT_COLUMNS, height_rows(statistics), HEIGHT_CAPTION, verdict=verdict)
    return table, content, lambda: vendor_heights_plot(plane, title)


def _focal_plane(heights: str, camera: str | None, settings: Sequence[str]) -> FocalPlane:
    from ..core.errors import HeightWarning
    from ..models.camera.cameras import load_camera
    from ..pipeline.experiment import measured_focal_plane

    if Path(heights).suffix.lower() in YAML:
        return configured_experiment(Path(heights), settings).focal_plane
    with warnings_shown(HeightWarning):
        return measured_focal_plane(heights, load_camera(camera or "lsst"))
