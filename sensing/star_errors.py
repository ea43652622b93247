"""Errors of the wavefront of one donut: photons, residuals, air, and the model's own accuracy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from ..wavefront.atmosphere.turbulence import REFERENCE_WAVELENGTH
from .air_shape import air_shape
from .donut_rays import ZernikeRays
from .hierarchy import ExposureAir
from .image_model import STRENGTH
from .light import Instrument
from .likelihood import Linearized, linearized, wavefront_columns
from .residual_patterns import AIR_UNIT, figure_strength, losses_of_field
from .residual_power import TelescopePatterns, residual_power
from .star_fitter import StarSolution

#: Terms up to the eleventh radial degree: what the mean wavefront of the air has beyond is lost in the seeing.
_AIR_TERMS = 78
#: Variance of Kolmogorov's wavefront from Z4 on where the diameter of the pupil is Fried's parameter [rad^2].
_NOLL_FROM_4 = 0.134
#: Part of what residuals say of the air that counts: in few winds it has other shares of high orders than in all.
_TRUST = 0.5
#: Least variance of a term of the air over that of all from Z4 to Z22.
_LEAST = 1e-9
#: Full width at half maximum of a Gaussian over its rms.
_FWHM_PER_RMS = 2.354820045
#: Error of the model of the image by cells of the pupil and pixels, all terms together [m].
_MODEL_ERROR = 3e-9
#: Difference of the wavefront by landing points from that of the optical path, over the wavefront itself.
_RELATIVE_ERROR = 3e-3


@dataclass(frozen=True)
class ErrorParts:
    """Covariance of wavefronts by cause, each of shape [n_noll, n_noll] or [n, n_noll, n_noll] [m^2].

    Attributes
    ----------
    photons : ndarray
        Noise of the pixels, and terms that are fitted beside those asked for: the Cramer-Rao bound.
    residuals : ndarray
        What the model lacks, by the power of the residuals beyond the noise, and which rim moved if several may have.
    air : ndarray
        Mean wavefront of the turbulence of the exposure.
    floor : ndarray
        Accuracy of the model, terms beyond those fitted, which fall off with the radial degree, and the scatter of the
        donuts of an exposure about a smooth field beyond all else.
    repeats : ndarray
        No part of the sum: covariance of a donut about the others of its exposure, which have the same errors of the
        model in common. The sum, where there are none to compare.
    """

    photons: np.ndarray
    residuals: np.ndarray
    air: np.ndarray
    floor: np.ndarray
    repeats: np.ndarray

    @classmethod
    def of(cls, photons: np.ndarray, residuals: np.ndarray, air: np.ndarray, floor: np.ndarray) -> ErrorParts:
        """Return the parts of a donut that is compared with no other."""
        return cls(photons, residuals, air, floor, photons + residuals + air + floor)

    def divided(self, total: np.ndarray) -> ErrorParts:
        """Return a covariance [n_noll, n_noll] of another fit of the donut, its causes in the shares of these ones."""
        causes = (self.photons, self.residuals, self.air, self.floor)
        shares = np.array([np.trace(cause) for cause in causes]) / np.trace(self.total)
        return ErrorParts.of(*(share * total for share in shares))

    @property
    def total(self) -> np.ndarray:
        """Sum of all."""
        return np.asarray(self.photons + self.residuals + self.air + self.floor)


@dataclass(frozen=True)
class StarErrors:
    """Errors of a star that was fitted by itself.

    Attributes
    ----------
    covariance : ndarray, shape [n_unknown, n_unknown]
        Covariance of its unknowns beside its wavefront.
    parts : ErrorParts
        That of its wavefront, by cause.
    of_light : ndarray, shape [n_noll, n_noll]
        Covariance of the wavefront of its light, the air's low terms among it, but for what stars have in common.
    figure : ndarray, shape [n_noll, n_noll]
        What stars have in common but for higher orders: the telescope's terms beside those asked for, fitted with a
        prior, and the accuracy of the model.
    higher : ndarray, shape [n_noll, n_noll]
        The same of the telescope's terms of higher orders as they are expected, fitted or not.
    air_losses : ndarray, shape [n_figure, n_rms], optional
        What the residuals say of the air: twice the negative logarithm of the likelihood of its rms, at
        :data:`~pachon.sensing.residual_patterns.RMS_LOGARITHMS` in units of 100 nm, for some of the telescope's.
    further : float
        Variance of the telescope's terms of higher orders over the expected one, as the residuals say.
    """

    covariance: np.ndarray
    parts: ErrorParts
    of_light: np.ndarray
    figure: np.ndarray
    higher: np.ndarray
    air_losses: np.ndarray | None = None
    further: float = 1.0

    @property
    def common(self) -> np.ndarray:
        """What stars have in common, shape [n_noll, n_noll]."""
        return np.asarray(self.figure + self.further * self.higher)


def star_errors(instrument: Instrument, star: StarSolution) -> StarErrors:
    """Return the errors of a star that was fitted by itself."""
    if isinstance(star.errors, StarErrors):
        return star.errors
    solution, terms = star.solution, instrument.terms
    n_star, n = len(solution.stars[0]), len(terms.requested)
    wavefront = slice(n_star, n_star + n)
    photons, air = solution.covariance, terms.air
    unfitted, higher, by_prior, speckled = np.zeros((4, n, n))
    air_losses, further = None, 1.0
    residuals, lacking = np.zeros_like(photons), solution.star_covariance(0).copy()
    point = linearized(star.stamp, solution.stars[0], solution.waves[0])
    if point is not None and len(solution.shared):
        beside = _TermsBeside(instrument, star, point)
        precision, deviation = instrument.prior(star.light, solution.stars[0], solution.shared, solution.prior_weight)
        seeing = float(solution.stars[0][STRENGTH])
        # Seeing that is fitted may be none by chance, or because the detector's blur has it.
        airless = instrument.model.air.fwhm is not None and seeing == 0.0
        power = residual_power(
            point,
            photons,
            resolution(instrument, star),
            beside.patterns,
            beside.telescope,
            precision * deviation,
            airless,
        )
        residuals, air_losses, further = power.covariance, power.losses, power.figure
        if instrument.model.rims.size > 0.0:
            # Rims of uncertain radii take up what further terms would show.
            further = max(further, 1.0)
        lacking += residuals[:n_star, :n_star]
        unfitted = beside.figure(photons)[wavefront, wavefront]
        # What a prior about zero takes from the telescope's further terms goes into those asked for.
        pulled = photons[wavefront, n_star : n_star + len(terms.figure)] * terms.precision * np.sqrt(terms.figure)
        pulled *= solution.prior_weight
        by_prior, higher = pulled @ pulled.T, pulled[:, terms.higher] @ pulled[:, terms.higher].T
        known_air = instrument.model.air.atmosphere is not None
        strength = 0.0 if known_air else min(power.strength, _most_air(instrument, seeing))
        if strength > 0.0:
            speckles, turbulence = (strength * values for values in beside.air(photons))
            lacking, air = lacking + speckles[:n_star, :n_star], air + turbulence[wavefront, wavefront]
            speckled = speckles[wavefront, wavefront]
    accuracy, of_residuals = model_floor(solution.shared[:n]), residuals[wavefront, wavefront] + by_rivals(star, n)
    # The inverse of the curvature has what priors hold of terms as large as these say, for their weight.
    held = by_prior + (further - 1.0) * higher
    of_noise = photons[wavefront, wavefront] + held - by_prior / solution.prior_weight
    if star.steps is not None:
        lacking += star.steps.covariance[:n_star, :n_star]
        of_noise = of_noise + star.steps.covariance[wavefront, wavefront]
    parts = ErrorParts.of(of_noise, of_residuals, air, further * unfitted + accuracy)
    of_light = parts.photons - held + parts.residuals + speckled
    figure = by_prior - higher + accuracy
    return StarErrors(lacking, parts, of_light, figure, higher + unfitted, air_losses, further)


def by_rivals(star: StarSolution, n: int) -> np.ndarray:
    """Return the covariance of the first n terms by which rims moved, where fits with several explain a star alike.

    It is the mean square of their differences from the best fit, weighted by their likelihoods.
    """
    likelihoods = np.exp([-0.5 * rival.worse for rival in star.rivals])
    differences = np.array([rival.wave[:n] - star.solution.shared[:n] for rival in star.rivals]).reshape(-1, n)
    weighted = differences * likelihoods[:, None] / (1.0 + likelihoods.sum())
    return np.asarray(weighted.T @ differences)


def _most_air(instrument: Instrument, seeing: float) -> float:
    """Return the variance of the wavefront of turbulence at one moment, in units of that of air of unit size.

    It is that of Kolmogorov's from Z4 on (Noll 1976), for an inverse Fried parameter [1/m]; infinite without seeing.
    """
    turbulence = instrument.telescope.pupil_diameter * seeing
    radians = _NOLL_FROM_4 * turbulence ** (5.0 / 3.0)
    return radians * (REFERENCE_WAVELENGTH / (2.0 * math.pi * AIR_UNIT)) ** 2 if seeing > 0.0 else math.inf


def with_errors(instrument: Instrument, star: StarSolution) -> StarSolution:
    """Return a star with its errors, its derivatives freed."""
    star = replace(star, errors=star_errors(instrument, star))
    star.stamp.forget()
    star.full.forget()
    return star


def model_floor(zernikes: np.ndarray) -> np.ndarray:
    """Return the covariance of a wavefront [m] by the accuracy of the model, shape [n, n]."""
    return np.diag(_MODEL_ERROR**2 / len(zernikes) + (_RELATIVE_ERROR * zernikes) ** 2)


def air_of_terms(instrument: Instrument) -> np.ndarray:
    """Return the covariance of the terms asked for in the mean wavefront of an exposure, of unit trace, [n, n]."""
    covariance = air_of_zernikes(instrument)
    return np.asarray(covariance / np.trace(covariance))


def air_of_zernikes(instrument: Instrument) -> np.ndarray:
    """Return the same over the variance of Z4 to Z22 together, shape [n, n]."""
    low = instrument.terms.requested - 4
    return air_of(instrument, max(_AIR_TERMS, int(instrument.terms.requested.max())))[np.ix_(low, low)]


def exposure_air(instrument: Instrument, rms: float | None = None, losses: np.ndarray | None = None) -> ExposureAir:
    """Return the mean wavefront of an exposure, of an rms of Z4 to Z22 [m] if it is known, with what residuals say."""
    return ExposureAir(air_of_zernikes(instrument), instrument.shared_air, instrument.shared_air_spread, rms, losses)


def air_losses(instrument: Instrument, stars: Sequence[StarSolution]) -> np.ndarray | None:
    """Return what the residuals of the stars of an exposure say of its air, as :class:`ExposureAir` has it.

    Stars have part of the air in common, and so say less than as many of their own would. An earlier fit says it where
    the air's higher terms are fitted, which are then no residuals. None where none says anything.
    """
    if instrument.terms.air_losses is not None:
        return instrument.terms.air_losses
    of_stars = [star_errors(instrument, star).air_losses for star in stars]
    losses = [values for values in of_stars if values is not None]
    # Squares of two amplitudes are correlated as the square of the correlation of these.
    alike = 1.0 + (len(losses) - 1) * instrument.shared_air**2
    return losses_of_field(_TRUST / alike * np.sum(np.broadcast_arrays(*losses), axis=0)) if losses else None


def further_strength(instrument: Instrument, stars: Sequence[StarSolution], air_rms: float) -> float:
    """Return the variance of the telescope's terms of higher orders over the expected one, as the residuals say.

    All stars have the same, and say no more of it than one does; ``air_rms`` is that of the exposure's air [m].
    """
    losses = [errors.air_losses for errors in (star_errors(instrument, star) for star in stars)]
    of_stars = [values for values in losses if values is not None]
    return figure_strength(np.mean(np.broadcast_arrays(*of_stars), axis=0), air_rms / AIR_UNIT) if of_stars else 1.0


def air_of(instrument: Instrument, last: int) -> np.ndarray:
    """Return the covariance of Z4 to a last term in the mean wavefront of an exposure, of unit trace up to Z22."""
    telescope = instrument.telescope
    outer_scale = float(instrument.model.air.outer_scale) / (0.5 * telescope.pupil_diameter)
    return air_shape(last, round(telescope.pupil_obscuration, 4), outer_scale)


def resolution(instrument: Instrument, star: StarSolution) -> float:
    """Return the width of the finest detail of an image [pixels of the fit]."""
    seeing = float(instrument.seeing.fwhm(star.solution.stars[0][STRENGTH])) * star.light.scale
    return max(math.hypot(seeing, _FWHM_PER_RMS * instrument.diffusion) / star.stamp.grid.pixel, 1.0)


class _TermsBeside:
    """Terms of the wavefront up to Z78 beside those asked for, and the light that they move."""

    def __init__(self, instrument: Instrument, star: StarSolution, point: Linearized) -> None:
        self._instrument, self._star, self._point = instrument, star, point
        self._beyond = np.setdiff1d(np.arange(4, _AIR_TERMS + 1), instrument.terms.every)

    @cached_property
    def _shape(self) -> np.ndarray:
        """Covariance of Z4 to the last term by air of unit size [m^2]."""
        last = max(_AIR_TERMS, int(self._instrument.terms.every.max()))
        return AIR_UNIT**2 * air_of(self._instrument, last)

    @cached_property
    def _high(self) -> np.ndarray:
        """Terms beside those asked for, by their place in the covariance."""
        return np.concatenate([self._instrument.terms.further, self._beyond]) - 4

    @cached_property
    def _root(self) -> np.ndarray:
        """Root of the covariance of the terms beside those asked for [m], [m, m]."""
        least = np.diag(np.full(len(self._high), _LEAST * AIR_UNIT**2))
        return np.linalg.cholesky(self._shape[np.ix_(self._high, self._high)] + least)

    @cached_property
    def _columns(self) -> np.ndarray:
        """Derivatives of the model by the terms beside those asked for, over the noise [1/m], [n_pixel, m]."""
        star, terms = self._star, self._instrument.terms
        unknowns, wave = star.solution.stars[0], star.solution.waves[0]
        first = len(unknowns) + len(terms.requested)
        further = slice(first, first + len(terms.further))
        columns = self._point.columns[:, further] * self._point.scales[further].astype(np.float32)
        if not len(self._beyond):
            return columns
        rays = star.stamp.rays
        assert isinstance(rays, ZernikeRays)
        beyond = wavefront_columns(star.stamp, unknowns, wave, self._point, rays.responding_to(self._beyond))
        return np.concatenate([columns, beyond], axis=1)

    @cached_property
    def patterns(self) -> np.ndarray | None:
        """Changes of the image over the noise by independent parts of air of unit size, [n_pixel, m]; None without."""
        return self._columns @ self._root.astype(np.float32) if len(self._high) else None

    @cached_property
    def unfitted(self) -> np.ndarray:
        """Changes of the image over the noise by terms that are not fitted, of the rms that telescopes have."""
        columns = self._columns[:, len(self._instrument.terms.further) :]
        return columns * self._instrument.terms.spreads_beyond(self._beyond).astype(np.float32)

    @cached_property
    def telescope(self) -> TelescopePatterns:
        """Changes of the image over the noise by the telescope's further terms of higher orders."""
        terms, weight = self._instrument.terms, self._star.solution.prior_weight
        further = slice(len(terms.requested), None)
        spreads = np.sqrt(np.where(terms.higher, terms.figure, 0.0))[further].astype(np.float32)
        fitted = self._columns[:, : len(spreads)] * spreads
        return TelescopePatterns(np.hstack([fitted, self.unfitted]), fitted / np.float32(math.sqrt(weight)))

    def figure(self, covariance: np.ndarray) -> np.ndarray:
        """Return the covariance of the unknowns by terms that are not fitted."""
        moved = covariance @ (self._point.scales[:, None] * (self._point.columns.T @ self.unfitted))
        return np.asarray(moved @ moved.T)

    def air(self, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the covariance of the unknowns by air of unit size: by its further terms, and with its own.

        Its own terms are those asked for, which no donut tells from the telescope's.
        """
        n_star, low = len(self._star.solution.stars[0]), self._instrument.terms.requested - 4
        scaled = self._point.columns.T @ self.patterns
        moved = covariance @ (self._point.scales[:, None] * scaled)
        speckles = moved @ moved.T
        turbulence, wavefront = speckles.copy(), slice(n_star, n_star + len(low))
        # What the air's further terms move goes with its low ones, which have a covariance with them.
        together = moved[wavefront] @ solve_triangular(self._root, self._shape[np.ix_(self._high, low)], lower=True)
        turbulence[wavefront, wavefront] += self._shape[np.ix_(low, low)] + together + together.T
        return speckles, turbulence
