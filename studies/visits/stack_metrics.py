"""Ellipticity correlations and figures of a stack of visits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...core.units import ARCMIN, ARCSEC
from ...measure.correlation import SEPARATION_RANGES, Correlation, patches_of_jackknife, shear_correlation
from ...pipeline.summary import bins_up_to
from .stack import PsfStack
from .visit_figures import rms_modulus

#: Correlations of a stack: of the true PSFs at all points, and of true minus model at stars and where no star is. With
#: ``_g``, they are of g of the adaptive moments, else of the weighted e.
KINDS = ("psf", "residual_stars", "residual_places", "psf_g", "residual_stars_g", "residual_places_g")
StackCorrelations = dict[str, Correlation]
# Side of a patch of the jackknife over that of a CCD.
_PATCH = 3.0


def stack_correlations(stack: PsfStack, cell: float) -> StackCorrelations:
    """Return the correlations of a stack by kind; `cell` is the angle of the side of a CCD [rad].

    Errors are those of a jackknife over squares of three CCDs.
    """
    corner = [np.floor(v / (_PATCH * cell) + 0.5).astype(int) for v in (stack.x, stack.y)]
    patch = corner[0] - corner[0].min() + (np.ptp(corner[0]) + 1) * (corner[1] - corner[1].min())
    values = {}
    residual_g = (stack.g1 - stack.model_g1, stack.g2 - stack.model_g2)
    for end, psf, residual in (
        ("", (stack.e1, stack.e2), (stack.residual_e1, stack.residual_e2)),
        ("_g", (stack.g1, stack.g2), residual_g),
    ):
        values[f"psf{end}"] = (*psf, np.ones(len(stack), dtype=bool))
        values[f"residual_stars{end}"] = (*residual, stack.star)
        values[f"residual_places{end}"] = (*residual, ~stack.star)
    return correlations(stack.x, stack.y, values, patch)


def correlations(
    x: np.ndarray, y: np.ndarray, values: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]], patch: np.ndarray
) -> StackCorrelations:
    """Return correlations of ellipticities e1, e2 at some of the positions [rad], all in the same bins, by kind.

    Errors are those of a jackknife over patches, where there are :data:`~.FEWEST_PATCHES` or more.
    """
    extent = float(np.hypot(np.ptp(x), np.ptp(y)))
    bins = bins_up_to(min(extent, SEPARATION_RANGES["long"][1] * ARCMIN))
    correlated = {}
    for kind, (e1, e2, rows) in values.items():
        correlated[kind] = shear_correlation(
            x[rows],
            y[rows],
            e1[rows],
            e2[rows],
            bins=bins,
            patch=patches_of_jackknife(patch[rows]),
        )
    return correlated


def stack_metrics(stack: PsfStack, correlated: StackCorrelations) -> dict[str, float]:
    """Return the figures of a stack: ellipticities, sizes and mean correlations.

    Those with ``_g`` are of adaptive moments, the others of weighted ones.
    """
    stars, places = stack.star, ~stack.star
    e, residual_e = (stack.e1, stack.e2), (stack.residual_e1, stack.residual_e2)
    residual_g = (stack.g1 - stack.model_g1, stack.g2 - stack.model_g2)
    size = (stack.size - stack.model_size) / stack.size
    metrics: dict[str, float] = {
        "points": len(stack),
        "rms_e": rms_modulus(*e),
        "rms_residual_e_stars": rms_modulus(*(v[stars] for v in residual_e)),
        "rms_residual_e_places": rms_modulus(*(v[places] for v in residual_e)),
        # Medians beside the rms: a polynomial fitted to few stars goes far astray at a few places.
        "median_residual_e_stars": _median_modulus(*(v[stars] for v in residual_e)),
        "median_residual_e_places": _median_modulus(*(v[places] for v in residual_e)),
        "median_size_arcsec": float(np.nanmedian(stack.size) / ARCSEC),
        "rms_relative_residual_size_places": float(np.sqrt(np.nanmean(size[places] ** 2))),
        "rms_g": rms_modulus(stack.g1, stack.g2),
        "rms_residual_g_stars": rms_modulus(*(v[stars] for v in residual_g)),
        "rms_residual_g_places": rms_modulus(*(v[places] for v in residual_g)),
        "median_residual_g_stars": _median_modulus(*(v[stars] for v in residual_g)),
        "median_residual_g_places": _median_modulus(*(v[places] for v in residual_g)),
        "rms_dt_g_places": float(np.sqrt(np.nanmean(stack.relative_size_residual[places] ** 2))),
    }
    for kind, correlation in correlated.items():
        for span in SEPARATION_RANGES:
            metrics[f"xi_plus_{kind}_{span}"] = correlation.mean_xi_plus(span)
            metrics[f"xi_plus_{kind}_{span}_error"] = correlation.error_mean_xi_plus(span)
    return metrics


def _median_modulus(e1: np.ndarray, e2: np.ndarray) -> float:
    """Return the median of the absolute value of an ellipticity."""
    return float(np.nanmedian(np.hypot(e1, e2)))
