"""Figures of single visits: ellipticity and size of their PSFs, and what the models leave of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.products import Columns
from ...core.statistics import finite_mean
from ...core.units import ARCSEC
from ...measure.shapes import measure_shapes

#: Figures in the order of tables: unit and description.
FIGURES = {
    "rms_e": ("", "rms |e| of the true PSFs, weighted e"),
    "rms_residual_e_stars": ("", "of true minus model, stars"),
    "rms_residual_e_places": ("", "likewise, where no star is"),
    "median_size": ("arcsec", "of the weighted rms size, true PSFs"),
}


@dataclass(frozen=True)
class VisitFigures:
    """Figures of the PSFs of one visit at the points of the sky that it sees, along the axes of the stack.

    Attributes
    ----------
    rms_e : float
        Rms of the absolute value of the weighted e of the true PSFs.
    rms_residual_e_stars, rms_residual_e_places : float
        That of true minus model at the stars, to which models are fitted, and where no star is; NaN without any.
    median_size : float
        Median of the weighted rms size of the true PSFs [arcsec].
    """

    rms_e: float
    rms_residual_e_stars: float
    rms_residual_e_places: float
    median_size: float

    @classmethod
    def of(
        cls, true: np.ndarray, model: np.ndarray, star: NDArray[np.bool_], pixel_scale: float, weight_fwhm: float
    ) -> VisitFigures:
        """Measure PSFs and those of the models, [n, size, size] each, with pixels and a weight [rad]."""
        shapes, modelled = (measure_shapes(images, pixel_scale, weight_fwhm) for images in (true, model))
        residual = np.stack([shapes.e1 - modelled.e1, shapes.e2 - modelled.e2])
        return cls(
            rms_modulus(shapes.e1, shapes.e2),
            rms_modulus(*residual[:, star]),
            rms_modulus(*residual[:, ~star]),
            float(np.nanmedian(shapes.size) / ARCSEC),
        )


def rms_modulus(e1: np.ndarray, e2: np.ndarray) -> float:
    """Return the rms of the absolute value of an ellipticity; NaN of none."""
    return float(np.sqrt(finite_mean(e1**2 + e2**2)))


def figure_columns(visits: Sequence[VisitFigures]) -> Columns:
    """Return the figures of visits as columns of a table."""
    return {
        name: (np.array([getattr(figures, name) for figures in visits]), unit, description)
        for name, (unit, description) in FIGURES.items()
    }
