"""The LSST camera, and the sensors of its corner rafts, as cameras of their own."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...core.arguments import check_arguments
from .camera import Camera
from .photometry import LSST

#: Rafts of the LSST camera whose CCDs are of Imaging Technology Laboratory; the others are Teledyne e2v's.
_ITL_RAFTS = {"R01", "R02", "R03", "R10", "R20", "R41", "R42", "R43"}
#: Light-sensitive pixels along x (serial) and y (parallel) of a CCD of each vendor, from obs_lsst.
_PIXELS = {"itl": (4072, 4000), "e2v": (4096, 4004)}
#: Distance of neighbouring rafts [m], from obs_lsst and the metrology of the camera.
_RAFT_PITCH = 127.0e-3
#: Distance of neighbouring CCDs on a raft [m], likewise.
_CCD_PITCH = 42.25e-3


@check_arguments
@lru_cache(maxsize=1)
def lsst_camera() -> Camera:
    """Return the LSST camera: 189 CCDs of 10 um pixels in 21 rafts of 3 x 3.

    Names, order and numbers of pixels are those of LSSTCam (obs_lsst): ``R<row><column>_S<row><column>``, R22_S11 at
    the centre; 4072 x 4000 pixels of vendor "itl", 4096 x 4004 of "e2v". Rafts stand on a 5 x 5 grid of 127.0 mm less
    its corners, CCDs on a grid of 42.25 mm. In images (DVCS, LSE-349) columns of the grid follow one another along x
    and rows along y; DVCS x is the telescope's y and DVCS y the telescope's x, so rows follow along +x of the
    telescope and columns along +y. Order: rafts row by row, then CCDs row by row.
    """
    # A corner has both its row and its column at the rim; every other place has at least one that is not.
    grid = [(row, column) for row in range(5) for column in range(5) if {row, column} - {0, 4}]
    rafts = [(f"R{row}{column}", row, column) for row, column in grid]
    names, centers = [], []
    for raft, row, column in rafts:
        for s_row, s_column in np.ndindex(3, 3):
            names.append(f"{raft}_S{s_row}{s_column}")
            x = (row - 2) * _RAFT_PITCH + (s_row - 1) * _CCD_PITCH
            y = (column - 2) * _RAFT_PITCH + (s_column - 1) * _CCD_PITCH
            centers.append((x, y))
    vendors = tuple("itl" if name[:3] in _ITL_RAFTS else "e2v" for name in names)
    return Camera(
        name="lsst",
        ccd_names=tuple(names),
        raft_names=tuple(r[0] for r in rafts),
        raft_index=np.repeat(np.arange(len(rafts)), 9),
        centers=np.array(centers),
        pixels=np.array([_PIXELS[vendor] for vendor in vendors]),
        pixel_size=10e-6,
        vendors=vendors,
        photometry=LSST,
        height_budget="simulated",
        transposed=True,
    )


class _CornerSensor(NamedTuple):
    """Sensor of raft R00, from the metrology of the camera (positions) and obs_lsst (angles)."""

    x: float  #: centre along x of the telescope [m]
    y: float  #: centre along y of the telescope [m]
    yaw_deg: float  #: angle of its pixels' x from x towards y of DVCS [deg]


_CORNER_SENSORS = {
    "SG0": _CornerSensor(-258.738e-3, -212.238e-3, 90.0),
    "SG1": _CornerSensor(-212.238e-3, -258.738e-3, 180.0),
    "SW0": _CornerSensor(-202.6272e-3, -214.25e-3, 180.0),
    "SW1": _CornerSensor(-225.8728e-3, -214.25e-3, 0.0),
}
#: Corner rafts, and the quarter turns from +y towards +x of the telescope (+x towards +y of DVCS) that bring R00 there.
_CORNER_RAFTS = {"R00": 0, "R04": 1, "R40": 3, "R44": 2}


def _corner_camera(name: str, sensors: tuple[str, ...], pixels: tuple[int, int]) -> Camera:
    """Return the sensors of the corner rafts of the LSST camera whose names in their raft are given."""
    centers, rotations = [], []
    for turns in _CORNER_RAFTS.values():
        for sensor in sensors:
            x, y, yaw = _CORNER_SENSORS[sensor]
            for _ in range(turns):
                x, y = y, -x
            centers.append((x, y))
            # DVCS and the telescope's frame are mirror images: an angle of one is minus that of the other.
            rotations.append(-(yaw + 90.0 * turns) % 360.0)
    return Camera(
        name=name,
        ccd_names=tuple(f"{raft}_{sensor}" for raft in _CORNER_RAFTS for sensor in sensors),
        raft_names=tuple(_CORNER_RAFTS),
        raft_index=np.repeat(np.arange(len(_CORNER_RAFTS)), len(sensors)),
        centers=np.array(centers),
        pixels=np.array(pixels),
        pixel_size=10e-6,
        rotation_deg=np.array(rotations),
        photometry=LSST,
        height_budget="simulated",
        transposed=True,
    )


@lru_cache(maxsize=1)
def lsst_wavefront_camera() -> Camera:
    """Return the wavefront sensors of the LSST camera, R00_SW0 to R44_SW1: halves of 4072 x 2000 pixels."""
    return _corner_camera("lsst_wavefront", ("SW0", "SW1"), (4072, 2000))


@lru_cache(maxsize=1)
def lsst_guider_camera() -> Camera:
    """Return the guiders of the LSST camera, R00_SG0 to R44_SG1, of 4072 x 4000 pixels."""
    return _corner_camera("lsst_guider", ("SG0", "SG1"), _PIXELS["itl"])
