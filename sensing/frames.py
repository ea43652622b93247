r"""Frames of an observatory: axes of stamps, field angles, pupils and rigid-body motions.

All are turns or mirror images of the telescope frame, which is the optical coordinate system (OCS) of the Rubin
Observatory and the global frame of batoid: right-handed, +z towards the sky.

=====  ============================================================================================================
frame  axes in the telescope frame
=====  ============================================================================================================
OCS    the telescope frame itself
CCS    turned with the camera: x at the angle of the rotator from +x towards +y
DVCS   axes of LSST's images: x along y of CCS, y along x of CCS; left-handed, for images and field angles
ZCS    the LSST's Zemax model: (-x, y, -z), half a turn about y
sky    x towards east and y towards north, as vectors of the telescope: those of (xi, eta)
=====  ============================================================================================================

Sources: CCS is DVCS transposed, ts_wep (``task/donutStamp.py``); the angle of the rotator is q - (rotation of the sky)
- 90 deg, ts_wep (``estimateZernikesBase.py``) and donut_viz (``aggregate_visit.py``, `rotTelPos`); ZCS, batoid_rubin
(``builder.py``: shifts (-dx, dy, -dz), turns (-rx, ry) of batoid's frame).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, DomainError, shown
from ..core.units import radians
from ..models.telescope import Telescope
from ..models.zernike_polynomials import noll_to_nm
from ..raytrace.rays import Projection

#: Frames by name.
FrameName = Literal["OCS", "CCS", "DVCS", "ZCS", "sky"]
FRAMES: tuple[FrameName, ...] = get_args(FrameName)
#: Axes of stamps that have names of their own: those of the camera and those of images of the LSST.
_NAMED_AXES = {"CCS": "x,y", "DVCS": "y,x"}
#: Unit vectors along the axes of the camera that stamps may run along.
_AXES = {"x": (1.0, 0.0), "y": (0.0, 1.0), "-x": (-1.0, 0.0), "-y": (0.0, -1.0)}
#: Cosine, sine or coupling of two Zernike terms below which it is rounding of a quarter turn.
_ROUNDING = 1e-12
#: Half a turn about y.
_ZCS = np.diag([-1.0, 1.0, -1.0])


@check_arguments
@dataclass(frozen=True)
class DonutFrames:
    """How the camera of an exposure stood, and along which axes its stamps run.

    Attributes
    ----------
    rotator : float or Quantity
        Angle of the camera from +x towards +y of the telescope [rad]; LSST's rotTelPos.
    parallactic_angle : float or Quantity, optional
        Position angle of the telescope's +y, from north through east [rad]: the parallactic angle of an alt-azimuth
        telescope whose +y points to the zenith, as Rubin's. Only the frame ``sky`` needs it.
    stamp_axes : str
        Axes of the camera (CCS) that columns and rows of a stamp run along: ``"x,y"``, ``"y,x"``, ``"-x,y"``...;
        ``"DVCS"`` is short for ``"y,x"``, that of images of the LSST, and ``"CCS"`` for ``"x,y"``.

    Raises
    ------
    ConfigError
        If the axes of stamps are no pair of different axes.
    DomainError
        If an angle is not one finite number.
    """

    rotator: ArrayLike = 0.0
    parallactic_angle: ArrayLike | None = None
    stamp_axes: str = "x,y"

    def __post_init__(self) -> None:
        for name in ("rotator", "parallactic_angle"):
            if (value := getattr(self, name)) is not None:
                angle = radians(value, name)
                if angle.ndim or not np.isfinite(angle):
                    raise DomainError(f"{name} = {shown(value)}: expected one finite angle", key=name)
                object.__setattr__(self, name, float(angle))
        stamp_matrix(self.stamp_axes)

    def axes(self, frame: FrameName) -> np.ndarray:
        """Return unit vectors along x, y, z of a frame in the telescope frame, one a row, shape [3, 3].

        Parameters
        ----------
        frame : {"OCS", "CCS", "DVCS", "ZCS", "sky"}
            The frame.

        Raises
        ------
        ConfigError
            If the frame is unknown, or is that of the sky without a parallactic angle.
        """
        if frame == "ZCS":
            return _ZCS.copy()
        if frame == "OCS":
            return np.eye(3)
        if frame == "sky":
            if self.parallactic_angle is None:
                raise ConfigError("frame = sky without a parallactic angle: expected one", key="parallactic_angle")
            # xi = X cos + Y sin, eta = -X sin + Y cos of the position angle of +y.
            return _turned(self._angle("parallactic_angle"))
        camera = _turned(self._angle("rotator"))
        return camera if frame == "CCS" else camera[[1, 0, 2]]

    def fields_in(self, fields: ArrayLike, frame: FrameName, *, projection: Projection = "zemax") -> np.ndarray:
        """Return field angles of the telescope frame in another frame.

        Parameters
        ----------
        fields : array_like or Quantity, shape [n, 2]
            Field angles of the light's own travel [rad], in the telescope frame.
        frame : {"OCS", "CCS", "DVCS", "ZCS", "sky"}
            The frame.
        projection : {"zemax", "gnomonic", "postel"}
            Meaning of the field angles.

        Returns
        -------
        ndarray, shape [n, 2]
            Field angles along the axes of the frame [rad].
        """
        return _along(self.axes(frame)[:2, :2], fields, projection)

    def fields_of_telescope(
        self, fields: ArrayLike, frame: FrameName, *, projection: Projection = "zemax"
    ) -> np.ndarray:
        """Return field angles in the telescope frame; the inverse of :meth:`fields_in`, with its arguments.

        Parameters
        ----------
        fields : array_like or Quantity, shape [n, 2]
            Field angles of the light's own travel along the axes of the frame [rad].
        frame : {"OCS", "CCS", "DVCS", "ZCS", "sky"}
            The frame.
        projection : {"zemax", "gnomonic", "postel"}
            Meaning of the field angles.

        Returns
        -------
        ndarray, shape [n, 2]
            Field angles in the telescope frame [rad].
        """
        return _along(self.axes(frame)[:2, :2].T, fields, projection)

    def stamps(self, images: Iterable[ArrayLike]) -> list[np.ndarray]:
        """Return stamps along y and x of the camera, for :func:`~pachon.fit_donuts`.

        Parameters
        ----------
        images : iterable of array_like, each of shape [ny, nx]
            Stamps, or masks, along `stamp_axes`.
        """
        matrix = stamp_matrix(self.stamp_axes)
        return [along_camera(np.asarray(image), matrix) for image in images]

    def telescope(self, telescope: Telescope) -> Telescope:
        """Return the telescope with its camera at the angle of the rotator.

        Parameters
        ----------
        telescope : Telescope
            Telescope with the camera at zero.
        """
        angle = self._angle("rotator")
        return telescope.with_rotator(angle) if angle else telescope

    def _angle(self, name: str) -> float:
        return float(radians(getattr(self, name), name))


def stamp_matrix(stamp_axes: str) -> np.ndarray:
    """Return unit vectors along columns and rows of a stamp in the frame of the camera, one a row, shape [2, 2]."""
    names = re.split(r"\s*,\s*", _NAMED_AXES.get(stamp_axes.strip(), stamp_axes.strip()).replace("+", ""))
    if len(names) != 2 or {name.lstrip("-") for name in names} != {"x", "y"} or not set(names) <= set(_AXES):
        raise ConfigError(
            f"stamp_axes = {stamp_axes!r}: expected DVCS, CCS, or axes of columns and rows such as x,y or -y,x",
            key="stamp_axes",
        )
    return np.array([_AXES[name] for name in names])


def stamp_axes_text(matrix: np.ndarray) -> str:
    """Return the axes of a matrix of :func:`stamp_matrix` as text."""
    return ",".join(next(name for name, axis in _AXES.items() if np.allclose(axis, row)) for row in matrix)


def along_camera(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return an image with rows along +y and columns along +x of the camera.

    Parameters
    ----------
    image : ndarray, shape [ny, nx]
        Image of any type.
    matrix : ndarray, shape [2, 2]
        Unit vectors along its columns and rows in the frame of the camera: a turn by quarters, or its mirror image.
    """
    signs = matrix.sum(axis=1)
    transposed = abs(matrix[0, 1]) > 0.5
    # The sign of the columns' axis turns the image about along them.
    flipped = image[:: int(signs[1]), :: int(signs[0])]
    return np.ascontiguousarray(flipped.T if transposed else flipped)


