"""Inner rim of the pupil as the apertures of the telescope define it.

Off the axis the hole of a mirror stands aside from that of the pupil, which lies in another plane: by 8 mm at 1.64
degrees of the LSST. A ring that ends at the pupil's own hole has a dark crescent there, which a fit of a donut takes
for 30 nm of astigmatism.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..pupil_optics import PupilOptics

#: Width of the ring within the pupil's inner rim that is traced too, over the outer radius.
_WITHIN = 0.01


def traced_obscuration(obscuration: float) -> float:
    """Return the linear obscuration of the points to trace for a pupil of a linear obscuration."""
    return max(obscuration - _WITHIN, 0.0)


def clipped_by_apertures(optics: PupilOptics, points: np.ndarray, inner_radius: float) -> PupilOptics:
    """Return optics whose lit points [n, 2] end at the apertures or, without any, at an inner radius [m]."""
    within = np.hypot(*points.T) < inner_radius
    unbounded = np.all(optics.lit[:, :, within], axis=2, keepdims=True)
    return replace(optics, lit=optics.lit & ~(unbounded & within))
