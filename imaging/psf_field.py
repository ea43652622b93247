"""The PSF across one CCD, as noise-free PSFs of a run have it, and its Fourier transforms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.threads import one_blas_thread
from ..core.units import for_each, pure_numbers
from ..pipeline.config import with_options
from ..pipeline.experiment import Experiment
from ..pipeline.resolved_values import noise_free_components
from ..pipeline.simulate.ccd_exposure import NoiseFreeStars, expose_positions, holdout_positions
from ..pipeline.simulate.photometry import effective_fwhm
from ..reconstruction.psf_model.interpolation import Interpolation
from ..reconstruction.psf_model.model import PsfModel
from ..reconstruction.psf_model.recipe import InterpolationKey, Recipe
from .lit_fraction import LitFraction

#: Pixels around a CCD that the PSF is extrapolated to, for galaxies whose light reaches the CCD.
RIM = 40
#: Least effective FWHM of PSFs that pixels sample, pixels included [pixel]. At 2.75, a seeing of 2.3 pixels, products
#: of transforms miss 0.15 % of the peak of galaxies of a half-light radius of half a pixel; at 1.9 2 %, at 1.3 8 %.
SAMPLED_FWHM = 2.75
#: Cells along a side of a pixel where they do not, one after the other until the cells sample the PSF.
_CELLS = (3, 9)
#: Error of polynomials over their PSFs, the median of the largest of each over its brightest pixel, beyond which they
#: do not describe the field: CCDs of the LSST have 0.01, by turbulence, the corners of HSC 0.06 to 0.09.
POLYNOMIAL_ERROR = 0.03


@dataclass(frozen=True, eq=False)
class PsfField:
    """PSF and lit fraction across one CCD; positions are pixels (x, y) of the CCD.

    PSF = mean + sum over k of a_k(x, y) component_k (Jee & Tyson 2011, sec. 3). Polynomials are held constant from
    :data:`RIM` pixels outside the CCD on.
    """

    model: PsfModel  #: its positions are pixels of the CCD
    pixels: np.ndarray  #: along x and y of the CCD, [2]
    light: LitFraction  #: that arrives at the pixels
    cells: int = 1  #: of the stamps of the model along a side of a pixel

    @classmethod
    @check_arguments
    def fit(
        cls,
        stamps: ArrayLike,
        positions: ArrayLike,
        pixels: ArrayLike,
        *,
        lit_fraction: ArrayLike | None = None,
        n_components: int | None = None,
        order: int = 4,
        interpolation: InterpolationKey | Interpolation | None = None,
        cells: int = 1,
    ) -> PsfField:
        """Fit noise-free PSFs on one CCD.

        Parameters
        ----------
        stamps : array
            [n, ny, nx], odd numbers of pixels, the reference point of each at the centre of the middle pixel.
        positions : array
            [n, 2] pixels (x, y) of the CCD.
        pixels : int or array, shape [2]
            Pixels along x and y of the CCD; one number where it is square.
        lit_fraction : array, optional
            [n], part of the entrance pupil whose light arrives; 1 by default.
        n_components, order, interpolation
            As in :meth:`pachon.PsfModel.fit`; 20 components or one less than the PSFs. The order is that of polynomials
            alone. By default they are polynomials, and kriging where these are farther than :data:`POLYNOMIAL_ERROR`
            from the PSFs, as at the rims of strongly vignetted fields.
        cells : int
            Cells of the stamps along a side of a pixel, an odd number: stamps then have so many times the pixels, and
            hold the light of each cell. Pixels of more than half the FWHM of the PSF do not sample it.

        Raises
        ------
        PachonError
            As :meth:`pachon.PsfModel.fit`.
        DomainError
            If the number of cells is not odd, or does not divide the sides of the stamps, or a lit fraction is not
            finite.
        """
        if cells < 1 or cells % 2 == 0 or any(side % cells for side in np.shape(stamps)[1:]):
            raise DomainError(f"cells = {cells}: expected an odd number that divides the sides of {np.shape(stamps)}")
        places = pure_numbers(positions, "positions")
        size = for_each(pure_numbers(pixels, "pixels"), 2, "pixels")
        extent = (-0.5, float(size[0]) - 0.5, -0.5, float(size[1]) - 0.5)

        def fitted(interpolation: InterpolationKey | Interpolation) -> PsfModel:
            recipe = Recipe.of("paper", interpolation=interpolation, n_components=n_components)
            if not recipe.interpolation.needs_noise:
                recipe = recipe.changed(order=order)
            return PsfModel.fit(stamps, places, recipe=recipe, gain=None, extent=extent, clipping=None)

        model = fitted("polynomial" if interpolation is None else interpolation)
        if interpolation is None and _typical_error(model, np.asarray(stamps), places) > POLYNOMIAL_ERROR:
            model = fitted("kriging")
        share = 1.0 if lit_fraction is None else lit_fraction
        light = for_each(pure_numbers(share, "lit_fraction"), len(places), "lit_fraction")
        if not np.isfinite(light).all():
            raise DomainError(f"lit_fraction[{np.isfinite(light).argmin()}]: expected a finite number")
        return cls(model, size, LitFraction.fit(places, light, extent, order), cells)

    @classmethod
    @check_arguments
    def of_run(
        cls,
        experiment: Experiment,
        ccd: str,
        *,
        interpolation: InterpolationKey | Interpolation | None = None,
        threads: int | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> PsfField:
        """Fit the noise-free PSFs of a run at its holdout positions (``stars.truth``) on one CCD.

        Reference points are centred, not centroids, so that images contain the displacements by turbulence.
        Components and order are those of the run, 20 and 4 by default; screens must have been made
        (:meth:`~pachon.Experiment.screens`). PSFs that pixels do not sample are drawn on cells finer than those.
        """
        positions = holdout_positions(experiment, ccd)

        def expose(experiment: Experiment) -> NoiseFreeStars:
            return expose_positions(experiment, positions, threads, progress=progress, along=ccd)

        return cls.of_stars(experiment, ccd, positions, expose(experiment), expose, interpolation=interpolation)

    @classmethod
    def of_stars(
        cls,
        experiment: Experiment,
        ccd: str,
        positions: np.ndarray,
        stars: NoiseFreeStars,
        expose: Callable[[Experiment], NoiseFreeStars],
        **options: Any,
    ) -> PsfField:
        """Fit the noise-free stars of a run at positions on the detector [m], [n, 2].

        `expose` draws them anew for an experiment of finer pixels, which it gets where pixels do not sample them.
        """
        config, camera, cells = experiment.config, experiment.camera, 1
        for finer in _CELLS:
            # The light of all stars, of which some may have none.
            if not effective_fwhm(stars.image[stars.lit_fraction > 0.0], 1.0) < SAMPLED_FWHM:
                break
            cells, stars = finer, expose(_with_cells(experiment, finer))
        return cls.fit(
            stars.image.astype(np.float64),
            to_pixel(experiment, ccd, positions),
            camera.pixels[camera.ccd_index(ccd)],
            lit_fraction=stars.lit_fraction,
            n_components=noise_free_components(config),
            order=config.reconstruction.truth_order,
            cells=cells,
            **options,
        )

    @property
    def stamp(self) -> int:
        """Pixels along a side of the PSF's stamps."""
        return self.model.mean.shape[0] // self.cells

    @property
    def mean(self) -> np.ndarray:
        """Light of the mean PSF in each pixel, [stamp, stamp]."""
        return self.model.mean.reshape(self.stamp, self.cells, self.stamp, self.cells).sum(axis=(1, 3))

    @check_arguments
    def amplitudes(self, positions: ArrayLike) -> np.ndarray:
        """Return amplitudes of mean and components, shape [n, 1 + k]; the first is 1."""
        of_components = self.model.amplitudes(self._on_ccd(positions))
        return np.concatenate([np.ones((len(of_components), 1)), of_components], axis=1)

    @check_arguments
    def lit_fraction(self, positions: ArrayLike) -> np.ndarray:
        """Return the part of the entrance pupil whose light arrives, shape [n]."""
        return self.light.at(self._on_ccd(positions))

    @check_arguments
    def transforms(self, size: int, amplitudes: np.ndarray | None = None) -> np.ndarray:
        """Return ``rfft2`` of mean and components, centred on cell ``size // 2``: complex64 [1 + k, size, size//2+1].

        Parts of a stamp beyond the grid wrap around, so that sums are kept. With amplitudes [n, 1 + k] they are those
        of the PSFs that these make up, [n, size, size//2+1].
        """
        images = np.concatenate([self.model.mean[None], self.model.components])
        if amplitudes is not None:
            with one_blas_thread():
                images = (amplitudes @ images.reshape(len(images), -1)).reshape(-1, *images.shape[1:])
        side = self.model.mean.shape[0]
        at = (np.arange(side) - side // 2 + size // 2) % size
        folded = (np.arange(size)[:, None] == at).astype(np.float64)
        with one_blas_thread():
            grid = folded @ images @ folded.T
        return fft.rfft2(grid, workers=1).astype(np.complex64)

    def profile(self) -> np.ndarray:
        """Return the largest value of the mean PSF beyond each distance from its middle pixel, [stamp // 2 + 1]."""
        mean, half = self.mean, self.stamp // 2
        y, x = np.indices(mean.shape) - half
        beyond = np.maximum(abs(x), abs(y))
        return np.array([mean[beyond >= r].max() for r in range(half + 1)])

    def _on_ccd(self, positions: ArrayLike) -> np.ndarray:
        return np.clip(np.atleast_2d(np.asarray(positions, dtype=np.float64)), -RIM, self.pixels + RIM)


def _typical_error(model: PsfModel, stamps: np.ndarray, places: np.ndarray) -> float:
    """Return the median over stars of the largest error of a model, in units of their brightest pixels."""
    error = np.abs(model.at(places) - stamps).max(axis=(1, 2))
    return float(np.median(error / stamps.max(axis=(1, 2))))


def _with_cells(experiment: Experiment, cells: int) -> Experiment:
    """Return an experiment whose stamps have so many cells along a side of a pixel."""
    pixel_um = 1e6 * experiment.pixel_size / cells
    return replace(
        experiment,
        config=with_options(experiment.config, psf__pixel_um=pixel_um, psf__stamp=experiment.stamp_size * cells),
    )


def to_pixel(experiment: Experiment, ccd: str, positions: np.ndarray) -> np.ndarray:
    """Convert positions on the detector [m] to pixels of a CCD, the first pixel's centre at (0, 0)."""
    camera = experiment.camera
    return camera.to_pixel(camera.ccd_index(ccd), positions)
