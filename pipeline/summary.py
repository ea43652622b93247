"""Figures that sum up a run: correlations over all CCDs, and what is said of each CCD and of all together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .ccd_product import CcdProduct, Stars
from .correlation import Correlation, shear_correlation
from .photometry import ARCSEC

#: What is correlated: truth and truth - model where no star is, observed and observed - model at the stars.
KINDS = ("truth", "observed", "residual", "away")
_SHORTEST = 0.5  # arcmin
_BINS_PER_DECADE = 6
_ARCMIN = 60.0 * ARCSEC
#: The paper's claim of a residual below 1e-7 is for separations from here on [arcmin].
LONG_RANGE = 10.0


def correlations(products: Sequence[CcdProduct]) -> dict[str, Correlation]:
    """Correlate ellipticities and residuals over all CCDs (Jee & Tyson 2011, Fig. 14), each of :data:`KINDS`.

    Residuals at the stars of an unweighted fit with a constant term sum to zero over each CCD, so their correlation
    between CCDs cancels whatever the error of the model is; residuals away from the stars are what a galaxy sees. Both
    are always given.
    """
    bins = separation_bins(products)
    result = {}
    for kind in KINDS:
        x, y, e1, e2 = (np.concatenate(c) for c in zip(*(of_kind(p, kind) for p in products), strict=True))
        result[kind] = shear_correlation(x, y, e1, e2, **bins)
    return result


def separation_bins(products: Sequence[CcdProduct]) -> dict[str, Any]:
    """Return the bins of separation of a run, as arguments: ``min_sep`` and ``max_sep`` [rad], and ``n_bins``."""
    everywhere = np.concatenate(
        [np.stack([s.field_x, s.field_y]) for p in products for s in (p.truth, p.observed)], axis=1
    )
    longest = float(np.hypot(*np.ptp(everywhere, axis=1)))
    bins = max(4, round(_BINS_PER_DECADE * np.log10(longest / (_SHORTEST * _ARCMIN))))
    return {"min_sep": _SHORTEST * _ARCMIN, "max_sep": longest, "n_bins": bins}


def of_kind(product: CcdProduct, kind: str) -> tuple[np.ndarray, ...]:
    """Return field angles x, y [rad] and what of the ellipticity there is correlated, e1 and e2.

    Parameters
    ----------
    product : CcdProduct
        One CCD.
    kind : str
        One of :data:`KINDS`, or ``left_out``: observed - model fitted without the star.
    """
    stars: Stars = product.truth if kind in ("truth", "away") else product.observed
    if kind == "left_out":
        left_out = product.observed.left_out_e1, product.observed.left_out_e2
        return stars.field_x, stars.field_y, stars.e1 - left_out[0], stars.e2 - left_out[1]
    e = (stars.e1, stars.e2) if kind in ("truth", "observed") else (stars.residual_e1, stars.residual_e2)
    return stars.field_x, stars.field_y, *e


def ccd_figures(product: CcdProduct) -> dict[str, Any]:
    """Return the figures of one CCD; keys end in their unit."""
    truth, observed = product.truth, product.observed
    field = np.array([np.median(truth.field_x), np.median(truth.field_y)])
    return {
        "x_mm": product.center[0] * 1e3,
        "y_mm": product.center[1] * 1e3,
        "field_deg": float(np.rad2deg(np.hypot(*field))),
        "truth_psfs": len(truth),
        "stars": len(observed),
        "stars_used": int(observed.used.sum()),
        "pixels_rejected": product.model.n_rejected,
        "fwhm_arcsec": _median(truth.fwhm) / ARCSEC,
        "mean_e_truth": _mean(np.hypot(truth.e1, truth.e2)),
        "mean_e_observed": _mean(np.hypot(observed.e1, observed.e2)),
        "rms_residual_at_stars": _rms(observed.residual_e1, observed.residual_e2),
        "rms_residual_left_out": _rms(observed.e1 - observed.left_out_e1, observed.e2 - observed.left_out_e2),
        "rms_residual_away": _rms(truth.residual_e1, truth.residual_e2),
        "truth_variance_in_components": product.truth_model.explained,
        "kink_observed": product.model.kink,
        "kink_truth": product.truth_model.kink,
    }


def run_figures(products: Sequence[CcdProduct], correlated: dict[str, Correlation]) -> dict[str, Any]:
    """Return the figures of the whole run: of each CCD, of all, and the correlations."""
    each = {p.name: ccd_figures(p) for p in products}
    truth = [p.truth for p in products]
    observed = [p.observed for p in products]

    def column(stars: Sequence[Stars], key: str) -> np.ndarray:
        return np.concatenate([getattr(s, key) for s in stars])

    fwhm = np.concatenate([t.fwhm for t in truth]) / ARCSEC
    together = {
        "ccds": len(products),
        "truth_psfs": sum(map(len, truth)),
        "stars": sum(map(len, observed)),
        "stars_used": sum(figures["stars_used"] for figures in each.values()),
        "snr_min": float(column(observed, "snr").min()),
        "fwhm_arcsec": _median(fwhm),
        "fwhm_min_arcsec": float(np.nanmin(fwhm)),
        "fwhm_max_arcsec": float(np.nanmax(fwhm)),
        "mean_e_truth": _mean(np.hypot(column(truth, "e1"), column(truth, "e2"))),
        "max_e_truth": float(np.nanmax(np.hypot(column(truth, "e1"), column(truth, "e2")))),
        "mean_e_observed": _mean(np.hypot(column(observed, "e1"), column(observed, "e2"))),
        "rms_residual_at_stars": _rms(column(observed, "residual_e1"), column(observed, "residual_e2")),
        "rms_residual_left_out": _rms(
            column(observed, "e1") - column(observed, "left_out_e1"),
            column(observed, "e2") - column(observed, "left_out_e2"),
        ),
        "rms_residual_away": _rms(column(truth, "residual_e1"), column(truth, "residual_e2")),
        "truth_variance_in_components": min(p.truth_model.explained for p in products),
    }
    for kind, correlation in correlated.items():
        for name, (low, high) in {"short": (0.0, LONG_RANGE), "long": (LONG_RANGE, np.inf)}.items():
            together[f"xi_plus_{kind}_{name}"] = mean_xi_plus(correlation, low, high)
    return {
        "all": together,
        "ccd": each,
        "correlation": {
            kind: {
                "r_arcmin": c.r_arcmin,
                "xi_plus": c.xi_plus,
                "xi_minus": c.xi_minus,
                "error_plus": c.error_plus,
                "error_minus": c.error_minus,
                "pairs": c.n_pairs,
            }
            for kind, c in correlated.items()
        },
    }


def mean_xi_plus(correlation: Correlation, low: float, high: float) -> float:
    """Return the mean of xi+ over the pairs with separations from low to high [arcmin]; NaN where there are none."""
    r = correlation.r_arcmin
    inside = (r >= low) & (r < high) & (correlation.n_pairs > 0)
    pairs = correlation.n_pairs[inside]
    return float(np.sum(pairs * correlation.xi_plus[inside]) / pairs.sum()) if pairs.size else np.nan


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else np.nan


def _median(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else np.nan


def _rms(e1: np.ndarray, e2: np.ndarray) -> float:
    """Return the root mean square of one component, of both together."""
    squares = np.concatenate([e1, e2]) ** 2
    finite = squares[np.isfinite(squares)]
    return float(np.sqrt(finite.mean())) if finite.size else np.nan
