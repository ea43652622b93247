"""Cubic Hermite basis of bicubic interpolation, for NumPy arrays and for kernels alike.

Within a cell, at 0 <= t <= 1 of its length, a cubic with values z0, z1 and slopes m0, m1 [per cell] at both ends is
``z0 + up (z1 - z0) + start m0 + end m1``. The functions return the weights ``up``, ``start``, ``end`` and their
derivatives. They take ``one`` in the type of ``t``, so that the kernels compile the same source.
"""

from __future__ import annotations

from typing import Any


def hermite(t: Any, one: Any) -> Any:
    """Return the weights of the rise and of the slopes at both ends."""
    two = one + one
    return t * t * (two + one - two * t), t * (one - t) * (one - t), t * t * (t - one)


def hermite_slope(t: Any, one: Any) -> Any:
    """Return the first derivatives of the weights."""
    two = one + one
    three = two + one
    return (three + three) * t * (one - t), (one - t) * (one - three * t), t * (three * t - two)


def hermite_curvature(t: Any, one: Any) -> Any:
    """Return the second derivatives of the weights."""
    two = one + one
    six = two + two + two
    return six - (six + six) * t, six * t - (two + two), six * t - two
