"""NumPy arrays as Warp arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from .launch import start_warp


def warp_array(values: Any, dtype: Any = wp.float64, device: str = "cpu") -> wp.array:
    """Wrap values for a kernel, without a copy where their type, order and device allow it.

    Complex numbers become pairs. For a vector or matrix type the last axes are its components.
    """
    start_warp()
    values = np.asarray(values)
    if np.iscomplexobj(values):
        values = np.ascontiguousarray(values)
        values = values.view(values.real.dtype).reshape(*values.shape, 2)
    scalar = wp.dtype_to_numpy(getattr(dtype, "_wp_scalar_type_", dtype))
    return wp.array(np.ascontiguousarray(values, dtype=scalar), dtype=dtype, device=device, copy=False)
