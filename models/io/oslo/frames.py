"""Places and rotations of the surfaces of an OSLO file.

Each surface has its local frame within that of the surface before it, a thickness further along z: decentred by DCX,
DCY, DCZ and then rotated by TLA, TLB, TLC about x, the new y and the new z (with DT -1 rotated in the reverse order
first). TLA and TLB are left-handed, TLC is right-handed (OSLO Optics Reference, "Tilted and decentered surfaces"). The
next surface stands in the new frame, or with RCO in that of an earlier surface; BEN repeats the tilt behind a mirror.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ....core.errors import PrescriptionError
from ...rotation import rotation_matrix

Frame = tuple[np.ndarray, np.ndarray]


def surface_frames(surfaces: Sequence[Mapping[str, float]]) -> list[Frame]:
    """Return vertex [lens unit] and axes of each surface from the first behind the object on.

    `surfaces` hold the values of the commands, the object's first; PrescriptionError with the number of the surface
    where a reference is to none before it.
    """
    frames: list[Frame] = []
    #: Frames of the surfaces without their own decentres and tilts.
    bases: list[Frame] = []
    origin, axes = np.zeros(3), np.eye(3)
    for number, values in enumerate(surfaces[1:], start=1):
        if "GC" in values:
            origin, axes = _referenced(frames, values["GC"], number, "GC")
        bases.append((origin, axes))
        shift = np.array([values.get(key, 0.0) for key in ("DCX", "DCY", "DCZ")])
        pivot = np.array([values.get(key, 0.0) for key in ("TOX", "TOY", "TOZ")])
        turn = _tilt(values)
        shift = shift if values.get("DT", 1.0) >= 0 else turn @ shift
        origin, axes = origin + axes @ (shift + pivot - turn @ pivot), axes @ turn
        frames.append((origin, axes))
        if "RCO" in values:
            target = values["RCO"]
            returns_to_itself = target in (0.0, float(number))
            origin, axes = bases[-1] if returns_to_itself else _referenced(frames, target, number, "RCO")
        elif values.get("BEN"):
            axes = axes @ turn
        origin = origin + values.get("TH", 0.0) * axes[:, 2]
    return frames


def _tilt(values: Mapping[str, float]) -> np.ndarray:
    angles = np.radians([-values.get("TLA", 0.0), -values.get("TLB", 0.0), values.get("TLC", 0.0)])
    if values.get("DT", 1.0) >= 0:
        return rotation_matrix(angles)
    x, y, z = (rotation_matrix(np.where(np.arange(3) == axis, angles, 0.0)) for axis in range(3))
    return z @ y @ x


def _referenced(frames: list[Frame], value: float, number: int, key: str) -> Frame:
    """Return the frame of an earlier surface, numbered from the object or, if negative, back from this one."""
    target = int(value) + number if value < 0 else int(value)
    if not 0 < target <= len(frames):
        raise PrescriptionError(f"surface {number}: {key} {value:g}: expected one of the surfaces 1 to {len(frames)}")
    return frames[target - 1]
