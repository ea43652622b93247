"""Page of a night: one HTML file with maps of the sky, correlations, and the metrics of each band."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...core.number_text import counted
from ...core.page import Picture, render, with_error
from ...core.version import VERSION
from ...sky.visit_list.visit_list import VisitList
from .maps import NightMaps
from .plots import correlations_plot, maps_plot
from .residual_correlation import MeanCorrelation

REPORT_NAME = "report.html"
#: Visits that are named as left out.
_SHOWN = 50


def night_page(
    summary: Mapping[str, Any],
    visits: VisitList,
    columns: Mapping[str, np.ndarray],
    maps: NightMaps | None,
    means: Mapping[str, Mapping[str, MeanCorrelation]],
) -> str:
    """Return the page of a night by its summary, the table of visits and detectors, maps and correlations."""
    pictures = []
    if means:
        shows = (
            "xi+ of g = (a - b)/(a + b) of adaptive moments at places of the same visit, mean over visits, with the "
            "standard error from visit to visit. Filled symbols are positive, open ones negative."
        )
        pictures.append(
            Picture("Correlation of the PSF, and of what the models leave", correlations_plot(means), shows)
        )
    if maps is not None and maps.bands:
        of_list = bool(np.isfinite(visits.weight).any())
        weights = "weights of the list" if of_list else "inverse variance of a pixel of the sky"
        shows = f"Means over visits, weighted by the {weights}. North is up, east left."
        pictures.insert(0, Picture("What the night has seen", maps_plot(maps), shows))
    return render(
        Path(__file__).parent / "templates",
        "night.html",
        summary=summary,
        source=Path(str(visits.source)).name,
        verdict=verdict(summary),
        pictures=pictures,
        bands=[_band_row(band, metrics, columns) for band, metrics in summary["bands"].items()],
        left_out=list(summary["left_out"].items())[:_SHOWN],
        unnamed=max(0, len(summary["left_out"]) - _SHOWN),
        pachon=VERSION,
    )


def verdict(summary: Mapping[str, Any]) -> str:
    """Return the result of a night in one sentence."""
    seen = summary["finished"] - len(summary["left_out"])
    count = f"{seen} of {counted(summary['visits'], 'visit has', 'visits have')} a PSF"
    bands = summary["bands"]
    if not bands:
        return f"{count}."
    limits = {band: bands[band].get("median_magLim", math.nan) for band in bands}
    depths = ", ".join(f"{band} {limit:.2f}" if math.isfinite(limit) else band for band, limit in limits.items())
    text = f"{count}; median limiting magnitudes (S/N 5): {depths}"
    best = min(bands, key=lambda band: bands[band].get("error_xi_plus_g_away_short", math.inf))
    value, error = (bands[best].get(f"{key}xi_plus_g_away_short", math.nan) for key in ("", "error_"))
    if math.isnan(value):
        return f"{text}."
    left = with_error(value, error) if math.isfinite(error) else f"{value:.2g}"
    return f"{text}; in {best} the models of single visits leave xi+ = {left} in g within 10', where no star is."


def _band_row(band: str, metrics: Mapping[str, float], columns: Mapping[str, np.ndarray]) -> list[str]:
    """Return the cells of a band."""
    of_band = columns["band"] == band
    arcsec = np.median((columns["psfSigma"] * columns["pixelScale"])[of_band])
    ranges = []
    for name in ("short", "long"):
        key = f"xi_plus_g_away_{name}"
        value, error = metrics.get(key, math.nan), metrics.get(f"error_{key}", math.nan)
        ranges.append("-" if math.isnan(value) else with_error(value, error))
    left = [metrics.get(f"rms_modelDelta{name}", math.nan) for name in ("E1", "E2")]
    return [
        band,
        f"{len(np.unique(columns['visitId'][of_band]))}",
        f"{metrics['detectors']:.0f}",
        f"{arcsec:.3f}",
        f"{metrics['median_magLim']:.2f}",
        f"{metrics['median_effTime']:.1f}",
        *("-" if math.isnan(value) else f"{value:.1e}" for value in left),
        *ranges,
    ]
