r"""Wavefronts of the donuts of an exposure as a smooth part over the field and what each has about it.

Donut i of star g(i), in exposure e(i), has a fitted wavefront

.. math:: y_i = X_i u + l_{g(i)} + a_{e(i)} + b_i + n_i, \qquad n_i \sim N(0, \alpha C_i),

with the covariance C of its own fit. What X u and l have is the telescope's: terms over the field or degrees of freedom
u, and l that donuts of one star on both sides of focus share. What a and b have is the air's: layers near the ground,
which all donuts of an exposure share, and layers above, of which donuts apart have nothing in common. All are Gaussian;
their variances are those that make the wavefronts most likely, with wide priors on them (empirical Bayes; of terms with
a flat prior this is restricted maximum likelihood, Patterson & Thompson 1971, Biometrika 58, 545).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.linalg import lapack
from scipy.optimize import minimize

from .residual_patterns import AIR_UNIT, RMS_LOGARITHMS

#: Rms of the air's wavefront about which its prior lies, that of 15 s under median seeing, Z4 to Z22 [m].
AIR_RMS = 110e-9
#: Rms of the air at which residuals of images say how likely it is [m].
RMS = AIR_UNIT * np.exp(RMS_LOGARITHMS)
#: Largest air that can be told from wavefronts that have nothing in common [m].
MOST_AIR = 3e-6
#: Standard deviation of the logarithm of the air's variance, and of those of the telescope.
_WIDE = 2.0
#: The same of the scale of the covariances of the fits.
_SCALE_SPREAD = 0.7
#: Rms of a linear term over the field of the lowest pupil terms about which its prior lies [m].
_LINEAR_RMS = 150e-9
#: Fall of the variance of field terms with each degree over field or pupil, about which its prior lies.
_FALL = 4.0
#: Standard deviation of the logarithm of the logarithm of that fall.
_FALL_SPREAD = 0.5
#: The same of pupil terms of any degree, beside these, of mirrors that are bent: LSST's with 10 nm of each mode.
_BENT_RMS = 5e-9
#: Rms of what stars have of their own in the telescope's wavefront, about which its prior lies [m].
_LOCAL_RMS = 10e-9
#: Rms of terms that are uniform over the field: nearly no prior [m].
_UNIFORM_RMS = 30e-6
#: Metres of one unit of the algebra.
_UNIT = 1e-9


@dataclass(frozen=True)
class Observations:
    """Fitted wavefronts of donuts.

    Attributes
    ----------
    zernikes : ndarray, shape [n, n_noll]
        Wavefronts [m].
    covariance : ndarray, shape [n, n_noll, n_noll]
        Covariances of the fits [m^2].
    star : ndarray of int, shape [n]
        Number of the star of each: donuts of the same star share what the telescope has there.
    exposure : ndarray of int, shape [n]
        Number of its exposure.
    """

    zernikes: np.ndarray
    covariance: np.ndarray
    star: np.ndarray
    exposure: np.ndarray

    @property
    def repeated(self) -> bool:
        """Whether a star has several donuts."""
        return len(np.unique(self.star)) < len(self.star)


@dataclass(frozen=True)
class ExposureAir:
    """The air's mean wavefront in an exposure.

    Attributes
    ----------
    shape : ndarray, shape [n_noll, n_noll]
        Covariance of its terms over that of Z4 to Z22 together.
    shared : float
        Part of it that all donuts of the exposure share, about which that part lies.
    shared_spread : float
        Standard deviation of the logarithm of that part over the other; 0 where it is known.
    rms : float, optional
        Rms, Z4 to Z22 [m]; fitted by default.
    losses : ndarray, shape [n_rms], optional
        What residuals of the images say of this: twice the negative logarithm of the likelihood at :data:`RMS`.
    """

    shape: np.ndarray
    shared: float
    shared_spread: float = 0.0
    rms: float | None = None
    losses: np.ndarray | None = None

    def loss(self, logarithm: float) -> tuple[float, float]:
        """Return what residuals say of the logarithm of an rms, and its slope; nothing below the least one."""
        if self.losses is None:
            return 0.0, 0.0
        inside = float(np.clip(logarithm, *self._curve.x[[0, -1]]))
        slope = float(self._curve(inside, 1)) if logarithm >= inside else 0.0
        return float(self._curve(inside)) + slope * (logarithm - inside), slope

    @cached_property
    def _curve(self) -> PchipInterpolator:
        """Losses by the logarithm of the rms."""
        return PchipInterpolator(np.log(RMS), self.losses)


@dataclass(frozen=True)
class Basis:
    """Terms of the telescope's wavefront.

    Attributes
    ----------
    columns : ndarray, shape [m, n_noll, n_term]
        Wavefronts at m places per unit of each term [m]; the first places are those of the observations.
    field_degree, pupil_degree : ndarray of int, shape [n_term], optional
        Radial degrees of double Zernikes, whose variances are fitted.
    variance : ndarray, shape [n_term], optional
        Variances of the terms in place of these.
    """

    columns: np.ndarray
    field_degree: np.ndarray | None = None
    pupil_degree: np.ndarray | None = None
    variance: np.ndarray | None = None

    def variances(self, sizes: Sizes) -> np.ndarray:
        """Return variances of the terms by the sizes of the parts [m^2], shape [n_term]."""
        if self.variance is not None:
            return self.variance
        return np.where(self.field_degree == 0, _UNIFORM_RMS**2, np.sum(self._varying(sizes)[:2], axis=0))

    def slopes(self, sizes: Sizes) -> np.ndarray:
        """Return the slopes of the variances by the third to fifth logarithm of :meth:`Sizes.of`, shape [3, n_term]."""
        if self.variance is not None:
            return np.zeros((3, len(self.variance)))
        falling, bent, steps = self._varying(sizes)
        slopes = np.array([2.0 * falling, -math.log(sizes.fall) * steps * falling, 2.0 * bent])
        return np.where(self.field_degree == 0, 0.0, slopes)

    def _varying(self, sizes: Sizes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return both parts of the variances of terms that vary over the field, and steps of the fall of the first."""
        assert self.field_degree is not None
        assert self.pupil_degree is not None
        beyond = self.field_degree - 1.0
        steps = beyond + (self.pupil_degree - self.pupil_degree.min())
        return sizes.linear**2 * sizes.fall**-steps, sizes.bent**2 * _FALL**-beyond, steps


