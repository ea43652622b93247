"""The PSF across a CCD from its stars: principal components, their amplitudes polynomials of position.

Jee & Tyson 2011, section 3: mean PSF with outlier rejection, singular value decomposition, and polynomials for the
amplitudes of the first components.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from astropy.io import fits

from ..models.errors import ConfigError, DomainError, ProductError
from .outliers import find_outliers, restore_predicted
from .polynomial import Extent, as_positions, design_matrix, term_count
from .single_thread import one_blas_thread


@dataclass(frozen=True, eq=False)
class PsfModel:
    """A PSF model of one CCD: PSF = mean + sum over k of a_k(x, y) component_k.

    Every stamp is normalised to unit sum, so the components sum to zero and the model to one wherever it is evaluated.

    Parameters
    ----------
    mean : array
        Mean PSF, [ny, nx], unit sum.
    components : array
        Eigen-PSFs, [k, ny, nx], orthonormal, by falling eigenvalue; the element of largest magnitude of each is
        positive.
    coefficients : array
        Projections of the stars on the components, [n, k].
    polynomial : array
        Coefficients of the terms of :func:`~pachon.pipeline.polynomial.design_matrix`, [n_terms, k].
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
        Per star, pixels rejected as outliers and replaced by the mean PSF, [n].
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

    @classmethod
    def fit(
        cls,
        stamps: Any,
        positions: Any,
        *,
        n_components: int = 20,
        order: int = 3,
        extent: Any = None,
        clip_sigma: float | None = 5.0,
        max_iterations: int = 20,
    ) -> PsfModel:
        """Fit the model to the stars of one CCD.

        Outliers are found pixel by pixel (:func:`~pachon.pipeline.outliers.find_outliers`) and replaced by the mean
        of the stars that are good there. The polynomials are fitted without weights, since it is the spatial
        variation that matters and not the brightest star (Jee & Tyson 2011, sec. 3).

        Parameters
        ----------
        stamps : array
            [n, ny, nx] background-subtracted stars centred on a pixel; of any flux, normalised to unit sum here.
        positions : array
            [n, 2] of the stars, in any unit.
        n_components : int
            Principal components to keep; at most n - 1.
        order : int
            Largest total degree of the polynomials.
        extent : tuple of float, optional
            (xmin, xmax, ymin, ymax) of the CCD in the unit of the positions. Where left out, that of the stars.
        clip_sigma : float or None
            Pixels that deviate by more standard deviations are rejected; None rejects nothing, as befits stars without
            noise.
        max_iterations : int
            Most passes of the rejection.

        Raises
        ------
        ConfigError
            If there are more components than stars less one, or more polynomial terms than stars.
        DomainError
            If an array has the wrong shape, a pixel is not finite, a star has no flux, or the stars do not determine
            the polynomials (all on a line, say).
        """
        images = _stamps(stamps)
        n_stars, ny, nx = images.shape
        places = as_positions(positions)
        if len(places) != n_stars:
            raise DomainError(f"positions: {len(places)} given, expected one for each of the {n_stars} stamps")
        limit = min(n_stars - 1, ny * nx)
        if not 1 <= n_components <= limit:
            raise ConfigError(
                f"n_components = {n_components}: expected 1 to {limit}, no more than the stars ({n_stars}) less one"
            )
        if clip_sigma is not None and not clip_sigma > 0.0:
            raise ConfigError(f"clip_sigma = {clip_sigma}: expected a positive number or None")
        if max_iterations < 1:
            raise ConfigError(f"max_iterations = {max_iterations}: expected at least 1")
        span = _extent(extent, places)
        terms = design_matrix(places, span, order)
        pixels = images.reshape(n_stars, -1)
        with one_blas_thread():
            _check_terms(terms, order)
            rejected = np.zeros(pixels.shape, dtype=bool)
            if clip_sigma is not None:
                rejected = find_outliers(pixels, clip_sigma, max_iterations)
            mean, flux = _mean_and_flux(pixels, rejected)
            if rejected.any():
                rejected = restore_predicted(pixels / pixels.sum(axis=1)[:, None], mean, rejected, terms)
                mean, flux = _mean_and_flux(pixels, rejected)
            deviations = np.where(rejected, 0.0, pixels / flux[:, None] - mean)
            _, singular, vectors = np.linalg.svd(deviations, full_matrices=False)
            vectors = vectors[:n_components]
            largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=1)[:, None], axis=1)
            vectors = vectors * np.where(largest < 0.0, -1.0, 1.0)
            coefficients = deviations @ vectors.T
            q, r = np.linalg.qr(terms)
            return cls(
                mean=mean.reshape(ny, nx),
                components=vectors.reshape(n_components, ny, nx),
                coefficients=coefficients,
                polynomial=scipy.linalg.solve_triangular(r, q.T @ coefficients),
                eigenvalues=singular[:limit] ** 2 / (n_stars - 1),
                positions=places,
                order=int(order),
                extent=span,
                unexplained=((deviations - coefficients @ vectors) ** 2).sum(axis=1),
                rejected=rejected.sum(axis=1),
            )

    @property
    def n_stars(self) -> int:
        """Number of stars of the fit."""
        return len(self.coefficients)

    @property
    def n_components(self) -> int:
        """Number of components kept."""
        return len(self.components)

    @property
    def n_rejected(self) -> int:
        """Number of pixels rejected as outliers in all stars."""
        return int(self.rejected.sum())

    @property
    def explained_variance(self) -> np.ndarray:
        """Fraction of the variance of the stamps along each component, [k] (zeros where all stamps are equal)."""
        total = self.eigenvalues.sum()
        return self.eigenvalues[: self.n_components] / (total if total > 0.0 else 1.0)

    @property
    def explained(self) -> float:
        """Fraction of the variance of the stamps in all components together."""
        return float(self.explained_variance.sum())

    @property
    def kink(self) -> int:
        """Number of components before the eigenvalues flatten out.

        The index, counted from 0, at which the logarithm of the eigenvalues lies farthest below the straight line
        from the first to the middle one (Jee & Tyson 2011, sec. 3, find it by eye). Beyond the middle even pure noise
        falls steeply, for want of stars. Eigenvalues under 1e-14 of the first are rounding and do not count.
        """
        values = self.eigenvalues[: (len(self.eigenvalues) + 1) // 2]
        values = values[values > 1e-14 * values[0]]
        if len(values) < 3:
            return len(values)
        curve = np.log(values)
        return int(np.argmin(curve - np.linspace(curve[0], curve[-1], len(curve))))

    @property
    def leverage(self) -> np.ndarray:
        """Diagonal of the polynomials' hat matrix, [n]: how far a star determines the fit at its own place, 0 to 1."""
        with one_blas_thread():
            q, _ = np.linalg.qr(design_matrix(self.positions, self.extent, self.order))
        return (q**2).sum(axis=1)

    def at(self, positions: Any) -> np.ndarray:
        """Evaluate the PSF at positions of any number, [m, ny, nx], unit sum.

        Outside the extent the polynomials are extrapolated. Each position is evaluated on its own: splitting a batch
        changes no byte.

        Parameters
        ----------
        positions : array
            [m, 2], or one position [2], in the unit of the fit.
        """
        return self._combine(self.amplitudes(positions))

    def amplitudes(self, positions: Any) -> np.ndarray:
        """Evaluate the polynomials of the components at positions, [m, k]."""
        terms = design_matrix(positions, self.extent, self.order)
        result = np.zeros((len(terms), self.n_components))
        for column, row in zip(terms.T, self.polynomial, strict=True):  # no BLAS: its sums depend on the batch
            result += column[:, None] * row
        return result

    def reconstruct(self) -> np.ndarray:
        """Return the stars from their own projections on the components, without the polynomials, [n, ny, nx]."""
        return self._combine(self.coefficients)

    def leave_one_out(self) -> np.ndarray:
        """Return the model at each star with that star left out of the polynomial fit, [n, ny, nx].

        Mean PSF and components are held, to which the star did contribute; only the polynomials are those of the other
        n - 1 stars. That needs no new fit: the residual of a star left out is its residual in the full fit divided by
        1 - leverage. NaN where the other stars do not determine the polynomials.
        """
        return self._combine(self.coefficients - self._left_out_residuals())

    @property
    def leave_one_out_rms(self) -> float:
        """Rms over stars and pixels of (stamp - :meth:`leave_one_out`), what the components cannot hold included."""
        squares = (self._left_out_residuals() ** 2).sum(axis=1) + self.unexplained
        return float(np.sqrt(squares.mean() / self.mean.size))

    def to_hdus(self, name: str = "PSF") -> list[fits.ImageHDU | fits.BinTableHDU]:
        """Return the model as FITS extensions, lossless; :meth:`from_hdus` reads them.

        Parameters
        ----------
        name : str
            Start of the extension names, such as the CCD's name: NAME_MEAN, NAME_EIGEN, NAME_POLY, NAME_EXTENT images
            and NAME_SPECTRUM, NAME_STARS tables.
        """
        mean = fits.ImageHDU(self.mean, name=f"{name}_MEAN")
        mean.header["ORDER"] = (self.order, "total degree of the polynomials")
        k = self.n_components
        stars = [
            fits.Column("position", "2D", array=self.positions),
            fits.Column("coefficient", f"{k}D", array=self.coefficients),
            fits.Column("unexplained", "D", array=self.unexplained),
            fits.Column("rejected", "K", array=self.rejected),
        ]
        return [
            mean,
            fits.ImageHDU(self.components, name=f"{name}_EIGEN"),
            fits.ImageHDU(self.polynomial, name=f"{name}_POLY"),
            fits.ImageHDU(np.array(self.extent), name=f"{name}_EXTENT"),
            fits.BinTableHDU.from_columns(
                [fits.Column("eigenvalue", "D", array=self.eigenvalues)], name=f"{name}_SPECTRUM"
            ),
            fits.BinTableHDU.from_columns(stars, name=f"{name}_STARS"),
        ]

    @classmethod
    def from_hdus(cls, hdus: Iterable[Any], name: str = "PSF") -> PsfModel:
        """Read a model from FITS extensions written by :meth:`to_hdus`.

        Raises
        ------
        ProductError
            If an extension or a column is missing.
        """
        found = {hdu.name: hdu for hdu in hdus}
        try:
            image = {key: found[f"{name}_{key}".upper()] for key in ("MEAN", "EIGEN", "POLY", "EXTENT")}
            stars = found[f"{name}_STARS".upper()].data
            extent = tuple(float(v) for v in image["EXTENT"].data)
            return cls(
                mean=_native(image["MEAN"].data),
                components=_native(image["EIGEN"].data),
                coefficients=_native(stars["coefficient"]).reshape(len(stars), -1),
                polynomial=_native(image["POLY"].data),
                eigenvalues=_native(found[f"{name}_SPECTRUM".upper()].data["eigenvalue"]),
                positions=_native(stars["position"]),
                order=int(image["MEAN"].header["ORDER"]),
                extent=extent,  # type: ignore[arg-type]
                unexplained=_native(stars["unexplained"]),
                rejected=np.asarray(stars["rejected"], dtype=np.int64),
            )
        except KeyError as error:
            raise ProductError(f"no PSF model {name!r} in the FITS file: {error.args[0]} is missing") from error

    def _left_out_residuals(self) -> np.ndarray:
        """Return coefficient minus its prediction by the other stars, [n, k]."""
        room = 1.0 - self.leverage
        room = np.where(room > 1e-10, room, np.nan)
        return (self.coefficients - self.amplitudes(self.positions)) / room[:, None]

    def _combine(self, amplitudes: np.ndarray) -> np.ndarray:
        """Return mean plus amplitudes times components, one component after the other so that no batch size matters."""
        result = np.repeat(self.mean[None], len(amplitudes), axis=0)
        for k, component in enumerate(self.components):
            result += amplitudes[:, k, None, None] * component
        return result


def _stamps(stamps: Any) -> np.ndarray:
    """Return the stamps as finite float64 numbers [n, ny, nx]."""
    try:
        images = np.asarray(stamps, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DomainError("stamps: expected real numbers [n, ny, nx]") from error
    if images.ndim != 3 or len(images) < 2:
        raise DomainError(f"stamps have shape {images.shape}: expected [n, ny, nx] with at least 2 stars")
    finite = np.isfinite(images).all(axis=(1, 2))
    if not finite.all():
        raise DomainError(f"stamps[{int(np.flatnonzero(~finite)[0])}] has pixels that are not finite")
    dark = images.sum(axis=(1, 2)) <= 0.0
    if dark.any():
        raise DomainError(f"stamps[{int(np.flatnonzero(dark)[0])}] sums to zero or less: expected a star")
    return images


def _extent(extent: Any, positions: np.ndarray) -> Extent:
    """Return the given extent, or that of the positions, as four floats."""
    if extent is None:
        (xmin, ymin), (xmax, ymax) = positions.min(axis=0), positions.max(axis=0)
    else:
        try:
            xmin, xmax, ymin, ymax = (float(v) for v in extent)
        except (TypeError, ValueError) as error:
            raise DomainError(f"extent = {extent!r}: expected (xmin, xmax, ymin, ymax)") from error
    if not (xmin < xmax and ymin < ymax and np.all(np.isfinite([xmin, xmax, ymin, ymax]))):
        raise DomainError(
            f"extent = {(xmin, xmax, ymin, ymax)}: expected (xmin, xmax, ymin, ymax), minima below maxima"
        )
    return float(xmin), float(xmax), float(ymin), float(ymax)


def _check_terms(terms: np.ndarray, order: int) -> None:
    """Refuse stars that do not determine the polynomials."""
    n_stars, n_terms = terms.shape
    if n_stars < n_terms:
        raise ConfigError(f"order = {order}: its {n_terms} polynomial terms need as many stars, {n_stars} given")
    if np.linalg.matrix_rank(terms) < n_terms:
        raise DomainError(f"positions: the {n_stars} stars do not determine the {term_count(order)} polynomial terms")


def _mean_and_flux(pixels: np.ndarray, rejected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean PSF [n_pixels], of unit sum, and the flux of each star [n_stars].

    A star with its rejected pixels replaced by the mean PSF is to have unit sum as well: its flux is the sum of the
    good pixels over the mean PSF's sum there. The mean depends on the fluxes in turn, so both are iterated.
    """
    flux = pixels.sum(axis=1)
    used = ~rejected
    used[:, rejected.all(axis=0)] = True  # a pixel that is bad in all stars has no better mean
    count = used.sum(axis=0)
    for _ in range(20 if rejected.any() else 1):
        mean = np.where(used, pixels / flux[:, None], 0.0).sum(axis=0) / count
        mean /= mean.sum()
        if rejected.any():
            flux = np.where(used, pixels, 0.0).sum(axis=1) / np.where(used, mean, 0.0).sum(axis=1)
    if not np.all(flux > 0.0):
        raise DomainError(f"stamps[{int(np.flatnonzero(~(flux > 0.0))[0])}] has no flux left outside its outliers")
    return mean, flux


def _native(array: Any) -> np.ndarray:
    """Return FITS numbers as float64 in the machine's own byte order."""
    return np.asarray(array, dtype=np.float64).copy()
