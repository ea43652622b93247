"""Errors of unknowns that donuts share: what the model lacks, air, and terms of the telescope that are not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .cross_check import checked_parts
from .light import Instrument
from .likelihood import linearized
from .residual_power import residual_power
from .solve import Group, Solution
from .star_errors import StarErrors, resolution
from .star_fitter import StarSolution


@dataclass(frozen=True)
class JointErrors:
    """Errors of a joint solution beyond the noise of the pixels.

    Attributes
    ----------
    residuals : Solution
        The solution, with the covariance of all its unknowns by what the model lacks.
    air, figure : ndarray, shape [n_shared, n_shared]
        Covariance of the shared unknowns by the air, and by terms of the telescope that are not fitted.
    """

    residuals: Solution
    air: np.ndarray
    figure: np.ndarray

    @property
    def shared(self) -> np.ndarray:
        """Covariance of the shared unknowns by all causes, shape [n_shared, n_shared]."""
        return self.residuals.shared_covariance + self.air + self.figure


def joint_errors(
    instrument: Instrument,
    alone: Sequence[StarSolution],
    fields: np.ndarray,
    wave_maps: Sequence[np.ndarray] | np.ndarray,
    stars: Sequence[StarSolution],
    group: Group,
    solution: Solution,
) -> JointErrors:
    """Return the errors of a joint solution.

    Parameters
    ----------
    instrument : Instrument
        Telescope and model of the images.
    alone : sequence of StarSolution
        The stars as each was fitted by itself.
    fields : ndarray, shape [n_star, 2]
        Their field angles [rad].
    wave_maps : sequence of n_star ndarray, each of shape [n_wave, m]
        Wavefronts by the first m shared unknowns.
    stars, group : sequence of StarSolution, Group
        The stars as they were fitted together.
    solution : Solution
        Their joint solution.
    """
    n, unknowns = len(instrument.terms.requested), len(solution.shared)
    gains, errors, donuts = [], [], []
    for i, (star, wave_map) in enumerate(zip(alone, wave_maps, strict=True)):
        if isinstance(star.errors, StarErrors):
            waves, count = wave_map.shape
            information = np.linalg.pinv(star.solution.shared_covariance[:waves, :waves], hermitian=True)
            # How the shared unknowns follow the star's own wavefront.
            gains.append((solution.shared_covariance[:, :count] @ wave_map.T @ information)[:, :n])
            errors.append(star.errors)
            donuts.append(i)
    air, figure = np.zeros((2, unknowns, unknowns))
    if errors:
        common, shared = np.sum(gains, axis=0), instrument.shared_air
        # Residuals of one star say little of the air that all have, and their scatter more.
        checked = checked_parts(instrument, [alone[i] for i in donuts], fields[donuts])
        of_air = np.mean([parts.air for parts in checked], axis=0)
        own = np.sum([gain @ of_air @ gain.T for gain in gains], axis=0)
        air = shared * common @ of_air @ common.T + (1.0 - shared) * own
        figure = common @ np.mean([star_error.common for star_error in errors], axis=0) @ common.T
    return JointErrors(_by_residuals(instrument, stars, group, solution), air, figure)


def _by_residuals(instrument: Instrument, stars: Sequence[StarSolution], group: Group, solution: Solution) -> Solution:
    """Return a joint solution whose covariance is that by what the model lacks, as the residuals of its stars say."""
    covariance = np.zeros_like(solution.covariance)
    first, n_shared = 0, len(solution.shared)
    shared = np.arange(len(covariance) - n_shared, len(covariance))
    for i, stamp in enumerate(group.stamps):
        n_star = len(solution.stars[i])
        unknowns = np.concatenate([first + np.arange(n_star), shared])
        first += n_star
        point = linearized(stamp, solution.stars[i], solution.waves[i])
        if point is not None:
            columns = point.columns * point.scales.astype(np.float32)
            joined = np.concatenate(
                [columns[:, :n_star], columns[:, n_star:] @ group.maps[i].astype(np.float32)], axis=1
            )
            point = replace(point, columns=joined, scales=np.ones(n_star + n_shared))
            block = np.ix_(unknowns, unknowns)
            covariance[block] += residual_power(
                point, solution.covariance[block], resolution(instrument, stars[i])
            ).covariance
        if group.transient:
            stamp.release()
    return replace(solution, covariance=covariance)
