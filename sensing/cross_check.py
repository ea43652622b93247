"""Errors of donuts of one exposure, checked against each other: scatter of their wavefronts about a smooth field."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar

from .light import Instrument
from .star_errors import ErrorParts, air_of_terms, star_errors
from .star_fitter import StarSolution

#: Least number of donuts for wavefronts that are linear over the field.
_FOR_LINEAR = 6
#: Least number of donuts near each other, whose wavefronts are taken to be the same.
_FOR_CONSTANT = 2
#: Distance of such donuts from the middle one over the radius of the field.
_NEAR = 0.1
#: Scatter from which on donuts are not of one exposure of one telescope [m]: air of 8 s at the LSST.
_MOST_SCATTER = 150e-9
#: Part of unexplained scatter that is where the donuts differ, beside that of the air: it may have another cause.
_WHERE_SEEN = 0.5
#: Least rms of the air's wavefront about which its prior lies, whatever the residuals say [m].
_LEAST_AIR = 20e-9
#: Standard deviation of the logarithm of its variance.
_AIR_SPREAD = 2.0
#: Standard deviations by which the scatter is larger than claimed, to be more than chance.
_SIGNIFICANT = 2.0
#: Independent errors of a wavefront: few combinations have most of the variance.
_INDEPENDENT = 5.0


def checked_parts(instrument: Instrument, stars: Sequence[StarSolution], fields: np.ndarray) -> list[ErrorParts]:
    """Return the errors of stars that were fitted each by itself, after :func:`cross_checked`.

    ``fields`` has their field angles [rad], shape [n, 2].
    """
    n = len(instrument.terms.requested)
    return cross_checked(
        fields / instrument.telescope.field_radius,
        np.array([star.solution.shared[:n] for star in stars]).reshape(-1, n),
        [star_errors(instrument, star).parts for star in stars],
        np.array([star.light.depth > 0.0 for star in stars], dtype=bool),
        partial(air_of_terms, instrument),
        None if instrument.model.air.atmosphere is not None else instrument.shared_air,
    )


def cross_checked(
    fields: np.ndarray,
    zernikes: np.ndarray,
    parts: Sequence[ErrorParts],
    behind: np.ndarray,
    air: Callable[[], np.ndarray],
    shared: float | None,
) -> list[ErrorParts]:
    """Return the errors of donuts that are fitted each by itself, after a check against their scatter.

    Donuts too far apart, too few, or of wavefronts too different to be of one exposure are left as they are. Donuts
    near each other on both sides of focus are of one telescope, however different.

    Parameters
    ----------
    fields : ndarray, shape [n, 2]
        Field angles over the radius of the field.
    zernikes : ndarray, shape [n, n_noll]
        Wavefronts [m].
    parts : sequence of n ErrorParts
        Their errors.
    behind : ndarray of bool, shape [n]
        Whether the detector is behind focus.
    air : callable
        Covariance of unit trace that unexplained scatter has, [n_noll, n_noll].
    shared : float, optional
        Part of the air's variance that they share, which is measured from the residuals; None if the exposure is known.
    """
    checked = list(parts)
    group, design = _smooth_field(fields)
    count, terms = design.shape
    if count == terms or not count:
        return checked
    basis = np.linalg.qr(design)[0]
    free = 1.0 - (basis**2).sum(axis=1)
    values = zernikes[group]
    of_terms = ((values - basis @ (basis.T @ values)) ** 2).sum(axis=0)
    scatter = float(of_terms.sum())
    freedom = count - terms
    both_sides = terms == 1 and len(set(behind[group])) == 2
    most = math.inf if both_sides else _MOST_SCATTER**2 * freedom
    noise, residuals = (
        float(sum(w * np.trace(of(parts[i])) for w, i in zip(free, group, strict=True))) for of in (_noise, _residuals)
    )
    # All of them have looked through one air, of which the residuals of one donut say little.
    common = np.mean([parts[i].air for i in group], axis=0)
    residual_air = float(np.trace(common))
    lacking = residuals + freedom * residual_air
    # Donuts near each other look through one air: what they differ by may be anything else.
    near = bool((np.hypot(*(fields[group] - fields[group].mean(axis=0)).T) < _NEAR).all())
    middle = residual_air if near else max(residual_air, _LEAST_AIR**2)
    if shared is not None and middle > 0.0 and scatter < most + noise + lacking:
        # What donuts share of the air is no part of the scatter.
        unshared = (1.0 - shared) * freedom
        variance = _air_variance(scatter, noise + residuals, unshared, middle, _INDEPENDENT * freedom)
        of_air = min(variance / residual_air, 1.0) * common if residual_air > 0.0 else common
        of_air = of_air + max(variance - residual_air, 0.0) * air()
        for i in group:
            errors = parts[i]
            checked[i] = ErrorParts.of(errors.photons, errors.residuals, of_air, errors.floor)
        lacking = residuals + unshared * variance
    excess = scatter - noise - lacking
    if excess > most:
        return list(parts)
    if excess > _SIGNIFICANT * (noise + lacking) * np.sqrt(2.0 / (freedom * _INDEPENDENT)):
        added = excess / freedom * ((1.0 - _WHERE_SEEN) * air() + _WHERE_SEEN * np.diag(of_terms / scatter))
        return [_with_repeats(replace(errors, floor=errors.floor + added)) for errors in checked]
    share = min(max(scatter - noise, 0.0) / lacking, 1.0) if lacking > 0.0 else 1.0
    for i in group:
        errors = checked[i]
        own = _lacking(errors) - (shared or 0.0) * errors.air
        checked[i] = replace(errors, repeats=_noise(errors) + share * own)
    return checked


def _air_variance(scatter: float, others: float, unshared: float, middle: float, freedom: float) -> float:
    """Return the likeliest variance of the air's wavefront by the scatter of the donuts.

    The scatter has so many degrees of freedom; it is expected to be what all else makes, and the variance times
    `unshared`. The prior lies about the variance `middle`.
    """

    def loss(logarithm: float) -> float:
        expected = others + math.exp(logarithm) * middle * unshared
        prior = 0.5 * (logarithm / _AIR_SPREAD) ** 2
        return prior + 0.5 * freedom * (math.log(expected) + scatter / expected)

    return middle * math.exp(float(minimize_scalar(loss, bounds=(-8.0, 8.0), method="bounded").x))


def _noise(errors: ErrorParts) -> np.ndarray:
    return errors.photons


def _residuals(errors: ErrorParts) -> np.ndarray:
    return errors.residuals


def _lacking(errors: ErrorParts) -> np.ndarray:
    return errors.residuals + errors.air


def _with_repeats(errors: ErrorParts) -> ErrorParts:
    return replace(errors, repeats=errors.total)


def _smooth_field(fields: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the donuts that can be compared, and the terms of a smooth field at each, [n, n_term]."""
    count = len(fields)
    if count >= _FOR_LINEAR:
        return np.arange(count), np.column_stack([np.ones(count), fields])
    distance = np.hypot(*(fields[:, None] - fields[None]).transpose(2, 0, 1)) if count else np.zeros((0, 0))
    near = distance < _NEAR
    middle = int(near.sum(axis=1).argmax()) if count else 0
    group = np.flatnonzero(near[middle]) if count else np.zeros(0, dtype=np.int64)
    return (group, np.ones((len(group), 1))) if len(group) >= _FOR_CONSTANT else (group[:0], np.zeros((0, 1)))
