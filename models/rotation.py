"""Rotations as matrices and as three angles."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..core.units import radians

#: Cosine of the rotation about y below which those about x and z are about the same line.
_SAME_LINE = 1e-15


def rotation_matrix(tilt: ArrayLike) -> np.ndarray:
    """Return Rx @ Ry @ Rz, shape (3, 3), of angles [rad] about x, the new y and the new z, as in Zemax."""
    rx, ry, rz = radians(tilt, "tilt")
    cx, cy, cz = np.cos((rx, ry, rz))
    sx, sy, sz = np.sin((rx, ry, rz))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_x @ about_y @ about_z


def rotation_angles(matrix: np.ndarray) -> tuple[float, float, float]:
    """Return the angles [rad] of a rotation matrix, about x, the new y and the new z."""
    along = math.hypot(matrix[0, 0], matrix[0, 1])
    if along < _SAME_LINE:
        # About y by a right angle, x and z turn about the same line: one of them does.
        return math.atan2(matrix[2, 1], matrix[1, 1]), math.atan2(matrix[0, 2], along), 0.0
    about_x = math.atan2(-matrix[1, 2], matrix[2, 2])
    # What is left without the first rotation: near a right angle the others make up for its rounding.
    about_y_z = rotation_matrix((-about_x, 0.0, 0.0)) @ matrix
    return about_x, math.atan2(about_y_z[0, 2], about_y_z[2, 2]), math.atan2(about_y_z[1, 0], about_y_z[1, 1])
