"""Cameras: where each CCD of a mosaic lies, by name, and the maps between its pixels and the focal plane.

Three frames. That of the focal plane is the detector's: x, y along the telescope's, origin on the optical axis, turned
by the rotator. That of a CCD has its origin at the centre of the CCD and x, y along its sides, at the angle
`rotation_deg` from those of the focal plane. Pixels are counted along the latter, the centre of the first at (0, 0):
their x along its x, or, where the camera is `transposed`, along its y.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError, check_unique, unknown_name
from ...core.notebook import Pictured
from ...core.number_text import counted
from ...core.units import plane_points
from .photometry import CameraPhotometry

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

#: Depth by which CCDs may overlap, which rounding of their places makes [m].
_TOUCHING = 1e-9
#: Corners of a CCD in halves of its sides.
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
#: Names of CCDs and rafts, which stand in names of files and in lists with commas.
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_QUARTER_COSINES = np.array([1.0, 0.0, -1.0, 0.0])


@dataclass(frozen=True)
class _Kind:
    """CCDs of one size and angle."""

    index: np.ndarray  #: in the camera, [n]
    half: np.ndarray  #: halves of their sides [m], [2]
    centers: np.ndarray  #: along their own axes, from the origin of the focal plane [m], [n, 2]
    tree: cKDTree  #: of the centres, y in units that make the CCDs square


@dataclass(frozen=True, eq=False)
class CcdFrame:
    """Frames of CCDs, one for each of so many points or one for all."""

    x: np.ndarray  #: centres on the focal plane along x [m]
    y: np.ndarray  #: centres along y [m]
    direction: np.ndarray | None  #: cosine and sine of their angles, shape [2, ...]; None where all are zero

    def along_ccd(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the components along the axes of the CCDs of vectors of the focal plane."""
        if self.direction is None:
            return x, y
        cosine, sine = self.direction
        return cosine * x + sine * y, cosine * y - sine * x

    def along_focal_plane(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the components along the axes of the focal plane of vectors along those of the CCDs."""
        if self.direction is None:
            return x, y
        cosine, sine = self.direction
        return cosine * x - sine * y, sine * x + cosine * y

    def to_local(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the places in the frames of the CCDs [m] of points of the focal plane [m]."""
        return self.along_ccd(x - self.x, y - self.y)

    def from_local(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the points of the focal plane [m] of places in the frames of the CCDs [m]."""
        along_x, along_y = self.along_focal_plane(x, y)
        return self.x + along_x, self.y + along_y


@check_arguments
@dataclass(frozen=True, eq=False)
class Camera(Pictured):
    """A mosaic of rectangular CCDs, each with its own size and angle, on rafts or without.

    Raises
    ------
    DomainError
        If there are no CCDs, two have one name or overlap, or a number is out of range.
    """

    name: str
    ccd_names: tuple[str, ...]
    raft_names: tuple[str, ...]
    raft_index: np.ndarray  #: raft of each CCD, -1 without one, [n_ccd]
    centers: np.ndarray  #: centres of the CCDs (x, y) [m], [n_ccd, 2]
    pixels: np.ndarray  #: pixels along x and y of each CCD, [n_ccd, 2]; or [2] if all are alike
    pixel_size: float  #: side of a pixel [m]
    vendors: tuple[str, ...] = ()  #: maker of each CCD; empty where they are not told apart
    rotation_deg: np.ndarray = field(default_factory=lambda: np.zeros(1))
    """Angle of each CCD from +x towards +y [deg], [n_ccd]; or [1] if all are alike. Quarter turns are exact."""
    placement: np.ndarray | None = None
    """Nominal height [m] and rotations about x and y of the focal plane [rad] of each CCD, [n_ccd, 3]; zero if None."""
    photometry: CameraPhotometry = field(default_factory=CameraPhotometry)  #: zero points, sky, noise
    height_budget: str = "flat"  #: budget that heights are drawn from by default, as :class:`~.HeightBudget` names them
    transposed: bool = False
    """Whether the pixels' x runs along y of the frame of the CCD, and y along x, as in LSST's images (DVCS)."""

    def __post_init__(self) -> None:
        n = len(self.ccd_names)
        if not n:
            raise DomainError(f"camera {self.name}: no CCDs: expected at least one")
        for name in (*self.ccd_names, *self.raft_names):
            if not _NAME.fullmatch(name) or name == "all":
                raise DomainError(f"camera {self.name}: {name!r}: expected a name of letters, digits, _, - and dots")
        check_unique(f"CCD of camera {self.name}", self.ccd_names)
        check_unique(f"raft of camera {self.name}", self.raft_names)
        for name in set(self.raft_names).intersection(self.ccd_names):
            raise DomainError(f"camera {self.name}: {name} names a CCD and a raft: expected different names")
        shapes = {"raft_index": (n,), "centers": (n, 2), "pixels": (n, 2), "rotation_deg": (n,), "placement": (n, 3)}
        for key, shape in shapes.items():
            values = getattr(self, key)
            if values is None:
                continue
            if key in ("pixels", "rotation_deg") and values.shape in (shape[1:], (1,)):
                values = np.broadcast_to(values, shape).copy()
                object.__setattr__(self, key, values)
            if values.shape != shape or not np.isfinite(values).all():
                raise DomainError(f"camera {self.name}, {key}: expected finite numbers of shape {list(shape)}")
            values.flags.writeable = False
        if self.vendors and len(self.vendors) != n:
            raise DomainError(f"camera {self.name}, vendors: expected none, or one for each of {n} CCDs")
        if not np.isin(self.raft_index, np.arange(-1, len(self.raft_names))).all():
            raise DomainError(
                f"camera {self.name}, raft_index: expected indices of {len(self.raft_names)} rafts, or -1"
            )
        if not 0.0 < self.pixel_size < np.inf:
            raise DomainError(f"camera {self.name}, pixel_size = {self.pixel_size!r}: expected a length above 0")
        wrong = np.flatnonzero(((self.pixels < 1) | (self.pixels != np.round(self.pixels))).any(axis=1))
        if wrong.size:
            pixels = self.pixels[wrong[0]].tolist()
            raise DomainError(f"CCD {self.ccd_names[wrong[0]]}, pixels = {pixels}: expected whole numbers of 1 or more")
        self._check_overlap()

    def __repr__(self) -> str:
        count = len(self.raft_names)
        rafts = f" on {count} raft{'s' * (count != 1)}" if count else ""
        return f"<Camera {self.name}: {counted(len(self), 'CCD')}{rafts}>"

    def __len__(self) -> int:
        return len(self.ccd_names)

    # ---- sizes and outlines

    @cached_property
    def half_sizes(self) -> np.ndarray:
        """Halves of the sides of each CCD along x and y of its frame [m], shape [n_ccd, 2]."""
        return np.ascontiguousarray(self._swapped(0.5 * (self.pixels * self.pixel_size)))

    @cached_property
    def shortest_side(self) -> float:
        """Shortest side of all CCDs [m], which sets the scale of drawings."""
        return 2.0 * float(self.half_sizes.min())

    @cached_property
    def reach(self) -> float:
        """Largest distance of the mosaic from the axis along x or y [m]."""
        return float(np.abs(self.bounds(range(len(self)))).max())

    @cached_property
    def radius(self) -> float:
        """Largest distance of the centre of a CCD from the axis, half the diagonal of a CCD where that is more [m]."""
        return float(max(np.hypot(*self.centers.T).max(), np.hypot(*self.half_sizes.T).max()))

    @cached_property
    def alike(self) -> bool:
        """Whether all CCDs are squares of one size, along the axes of the focal plane."""
        return self._upright and bool((self.pixels == self.pixels[0, 0]).all())

    @cached_property
    def raft_of(self) -> tuple[str, ...]:
        """Name of the raft of each CCD; empty without one."""
        return tuple((*self.raft_names, "")[i] for i in self.raft_index)

    def corners(self, ccds: Iterable[int]) -> np.ndarray:
        """Return the corners of CCDs of given index, in order around them [m], shape [n, 4, 2]."""
        return self.from_uv(np.array(list(ccds), dtype=np.int64)[:, None], _CORNERS)

    def bounds(self, ccds: Iterable[int]) -> tuple[float, float, float, float]:
        """Return (xmin, xmax, ymin, ymax) of CCDs of given index, all of them within [m]."""
        corners = self.corners(ccds)
        (xmin, ymin), (xmax, ymax) = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        return float(xmin), float(xmax), float(ymin), float(ymax)

    def rectangle(self, ccd: int, rim: float = 0.0) -> tuple[tuple[float, float, float, float], float]:
        """Return a CCD without a rim [m] as a rectangle along the axes of the focal plane, and its angle.

        Returns
        -------
        rectangle : tuple of float
            (xmin, xmax, ymin, ymax) [m].
        angle : float
            By which it is turned about its centre, from +x towards +y [rad]; 0 after quarter turns.
        """
        (x, y), (a, b) = self.centers[ccd].tolist(), self.half_sizes[ccd].tolist()
        quarters = round(float(self.rotation_deg[ccd]) / 90.0)
        a, b = (b - rim, a - rim) if quarters % 2 else (a - rim, b - rim)
        return (x - a, x + a, y - b, y + b), float(np.deg2rad(self.rotation_deg[ccd] - 90.0 * quarters))

    def turned(self, angle_deg: float) -> Camera:
        """Return the camera in axes of the focal plane that are turned from +x towards +y [deg]; quarters are exact."""
        if not np.isfinite(angle_deg):
            raise DomainError(f"angle_deg = {angle_deg}: expected a finite number of degrees")
        cosine, sine = _directions(np.array(angle_deg))

        def along(vectors: np.ndarray) -> np.ndarray:
            x, y = vectors[:, -2], vectors[:, -1]
            return np.column_stack([vectors[:, :-2], cosine * x + sine * y, cosine * y - sine * x])

        placement = None if self.placement is None else along(self.placement)
        rotation = self.rotation_deg - angle_deg
        return replace(self, centers=along(self.centers), rotation_deg=rotation, placement=placement)

    # ---- names

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

    def members(self, name: str) -> tuple[int, ...]:
        """Return the indices of the CCDs on a raft, or of the CCD of that name; UnknownNameError without either."""
        if name in self._index:
            return (self._index[name],)
        if name in self.raft_names:
            return tuple(np.flatnonzero(self.raft_index == self.raft_names.index(name)).tolist())
        # Rafts of the LSST are R22, its CCDs R22_S11: what looks like neither is compared with both.
        rafts = self.raft_names if "_" not in name else ()
        raise unknown_name(f"raft of {self.name}" if rafts else f"CCD of {self.name}", name, rafts or self.ccd_names)

    @cached_property
    def parts(self) -> dict[str, tuple[int, ...]]:
        """CCDs of each part that moves as one, by its name: rafts, and CCDs without a raft."""
        alone = [name for name, raft in zip(self.ccd_names, self.raft_index, strict=True) if raft < 0]
        return {name: self.members(name) for name in (*self.raft_names, *alone)}

    # ---- maps between the frames; `ccd` is one index or an array of them, which is broadcast with the points

    def frame(self, ccd: Any) -> CcdFrame:
        """Return the frames of CCDs."""
        return CcdFrame(self.centers[ccd, 0], self.centers[ccd, 1], None if self._upright else self._direction[:, ccd])

    def to_local(self, ccd: Any, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the places in the frames of CCDs [m] of points of the focal plane [m]."""
        return self.frame(ccd).to_local(x, y)

    def from_local(self, ccd: Any, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the points of the focal plane [m] of places in the frames of CCDs [m]."""
        return self.frame(ccd).from_local(x, y)

    def to_uv(self, ccd: Any, xy: np.ndarray) -> np.ndarray:
        """Return the places on CCDs, in halves of their sides from -1 to 1, of points [m], shape [..., 2]."""
        return np.stack(self.to_local(ccd, xy[..., 0], xy[..., 1]), axis=-1) / self.half_sizes[ccd]

    def from_uv(self, ccd: Any, uv: np.ndarray) -> np.ndarray:
        """Return the points of the focal plane [m] of places on CCDs in halves of their sides, shape [..., 2]."""
        local = self.half_sizes[ccd] * uv
        return np.stack(self.from_local(ccd, local[..., 0], local[..., 1]), axis=-1)

    def to_pixel(self, ccd: Any, xy: np.ndarray) -> np.ndarray:
        """Return the pixels of CCDs of points of the focal plane [m], shape [..., 2]."""
        local = np.stack(self.to_local(ccd, xy[..., 0], xy[..., 1]), axis=-1)
        return self._swapped(local) / self.pixel_size + 0.5 * (self.pixels[ccd] - 1)

    def from_pixel(self, ccd: Any, pixel: np.ndarray) -> np.ndarray:
        """Return the points of the focal plane [m] of pixels of CCDs, shape [..., 2]."""
        local = self._swapped((pixel - 0.5 * (self.pixels[ccd] - 1)) * self.pixel_size)
        return np.stack(self.from_local(ccd, local[..., 0], local[..., 1]), axis=-1)

    def along_pixels(self, ccd: Any, vectors: np.ndarray) -> np.ndarray:
        """Return the components along the pixels' x and y of vectors of the focal plane, shape [..., 2]."""
        return self._swapped(np.stack(self.frame(ccd).along_ccd(vectors[..., 0], vectors[..., 1]), axis=-1))

    def _swapped(self, vectors: np.ndarray) -> np.ndarray:
        """Return vectors along the axes of CCDs as vectors along their pixels' x and y, and the other way round."""
        return vectors[..., ::-1] if self.transposed else vectors

    def nodes(self, cells: int, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return CCD, x and y in its frame [m] of the nodes of a grid over every CCD, shrunk by a scale; shape [n]."""
        axis = np.linspace(-1.0, 1.0, cells + 1)
        ccd, v, u = np.broadcast_arrays(np.arange(len(self))[:, None, None], axis[None, :, None], axis[None, None, :])
        ccd = ccd.ravel()
        a, b = (self.half_sizes * scale)[ccd].T
        return ccd, u.ravel() * a, v.ravel() * b

    # ---- membership

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
        for kind in self._kinds:
            unassigned = finite if kind is self._kinds[0] else finite & (index < 0)
            if np.any(unassigned):
                index[unassigned] = self._of_kind(kind, px[unassigned], py[unassigned], margin)
        return index

    def _of_kind(self, kind: _Kind, x: np.ndarray, y: np.ndarray, margin: float) -> np.ndarray:
        """Return the index of the CCD of one kind at points [m], shape [n]; -1 without one."""
        u, v = self.frame(kind.index[0]).along_ccd(x, y)
        (a, b), (width, height) = kind.half + margin, kind.half
        # Equal rectangles that do not overlap: the nearest centre in the maximum norm is the only candidate.
        distance, nearest = kind.tree.query(np.stack([u, v * (width / height)], axis=-1), p=np.inf)
        if width == height:
            inside = distance <= a
        else:
            at = kind.centers[nearest]
            inside = (np.abs(u - at[:, 0]) <= a) & (np.abs(v - at[:, 1]) <= b)
        return np.where(inside, kind.index[nearest], -1)

    def depth(self, ccd: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return how far inside the nearest rim of a CCD, one or that of each, points lie [m]; negative beyond."""
        u, v = self.to_local(ccd, x, y)
        a, b = self.half_sizes[ccd].T
        return np.minimum(a - np.abs(u), b - np.abs(v))

    # ---- kept

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.ccd_names)}

    @cached_property
    def _upright(self) -> bool:
        return not self.rotation_deg.any()

    @cached_property
    def _direction(self) -> np.ndarray:
        """Cosine and sine of the angle of each CCD, [2, n_ccd]; exact for quarter turns."""
        return _directions(self.rotation_deg)

    @cached_property
    def _kinds(self) -> list[_Kind]:
        """CCDs by size and angle, the most numerous first; half turns leave a rectangle as it is."""
        from scipy.spatial import cKDTree

        kinds = []
        described = np.column_stack([self.pixels, self.rotation_deg % 180.0])
        for row in np.unique(described, axis=0):
            index = np.flatnonzero((described == row).all(axis=1))
            half = self.half_sizes[index[0]]
            centers = np.stack(self.frame(index[0]).along_ccd(*self.centers[index].T), axis=-1)
            kinds.append(_Kind(index, half, centers, cKDTree(centers * [1.0, half[0] / half[1]])))
        return sorted(kinds, key=lambda kind: -len(kind.index))

    def _check_overlap(self) -> None:
        """Raise DomainError, with the names, if two CCDs overlap: if no side of either separates them."""
        radius = np.hypot(*self.half_sizes.T)
        x, y = self.centers.T
        near = np.hypot(x[:, None] - x, y[:, None] - y) < radius[:, None] + radius
        first, second = np.nonzero(np.triu(near, 1))
        apart = np.zeros(len(first), dtype=bool)
        offset = self.centers[second] - self.centers[first]
        for ccd, neighbour in ((first, second), (second, first)):
            away = np.abs(np.stack(self.frame(ccd).along_ccd(*offset.T), axis=-1))
            # Half the other rectangle along the axes of this one.
            turn = np.deg2rad(self.rotation_deg[neighbour] - self.rotation_deg[ccd])
            cosine, sine = np.abs(np.cos(turn)), np.abs(np.sin(turn))
            a, b = self.half_sizes[neighbour].T
            across = np.stack([cosine * a + sine * b, sine * a + cosine * b], axis=-1)
            apart |= (away > self.half_sizes[ccd] + across - _TOUCHING).any(axis=1)
        if not apart.all():
            i = int(np.flatnonzero(~apart)[0])
            first_name, second_name = self.ccd_names[first[i]], self.ccd_names[second[i]]
            raise DomainError(
                f"camera {self.name}: CCDs {first_name} and {second_name} overlap: expected them beside each other"
            )


def _directions(angles_deg: np.ndarray) -> np.ndarray:
    """Return cosine and sine of angles [deg], shape [2, ...]; exact for quarter turns."""
    quarters = np.round(angles_deg / 90.0).astype(np.int64)
    remainder = np.deg2rad(angles_deg - 90.0 * quarters)
    cosine, sine = _QUARTER_COSINES[quarters % 4], _QUARTER_COSINES[(quarters - 1) % 4]
    c, s = np.cos(remainder), np.sin(remainder)
    return np.stack([cosine * c - sine * s, sine * c + cosine * s])
