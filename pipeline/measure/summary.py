"""Metrics of a run: correlations over all CCDs, and metrics of each CCD and of all together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...core.units import ARCMIN, ARCSEC
from ..ccd_product import CcdProduct, Stars
from .correlation import SEPARATION_RANGES, Correlation, shear_correlation

#: Ellipticities that are correlated; ``truth`` and ``away`` (noise-free - model) are of the holdout positions.
CORRELATED = ("truth", "observed", "residual", "away")
#: Pairs are counted from here on [arcmin].
SHORTEST_ARCMIN = 0.5
_BINS_PER_DECADE = 6


def correlations(products: Sequence[CcdProduct], kinds: Sequence[str] = CORRELATED) -> dict[str, Correlation]:
    """Correlate ellipticities and residuals over all CCDs (Jee & Tyson 2011, Fig. 14).

    Residuals at the stars of an unweighted fit with a constant term sum to zero over each CCD, so their correlation
    between CCDs cancels for any error of the model. Those at holdout positions apply to galaxies. Both are always
    given. Errors are by jackknife over the CCDs where there are two or more.

    Parameters
    ----------
    products : sequence of CcdProduct
        CCDs.
    kinds : sequence of str
        Ellipticities, of :data:`~pachon.pipeline.ccd_product.KINDS`.
    """
    bins = separation_bins(products)
    result = {}
    for kind in kinds:
        stars = [p.stars(kind) for p in products]
        x, y = (np.concatenate([getattr(s, key) for s in stars]) for key in ("field_x", "field_y"))
        e1, e2 = np.concatenate([p.ellipticity(kind) for p in products], axis=1)
        result[kind] = shear_correlation(x, y, e1, e2, patch=patches(stars), **bins)
    return result


def patches(stars: Sequence[Stars]) -> np.ndarray | None:
    """Return the number of the CCD of each star, the patches of a jackknife; None where there is but one CCD."""
    return np.repeat(np.arange(len(stars)), [len(s) for s in stars]) if len(stars) > 1 else None


def separation_bins(products: Sequence[CcdProduct]) -> dict[str, Any]:
    """Return the bins of separation of a run, as arguments: ``min_sep`` and ``max_sep`` [rad], and ``n_bins``."""
    everywhere = np.concatenate(
        [np.stack([s.field_x, s.field_y]) for p in products for s in (p.holdout, p.observed)], axis=1
    )
    longest = float(np.hypot(*np.ptp(everywhere, axis=1)))
    bins = max(4, round(_BINS_PER_DECADE * np.log10(longest / (SHORTEST_ARCMIN * ARCMIN))))
    return {"min_sep": SHORTEST_ARCMIN * ARCMIN, "max_sep": longest, "n_bins": bins}


def ccd_metrics(product: CcdProduct) -> dict[str, Any]:
    """Return the metrics of one CCD; keys end in their unit."""
    truth, observed = product.holdout, product.observed
    field = np.array([np.median(truth.field_x), np.median(truth.field_y)])
    return {
        "x_mm": product.center[0] * 1e3,
        "y_mm": product.center[1] * 1e3,
        "field_deg": float(np.rad2deg(np.hypot(*field))),
        "truth_psfs": len(truth),
        "stars": len(observed),
        "stars_used": int(observed.used.sum()),
        "stars_with_defects": int((observed.defects != 0).sum()),
        "pixels_rejected": product.model.n_rejected,
        "fwhm_arcsec": _median(truth.fwhm) / ARCSEC,
        "mean_e_truth": finite_mean(np.hypot(truth.e1, truth.e2)),
        "mean_e_observed": finite_mean(np.hypot(observed.e1, observed.e2)),
        "rms_residual_at_stars": _rms(observed.residual_e1, observed.residual_e2),
        "rms_residual_left_out": _rms(observed.e1 - observed.leave_one_out_e1, observed.e2 - observed.leave_one_out_e2),
        "rms_residual_away": _rms(truth.residual_e1, truth.residual_e2),
        "truth_variance_in_components": product.noise_free_model.explained,
        "kink_observed": product.model.elbow,
        "kink_truth": product.noise_free_model.elbow,
    }


def run_metrics(products: Sequence[CcdProduct], correlated: dict[str, Correlation]) -> dict[str, Any]:
    """Return the metrics of a run: of each CCD, of all together, and the correlations.

    ``xi_plus_..._short`` is the mean of xi+ over pairs closer than 10 arcmin, ``xi_plus_..._long`` over those from 10
    to 180 arcmin.
    """
    each = {p.name: ccd_metrics(p) for p in products}
    truth = [p.holdout for p in products]
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
        "mean_e_truth": finite_mean(np.hypot(column(truth, "e1"), column(truth, "e2"))),
        "max_e_truth": float(np.nanmax(np.hypot(column(truth, "e1"), column(truth, "e2")))),
        "mean_e_observed": finite_mean(np.hypot(column(observed, "e1"), column(observed, "e2"))),
        "rms_residual_at_stars": _rms(column(observed, "residual_e1"), column(observed, "residual_e2")),
        "rms_residual_left_out": _rms(
            column(observed, "e1") - column(observed, "leave_one_out_e1"),
            column(observed, "e2") - column(observed, "leave_one_out_e2"),
        ),
        "rms_residual_away": _rms(column(truth, "residual_e1"), column(truth, "residual_e2")),
        "truth_variance_in_components": min(p.noise_free_model.explained for p in products),
    }
    for kind, correlation in correlated.items():
        for name in SEPARATION_RANGES:
            together[f"xi_plus_{kind}_{name}"] = correlation.mean_xi_plus(name)
            together[f"error_xi_plus_{kind}_{name}"] = correlation.error_mean_xi_plus(name)
    return {
        "all": together,
        "ccd": each,
        "correlation": {kind: c.as_dict() for kind, c in correlated.items()},
    }


def finite_mean(values: np.ndarray) -> float:
    """Return the mean of the finite values; NaN where there are none."""
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
