"""What each cause does to the PSF: the same stars once with everything, and once more with each cause switched off.

Random numbers are common: heights, turbulence, wind, positions of the stars and the order in which their magnitudes
are drawn stay what they were when another cause goes, so that a difference is the doing of that cause. Two things
follow the PSF, as they do at a telescope: the faintest star is the one of the wanted signal-to-noise ratio, and photons
are counted in other numbers.

The same beam without aberrations is no telescope that can be traced over the CCD heights. With the optics off, stars
are therefore seen from the same places on the sky through a paraboloid so long that nothing the telescope does is left:
neither its design, nor the heights, nor what active optics leaves. The design's own share is what the heights' case has
more than that of the optics.

The layer on the ground does most of the turbulence, and at exactly 0 m all stars of the field see the same part of it
at the same moment: they share its ellipticity. Its case lifts it, with the same turbulence, so far that stars share it
no more than they do the next layer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import ConfigError, unknown_name
from ...core.files import write_bytes, write_json
from ...core.products import write_ecsv
from ...core.progress import Reporter
from ...models.io.site_file import load_site
from ...pipeline.ccd_product import KINDS, CcdProduct
from ...pipeline.config import Configuration, to_yaml, with_options
from ...pipeline.experiment import Experiment
from ...pipeline.measure.correlation import SEPARATION_RANGES, Correlation, jackknife_error
from ...pipeline.measure.diagnostics import correlation_columns
from ...pipeline.measure.summary import (
    correlations,
    run_figures,
)
from ...pipeline.memory import check_memory
from ...pipeline.run_folder import CONFIG_NAME, stamp_of
from ...pipeline.simulate.ccd_exposure import CcdExposure
from ...pipeline.simulate.ccd_loop import simulate_ccds
from ...pipeline.simulate.ccd_model import model_ccd
from .plots import attribution_figure

FULL, NOISE, OPTICS = "full", "noise", "optics"
#: Height that the layer on the ground is lifted to [m]: about that of the next one over Cerro Pachon.
GROUND_LIFT = 2500.0
_SWITCHES: dict[str, dict[str, Any]] = {
    "global": {"focal_plane__global": False},
    "raft": {"focal_plane__raft": False},
    "ccd": {"focal_plane__ccd": False},
    "tilt": {"focal_plane__tilt": False},
    "potato_chip": {"focal_plane__potato_chip": False},
    "heights": {"focal_plane__budget": "flat"},
    "active_optics": {"active_optics__residual_um": 0.0},
    OPTICS: {},
    "atmosphere": {"atmosphere__enabled": False},
    "ground_layer": {"atmosphere__ground_lift_m": GROUND_LIFT},
    "diffusion": {"psf__diffusion_pixels": 0.0},
    NOISE: {},
}
#: All causes: five terms of the heights and these together, residual aberration, all that the telescope does,
#: turbulence with refraction, that all stars share the layer on the ground, charge diffusion, and the noise of the
#: observed stars.
CAUSES = tuple(_SWITCHES)
_RMS = ("rms_e_truth", "rms_residual_at_stars", "rms_residual_left_out", "rms_residual_away", "fwhm_arcsec")
_XI = ("truth", "observed", "residual", "away")


@dataclass(frozen=True)
class Attribution:
    """What came out with everything, and without each cause.

    Attributes
    ----------
    figures : dict of str to dict
        For ``full`` and for each cause that was off: rms of e and of its residuals, median FWHM, and the mean xi+ of
        noise-free PSFs, observed stars, residual at the stars and away from them, over the short and the long
        separations; ``change_`` and a key is the effect of the cause, the full case less this one, and ``error_`` and a
        key of xi+ its jackknife error over the CCDs.
    correlations : dict of str to dict of str to Correlation
        Of each case.
    """

    figures: dict[str, dict[str, float]]
    correlations: dict[str, dict[str, Correlation]]


def causes_of(config: Configuration) -> tuple[str, ...]:
    """Return the causes that are on in a resolved configuration, and can be switched off with its engine."""
    return tuple(cause for cause in CAUSES if _why_not(config, cause) is None)


def checked_causes(config: Configuration, causes: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return causes each once, or all of :func:`causes_of` where none are given.

    Raises
    ------
    UnknownNameError
        If there is no such cause.
    ConfigError
        If one is off in the configuration already, or cannot be switched off with its engine.
    """
    if causes is None:
        return causes_of(config)
    for cause in causes:
        if cause not in _SWITCHES:
            raise unknown_name("cause", cause, CAUSES)
        problem = _why_not(config, cause)
        if problem is not None:
            raise ConfigError(f"{cause} cannot be switched off: {problem}")
    return tuple(dict.fromkeys(causes))


