"""Cameras by name or file."""

from __future__ import annotations

import os
from pathlib import Path

from ...core.arguments import check_arguments
from ...core.errors import unknown_name
from .camera import Camera
from .lsst import lsst_camera, lsst_guider_camera, lsst_wavefront_camera

#: Cameras that are computed, and files of those that are listed.
_MADE = {"lsst": lsst_camera, "lsst_wavefront": lsst_wavefront_camera, "lsst_guider": lsst_guider_camera}
_FILES = ("comcam", "auxtel", "hsc", "decam", "decam_focus")
#: Names of the cameras that come with the package.
CAMERAS = (*_MADE, *_FILES)
#: Endings of files that a camera is read from.
ENDINGS = (".yaml", ".yml")
_DATA = Path(__file__).parents[1] / "data"


@check_arguments
def load_camera(camera: str | os.PathLike[str] | Camera) -> Camera:
    """Load a bundled camera by name, or any camera by the path of its file; a camera is returned as it is.

    Parameters
    ----------
    camera : str, path or Camera
        "lsst", "lsst_wavefront", "lsst_guider", "comcam", "auxtel", "hsc", "decam" or "decam_focus"; or the path of a
        ``.yaml`` file.

    Raises
    ------
    UnknownNameError
        If it is neither a bundled name nor a path.
    PrescriptionError
        If the file cannot be read, or is malformed: one line with file, key, value and expected value.
    """
    if isinstance(camera, Camera):
        return camera
    text = os.fspath(camera)
    if text in _MADE:
        return _MADE[text]()
    if text in _FILES:
        path = _DATA / f"camera_{text}.yaml"
    elif Path(text).suffix.lower() in ENDINGS:
        path = Path(text)
    else:
        raise unknown_name("camera", text, (*CAMERAS, "or a file that ends in .yaml"))
    # Imported where it is needed: the sections of the format take time to make.
    from ..io.camera_file import read_camera

    return read_camera(path)
