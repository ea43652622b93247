"""What a weak-lensing person asks of a finished run: residuals of ellipticity and size, correlations, rho statistics.

Residuals at the stars that a model was fitted to flatter it; what a galaxy sees is the residual where no star is. Each
is never without the other, nor without the residual of each star at the model fitted without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from ..models.errors import PachonError, ProductError
from .ccd_product import CcdProduct, ObservedStars, Stars, product_path, read_product
from .config import load_configuration
from .correlation import Correlation, shear_correlation
from .experiment import prepare
from .figures_diagnostics import residual_map, rho_figure
from .figures_statistics import correlation_figure
from .products import described_table, make_folder, write_bytes, write_ecsv, write_json
from .rho_statistics import RhoStatistics, rho_statistics, trace_of_moments
from .run_folder import CONFIG_NAME, stamp_of
from .shapes import measure_shapes
from .summary import LONG_RANGE, of_kind, separation_bins

#: What is correlated, in this order in tables and pictures.
CORRELATED = ("truth", "observed", "residual", "left_out", "away")
#: Residuals: at the stars, of stars left out, away from them.
RESIDUALS = ("residual", "left_out", "away")
#: Those of them whose size is known too.
SIZED = ("residual", "away")
#: The paper's claim of a residual below 1e-7 is for separations up to here [arcmin].
LONGEST = 180.0
FOLDER_NAME = "diagnostics"
_MEANINGS = {
    "residual": "observed - model, at the stars",
    "left_out": "observed - model fitted without the star",
    "away": "truth - model, where no star is",
}


@dataclass(frozen=True)
class Diagnostics:
    """Diagnostics of a run.

    Attributes
    ----------
    folder : Path
        Where the files are.
    files : tuple of str
        Their names.
    missing : tuple of str
        CCDs of the configuration that have no product yet.
    table : Table
        A row for each CCD: means and rms of the residuals.
    overall : dict
        The same over all CCDs, and figures of the correlations; keys end in their unit.
    correlations : dict of str to Correlation
        Of each of :data:`CORRELATED`. Errors by jackknife over the CCDs where there are two or more.
    rho : dict of str to RhoStatistics
        At the stars (``residual``), and where no star is (``away``).
    """

    folder: Path
    files: tuple[str, ...]
    missing: tuple[str, ...]
    table: Table
    overall: dict[str, Any]
    correlations: dict[str, Correlation]
    rho: dict[str, RhoStatistics]

    def as_dict(self) -> dict[str, Any]:
        """Return all figures as plain mappings and arrays."""
        return {
            "all": self.overall,
            "ccd": {row["ccd"]: {k: row[k] for k in self.table.colnames[1:]} for row in self.table},
            "correlation": {kind: correlation_dict(c) for kind, c in self.correlations.items()},
            "rho": {kind: {name: correlation_dict(c) for name, c in rho.items()} for kind, rho in self.rho.items()},
            "missing": list(self.missing),
            "files": list(self.files),
        }


def diagnose(folder: Path, out: Path | None = None) -> Diagnostics:
    """Read the products of a run, and write tables and pictures of the residuals.

    Parameters
    ----------
    folder : Path
        Folder of a run, finished or not.
    out : Path, optional
        Where to write; a folder ``diagnostics`` within the run's by default.

    Raises
    ------
    PachonError
        If this is no run, no CCD is finished, a product is damaged or of another configuration, or nothing can be
        written.
    """
    path = folder / CONFIG_NAME
    if not path.exists():
        raise ProductError(f"{folder}: expected the folder of a run, there is no {CONFIG_NAME} in it")
    config = load_configuration(path)
    try:
        experiment = prepare(config)
    except PachonError as error:
        raise ProductError(f"{path}: no configuration that pachon run wrote ({error})") from None
    stamp, names = stamp_of(experiment), config.ccds or ()
    missing = tuple(name for name in names if not product_path(folder, name).exists())
    if len(missing) == len(names):
        raise ProductError(f"{folder}: none of its {len(names)} CCDs is finished")
    products = [
        read_product(product_path(folder, name), stamp, truth_images=False) for name in names if name not in missing
    ]
    samples = [{kind: _sample(p, kind, experiment.weight_fwhm) for kind in RESIDUALS} for p in products]
    columns = _ccd_columns(products, samples)
    correlated = correlate(products)
    rho = {kind: _rho(products, samples, kind) for kind in SIZED}
    overall = _overall(products, samples, correlated)

    out = folder / FOLDER_NAME if out is None else out
    make_folder(out)
    meta = {"run": stamp.config_hash, "pachon": stamp.version, "seed": stamp.seed}
    write_ecsv(out / "ccds.ecsv", columns, {"what": "residuals of each CCD", **meta})
    write_ecsv(out / "correlations.ecsv", correlation_columns(correlated), {"what": "xi of ellipticities", **meta})
    everything = {f"{kind} {name}": c for kind, r in rho.items() for name, c in r.items()}
    write_ecsv(out / "rho.ecsv", correlation_columns(everything), {"what": "rho statistics 1 to 5", **meta})
    figures = {name: columns[name][0] for name in columns}
    write_bytes(out / "residuals.png", residual_map(experiment.camera, figures))
    write_bytes(out / "correlations.png", correlation_figure(correlated))
    write_bytes(out / "rho.png", rho_figure(rho))
    files = ("ccds.ecsv", "correlations.ecsv", "rho.ecsv", "residuals.png", "correlations.png", "rho.png")
    table = described_table(columns, meta)
    result = Diagnostics(out, (*files, "diagnostics.json"), missing, table, overall, correlated, rho)
    write_json(out / "diagnostics.json", {**meta, **result.as_dict()})
    return result


def correlate(products: Sequence[CcdProduct]) -> dict[str, Correlation]:
    """Correlate each of :data:`CORRELATED` over all CCDs, with errors by jackknife over them where there are two.

    The same bins as in the summary of a run.
    """
    bins = separation_bins(products)
    result = {}
    for kind in CORRELATED:
        parts = [of_kind(p, kind) for p in products]
        x, y, e1, e2 = (np.concatenate(c) for c in zip(*parts, strict=True))
        result[kind] = shear_correlation(x, y, e1, e2, patch=_patches([len(p[0]) for p in parts]), **bins)
    return result


@dataclass(frozen=True)
class _Sample:
    """Stars of one kind on one CCD with the model there, and what is left: T is Q11 + Q22 [rad^2]."""

    stars: Stars
    model_e1: np.ndarray
    model_e2: np.ndarray
    model_size: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        """Ellipticity less the model's, [2, n]."""
        return np.stack([self.stars.e1 - self.model_e1, self.stars.e2 - self.model_e2])

    @property
    def growth(self) -> np.ndarray:
        """(T - T of the model)/T, [n]."""
        trace = trace_of_moments(self.stars.size, self.stars.e1, self.stars.e2)
        result: np.ndarray = 1.0 - trace_of_moments(self.model_size, self.model_e1, self.model_e2) / trace
        return result


