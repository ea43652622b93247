"""Effect of each cause on the PSF: the same stars with all causes, and with each cause switched off.

Random numbers are common to all cases: heights, turbulence, wind, positions of the stars and the order of their
magnitudes. Differences are then effects of a cause. Two quantities depend on the PSF, as in observations: the magnitude
of the faintest star, by its signal-to-noise ratio, and the numbers of the photons.

A telescope without aberrations cannot be traced over the CCD heights. With the optics off, stars at the same positions
on the sky are therefore imaged by a paraboloid so long that design, heights and residuals of the active optics have no
effect. The effect of the design is that of the optics less that of the heights.

The ground layer holds most of the turbulence. At exactly 0 m the light of all stars crosses the same part of it at any
time, and gives them one ellipticity in common. Its case lifts the layer with the same turbulence, so far that stars
have no more of it in common than of the next layer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import DomainError, PachonError
from ...core.progress import Reporter
from ...core.statistics import rms
from ...core.units import ARCSEC
from ...measure.correlation import SEPARATION_RANGES, Correlation, jackknife_error
from ...pipeline.config import Configuration
from ...pipeline.experiment import Experiment
from ...pipeline.focal_plane_stage import apply_focal_plane_model
from ...pipeline.memory import check_memory
from ...pipeline.simulate.ccd_exposure import CcdExposure
from ...pipeline.simulate.ccd_loop import simulate_ccds
from ...pipeline.simulate.ccd_model import model_ccds
from ...pipeline.summary import correlations, ellipticities, has_focal_plane_model, size_residuals
from ...reconstruction.ccd_product import CCD_KINDS, MOMENTS, CcdProduct, CcdStars
from .causes import FULL, NOISE, OPTICS, checked_causes, without

_XI = ("truth", "observed", "residual", "away")
#: What keys of metrics have before the kind, by moments.
_PREFIX = {"e": "", "g": "g_"}


@dataclass(frozen=True)
class Attribution:
    """Metrics with all causes (``full``), and without each.

    Metrics are the rms of one component of the ellipticity and of its residuals, the rms of dT/T of the residuals,
    median FWHM, and the mean xi+ of noise-free PSFs, observed stars and residuals, over short and long separations.
    Keys with ``_g`` are of g and T of adaptive moments; the others of the weighted e, as the paper's. ``change_`` and
    a key is the effect of the cause, the full case less this one; ``error_`` and a key of xi+ its jackknife error over
    the CCDs. With a focal-plane model there are those of the CCDs' own models too, with ``_ccd`` in their keys.
    """

    metrics: dict[str, dict[str, float]]  #: by case
    correlations: dict[str, dict[str, Correlation]]  #: of the weighted e, by case and kind
    correlations_g: dict[str, dict[str, Correlation]]  #: of g, by case and kind; none where images have no moments
    left_out: dict[str, str]  #: reason by CCD that cannot be modelled in some case, and is left out of all


def attribute(
    config: Configuration,
    causes: Sequence[str] | None = None,
    *,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> Attribution:
    """Simulate and model the same stars with all causes and without each, by default of all that are on.

    The engine ``long_exposure`` averages over all turbulence. It is fast, and ellipticities are effects of optics and
    heights alone; the atmosphere cannot be switched off. CCDs that cannot be modelled in one case, such as those of
    images without turbulence that are narrower than a pixel, are left out of all.

    Raises
    ------
    DomainError
        If no CCD can be modelled in all cases.
    """
    reporter = Reporter(quiet=True) if reporter is None else reporter
    full = Experiment.from_config(config)
    cause_names = checked_causes(full.config, causes)
    check_memory(full, threads)
    stars: dict[str, dict[str, CcdStars]] = {}
    left_out: dict[str, str] = {}
    with full.screens(threads, reporter):
        for case in [FULL, *(c for c in cause_names if c != NOISE)]:
            # No experiment outlives its case: its atmosphere would hold the screens.
            case_stars, failed = _stars_by_case(
                full if case == FULL else without_cause(full, case),
                case,
                NOISE in cause_names and case == FULL,
                threads,
                reporter,
            )
            stars |= case_stars
            left_out |= {name: reason for name, reason in failed.items() if name not in left_out}
    if not stars[FULL].keys() - left_out:
        name, reason = next(iter(left_out.items()))
        raise DomainError(f"{reason}; no CCD can be modelled in all cases", subject=f"CCD {name}")
    correlated: dict[str, dict[str, dict[str, Correlation]]] = {moments: {} for moments in MOMENTS}
    metrics = {}
    for case in (FULL, *cause_names):
        common_stars = [ccd_stars for name, ccd_stars in stars[case].items() if name not in left_out]
        for moments in MOMENTS:
            correlated[moments][case] = correlations(common_stars, common_stars[0].kinds, moments)
        metrics[case] = _case_metrics(common_stars, {moments: correlated[moments][case] for moments in MOMENTS})
    for case in cause_names:
        metrics[case] |= changes(metrics[FULL], metrics[case])
        for moments in MOMENTS:
            metrics[case] |= change_errors(correlated[moments][FULL], correlated[moments][case], moments)
    return Attribution(metrics, correlated["e"], correlated["g"], left_out)


def without_cause(full: Experiment, cause: str) -> Experiment:
    """Return the experiment with one cause off; defaults that were filled in stay: pixels, stamps, weight."""
    experiment = Experiment.from_config(without(full.config, cause))
    if full.atmosphere is not None and experiment.atmosphere is not None:
        # The screens are the same, and slow to make.
        experiment = replace(experiment, atmosphere=full.atmosphere.at_altitudes(experiment.atmosphere.altitudes))
    return replace(experiment, atmosphere_only=cause == OPTICS)


def _stars_by_case(
    experiment: Experiment, case: str, noiseless: bool, threads: int | None, reporter: Reporter
) -> tuple[dict[str, dict[str, CcdStars]], dict[str, str]]:
    """Return the stars by case and CCD, the same without noise too; and the reasons of CCDs that are not modelled."""
    kinds = {case: True, NOISE: False} if noiseless else {case: True}
    focal_plane_model = experiment.config.reconstruction.model == "focal_plane"

    def stars_of(product: CcdProduct) -> CcdStars:
        # A focal-plane model takes the noise of the stars from their stamps.
        return replace(product, holdout_images=product.holdout_images[:0]) if focal_plane_model else product.ccd_stars

    def model(exposures: Sequence[CcdExposure]) -> list[list[CcdStars] | PachonError]:
        products_by_kind = [model_ccds(experiment, exposures, noisy=noisy) for noisy in kinds.values()]
        results: list[list[CcdStars] | PachonError] = []
        for of_ccd in zip(*products_by_kind, strict=True):
            errors = [product for product in of_ccd if isinstance(product, PachonError)]
            products = [product for product in of_ccd if not isinstance(product, PachonError)]
            results.append(errors[0] if errors else [stars_of(product) for product in products])
        return results

    title = "everything on" if case == FULL else f"{case} off"
    simulated = simulate_ccds(experiment, model, title=title, strict=False, threads=threads, reporter=reporter)
    stars_by_kind = {
        kind: {name: stars[i] for name, stars in simulated.results.items()} for i, kind in enumerate(kinds)
    }
    if focal_plane_model and simulated.results:
        for kind, ccd_stars in stars_by_kind.items():
            products = [p for p in ccd_stars.values() if isinstance(p, CcdProduct)]
            applied, _ = apply_focal_plane_model(experiment, products, threads=threads, reporter=reporter)
            stars_by_kind[kind] = {product.name: product.ccd_stars for product in applied}
    return stars_by_kind, simulated.not_modelled


def _case_metrics(stars: Sequence[CcdStars], correlated: dict[str, dict[str, Correlation]]) -> dict[str, float]:
    """Return the metrics of a case from its stars, and from their correlations by moments and kind."""
    residuals = {"at_stars": "residual", "left_out": "left_out", "away": "away"}
    if has_focal_plane_model(stars):
        residuals |= {"at_stars_ccd": "residual_ccd", "away_ccd": "away_ccd"}
    metrics = {}
    for moments, prefix in _PREFIX.items():
        metrics[f"rms_{moments}_truth"] = rms(ellipticities(stars, "truth", moments))
        for name, kind in residuals.items():
            metrics[f"rms_residual_{prefix}{name}"] = rms(ellipticities(stars, kind, moments))
    for name, kind in residuals.items():
        metrics[f"rms_dt_g_{name}"] = rms(size_residuals(stars, kind, "g"))
    metrics["fwhm_arcsec"] = float(np.nanmedian(np.concatenate([s.holdout.fwhm for s in stars]))) / ARCSEC
    for moments, prefix in _PREFIX.items():
        # A correlation of g is absent where images have no adaptive moments; that of e is not.
        for kind in (k for k in (*_XI, *CCD_KINDS) if k in correlated["e"]):
            for name in SEPARATION_RANGES:
                correlation = correlated[moments].get(kind)
                mean = np.nan if correlation is None else correlation.mean_xi_plus(name)
                metrics[f"xi_plus_{prefix}{kind}_{name}"] = mean
    return metrics


def changes(full: Mapping[str, float], case: Mapping[str, float]) -> dict[str, float]:
    """Return the metrics of the full case less those of another."""
    return {f"change_{key}": full[key] - case[key] for key in case}


def change_errors(
    with_all: Mapping[str, Correlation], without: Mapping[str, Correlation], moments: str = "e"
) -> dict[str, float]:
    """Return jackknife errors of the changes of xi+ of e, or of g, between the full case and another.

    The stars are the same in both, so that errors in common cancel. NaN where the CCDs of both are not the same.
    """
    errors = {}
    for kind in (k for k in (*_XI, *CCD_KINDS) if k in with_all):
        for name in SEPARATION_RANGES:
            full_correlation, case_correlation = with_all[kind], without.get(kind)
            error = np.nan
            if (
                case_correlation is not None
                and full_correlation.n_patches
                and full_correlation.n_patches == case_correlation.n_patches
            ):
                error = float(
                    jackknife_error(
                        full_correlation.leave_one_out_mean_xi_plus(name)
                        - case_correlation.leave_one_out_mean_xi_plus(name)
                    )
                )
            errors[f"error_xi_plus_{_PREFIX[moments]}{kind}_{name}"] = error
    return errors
