"""Prediction of PSF shapes over the focal plane: optics, and a Gaussian random field of the residuals of the stars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.statistics import RMS_PER_MAD
from .covariance import Covariance, Places
from .fit import ShapeData, columns_acting_on
from .kriging import Neighbourhood, leave_one_out, map_on_threads, neighbourhood, neighbours_of
from .likelihood import blocks_of
from .mosaic import Mosaic
from .optics_part import OpticsPart
from .response import N_EXPOSURE

#: Stars that deviate by more standard deviations from the prediction of all others are left out.
CLIP_SIGMA = 6.0


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
    covariances : tuple of Covariance
        Of e1, e2 and ln size.
    optics : OpticsPart or None
        The optical part; None where there is no telescope.
    design : ndarray, shape [n, n_parameter, 3], or None
        Derivatives of the optical shapes of the stars with respect to the parameters that act on their CCD.
    """

    mosaic: Mosaic
    data: ShapeData
    residuals: np.ndarray
    covariances: tuple[Covariance, ...]
    optics: OpticsPart | None = None
    design: np.ndarray | None = None

    def with_stars(self, which: np.ndarray) -> ShapeField:
        """Return the field restricted to some of its stars."""
        data = ShapeData(self.data.places[which], self.data.values[which], self.data.noise[which])
        design = None if self.design is None else self.design[which]
        return ShapeField(self.mosaic, data, self.residuals[which], self.covariances, self.optics, design)

    def predict(
        self, places: Places, *, variance: bool = False, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return e1, e2 and ln size at places, shape [n, 3], and their variances, of the same shape, or None."""
        values = np.zeros((len(places), 3))
        if self.optics is not None:
            values += self.optics.shapes(places, threads)
        design = self.optics.design(places, values, threads) if variance and self.optics is not None else None
        ccds = np.unique(places.ccd)

        def job(ccd: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            at = np.flatnonzero(places.ccd == ccd)
            change, spread = np.empty((len(at), 3)), np.zeros((len(at), 3))
            stars = self._neighbours(ccd)
            for shape in range(3):
                near = self._neighbourhood(stars, shape)
                between = self.covariances[shape].between(self.data.places[stars], places[at])
                change[:, shape] = near.predict(between)
                if variance:
                    weights = near.weights(between)
                    spread[:, shape] = self.covariances[shape].at(places[at]) - (between * weights).sum(axis=0)
                    if design is not None:
                        spread[:, shape] += self._optics_variance(ccd, shape, design[at, :, shape], stars, weights)
            return at, change, spread

        variances = np.empty((len(places), 3)) if variance else None
        for at, change, spread in map_on_threads(job, ccds, threads):
            values[at] += change
            if variances is not None:
                variances[at] = spread
        return values, variances

    def _neighbours(self, ccd: int) -> np.ndarray:
        return neighbours_of(self.data.places, self.mosaic.centers[ccd])

    def _neighbourhood(self, stars: np.ndarray, shape: int) -> Neighbourhood:
        values, noise = self.residuals[:, shape], self.data.noise[:, shape]
        return neighbourhood(self.covariances[shape], self.data.places, values, noise, stars)

    def _optics_variance(
        self, ccd: int, shape: int, design: np.ndarray, stars: np.ndarray, weights: np.ndarray
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

        sensitivity = np.zeros((len(design), len(used)))
        sensitivity[:, columns(ccd)] = design
        for star_ccd in np.unique(at):
            rows = at == star_ccd
            sensitivity[:, columns(star_ccd)] -= weights[rows].T @ self.design[stars[rows], :, shape]
        covariance = self.optics.covariance[np.ix_(used, used)].astype(np.float64)
        return np.asarray(((sensitivity @ covariance) * sensitivity).sum(axis=1))

    def leave_one_out_residuals(self, threads: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return shapes minus leave-one-out predictions, and their variances, each of shape [n, 3].

        NaN for the farthest stars of a CCD with more stars than a neighbourhood holds.
        """
        ccds = np.unique(self.data.places.ccd)

        def job(ccd: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            stars = self._neighbours(ccd)
            on_ccd = self.data.places.ccd[stars] == ccd
            pairs = [leave_one_out(self._neighbourhood(stars, shape)) for shape in range(3)]
            return (
                stars[on_ccd],
                np.stack([p[0][on_ccd] for p in pairs], axis=1),
                np.stack([p[1][on_ccd] for p in pairs], axis=1),
            )

        residuals, variance = np.full((2, len(self.data), 3), np.nan)
        for at, difference, spread in map_on_threads(job, ccds, threads):
            residuals[at], variance[at] = difference, spread
        return residuals, variance

    def inliers(self, threads: int | None = None) -> np.ndarray:
        """Return the stars within :data:`CLIP_SIGMA` of the prediction from the others of their block, [n] bool."""
        data = self.data

        def job(index: np.ndarray) -> np.ndarray:
            values = []
            for shape, covariance in enumerate(self.covariances):
                near = neighbourhood(covariance, data.places, self.residuals[:, shape], data.noise[:, shape], index)
                block_residuals, variance = leave_one_out(near)
                values.append(block_residuals / np.sqrt(variance))
            return np.stack(values, axis=1)

        blocks = blocks_of(data.places.xy)
        deviation = np.empty((len(data), 3))
        for index, values in zip(blocks, map_on_threads(job, blocks, threads), strict=True):
            deviation[index] = values
        typical = np.maximum(RMS_PER_MAD * np.median(np.abs(deviation), axis=0), 1.0)
        return np.asarray((np.abs(deviation) < CLIP_SIGMA * typical).all(axis=1))
