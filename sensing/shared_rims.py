"""Rims that stand elsewhere, of all donuts of an exposure: they are of one telescope, and so stand in one place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from .donut_rays import ZernikeRays
from .image_model import STRENGTH
from .light import Instrument, StarLight
from .moving_rims import FreeRims, RimBody
from .rim_table import MovedRim, rims_at
from .solve import Group, Solution
from .stamps import Pixels
from .star_fitter import StarSolution

#: Change of the loss by rims elsewhere, in units of that of a pixel, that is more than chance: a gain by which they are
#: free in a joint fit, or a rise by which donuts that do not have them elsewhere by themselves contradict them.
_DECIDES = 25.0
#: Step of the rims over their standard deviations that is small enough to be linear.
_SETTLED = 0.05


def shared_rims(instrument: Instrument, stars: Sequence[StarSolution]) -> FreeRims:
    """Return the rims that are free in the fit of any star by itself, where all of these together have them."""
    first: dict[tuple[tuple[int, int], ...], RimBody] = {}
    for star in stars:
        for body in star.light.free_rims.bodies:
            if body.moved or body.members not in first:
                first[body.members] = body
    rims = FreeRims()
    for body in first.values():
        rims = rims.with_body(body)
    prior = rims.spreads**-2.0
    curvature, gradient = np.diag(prior), np.zeros(len(rims))
    for star in stars:
        star_rims, begin = star.light.free_rims, len(instrument.noll) + star.light.before_free_rims
        free = slice(begin, begin + len(star_rims))
        places = _places(rims, star_rims)
        information = np.linalg.pinv(star.solution.shared_covariance[free, free], hermitian=True)
        values = star_rims.values[star_rims.free] + star.solution.shared[free]
        # The prior of a fit counts once for all of them.
        curvature[np.ix_(places, places)] += information - np.diag(star_rims.spreads**-2.0)
        gradient[places] += information @ values
    return rims.moved(np.linalg.lstsq(curvature, gradient, rcond=1e-12)[0]) if len(rims) else rims


class JointFit(NamedTuple):
    """Stars with the light of some rims, as they are fitted together, and their solution."""

    stars: list[StarSolution]
    group: Group
    solution: Solution
    rims: FreeRims


def least_rims(rims: FreeRims, fitted: Callable[[FreeRims], JointFit]) -> JointFit:
    """Return a joint fit with rims that stars have elsewhere, unless one with these as prescribed is as good.

    What all stars share, such as a camera aside, moves shadows that each star by itself takes for those of rims.
    """
    if not any(body.moved for body in rims.bodies):
        return fitted(rims)
    prescribed, elsewhere = fitted(rims.unmoved()), fitted(rims)
    pixels = sum(int(star.stamp.used.sum()) for star in elsewhere.stars)
    gain = prescribed.solution.loss - elsewhere.solution.loss
    return elsewhere if gain > _DECIDES * max(1.0, elsewhere.solution.loss / pixels) else prescribed


def contradicted(alone: Mapping[int, StarSolution], together: Mapping[int, StarSolution]) -> bool:
    """Return whether stars without rims of their own elsewhere fit worse with those that others have.

    Parameters
    ----------
    alone, together : mapping of int to StarSolution
        Stars by their numbers, fitted by themselves, and again with rims free that are elsewhere in any of them.
    """
    rise = 0.0
    for number in alone.keys() & together.keys():
        before, after = alone[number], together[number]
        if not any(body.moved for body in before.light.free_rims.bodies):
            losses = [star.solution.loss / star.stamp.used.sum() for star in (before, after)]
            rise += (losses[1] / losses[0] - 1.0) * after.stamp.used.sum()
    return rise > _DECIDES


def _places(rims: FreeRims, star_rims: FreeRims) -> np.ndarray:
    """Return the numbers of the free motions of some rims among those of all."""
    number = {body.members: k for k, body in enumerate(rims.bodies)}
    index = np.full(rims.free.shape, -1)
    index[rims.free] = np.arange(len(rims))
    return np.concatenate([np.zeros(0, dtype=np.int64), *(index[number[b.members]][b.free] for b in star_rims.bodies)])


def settled(rims: FreeRims, steps: np.ndarray) -> bool:
    """Return whether steps of the free motions [n] are so small that the rims need not be moved."""
    return bool(np.all(np.abs(steps) < _SETTLED * rims.spreads))


def light_with(instrument: Instrument, star: StarSolution, rims: FreeRims) -> StarLight:
    """Return the light of a star with the rims of all where these stand."""
    star_rims = star.light.free_rims
    return star.light.with_free_rims(rims, instrument.middle) if rims.bodies or star_rims.bodies else star.light


def cells_across(instrument: Instrument, star: StarSolution) -> int:
    """Return the cells across the pupil that the stamp of a star needs."""
    stamp = star.stamp
    fwhm = float(instrument.seeing.fwhm(star.solution.stars[0][STRENGTH]))
    pixels = Pixels(stamp.image, stamp.variance, stamp.used, round(stamp.grid.scale))
    return instrument.sampling(star.light, pixels, fwhm).across


def with_shared_rims(instrument: Instrument, star: StarSolution, rims: FreeRims) -> StarSolution:
    """Return a star for unknowns of the wavefront, slopes of the response and free motions of the rims of all stars.

    Other rims stand where the star's own fit has them.
    """
    rays, first = star.stamp.rays, len(instrument.noll)
    assert isinstance(rays, ZernikeRays)
    held = star.solution.waves[0][first : first + 2 * len(star.light.rims)].copy()
    if not (rims.bodies or star.light.free_rims.bodies):
        return replace(star, stamp=replace(star.stamp, rays=rays.holding(held)))
    light = light_with(instrument, star, rims)
    names = rims.surfaces(light.telescope)
    held[np.repeat(np.array([rim.name in names for rim in light.rims], dtype=bool), 2)] = 0.0
    stamp, full = star.stamp, star.full
    if light.pupil_rims is not None:
        stamp, full = (replace(s, grid=s.grid.with_rims(light.pupil_rims)) for s in (stamp, full))
    rays = instrument.rays(light, cells_across(instrument, star)).holding(held)
    return replace(star, light=light, stamp=replace(stamp, rays=rays), full=replace(full, rays=rays))


def group_with_rims(
    instrument: Instrument,
    stars: Sequence[StarSolution],
    maps: Sequence[np.ndarray],
    precision: np.ndarray,
    rims: FreeRims,
    *,
    transient: bool = False,
) -> Group:
    """Return stars as they are fitted together, the free motions of rims last among their shared unknowns.

    Parameters
    ----------
    instrument : Instrument
        Telescope and model of the images.
    stars : sequence of StarSolution
        The stars, with the light of these rims.
    maps : sequence of n_star ndarray, each of shape [n_wave, n_shared]
        Unknowns of each star's wavefront by the other shared ones.
    precision : ndarray, shape [n_shared]
        Inverse variances of the priors of these, whose means are zero.
    rims : FreeRims
        Where the telescope has the rims.
    transient : bool
        As in :class:`~pachon.sensing.solve.Group`.
    """
    first = len(precision)
    return Group(
        tuple(star.stamp for star in stars),
        [block_diag(of_star, np.eye(len(rims))) for of_star in maps],
        np.concatenate([precision, rims.spreads**-2.0]),
        instrument.known_seeing,
        transient,
        prior_mean=np.concatenate([np.zeros(first), rims.means]),
        limits=np.concatenate([np.full(first, np.inf), rims.limits]),
        strength_prior=instrument.strength_prior,
    )


def moved_rims_of_all(instrument: Instrument, joint: JointFit, first: int) -> list[list[MovedRim]]:
    """Return the rims of all stars as each star shows them; none without free ones.

    Steps of the rims are the shared unknowns of the solution from the number `first` on.
    """
    if not joint.rims.bodies:
        return []
    steps, covariance = joint.solution.shared[first:], joint.solution.shared_covariance[first:, first:]
    return [rims_at(instrument, star.light, star.stamp, steps, covariance) for star in joint.stars]
