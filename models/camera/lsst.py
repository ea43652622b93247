"""The LSST camera, and the sensors of its corner rafts, as cameras of their own."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ...core.arguments import check_arguments
from .camera import Camera
from .photometry import LSST

#: Rafts of the LSST camera whose CCDs are of Imaging Technology Laboratory; the others are Teledyne e2v's.
_ITL_RAFTS = {"R01", "R02", "R03", "R10", "R20", "R41", "R42", "R43"}


@check_arguments
@lru_cache(maxsize=1)
def lsst_camera() -> Camera:
    """Return the LSST camera: 189 CCDs of 4096 x 4096 pixels of 10 um in 21 rafts of 3 x 3.

    Rafts stand on a 5 x 5 grid of 127.0 mm less its corners, CCDs on a grid of 42.25 mm. ``R<row><column>_S<row>
    <column>``: rows along +y, columns along +x, R22_S11 at the centre. Order: rafts row by row, then CCDs row by row.
    Vendors are "itl" and "e2v". (The CCDs as built have 4072 x 4000 and 4096 x 4004 pixels.)
    """
    raft_pitch, ccd_pitch = 127.0e-3, 42.25e-3
    # A corner has both its row and its column at the rim; every other place has at least one that is not.
    grid = [(row, column) for row in range(5) for column in range(5) if {row, column} - {0, 4}]
    rafts = [(f"R{row}{column}", row, column) for row, column in grid]
    names, centers = [], []
    for raft, row, column in rafts:
        for s_row, s_column in np.ndindex(3, 3):
            names.append(f"{raft}_S{s_row}{s_column}")
            x = (column - 2) * raft_pitch + (s_column - 1) * ccd_pitch
            y = (row - 2) * raft_pitch + (s_row - 1) * ccd_pitch
            centers.append((x, y))
    return Camera(
        name="lsst",
        ccd_names=tuple(names),
        raft_names=tuple(r[0] for r in rafts),
        raft_index=np.repeat(np.arange(len(rafts)), 9),
        centers=np.array(centers),
        pixels=np.array([4096, 4096]),
        pixel_size=10e-6,
        vendors=tuple("itl" if name[:3] in _ITL_RAFTS else "e2v" for name in names),
        photometry=LSST,
        height_budget="simulated",
    )


#: Centres of the sensors of raft R00 of the LSST camera [m]; the other corners are quarter turns of it.
_CORNER_SENSORS = {
    "SG0": (-212.238e-3, -258.738e-3),
    "SG1": (-258.738e-3, -212.238e-3),
    "SW0": (-214.25e-3, -202.6272e-3),
    "SW1": (-214.25e-3, -225.8728e-3),
}
#: Corner rafts, and the quarter turns from +x towards +y that bring R00 there.
_CORNER_RAFTS = {"R00": 0, "R04": 1, "R40": 3, "R44": 2}


def _corner_camera(name: str, sensors: tuple[str, ...], pixels: int) -> Camera:
    """Return the sensors of the corner rafts of the LSST camera whose names in their raft are given."""
    centers = []
    for turns in _CORNER_RAFTS.values():
        for sensor in sensors:
            x, y = _CORNER_SENSORS[sensor]
            for _ in range(turns):
                x, y = -y, x
            centers.append((x, y))
    return Camera(
        name=name,
        ccd_names=tuple(f"{raft}_{sensor}" for raft in _CORNER_RAFTS for sensor in sensors),
        raft_names=tuple(_CORNER_RAFTS),
        raft_index=np.repeat(np.arange(len(_CORNER_RAFTS)), len(sensors)),
        centers=np.array(centers),
        pixels=np.array([pixels, pixels]),
        pixel_size=10e-6,
        photometry=LSST,
        height_budget="simulated",
    )


@lru_cache(maxsize=1)
def lsst_wavefront_camera() -> Camera:
    """Return the wavefront sensors of the LSST camera, R00_SW0 to R44_SW1.

    Of each half of 2000 x 4072 pixels these are the middle 2000 x 2000.
    """
    return _corner_camera("lsst_wavefront", ("SW0", "SW1"), 2000)


@lru_cache(maxsize=1)
def lsst_guider_camera() -> Camera:
    """Return the guiders of the LSST camera, R00_SG0 to R44_SG1: of 4072 x 4000 pixels the middle 4000 x 4000."""
    return _corner_camera("lsst_guider", ("SG0", "SG1"), 4000)
