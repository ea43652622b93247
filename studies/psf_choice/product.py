"""Files of a study of PSF models: table, metrics, plots, configuration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...core.products import Columns
from ...measure.correlation import SEPARATION_RANGES
from ...pipeline.config import Configuration
from ...pipeline.run_folder import stamp_of
from ..product import write_products
from .plan import FOCAL_PLANE, POLYNOMIALS, Case
from .plots import choices_plot, stars_plot
from .study import Study, study_experiment


def write_study(result: Study, folder: Path, config: Configuration) -> tuple[str, ...]:
    """Write table, metrics, plots and configuration; return the names of the files."""
    stamp = stamp_of(study_experiment(config, result.plan))
    return write_products(
        folder,
        {"study.ecsv": ("PSF models against the truth", study_columns(result))},
        {"study_stars.png": stars_plot(result), "study_choices.png": choices_plot(result)},
        {"study.json": study_summary(result)},
        {**stamp.meta(), "draws": result.plan.draws},
        config,
        "the configuration that the study is about.",
    )


def study_summary(result: Study) -> dict[str, Any]:
    """Return the base, default and recommended case, those of the focal plane, and the best orders."""
    plan, best_case = result.plan, result.recommended()
    orders = {
        how: {str(n): best.order for n in plan.stars if (best := result.best_order(n, how))} for how in POLYNOMIALS
    }
    together = [best for how in FOCAL_PLANE if (best := result.best_order(plan.base.stars, how))]
    return {
        "base": _case_entry(result, plan.base),
        "default": _case_entry(result, plan.default),
        "recommended": None if best_case is None else _case_entry(result, best_case),
        **({"focal_plane": [_case_entry(result, case) for case in together]} if plan.focal_plane else {}),
        "best_order": orders,
        "fitted": len(result.metrics),
        "not_fitted": {f"{case.stars} stars {case.noise_text}, {case}": why for case, why in result.problems.items()},
    }


def _case_entry(result: Study, case: Case) -> dict[str, Any]:
    return {**vars(case), "figures": result.metrics.get(case)}


def study_columns(result: Study) -> Columns:
    """Return the columns of the table, a row for each case, those without a fit included."""
    cases = [*result.metrics, *result.problems]
    about = {
        "stars": "stars of a CCD",
        "snr": "S/N of the faintest star; infinite without noise",
        "basis": "description of the stars",
        "interpolation": "how positions enter",
        "order": "of the polynomials",
        "components": "of the basis; 0: all pixels",
    }
    columns = {key: (np.array([getattr(c, key) for c in cases]), "", description) for key, description in about.items()}
    for key in next(iter(result.metrics.values()), {}):
        values: list[Mapping[str, float]] = [result.metrics.get(case, {}) for case in cases]
        columns[key] = (np.array([v.get(key, np.nan) for v in values]), "", _metric_description(key))
    problems = np.array([result.problems.get(case, "") for case in cases])
    columns["problem"] = (problems, "", "why it could not be fitted")
    return columns


def _metric_description(key: str) -> str:
    if key.startswith("error_"):
        return "standard error over the CCDs: " + _metric_description(key.removeprefix("error_"))
    where = "observed - model, at the stars" if "at_stars" in key else "truth - model, where no star is"
    descriptions = {
        "rms_g": "rms of one component of g of adaptive moments",
        "rms_dt_g": "rms of dT/T of adaptive moments",
        "mean_g": "rms over CCDs of their mean of one component of g",
        "noise_law_g": "rms of one component of g that noise alone should leave",
        "rms_e": "rms of one component of the weighted e",
        "rms_size": "rms of the relative weighted size",
        "mean_e": "rms over CCDs of their mean of one component of the weighted e",
        "noise_law": "rms of one component of the weighted e that noise alone should leave",
        "lost": "places whose model has no shape",
    }
    if key.startswith("xi_plus"):
        low, high = SEPARATION_RANGES["long"]
        span = f"below {low:g}" if key.endswith("short") else f"{low:g} to {high:g}"
        ellipticity = "g" if key.startswith("xi_plus_g_") else "the weighted e"
        return f"xi+ of {ellipticity} {span} arcmin, {where}"
    return next(f"{words}, {where}" for start, words in descriptions.items() if key.startswith(start))
