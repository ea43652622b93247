"""Table of the rims and spiders that stand elsewhere than the prescription of the telescope has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from astropy import units as u
from astropy.table import QTable

from .light import Instrument, StarLight
from .likelihood import Stamp
from .moving_rims import PupilShadows, RimBody, RimLines, steps_of_bounding
from .rim_outlines import MOTIONS, RimMotion
from .star_fitter import StarSolution

_MEANINGS = {
    "donut": "number of the donut, from 0",
    "rim": "surfaces whose rims moved together, or spider",
    "outward": "mean shift across the rim on its surface, where it bounds the light, towards more light",
    "pixels": "root mean square shift of the image of the rim across itself, with the sign of outward",
    "x": "shift along x of the surface",
    "y": "shift along y of the surface",
    "growth": "offset along the outward normal of a disc, or of each side of an obstacle",
    "rotation": "turn about the origin of the surface, from x towards y",
}


@dataclass(frozen=True, eq=False)
class MovedRim:
    """A rim of one donut, and where it stands.

    Attributes
    ----------
    name : str
        Surfaces that have it.
    values, errors : ndarray, shape [4]
        Motions in the order of :class:`~pachon.sensing.rim_outlines.RimMotion`, and their standard deviations.
    outward : tuple of float
        Mean shift across the rim on its surface towards more light, and its standard deviation [m].
    pixels : tuple of float
        Root mean square shift of the image of the rim across itself, and its standard deviation [pixels].
    moved : bool
        Whether it may stand elsewhere, and does not only have another size.
    """

    name: str
    values: np.ndarray
    errors: np.ndarray
    outward: tuple[float, float]
    pixels: tuple[float, float]
    moved: bool


def moved_rims(instrument: Instrument, star: StarSolution) -> list[MovedRim]:
    """Return the rims that are free in the fit of a star."""
    light = star.light
    first = len(instrument.noll) + light.before_free_rims
    free = slice(first, first + len(light.free_rims))
    steps = steps_of_bounding(star.stamp.rays.rates[:, light.before_free_rims :], star.solution.shared[free])
    covariance = star.solution.shared_covariance[free, free]
    return rims_at(instrument, light, star.stamp, steps, covariance)


def rims_at(
    instrument: Instrument, light: StarLight, stamp: Stamp, steps: np.ndarray, step_covariance: np.ndarray
) -> list[MovedRim]:
    """Return the free rims of the light of a star after steps of their free motions, with their covariance.

    Those that do not bound the light, neither where they stand nor where they are believed to, are left out.
    """
    rims = light.free_rims
    if not rims.bodies:
        return []
    values, free = rims.values.copy(), rims.free
    values[free] += steps
    covariance = np.zeros((values.size, values.size))
    places = np.flatnonzero(free.ravel())
    covariance[np.ix_(places, places)] = step_covariance
    cells = stamp.rays.cells
    standing, believed = (
        PupilShadows(telescope, light.direction, instrument.middle, cells).lines(rims.bodies)
        for telescope in (light.telescope, light.prescribed or light.telescope)
    )
    pixels = np.sqrt(abs(float(np.linalg.det(stamp.grid.footprint)))) / cells.side / instrument.pixel
    moved = []
    for k, body in enumerate(rims.bodies):
        lines = standing if (standing.body == k).any() else believed
        if not (lines.body == k).any():
            continue
        block = slice(MOTIONS * k, MOTIONS * (k + 1))
        name = _name(light.telescope.surface_names, body)
        moved.append(_moved_rim(name, body, values[k], covariance[block, block], lines, k, pixels))
    return moved


def _moved_rim(
    name: str,
    body: RimBody,
    values: np.ndarray,
    covariance: np.ndarray,
    lines: RimLines,
    number: int,
    pixels: float,
) -> MovedRim:
    """Return a rim by its motions and their covariance; ``pixels`` are those of a metre of the pupil."""
    pieces = lines.body == number
    weight = lines.lengths[pieces] / max(float(lines.lengths[pieces].sum()), 1e-300)
    across, outward = weight @ lines.outward[pieces], pixels * lines.across[pieces]
    square = (outward * weight[:, None]).T @ outward
    mean = float(across @ values)
    size = float(np.sqrt(values @ square @ values))
    slope = square @ values / max(size, 1e-300)
    return MovedRim(
        name,
        values,
        np.sqrt(np.diag(covariance)),
        (mean, float(np.sqrt(across @ covariance @ across))),
        (float(np.copysign(size, mean)), float(np.sqrt(slope @ covariance @ slope))),
        body.moved,
    )


def _name(surfaces: tuple[str, ...], body: RimBody) -> str:
    names = list(dict.fromkeys(surfaces[surface] for surface, _ in body.members))
    return ("spider: " if body.spider else "") + ", ".join(names)


def rim_table(moved: Mapping[int, list[MovedRim]]) -> QTable:
    """Return the table of the rims of donuts, by the number of the donut."""
    rows = [(donut, rim) for donut, rims in moved.items() for rim in rims]
    table = QTable()
    table["donut"] = np.array([donut for donut, _ in rows], dtype=np.int64)
    table["rim"] = np.array([rim.name for _, rim in rows], dtype=str)
    for name, unit in (("outward", u.mm), ("pixels", u.pix)):
        pairs = np.array([getattr(rim, name) for _, rim in rows]).reshape(-1, 2)
        pairs = pairs * (1e3 if unit == u.mm else 1.0)
        table[name], table[f"{name}_err"] = pairs.T * unit
    for k, name in enumerate(RimMotion._fields):
        scale, unit = (np.rad2deg(1.0), u.deg) if name == "rotation" else (1e3, u.mm)
        table[name] = np.array([rim.values[k] for _, rim in rows]) * scale * unit
        table[f"{name}_err"] = np.array([rim.errors[k] for _, rim in rows]) * scale * unit
    for column in table.colnames:
        meaning = _MEANINGS[column.removesuffix("_err")]
        table[column].info.description = f"standard error of {column[:-4]}" if column.endswith("_err") else meaning
    return table