@dataclass(frozen=True)
class Sizes:
    """Variances of the parts, fitted to the wavefronts.

    Attributes
    ----------
    noise : float
        Variance of the fits' errors over that claimed.
    air : float
        Rms of the air's wavefront, Z4 to Z22 [m].
    linear : float
        Rms of a linear field term of the lowest pupil terms [m].
    fall : float
        Fall of the variances of these with each degree over field or pupil.
    bent : float
        Rms of linear field terms of all pupil terms alike, beside these [m].
    local : float
        Rms of what each star has of its own in the telescope's wavefront [m].
    shared : float
        Part of the air's variance that all donuts of an exposure share.
    """

    noise: float
    air: float
    linear: float
    fall: float
    bent: float
    local: float
    shared: float

    @classmethod
    def of(cls, logarithms: np.ndarray) -> Self:
        """Return those of logarithms; of the fall, that of its logarithm, of the shared part, over the other one."""
        noise, rms, linear, fall, bent, local, shared = np.exp(logarithms)
        return cls(noise, rms, linear, math.exp(fall), bent, local, shared / (1.0 + shared))


@dataclass(frozen=True)
class Hierarchy:
    """Wavefronts of telescope and air.

    Attributes
    ----------
    sizes : Sizes
        Variances of the parts.
    loss : float
        Twice the negative logarithm of the likelihood of the wavefronts and of the priors of the sizes.
    terms : ndarray, shape [n_term]
        Terms of the telescope.
    term_covariance : ndarray, shape [n_term, n_term]
        Their covariance, the air's part included.
    telescope : ndarray, shape [m, n_noll]
        The telescope's wavefront at the places of the basis [m].
    telescope_covariance : ndarray, shape [m, n_noll, n_noll]
        Its covariance, the air's part included [m^2].
    total, total_covariance : ndarray, shapes [n, n_noll], [n, n_noll, n_noll]
        Wavefront of the light of each donut, telescope and air, and its covariance [m], [m^2].
    """

    sizes: Sizes
    loss: float
    terms: np.ndarray
    term_covariance: np.ndarray
    telescope: np.ndarray
    telescope_covariance: np.ndarray
    total: np.ndarray
    total_covariance: np.ndarray


