"""Stamps of stars: pixels and silicon of the detector, jitter, and the places of the stars on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...models.camera.camera import Camera
from ...models.camera.cameras import load_camera
from ...models.camera.silicon import Silicon
from .image_plane import ImagePlane

#: Pixels of the LSST [m].
_PIXEL = 10e-6
#: Rms charge diffusion in them [m].
_DIFFUSION = 4e-6


@check_arguments
@dataclass(frozen=True, eq=False)
class Stamps:
    """Stamps on which :func:`~pachon.make_psfs` draws stars.

    Attributes
    ----------
    size : int
        Pixels on a side of a stamp, 3 to 4096.
    pixel_size : float
        Side of a pixel [m].
    diffusion : float
        Root mean square of the charge diffusion along each axis [m]; in silicon that of charge from the surface, and
        less from deeper down.
    jitter : float
        Root mean square of the telescope's pointing along each axis during the exposure [rad]: a Gaussian blur, the
        same for all stars.
    silicon : Silicon, optional
        Silicon of the CCDs, in which light turns into charge below the surface, and some of it not at all; by default
        all of it does so at the surface.
    offsets : array_like, shape [n_star, 2], optional
        Place of each star (x, y) on its stamp, from the centre of the middle pixel [pixels]; 0 by default.
    recenter : callable, optional
        Centroids of stamps: given images [n, ny, nx] and the angle of a pixel [rad], it returns places (x, y) from the
        centre of the middle pixel [pixels], shape [n, 2]. Each star is then drawn once more, with its centroid at the
        centre. That is exact, unlike a shift of the pixels, and costs little.
    room : int
        Pixels of a side that will be cut off, around the middle ones: long exposures and the statistical engine let
        wings that wrap around fall there, which makes them quicker.

    Raises
    ------
    DomainError
        If a number is outside its range.
    """

    size: int = 31
    pixel_size: float = _PIXEL
    diffusion: float = _DIFFUSION
    jitter: float = 0.0
    silicon: Silicon | None = None
    offsets: ArrayLike | None = None
    recenter: Callable[[np.ndarray, float], np.ndarray] | None = None
    room: int = 0

    @classmethod
    def of_camera(
        cls, camera: str | Camera, *, size: int = 31, jitter: float = 0.0, silicon: Silicon | None = None
    ) -> Stamps:
        """Return stamps of the pixels of a camera, with a charge diffusion of 0.4 of them.

        Parameters
        ----------
        camera : str or Camera
            The camera.
        size, jitter, silicon
            As in the class.
        """
        pixel = load_camera(camera).pixel_size
        return cls(size, pixel, _DIFFUSION * (pixel / _PIXEL), jitter, silicon)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.jitter) and self.jitter >= 0.0):
            raise DomainError(f"jitter = {self.jitter:g}: expected an angle in radians from 0")
        self.image_plane(0.0)  # checks the other numbers

    def image_plane(self, focal_length: float) -> ImagePlane:
        """Return the detector behind a telescope of a focal length [m], which turns jitter into motion on it."""
        return ImagePlane(self.size, self.pixel_size, self.diffusion, self.jitter * focal_length, self.room)
