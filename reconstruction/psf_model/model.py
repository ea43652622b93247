"""The PSF across a CCD from its stars: a mean, components, and their amplitudes as functions of position.

Jee & Tyson 2011, section 3: mean PSF with outlier rejection, singular value decomposition, and polynomials for the
amplitudes of the first components. Pixels or shapelets may stand for the principal components, and a Gaussian process
for the polynomials, behind the same interface.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike, NDArray

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, ProductError
from ...core.products import read_fits, write_fits
from ...core.threads import one_blas_thread
from ...core.version import CREATOR
from . import gaussian_process, kriging
from .basis import elbow_of
from .file import model_fields, model_hdus
from .fit import fit_fields, weighted
from .picture import PicturedModel
from .polynomial import Extent, design_matrix, mapped

#: Pixels of noisy stars that deviate by more standard deviations are rejected.
CLIP_SIGMA = 5.0


@dataclass(frozen=True, eq=False)
class PsfModel(PicturedModel):
    """A PSF model of one CCD: PSF = mean + sum over k of a_k(x, y) component_k.

    Every stamp is normalised to unit sum, so the components sum to zero and the model to one wherever it is evaluated.

    Parameters
    ----------
    mean : array
        Mean PSF, [ny, nx], unit sum.
    components : array
        [k, ny, nx]. Eigen-PSFs by falling eigenvalue, the element of largest magnitude of each positive; or shapelets
        of unit sum by rising order; both orthonormal. Or one for each pixel.
    coefficients : array
        Projections of the stars on the components, [n, k].
    polynomial : array
        Coefficients of the terms of :func:`~pachon.reconstruction.psf_model.polynomial.design_matrix`, [n_terms, k].
    eigenvalues : array
        All n - 1 eigenvalues of the covariance of the stamps (fewer where a stamp has fewer pixels), falling.
    positions : array
        Positions of the stars, [n, 2].
    order : int
        Largest total degree of the polynomials.
    extent : tuple of float
        (xmin, xmax, ymin, ymax), in the unit of the positions, mapped to [-1, 1].
    unexplained : array
        Per star, sum over its pixels of the square of what the components leave, [n].
    rejected : array of int
        Per star, pixels rejected as outliers and replaced, [n].
    basis : str
        ``pca``, ``pixels`` or ``shapelets``.
    scale : float
        rms width of the Gaussian under shapelets [pixel]; NaN else.
    weights : array or None
        Of the stars in the polynomials, [n]; under a process their inverse variances, in units of the middle star's.
    kernel : array or None
        Of a Gaussian process for each component: variance, correlation length where the extent is 2 wide, variance of
        the noise, [k, 3]; under kriging those of :data:`.kriging.COLUMNS`. None where there are only polynomials.
    alpha : array or None
        Dual coefficients of the Gaussian process: inverse covariance times coefficients less trend, [n, k].
    """

    mean: np.ndarray
    components: np.ndarray
    coefficients: np.ndarray
    polynomial: np.ndarray
    eigenvalues: np.ndarray
    positions: np.ndarray
    order: int
    extent: Extent
    unexplained: np.ndarray
    rejected: np.ndarray
    basis: str = "pca"
    scale: float = np.nan
    weights: np.ndarray | None = None
    kernel: np.ndarray | None = None
    alpha: np.ndarray | None = None

    @classmethod
    @check_arguments
    def fit(
        cls,
        stamps: ArrayLike,
        positions: ArrayLike,
        *,
        basis: Literal["pca", "pixels", "shapelets"] = "pca",
        interpolation: Literal["polynomial", "gp", "kriging"] = "polynomial",
        weights: ArrayLike | Literal["noise"] | None = None,
        masks: NDArray[np.bool_] | None = None,
        n_components: int | Literal["auto"] | None = None,
        order: int | Literal["auto"] | None = None,
        extent: ArrayLike | None = None,
        scale: float | None = None,
        gain: float | None = 1.0,
        clip_sigma: float | None = CLIP_SIGMA,
        max_iterations: int = 20,
        replacement: Literal["mean", "polynomial"] = "mean",
    ) -> PsfModel:
        """Fit the model to the stars of one CCD.

        Outliers are found pixel by pixel (:func:`~.find_outliers`) and replaced by the mean
        of the stars that are good there. By default the polynomials are fitted without weights, as in Jee & Tyson 2011,
        sec. 3.

        Parameters
        ----------
        stamps : array
            [n, ny, nx] background-subtracted stars centred on a pixel; of any flux, normalised to unit sum here.
        positions : array
            [n, 2] of the stars, in any unit.
        basis : str
            ``pca``: eigen-PSFs. ``pixels``: every pixel on its own. ``shapelets``: Gauss-Hermite functions, which
            truncate the wings (Jee & Tyson 2011, sec. 3).
        interpolation : str
            ``polynomial``, or ``gp``: a Gaussian process for each component (one for all pixels) over a polynomial
            trend, with the noise of each star. ``kriging``: one rule for all pixels, with the noise of each star
            (:mod:`~.psf_model.kriging`); with ``basis="pixels"`` the best choice where nothing is known.
        weights : array or str, optional
            [n] of the stars in the polynomials. ``noise``: in the mean and the eigen-PSFs, too, each star counts by the
            inverse of its noise and of what the polynomials leave (:mod:`~.psf_model.shape_noise`); where `order` or
            `n_components` is ``auto`` this is the default.
        masks : array of bool, optional
            [n, ny, nx], True for pixels to ignore. They are replaced by the polynomial through the stars in which the
            pixel is good, so that they have no influence on the fit.
        n_components : int or str, optional
            Components to keep, 20 where left out: principal ones at most n - 1, of shapelets those of sum zero.
            ``auto`` takes the number, up to 65, that predicts the shapes of held-out stars best; :attr:`elbow` is the
            alternative. None for pixels.
        order : int or str, optional
            Largest total degree of the polynomials, 3 where left out; of the trend 0 under a Gaussian process and 4 in
            kriging, which shrinks it. ``auto``: of polynomials the order, up to 4, that predicts held-out stars best.
        extent : tuple of float, optional
            (xmin, xmax, ymin, ymax) of the CCD in the unit of the positions. Where left out, that of the stars.
        scale : float, optional
            rms width of the Gaussian under the shapelets [pixel]; by default the one with the least residual of the
            stars.
        gain : float or None
            Electrons in a unit of the stamps, for the photon noise of the stars; None for none. Kriging refuses stamps
            that are not in electrons; else their photon noise counts as unknown.
        clip_sigma : float or None
            Pixels that deviate by more standard deviations are rejected; with None, for noise-free stars, none is.
        max_iterations : int
            Most passes of the rejection.
        replacement : str
            Replacement of rejected pixels: the ``mean`` of the stars, as in the paper, or as for masked ones the
            ``polynomial`` of the others.

        Raises
        ------
        ConfigError
            If there are more components than stars less one, or more polynomial terms than stars, or an option has no
            such value.
        DomainError
            If an array has the wrong shape, a pixel is not finite, a star has no flux, or the stars do not determine
            the polynomials (all on a line, say).
        """
        fitted = fit_fields(
            stamps,
            positions,
            basis=basis,
            interpolation=interpolation,
            weights=weights,
            masks=masks,
            n_components=n_components,
            order=order,
            extent=extent,
            scale=scale,
            gain=gain,
            clip_sigma=clip_sigma,
            max_iterations=max_iterations,
            replacement=replacement,
        )
        return cls(**fitted)

    @property
    def n_stars(self) -> int:
        """Number of stars of the fit."""
        return len(self.coefficients)

    @property
    def n_rejected(self) -> int:
        """Number of pixels rejected as outliers in all stars."""
        return int(self.rejected.sum())

    @property
    def explained_variance(self) -> np.ndarray:
        """Fraction of the variance of the stamps along each component, [k] (zeros where all stamps are equal)."""
        total = self.eigenvalues.sum()
        along = self.eigenvalues[: self.n_components]
        if self.basis != "pca":
            along = self.coefficients.var(axis=0, ddof=1)
        return along / (total if total > 0.0 else 1.0)

    @property
    def explained(self) -> float:
        """Fraction of the variance of the stamps in all components together."""
        return float(self.explained_variance.sum())

    @property
    def elbow(self) -> int:
        """Number of principal components before the eigenvalues flatten out, see :func:`~.basis.elbow_of`."""
        return elbow_of(self.eigenvalues)

    @property
    def leave_one_out_curve(self) -> np.ndarray:
        """Rms of stamps minus models without the star, by components used, 0 to k; the last is `leave_one_out_rms`."""
        left_out, own = self._leave_one_out_residuals() ** 2, self.coefficients**2
        gained = np.concatenate([[0.0], np.cumsum((left_out - own).sum(axis=0))])
        total = self.unexplained.sum() + own.sum() + gained
        return np.sqrt(np.maximum(total, 0.0) / (self.n_stars * self.mean.size))

    @property
    def leverage(self) -> np.ndarray:
        """Diagonal of the polynomials' hat matrix, [n]: how far a star determines the fit at its own place, 0 to 1.

        That of the trend alone, without weights, where there is a Gaussian process.
        """
        with one_blas_thread():
            q, _ = np.linalg.qr(weighted(design_matrix(self.positions, self.extent, self.order), self.weights))
        return (q**2).sum(axis=1)

    @check_arguments
    def at(self, positions: ArrayLike) -> np.ndarray:
        """Evaluate the PSF at positions, [m, ny, nx], unit sum.

        Outside the extent polynomials are extrapolated. Positions are evaluated on their own: no batch changes a byte.

        Parameters
        ----------
        positions : array
            [m, 2], or one position [2], in the unit of the fit.
        """
        return self._combine(self.amplitudes(positions))

    @check_arguments
    def draw(self, x: float, y: float) -> np.ndarray:
        """Evaluate the PSF at one position, [ny, nx], unit sum."""
        return self.at((x, y))[0]

    @check_arguments
    def amplitudes(self, positions: ArrayLike) -> np.ndarray:
        """Evaluate the amplitudes of the components at positions, [m, k]."""
        terms = design_matrix(positions, self.extent, self.order)
        result = np.zeros((len(terms), self.n_components))
        for column, row in zip(terms.T, self.polynomial, strict=True):  # no BLAS: its sums depend on the batch
            result += column[:, None] * row
        if self.kernel is not None and self.alpha is not None:
            points, at = (mapped(p, self.extent) for p in (self.positions, positions))
            if self._kriged:
                result += kriging.predict(points, at, self.kernel[0], self.alpha)
            else:
                result += gaussian_process.predict(points, at, self.kernel, self.alpha)
        return result

    def reconstruct(self) -> np.ndarray:
        """Return the stars from their own projections on the components, without the polynomials, [n, ny, nx]."""
        return self._combine(self.coefficients)

    def leave_one_out(self) -> np.ndarray:
        """Return the model at each star with that star left out of the interpolation, [n, ny, nx].

        Mean PSF, components and the kernel of a process are held, to which the star did contribute; only the
        polynomials are those of the other n - 1 stars. That needs no new fit: the residual of a star left out is that
        in the full fit divided by 1 - leverage. NaN where the other stars do not determine the polynomials.
        """
        return self._combine(self.coefficients - self._leave_one_out_residuals())

    @property
    def leave_one_out_rms(self) -> float:
        """Rms over stars and pixels of (stamp - :meth:`leave_one_out`), what the components cannot hold included."""
        squares = (self._leave_one_out_residuals() ** 2).sum(axis=1) + self.unexplained
        return float(np.sqrt(squares.mean() / self.mean.size))

    @check_arguments
    def truncated(self, n_components: int) -> PsfModel:
        """Return the model with its first components only; the others count as unexplained.

        Raises
        ------
        ConfigError
            If the model has fewer components, or is one of pixels, which have no order.
        """
        k = n_components
        if self.basis == "pixels" or not 1 <= k <= self.n_components:
            raise ConfigError(f"n_components = {k}: expected 1 to {self.n_components} of a model of pca or shapelets")
        return replace(
            self,
            components=self.components[:k],
            coefficients=self.coefficients[:, :k],
            polynomial=self.polynomial[:, :k],
            unexplained=self.unexplained + (self.coefficients[:, k:] ** 2).sum(axis=1),
            kernel=None if self.kernel is None else self.kernel[:k],
            alpha=None if self.alpha is None else self.alpha[:, :k],
        )

    def to_hdus(self, name: str = "PSF") -> list[fits.ImageHDU | fits.BinTableHDU]:
        """Return the model as FITS extensions, lossless; :meth:`from_hdus` reads them.

        Parameters
        ----------
        name : str
            Start of the extension names, such as the CCD's name: NAME_MEAN, NAME_EIGEN, NAME_POLY, NAME_EXTENT images
            and NAME_SPECTRUM, NAME_STARS tables.
        """
        return model_hdus({field.name: getattr(self, field.name) for field in fields(self)}, name)

    @classmethod
    def from_hdus(cls, hdus: Iterable[Any], name: str = "PSF") -> PsfModel:
        """Read a model from FITS extensions written by :meth:`to_hdus`.

        Raises
        ------
        ProductError
            If an extension or a column is missing.
        """
        return cls(**model_fields(hdus, name))

    @check_arguments
    def write(self, path: str | Path, name: str = "PSF") -> None:
        """Write the model to a FITS file of its own, with checksums; lossless.

        Raises
        ------
        ProductError
            If it cannot be written.
        """
        write_fits(Path(path), self.to_hdus(name), None, [CREATOR])

    @classmethod
    @check_arguments
    def read(cls, path: str | Path, name: str = "PSF") -> PsfModel:
        """Read a model from a FITS file: one of :meth:`write`, or the product of a CCD.

        Raises
        ------
        ProductError
            If there is no such file, it is cut short, damaged or not FITS, or holds no model of that name.
        """
        hdus = read_fits(Path(path))
        try:
            return cls.from_hdus(hdus, name)
        except ProductError as error:
            raise ProductError(str(error), file=path) from None

    def _leave_one_out_residuals(self) -> np.ndarray:
        """Return coefficient minus its prediction by the other stars, [n, k]."""
        if self.kernel is not None:
            points = mapped(self.positions, self.extent)
            terms = design_matrix(self.positions, self.extent, self.order)
            with one_blas_thread():
                if self._kriged and self.weights is not None:
                    return kriging.krige(points, self.coefficients, terms, self.kernel[0], 1.0 / self.weights)[2]
                # Files of older versions have no noise of their stars, which was taken to be the same.
                noise = np.ones(self.n_stars) if self.weights is None else 1.0 / self.weights
                return gaussian_process.krige(points, self.coefficients, terms, self.kernel, noise)[2]
        room = 1.0 - self.leverage
        room = np.where(room > 1e-10, room, np.nan)
        return (self.coefficients - self.amplitudes(self.positions)) / room[:, None]

    @property
    def _kriged(self) -> bool:
        return self.kernel is not None and self.kernel.shape[1] >= kriging.COLUMNS

    def _combine(self, amplitudes: np.ndarray) -> np.ndarray:
        """Return mean plus amplitudes times components, one component after the other so that no batch size matters."""
        if self.basis == "pixels":
            return self.mean + amplitudes.reshape(-1, *self.mean.shape)
        result = np.repeat(self.mean[None], len(amplitudes), axis=0)
        for k, component in enumerate(self.components):
            result += amplitudes[:, k, None, None] * component
        return result
