"""Fits of the wavefronts of donuts: Zernikes of each, or terms over the field that all of them share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, DomainError
from ..models.telescope import Telescope
from ..models.zernike_polynomials import annular_zernikes
from ..raytrace.rays import Projection
from ..wavefront.atmosphere.atmosphere import Atmosphere
from .cross_check import checked_parts
from .degrees import FreedomEstimate
from .exposure import ExposureWavefront
from .fit_star import StarFit
from .flags import DonutFlag
from .inputs import noll_indices, small_length
from .joint_errors import JointErrors, joint_errors
from .light import Instrument
from .likelihood import Stamp, model_image
from .moving_rims import FreeRims
from .rim_table import MovedRim
from .shared_rims import (
    JointFit,
    group_with_rims,
    least_rims,
    moved_rims_of_all,
    settled,
    shared_rims,
    with_shared_rims,
)
from .sided_stars import sided_stars
from .solve import DAMPING, Solution, solve
from .star_errors import ErrorParts, model_floor, star_errors, with_errors
from .star_fitter import StarSolution
from .terms import WavefrontTerms
from .undetermined import is_undetermined

#: Noll indices of the wavefront that are fitted by default: up to the fifth radial degree.
NOLL = tuple(range(4, 23))
#: Times that the shadows of rims that all stars share are computed where these are found to stand.
RIM_STEPS = 6


@dataclass(frozen=True)
class UsableStars:
    """Stars of an exposure that a fit of each by itself found.

    Attributes
    ----------
    instrument : Instrument
        Telescope and model of the images.
    stars : sequence of StarSolution
        Best model of each by itself.
    fields : ndarray, shape [n_star, 2]
        Field angles [rad].
    projection : str
        Their meaning.
    every_field : ndarray, shape [n, 2]
        Field angles of all stars of the exposure [rad].
    index : ndarray of int, shape [n_star]
        Numbers of these stars among them.
    """

    instrument: Instrument
    stars: Sequence[StarSolution]
    fields: np.ndarray
    projection: Projection
    every_field: np.ndarray
    index: np.ndarray

    @property
    def unknowns(self) -> list[np.ndarray]:
        """Unknowns of each star beside its wavefront."""
        return [star.solution.stars[0] for star in self.stars]

    def start(self, maps: Sequence[np.ndarray] | np.ndarray, precision: np.ndarray) -> np.ndarray:
        """Return the shared unknowns that fit the stars' single wavefronts best.

        Parameters
        ----------
        maps : sequence of n_star ndarray, each of shape [n_wave, n_shared]
            Wavefronts by the shared unknowns.
        precision : ndarray, shape [n_shared]
            Inverse variances of their priors.
        """
        curvature, gradient = np.diag(precision), np.zeros(len(precision))
        for star, wavefront_map in zip(self.stars, maps, strict=True):
            if len(star.solution.shared):
                # Shifts of rims of a star's own stand after the wavefront.
                n = len(wavefront_map)
                information = np.linalg.pinv(star.solution.shared_covariance[:n, :n], hermitian=True)
                curvature = curvature + wavefront_map.T @ information @ wavefront_map
                gradient = gradient + wavefront_map.T @ information @ star.solution.shared[:n]
        return np.linalg.lstsq(curvature, gradient, rcond=1e-14)[0]


@dataclass(frozen=True)
class FittedStar:
    """Result of a star: pixels, best model [electrons], unknowns and their covariance, wavefront [m] and its errors.

    Rims that stand elsewhere, and slopes of the response with their errors [1/pixel], are those of the star's own fit,
    unless it shares them with others.
    """

    pixels: Stamp
    model: np.ndarray
    unknowns: np.ndarray
    covariance: np.ndarray
    zernikes: np.ndarray
    errors: ErrorParts
    shared_rims: Sequence[MovedRim] | None = None
    shared_slopes: np.ndarray | None = None


@dataclass(frozen=True)
class FittedStars:
    """Results of all usable stars, and what they share: double Zernikes, degrees of freedom, their exposure."""

    stars: Sequence[FittedStar]
    double_zernikes: np.ndarray | None = None
    double_zernike_covariance: np.ndarray | None = None
    degrees_of_freedom: FreedomEstimate | None = None
    exposure: ExposureWavefront | None = None


class WavefrontFit(ABC):
    """Fit of the wavefronts of donuts: the unknowns of the wavefront, and how they are found.

    Attributes
    ----------
    noll : sequence of int
        Noll indices of the wavefronts that are returned.
    joint : bool
        Whether stars share unknowns.
    """

    noll: Iterable[int]
    joint: ClassVar[bool] = True

    def terms(self, telescope: Telescope, atmosphere: Atmosphere | None) -> WavefrontTerms:
        """Return the terms of the wavefront of each star; turbulence is for single donuts."""
        if atmosphere is not None:
            raise ConfigError(
                "atmosphere: expected fits of single donuts, no field terms or degrees of freedom with it"
            )
        return WavefrontTerms.of(noll_indices(self.noll, "noll", 4))

    def prepared(self, instrument: Instrument, star: StarFit) -> StarFit:
        """Return a star that was fitted by itself, made ready for :meth:`solved`: with errors of its wavefront.

        A donut whose light leaves that undetermined is flagged.
        """
        if star.usable is None or not len(star.usable.solution.shared):
            return star
        best = with_errors(instrument, star.usable)
        if instrument.is_donut(best.light) and is_undetermined(star_errors(instrument, best).parts.total):
            return StarFit(DonutFlag.UNDETERMINED)
        return replace(star, best=best)

    def sided(self, instrument: Instrument, stars: Sequence[StarFit], fields: np.ndarray) -> list[StarFit]:
        """Return the stars with flags by the side of focus that they say together, if they share unknowns."""
        return sided_stars(instrument, stars, fields) if self.joint else list(stars)

    def refined(self, instrument: Instrument, stars: Sequence[StarSolution], fitted: FittedStars) -> Instrument | None:
        """Return an instrument for which all stars are fitted once more, by what a first fit has found; or None."""
        return None

    @abstractmethod
    def solved(self, usable: UsableStars, pool: Executor) -> FittedStars:
        """Return the results of the usable stars."""


@check_arguments
@dataclass(frozen=True, eq=False)
class SingleDonuts(WavefrontFit):
    """Fit of each donut by itself, by Zernikes; for :func:`~pachon.fit_donuts`.

    Attributes
    ----------
    noll : iterable of int
        Noll indices of the wavefront, from 4.
    left_out : float or Quantity
        Rms of each term from Z4 to Z22 that `noll` leaves out [m]. These are fitted too, with that prior, those up to
        Z28 with a tenth of it, and not returned: errors of `zernikes` have what is not known of them. 0 is none.
    higher_order : float or Quantity
        Rms of each further Zernike, of the next radial degree at every azimuthal order of `noll` [m]: 10 nm, by
        default, are what turbulence leaves in 15 s. They are fitted too, with that prior, and not returned. Without
        them (0) light that they move is taken for low orders, which is worst on an annulus.

    Raises
    ------
    DomainError
        If indices repeat or are below 4, or a number is outside its range.
    """

    joint: ClassVar[bool] = False

    noll: Iterable[int] = NOLL
    left_out: ArrayLike = 200e-9
    higher_order: ArrayLike = 10e-9

    def __post_init__(self) -> None:
        object.__setattr__(self, "noll", tuple(noll_indices(self.noll, "noll", 4)))
        for name in ("left_out", "higher_order"):
            small_length(getattr(self, name), name)

    def terms(self, telescope: Telescope, atmosphere: Atmosphere | None) -> WavefrontTerms:
        """Return the terms of the wavefront of each star, with those of the turbulence."""
        spreads = small_length(self.left_out, "left_out"), small_length(self.higher_order, "higher_order")
        return WavefrontTerms.of(np.array(self.noll), *spreads, telescope, atmosphere)

    def solved(self, usable: UsableStars, pool: Executor) -> FittedStars:
        """Return the results of the stars as each fit has them."""
        instrument, n = usable.instrument, len(usable.instrument.terms.requested)
        errors = [star_errors(instrument, star) for star in usable.stars]
        zernikes = [star.solution.shared[:n] for star in usable.stars]
        parts = checked_parts(instrument, usable.stars, usable.fields)
        return FittedStars(
            [
                FittedStar(star.full, star.model, star.solution.stars[0], star_error.covariance, wavefront, causes)
                for star, star_error, wavefront, causes in zip(usable.stars, errors, zernikes, parts, strict=True)
            ]
        )


@check_arguments
@dataclass(frozen=True, eq=False)
class FieldTerms(WavefrontFit):
    """Fit of double Zernikes to all donuts together; for :func:`~pachon.fit_donuts`.

    Attributes
    ----------
    field_noll : iterable of int
        Noll indices of terms over the field, from 1; the field's radius is that of the telescope.
    noll : iterable of int
        Noll indices of the wavefront, from 4; terms that are left out are taken to be zero.
    higher_order : float or Quantity
        As in :class:`SingleDonuts`; 0 by default.

    Raises
    ------
    DomainError
        If indices repeat or are too low, or a number is outside its range.
    """

    field_noll: Iterable[int]
    noll: Iterable[int] = NOLL
    higher_order: ArrayLike = 0.0

    def __post_init__(self) -> None:
        for name, least in (("field_noll", 1), ("noll", 4)):
            object.__setattr__(self, name, tuple(noll_indices(getattr(self, name), name, least)))
        small_length(self.higher_order, "higher_order")

    def terms(self, telescope: Telescope, atmosphere: Atmosphere | None) -> WavefrontTerms:
        """Return the terms of the wavefront of each star; turbulence is for single donuts."""
        requested = super().terms(telescope, atmosphere).requested
        # Terms that `noll` leaves out would have a prior of their own at every field term.
        return WavefrontTerms.of(requested, 0.0, small_length(self.higher_order, "higher_order"))

    def solved(self, usable: UsableStars, pool: Executor) -> FittedStars:
        """Return the results of a joint fit of field terms times those of the pupil."""
        instrument, field_noll = usable.instrument, np.array(self.field_noll)
        n_noll, n_field = len(instrument.noll), len(field_noll)
        if len(usable.stars) < n_field:
            raise DomainError(
                f"field_noll: {n_field} terms for {len(usable.stars)} usable donuts; expected no more terms"
            )
        over_field = annular_zernikes(int(field_noll.max()), *(usable.fields.T / instrument.telescope.field_radius))
        wave_maps = np.stack([np.kron(row, np.eye(n_noll)) for row in over_field[field_noll - 1].T])
        precision, slopes = np.tile(instrument.terms.precision, n_field), instrument.slope_spreads
        shared, unknowns = np.append(usable.start(wave_maps, precision), 0.0 * slopes), usable.unknowns
        maps = [block_diag(of_star, np.eye(len(slopes))) for of_star in wave_maps]
        precision, first = np.append(precision, slopes**-2.0), len(shared)

        def fitted(rims: FreeRims) -> JointFit:
            at, of_stars, damping = shared, unknowns, DAMPING
            for _ in range(RIM_STEPS):
                stars = [with_shared_rims(instrument, star, rims) for star in usable.stars]
                group = group_with_rims(instrument, stars, maps, precision, rims)
                start = np.concatenate([at, np.zeros(len(rims))])
                solution = solve(group, of_stars, start, damping=damping, pool=pool)
                joint = JointFit(stars, group, solution, rims)
                at, of_stars, damping = solution.shared[:first], list(solution.stars), solution.damping
                if settled(rims, solution.shared[first:]):
                    break
                rims = rims.moved(solution.shared[first:])
            return joint

        fit = least_rims(shared_rims(instrument, usable.stars), fitted)
        stars, group, solution, _ = fit
        n = len(instrument.terms.requested)
        requested = (n_noll * np.arange(n_field)[:, None] + np.arange(n)).ravel()
        errors = joint_errors(instrument, usable.stars, usable.fields, wave_maps, stars, group, solution)
        shared_covariance = solution.shared_covariance + errors.shared
        return FittedStars(
            joint_results(
                stars,
                solution,
                errors,
                np.array(solution.waves)[:, :n],
                [of_star[:n] for of_star in group.maps],
                moved_rims_of_all(instrument, fit, first),
                slice(first - len(slopes), first),
            ),
            solution.shared[requested].reshape(-1, n),
            shared_covariance[np.ix_(requested, requested)],
        )


def joint_results(
    stars: Sequence[StarSolution],
    solution: Solution,
    errors: JointErrors,
    zernikes: np.ndarray,
    zernike_maps: np.ndarray | Sequence[np.ndarray],
    rims: Sequence[list[MovedRim]],
    slopes: slice,
) -> list[FittedStar]:
    """Return the results of stars that share unknowns.

    Parameters
    ----------
    stars : sequence of StarSolution
        The stars with their last stamps.
    solution : Solution
        Unknowns of all stars and the shared ones.
    errors : JointErrors
        What they are uncertain by beyond the noise.
    zernikes : ndarray, shape [n_star, n_noll]
        Wavefront of each star [m].
    zernike_maps : sequence of n_star ndarray, each of shape [n_noll, n_shared]
        Derivatives of the wavefronts with respect to the shared unknowns.
    rims : sequence of n_star list of MovedRim
        Rims that stand elsewhere, as each star shows them; empty without any.
    slopes : slice
        Which of the shared unknowns are slopes of the response.
    """
    results = []
    spread_of_slopes = np.sqrt(np.diag(solution.shared_covariance + errors.shared)[slopes])
    response_slope = np.array([solution.shared[slopes], spread_of_slopes])
    for i, star in enumerate(stars):
        pixels = replace(star.full, rays=star.stamp.rays)
        model = model_image(pixels, solution.stars[i], solution.waves[i])
        pixels.release()
        photons, lacking, air, figure = (
            zernike_maps[i] @ shared @ zernike_maps[i].T
            for shared in (
                solution.shared_covariance,
                errors.residuals.shared_covariance,
                errors.air,
                errors.figure,
            )
        )
        covariance = solution.star_covariance(i) + errors.residuals.star_covariance(i)
        parts = ErrorParts.of(photons, lacking, air, figure + model_floor(zernikes[i]))
        moved = rims[i] if rims else ()
        unknowns = solution.stars[i]
        results.append(FittedStar(pixels, model, unknowns, covariance, zernikes[i], parts, moved, response_slope))
    return results
