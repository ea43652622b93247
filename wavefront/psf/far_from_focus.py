"""Stars far from focus: size of their images, and sampling of their pupils.

A pupil point stands for the light of the pupil around it. In focus all rays land together, and some hundred points are
enough; 1.5 mm from focus they would make a ring of dots. How far apart the rays of neighbouring points land follows
from the traced rays of the star itself, so its sampling, like its image, does not depend on other stars.
"""

from __future__ import annotations

import numpy as np

from ...core.errors import DomainError
from ...core.units import ARCSEC
from ..atmosphere.turbulence import fried_parameter
from ..pupil_optics import PupilOptics
from .image_plane import ImagePlane

#: Largest part of the light of the optics alone that may fall beside a stamp.
LARGEST_LOSS = 0.05
# Bend of waves across strips along rims [rad] from which on sums over strips lack something, and path over the pupil
# [wavelengths] up to which the lattice is quicker than rays: images of 1.2 to 3.5 m telescopes whose waves bend by 1 to
# 20 were wrong by 0.5 to 2.5 % of the peak. The LSST's bend by 0.05 in focus, by 1.1 with 140 waves at 0.3 mm.
_LARGEST_BEND = 1.0
_MOST_WAVES = 100.0
# Highest term of landing points along spokes with stopped rays [rad], up to which these are as good as others. The
# LSST's and DECam's are below 0.015 arcsec. With 0.04 e of a corrector like HSC's is wrong by 7e-4, with 0.3 by 0.014.
_ASTRAY = 0.025 * ARCSEC


def blur_radii(optics: PupilOptics) -> np.ndarray:
    """Return the rms distance of a star's rays from its reference point [m], 0 for a dark star, shape [n_star]."""
    x, y = (optics.displacement[..., axis].astype(np.float64) for axis in (0, 1))
    square = x**2 + y**2
    total = np.sum(square, axis=(1, 2), where=optics.lit)
    return np.asarray(np.sqrt(total / np.maximum(optics.lit.sum(axis=(1, 2)), 1)))


def bent_across_strips(optics: PupilOptics, focal_length: float, diameter: float, r0: float) -> np.ndarray:
    """Return which stars have waves that bend across strips along the rims, and not too many for a lattice, [n_star].

    Strips are a Fried parameter wide, and their sums have the slope of the wave. ``r0`` is that of 500 nm; all in
    metres.
    """
    longest, blur = float(optics.wavelengths.max()), blur_radii(optics) / focal_length
    bend = 4.0 * np.pi * blur / diameter / longest * float(fried_parameter(r0, longest)) ** 2
    return np.asarray((bend > _LARGEST_BEND) & (blur * diameter < _MOST_WAVES * longest))


def stopped_rays_astray(optics: PupilOptics, radius: np.ndarray, focal_length: float) -> np.ndarray:
    """Return which stars have rays that apertures stop, and that would land where no polynomial leads, [n_star].

    Points of the pupil stand on rings of rising radii, ring by ring. Stopped rays may pass a lens far outside of what
    is ground; the polynomials through the rays of a spoke are then none of the light that passes. In metres.
    """
    n_star, middle = len(optics.lit), len(optics.wavelengths) // 2
    node = (2.0 * radius - radius[0] - radius[-1]) / (radius[-1] - radius[0])
    highest = np.linalg.inv(np.polynomial.chebyshev.chebvander(node, len(radius) - 1))[-1]
    places = optics.displacement[:, middle].reshape(n_star, len(radius), -1, 2)
    stopped = ~optics.lit[:, middle].reshape(n_star, len(radius), -1).all(axis=1)
    square = np.where(stopped, (np.einsum("r,srpi->spi", highest, places) ** 2).sum(axis=-1), 0.0)
    # A ray that is lost has no place.
    return ~(square.sum(axis=1) <= (_ASTRAY * focal_length) ** 2 * stopped.sum(axis=1))


def sampling_refinement(optics: PupilOptics, neighbour: float, largest: float, refined: float) -> np.ndarray:
    """Return the refinement of each star's pupil sampling, a power of two, 1 near focus, [n_star].

    Parameters
    ----------
    optics : PupilOptics
        Rays of the stars.
    neighbour : float
        Distance of neighbouring points over the radius of the pupil.
    largest, refined : float
        Distance of the rays of neighbouring points [m] from which on a star counts as far from focus, and that which
        its rays then have at most.
    """
    distance = neighbour * blur_radii(optics)
    power = np.ceil(np.log2(np.maximum(distance / refined, 1.0))).astype(np.int64)
    return np.where(distance > largest, 2**power, 1)


def check_stamp(optics: PupilOptics, plane: ImagePlane) -> None:
    """Raise a DomainError if rays of a star fall beside its stamp, where engines alias or lose light."""
    half = 0.5 * plane.side
    far = np.abs(optics.displacement) > half
    if not far.any():
        return
    beside = far.any(axis=-1) & optics.lit
    lit = optics.lit.sum(axis=(1, 2))
    lost = beside.sum(axis=(1, 2)) / np.maximum(lit, 1)
    if (lost > LARGEST_LOSS).any():
        star = int(np.argmax(lost))
        reach = np.max(np.abs(optics.displacement[star]), where=optics.lit[star, ..., None], initial=0.0)
        needed = 2 * int(np.ceil(1.1 * reach / plane.pixel_size)) + 1
        x, y = np.rad2deg(optics.fields[star])
        raise DomainError(
            f"stamps: size = {plane.size} (psf.stamp of a configuration): {100.0 * lost[star]:.0f} % of the light of "
            f"the star at field ({x:.4g}, {y:.4g}) deg falls beside the stamp; expected at least "
            f"{needed} pixels, or a telescope in focus (pachon focus)"
        )
