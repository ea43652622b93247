"""Metrics of a run: correlations over all CCDs, and metrics of each CCD and of all together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..core.statistics import finite_mean, finite_median, rms
from ..core.units import ARCMIN, ARCSEC
from ..measure.correlation import (
    SEPARATION_RANGES,
    Correlation,
    SeparationBins,
    patches_of_jackknife,
    shear_correlation,
)
from ..measure.rho_statistics import trace_of_moments
from ..reconstruction.ccd_product import CCD_KINDS, CcdProduct, CcdStars, Stars

#: Ellipticities that are correlated; ``truth`` and ``away`` (noise-free - model) are of the holdout positions.
CORRELATED = ("truth", "observed", "residual", "away")
#: Shape parameters of which a focal-plane model predicts its uncertainty.
_PREDICTED = ("e1", "e2", "size")
#: Ends of the long separations [arcmin], which are edges of bins: none has pairs on both sides of one.
_LONG_FROM, _LONG_TO = SEPARATION_RANGES["long"]
#: Smallest separation of pairs [arcmin], 0.56.
SHORTEST_ARCMIN = _LONG_FROM**2 / _LONG_TO
_BINS_PER_RANGE = 8
_FEWEST_BINS = 4


def correlations(
    products: Sequence[CcdStars], kinds: Sequence[str] | None = None, moments: str = "e"
) -> dict[str, Correlation]:
    """Correlate ellipticities and residuals, of :data:`~.KINDS`, over all CCDs (Jee & Tyson 2011, Fig. 14).

    They are those of weighted moments, e as the paper's, or of adaptive ones, g as DES, HSC and Rubin have them
    (:data:`~.MOMENTS`). By default those of :data:`CORRELATED` and, beside a focal-plane model, the residuals of the
    CCDs' own models.

    Residuals at the stars of an unweighted fit with a constant term sum to zero over each CCD, so their correlation
    between CCDs cancels for any error of the model; those at holdout positions apply to galaxies. Errors are by
    jackknife over the CCDs where there are :data:`~.FEWEST_PATCHES` or more, else from the scatter of the
    ellipticities. A kind of which fewer than two stars have adaptive moments, as images of the optics alone that are
    narrower than a pixel, is left out.
    """
    bins = separation_bins(products)
    if kinds is None:
        kinds = CORRELATED + CCD_KINDS if has_focal_plane_model(products) else CORRELATED
    result = {}
    for kind in kinds:
        stars = [p.stars(kind) for p in products]
        x, y = np.concatenate([p.sky_positions(kind) for p in products], axis=1)
        values, patch = ellipticities(products, kind, moments), patches(stars)
        if moments == "g":
            usable = np.isfinite(values).all(axis=0)
            if usable.sum() < 2:
                continue
            if patch is not None and patches_of_jackknife(patch[usable]) is None:
                patch = None
        result[kind] = shear_correlation(x, y, *values, bins=bins, patch=patch)
    return result


def has_focal_plane_model(products: Sequence[CcdStars]) -> bool:
    """Return whether the model of all products is one of the whole focal plane."""
    return all(p.has_focal_plane_model for p in products)


def ellipticities(products: Sequence[CcdStars], kind: str, moments: str = "e") -> np.ndarray:
    """Return both components of one kind on all CCDs, [2, n]; of weighted (e) or adaptive moments (g)."""
    return np.concatenate([p.ellipticity(kind, moments) for p in products], axis=1)


def size_residuals(products: Sequence[CcdStars], kind: str, moments: str = "e") -> np.ndarray:
    """Return (T - T of the model)/T of one kind on all CCDs, [n]."""
    return np.concatenate([p.relative_size_residual(kind, moments) for p in products])


def patches(stars: Sequence[Stars]) -> np.ndarray | None:
    """Return the number of the CCD of each star, the patches of a jackknife; None where there are too few CCDs."""
    return patches_of_jackknife(np.repeat(np.arange(len(stars)), [len(s) for s in stars]))


def separation_bins(products: Sequence[CcdStars]) -> SeparationBins:
    """Return the bins of separation of a run."""
    everywhere = np.concatenate(
        [np.stack([s.field_x, s.field_y]) for p in products for s in (p.holdout, p.observed)], axis=1
    )
    return bins_up_to(float(np.hypot(*np.ptp(everywhere, axis=1))))


def bins_up_to(longest: float, exact: bool | None = None) -> SeparationBins:
    """Return bins of separation from :data:`SHORTEST_ARCMIN` to beyond the longest separation [rad], 6.4 a decade."""
    shortest = SHORTEST_ARCMIN * ARCMIN
    width = np.log(_LONG_TO / _LONG_FROM) / _BINS_PER_RANGE
    # A longest separation at an edge is not to round beyond it.
    bins = max(_FEWEST_BINS, int(np.ceil(np.log(max(longest, shortest) / shortest) / width - 1e-9)))
    return SeparationBins(shortest, shortest * float(np.exp(width * bins)), bins, exact)


def ccd_metrics(product: CcdProduct) -> dict[str, Any]:
    """Return the metrics of one CCD; keys end in their unit."""
    holdout, observed = product.holdout, product.observed
    return {
        "x_mm": product.center[0] * 1e3,
        "y_mm": product.center[1] * 1e3,
        "field_deg": float(np.rad2deg(np.hypot(*_field_of_middle(product)))),
        "stars_with_defects": int((observed.defects != 0).sum()),
        "fwhm_arcsec": finite_median(holdout.fwhm) / ARCSEC,
        "pixels_rejected": product.model.n_rejected,
        "kink_observed": product.model.elbow,
        "kink_truth": product.noise_free_model.elbow,
        **({"psf_smoothness": smoothness} if (smoothness := product.model.smoothness) else {}),
        **_colour_metrics(product),
        **_common_metrics([product]),
    }


def _field_of_middle(product: CcdProduct) -> np.ndarray:
    """Return the field angle of the middle of a CCD [rad], by a plane through those of its holdout positions."""
    stars = product.holdout
    fields = np.stack([stars.field_x, stars.field_y], axis=-1)
    offsets = np.stack([stars.x, stars.y], axis=-1) - product.center
    plane = np.column_stack([np.ones(len(offsets)), offsets])
    if np.linalg.matrix_rank(plane) < plane.shape[1]:
        return np.median(fields, axis=0)
    return np.linalg.lstsq(plane, fields, rcond=None)[0][0]


def _colour_metrics(product: CcdProduct) -> dict[str, Any]:
    """Return what the stars of a CCD say of a dependence on their colours; nothing where they have no spectra."""
    if product.observed.colour is None:
        return {}
    colour, values = product.model.colour, product.observed.colour[product.observed.used]
    probability = 0.0 if colour is None else colour.probability
    return {"psf_colour_probability": probability, "stars_without_colour": int(np.isnan(values).sum())}


def run_metrics(
    products: Sequence[CcdProduct],
    correlated: Mapping[str, Correlation],
    correlated_g: Mapping[str, Correlation] | None = None,
) -> dict[str, Any]:
    """Return the metrics of a run: of each CCD, of all together, and the correlations.

    Keys with ``_g`` are of adaptive moments: g, and dt = (T - T model)/T; those with ``_e`` or neither of weighted
    ones, as the paper's. ``truth_psfs_with_g`` counts the noise-free PSFs that have adaptive moments, the others being
    narrower than a pixel. ``distortion`` is (a^2 - b^2)/(a^2 + b^2) of adaptive moments, the e of the LSST's
    requirements; ``scatter`` the rms of a component of the noise-free PSFs about the mean of their CCD, which is
    what a model that is constant on each CCD would leave. ``xi_plus_..._short`` is the mean of xi+ over pairs
    closer than 10 arcmin, ``xi_plus_..._long`` over those from 10 to 180 arcmin. Beside a focal-plane model, keys
    that end in ``_ccd`` are of the CCDs' own models, and ``chi2_away_`` is the mean square of noise-free - model
    over its predicted uncertainty.
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
    together |= _mean_xi_plus(correlated, correlated, "")
    if correlated_g is not None:
        together |= _mean_xi_plus(correlated_g, correlated, "g_")
    metrics = {
        "all": together,
        "ccd": {p.name: ccd_metrics(p) for p in products},
        "correlation": {kind: c.as_dict() for kind, c in correlated.items()},
    }
    if correlated_g is not None:
        metrics["correlation_g"] = {kind: c.as_dict() for kind, c in correlated_g.items()}
    return metrics