def _sample(product: CcdProduct, kind: str, weight_fwhm: float) -> _Sample:
    stars = product.truth if kind == "away" else product.observed
    if kind == "left_out":
        assert isinstance(stars, ObservedStars)
        return _Sample(stars, stars.left_out_e1, stars.left_out_e2, np.full(len(stars), np.nan))
    # A product keeps the ellipticity of the model and not its size, but it keeps the model without loss.
    images = product.model.at(np.stack([stars.x, stars.y], axis=1))
    return _Sample(stars, stars.model_e1, stars.model_e2, measure_shapes(images, product.pixel_scale, weight_fwhm).size)


def _patches(counts: Sequence[int]) -> np.ndarray | None:
    """Return the number of the CCD of each star; None where there is but one CCD."""
    return np.repeat(np.arange(len(counts)), counts) if len(counts) > 1 else None


def _rho(products: Sequence[CcdProduct], samples: Sequence[Mapping[str, _Sample]], kind: str) -> RhoStatistics:
    chosen = [s[kind] for s in samples]

    def of_stars(key: str) -> np.ndarray:
        return np.concatenate([getattr(s.stars, key) for s in chosen])

    def of_model(key: str) -> np.ndarray:
        return np.concatenate([getattr(s, key) for s in chosen])

    return rho_statistics(
        *(of_stars(key) for key in ("field_x", "field_y", "e1", "e2", "size")),
        *(of_model(key) for key in ("model_e1", "model_e2", "model_size")),
        patch=_patches([len(s.stars) for s in chosen]),
        **separation_bins(products),
    )


