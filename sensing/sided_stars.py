"""Sides of focus of the donuts of an exposure, by how smooth their wavefronts are over the field."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from ..core.units import radians
from ..models.zernike_polynomials import annular_zernikes, noll_to_nm
from .fit_star import StarFit
from .flags import DonutFlag
from .hierarchy import Basis, Observations, fit_hierarchy, star_numbers
from .light import Instrument
from .sides import SideFit, decide_sides
from .star_errors import exposure_air

#: Terms over the field: up to the second degree.
FIELD_NOLL = tuple(range(1, 7))
#: Distance within which donuts on both sides of focus are of one star, if no names are given [rad]: 36 arcsec.
SAME_STAR = np.deg2rad(0.01)


def sided_stars(
    instrument: Instrument,
    stars: Sequence[StarFit],
    fields: np.ndarray,
    numbers: np.ndarray | None = None,
    field_noll: Iterable[int] = FIELD_NOLL,
) -> list[StarFit]:
    """Return stars with flags by the side of focus that all of them together say.

    Parameters
    ----------
    instrument : Instrument
        Telescope and model of the images.
    stars : sequence of n StarFit
        The stars, each fitted by itself.
    fields : ndarray, shape [n, 2]
        Their field angles [rad].
    numbers : ndarray of int, shape [n], optional
        Numbers of the stars, the same for donuts of one star; by default those within 36 arcsec are of one.
    field_noll : iterable of int
        Noll indices of the terms over the field that a telescope's wavefront has.
    """
    number = star_numbers(fields, SAME_STAR) if numbers is None else numbers
    air = exposure_air(instrument)

    def smoothness(index: np.ndarray, fits: Sequence[SideFit]) -> float:
        star = number[index]
        observations = Observations(
            np.array([fit.zernikes for fit in fits]),
            np.array([fit.covariance for fit in fits]),
            star,
            np.zeros(len(star), dtype=np.int64),
        )
        basis = field_basis(instrument, fields[index], field_noll)
        return fit_hierarchy(observations, basis, air).loss

    decision = decide_sides([star.sides for star in stars], smoothness)
    changed = []
    for star, wrong, decided in zip(stars, decision.wrong, decision.decided, strict=True):
        if wrong:
            changed.append(StarFit(DonutFlag.DEFOCUS_SIGN, sides=star.sides))
        else:
            changed.append(replace(star, flags=star.flags & ~DonutFlag.AMBIGUOUS_SIDE) if decided else star)
    return changed


def field_basis(instrument: Instrument, fields: np.ndarray, field_noll: Iterable[int]) -> Basis:
    """Return double Zernikes at fields [rad], term by term over the field."""
    over, noll = np.array(tuple(field_noll)), instrument.terms.requested
    places = radians(fields, "fields").T / instrument.telescope.field_radius
    over_field = annular_zernikes(int(over.max()), *places)[over - 1].T
    columns = np.einsum("ik,ab->iakb", over_field, np.eye(len(noll))).reshape(len(fields), len(noll), -1)
    field_degree, pupil_degree = (np.array([noll_to_nm(int(j))[0] for j in js]) for js in (over, noll))
    return Basis(columns, np.repeat(field_degree, len(noll)), np.tile(pupil_degree, len(over)))
