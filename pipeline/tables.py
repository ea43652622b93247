"""The figures of a run as tables that people read, on the terminal and in the report, in an astronomer's units."""

from __future__ import annotations

import math
from typing import Any

from .summary import KINDS, LONG_RANGE

_NAMES = {
    "truth": "truth",
    "observed": "observed",
    "residual": "observed - model, at the stars",
    "away": "truth - model, where no star is",
}


def headline(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the figures of a run: what, and its value with unit."""
    figures = summary["all"]
    rows = [
        ("CCDs", f"{figures['ccds']}"),
        ("PSFs known without noise", f"{figures['truth_psfs']}"),
        ("observed stars, used in the fit", f"{figures['stars']}, {figures['stars_used']}"),
        (
            "FWHM, median and range",
            f'{_figure(figures["fwhm_arcsec"])}", '
            f'{_figure(figures["fwhm_min_arcsec"])} to {_figure(figures["fwhm_max_arcsec"])}"',
        ),
        ("mean |e|, truth", _percent(figures["mean_e_truth"])),
        ("mean |e|, observed stars", _percent(figures["mean_e_observed"])),
        ("rms e residual, at the stars", _percent(figures["rms_residual_at_stars"])),
        ("rms e residual, each star left out in turn", _percent(figures["rms_residual_left_out"])),
        ("rms e residual, where no star is (no noise)", _percent(figures["rms_residual_away"])),
        ("truth's variance in the components, worst CCD", percent(figures["truth_variance_in_components"])),
    ]
    for kind in KINDS:
        short, far = (figures[f"xi_plus_{kind}_{name}"] for name in ("short", "long"))
        rows.append((f"ξ+ of {_NAMES[kind]}, below / beyond {LONG_RANGE:g}'", f"{_power(short)} / {_power(far)}"))
    return rows


PER_CCD_COLUMNS = (
    ("CCD", ""),
    ("field", "deg"),
    ("FWHM", "arcsec"),
    ("truth |e|", "%"),
    ("at stars", "%"),
    ("left out", "%"),
    ("no star", "%"),
    ("variance", "%"),
    ("kink", ""),
    ("stars used", ""),
)
PER_CCD_CAPTION = (
    "Mean |e| of the truth, and rms of one component of the residual: observed - model at the stars; the same with "
    "each star left out of the polynomial fit in turn; truth - model where no star is, which holds no noise of a star. "
    "Variance: part of the truth's variance that the components hold. Kink: components before the eigenvalues flatten, "
    "of the observed stars and of the truth."
)


def per_ccd(summary: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return a row for each CCD, in the columns of :data:`PER_CCD_COLUMNS`."""
    return [
        (
            name,
            f"{f['field_deg']:.2f}",
            _figure(f["fwhm_arcsec"]),
            _bare_percent(f["mean_e_truth"]),
            _bare_percent(f["rms_residual_at_stars"]),
            _bare_percent(f["rms_residual_left_out"]),
            _bare_percent(f["rms_residual_away"]),
            percent(f["truth_variance_in_components"]).removesuffix(" %"),
            f"{f['kink_observed']}, {f['kink_truth']}",
            f"{f['stars_used']} of {f['stars']}",
        )
        for name, f in summary["ccd"].items()
    ]


def percent(fraction: float) -> str:
    """Return a fraction in per cent, with more digits near all, and never rounded up to all."""
    if fraction < 0.99:
        return f"{100 * fraction:.3g} %"
    return f"{100 * fraction:.2f} %" if fraction < 0.99985 else "> 99.98 %"


def _figure(value: float) -> str:
    return f"{value:.3f}"


def _bare_percent(value: float) -> str:
    return f"{100 * value:.2f}"


def _percent(value: float) -> str:
    return f"{_bare_percent(value)} %"


def _power(value: float) -> str:
    return f"{value:.1e}" if math.isfinite(value) else "-"