def fit_hierarchy(observations: Observations, basis: Basis, air: ExposureAir) -> Hierarchy:
    """Return the wavefronts of telescope and air that are most likely.

    Parameters
    ----------
    observations : Observations
        Fitted wavefronts.
    basis : Basis
        Terms of the telescope's wavefront.
    air : ExposureAir
        The air's mean wavefront.
    """
    model = _Model(observations, basis, air)
    of_field = basis.variance is None
    unknown = air.rms is None
    free = [True, unknown, of_field, of_field, of_field, observations.repeated, unknown and air.shared_spread > 0.0]
    middle = _middle(observations, air)
    # Standard deviations of the logarithms of rms are half of those of variances.
    of_rms = 0.5 * _WIDE
    spread = np.array([_SCALE_SPREAD, of_rms, of_rms, _FALL_SPREAD, of_rms, of_rms, air.shared_spread or 1.0])
    least, most = middle - 4.0 * spread, middle + 4.0 * spread
    most[1] = math.log(MOST_AIR)
    index = np.flatnonzero(free)

    def sizes(values: np.ndarray) -> Sizes:
        logarithms = middle.copy()
        logarithms[index] = values
        return Sizes.of(logarithms)

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        deviation = (values - middle[index]) / spread[index]
        parts = sizes(values)
        of_model, slopes = model.loss(parts)
        of_residuals, slope = air.loss(math.log(parts.air))
        slopes[1] += slope
        total = of_model + of_residuals + float(deviation @ deviation)
        return total, slopes[index] + 2.0 * deviation / spread[index]

    bounds = list(zip(least[index], most[index], strict=True))
    best = minimize(loss, middle[index], jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 40})
    return model.solved(sizes(best.x), float(best.fun))


def chi2_by_the_others(observations: Observations, basis: Basis, air: ExposureAir) -> np.ndarray:
    """Return chi-square a term of each donut's star about what other stars say of it, shape [n].

    Sizes of the parts are those about which their priors lie; arguments are those of :func:`fit_hierarchy`.
    """
    return _Model(observations, basis, air).chi2_by_the_others(Sizes.of(_middle(observations, air)))


def _middle(observations: Observations, air: ExposureAir) -> np.ndarray:
    """Return the logarithms of the sizes about which their priors lie."""
    local = _LOCAL_RMS if observations.repeated else 1e-3 * _UNIT
    over_other = air.shared / (1.0 - air.shared)
    return np.log([1.0, air.rms or AIR_RMS, _LINEAR_RMS, math.log(_FALL), _BENT_RMS, local, over_other])


