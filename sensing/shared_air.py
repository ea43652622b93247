"""The part of the air of an exposure that all its donuts share, by the layers of a site."""

from __future__ import annotations

import numpy as np

from ..models.site import Site
from ..models.telescope import Telescope

#: Distance of two beams in a layer over the diameter of the pupil, up to which they have the layer's air in common.
_COMMON = 0.5
#: Least speed of the wind [m/s]: slower air stays in front of the pupil.
_LEAST_SPEED = 1.0
#: Least and greatest part, whatever the layers are: fits need a part of either kind.
_BOUNDS = (0.05, 0.95)
#: Standard deviation of the logarithm of that part over the other, about that of a site's mean winds: with winds of 0
#: to 20 m/s in each of six layers, two thirds of the seeing on the ground, exposures share 0.25 to 0.9.
SHARED_SPREAD = 1.5


def shared_air(telescope: Telescope, site: Site) -> float:
    """Return the part of the variance of the air's mean wavefront that donuts half a field apart share.

    The mean wavefront of an exposure in which a layer drifts much farther than the pupil is wide has a variance in
    proportion to the layer's weight over the speed of its wind, as many independent pieces pass: layers on the ground,
    where the wind is slow, count for more than their part of the seeing (0.80 for 0.65 at Cerro Pachon).
    """
    variance = np.array(site.weights) / np.maximum(site.wind_speeds, _LEAST_SPEED)
    apart = np.array(site.altitudes) * telescope.field_radius
    shared = variance[apart <= _COMMON * telescope.pupil_diameter].sum() / variance.sum()
    return float(np.clip(shared, *_BOUNDS))
