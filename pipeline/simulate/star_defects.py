"""Defects of simulated stars: neighbours, cosmic rays, saturated cores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...measure.star_selection import StarFlag


@check_arguments
@dataclass(frozen=True)
class StarDefects:
    """Defects of simulated stars, for :func:`~pachon.draw_donuts`.

    Attributes
    ----------
    second_stars : float
        Fraction of the stars with a second one of 0.1 to 1 times the light on the stamp.
    cosmic_rays : float
        Fraction of the stars crossed by a cosmic ray.

    Raises
    ------
    DomainError
        If a fraction is not from 0 to 1.
    """

    second_stars: float = 0.0
    cosmic_rays: float = 0.0

    def __post_init__(self) -> None:
        for name in ("second_stars", "cosmic_rays"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise DomainError(f"{name} = {getattr(self, name)!r}: expected a fraction from 0 to 1")


def add_defects(
    stamps: Any,
    psf_images: Any,
    rng: np.random.Generator,
    *,
    neighbours: float = 0.0,
    cosmic_rays: float = 0.0,
    full_well: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Inject defects into simulated stars; return [n, ny, nx] images [e-] and :class:`~.StarFlag` bits [n].

    Each star draws the same numbers whatever its defects: a larger fraction adds defects to more stars and leaves the
    others unchanged.

    Parameters
    ----------
    stamps : array
        [n, ny, nx] electrons, sky subtracted, as from :func:`~.observe_stamps`.
    psf_images : array
        [n, ny, nx] noise-free stars of unit sum: the shape of a star's neighbour.
    rng : numpy.random.Generator
        Random stream.
    neighbours : float
        Fraction of the stars with a neighbour of 0.1 to 1 times the star's light, anywhere on the stamp but within 4
        pixels of its centre, with its own photon noise.
    cosmic_rays : float
        Fraction of the stars crossed by a straight track of 2 to 8 pixels of 500 to 5000 electrons each.
    full_well : float, optional
        Electrons at which a pixel saturates.
    """
    images, shapes = (np.array(a, dtype=np.float64) for a in (stamps, psf_images))
    if images.ndim != 3 or images.shape != shapes.shape:
        raise DomainError(
            f"stamps and psf_images have shapes {images.shape} and {shapes.shape}: expected two [n, ny, nx]"
        )
    for name, value in (("neighbours", neighbours), ("cosmic_rays", cosmic_rays)):
        if not 0.0 <= value <= 1.0:
            raise DomainError(f"{name} = {value}: expected a fraction from 0 to 1")
    if full_well is not None and not full_well > 0.0:
        raise DomainError(f"full_well = {full_well}: expected a positive number of electrons")
    count, ny, nx = images.shape
    flags = np.zeros(count, dtype=np.int32)
    for i, star_rng in enumerate(rng.spawn(count)):
        chance, where, ray = star_rng.random(2), star_rng.random((64, 2)), star_rng.random(4)
        if chance[0] < neighbours:
            offsets = (where - 0.5) * (nx - 1, ny - 1)
            dx, dy = offsets[np.hypot(*offsets.T) > 4.0][0]
            light = images[i].sum() * 10.0 ** -ray[0]
            moved = ndimage.shift(shapes[i], (dy, dx), order=3)
            images[i] += star_rng.poisson(np.maximum(light * moved, 0.0))
            flags[i] |= StarFlag.NEIGHBOUR
        if chance[1] < cosmic_rays:
            angle, length = np.pi * ray[1], 2 + int(7 * ray[2])
            along = np.arange(length) - (length - 1) / 2.0
            middle = 2.0 + where[0] * (nx - 5, ny - 5)
            x, y = (
                np.rint(m + along * c).astype(int) for m, c in zip(middle, (np.cos(angle), np.sin(angle)), strict=True)
            )
            inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
            images[i, y[inside], x[inside]] += 500.0 * 10.0 ** ray[3]
            flags[i] |= StarFlag.COSMIC_RAY
        if full_well is not None and (images[i] > full_well).any():
            images[i] = np.minimum(images[i], full_well)
            flags[i] |= StarFlag.SATURATED
    return images, flags