def attribute(
    config: Configuration,
    causes: Sequence[str] | None = None,
    *,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> Attribution:
    """Make the same stars with everything and without each cause, model them, and compare.

    The engine ``long_exposure`` in the configuration averages over all turbulence: quick, and what is left is the
    doing of optics and heights; the atmosphere is then no cause of ellipticity and cannot be switched off.

    Parameters
    ----------
    config : Configuration
        Resolved configuration.
    causes : sequence of str, optional
        Of :data:`CAUSES`; all of :func:`causes_of` by default.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    reporter : Reporter, optional
        Who tells how far it is; nobody by default.

    Raises
    ------
    UnknownNameError, ConfigError
        If a cause is none, see :func:`checked_causes`.
    PachonError
        If a case cannot be computed.
    """
    reporter = Reporter(quiet=True) if reporter is None else reporter
    chosen = checked_causes(config, causes)
    full = Experiment.from_config(config)
    check_memory(full, threads)
    correlated, figures = {}, {}
    cases = [FULL, *(c for c in chosen if c != NOISE)]
    with full.screens(threads, reporter):
        for case in cases:
            experiment = full if case == FULL else _without(full, case)
            products, noiseless = _products(experiment, case, NOISE in chosen and case == FULL, threads, reporter)
            for name, found in ((case, products), (NOISE, noiseless)):
                if found:
                    correlated[name] = correlations(found, KINDS)
                    figures[name] = _figures(found, correlated[name])
    order = (FULL, *chosen)
    for name in chosen:
        figures[name] |= _changes(figures[FULL], figures[name], correlated[FULL], correlated[name])
    return Attribution({n: figures[n] for n in order}, {n: correlated[n] for n in order})


def write_attribution(result: Attribution, folder: Path, config: Configuration) -> tuple[str, ...]:
    """Write the figures, the correlations, a picture and the configuration, and return the names of the files.

    Parameters
    ----------
    result : Attribution
        What to write.
    folder : Path
        Where; it exists.
    config : Configuration
        Resolved configuration of the full case.

    Raises
    ------
    ProductError
        If it cannot be written.
    """
    stamp = stamp_of(Experiment.from_config(config))
    meta = {"pachon": stamp.version, "config_hash": stamp.config_hash, "seed": stamp.seed}
    cases = list(result.figures)
    keys = list(dict.fromkeys(key for figures in result.figures.values() for key in figures))
    columns = {"off": (np.array(cases), "", "cause that is switched off, or full")}
    for key in keys:
        values = np.array([result.figures[case].get(key, np.nan) for case in cases])
        columns[key] = (values, "arcsec" if key.endswith("arcsec") else "", _meaning(key))
    everything = {f"{case} {kind}": c for case, each in result.correlations.items() for kind, c in each.items()}
    write_ecsv(folder / "attribution.ecsv", columns, {"what": "the same stars without one cause", **meta})
    write_ecsv(folder / "correlations.ecsv", correlation_columns(everything), {"what": "xi of each case", **meta})
    write_bytes(folder / "attribution.png", attribution_figure(result.figures, result.correlations))
    write_json(folder / "attribution.json", {"figures": result.figures, **meta})
    heading = (f"pachon {stamp.version}: the case with everything on.",)
    write_bytes(folder / CONFIG_NAME, to_yaml(config, heading).encode())
    return "attribution.ecsv", "correlations.ecsv", "attribution.png", "attribution.json", CONFIG_NAME


def _why_not(config: Configuration, cause: str) -> str | None:
    """Return why a cause cannot be switched off, or None."""
    plane = config.focal_plane
    if cause in ("global", "raft", "ccd", "tilt", "potato_chip", "heights") and plane.budget == "flat":
        return "focal_plane.budget = flat"
    if cause == "heights" and not plane.terms:
        return "all terms of focal_plane are off already"
    if cause in ("global", "raft", "ccd", "tilt", "potato_chip") and cause not in plane.terms:
        return f"focal_plane.{cause} = false"
    if cause == "active_optics" and config.active_optics.residual_um == 0.0:
        return "active_optics.residual_um = 0"
    if cause == "atmosphere" and not config.atmosphere.enabled:
        return "atmosphere.enabled = false"
    if cause == "atmosphere" and config.psf.engine == "long_exposure":
        return "psf.engine = long_exposure, which needs it"
    if cause == OPTICS and not config.atmosphere.enabled:
        return "atmosphere.enabled = false, nothing would be left"
    if cause == "ground_layer":
        if not config.atmosphere.enabled or config.psf.engine == "long_exposure":
            return "no star sees turbulence"
        if config.atmosphere.ground_lift_m > 0.0 or load_site(config.atmosphere.site).altitudes[0] > 0.0:
            return "no layer is on the ground"
    if cause == "diffusion" and config.psf.diffusion_pixels == 0.0:
        return "psf.diffusion_pixels = 0"
    return None


def _without(full: Experiment, cause: str) -> Experiment:
    """Return the experiment with one cause off. All that a default filled in stays: pixels, stamps, weight."""
    experiment = Experiment.from_config(with_options(full.config, **_SWITCHES[cause]))
    if full.atmosphere is not None and experiment.atmosphere is not None:
        # Screens are the same and take their time.
        experiment = replace(experiment, atmosphere=full.atmosphere.at_altitudes(experiment.atmosphere.altitudes))
    return replace(experiment, atmosphere_only=cause == OPTICS)


def _products(
    experiment: Experiment, case: str, noiseless: bool, threads: int | None, reporter: Reporter
) -> tuple[list[CcdProduct], list[CcdProduct]]:
    """Return the products of all CCDs, and those of the same stars without noise where wanted."""
    noisy_or_not = (True, False) if noiseless else (True,)

    def model(exposure: CcdExposure) -> list[CcdProduct]:
        return [_without_images(model_ccd(experiment, exposure, noisy=noisy)) for noisy in noisy_or_not]

    title = "everything on" if case == FULL else f"{case} off"
    models = simulate_ccds(experiment, model, title=title, threads=threads, reporter=reporter).results.values()
    return [m[0] for m in models], [m[1] for m in models if noiseless]


def _without_images(product: CcdProduct) -> CcdProduct:
    """Return a product without its stamps, of which 189 CCDs have half a gigabyte."""
    return replace(product, holdout_images=product.holdout_images[:0], observed_images=product.observed_images[:0])


def _figures(products: Sequence[CcdProduct], correlated: dict[str, Correlation]) -> dict[str, float]:
    together = run_figures(products, correlated)["all"]
    e = np.concatenate([[p.holdout.e1, p.holdout.e2] for p in products], axis=1)
    figures = {"rms_e_truth": float(np.sqrt(np.nanmean(e**2)))}
    figures |= {key: float(together[key]) for key in _RMS if key != "rms_e_truth"}
    for kind in _XI:
        for name in SEPARATION_RANGES:
            figures[f"xi_plus_{kind}_{name}"] = correlated[kind].mean_xi_plus(name)
    return figures


def _changes(
    full: Mapping[str, float],
    case: Mapping[str, float],
    with_all: Mapping[str, Correlation],
    without: Mapping[str, Correlation],
) -> dict[str, float]:
    """Return the full case less this one; the stars are the same, so what both have in common is in no error."""
    changes = {f"change_{key}": full[key] - case[key] for key in case}
    for kind in _XI:
        for name in SEPARATION_RANGES:
            one, other = with_all[kind], without[kind]
            error = np.nan
            if one.n_patches and one.n_patches == other.n_patches:
                error = float(
                    jackknife_error(one.leave_one_out_mean_xi_plus(name) - other.leave_one_out_mean_xi_plus(name))
                )
            changes[f"error_xi_plus_{kind}_{name}"] = error
    return changes


def _meaning(key: str) -> str:
    for start, words in (("change_", "full case less this one: "), ("error_", "jackknife error of the change: ")):
        if key.startswith(start):
            return words + _meaning(key.removeprefix(start))
    if key.startswith("xi_plus_"):
        low, high = SEPARATION_RANGES[key.rpartition("_")[2]]
        return f"mean xi+ of {key.split('_')[2]}, {low:g} to {high:g} arcmin"
    return "median FWHM" if key == "fwhm_arcsec" else key.replace("_", " ") + ", one component"
