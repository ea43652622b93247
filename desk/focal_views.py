"""The PSF model of a focal plane, and views of it; nothing here draws."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..core.errors import DomainError
from ..core.number_text import counted
from ..core.statistics import FWHM_PER_RMS, finite_median
from ..core.units import ARCSEC
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from ..reconstruction.focal_plane_psf.mosaic import PsfShapes
from .result_views import PlacesView, RowsView
from .views import HeightsView, WhiskersView, heights_view

#: Places of a map in all, about: one a CCD of a large camera.
_PLACES = 300
#: Distance of the outermost places from the centre of a CCD, in halves of its side.
_INSIDE = 0.9
#: What the map shows.
MAPS = ("uncertainty of e", "uncertainty of FWHM", "e", "FWHM")


class FocalBench:
    """A focal-plane model at a grid of places on the CCDs that have stars.

    Parameters
    ----------
    name : str
        Name of the model.
    model : FocalPlanePsf
        The model.
    """

    def __init__(self, name: str, model: FocalPlanePsf) -> None:
        self.name, self.model = name, model
        ccds = np.unique(model.field.data.places.ccd)
        side = max(1, round(math.sqrt(_PLACES / len(ccds))))
        axis = _INSIDE * (2.0 * (np.arange(side) + 0.5) / side - 1.0)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        #: Number of the CCD of each place, and its position on the detector [m], shapes [n] and [n, 2].
        self.ccd, uv = np.repeat(ccds, len(grid)), np.tile(grid, (len(ccds), 1))
        mosaic, camera = model.mosaic, model.mosaic.camera
        self.places = (
            mosaic.centers[self.ccd] + mosaic.half_size * uv if camera is None else camera.from_uv(self.ccd, uv)
        )
        half = mosaic.half_size if camera is None else float(camera.half_sizes.max())
        #: Side of the square that a place stands for, and half that of all [m].
        self.spacing = 2.0 * half * _INSIDE / side
        low, high = self.places.min(axis=0), self.places.max(axis=0)
        self.center, self.reach = 0.5 * (low + high), 0.5 * float((high - low).max()) + half / side

        names = [mosaic.names[i] for i in self.ccd]
        #: Shapes at the places, and their standard deviations.
        self.predicted: tuple[PsfShapes, PsfShapes] = model.predict(names, *self.places.T)
        #: FWHM of round Gaussians of the same weighted sizes, and their standard deviations [arcsec].
        shapes, sigma = self.predicted
        self.fwhm, self.fwhm_error = _gaussian_fwhm(shapes.size, sigma.size, model.weight_fwhm)

    @classmethod
    def read(cls, path: Path) -> FocalBench:
        """Read a model; ProductError where it is none."""
        return cls(path.stem, FocalPlanePsf.read(path))

    def __len__(self) -> int:
        return len(self.ccd)

    def ccd_name(self, place: int) -> str:
        """Return the name of the CCD of a place."""
        return self.model.mosaic.names[self.ccd[place]]

    def whiskers(self) -> WhiskersView:
        """Return the predicted shapes, weighted moments, at all places."""
        shapes, _ = self.predicted
        x_mm, y_mm = 1e3 * self.places.T
        title = f"Predicted shapes at {counted(len(self), 'place')}"
        return WhiskersView(x_mm, y_mm, shapes.e1, shapes.e2, self.fwhm, title)

    def heights(self) -> HeightsView | None:
        """Return the fitted heights of the CCDs; None without a telescope."""
        return None if self.model.heights is None else heights_view(self.model.heights)

    def map(self, name: str) -> PlacesView:
        """Return one of :data:`MAPS` at all places; the uncertainty of e is that of a component, rms of both."""
        shapes, sigma = self.predicted
        values, unit = {
            "e": (100.0 * np.hypot(shapes.e1, shapes.e2), "%"),
            "FWHM": (self.fwhm, "arcsec"),
            "uncertainty of e": (100.0 * np.sqrt(0.5 * (sigma.e1**2 + sigma.e2**2)), "%"),
            "uncertainty of FWHM": (self.fwhm_error, "arcsec"),
        }[name]
        x_mm, y_mm = 1e3 * self.places.T
        return PlacesView(x_mm, y_mm, values, f"{name} [{unit}]", f"{name[0].upper()}{name[1:]} of the prediction")

    def psf(self, place: int) -> RowsView | None:
        """Return the PSF at a place and its standard deviation over its peak; None where none can be drawn."""
        where = self.ccd_name(place), *self.places[place]
        try:
            image, sigma = self.model.draw(*where)[0], self.model.draw_uncertainty(*where)[0]
        except DomainError:
            # A model without telescope of stars without stamps.
            return None
        rows = {"PSF": image[None] / image.max(), "sigma": sigma[None] / image.max()}
        return RowsView(rows, len(image) * self._pixel_arcsec, f"PSF on {where[0]}, and its uncertainty")

    def components(self) -> RowsView | None:
        """Return the mean star and the eigen-PSFs of the residual stamps, each over its peak; None without stamps."""
        mean, pca = self.model.mean_star, self.model.pca
        if mean is None:
            return None
        images = mean[None] if pca is None else np.stack([mean, *pca.components])
        row = images / np.abs(images).max(axis=(1, 2), keepdims=True)
        title = "Mean star" + ("" if pca is None else f" and {len(pca.components)} eigen-PSFs of the residual stamps")
        return RowsView({"": row}, len(mean) * self._pixel_arcsec, title)

    @property
    def _pixel_arcsec(self) -> float:
        """Angle of a pixel of drawn images [arcsec]; NaN where none can be drawn."""
        optics = self.model.field.optics
        scale = self.model.pixel_scale if optics is None else optics.pixel_scale
        return math.nan if scale is None else scale / ARCSEC

    def numbers(self, place: int) -> dict[str, tuple[float, str]]:
        """Return the numbers of the model and of a place, with their units."""
        shapes, sigma = self.predicted
        e = 100.0 * np.hypot(shapes.e1, shapes.e2)
        return {
            "stars of the fit": (float(self.model.used.sum()), ""),
            "e, median": (finite_median(e), "%"),
            "FWHM, median": (finite_median(self.fwhm), "arcsec"),
            **{f"chi-square of {name}": (value, "") for name, value in self.model.chi2.items()},
            "e1 at the place": (100.0 * float(shapes.e1[place]), f"± {100.0 * sigma.e1[place]:.2g} %"),
            "e2 at the place": (100.0 * float(shapes.e2[place]), f"± {100.0 * sigma.e2[place]:.2g} %"),
            "FWHM at the place": (float(self.fwhm[place]), f"± {self.fwhm_error[place]:.2g} arcsec"),
        }


def _gaussian_fwhm(size: np.ndarray, sigma: np.ndarray, weight_fwhm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return FWHM [arcsec] and standard deviations of round Gaussians of rms sizes [rad] under a weight of a FWHM."""
    ratio = FWHM_PER_RMS * size / weight_fwhm
    # The product of image and weight is a Gaussian whose inverse variance is the sum of theirs.
    factor = np.where(ratio < 1.0, 1.0 - ratio**2, np.nan)
    return FWHM_PER_RMS * size / np.sqrt(factor) / ARCSEC, FWHM_PER_RMS * sigma * factor**-1.5 / ARCSEC
