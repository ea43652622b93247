"""Effect of each cause on the PSF: the same stars with all causes, and with each cause switched off.

Random numbers are common to all cases: heights, turbulence, wind, positions of the stars and the order of their
magnitudes. Differences are then effects of a cause. Two quantities depend on the PSF, as in observations: the magnitude
of the faintest star, by its signal-to-noise ratio, and the numbers of the photons.

A telescope without aberrations cannot be traced over the CCD heights. With the optics off, stars at the same positions
on the sky are therefore imaged by a paraboloid so long that design, heights and residuals of the active optics have no
effect. The effect of the design is that of the optics less that of the heights.

The ground layer holds most of the turbulence. At exactly 0 m all stars of the field have the same part of it in front
of them at any time, and one ellipticity in common. Its case lifts the layer with the same turbulence, so far that stars
have no more of it in common than of the next layer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...core.progress import Reporter
from ...pipeline.ccd_product import CCD_KINDS, CcdProduct
from ...pipeline.config import Configuration
from ...pipeline.experiment import Experiment
from ...pipeline.focal_plane_stage import apply_focal_plane_model
from ...pipeline.measure.correlation import SEPARATION_RANGES, Correlation, jackknife_error
from ...pipeline.measure.summary import correlations, of_focal_plane, run_metrics
from ...pipeline.memory import check_memory
from ...pipeline.simulate.ccd_exposure import CcdExposure
from ...pipeline.simulate.ccd_loop import simulate_ccds
from ...pipeline.simulate.ccd_model import model_ccd
from .causes import FULL, NOISE, OPTICS, checked_causes, without

_RMS = ("rms_e_truth", "rms_residual_at_stars", "rms_residual_left_out", "rms_residual_away", "fwhm_arcsec")
_RMS_CCD = ("rms_residual_at_stars_ccd", "rms_residual_away_ccd")
_XI = ("truth", "observed", "residual", "away")


@dataclass(frozen=True)
class Attribution:
    """Metrics with all causes (``full``), and without each.

    Metrics are rms of e and of its residuals, median FWHM, and the mean xi+ of noise-free PSFs, observed stars and
    residuals, over short and long separations. ``change_`` and a key is the effect of the cause, the full case less
    this one; ``error_`` and a key of xi+ its jackknife error over the CCDs. With a focal-plane model there are those of
    the CCDs' own models too, with ``_ccd`` in their keys.
    """

    metrics: dict[str, dict[str, float]]  #: by case
    correlations: dict[str, dict[str, Correlation]]  #: by case and kind


def attribute(
    config: Configuration,
    causes: Sequence[str] | None = None,
    *,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> Attribution:
    """Simulate and model the same stars with all causes and without each, by default of all that are on.

    The engine ``long_exposure`` averages over all turbulence. It is fast, and ellipticities are effects of optics and
    heights alone; the atmosphere cannot be switched off.
    """
    reporter = Reporter(quiet=True) if reporter is None else reporter
    full = Experiment.from_config(config)
    chosen = checked_causes(full.config, causes)
    check_memory(full, threads)
    correlated, metrics = {}, {}
    cases = [FULL, *(c for c in chosen if c != NOISE)]
    with full.screens(threads, reporter):
        for case in cases:
            experiment = full if case == FULL else without_cause(full, case)
            products, noiseless = _products(experiment, case, NOISE in chosen and case == FULL, threads, reporter)
            for name, found in ((case, products), (NOISE, noiseless)):
                if found:
                    correlated[name] = correlations(found, found[0].kinds)
                    metrics[name] = _metrics(found, correlated[name])
    order = (FULL, *chosen)
    for name in chosen:
        metrics[name] |= changes(metrics[FULL], metrics[name], correlated[FULL], correlated[name])
    return Attribution({n: metrics[n] for n in order}, {n: correlated[n] for n in order})


def without_cause(full: Experiment, cause: str) -> Experiment:
    """Return the experiment with one cause off; defaults that were filled in stay: pixels, stamps, weight."""
    experiment = Experiment.from_config(without(full.config, cause))
    if full.atmosphere is not None and experiment.atmosphere is not None:
        # The screens are the same, and slow to make.
        experiment = replace(experiment, atmosphere=full.atmosphere.at_altitudes(experiment.atmosphere.altitudes))
    return replace(experiment, atmosphere_only=cause == OPTICS)


def _products(
    experiment: Experiment, case: str, noiseless: bool, threads: int | None, reporter: Reporter
) -> tuple[list[CcdProduct], list[CcdProduct]]:
    """Return the products of all CCDs, and of the same stars without noise."""
    noisy_or_not = (True, False) if noiseless else (True,)
    whole = experiment.config.reconstruction.model == "focal_plane"

    def model(exposure: CcdExposure) -> list[CcdProduct]:
        # A focal-plane model takes the noise of the stars from their stamps.
        return [_without_images(model_ccd(experiment, exposure, noisy=noisy), whole) for noisy in noisy_or_not]

    title = "everything on" if case == FULL else f"{case} off"
    models = simulate_ccds(experiment, model, title=title, threads=threads, reporter=reporter).results.values()
    noisy, noise_free = [m[0] for m in models], [m[1] for m in models if noiseless]
    if whole:
        noisy = _of_focal_plane(experiment, noisy, threads, reporter)
        noise_free = _of_focal_plane(experiment, noise_free, threads, reporter) if noiseless else []
    return noisy, noise_free


def _of_focal_plane(
    experiment: Experiment, products: list[CcdProduct], threads: int | None, reporter: Reporter
) -> list[CcdProduct]:
    """Return products with the focal-plane model of all of them, without any stamps."""
    applied, _ = apply_focal_plane_model(experiment, products, threads=threads, reporter=reporter)
    return [_without_images(product, keep_stars=False) for product in applied]


def _without_images(product: CcdProduct, keep_stars: bool) -> CcdProduct:
    """Return a product without its stamps, half a gigabyte for 189 CCDs, but for those of the stars where asked."""
    stars = product.observed_images if keep_stars else product.observed_images[:0]
    return replace(product, holdout_images=product.holdout_images[:0], observed_images=stars)


def _metrics(products: Sequence[CcdProduct], correlated: dict[str, Correlation]) -> dict[str, float]:
    together = run_metrics(products, correlated)["all"]
    e = np.concatenate([[p.holdout.e1, p.holdout.e2] for p in products], axis=1)
    metrics = {"rms_e_truth": float(np.sqrt(np.nanmean(e**2)))}
    metrics |= {key: float(together[key]) for key in _RMS if key != "rms_e_truth"}
    if of_focal_plane(products):
        metrics |= {key: float(together[key]) for key in _RMS_CCD}
    for kind in (k for k in (*_XI, *CCD_KINDS) if k in correlated):
        for name in SEPARATION_RANGES:
            metrics[f"xi_plus_{kind}_{name}"] = correlated[kind].mean_xi_plus(name)
    return metrics


def changes(
    full: Mapping[str, float],
    case: Mapping[str, float],
    with_all: Mapping[str, Correlation],
    without: Mapping[str, Correlation],
) -> dict[str, float]:
    """Return the metrics of the full case less those of another, with jackknife errors of xi+.

    The stars are the same in both, so that errors in common cancel.
    """
    found = {f"change_{key}": full[key] - case[key] for key in case}
    for kind in (k for k in (*_XI, *CCD_KINDS) if k in with_all):
        for name in SEPARATION_RANGES:
            one, other = with_all[kind], without[kind]
            error = np.nan
            if one.n_patches and one.n_patches == other.n_patches:
                error = float(
                    jackknife_error(one.leave_one_out_mean_xi_plus(name) - other.leave_one_out_mean_xi_plus(name))
                )
            found[f"error_xi_plus_{kind}_{name}"] = error
    return found
