"""Packets of the PSF kernels: ``LANES`` pupil points side by side, in single precision."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

#: Pupil points in one packet.
LANES = 16

samples = wp.types.vector(LANES, wp.float32)
indices = wp.types.vector(LANES, wp.int32)


def to_packets(values: np.ndarray, dtype: Any, fill: str = "edge") -> np.ndarray:
    """Return values [..., n], one per pupil point, as whole packets [..., n_packet, LANES], contiguous.

    The last packet is filled up with copies of the last value (``"edge"``) or with zeros (``"constant"``).
    """
    padding_count = -values.shape[-1] % LANES
    padding = [(0, 0)] * (values.ndim - 1) + [(0, padding_count)]
    filled = np.pad(values.astype(dtype), padding, mode=fill)  # type: ignore[call-overload]
    return np.ascontiguousarray(filled.reshape(*values.shape[:-1], -1, LANES))