def zernike_matrix(noll: Sequence[int] | np.ndarray, axes: np.ndarray) -> np.ndarray:
    r"""Return the matrix from Zernike coefficients of the telescope frame to those along other axes.

    A point of the pupil at the angle :math:`\theta` lies at :math:`\theta - \alpha`, or of mirrored axes at
    :math:`\alpha - \theta`, of the frame: cosine and sine of one order mix (Tatulli 2013, arXiv:1302.7106).

    Parameters
    ----------
    noll : sequence of int
        Noll indices, of rows and columns.
    axes : ndarray, shape [2, 2]
        Unit vectors along x and y of the frame, one a row.

    Raises
    ------
    DomainError
        If a term mixes with one that is not among them.
    """
    listed = [int(j) for j in noll]
    place = {noll_to_nm(j): k for k, j in enumerate(listed)}
    mirrored = np.linalg.det(axes) < 0.0
    angle = np.arctan2(axes[0, 1], axes[0, 0])
    matrix = np.zeros((len(listed), len(listed)))
    for column, j in enumerate(listed):
        n, m = noll_to_nm(j)
        cosine, sine = np.cos(abs(m) * angle), np.sin(abs(m) * angle)
        if not m:
            matrix[column, column] = 1.0
            continue
        # cos m theta and sin m theta as a cos m theta' + b sin m theta'.
        even, odd = (cosine, -sine) if m > 0 else (sine, cosine)
        for order, value in ((abs(m), even), (-abs(m), -odd if mirrored else odd)):
            if (n, order) in place:
                matrix[place[n, order], column] = value
            elif abs(value) > _ROUNDING:
                raise DomainError(f"Z{j} mixes with its partner of the same order in this frame: expected both of them")
    return matrix


def _turned(angle: float) -> np.ndarray:
    """Return axes turned by an angle from +x towards +y [rad], one a row."""
    # Of quarter turns exactly zero: motions that are not fitted would have errors that are not.
    cosine, sine = (0.0 if abs(value) < _ROUNDING else value for value in (np.cos(angle), np.sin(angle)))
    return np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _along(matrix: np.ndarray, fields: ArrayLike, projection: Projection) -> np.ndarray:
    """Return field angles times a matrix, in the plane where their projection is linear."""
    angles = np.atleast_2d(radians(fields, "fields"))
    if angles.ndim != 2 or angles.shape[1] != 2:
        raise DomainError(f"fields of shape {angles.shape}: expected [n, 2]")
    if projection == "zemax":
        return np.asarray(np.arctan(np.tan(angles) @ matrix.T))
    return np.asarray(angles @ matrix.T)
