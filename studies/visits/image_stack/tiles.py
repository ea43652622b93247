"""Square tiles of the common frame, and the sums of images over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits

from ....core.errors import DomainError
from ....core.products import Stamp, image_hdu, read_fits, write_fits
from ....imaging.draw import SkyPixels, Window
from ....imaging.wcs import CcdWcs
from ....pipeline.experiment import Experiment
from ..config import VisitsConfig
from ..psf_visit import StackFrame, middle_wavelength, visit_telescope
from ..stack import VISITS_CARD

#: Bit of the mask of a pixel without data of any visit.
NO_DATA = 1
#: Name of the bit.
STACK_MASK_BITS = {NO_DATA: "NO_DATA"}
#: Bytes of a pixel of a tile: sums of data and variance, number of visits.
BYTES = 10
#: Nodes along a side of a CCD for its overlap with tiles.
_NODES = 65
#: Visits for the coverage of a tile.
_VISITS = 10
#: Points along a side of a tile for its coverage.
_POINTS = 5


@dataclass(frozen=True)
class Tile:
    """Square of `side` x `side` pixels of the frame; tile (0, 0) has the common pointing in its middle.

    Places in the frame (x, y) are d(x, y)/d(xi, eta) times (xi, eta); the first pixel of a tile is at `first`.
    """

    column: int
    row: int
    side: int

    @property
    def name(self) -> str:
        """Column and row, as names of files have them."""
        return f"{self.column:+03d}_{self.row:+03d}"

    @property
    def first(self) -> np.ndarray:
        """Place (x, y) of the first pixel in the frame, so that pixels coincide with those of a CCD in the middle."""
        return np.array([self.column, self.row]) * self.side - 0.5 * (self.side - 1)

    @property
    def inside(self) -> Window:
        """Its own pixels, counted from its first one."""
        return Window(0, 0, self.side, self.side)

    def wcs(self, frame: StackFrame) -> CcdWcs:
        """Return the world coordinates: TAN about the common pointing, without distortion."""
        nothing = np.zeros((2, 2, 2))
        return CcdWcs(
            pointing=(0.0, 0.0),
            reference=(0.0, 0.0),
            shape=(self.side, self.side),
            reference_pixel=-self.first,
            cd=np.linalg.inv(frame.matrix),
            distortion=nothing,
            inverse=nothing,
            error=0.0,
        )


def choose_tiles(experiment: Experiment, frame: StackFrame, side: int, most: int, config: VisitsConfig) -> list[Tile]:
    """Return tiles of which the CCDs of visits cover at least half on average, from the pointing outwards.

    The first visits of the plan decide, whatever the number of visits of a stack.

    Parameters
    ----------
    experiment : Experiment
        Experiment of the visits.
    frame : StackFrame
        Common frame.
    side : int
        Pixels along a side of a tile.
    most : int
        Most tiles.
    config : VisitsConfig
        Configuration of the visits.

    Raises
    ------
    DomainError
        If there is no such tile.
    """
    camera = experiment.camera
    names = experiment.config.ccds or ()
    ccds = [camera.ccd_index(name) for name in names]
    reach = float(np.abs(camera.bounds(ccds)).max())
    rows = int(np.ceil(reach / (side * camera.pixel_size)))
    tiles = [Tile(i, j, side) for i in range(-rows, rows + 1) for j in range(-rows, rows + 1)]
    # Those farther out than wanted are not looked at: a field of small tiles has thousands.
    tiles = sorted(tiles, key=lambda tile: (tile.column**2 + tile.row**2, tile.column, tile.row))
    inside = (np.arange(_POINTS) + 0.5) * side / _POINTS
    offsets = np.stack(np.meshgrid(inside, inside), axis=-1).reshape(-1, 2)
    to_sky = np.linalg.inv(frame.matrix).T
    angle_lists = [
        angle_list
        for angle_list in (config.visits.roll_deg, config.visits.rotator_deg)
        if isinstance(angle_list, tuple)
    ]
    plan = config.plan_of(min([_VISITS, *map(len, angle_lists)]), experiment.config.seed)
    telescopes = [visit_telescope(experiment, visit) for visit in plan]
    wavelength = middle_wavelength(experiment)
    covered_tiles: list[Tile] = []
    for tile in tiles:
        sky = (offsets + tile.first) @ to_sky
        coverage = 0.0
        for visit, telescope in zip(plan, telescopes, strict=True):
            at = visit.on_detector(telescope, sky, wavelength)
            near = np.any([camera.depth(ccd, *at.T) >= 0.0 for ccd in ccds], axis=0)
            coverage += near.mean() / len(plan)
        if coverage >= 0.5:
            covered_tiles.append(tile)
        if len(covered_tiles) == most:
            break
    if not covered_tiles:
        raise DomainError(
            f"no tile of {side} pixels is seen by half of the visits; expected more CCDs, or smaller tiles"
        )
    return covered_tiles


@dataclass(eq=False)
class TileSums:
    """Sums over the visits, all of one weight, as all have the same sky and read noise.

    Attributes
    ----------
    visits : int
        Visits so far.
    data, variance : ndarray of float32, shape [side, side]
        Sums of the resampled images [electron] and of their variances.
    count : ndarray of int16, shape [side, side]
        Visits with data in each pixel.
    """

    visits: int
    data: np.ndarray
    variance: np.ndarray
    count: np.ndarray

    @classmethod
    def empty(cls, side: int) -> TileSums:
        """Return the sums of no visit."""
        data, variance = np.zeros((2, side, side), dtype=np.float32)
        return cls(0, data, variance, np.zeros((side, side), dtype=np.int16))

    def add(self, visit: TileSums) -> None:
        """Add those of one visit."""
        self.data += visit.data
        self.variance += visit.variance
        self.count += visit.count
        self.visits += 1

    def stacked(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return image, variance and mask of the mean of the visits times their number, as of one long exposure."""
        has_data = self.count > 0
        factor = np.divide(self.visits, self.count, out=np.zeros(self.data.shape, np.float32), where=has_data)
        mask = np.where(has_data, 0, NO_DATA).astype(np.int16)
        return self.data * factor, self.variance * factor**2, mask

    def write(self, path: Path, stamp: Stamp) -> None:
        """Write the sums, exactly as they are."""
        hdus = [
            image_hdu("DATA", self.data, "sum of the images of visits [electron]"),
            image_hdu("VARIANCE", self.variance, "sum of their variances"),
            fits.ImageHDU(self.count, name="COUNT"),
        ]
        write_fits(path, hdus, stamp, [(VISITS_CARD, self.visits, "in the sums")])

    @classmethod
    def read(cls, path: Path, stamp: Stamp) -> TileSums:
        """Read sums; ProductError for those of another configuration, and for a damaged file."""
        hdus = read_fits(path, stamp)
        data, variance = (np.array(hdus[key].data, dtype=np.float32) for key in ("DATA", "VARIANCE"))
        return cls(hdus[0].header[VISITS_CARD], data, variance, np.array(hdus["COUNT"].data, dtype=np.int16))


def window_on(tiles: Sequence[Tile], frame: StackFrame, wcs: SkyPixels) -> Window | None:
    """Return the part of a CCD that touches tiles; None if none does."""
    height, width = wcs.shape
    nodes = [np.linspace(0.0, n - 1.0, _NODES) for n in (width, height)]
    steps = [float(line[1]) for line in nodes]
    places = wcs.to_sky(np.stack(np.meshgrid(*nodes), axis=-1).reshape(-1, 2)) @ frame.matrix.T
    # Nodes are less than a step and a half from any pixel between them, along each axis of a rolled frame.
    near = np.any([tile.inside.contains(places - tile.first, 1.5 * max(steps)) for tile in tiles], axis=0)
    near = near.reshape(_NODES, _NODES)
    if not near.any():
        return None
    ends = []
    for axis, (line, step, pixels) in enumerate(zip(nodes, steps, (width, height), strict=True)):
        near_nodes = np.flatnonzero(near.any(axis=axis))
        low, high = line[near_nodes[0]] - step, line[near_nodes[-1]] + step
        ends.append((max(0, int(low)), min(pixels, int(np.ceil(high)) + 1)))
    (x0, x1), (y0, y1) = ends
    return Window(x0, y0, x1 - x0, y1 - y0)
