"""PSFs of a run of the pipeline and their model (Jee & Tyson 2011, Figs. 9 and 11 to 14)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...core.products import Columns, image_hdu, table_hdu
from ...pipeline.report.focal_plane_plots import whiskers_plot
from ...pipeline.report.pictures import closest_middle_farthest
from ...pipeline.report.psf_plots import eigen_psf_plot, spectrum_plot
from ...pipeline.report.statistics_plots import correlation_plot, scatter_plot
from ...pipeline.report.tables import percent
from ...reconstruction.ccd_product import CcdProduct
from .bench import Bench
from .figure import EcsvData, FitsData, Reproduced, figure
from .focal_plane import optics_ellipticity

#: Least number of PSFs for a comparison of the variance in 20 components.
_ENOUGH = 200
#: Most stars of a CCD for the comparison of PSFs with and without the atmosphere.
_COMPARED = 3
#: Most stars in all for that comparison, but for one on every CCD.
_MOST_COMPARED = 189


@figure(
    "fig9",
    "mean PSF, eigen-PSFs and eigenvalues",
    "the first eigen-PSFs resemble shapelets, later ones are finer; about 20 suffice, over 99 % of the variance",
    minutes=(0.05, 0.1),
    of_run=True,
)
def eigen_psfs(bench: Bench) -> Reproduced:
    """Show mean, eigen-PSFs and eigenvalues (Fig. 9)."""
    products = bench.pipeline.products
    product = closest_middle_farthest(products)[0]
    model = product.noise_free_model
    explained = np.array([p.noise_free_model.explained for p in products])
    elbows = np.array([p.model.elbow for p in products])
    worst = float(explained.min())
    n = np.arange(1, len(model.eigenvalues) + 1)
    values = {
        "N": (n, "", "rank"),
        "EIGENVAL": (model.eigenvalues, "", "variance of unit-sum stamps along it"),
        "FRACTION": (model.eigenvalues / model.eigenvalues.sum(), "", "part of the variance"),
    }
    caveat = "too few PSFs, of which 20 components hold nearly all whatever they are: "
    source = (
        f"{model.n_stars} PSFs of one CCD, optics and heights included; the paper draws the components of 4000 PSFs of"
        " the atmosphere alone, over all CCDs"
    )
    hdus = [
        image_hdu("MEAN", model.mean, "mean PSF of unit sum"),
        image_hdu("EIGENPSF", model.components, "eigen-PSFs, orthonormal, by falling eigenvalue"),
        table_hdu("EIGENVAL", values),
    ]
    return Reproduced(
        {"": eigen_psf_plot(product, noise_free=True), "_eigenvalues": spectrum_plot(products)},
        {"": FitsData(hdus, [("CCD", product.name, ""), ("NPSF", model.n_stars, "noise-free PSFs")])},
        f"{model.n_components} components hold {percent(worst)} of the variance of the noise-free PSFs on the worst of"
        f" {len(products)} CCDs, {percent(float(np.median(explained)))} on the median one; observed stars: elbow at"
        f" {np.median(elbows):.0f}",
        worst > 0.99 if model.n_stars >= _ENOUGH else None,
        (caveat if model.n_stars < _ENOUGH else "") + source,
        {
            "ccd": product.name,
            "components": model.n_components,
            "explained_worst": worst,
            "explained_median": float(np.median(explained)),
            "kink_observed_median": float(np.median(elbows)),
        },
    )


@figure(
    "fig11",
    "whiskers with the atmosphere",
    "the pattern of the optics alone (Fig. 8), smaller: the atmosphere makes PSFs rounder; heights still show",
    minutes=(0.03, 0.6),
    of_run=True,
)
def whiskers_of_stars(bench: Bench) -> Reproduced:
    """Show whiskers of the PSFs with the atmosphere (Fig. 11)."""
    run = bench.pipeline
    e = np.concatenate([np.hypot(p.holdout.e1, p.holdout.e2) for p in run.products])
    mean, largest = float(np.nanmean(e)), float(np.nanmax(e))
    alike, ratio = _comparison_with_optics(bench)
    png = whiskers_plot(run.products, run.experiment.focal_plane, bench.optics.field_radius_on_detector, ("truth",))
    return Reproduced(
        {"": png},
        {"": EcsvData(_star_columns(run.products, "truth"), {"what": "noise-free PSFs"})},
        f"mean |e| {100 * mean:.2f} %, at most {100 * largest:.1f} %, on {len(run.products)} CCDs; at the same places"
        f" {100 * ratio:.0f} % of that without an atmosphere (mean taken off), with a correlation of {alike:.2f}",
        alike > 0.5 and ratio < 0.5,
        "the paper gives no number; what the air adds to all stars alike is taken off before the patterns are compared",
        {
            "mean_e": mean,
            "largest_e": largest,
            "ccds": len(run.products),
            "correlation_with_optics_alone": alike,
            "rms_over_that_of_optics_alone": ratio,
        },
    )


def _comparison_with_optics(bench: Bench) -> tuple[float, float]:
    """Return correlation and rms ratio of the pattern with that of the optics alone."""
    products = bench.pipeline.products
    stars_per_ccd = min(_COMPARED, max(1, _MOST_COMPARED // len(products)))
    stars = [p.holdout for p in products]
    x, y, e1, e2 = (np.concatenate([getattr(s, key)[:stars_per_ccd] for s in stars]) for key in ("x", "y", "e1", "e2"))
    optics_e = optics_ellipticity(bench, np.stack([x, y], axis=1))
    total_e = e1 + 1j * e2
    good = np.isfinite(optics_e) & np.isfinite(total_e)
    optics_e, total_e = optics_e[good] - optics_e[good].mean(), total_e[good] - total_e[good].mean()
    norm = np.sqrt(np.sum(np.abs(optics_e) ** 2) * np.sum(np.abs(total_e) ** 2))
    ratio = np.sqrt(np.sum(np.abs(total_e) ** 2) / np.sum(np.abs(optics_e) ** 2))
    return float(np.sum(optics_e * np.conj(total_e)).real / norm), float(ratio)


@figure(
    "fig12",
    "whiskers of the residual",
    "residuals at the stars are small and without visible pattern",
    minutes=(0.05, 0.2),
    of_run=True,
)
def whiskers_of_residual(bench: Bench) -> Reproduced:
    """Show whiskers of the residual, at the stars and at holdout positions (Fig. 12)."""
    run = bench.pipeline
    metrics = run.summary["all"]
    png = whiskers_plot(
        run.products, run.experiment.focal_plane, bench.optics.field_radius_on_detector, ("residual", "away")
    )
    at, away = metrics["rms_residual_at_stars"], metrics["rms_residual_away"]
    observed = _rms(run.products, "observed", ("e1", "e2"))
    return Reproduced(
        {"": png},
        {
            "": EcsvData(_star_columns(run.products, "residual"), {"what": "observed - model, at the stars"}),
            "_away": EcsvData(_star_columns(run.products, "away"), {"what": "truth - model, where no star is"}),
        },
        f"rms of a component: observed {100 * observed:.2f} %, residual at the stars {100 * at:.2f} %, away from them"
        f" {100 * away:.2f} %",
        at < 0.6 * observed,
        "residuals at the stars hold the noise of each star, of S/N from 30, which sets their size here; the paper,"
        " which gives no number, does not look away from the stars",
        {"rms_observed": observed, "rms_residual_at_stars": at, "rms_residual_away": away},
    )


@figure(
    "fig13",
    "scatter of the ellipticity",
    "residuals are much more compact than the observed ellipticities, and centred on the origin",
    minutes=(0.05, 0.1),
    of_run=True,
)
def scatter(bench: Bench) -> Reproduced:
    """Show the scatter of the ellipticity before and after the correction (Fig. 13)."""
    products = bench.pipeline.products
    before = _rms(products, "observed", ("e1", "e2"))
    after = _rms(products, "observed", ("residual_e1", "residual_e2"))
    # Noise adds to the variance of the PSFs themselves, which the noise-free ones show.
    noise = float(np.sqrt(max(before**2 - _rms(products, "holdout", ("e1", "e2")) ** 2, 0.0)))
    stars = [p.observed for p in products]
    residuals = [np.concatenate([getattr(s, k) for s in stars]) for k in ("residual_e1", "residual_e2")]
    mean = [float(np.nanmean(v)) for v in residuals]
    error = after / np.sqrt(np.isfinite(residuals[0]).sum())
    columns = _star_columns(products, "observed")
    for key in ("residual_e1", "residual_e2"):
        columns[key] = (np.concatenate([getattr(s, key) for s in stars]), "", "observed - model")
    centred = max(abs(m) for m in mean) < 3.0 * error
    return Reproduced(
        {"": scatter_plot(products)},
        {"": EcsvData(columns, {"what": "observed stars"})},
        f"rms of a component {100 * before:.2f} % before, {100 * after:.2f} % after; mean residual"
        f" ({1e4 * mean[0]:+.1f}, {1e4 * mean[1]:+.1f})e-4, its error {1e4 * error:.1f}e-4",
        after < 0.6 * before and centred,
        f"{before / after:.1f} times as compact: the noise of the stars, of S/N from 30, is {100 * noise:.2f} % by the"
        " difference to the noise-free PSFs, and no model of the PSF takes it away",
        {
            "rms_before": before,
            "rms_after": after,
            "rms_noise": noise,
            "mean_residual": mean,
            "error_of_mean": float(error),
        },
    )


@figure(
    "fig14",
    "correlation of the ellipticity",
    "xi+ about 3e-5 before, about 1e-8 after the correction, at the stars; below 1e-7 from 10' to 3°",
    minutes=(0.05, 0.1),
    of_run=True,
)
def correlation(bench: Bench) -> Reproduced:
    """Show the correlation of ellipticity and residuals (Fig. 14)."""
    run = bench.pipeline
    correlated = run.correlated
    columns: Columns = {"separation_arcmin": (correlated["observed"].r_arcmin, "arcmin", "of the observed stars")}
    for kind, c in correlated.items():
        columns[f"r_{kind}_arcmin"] = (c.r_arcmin, "arcmin", "mean separation of the pairs")
        columns[f"xi_plus_{kind}"] = (c.xi_plus, "", "xi+")
        columns[f"xi_minus_{kind}"] = (c.xi_minus, "", "xi-")
        columns[f"error_{kind}"] = (c.error_plus, "", "error of xi+ by jackknife over the CCDs")
        columns[f"pairs_{kind}"] = (c.n_pairs, "", "pairs")
    raw = correlated["observed"].mean_xi_plus("long")
    at, away = (correlated[k].mean_xi_plus("long") for k in ("residual", "away"))
    near = correlated["away"].mean_xi_plus("short")
    count, camera_count = len(run.products), len(bench.optics.camera)
    all_ccds = count == camera_count
    c = correlated["residual"]
    inside = c.within("long") & (c.n_pairs > 0)
    worst = np.argmax(np.abs(c.xi_plus[inside]))
    largest, error = float(np.abs(c.xi_plus[inside][worst])), float(c.error_plus[inside][worst])
    reached = abs(at) < 1e-7 and 1e-5 < raw < 9e-5
    return Reproduced(
        {"": correlation_plot(correlated)},
        {"": EcsvData(columns, {"what": "correlation of the ellipticity, TreeCorr", "ccds": count})},
        f"from 10' to 3°: {raw:.1e} before; {at:+.0e} after, at the stars (one bin at most {largest:.0e}, its error"
        f" {error:.0e}); {away:+.0e} away from the stars, {near:.0e} there within 10'",
        reached if all_ccds else None,
        (
            "in the mean over pairs at the stars, where residuals of each CCD sum to zero by construction; where there"
            " is no star, which is where galaxies are, the residual is larger"
            if all_ccds
            else f"{count} of {camera_count} CCDs have too few pairs to tell 1e-8 from nothing;"
            " residuals of each CCD sum to zero at its stars by construction, and are larger away from them"
        ),
        {
            "xi_plus_observed_10_to_180_arcmin": raw,
            "xi_plus_residual_10_to_180_arcmin": at,
            "xi_plus_away_10_to_180_arcmin": away,
            "xi_plus_away_below_10_arcmin": near,
            "largest_residual_bin": largest,
            "error_of_a_bin": error,
        },
    )


def _rms(products: Sequence[CcdProduct], kind: str, keys: tuple[str, str]) -> float:
    values = np.concatenate([getattr(getattr(p, kind), key) for p in products for key in keys])
    return float(np.sqrt(np.nanmean(values**2)))


def _star_columns(products: Sequence[CcdProduct], kind: str) -> Columns:
    """Return positions and ellipticities of one kind: truth, observed, residual or away."""
    stars = [p.stars(kind) for p in products]
    places = ("x", "y", "field_x", "field_y")
    x, y, field_x, field_y = (np.concatenate([getattr(s, key) for s in stars]) for key in places)
    e1, e2 = np.concatenate([p.ellipticity(kind) for p in products], axis=1)
    names = np.repeat([p.name for p in products], [len(s) for s in stars])
    return {
        "ccd": (names, "", "name of the CCD"),
        "x_mm": (x * 1e3, "mm", "detector x"),
        "y_mm": (y * 1e3, "mm", "detector y"),
        "field_x_deg": (np.rad2deg(field_x), "deg", "field angle x"),
        "field_y_deg": (np.rad2deg(field_y), "deg", "field angle y"),
        "e1": (e1, "", "ellipticity (a-b)/(a+b) along x"),
        "e2": (e2, "", "ellipticity along x = y"),
    }