def _moments(samples: Sequence[_Sample], kind: str) -> dict[str, float]:
    """Return means and rms of the residuals of some CCDs together."""
    e = np.concatenate([s.residual for s in samples], axis=1)
    figures = {
        f"mean_e1_{kind}": _mean(e[0]),
        f"mean_e2_{kind}": _mean(e[1]),
        f"rms_e_{kind}": float(np.sqrt(_mean(e**2))),
    }
    if kind in SIZED:
        growth = np.concatenate([s.growth for s in samples])
        figures |= {f"mean_dt_{kind}": _mean(growth), f"rms_dt_{kind}": float(np.sqrt(_mean(growth**2)))}
    return figures


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else np.nan


def _ccd_columns(
    products: Sequence[CcdProduct], samples: Sequence[Mapping[str, _Sample]]
) -> dict[str, tuple[np.ndarray, str, str]]:
    columns: dict[str, tuple[np.ndarray, str, str]] = {
        "ccd": (np.array([p.name for p in products]), "", "name of the CCD"),
        "x_mm": (np.array([round(p.center[0] * 1e3, 6) for p in products]), "mm", "centre on the detector"),
        "y_mm": (np.array([round(p.center[1] * 1e3, 6) for p in products]), "mm", "centre on the detector"),
        "stars": (np.array([len(p.observed) for p in products]), "", "observed stars"),
        "stars_used": (np.array([int(p.observed.used.sum()) for p in products]), "", "stars in the fit"),
        "truth_psfs": (np.array([len(p.truth) for p in products]), "", "places where the PSF is known"),
    }
    for kind in RESIDUALS:
        rows = [_moments([s[kind]], kind) for s in samples]
        for key in rows[0]:
            what = {"mean": "mean", "rms_": "rms"}[key[:4]]
            of = "(T - T model)/T" if "_dt_" in key else "e1" if "_e1_" in key else "e2" if "_e2_" in key else "e1, e2"
            values = np.array([row[key] for row in rows])
            columns[key] = (values, "", f"{what} of {of}: {_MEANINGS[kind]}")
    return columns


def _overall(
    products: Sequence[CcdProduct],
    samples: Sequence[Mapping[str, _Sample]],
    correlated: Mapping[str, Correlation],
) -> dict[str, Any]:
    figures: dict[str, Any] = {
        "ccds": len(products),
        "stars": sum(len(p.observed) for p in products),
        "truth_psfs": sum(len(p.truth) for p in products),
    }
    for kind in RESIDUALS:
        figures |= _moments([s[kind] for s in samples], kind)
    for kind, correlation in correlated.items():
        r = correlation.r_arcmin
        inside = np.flatnonzero((r >= LONG_RANGE) & (r <= LONGEST) & (correlation.n_pairs > 0))
        largest = inside[np.argmax(np.abs(correlation.xi_plus[inside]))] if len(inside) else None
        for key, values in (("r_arcmin", r), ("xi_plus", correlation.xi_plus), ("error_plus", correlation.error_plus)):
            figures[f"largest_{kind}_{key}"] = np.nan if largest is None else float(values[largest])
    return figures


def correlation_columns(correlated: Mapping[str, Correlation]) -> dict[str, tuple[np.ndarray, str, str]]:
    """Return correlations as the columns of one table, one after the other, by the name of each."""
    each = [correlation_dict(c) for c in correlated.values()]

    def together(key: str) -> np.ndarray:
        return np.concatenate([c[key] for c in each])

    kinds = np.repeat(list(correlated), [len(c["r_arcmin"]) for c in each])
    by = "jackknife over the CCDs" if next(iter(correlated.values())).n_patches else "scatter of the ellipticities"
    return {
        "kind": (kinds, "", "what is correlated"),
        "r_arcmin": (together("r_arcmin"), "arcmin", "mean separation"),
        "xi_plus": (together("xi_plus"), "", "mean of Re(e e'*)"),
        "error_plus": (together("error_plus"), "", f"standard error by {by}"),
        "xi_minus": (together("xi_minus"), "", "mean of Re(e e' exp(-4 i phi))"),
        "error_minus": (together("error_minus"), "", f"standard error by {by}"),
        "pairs": (together("pairs"), "", "pairs of stars"),
    }


def correlation_dict(correlation: Correlation) -> dict[str, np.ndarray]:
    """Return what is written of a correlation."""
    return {
        "r_arcmin": correlation.r_arcmin,
        "xi_plus": correlation.xi_plus,
        "xi_minus": correlation.xi_minus,
        "error_plus": correlation.error_plus,
        "error_minus": correlation.error_minus,
        "pairs": correlation.n_pairs,
    }
