"""Diagnostics of a finished run: residuals of ellipticity and size, correlations, rho statistics.

Residuals at the fitted stars underestimate the error of a model for galaxies, which is that of holdout positions. Both
are always given, and the leave-one-out residuals of the stars.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from ...core.errors import PachonError, ProductError
from ...core.files import make_folder, write_bytes, write_json
from ...core.number_text import counted
from ...core.products import Stamp, described_table, write_ecsv
from ...measure.correlation import Correlation
from ...measure.correlation_plots import correlation_columns, rho_plot
from ...measure.rho_statistics import RhoStatistics, rho_statistics
from ...reconstruction.ccd_product import CCD_KINDS, KINDS, MOMENTS, CcdProduct, product_path, read_product
from ..config import load_configuration
from ..experiment import Experiment
from ..run_folder import CONFIG_NAME, SUMMARY_NAME, stamp_of
from ..summary import (
    correlations,
    ellipticities,
    finite_mean,
    has_focal_plane_model,
    patches,
    rms,
    scatter,
    separation_bins,
    size_residuals,
    size_scatter,
)
from .focal_plane_plots import residual_plot
from .statistics_plots import correlation_plot

#: Residuals: at the stars, leave-one-out, and at holdout positions.
RESIDUALS = ("residual", "left_out", "away")
#: Residuals for which weighted sizes are available too; adaptive ones are for all.
SIZED = ("residual", "away", *CCD_KINDS)
FOLDER_NAME = "diagnostics"
_MEANINGS = {
    "residual": "observed - model, at the stars",
    "left_out": "observed - model fitted without the star",
    "away": "noise-free - model, at holdout positions",
    "residual_ccd": "observed - the CCD's own model, at the stars",
    "away_ccd": "noise-free - the CCD's own model, at holdout positions",
}
#: Residuals of which there are rho statistics.
_RHO_KINDS: tuple[str, ...] = ("residual", "away")
_QUANTITIES = {
    "e1": "e1",
    "e2": "e2",
    "e": "e1, e2",
    "dt": "(T - T model)/T",
    "g1": "g1",
    "g2": "g2",
    "g": "g1, g2",
    "dt_g": "(T - T model)/T of adaptive moments",
}


@dataclass(frozen=True)
class Diagnostics:
    """Diagnostics of a run."""

    folder: Path
    files: tuple[str, ...]  #: names of the files in the folder
    missing: dict[str, str]  #: reason by CCD without a readable product
    table: Table  #: means and rms of the residuals, a row for each CCD
    overall: dict[str, float]  #: the same over all CCDs, and metrics of the correlations; keys end in their unit
    #: Of each of :data:`~.KINDS`, with errors by jackknife over the CCDs where there are five or more; with a
    #: focal-plane model also of :data:`~.CCD_KINDS`, as in the table.
    correlations: dict[str, Correlation]
    rho: dict[str, RhoStatistics]  #: at the stars (``residual``), and at holdout positions (``away``)
    #: Of g of the adaptive moments, as DES, HSC and Rubin define it; `correlations` and `rho` are of the weighted e.
    correlations_g: dict[str, Correlation]
    rho_g: dict[str, RhoStatistics]  #: of g and T of the adaptive moments, as Jarvis et al. (2016)

    def as_dict(self) -> dict[str, Any]:
        """Return all metrics as plain mappings and arrays."""
        return {
            "all": self.overall,
            "ccd": {row["ccd"]: {k: row[k] for k in self.table.colnames[1:]} for row in self.table},
            "correlation": {kind: c.as_dict() for kind, c in self.correlations.items()},
            "correlation_g": {kind: c.as_dict() for kind, c in self.correlations_g.items()},
            "rho": {kind: {name: c.as_dict() for name, c in rho.items()} for kind, rho in self.rho.items()},
            "rho_g": {kind: {name: c.as_dict() for name, c in rho.items()} for kind, rho in self.rho_g.items()},
            "missing": self.missing,
            "files": list(self.files),
        }


def diagnose(folder: Path, out: Path | None = None, *, strict: bool = False) -> Diagnostics:
    """Read the products of a run, finished or not, and write tables and pictures of the residuals.

    Raises
    ------
    PachonError
        If this is no run, no CCD is finished, the products are of another configuration, or nothing can be written;
        with `strict`, if a single product is missing or damaged, which is otherwise reported.
    """
    path = folder / CONFIG_NAME
    if not path.exists():
        raise ProductError(f"expected the folder of a run, there is no {CONFIG_NAME} in it", file=folder)
    config = load_configuration(path)
    try:
        experiment = Experiment.from_config(config)
    except PachonError as error:
        raise ProductError(f"no configuration that pachon run wrote ({error})", file=path) from None
    if experiment.config != config:
        raise ProductError("no configuration that pachon run wrote (defaults are not filled in)", file=path)
    stamp, names = stamp_of(experiment), config.ccds or ()
    if not any(product_path(folder, name).exists() for name in names):
        raise ProductError(f"none of its {counted(len(names), 'CCD')} is finished", file=folder)
    products, unreadable_ccds = [], {}
    for name in names:
        try:
            products.append(_read_product_or_reason(folder, name, stamp, config.reconstruction.model))
        except ProductError as error:
            unreadable_ccds[name] = str(error)
            # Damage happens to single files; a folder without any that can be read has another reason.
            if strict or len(unreadable_ccds) == len(names):
                raise
    residuals = RESIDUALS + CCD_KINDS if has_focal_plane_model(products) else RESIDUALS
    columns = _ccd_columns(products, residuals)
    correlated, correlated_g = (correlations(products, products[0].kinds, moments) for moments in MOMENTS)
    rho, rho_g = (
        {kind: _rho_statistics(products, kind, moments) for kind in _RHO_KINDS if kind in of_moments}
        for moments, of_moments in zip(MOMENTS, (correlated, correlated_g), strict=True)
    )
    overall = _overall_metrics(products, residuals, correlated, correlated_g)

    out = folder / FOLDER_NAME if out is None else out
    make_folder(out)
    meta = {"run": stamp.config_hash, "pachon": stamp.version, "seed": stamp.seed}
    tables = {
        "ccds.ecsv": ("residuals of each CCD", columns),
        "correlations.ecsv": ("xi of the weighted e", correlation_columns(correlated)),
        "rho.ecsv": ("rho statistics 1 to 5 of the weighted e and T", correlation_columns(_by_name(rho))),
    }
    is_lsst = experiment.camera.name == "lsst"
    pictures = {
        "residuals.png": residual_plot(experiment.camera, {name: values for name, (values, _, _) in columns.items()}),
        "correlations.png": correlation_plot({kind: correlated[kind] for kind in KINDS}, is_lsst),
        "rho.png": rho_plot(rho),
    }
    if correlated_g:
        tables["correlations_g.ecsv"] = "xi of g of adaptive moments", correlation_columns(correlated_g)
        pictures["correlations_g.png"] = correlation_plot(
            {kind: correlated_g[kind] for kind in KINDS if kind in correlated_g}, False, "g, adaptive moments"
        )
    if rho_g:
        tables["rho_g.ecsv"] = "rho statistics 1 to 5 of g and T", correlation_columns(_by_name(rho_g))
        pictures["rho_g.png"] = rho_plot(rho_g)
    for name, (description, content) in tables.items():
        write_ecsv(out / name, content, {"what": description, **meta})
    for name, png in pictures.items():
        write_bytes(out / name, png)
    files = (*tables, *pictures, "diagnostics.json")
    result = Diagnostics(
        out, files, unreadable_ccds, described_table(columns, meta), overall, correlated, rho, correlated_g, rho_g
    )
    write_json(out / "diagnostics.json", {**meta, **result.as_dict()})
    return result


def _read_product_or_reason(folder: Path, name: str, stamp: Stamp, model: str) -> CcdProduct:
    """Return the product of a CCD, or raise the reason for its absence from the summary of the run."""
    path = product_path(folder, name)
    if path.exists():
        product = read_product(path, stamp, holdout_images=False)
        if model == "focal_plane" and not product.has_focal_plane_model:
            raise ProductError(f"CCD {name}: has no focal-plane model yet, which pachon run --resume adds")
        return product
    reason = "has no product yet"
    with suppress(OSError, ValueError, KeyError):
        reason = json.loads((folder / SUMMARY_NAME).read_text())["not_modelled"][name]
    raise ProductError(f"CCD {name}: {reason}")


def _by_name(rho: Mapping[str, RhoStatistics]) -> dict[str, Correlation]:
    return {f"{kind} {name}": c for kind, statistics in rho.items() for name, c in statistics.items()}


def _rho_statistics(products: Sequence[CcdProduct], kind: str, moments: str) -> RhoStatistics:
    stars = [p.stars(kind) for p in products]
    x, y = np.concatenate([p.sky_positions(kind) for p in products], axis=1)
    shape = ("g1", "g2", "sigma") if moments == "g" else ("e1", "e2", "size")
    keys = (*shape, *(f"model_{key}" for key in shape))
    columns = (np.concatenate([getattr(s, key) for s in stars]) for key in keys)
    return rho_statistics(x, y, *columns, bins=separation_bins(products), patch=patches(stars))


def _residual_moments(products: Sequence[CcdProduct], kind: str) -> dict[str, float]:
    """Return means and rms of the residuals of some CCDs together."""
    e = ellipticities(products, kind)
    metrics = {f"mean_e1_{kind}": finite_mean(e[0]), f"mean_e2_{kind}": finite_mean(e[1]), f"rms_e_{kind}": rms(e)}
    if kind in SIZED:
        growth = size_residuals(products, kind)
        metrics |= {f"mean_dt_{kind}": finite_mean(growth), f"rms_dt_{kind}": rms(growth)}
    g, growth = ellipticities(products, kind, "g"), size_residuals(products, kind, "g")
    metrics |= {f"mean_g1_{kind}": finite_mean(g[0]), f"mean_g2_{kind}": finite_mean(g[1]), f"rms_g_{kind}": rms(g)}
    return metrics | {f"mean_dt_g_{kind}": finite_mean(growth), f"rms_dt_g_{kind}": rms(growth)}


def _ccd_columns(products: Sequence[CcdProduct], residuals: Sequence[str]) -> dict[str, tuple[np.ndarray, str, str]]:
    columns: dict[str, tuple[np.ndarray, str, str]] = {
        "ccd": (np.array([p.name for p in products]), "", "name of the CCD"),
        "x_mm": (np.array([round(p.center[0] * 1e3, 6) for p in products]), "mm", "centre on the detector"),
        "y_mm": (np.array([round(p.center[1] * 1e3, 6) for p in products]), "mm", "centre on the detector"),
        "stars": (np.array([len(p.observed) for p in products]), "", "observed stars"),
        "stars_used": (np.array([int(p.observed.used.sum()) for p in products]), "", "stars in the fit"),
        "truth_psfs": (np.array([len(p.holdout) for p in products]), "", "places where the PSF is known"),
    }
    for moments in MOMENTS:
        values = np.array([scatter([p], moments) for p in products])
        columns[f"rms_scatter_{moments}"] = (values, "", f"rms of {moments} of noise-free PSFs about the CCD's mean")
    values = np.array([size_scatter([p]) for p in products])
    columns["rms_scatter_dt_g"] = (values, "", "rms of T/mean - 1 of noise-free PSFs, T of adaptive moments")
    for kind in residuals:
        rows = [_residual_moments([p], kind) for p in products]
        for key in rows[0]:
            statistic, _, quantity = key.removesuffix(f"_{kind}").partition("_")
            values = np.array([row[key] for row in rows])
            columns[key] = (values, "", f"{statistic} of {_QUANTITIES[quantity]}: {_MEANINGS[kind]}")
    return columns


def _overall_metrics(
    products: Sequence[CcdProduct],
    residuals: Sequence[str],
    correlated: Mapping[str, Correlation],
    correlated_g: Mapping[str, Correlation],
) -> dict[str, float]:
    metrics: dict[str, float] = {
        "ccds": len(products),
        "stars": sum(len(p.observed) for p in products),
        "truth_psfs": sum(len(p.holdout) for p in products),
    }
    metrics |= {f"rms_scatter_{moments}": scatter(products, moments) for moments in MOMENTS}
    metrics["rms_scatter_dt_g"] = size_scatter(products)
    for kind in residuals:
        metrics |= _residual_moments(products, kind)
    for kind, correlation in [*correlated.items(), *((f"g_{kind}", c) for kind, c in correlated_g.items())]:
        r = correlation.r_arcmin
        inside = np.flatnonzero(correlation.within("long") & (correlation.n_pairs > 0))
        largest = inside[np.argmax(np.abs(correlation.xi_plus[inside]))] if len(inside) else None
        error = correlation.error_plus if correlation.n_patches else np.full_like(r, np.nan)
        for key, values in (("r_arcmin", r), ("xi_plus", correlation.xi_plus), ("error_plus", error)):
            metrics[f"largest_{kind}_{key}"] = np.nan if largest is None else float(values[largest])
    return metrics