def _mean_xi_plus(correlated: Mapping[str, Correlation], kinds: Iterable[str], prefix: str) -> dict[str, float]:
    """Return mean xi+ and errors of kinds over the ranges of separation; NaN of a kind without a correlation."""
    metrics = {}
    for kind in kinds:
        for name in SEPARATION_RANGES:
            correlation = correlated.get(kind)
            mean, error = (
                (np.nan, np.nan)
                if correlation is None
                else (correlation.mean_xi_plus(name), correlation.error_mean_xi_plus(name))
            )
            metrics[f"xi_plus_{prefix}{kind}_{name}"] = mean
            metrics[f"error_xi_plus_{prefix}{kind}_{name}"] = error
    return metrics


def _common_metrics(products: Sequence[CcdProduct]) -> dict[str, Any]:
    """Return the metrics of which a run has the same as each of its CCDs."""
    residuals = {"at_stars": "residual", "left_out": "left_out", "away": "away"}
    chi2 = {}
    if has_focal_plane_model(products):
        residuals |= {"at_stars_ccd": "residual_ccd", "away_ccd": "away_ccd"}
        chi2 = {f"chi2_away_{key}": _chi2_away(products, key) for key in _PREDICTED}
    return {
        "truth_psfs": sum(len(p.holdout) for p in products),
        "truth_psfs_with_g": int(np.isfinite(ellipticities(products, "truth", "g")).all(axis=0).sum()),
        "stars": sum(len(p.observed) for p in products),
        "stars_used": sum(int(p.observed.used.sum()) for p in products),
        **{f"mean_e_{k}": finite_mean(np.hypot(*ellipticities(products, k))) for k in ("truth", "observed")},
        **{f"rms_residual_{name}": rms(ellipticities(products, kind)) for name, kind in residuals.items()},
        "rms_scatter_e": scatter(products, "e"),
        **{f"mean_g_{k}": finite_mean(np.hypot(*ellipticities(products, k, "g"))) for k in ("truth", "observed")},
        "median_distortion_truth": _median_distortion(products),
        **{f"rms_residual_g_{name}": rms(ellipticities(products, kind, "g")) for name, kind in residuals.items()},
        "rms_scatter_g": scatter(products, "g"),
        "rms_scatter_dt_g": size_scatter(products),
        **{f"rms_dt_g_{name}": rms(size_residuals(products, kind, "g")) for name, kind in residuals.items()},
        **chi2,
        "truth_variance_in_components": min(p.noise_free_model.explained for p in products),
    }


