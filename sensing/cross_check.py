"""Errors of donuts of one exposure, checked against each other: scatter of their wavefronts about a smooth field."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from .star_errors import ErrorParts

#: Least number of donuts for wavefronts that are linear over the field.
_FOR_LINEAR = 6
#: Least number of donuts near each other, whose wavefronts are taken to be the same.
_FOR_CONSTANT = 3
#: Distance of such donuts from the middle one over the radius of the field.
_NEAR = 0.1
#: Scatter from which on donuts are not of one exposure of one telescope [m]: air of 8 s at the LSST.
_MOST_SCATTER = 150e-9
#: Fraction of the air's wavefront that stars do not share: two thirds are in the layer at the ground.
_AIR_OF_ITS_OWN = 1.0 / 3.0
#: Standard deviations by which the scatter is larger than claimed, to be more than chance.
_SIGNIFICANT = 2.0
#: Independent errors of a wavefront: few combinations have most of the variance.
_INDEPENDENT = 5.0


def cross_checked(
    fields: np.ndarray,
    zernikes: np.ndarray,
    parts: Sequence[ErrorParts],
    air: Callable[[], np.ndarray],
    measured_air: bool,
) -> list[ErrorParts]:
    """Return the errors of donuts that are fitted each by itself, after a check against their scatter.

    Donuts too far apart, too few, or of wavefronts too different to be of one exposure are left as they are.

    Parameters
    ----------
    fields : ndarray, shape [n, 2]
        Field angles over the radius of the field.
    zernikes : ndarray, shape [n, n_noll]
        Wavefronts [m].
    parts : sequence of n ErrorParts
        Their errors.
    air : callable
        Covariance of unit trace that unexplained scatter has, [n_noll, n_noll].
    measured_air : bool
        Whether the air's part is measured from the residuals, not known by the exposure.
    """
    checked = list(parts)
    group, design = _smooth_field(fields)
    count, terms = design.shape
    if count == terms or not count:
        return checked
    basis = np.linalg.qr(design)[0]
    free = 1.0 - (basis**2).sum(axis=1)
    values = zernikes[group]
    scatter = float(((values - basis @ (basis.T @ values)) ** 2).sum())
    noise, lacking, in_air = (
        float(sum(w * np.trace(of(parts[i])) for w, i in zip(free, group, strict=True)))
        for of in (_noise, _lacking, lambda errors: errors.air)
    )
    excess, freedom = scatter - noise - lacking, count - terms
    if excess > _MOST_SCATTER**2 * freedom:
        return checked
    if excess > _SIGNIFICANT * (noise + lacking) * np.sqrt(2.0 / (freedom * _INDEPENDENT)):
        added = excess / freedom * air()
        return [_with_repeats(replace(errors, floor=errors.floor + added)) for errors in checked]
    unseen = max(scatter - noise, 0.0)
    share = min(unseen / lacking, 1.0) if lacking > 0.0 else 1.0
    # What stars do not share of the air is a part of the scatter.
    calm = min(unseen / (_AIR_OF_ITS_OWN * in_air), 1.0) if measured_air and in_air > 0.0 else 1.0
    for i in group:
        repeats = _noise(parts[i]) + share * _lacking(parts[i])
        checked[i] = replace(parts[i], air=calm * parts[i].air, repeats=repeats)
    return checked


def _noise(errors: ErrorParts) -> np.ndarray:
    return errors.photons


def _lacking(errors: ErrorParts) -> np.ndarray:
    return errors.residuals + errors.air + errors.floor


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
