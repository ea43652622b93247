"""The PSF across a CCD from its stars: a mean, components, and their coefficients as functions of position.

Jee & Tyson 2011, section 3: mean PSF with outlier rejection, singular value decomposition, and polynomials for the
amplitudes of the first components. Other bases and interpolations stand behind the same interface.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike, NDArray

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import PachonError, ProductError
from ...core.number_text import counted
from ...core.plotting import figure_at, styled
from ...core.products import read_fits, write_fits
from ...core.result import Result
from ...core.version import CREATOR
from .basis import elbow_of
from .colour import FittedColour, as_colours
from .file import model_hdus, read_model
from .fit import CcdStars, ModelFit, fit_stars
from .outliers import SigmaClipping
from .polynomial import Extent, as_positions
from .recipe import Recipe, RecipeKeys, RecipeName

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Rejection of outliers in noisy stars.
CLIPPING = SigmaClipping()
# Components that are drawn beside the mean.
_SHOWN = 5


class ModelOptions(RecipeKeys, total=False):
    """Options of :meth:`PsfModel.fit` that hold for any stars of a CCD."""

    recipe: RecipeName | Recipe | None
    weights: Literal["noise"] | None
    clipping: SigmaClipping | None
    extent: ArrayLike | None


class StarOptions(ModelOptions, total=False):
    """Options of :meth:`PsfModel.fit` and colours of stars."""

    colour: ArrayLike | None


@dataclass(frozen=True, eq=False)
class PsfModel(ModelFit, Result):
    """A PSF model of one CCD: PSF = mean + sum over k of a_k(x, y) component_k.

    Every stamp is normalised to unit sum, so the components sum to zero and the model to one wherever it is evaluated.

    Parameters
    ----------
    basis : FittedBasis
        Mean and components; of the class of its kind: :class:`~.EigenPsfs`, :class:`~.PixelGrid`,
        :class:`~.GaussHermite`.
    interpolation : FittedInterpolation
        The stars' coefficients between them; of the class of its kind: :class:`~.FittedPolynomial`,
        :class:`~.FittedKriging`.
    coefficients : array
        Projections of the stars on the components, [n, k].
    unexplained : array
        Per star, sum over its pixels of the square of what the components leave, [n].
    rejected : array of int
        Per star, pixels rejected as outliers and replaced, [n].
    """

    _table = ("positions", "coefficients", "unexplained", "rejected")

    @classmethod
    @removed_arguments(clip_sigma="clipping=SigmaClipping(sigma=...), or None to reject no pixel")
    @check_arguments
    def fit(
        cls,
        stamps: ArrayLike,
        positions: ArrayLike,
        *,
        recipe: RecipeName | Recipe | None = None,
        weights: ArrayLike | Literal["noise"] | None = None,
        masks: NDArray[np.bool_] | None = None,
        extent: ArrayLike | None = None,
        gain: float | None = 1.0,
        clipping: SigmaClipping | None = CLIPPING,
        colour: ArrayLike | None = None,
        **recipe_keys: Unpack[RecipeKeys],
    ) -> PsfModel:
        """Fit the model to the stars of one CCD.

        Outliers are found pixel by pixel (:func:`~.find_outliers`) and replaced by the mean of the stars that are good
        there. Where nothing else is said every pixel is interpolated by kriging (:mod:`~.psf_model.kriging`), the best
        choice where nothing is known of the PSF; each keyword changes that part of the recipe alone. With
        `n_components` and no basis, which pixels lack, the recipe is ``paper``: that of Jee & Tyson 2011, sec. 3.

        Parameters
        ----------
        stamps : array
            [n, ny, nx] background-subtracted stars centred on a pixel; of any flux, normalised to unit sum here.
        positions : array
            [n, 2] of the stars, in any unit.
        recipe : str or Recipe, optional
            ``kriging`` of pixels, the default; ``paper``: 20 eigen-PSFs and cubic polynomials without weights; or one's
            own :class:`~.psf_model.recipe.Recipe`.
        basis : str or Basis, optional
            ``pca``: eigen-PSFs. ``pixels``: every pixel on its own. ``shapelets``: Gauss-Hermite functions, which
            truncate the wings (Jee & Tyson 2011, sec. 3). Or an object with options, such as
            :class:`~.psf_model.shapelets.Shapelets`.
        interpolation : str or Interpolation, optional
            ``polynomial``; ``kriging``: one rule for all components, with the noise of each star. Or an object.
        weights : array or str, optional
            [n] of the stars in the polynomials. ``noise``: in the mean and the eigen-PSFs, too, each star counts by the
            inverse of its noise and of what the polynomials leave (:mod:`~.psf_model.shape_noise`); where `order` or
            `n_components` is ``auto`` this is the default.
        masks : array of bool, optional
            [n, ny, nx], True for pixels to ignore, besides those that are not finite, or -1e29 or less. They are
            replaced by the polynomial through the stars in which the pixel is good, so that they have no influence on
            the fit, and are no sky of which noise is measured.
        n_components : int or str, optional
            Components to keep, 20 where left out: principal ones at most n - 1, of shapelets those of sum zero.
            ``auto`` takes the number, up to 65, that predicts the shapes of held-out stars best; :attr:`elbow` is the
            alternative. None for pixels.
        order : int or str, optional
            Largest total degree of the polynomials, 3 where left out; of the trend in kriging 4, which shrinks it.
            ``auto``: of polynomials the order, up to 4, that predicts held-out stars best.
        extent : tuple of float, optional
            (xmin, xmax, ymin, ymax) of the CCD in the unit of the positions. Where left out, that of the stars.
        scale : float, optional
            rms width of the Gaussian under the shapelets [pixel]; by default the one with the least residual of the
            stars.
        gain : float or None
            Electrons in a unit of the stamps, for the photon noise of the stars; None for none. Kriging refuses stamps
            that are not in electrons; else their photon noise counts as unknown.
        clipping : SigmaClipping or None
            Rejection of pixels that stand out, beyond five standard deviations by default; with None, for noise-free
            stars, none is rejected.
        colour : array, optional
            Colours of the stars, [n], of any kind and unit: effective wavelengths (:func:`~pachon.effective_colour`),
            g - i, temperatures. The PSF may be linear in them, as far as the stars ask for it (:attr:`colour`); NaN
            counts as the mean of the others. Colours that do not differ change nothing.

        Raises
        ------
        ConfigError
            If there are more components than stars less one, or more polynomial terms than stars, or an option has no
            such value.
        DomainError
            If an array has the wrong shape, a star has no flux or no pixel with weight, a pixel has none in any star,
            or the stars do not determine the polynomials (all on a line, say).
        """
        stars = CcdStars(stamps, positions, weights, masks, extent, colour)
        model = fit_stars(cls, [stars], Recipe.of(recipe, **recipe_keys), gain=gain, clipping=clipping)[0]
        if isinstance(model, PachonError):
            raise model
        return model

    def _label(self) -> str:
        ny, nx = self.mean.shape
        components, order = f"{counted(self.n_components, 'component')} ({self.basis.name})", self.order
        return f"{components}, order {order}, {counted(self.n_stars, 'star')}, stamps {nx} x {ny}"

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the mean PSF and the first components, each over its largest magnitude."""
        images = self.components[: _SHOWN if self.basis.kind.has_components else 0]
        with styled():
            figure = figure_at(ax, max(1.9 * (len(images) + 1), 4.0), 2.3)
            row = figure.subplots(1, len(images) + 1, squeeze=False)[0]
            row[0].imshow(np.sqrt(np.maximum(self.mean, 0.0)), cmap="viridis", vmin=0.0)
            row[0].set_title("mean (square root)", fontsize=8.5)
            for k, (axes, image) in enumerate(zip(row[1:], images, strict=True), start=1):
                axes.imshow(image / float(np.abs(image).max()), cmap="RdBu_r", vmin=-1.0, vmax=1.0)
                axes.set_title(f"component {k}", fontsize=8.5)
            for axes in row:
                axes.set(xticks=[], yticks=[])
            return figure

    @property
    def n_components(self) -> int:
        """Number of components kept."""
        return len(self.components)

    @property
    def mean(self) -> np.ndarray:
        """Mean PSF, [ny, nx], unit sum."""
        return self.basis.mean

    @property
    def components(self) -> np.ndarray:
        """Components, [k, ny, nx].

        Eigen-PSFs by falling eigenvalue, the element of largest magnitude of each positive; or shapelets of unit sum by
        rising order; both orthonormal. Or one for each pixel.
        """
        return self.basis.components

    @property
    def eigenvalues(self) -> np.ndarray:
        """All n - 1 eigenvalues of the covariance of the stamps (fewer where a stamp has fewer pixels), falling."""
        return self.basis.eigenvalues

    @property
    def positions(self) -> np.ndarray:
        """Positions of the stars, [n, 2]."""
        return self.interpolation.positions

    @property
    def extent(self) -> Extent:
        """(xmin, xmax, ymin, ymax) of the CCD, in the unit of the positions."""
        return self.interpolation.extent

    @property
    def order(self) -> int:
        """Largest total degree of the polynomials."""
        return self.interpolation.order

    @property
    def weights(self) -> np.ndarray | None:
        """Weights of the stars, [n], or None; under a process inverse variances, in units of the middle star's."""
        return self.interpolation.weights

    @property
    def smoothness(self) -> dict[str, float]:
        """Probability of each form of the PSF over the CCD, by the stars; empty for polynomials.

        Kriging chooses among a constant, a linear and a quadratic field, and a process, such as turbulence leaves, on a
        trend: ``{"constant": 0.9, "linear": 0.1}``, say. Predictions are the mean of all by these.
        """
        return self.interpolation.smoothness

    @property
    def colour(self) -> FittedColour | None:
        """Dependence on the colour with its probability by the stars; None where they have no colours that differ.

        Polynomials have none, either, where the stars do not ask for it. ``model.colour.mean`` is the colour of
        predictions without one.
        """
        return self.interpolation.colour

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
        return self.basis.variance_along(self.coefficients) / (total if total > 0.0 else 1.0)

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
        residual_squares, squares = self.interpolation.leave_one_out(self.coefficients) ** 2, self.coefficients**2
        gained = np.concatenate([[0.0], np.cumsum((residual_squares - squares).sum(axis=0))])
        total = self.unexplained.sum() + squares.sum() + gained
        return np.sqrt(np.maximum(total, 0.0) / (self.n_stars * self.mean.size))

    @property
    def leverage(self) -> np.ndarray:
        """Diagonal of the polynomials' hat matrix, [n]: how far a star determines the fit at its own place, 0 to 1.

        That of the trend alone where there is a process.
        """
        return self.interpolation.leverage()

    @check_arguments
    def at(self, positions: ArrayLike, *, colour: ArrayLike | None = None) -> np.ndarray:
        """Evaluate the PSF at positions, [m, ny, nx], unit sum.

        Outside the extent polynomials are extrapolated. Positions are evaluated on their own: no batch changes a byte.

        Parameters
        ----------
        positions : array
            [m, 2], or one position [2], in the unit of the fit.
        colour : array, optional
            Colours of what is observed there, [m], or one for all, as those of the fit; of a spectrum
            :func:`~pachon.effective_colour`. The mean colour of the stars where it is left out or NaN. It has no effect
            in a model without :attr:`colour`.
        """
        return self.basis.at(self.amplitudes(positions, colour=colour))

    @check_arguments
    def draw(self, x: float, y: float, *, colour: float | None = None) -> np.ndarray:
        """Evaluate the PSF at one position, [ny, nx], unit sum; for a colour as :meth:`at` does."""
        return self.at((x, y), colour=colour)[0]

    @check_arguments
    def amplitudes(self, positions: ArrayLike, *, colour: ArrayLike | None = None) -> np.ndarray:
        """Evaluate the amplitudes of the components at positions, [m, k]; for colours as :meth:`at` does."""
        if colour is None:
            return self.interpolation.at(positions)
        points = as_positions(positions)
        return self.interpolation.with_colour(points, as_colours(colour, len(points)))

    def reconstruct(self) -> np.ndarray:
        """Return the stars from their own projections on the components, without the polynomials, [n, ny, nx]."""
        return self.basis.at(self.coefficients)

    def leave_one_out(self) -> np.ndarray:
        """Return the model at each star with that star left out of the interpolation, [n, ny, nx].

        Mean PSF, components and the covariance of a process are held, to which the star did contribute; only the
        interpolation is that of the other n - 1 stars. NaN where these do not determine it.
        """
        return self.basis.at(self.coefficients - self.interpolation.leave_one_out(self.coefficients))

    @property
    def leave_one_out_rms(self) -> float:
        """Rms over stars and pixels of (stamp - :meth:`leave_one_out`), what the components cannot hold included."""
        squares = (self.interpolation.leave_one_out(self.coefficients) ** 2).sum(axis=1) + self.unexplained
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
        return replace(
            self,
            basis=self.basis.truncated(k),
            interpolation=self.interpolation.truncated(k),
            coefficients=self.coefficients[:, :k],
            unexplained=self.unexplained + (self.coefficients[:, k:] ** 2).sum(axis=1),
        )

    def to_hdus(self, name: str = "PSF") -> list[fits.ImageHDU | fits.BinTableHDU]:
        """Return the model as FITS extensions, lossless; :meth:`from_hdus` reads them.

        Parameters
        ----------
        name : str
            Start of the extension names, such as the CCD's name: NAME_MEAN, NAME_EIGEN, NAME_POLY, NAME_EXTENT images
            and NAME_SPECTRUM, NAME_STARS tables.
        """
        return model_hdus(self, name)

    @classmethod
    def from_hdus(cls, hdus: Iterable[Any], name: str = "PSF") -> PsfModel:
        """Read a model from FITS extensions written by :meth:`to_hdus`.

        Raises
        ------
        ProductError
            If an extension or a column is missing.
        """
        return read_model(cls, hdus, name)

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
