"""Stamps on the CCDs of a camera: field angles, axes, and heights of sensors that stand out of focus."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from ..core.errors import PachonError, ProductError, unknown_name
from ..models.camera.camera import Camera
from ..models.camera.cameras import load_camera
from ..models.camera.corner_rafts import WAVEFRONT_OFFSET
from ..models.telescope import Telescope
from ..raytrace.rays import Projection
from ..wavefront.chief_rays import fields_at
from .stamp_files import DonutStamps

#: Bundled cameras of each camera of headers, in the order of LSST's numbers of detectors.
_CAMERAS = {
    "lsst": ("lsst", "lsst_wavefront", "lsst_guider"),
    "comcam": ("comcam",),
    "auxtel": ("auxtel",),
    "decam": ("decam", "decam_focus"),
}
#: Corner rafts of LSSTCam and their sensors, which follow the 189 CCDs in the numbers of detectors.
_CORNERS = tuple(f"{raft}_{sensor}" for raft in ("R00", "R04", "R40", "R44") for sensor in ("SG0", "SG1", "SW0", "SW1"))


@dataclass(frozen=True)
class StampPlaces:
    """Where stamps lie, and how their pixels do.

    Attributes
    ----------
    fields : ndarray, shape [n, 2]
        Field angles of the light's own travel in the telescope frame [rad].
    axes : ndarray, shape [n, 2, 2]
        Unit vectors along columns and rows of each stamp in the frame of the camera.
    heights : ndarray, shape [n]
        Nominal distance of each sensor behind the focus [m].
    """

    fields: np.ndarray
    axes: np.ndarray
    heights: np.ndarray


def on_camera(stamps: DonutStamps) -> bool:
    """Return whether headers name a known camera, and detector and pixel of each stamp."""
    on_detectors = stamps.header.camera is not None and all(d is not None for d in _detectors(stamps))
    return on_detectors and bool(np.isfinite(stamps.pixels).all())


def stamp_places(stamps: DonutStamps, telescope: Telescope, file: Path, projection: Projection) -> StampPlaces:
    """Return fields, axes and heights of stamps on the CCDs of their camera.

    Parameters
    ----------
    stamps : DonutStamps
        Stamps with detectors and pixels, of a known camera.
    telescope : Telescope
        Telescope with its camera at the angle of the rotator.
    file : Path
        File that errors name.
    projection : str
        Meaning of the field angles.

    Raises
    ------
    ProductError
        If the camera has no such detector, a pixel is not on it, or stands askew.
    """
    assert stamps.header.camera is not None
    positions, axes, heights = [], [], []
    for detector, pixel in zip(_detectors(stamps), stamps.pixels, strict=True):
        camera, index = _sensor(stamps.header.camera, detector, file)
        size = camera.pixels[index]
        if not ((pixel >= -0.5) & (pixel <= size - 0.5)).all():
            expected = f"one of {size[0]} x {size[1]} from 0"
            text = f"pixel ({pixel[0]:g}, {pixel[1]:g}) of {camera.ccd_names[index]}: expected {expected}"
            raise ProductError(text, file=file)
        along = np.stack([camera.along_pixels(index, unit) for unit in np.eye(2)], axis=1)
        if not np.isclose(np.abs(along).max(axis=1), 1.0).all():
            raise ProductError(f"{camera.ccd_names[index]} stands askew: expected quarter turns", file=file)
        positions.append(camera.from_pixel(index, pixel))
        axes.append(np.round(along))
        heights.append(_height(camera, index))
    try:
        fields = fields_at(telescope, np.array(positions), projection=projection)
    except PachonError as error:
        raise ProductError(str(error), file=file) from None
    return StampPlaces(fields, np.array(axes), np.array(heights))


def _detectors(stamps: DonutStamps) -> list[str | int | None]:
    """Return the detectors; the only one of a camera of one CCD where headers do not say."""
    if stamps.header.camera == "auxtel":
        return ["RXX_S00"] * len(stamps)
    return stamps.detectors


@cache
def _camera(name: str) -> Camera:
    camera = load_camera(name)
    # Images of LATISS are in DVCS too, whose transpose ts_wep takes for the camera's frame.
    return replace(camera, transposed=True) if name == "auxtel" else camera


def _sensor(family: str, detector: str | int | None, file: Path) -> tuple[Camera, int]:
    """Return the camera and the index of a detector by name or number."""
    cameras = [_camera(name) for name in _CAMERAS[family]]
    if isinstance(detector, int):
        names = (*cameras[0].ccd_names, *_CORNERS) if family == "lsst" else cameras[0].ccd_names
        if not 0 <= detector < len(names):
            raise ProductError(f"DETECTOR = {detector}: expected a number from 0 to {len(names) - 1}", file=file)
        detector = names[detector]
    for camera in cameras:
        if detector in camera.ccd_names:
            return camera, camera.ccd_index(detector)
    problem = unknown_name(f"CCD of {family}", str(detector), [n for camera in cameras for n in camera.ccd_names])
    raise ProductError(str(problem), file=file)


def _height(camera: Camera, index: int) -> float:
    """Return the nominal distance of a sensor behind the focus [m]."""
    if camera.name == "lsst_wavefront":
        return WAVEFRONT_OFFSET if camera.ccd_names[index].endswith("SW0") else -WAVEFRONT_OFFSET
    return 0.0 if camera.placement is None else float(camera.placement[index, 0])
