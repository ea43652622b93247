"""Cameras: where each CCD of a mosaic lies, by name.

Positions are in the frame of the detector: x, y along the telescope's, origin on the optical axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import unknown_name
from ...core.units import plane_points

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


@check_arguments
@dataclass(frozen=True, eq=False)
class Camera:
    """A mosaic of equal square CCDs, on rafts."""

    name: str
    ccd_names: tuple[str, ...]
    raft_names: tuple[str, ...]
    raft_index: np.ndarray  #: raft of each CCD, [n_ccd]
    centers: np.ndarray  #: centres of the CCDs (x, y) [m], [n_ccd, 2]
    pixels: int  #: pixels along a side of a CCD
    pixel_size: float  #: side of a pixel [m]
    vendors: tuple[str, ...] = ()  #: maker of each CCD; empty where they are not told apart

    def __repr__(self) -> str:
        return f"<Camera {self.name}: {len(self)} CCDs of {self.pixels} pixels of {self.pixel_size * 1e6:g} um>"

    def __post_init__(self) -> None:
        for array in (self.raft_index, self.centers):
            array.flags.writeable = False

    def __len__(self) -> int:
        return len(self.ccd_names)

    @property
    def ccd_size(self) -> float:
        """Side of a CCD [m]."""
        return self.pixels * self.pixel_size

    @property
    def half_size(self) -> float:
        """Half the side of a CCD [m]."""
        return 0.5 * self.ccd_size

    @cached_property
    def raft_of(self) -> tuple[str, ...]:
        """Name of the raft of each CCD."""
        return tuple(self.raft_names[i] for i in self.raft_index)

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.ccd_names)}

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.centers)

    def ccd_index(self, name: str) -> int:
        """Return the index of a CCD, or raise UnknownNameError."""
        try:
            return self._index[name]
        except (KeyError, TypeError):
            raise unknown_name(f"CCD of {self.name}", name, self.ccd_names) from None

    def ccds_of_raft(self, raft: str) -> tuple[str, ...]:
        """Return the names of the CCDs on a raft, or raise UnknownNameError."""
        if raft not in self.raft_names:
            raise unknown_name(f"raft of {self.name}", raft, self.raft_names)
        return tuple(n for n, r in zip(self.ccd_names, self.raft_of, strict=True) if r == raft)

    def ccd_at(self, x: ArrayLike, y: ArrayLike, *, margin: float = 0.0) -> np.ndarray:
        """Return the index of the CCD at points; -1 without one.

        Parameters
        ----------
        x, y : array_like or Quantity
            Points [m].
        margin : float
            Distance from the rim at which points still belong to a CCD [m].
        """
        px, py = plane_points(x, y)
        index = np.full(px.shape, -1, dtype=np.int64)
        finite = np.isfinite(px) & np.isfinite(py)
        if np.any(finite):
            # Equal squares that do not overlap: the nearest centre in the maximum norm is the only candidate.
            distance, nearest = self._tree.query(np.stack([px[finite], py[finite]], axis=-1), p=np.inf)
            index[finite] = np.where(distance <= self.half_size + margin, nearest, -1)
        return index


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
        pixels=4096,
        pixel_size=10e-6,
        vendors=tuple("itl" if name[:3] in _ITL_RAFTS else "e2v" for name in names),
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
        pixels=pixels,
        pixel_size=10e-6,
    )


@lru_cache(maxsize=1)
def lsst_wavefront_camera() -> Camera:
    """Return the wavefront sensors of the LSST camera, R00_SW0 to R44_SW1.

    CCDs of a camera are square: of each half of 2000 x 4072 pixels these are the middle 2000 x 2000.
    """
    return _corner_camera("lsst_wavefront", ("SW0", "SW1"), 2000)


@lru_cache(maxsize=1)
def lsst_guider_camera() -> Camera:
    """Return the guiders of the LSST camera, R00_SG0 to R44_SG1: of 4072 x 4000 pixels the middle 4000 x 4000."""
    return _corner_camera("lsst_guider", ("SG0", "SG1"), 4000)


CAMERAS = {"lsst": lsst_camera, "lsst_wavefront": lsst_wavefront_camera, "lsst_guider": lsst_guider_camera}


def load_camera(camera: str | Camera) -> Camera:
    """Return a camera by name, or a camera as it is; an unknown name is an UnknownNameError."""
    if isinstance(camera, Camera):
        return camera
    if camera not in CAMERAS:
        raise unknown_name("camera", camera, CAMERAS)
    return CAMERAS[camera]()
