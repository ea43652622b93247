"""Angle of the rotator from what lists have: rotTelPos, or the angle of the camera on the sky, of either convention.

With q the position angle of the zenith, the angle on the sky is

    rotSkyPos = q - rotTelPos - 90 deg       rubin_scheduler and ConsDB with LSSTCam
    rotSkyPos = q - rotTelPos                ComCam
    rotSkyPos = rotTelPos - q                imSim's first lists
"""

from __future__ import annotations

import numpy as np

from ...core.number_text import counted
from .list_columns import ListColumns

#: Largest typical difference with which a list follows a convention [rad]: q of schedulers lacks precession.
_TOLERANCE = np.deg2rad(2.0)
_QUARTER = 0.5 * np.pi
# Camera with a convention of its own.
_COMCAM = "comcam"


def wrapped(angles: np.ndarray) -> np.ndarray:
    """Return angles [rad] from -pi to pi."""
    return np.asarray((np.asarray(angles) + np.pi) % (2.0 * np.pi) - np.pi)


def conventions(rotator: np.ndarray, zenith: np.ndarray) -> dict[str, np.ndarray]:
    """Return the angle of the camera on the sky [rad] by each convention."""
    return {
        "q - rotTelPos - 90 deg (LSSTCam)": zenith - rotator - _QUARTER,
        "q - rotTelPos (ComCam)": zenith - rotator,
        "rotTelPos - q (imSim's first lists)": rotator - zenith,
    }


def sky_rotations(rotator: np.ndarray, zenith: np.ndarray, camera: str) -> np.ndarray:
    """Return the angles of a camera on the sky [rad], rotSkyPos by the convention of the camera, -pi to pi."""
    return wrapped(zenith - rotator - (0.0 if camera == _COMCAM else _QUARTER))


def rotator_angles(columns: ListColumns, zenith: np.ndarray, camera: str) -> np.ndarray:
    """Return the angles of the rotator [rad], -pi to pi; remarks say by which convention the list has those on the sky.

    Where a visit has no rotTelPos they follow from rotSkyPos by the convention of the camera. A list that states the
    position angle of the telescope may have neither: its camera stands still.
    """
    sky = columns.numbers("sky_rotation")
    if "rotator" in columns.values:
        rotator = columns.numbers("rotator")
        from_sky = np.isnan(rotator) & np.isfinite(sky)
        columns.rows(~from_sky).complete("rotator", _is_angle, "a finite angle")
        both = np.where(from_sky, np.nan, sky)
        if np.isfinite(both).any():
            columns.remarks.append(_agreement(rotator, both, zenith))
    elif "roll" in columns.values and "sky_rotation" not in columns.values:
        return np.zeros(len(columns))
    else:
        columns.require("rotator", "sky_rotation")
        rotator, from_sky = np.zeros(len(columns)), np.ones(len(columns), dtype=bool)
    if not from_sky.any():
        return wrapped(rotator)
    columns.rows(from_sky).complete("sky_rotation", _is_angle, "a finite angle")
    is_comcam = camera == _COMCAM
    formula = "q - rotSkyPos" if is_comcam else "q - rotSkyPos - 90 deg"
    extent = "" if from_sky.all() else f"{from_sky.sum()} of {counted(len(columns), 'visit has', 'visits have')} "
    columns.remarks.append(f"{extent}no rotTelPos: it is {formula}, as of {'ComCam' if is_comcam else 'LSSTCam'}")
    # Angles on the sky and of the rotator follow from each other in the same way.
    return np.where(from_sky, sky_rotations(sky, zenith, camera), wrapped(rotator))


def _is_angle(angle: np.ndarray) -> np.ndarray:
    """Return whether angles [rad] are of at most two turns."""
    return np.asarray(np.abs(angle) <= 4.0 * np.pi)


def _agreement(rotator: np.ndarray, sky: np.ndarray, zenith: np.ndarray) -> str:
    """Return the line that says which convention the angles on the sky follow."""
    listed = np.isfinite(sky)
    residuals = {
        name: float(np.median(np.abs(wrapped(sky - angle)[listed])))
        for name, angle in conventions(rotator, zenith).items()
    }
    name, least = min(residuals.items(), key=lambda item: item[1])
    degrees = f"{np.rad2deg(least):.2g} deg"
    if least <= _TOLERANCE:
        return f"rotSkyPos is {name}, within {degrees} (median); rotTelPos is taken"
    return f"rotSkyPos follows no convention, {name} within {degrees} (median) at best; rotTelPos is taken"
