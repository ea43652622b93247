"""Metrics of a run: correlations over all CCDs, and metrics of each CCD and of all together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core.statistics import finite_mean, finite_median, rms
from ..core.units import ARCMIN, ARCSEC
from ..measure.correlation import SEPARATION_RANGES, Correlation, shear_correlation
from ..reconstruction.ccd_product import CCD_KINDS, CcdProduct, CcdStars, Stars

#: Ellipticities that are correlated; ``truth`` and ``away`` (noise-free - model) are of the holdout positions.
CORRELATED = ("truth", "observed", "residual", "away")
#: Shape parameters of which a focal-plane model predicts its uncertainty.
_PREDICTED = ("e1", "e2", "size")
#: Smallest separation of pairs [arcmin].
SHORTEST_ARCMIN = 0.5
_BINS_PER_DECADE = 6


def correlations(products: Sequence[CcdStars], kinds: Sequence[str] | None = None) -> dict[str, Correlation]:
    """Correlate ellipticities and residuals, of :data:`~.KINDS`, over all CCDs (Jee & Tyson 2011, Fig. 14).

    By default those of :data:`CORRELATED` and, beside a focal-plane model, the residuals of the CCDs' own models.

    Residuals at the stars of an unweighted fit with a constant term sum to zero over each CCD, so their correlation
    between CCDs cancels for any error of the model; those at holdout positions apply to galaxies. Errors are by
    jackknife over the CCDs where there are two or more.
    """
    bins = separation_bins(products)
    if kinds is None:
        kinds = CORRELATED + CCD_KINDS if has_focal_plane_model(products) else CORRELATED
    result = {}
    for kind in kinds:
        stars = [p.stars(kind) for p in products]
        x, y = np.concatenate([p.sky_positions(kind) for p in products], axis=1)
        result[kind] = shear_correlation(x, y, *ellipticities(products, kind), patch=patches(stars), **bins)
    return result


def has_focal_plane_model(products: Sequence[CcdStars]) -> bool:
    """Return whether the model of all products is one of the whole focal plane."""
    return all(p.has_focal_plane_model for p in products)


def ellipticities(products: Sequence[CcdStars], kind: str) -> np.ndarray:
    """Return e1 and e2 of one kind on all CCDs, [2, n]."""
    return np.concatenate([p.ellipticity(kind) for p in products], axis=1)


def patches(stars: Sequence[Stars]) -> np.ndarray | None:
    """Return the number of the CCD of each star, the patches of a jackknife; None where there is but one CCD."""
    return np.repeat(np.arange(len(stars)), [len(s) for s in stars]) if len(stars) > 1 else None


def separation_bins(products: Sequence[CcdStars]) -> dict[str, Any]:
    """Return the bins of separation of a run, as arguments: ``min_sep`` and ``max_sep`` [rad], and ``n_bins``."""
    everywhere = np.concatenate(
        [np.stack([s.field_x, s.field_y]) for p in products for s in (p.holdout, p.observed)], axis=1
    )
    longest = float(np.hypot(*np.ptp(everywhere, axis=1)))
    bins = max(4, round(_BINS_PER_DECADE * np.log10(longest / (SHORTEST_ARCMIN * ARCMIN))))
    return {"min_sep": SHORTEST_ARCMIN * ARCMIN, "max_sep": longest, "n_bins": bins}


def ccd_metrics(product: CcdProduct) -> dict[str, Any]:
    """Return the metrics of one CCD; keys end in their unit."""
    holdout, observed = product.holdout, product.observed
    field = np.array([np.median(holdout.field_x), np.median(holdout.field_y)])
    return {
        "x_mm": product.center[0] * 1e3,
        "y_mm": product.center[1] * 1e3,
        "field_deg": float(np.rad2deg(np.hypot(*field))),
        "stars_with_defects": int((observed.defects != 0).sum()),
        "fwhm_arcsec": finite_median(holdout.fwhm) / ARCSEC,
        "pixels_rejected": product.model.n_rejected,
        "kink_observed": product.model.elbow,
        "kink_truth": product.noise_free_model.elbow,
        **({"psf_smoothness": smoothness} if (smoothness := product.model.smoothness) else {}),
        **_common_metrics([product]),
    }


def run_metrics(products: Sequence[CcdProduct], correlated: dict[str, Correlation]) -> dict[str, Any]:
    """Return the metrics of a run: of each CCD, of all together, and the correlations.

    ``xi_plus_..._short`` is the mean of xi+ over pairs closer than 10 arcmin, ``xi_plus_..._long`` over those from 10
    to 180 arcmin. Beside a focal-plane model, keys that end in ``_ccd`` are of the CCDs' own models, and ``chi2_away_``
    is the mean square of noise-free - model over its predicted uncertainty.
    """
    fwhm = np.concatenate([p.holdout.fwhm for p in products]) / ARCSEC
    together = {
        "ccds": len(products),
        "snr_min": float(min(p.observed.snr.min() for p in products)),
        "fwhm_arcsec": finite_median(fwhm),
        "fwhm_min_arcsec": float(np.nanmin(fwhm)),
        "fwhm_max_arcsec": float(np.nanmax(fwhm)),
        "max_e_truth": float(np.nanmax(np.hypot(*ellipticities(products, "truth")))),
        **_common_metrics(products),
    }
    for kind, correlation in correlated.items():
        for name in SEPARATION_RANGES:
            together[f"xi_plus_{kind}_{name}"] = correlation.mean_xi_plus(name)
            together[f"error_xi_plus_{kind}_{name}"] = correlation.error_mean_xi_plus(name)
    return {
        "all": together,
        "ccd": {p.name: ccd_metrics(p) for p in products},
        "correlation": {kind: c.as_dict() for kind, c in correlated.items()},
    }


def _common_metrics(products: Sequence[CcdProduct]) -> dict[str, Any]:
    """Return the metrics of which a run has the same as each of its CCDs."""
    residuals = {"at_stars": "residual", "left_out": "left_out", "away": "away"}
    chi2 = {}
    if has_focal_plane_model(products):
        residuals |= {"at_stars_ccd": "residual_ccd", "away_ccd": "away_ccd"}
        chi2 = {f"chi2_away_{key}": _chi2_away(products, key) for key in _PREDICTED}
    return {
        "truth_psfs": sum(len(p.holdout) for p in products),
        "stars": sum(len(p.observed) for p in products),
        "stars_used": sum(int(p.observed.used.sum()) for p in products),
        **{f"mean_e_{k}": finite_mean(np.hypot(*ellipticities(products, k))) for k in ("truth", "observed")},
        **{f"rms_residual_{name}": rms(ellipticities(products, kind)) for name, kind in residuals.items()},
        **chi2,
        "truth_variance_in_components": min(p.noise_free_model.explained for p in products),
    }


def _chi2_away(products: Sequence[CcdProduct], key: str) -> float:
    """Return the mean square of noise-free - model over the predicted uncertainty, at holdout positions."""
    true, model, sigma = (
        np.concatenate([getattr(p.holdout, f"{start}{key}") for p in products]) for start in ("", "model_", "sigma_")
    )
    return finite_mean(((true - model) / sigma) ** 2)
