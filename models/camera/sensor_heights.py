"""Measured heights of named sensors, and their place on a camera.

Positions and heights are in the telescope frame: heights are positive along +z, the direction of the light at the
detector.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.units import plane_points
from .camera import Camera
from .ccd_surfaces import CcdSurfaces
from .zernike_surfaces import ZernikeSurfaces


@dataclass(frozen=True, eq=False)
class SensorHeights:
    """Zernike coefficients of the heights of `n` sensors."""

    names: tuple[str, ...]
    center: np.ndarray  #: centre of the Zernike circle (x, y) [m], [n, 2]
    surfaces: ZernikeSurfaces  #: about the centre of the circle

    def on(self, camera: Camera) -> tuple[CcdSurfaces, np.ndarray]:
        """Return the height functions of a camera's CCDs, zero where there are none, and which have one [n_ccd] bool.

        Raises
        ------
        DomainError
            If no sensor is a CCD of the camera, one does not stand where the camera has it, or is turned by another
            angle than quarters.
        """
        index = {name: i for i, name in enumerate(self.names)}
        measured = np.array([name in index for name in camera.ccd_names])
        if not measured.any():
            raise DomainError(
                f"none of {len(self.names)} sensors is a CCD of {camera.name}: expected names such as "
                f"{camera.ccd_names[0]}"
            )
        rows = np.array([index[name] for name in camera.ccd_names if name in index])
        offset = self.center[rows] - camera.centers[measured]
        for name, off, center in zip(np.array(camera.ccd_names)[measured], offset, self.center[rows], strict=True):
            if (np.abs(off) > camera.half_sizes[camera.ccd_index(name)].min()).any():
                x, y = 1e3 * (center - off)
                raise DomainError(
                    f"{name} at (x, y) = ({1e3 * center[0]:.2f}, {1e3 * center[1]:.2f}) mm of the telescope frame: "
                    f"expected ({x:.2f}, {y:.2f}) mm as in {camera.name}; is the frame of the file right?"
                )
        quarters = np.rint(camera.rotation_deg / 90.0).astype(np.int64)
        oblique = np.flatnonzero(measured & (camera.rotation_deg != 90.0 * quarters))
        if oblique.size:
            i = oblique[0]
            raise DomainError(
                f"{camera.ccd_names[i]}: rotation_deg = {camera.rotation_deg[i]:g}: expected a multiple of 90 for "
                "Zernike coefficients; measured points are fitted at any angle"
            )
        n, sensor_surfaces = len(camera), self.surfaces.chosen(rows).turned(quarters[measured])
        radius, origin = camera.half_sizes[:, 0].copy(), np.zeros((n, 2))
        coefficients = np.zeros((n, *sensor_surfaces.coefficients.shape[1:]))
        limits = np.stack([-camera.half_sizes, camera.half_sizes], axis=-1)
        radius[measured] = sensor_surfaces.radius
        origin[measured] = np.stack(camera.frame(np.flatnonzero(measured)).along_ccd(*offset.T), axis=1)
        coefficients[measured], limits[measured] = sensor_surfaces.coefficients, sensor_surfaces.limits
        zernikes = ZernikeSurfaces(radius, origin, coefficients, limits)
        return CcdSurfaces(camera.half_sizes, np.zeros((n, 10)), np.zeros((n, 2, 4)), zernikes=zernikes), measured


@dataclass(frozen=True, eq=False)
class CornerSensor:
    """Wavefront sensor or guider in a corner of the focal plane."""

    name: str  #: such as R00_SW0; SW0 stands behind the focus, SW1 in front of it
    kind: str  #: "wavefront" or "guider"
    center: tuple[float, float]  #: x, y [m]
    half_size: tuple[float, float]  #: half its measured sides along x and y [m]
    surface: ZernikeSurfaces  #: height function, of one sensor

    @property
    def raft(self) -> str:
        """Name of the raft."""
        return self.name.split("_")[0]

    @check_arguments
    def height(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Return the height [m] at positions on the focal plane [m], positive along +z; NaN off the measured sides."""
        px, py = plane_points(x, y)
        dx, dy = px - self.center[0], py - self.center[1]
        first = np.zeros(dx.shape, dtype=np.int64)
        inside = self.surface.inside(first, dx, dy)
        out = np.full(dx.shape, np.nan)
        out[inside] = self.surface.height(first[inside], dx[inside], dy[inside])
        return out
