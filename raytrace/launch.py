"""Launch of rays from field points through points of the entrance pupil, or aimed at points of the stop."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.buffers import empty
from ..core.units import angle
from ..models.design_data import Aiming
from ..models.telescope import Telescope
from .aiming import entrance_points, require_aimed
from .rays import Projection, Rays, check_wavelength, field_direction, pupil_points, straight_bundles


@check_arguments
def launch_rays(
    telescope: Telescope,
    field: tuple[ArrayLike, ArrayLike],
    wavelength: ArrayLike,
    pupil: tuple[ArrayLike, ArrayLike],
    projection: Projection = "zemax",
    aiming: Aiming | None = None,
) -> Rays:
    """Launch a plane wave from one field point through given points of the entrance pupil.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    field : (tx, ty)
        Field angles [rad]; see :func:`field_direction`.
    wavelength : float or Quantity
        Vacuum wavelength [m].
    pupil : (px, py)
        Entrance-pupil coordinates [m], arrays of one shape (flattened): points of the plane z = ``telescope.stop_z``
        that the rays pass through.
    projection : str
        Meaning of the field angles.
    aiming : {"off", "paraxial", "real"}, optional
        Ray aiming at the stop, see :class:`~pachon.models.DesignData`; by default as the design data of the telescope
        say.

    Returns
    -------
    Rays
        Rays in phase: they start on one plane perpendicular to their direction, before the first surface, or at one
        point of the object where that is at a finite distance.

    Raises
    ------
    DomainError
        If the field or the wavelength lies outside what the telescope covers, or no ray of the field can be aimed.
    PrescriptionError
        If the aiming is unknown, or rays are to be aimed and the telescope has no stop.
    """
    if aiming is not None:
        telescope = telescope.with_design(aiming=aiming)
    tx, ty = angle(field[0], "field x"), angle(field[1], "field y")
    telescope.check_field(tx, ty)
    wavelength = check_wavelength(wavelength)
    telescope.check_wavelength(wavelength)
    px, py = pupil_points(pupil)
    # Transposed, not copied: the components stay contiguous, as the kernels read them.
    points = np.stack([px.ravel(), py.ravel()], out=empty((2, px.size))).T
    return launch_bundles(telescope, field_direction(tx, ty, projection)[None], wavelength, points)


def aimed_points(telescope: Telescope, directions: np.ndarray, wavelength: float, pupil: np.ndarray) -> np.ndarray:
    """Return :func:`~pachon.raytrace.aiming.entrance_points`; DomainError if no ray of a direction can be aimed."""
    points = entrance_points(telescope, directions, wavelength, pupil)
    require_aimed(telescope, directions, points)
    return points


def launch_bundles(telescope: Telescope, directions: np.ndarray, wavelength: float, pupil: np.ndarray) -> Rays:
    """Launch the light of several field points, at any distance, through points of the entrance pupil.

    As :func:`~pachon.raytrace.rays.straight_bundles`, but aimed at the stop where the design data of the telescope say
    so, and with parallel chief rays in a telecentric object space. DomainError if a chief ray cannot be aimed.
    """
    points = aimed_points(telescope, directions, wavelength, pupil)
    return straight_bundles(telescope, directions, wavelength, points)