def scatter(products: Sequence[CcdStars], moments: str) -> float:
    """Return the rms of a component of the noise-free ellipticities about the mean of their CCD."""
    ellipticity = [np.stack(product.ellipticity("truth", moments)) for product in products]
    return _rms_within_ccds(ellipticity, lambda e: e - e.mean(axis=1, keepdims=True))


def size_scatter(products: Sequence[CcdStars]) -> float:
    """Return the rms of T of adaptive moments of the noise-free PSFs over the mean of their CCD, less 1."""
    stars = [product.stars("truth") for product in products]
    traces = [trace_of_moments(s.sigma, s.g1, s.g2)[None] for s in stars]
    return _rms_within_ccds(traces, lambda trace: trace / trace.mean() - 1.0)


def _rms_within_ccds(values: Sequence[np.ndarray], deviations: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return the rms of the deviations of the finite values [k, n] of each CCD; one value alone has none."""
    finite = [v[:, np.isfinite(v).all(axis=0)] for v in values]
    of_ccds = [deviations(v) for v in finite if v.shape[1] > 1]
    return rms(np.concatenate(of_ccds, axis=1)) if of_ccds else np.nan


def _median_distortion(products: Sequence[CcdProduct]) -> float:
    """Return the median of |e| = (a^2 - b^2)/(a^2 + b^2) of the noise-free PSFs, from adaptive moments."""
    g = np.hypot(*ellipticities(products, "truth", "g"))
    return finite_median(2.0 * g / (1.0 + g**2))


def _chi2_away(products: Sequence[CcdProduct], key: str) -> float:
    """Return the mean square of noise-free - model over the predicted uncertainty, at holdout positions."""
    true, model, sigma = (
        np.concatenate([getattr(p.holdout, f"{start}{key}") for p in products]) for start in ("", "model_", "sigma_")
    )
    return finite_mean(((true - model) / sigma) ** 2)