class _Model:
    """Gaussian algebra of observations, in nanometres."""

    def __init__(self, observations: Observations, basis: Basis, air: ExposureAir) -> None:
        self._basis, self._shape = basis, air.shape
        self._count, self._n = observations.zernikes.shape
        self._values = observations.zernikes / _UNIT
        self._noise = observations.covariance / _UNIT**2
        columns = basis.columns / _UNIT
        exposures = np.unique(observations.exposure)
        shared = (observations.exposure[:, None] == exposures)[:, None, :, None] * np.eye(self._n)[None, :, None, :]
        self._n_shared = shared[0, 0].size
        self._design = np.concatenate([columns[: self._count], shared.reshape(self._count, self._n, -1)], axis=2)
        self._places = columns
        numbers = [np.flatnonzero(observations.star == star) for star in np.unique(observations.star)]
        #: Donuts of stars with as many of them each, shape [n_star, n_donut].
        self._groups = [np.array([g for g in numbers if len(g) == size]) for size in sorted({len(g) for g in numbers})]

    def _blocks(self, group: np.ndarray, sizes: Sizes) -> np.ndarray:
        """Return the covariances of the wavefronts of stars but for the terms, [n_star, size n_noll, size n_noll]."""
        n_star, size = group.shape
        blocks = np.zeros((n_star, size, self._n, size, self._n))
        above = (1.0 - sizes.shared) * (sizes.air / _UNIT) ** 2 * self._shape
        for k in range(size):
            blocks[:, k, :, k, :] = sizes.noise * self._noise[group[:, k]] + above
        blocks += self._local(sizes)[None, None, :, None, :]
        return blocks.reshape(n_star, size * self._n, size * self._n)

    def _local(self, sizes: Sizes) -> np.ndarray:
        """Return the covariance of what each star has of its own in the telescope's wavefront."""
        return np.asarray((sizes.local / _UNIT) ** 2 * self._shape)

    def _precision(self, sizes: Sizes) -> tuple[np.ndarray, float]:
        """Return the inverse of the covariance of the terms and the ground's air, and the logarithm of its determinant.

        Degrees of freedom have units of their own; terms over the field are in metres.
        """
        variance = self._basis.variances(sizes)
        ground = sizes.shared * (sizes.air / _UNIT) ** 2 * self._shape
        ground = ground + 1e-12 * np.trace(ground) * np.eye(self._n)
        precision = np.diag(np.concatenate([1.0 / variance, np.zeros(self._n_shared)]))
        first, logarithm = len(variance), float(np.log(variance).sum())
        for start in range(first, first + self._n_shared, self._n):
            precision[start : start + self._n, start : start + self._n] = np.linalg.inv(ground)
            logarithm += float(np.linalg.slogdet(ground)[1])
        return precision, logarithm

    def _normal(self, sizes: Sizes) -> tuple[np.ndarray, np.ndarray, float, list[np.ndarray]]:
        """Return curvature and gradient of the terms, the loss without them, and inverse blocks of each group."""
        curvature, loss = self._precision(sizes)
        gradient, inverses = np.zeros(len(curvature)), []
        for group in self._groups:
            n_star, size = group.shape
            blocks = self._blocks(group, sizes)
            inverse = np.linalg.inv(blocks)
            design = self._design[group].reshape(n_star, size * self._n, -1)
            values = self._values[group].reshape(n_star, -1)
            weighted = inverse @ design
            curvature = curvature + design.reshape(-1, design.shape[2]).T @ weighted.reshape(-1, design.shape[2])
            gradient = gradient + np.einsum("gaq,ga->q", weighted, values)
            loss += float(np.linalg.slogdet(blocks)[1].sum()) + float(np.einsum("ga,gab,gb->", values, inverse, values))
            inverses.append(inverse)
        return curvature, gradient, loss, inverses

    def loss(self, sizes: Sizes) -> tuple[float, np.ndarray]:
        """Return twice the negative logarithm of the likelihood, the terms integrated over, and its slopes, [7].

        These are by the logarithms of :meth:`Sizes.of`.
        """
        curvature, gradient, loss, inverses = self._normal(sizes)
        root = _root_of_inverse(curvature)
        if root is None:
            return 1e30, np.zeros(7)
        terms = root.T @ (root @ gradient)
        loss -= 2.0 * float(np.log(np.diag(root)).sum()) + float(gradient @ terms)
        return loss, self._slopes(sizes, inverses, root, terms)

    def _slopes(self, sizes: Sizes, inverses: list[np.ndarray], root: np.ndarray, terms: np.ndarray) -> np.ndarray:
        r"""Return the slopes of :meth:`loss`, from a root of the covariance of the terms and these.

        With the covariance V of wavefronts beside the terms u, of precision P, and K, Q and w of :meth:`_beside` they
        are :math:`\mathrm{tr}\,Q\,dV - w^T dV w + \mathrm{tr}\,(K^{-1} - P^{-1})\,dP + u^T dP u`.
        """
        slopes, of_above = np.zeros(7), 0.0
        above = 2.0 * (1.0 - sizes.shared) * (sizes.air / _UNIT) ** 2
        for group, inverse in zip(self._groups, inverses, strict=True):
            n_star, size = group.shape
            precision, pull = self._beside(group, inverse, root, terms)
            by_donuts = (precision - pull[:, :, None] * pull[:, None, :]).reshape(n_star, size, self._n, size, self._n)
            for k in range(size):
                of_donut = by_donuts[:, k, :, k]
                slopes[0] += sizes.noise * float(np.vdot(of_donut, self._noise[group[:, k]]))
                of_above += above * float(np.vdot(of_donut.sum(axis=0), self._shape))
            slopes[5] += 2.0 * float(np.vdot(by_donuts.sum(axis=(0, 1, 3)), self._local(sizes)))
        variance = self._basis.variances(sizes)
        first = len(variance)
        squares = (root[:, :first] ** 2).sum(axis=0) + terms[:first] ** 2
        slopes[2:5] = self._basis.slopes(sizes) @ ((1.0 - squares / variance) / variance)
        of_ground = root[:, first:].T @ root[:, first:] + np.outer(terms[first:], terms[first:])
        ground = self._precision(sizes)[0][first:, first:]
        by_ground = 2.0 * (self._n_shared - float(np.vdot(of_ground, ground)))
        slopes[1] = of_above + by_ground
        slopes[6] = 0.5 * ((1.0 - sizes.shared) * by_ground - sizes.shared * of_above)
        return slopes

    def _beside(
        self, group: np.ndarray, inverse: np.ndarray, root: np.ndarray, terms: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        r"""Return what a group's wavefronts y say beside all terms, :math:`Q` [n_star, n, n], and w [n_star, n].

        With the inverse of V, the columns D of terms u and their covariance :math:`K^{-1}`, of which there is a root,
        :math:`Q = V^{-1} - V^{-1} D K^{-1} D^T V^{-1}` is a block of the inverse covariance of all wavefronts, and
        :math:`w = V^{-1} (y - D u)` what that makes of these.
        """
        n_star, size = group.shape
        design = self._design[group].reshape(n_star, size * self._n, -1)
        weighted = inverse @ design
        determined = (weighted.reshape(-1, weighted.shape[2]) @ root.T).reshape(weighted.shape)
        residual = self._values[group].reshape(n_star, -1) - design @ terms
        return inverse - determined @ np.swapaxes(determined, 1, 2), np.einsum("gab,gb->ga", inverse, residual)

    def chi2_by_the_others(self, sizes: Sizes) -> np.ndarray:
        """Return chi-square a term of each donut's star about what other stars say of it, shape [n]."""
        curvature, gradient, _, inverses = self._normal(sizes)
        root, result = _root_of_inverse(curvature), np.zeros(self._count)
        if root is None:
            return result
        for group, inverse in zip(self._groups, inverses, strict=True):
            precision, pull = self._beside(group, inverse, root, root.T @ (root @ gradient))
            # Blocks of the inverse covariance of all are those of each about all others.
            chi2 = np.einsum("ga,ga->g", pull, np.linalg.solve(precision, pull[..., None])[..., 0])
            result[group] = chi2[:, None] / pull.shape[1]
        return result

    def solved(self, sizes: Sizes, loss: float) -> Hierarchy:
        """Return the wavefronts for sizes of the parts."""
        curvature, gradient, _, inverses = self._normal(sizes)
        scale = 1.0 / np.sqrt(np.diag(curvature))
        normalized = curvature * np.outer(scale, scale)
        covariance = np.linalg.pinv(normalized, hermitian=True) * np.outer(scale, scale)
        terms = covariance @ gradient
        n_term = self._places.shape[2]
        of_terms = covariance[:n_term, :n_term]
        telescope = self._places @ terms[:n_term]
        telescope_covariance = np.einsum("maq,qr,mbr->mab", self._places, of_terms, self._places, optimize=True)
        total = np.zeros_like(self._values)
        total_covariance = np.zeros_like(self._noise)
        local = self._local(sizes)
        above = (1.0 - sizes.shared) * (sizes.air / _UNIT) ** 2 * self._shape
        for group, inverse in zip(self._groups, inverses, strict=True):
            n_star, size = group.shape
            design = self._design[group].reshape(n_star, size * self._n, -1)
            residual = self._values[group].reshape(n_star, -1) - design @ terms
            for k in range(size):
                donuts = group[:, k]
                # Covariances of what a donut has beside the terms with the wavefronts of its star.
                of_star = np.tile(local, size)
                of_light = of_star.copy()
                of_light[:, k * self._n : (k + 1) * self._n] += above
                fixed = self._places[donuts], np.zeros((n_star, self._n, self._n_shared))
                for own, columns, variance, values, covariances in (
                    (of_star, np.concatenate(fixed, axis=2), local, telescope, telescope_covariance),
                    (of_light, self._design[donuts], local + above, total, total_covariance),
                ):
                    gain = own @ inverse
                    change = columns - gain @ design
                    values[donuts] = columns @ terms + np.einsum("gab,gb->ga", gain, residual)
                    covariances[donuts] = (
                        variance
                        - gain @ own.T
                        + np.einsum("gaq,qr,gbr->gab", change, covariance, change, optimize=True)
                    )
        return Hierarchy(
            sizes,
            loss,
            terms[:n_term],
            of_terms,
            telescope * _UNIT,
            telescope_covariance * _UNIT**2,
            total * _UNIT,
            total_covariance * _UNIT**2,
        )


def _root_of_inverse(matrix: np.ndarray) -> np.ndarray | None:
    """Return a triangular root whose transpose times itself is the inverse of a positive matrix; None if it is not."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    # Of a symmetric matrix the transpose is in the order of LAPACK, without a copy.
    factor, failed = lapack.dpotrf((matrix * np.outer(scale, scale)).T, lower=1, clean=1, overwrite_a=1)
    return None if failed else np.asarray(lapack.dtrtri(factor, lower=1, overwrite_c=1)[0] * scale)


def star_numbers(fields: np.ndarray, within: float, names: Sequence[int] | None = None) -> np.ndarray:
    """Return the number of the star of each donut: the same for fields [rad] within a distance, or for equal names."""
    if names is not None:
        return np.unique(np.asarray(names), return_inverse=True)[1]
    numbers = np.full(len(fields), -1)
    for i in range(len(fields)):
        if numbers[i] < 0:
            near = (np.hypot(*(fields - fields[i]).T) <= within) & (numbers < 0)
            numbers[near] = i
    return np.unique(numbers, return_inverse=True)[1]
