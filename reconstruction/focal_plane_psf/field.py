"""Prediction of PSF shapes over the focal plane: optics, and a Gaussian random field of the residuals of the stars."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...core.statistics import RMS_PER_MAD
from .covariance import Covariance, Places
from .fit import ShapeData, columns_acting_on
from .kriging import (
    NEIGHBOURS,
    NEIGHBOURS_OF_ALL,
    Neighbourhood,
    leave_one_out,
    map_on_threads,
    neighbourhood,
    neighbours_of,
)
from .layer_covariance import LayerCovariance, shape_groups
from .likelihood import blocks_of
from .mosaic import Mosaic
from .optics_part import OpticsPart
from .response import N_EXPOSURE

#: Stars that deviate by more standard deviations from the prediction of all others are left out.
CLIP_SIGMA = 6.0
#: Standard deviations within which one that was left out is a star after all: one in 5000 good ones is not.
AGREEING_SIGMA = 4.0


@dataclass(frozen=True, eq=False)
class ShapeField:
    """Shapes e1, e2 and ln size of the PSF over the focal plane.

    Attributes
    ----------
    mosaic : Mosaic
        The CCDs.
    data : ShapeData
        Stars.
    residuals : ndarray, shape [n, 3]
        Their shapes less those of the optics.
    covariances : tuple of Covariance or LayerCovariance
        Of e1, e2 and ln size each, or one :class:`.LayerCovariance` of all three.
    optics : OpticsPart or None
        The optical part; None where there is no telescope.
    design : ndarray, shape [n, n_parameter, 3], or None
        Derivatives of the optical shapes of the stars with respect to the parameters that act on their CCD.
    """

    mosaic: Mosaic
    data: ShapeData
    residuals: np.ndarray
    covariances: tuple[Covariance | LayerCovariance, ...]
    optics: OpticsPart | None = None
    design: np.ndarray | None = None

    def with_stars(self, which: np.ndarray) -> ShapeField:
        """Return the field restricted to some of its stars."""
        design = None if self.design is None else self.design[which]
        return ShapeField(
            self.mosaic, self.data.chosen(which), self.residuals[which], self.covariances, self.optics, design
        )

    def predict(
        self, places: Places, *, variance: bool = False, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return e1, e2 and ln size at places, shape [n, 3], and their variances, of the same shape, or None."""
        values = np.zeros((len(places), 3))
        if self.optics is not None:
            if self.data.places.amplitude is not None:
                places = self.optics.instrument.at_amplitudes(places, threads)
            values += self.optics.shapes(places, threads)
        design = self.optics.design(places, values, threads) if variance and self.optics is not None else None

        def job(cell: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            center, at = cell
            change, spread = np.empty((len(at), 3)), np.zeros((len(at), 3))
            stars = neighbours_of(self.data.places, center, self._neighbour_count)
            for shapes, covariance in shape_groups(self.covariances):
                near = self._neighbourhood(covariance, stars, shapes)
                between = covariance.between(self.data.places[stars], places[at])
                change[:, shapes] = near.predict(between).reshape(-1, len(at)).T
                if variance:
                    weights = near.weights(between)
                    unexplained = covariance.at(places[at]) - (between * weights).sum(axis=0)
                    # What varies between neighbouring stars beside their stated noise varies at any place.
                    spread[:, shapes] = unexplained.reshape(-1, len(at)).T + covariance.nugget
                    if design is not None:
                        ccd = int(places.ccd[at[0]])
                        spread[:, shapes] += self._optics_variance(ccd, shapes, design[at], stars, weights)
            return at, change, spread

        variances = np.empty((len(places), 3)) if variance else None
        for at, change, spread in map_on_threads(job, self._cells(places), threads):
            values[at] += change
            if variances is not None:
                variances[at] = spread
        return values, variances

    @property
    def _neighbour_count(self) -> int:
        return NEIGHBOURS_OF_ALL if len(self.covariances) == 1 else NEIGHBOURS

    def _cells(self, places: Places) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the middle [m] of each CCD, or of each of its parts where it has many stars, and the places there."""
        stars_of_cell, cells = self._neighbour_count // 2, []
        for ccd in np.unique(places.ccd):
            at = np.flatnonzero(places.ccd == ccd)
            count = math.ceil(math.sqrt(np.count_nonzero(self.data.places.ccd == ccd) / stars_of_cell))
            if count <= 1:
                cells.append((self.mosaic.centers[ccd], at))
                continue
            column, row = np.clip(np.floor(0.5 * count * (places.uv[at] + 1.0)).astype(int), 0, count - 1).T
            for number in np.unique(column * count + row):
                middle = (2.0 * np.array(divmod(int(number), count)) + 1.0) / count - 1.0
                cells.append((self.mosaic.from_uv(ccd, middle), at[column * count + row == number]))
        return cells

    def _neighbourhood(
        self, covariance: Covariance | LayerCovariance, stars: np.ndarray, shapes: slice
    ) -> Neighbourhood:
        return neighbourhood(covariance, self.data.places, self.residuals[:, shapes], self.data.noise[:, shapes], stars)

    def _optics_variance(
        self, ccd: int, shapes: slice, design: np.ndarray, stars: np.ndarray, weights: np.ndarray
    ) -> np.ndarray:
        """Return the variance by uncertain optics that remains after correction by the neighbouring stars."""
        assert self.optics is not None
        assert self.design is not None
        prior, at = self.optics.prior, self.data.places.ccd[stars]
        ccds = np.union1d(at, ccd)
        used, common, width = columns_acting_on(prior, ccds), prior.n_common, prior.ccd.shape[1]

        def columns(of: int) -> np.ndarray:
            first = common + int(np.searchsorted(ccds, of)) * width
            return np.r_[:common, first : first + width, len(used) - N_EXPOSURE : len(used)]

        covariance = self.optics.covariance[np.ix_(used, used)].astype(np.float64)
        numbers = range(3)[shapes]
        # Weights of the stars' values of each shape in the predictions of each.
        by_shape = weights.reshape(len(numbers), len(stars), len(numbers), len(design))
        out = np.empty((len(design), len(numbers)))
        for k, shape in enumerate(numbers):
            sensitivity = np.zeros((len(design), len(used)))
            sensitivity[:, columns(ccd)] = design[:, :, shape]
            for star_ccd in np.unique(at):
                rows = at == star_ccd
                for of_stars, weighted in zip(numbers, by_shape[:, rows, k], strict=True):
                    sensitivity[:, columns(star_ccd)] -= weighted.T @ self.design[stars[rows], :, of_stars]
            out[:, k] = ((sensitivity @ covariance) * sensitivity).sum(axis=1)
        return out

    def leave_one_out_residuals(self, threads: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return shapes minus leave-one-out predictions, and their variances, each of shape [n, 3]."""
        places = self.data.places

        def job(cell: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            center, at = cell
            stars = np.union1d(neighbours_of(places, center, self._neighbour_count), at)
            rows = np.searchsorted(stars, at)
            groups = shape_groups(self.covariances)
            pairs = [leave_one_out(self._neighbourhood(c, stars, shapes)) for shapes, c in groups]
            difference, spread = (np.concatenate([p[k][rows] for p in pairs], axis=1) for k in range(2))
            return at, difference, spread

        residuals, variance = np.full((2, len(self.data), 3), np.nan)
        for at, difference, spread in map_on_threads(job, self._cells(places), threads):
            residuals[at], variance[at] = difference, spread
        return residuals, variance

    def agrees_with(self, stars: ShapeData, threads: int | None = None) -> np.ndarray:
        """Return which of other stars lie within :data:`AGREEING_SIGMA` of the prediction, [n] bool."""
        predicted, variance = self.predict(stars.places, variance=True, threads=threads)
        assert variance is not None
        spread = AGREEING_SIGMA * np.sqrt(variance + stars.noise)
        return np.asarray((np.abs(stars.values - predicted) < spread).all(axis=1))

    def inliers(self, threads: int | None = None, *, sigma: float = CLIP_SIGMA, least: float = 1.0) -> np.ndarray:
        """Return the stars within `sigma` typical deviations of the prediction from others of their block, [n] bool.

        `least` is the least typical deviation over that expected.
        """
        data = self.data

        def job(index: np.ndarray) -> np.ndarray:
            values = []
            for shapes, covariance in shape_groups(self.covariances):
                block_residuals, variance = leave_one_out(self._neighbourhood(covariance, index, shapes))
                values.append(block_residuals / np.sqrt(variance))
            return np.concatenate(values, axis=1)

        blocks = blocks_of(data.places.xy)
        deviation = np.empty((len(data), 3))
        for index, values in zip(blocks, map_on_threads(job, blocks, threads), strict=True):
            deviation[index] = values
        typical = np.maximum(RMS_PER_MAD * np.median(np.abs(deviation), axis=0), least)
        return np.asarray((np.abs(deviation) < sigma * typical).all(axis=1))
