"""Metrics of a run as tables for the terminal and the report."""

from __future__ import annotations

import math
from typing import Any

from astropy.table import Table

from ...core.number_text import CellText, NumberText, number_with_error
from ...measure.correlation import FEWEST_PATCHES, SEPARATION_RANGES
from ...models.camera.camera import Camera
from ...models.camera.height_statistics import HeightStatistics
from ..summary import CORRELATED

_NAMES = {
    "truth": "noise-free PSFs",
    "observed": "observed",
    "residual": "observed - model, at the stars",
    "away": "noise-free - model, at holdout positions",
}


#: Least fraction of the noise-free PSFs with adaptive moments for a verdict in g: a failure or two shift no mean.
LEAST_FRACTION_WITH_G = 0.99

#: What a model that is constant on each CCD would leave.
ABOUT_MEAN = "about the CCD's mean"


def headline(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the metrics of a run: name, and value with unit."""
    metrics = summary["all"]
    rows = [
        ("CCDs", f"{metrics['ccds']}"),
        ("PSFs known without noise, with a g", "{truth_psfs}, {truth_psfs_with_g}".format(**metrics)),
        ("observed stars, used in the fit", f"{metrics['stars']}, {metrics['stars_used']}"),
        (
            "FWHM of the noise-free PSFs (at half maximum), median and range",
            '{fwhm_arcsec:.3f}", {fwhm_min_arcsec:.3f} to {fwhm_max_arcsec:.3f}"'.format(**metrics),
        ),
        ("median |e| as in the LSST's requirements, noise-free PSFs", _percent(metrics["median_distortion_truth"])),
        ("mean |g|, weighted |e|: noise-free PSFs", _both(metrics, "mean_g_truth", "mean_e_truth")),
        ("mean |g|, weighted |e|: observed stars", _both(metrics, "mean_g_observed", "mean_e_observed")),
        (f"rms g, e of noise-free PSFs {ABOUT_MEAN}", _both(metrics, "rms_scatter_g", "rms_scatter_e")),
        (f"rms dT/T of noise-free PSFs {ABOUT_MEAN}", _percent(metrics["rms_scatter_dt_g"])),
    ]
    for key, words in (
        ("at_stars", "at the stars"),
        ("left_out", "leave-one-out"),
        ("away", "at holdout positions (noise-free)"),
    ):
        rows.append((f"rms g, e residual, {words}", _both(metrics, f"rms_residual_g_{key}", f"rms_residual_{key}")))
        rows.append((f"rms dT/T, {words}", _percent(metrics[f"rms_dt_g_{key}"])))
    rows.append(
        ("variance of noise-free PSFs in the components, worst CCD", percent(metrics["truth_variance_in_components"]))
    )
    low, high = SEPARATION_RANGES["long"]
    for start, name in (("g_", "g"), ("", "weighted e")):
        for kind in CORRELATED:
            near, far = (_xi_plus(metrics, f"{start}{kind}", separations) for separations in ("short", "long"))
            rows.append((f"ξ+ of {name}, {_NAMES[kind]}, below {low:g}' / {low:g}' to {high:g}'", f"{near} / {far}"))
    return rows


def verdict(summary: dict[str, Any]) -> str:
    """Return the result of a run in one sentence, with another one where few PSFs have a g."""
    metrics, lost = summary["all"], len(summary["not_modelled"])
    where = "On one CCD" if metrics["ccds"] == 1 else f"On {metrics['ccds']} CCDs"
    width = f'{metrics["fwhm_arcsec"]:.3g}" wide' if math.isfinite(metrics["fwhm_arcsec"]) else "of unknown width"
    keys = {
        "g": ("mean_g_truth", "rms_residual_g_away", "rms_scatter_g"),
        "weighted e": ("mean_e_truth", "rms_residual_away", "rms_scatter_e"),
    }
    # Images narrower than a pixel have no adaptive moments; those that have are not typical, but the widest.
    measured = metrics["truth_psfs_with_g"] >= LEAST_FRACTION_WITH_G * metrics["truth_psfs"]
    name = "g" if measured and all(math.isfinite(metrics[key]) for key in keys["g"]) else "weighted e"
    mean, residual, scatter = (_percent(metrics[key]) for key in keys[name])
    constant = "a constant PSF" if metrics["ccds"] == 1 else "a constant PSF on each CCD"
    left_out = f"; {lost} {'CCD' if lost == 1 else 'CCDs'} could not be modelled" if lost else ""
    sharp = (
        ""
        if measured or not metrics["truth_psfs_with_g"]
        else f" Only {metrics['truth_psfs_with_g']} of {metrics['truth_psfs']} noise-free PSFs have adaptive moments, "
        "which images narrower than 2 pixels often lack; figures of g are those of the few."
    )
    return (
        f"{where} the PSF is {width} with a mean ellipticity |{name}| of {mean}; where no star is, its model errs by "
        f"{residual} in {name}, against {scatter} of {constant}{left_out}.{sharp}"
    )


#: Which ellipticity is which, for readers of the metrics.
MOMENTS_NOTE = (
    "g = (a - b)/(a + b) and T = Mxx + Myy are of adaptive moments, as of DES, HSC and Rubin; weighted e = (a - "
    "b)/(a + b) is of moments under a round weight, as in Jee & Tyson (2011), about half of g. The e of the LSST's "
    "requirements is (a² - b²)/(a² + b²), about 2 g. All are along the pixels, the distortion of the field in them; "
    "runs with a pointing have G1_SKY and G2_SKY in their products. Errors of ξ+ are a jackknife over "
    f"{FEWEST_PATCHES} CCDs or more; fewer are too few."
)


def _both(metrics: dict[str, Any], g: str, e: str) -> str:
    """Return a metric of g with that of the weighted e."""
    return f"{_percent(metrics[g])}, {_percent(metrics[e])}"


def _xi_plus(metrics: dict[str, Any], kind: str, name: str) -> str:
    """Return a mean xi+ with its error."""
    return number_with_error(metrics[f"xi_plus_{kind}_{name}"], metrics[f"error_xi_plus_{kind}_{name}"], ".1e")


CAMERA_COLUMNS = ("ccd", "x_mm", "y_mm", "rotation_deg", "nx", "ny", "raft", "vendor")
CAMERA_CAPTION = "Centre on the focal plane, angle from +x towards +y, pixels along x and y of each."


def camera_rows(camera: Camera) -> list[tuple[str, float, float, float, int, int, str, str]]:
    """Return rows of the CCDs of a camera, in the columns of :data:`CAMERA_COLUMNS`."""
    vendors = camera.vendors or ("",) * len(camera)
    return [
        (name, round(1e3 * x, 6), round(1e3 * y, 6), float(angle), nx, ny, raft, vendor)
        for name, (x, y), angle, (nx, ny), raft, vendor in zip(
            camera.ccd_names,
            camera.centers.tolist(),
            camera.rotation_deg,
            camera.pixels.tolist(),
            camera.raft_of,
            vendors,
            strict=True,
        )
    ]


MODELS_COLUMNS = ("", "focal plane", "CCD by CCD")
MODELS_CAPTION = (
    "One model of the whole focal plane, which fills the products, beside the models of the single CCDs. rms of one "
    "component of the residual; mean ξ+ of the residuals; reduced chi-square: mean square of the difference over the "
    "uncertainty that the model predicts, of noise-free - model at holdout positions, and of observed - model fitted "
    "without the star, noise of the star included."
)


def models_rows(summary: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return rows of the focal-plane model beside the CCDs' own models, in the columns of :data:`MODELS_COLUMNS`.

    There are none in a run without a focal-plane model.
    """
    metrics = summary["all"]
    if "rms_residual_away_ccd" not in metrics:
        return []
    rows: list[tuple[str, ...]] = [
        (
            f"rms residual of {name}, {words}",
            *(_percent(metrics[f"rms_residual_{start}{key}{end}"]) for end in ("", "_ccd")),
        )
        for start, name in (("g_", "g"), ("", "weighted e"))
        for key, words in (("at_stars", "at the stars"), ("away", "at holdout positions (noise-free)"))
    ]
    for start, name in (("g_", "g"), ("", "weighted e")):
        for kind in ("residual", "away"):
            for separations, (low, high) in SEPARATION_RANGES.items():
                words = f"{low:g}' to {high:g}'" if low > 0.0 else f"below {high:g}'"
                xi_texts = (_xi_plus(metrics, f"{start}{kind}{end}", separations) for end in ("", "_ccd"))
                rows.append((f"ξ+ of {name}, {_NAMES[kind]}, {words}", *xi_texts))
    for key, name in (("left_out", "leave-one-out"), ("away", "at holdout positions")):
        chi2 = {k.rpartition("_")[2]: v for k, v in metrics.items() if k.startswith(f"chi2_{key}_")}
        values = ", ".join(f"{v:.2f}" for v in chi2.values())
        rows.append((f"reduced chi-square, {name}: {', '.join(chi2)}", values, "-"))
    return rows


PER_CCD_COLUMNS = (
    ("CCD", ""),
    ("field", "deg"),
    ("FWHM", "arcsec"),
    ("|g|", "%"),
    ("scatter", "%"),
    ("at stars", "%"),
    ("leave-one-out", "%"),
    ("holdout", "%"),
    ("variance", "%"),
    ("elbow", ""),
    ("stars used", ""),
)
PER_CCD_CAPTION = (
    "Field: distance of the middle of the CCD from the axis; FWHM: at half maximum, median of the noise-free PSFs. "
    "Mean |g| of the noise-free PSFs, adaptive moments; scatter: rms of one component about the CCD's mean, which a "
    "constant model would leave; rms of one component of the residual: observed - model at the stars; the same, "
    "leave-one-out; noise-free - model at the holdout positions. Variance: part of the variance of the noise-free "
    "PSFs in the components. Elbow: components before the eigenvalues flatten, of the observed stars and of the "
    "noise-free PSFs. Stars used: those that the model was fitted to, of all."
)


def per_ccd(summary: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return a row for each CCD, in the columns of :data:`PER_CCD_COLUMNS`."""
    return [
        (
            name,
            NumberText(f["field_deg"], ".2f"),
            NumberText(f["fwhm_arcsec"], ".3f"),
            _percent_number(f["mean_g_truth"]),
            _percent_number(f["rms_scatter_g"]),
            _percent_number(f["rms_residual_g_at_stars"]),
            _percent_number(f["rms_residual_g_left_out"]),
            _percent_number(f["rms_residual_g_away"]),
            _variance_text(f["truth_variance_in_components"]),
            CellText(
                f"{f['kink_observed']}, {f['kink_truth']}",
                {"elbow observed": f["kink_observed"], "elbow noise-free": f["kink_truth"]},
            ),
            CellText(f"{f['stars_used']} of {f['stars']}", {"": f["stars_used"], "stars": f["stars"]}),
        )
        for name, f in summary["ccd"].items()
    ]


DIAGNOSTICS_COLUMNS = (
    "residual",
    "mean g1",
    "mean g2",
    "rms g",
    "mean dT/T",
    "rms dT/T",
    "largest ξ+ of g",
    "at [arcmin]",
    "rms e",
)
DIAGNOSTICS_CAPTION = (
    "g and T = Mxx + Myy of adaptive moments, less those of the model and, for T, over its own value; rms of one "
    f"component. Largest ξ+ of either sign from 10' to 3 deg, with the jackknife error over {FEWEST_PATCHES} CCDs or "
    "more. Last, the weighted e as in Jee & Tyson (2011), about half of g. A model that is constant on each CCD would "
    "leave the scatter of the noise-free PSFs about the CCD's mean."
)


def diagnostics_rows(overall: dict[str, float]) -> list[tuple[str, ...]]:
    """Return a row for each kind of residual, in the columns of :data:`DIAGNOSTICS_COLUMNS`."""

    def metric(key: str) -> float:
        return overall.get(key, math.nan)

    def power(key: str) -> str:
        return _power(metric(key))

    names = {"residual": _NAMES["residual"], "left_out": "the same, star left out of the fit", "away": _NAMES["away"]}
    if "rms_e_away_ccd" in overall:
        names |= {"residual_ccd": "CCD's own model, at the stars", "away_ccd": "CCD's own model, at holdout positions"}
    rows = [
        (
            name,
            *(power(f"{statistic}_{kind}") for statistic in ("mean_g1", "mean_g2", "rms_g", "mean_dt_g", "rms_dt_g")),
            number_with_error(metric(f"largest_g_{kind}_xi_plus"), metric(f"largest_g_{kind}_error_plus"), ".1e"),
            NumberText(metric(f"largest_g_{kind}_r_arcmin"), ".1f"),
            power(f"rms_e_{kind}"),
        )
        for kind, name in names.items()
    ]
    scatter = ("-", "-", power("rms_scatter_g"), "-", power("rms_scatter_dt_g"), "-", "-", power("rms_scatter_e"))
    return [(f"noise-free PSFs {ABOUT_MEAN}", *scatter), *rows]


PIFF_COLUMNS = ("model", "stars", "mean e1", "mean e2", "rms e", "mean dT/T", "rms dT/T")
PIFF_CAPTION = (
    "Ellipticity and size T = Q11 + Q22 of stars, less those of the model and, for T, over its own value; rms of one "
    "component, with the noise of the stars. Residuals at the stars of a fit are too small."
)


def piff_rows(models: Table) -> list[tuple[str, ...]]:
    """Return a row for each model of a comparison with Piff, in the columns of :data:`PIFF_COLUMNS`."""
    keys = ("mean_e1", "mean_e2", "rms_e", "mean_dt", "rms_dt")
    return [(row["model"], str(row["stars"]), *(_power(row[key]) for key in keys)) for row in models]


ATTRIBUTION_COLUMNS = (
    "off",
    "rms g [%]",
    "at stars [%]",
    "holdout [%]",
    "dT/T holdout [%]",
    "ξ+ of g, below 10'",
    "beyond",
    "change",
    "ξ+ holdout, beyond",
    "rms e [%]",
)
ATTRIBUTION_CAPTION = (
    "The same stars without one cause, in g and T of adaptive moments. rms of one component of the noise-free PSFs, "
    "and of the residuals at the stars and at the holdout positions; mean ξ+ below 10' and from there to 3 deg; "
    f"change: full case less this one beyond 10', with the jackknife error over {FEWEST_PATCHES} CCDs or more. Last, "
    "rms of the noise-free PSFs in the weighted e of Jee & Tyson (2011)."
)


_ATTRIBUTION_RMS = ("rms_g_truth", "rms_residual_g_at_stars", "rms_residual_g_away", "rms_dt_g_away")


def attribution_rows(metrics: dict[str, dict[str, float]]) -> list[tuple[str, ...]]:
    """Return a row for each case of an attribution, in the columns of :data:`ATTRIBUTION_COLUMNS`."""

    def change(case_metrics: dict[str, float]) -> str:
        if "change_xi_plus_g_truth_long" not in case_metrics:
            return "-"
        error = case_metrics.get("error_xi_plus_g_truth_long", math.nan)
        return number_with_error(case_metrics["change_xi_plus_g_truth_long"], error, ".1e")

    return [
        (
            "nothing" if case == "full" else case,
            *(_percent_number(case_metrics[key]) for key in _ATTRIBUTION_RMS),
            _power(case_metrics["xi_plus_g_truth_short"]),
            _power(case_metrics["xi_plus_g_truth_long"]),
            change(case_metrics),
            _power(case_metrics["xi_plus_g_away_long"]),
            _percent_number(case_metrics["rms_e_truth"]),
        )
        for case, case_metrics in metrics.items()
    ]


def percent(fraction: float) -> str:
    """Return a fraction in per cent, with more digits near all, and never rounded up to all."""
    if fraction < 0.99:
        return f"{100 * fraction:.3g} %"
    return f"{100 * fraction:.2f} %" if fraction < 0.99985 else "> 99.98 %"


def _variance_text(fraction: float) -> str:
    """Return a fraction in per cent, without the sign."""
    return CellText(percent(fraction).removesuffix(" %"), {"": 100 * fraction})


def _percent_number(value: float) -> str:
    return NumberText(100 * value, ".2f") if math.isfinite(value) else "-"


def _percent(value: float) -> str:
    return f"{_percent_number(value)} %" if math.isfinite(value) else "-"


def _power(value: float) -> str:
    return NumberText(value, ".1e") if math.isfinite(value) else "-"


HEIGHT_COLUMNS = (
    "CCDs",
    "number",
    "mean [um]",
    "rms [um]",
    "95 % [um]",
    "PV [um]",
    "CCD means [um]",
    "within a CCD [um]",
    "within, 95 % [um]",
    "tilt [um]",
    "shape [um]",
)
HEIGHT_CAPTION = (
    "Heights along +z of the detector. PV: peak to valley; 95 %: from the 2.5th to the 97.5th percentile, "
    "within a CCD the median over the CCDs. Rms of the CCDs' means, within CCDs, and of the best plane of each CCD "
    "(tilt) and about it (shape). Parts without metrology are left out."
)


def height_rows(statistics: dict[str, HeightStatistics]) -> list[tuple[str, ...]]:
    """Return a row for each group of CCDs, in the columns of :data:`HEIGHT_COLUMNS`."""

    def row(name: str, of: HeightStatistics) -> tuple[str, ...]:
        heights = (of.mean, of.rms, of.width95, of.peak_to_valley, of.ccd_mean_rms)
        within = (of.within_rms, of.within_width95, of.tilt_rms, of.shape_rms)
        return name, str(of.n_ccd), *(NumberText(value * 1e6, ".2f") for value in (*heights, *within))

    return [row(name, of) for name, of in statistics.items()]
