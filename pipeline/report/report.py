"""The report of a run as one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...core.page import Picture, render
from ..config import ReconstructionConfig, to_yaml
from ..experiment import Experiment
from .tables import (
    MODELS_CAPTION,
    MODELS_COLUMNS,
    MOMENTS_NOTE,
    PER_CCD_CAPTION,
    PER_CCD_COLUMNS,
    headline,
    models_rows,
    per_ccd,
    verdict,
)

#: Templates of the reports of runs and sweeps.
TEMPLATES = Path(__file__).parent / "templates"
#: Title of the picture that opens the report of a run.
_OPENING = "Whiskers over the field"


def build_report(experiment: Experiment, summary: dict[str, Any], pictures: Sequence[Picture]) -> str:
    """Return the report of a run as HTML that refers to no other file."""
    return render(
        TEMPLATES,
        "report.html",
        config=experiment.config,
        telescope=experiment.telescope,
        summary=summary,
        verdict=verdict(summary),
        opening=_opening(pictures),
        headline=headline(summary),
        moments_note=MOMENTS_NOTE,
        caption=PER_CCD_CAPTION,
        columns=PER_CCD_COLUMNS,
        ccds=per_ccd(summary),
        models=models_rows(summary),
        models_caption=MODELS_CAPTION,
        models_columns=MODELS_COLUMNS,
        pictures=pictures,
        configuration=to_yaml(experiment.config),
        model=_model_words(experiment.config.reconstruction),
    )


def _opening(pictures: Sequence[Picture]) -> int:
    """Return the place of the picture that opens the report, from 1: that of the PSFs and of their model."""
    return next((i for i, picture in enumerate(pictures, 1) if picture.title == _OPENING), 1)


def _model_words(fit: ReconstructionConfig) -> str:
    """Return the PSF model in words."""
    recipe = fit.psf_recipe()
    basis = recipe.basis.words if fit.components is None else f"{fit.components} {recipe.basis.words}"
    weights = {"equal": "", "snr": ", weights (S/N)²", "softened": ", weights (S/N)², softened for bright stars"}
    shape_text = "; ellipticity and size from one model of the whole focal plane" if fit.model == "focal_plane" else ""
    return f"{basis}, {recipe.interpolation.words}polynomials of order {fit.order}{weights[recipe.weights]}{shape_text}"
