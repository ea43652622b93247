"""Focus of a telescope in another band than that of its prescription, as an observatory has it in each band."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from ..models.camera.camera import Camera
from ..models.telescope import Telescope
from ..raytrace.rays import RayStatus, field_direction, parallel_rays
from ..raytrace.spot_parabola import lowest_height, spot_parabola
from ..raytrace.trace import trace
from ..wavefront.chief_rays import fields_at

#: Rings of rays across the pupil; each has six rays more than the one within.
_RINGS = 6
#: Wavelengths that stand for a band by default.
_WAVELENGTHS = 5
#: r of Jee & Tyson (2011) [m].
_BAND_OF_THE_PAPER = (545e-9, 703e-9)
#: CCDs from which on their centres sample the field.
_MANY = 9
#: Shifts below are none [um].
_LEAST_UM = 0.5
#: Cosine of the normal of the detector and an axis of the telescope below which shifts have no part along it.
_LEAST_PART = 1e-3


def wavelengths_of_band(ends: tuple[float, float], *, dispersed: bool = True) -> np.ndarray:
    """Return the wavelengths that stand for a band by default [m]: the middles of equal parts of it.

    From end to end they would have 1.5 times the variance of an even band, and the air would disperse them as much
    more. Jee & Tyson (2011) have theirs from end to end: so has their band where the air does not disperse it.
    """
    if not dispersed and np.allclose(ends, _BAND_OF_THE_PAPER, rtol=1e-9, atol=0.0):
        return np.linspace(*ends, _WAVELENGTHS)
    return np.linspace(*ends, 2 * _WAVELENGTHS + 1)[1::2]


def refocus(
    telescope: Telescope,
    camera: Camera,
    band: tuple[float, float],
    prescribed: tuple[float, float],
    changes: Mapping[str, float],
) -> dict[str, float]:
    """Return the change of a prescription that brings light of another band into focus, by its key.

    The detector moves along its normal to where spots are smallest on all CCDs, by no more than this height differs
    from that of the light of the prescription: mirrors stay as they are. So does a detector that changes move along it
    already.

    Parameters
    ----------
    telescope, camera
        Telescope as prescribed, and its CCDs.
    band, prescribed : (float, float)
        Ends of the band, and of that of the prescription [m].
    changes : mapping
        Changes of the prescription: ``{"Detector.dz_um": 10.0}``.
    """
    detector, normal = telescope.surfaces[-1].name, np.array(telescope.surfaces[-1].rotation)[:, 2]
    # Shifts are along the axes of the telescope; behind a folding mirror the normal is none of its z axis.
    axes = {f"d{axis}": float(part) for axis, part in zip("xyz", normal, strict=True) if abs(part) > _LEAST_PART}
    for key in changes:
        moved, _, motion = key.rpartition(".")
        if motion[:2] in axes and detector in (moved, *telescope.groups.get(moved, ())):
            return {}
    best, before = (_best_focus(telescope, camera, light) for light in (band, prescribed))
    nearest, farthest = sorted((0.0, best - before))
    shift = round(1e6 * float(np.clip(best, nearest, farthest)), 1)
    if not (math.isfinite(shift) and abs(shift) > _LEAST_UM):
        return {}
    return {f"{detector}.{axis}_um": round(shift * part, 3) for axis, part in axes.items()}


@lru_cache(maxsize=16)
def _best_focus(telescope: Telescope, camera: Camera, band: tuple[float, float]) -> float:
    """Return the height above the detector where the spots have the least mean square radius [m]; NaN without light."""
    places = (
        camera.centers
        if len(camera) >= _MANY
        else np.concatenate([camera.centers, *camera.corners(range(len(camera)))])
    )
    fields = fields_at(telescope, places)
    fields = fields[np.hypot(*fields.T) <= telescope.field_radius]
    angles = [2.0 * np.pi * np.arange(6 * ring) / (6 * ring) for ring in range(1, _RINGS + 1)]
    rings = [(ring - 0.5) / _RINGS * np.stack([np.cos(a), np.sin(a)], axis=1) for ring, a in enumerate(angles, start=1)]
    pupil = 0.5 * telescope.pupil_diameter * np.concatenate(rings)
    shape, detector, total = (len(fields), len(pupil)), telescope.surfaces[-1], np.zeros(3)
    for wavelength in wavelengths_of_band(band):
        rays = parallel_rays(telescope, field_direction(*fields.T), float(wavelength), pupil)
        end = trace(telescope, rays)
        light = (end.status == RayStatus.OK).reshape(shape).astype(np.float64)
        travel = detector.along(end.direction)
        place, slope = detector.to_local(end.position)[:, :2], travel[:, :2] / travel[:, 2:]
        lit = light.any(axis=1)
        parabolas = spot_parabola(place.reshape(*shape, 2)[lit], slope.reshape(*shape, 2)[lit], light[lit])
        total += light[lit].sum(axis=1) @ parabolas
    return float(lowest_height(total))
