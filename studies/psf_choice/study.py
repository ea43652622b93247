"""Study of PSF models: number of stars, order, components and basis, against noise-free PSFs.

Positions, PSFs, magnitudes and noise are common to all cases. Stars are simulated once, without noise, at as many
positions of each CCD as the most demanding case needs, and at holdout positions. A case of n stars takes the first n,
with noise. Differences between cases are then effects of the model. The residual at the stars underestimates the error;
the one at the holdout positions applies to galaxies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np

from ...core.errors import ConfigError, DomainError, PachonError
from ...core.progress import Reporter
from ...pipeline.config import Configuration, with_options
from ...pipeline.experiment import Experiment
from ...pipeline.focal_plane_stage import fit_focal_plane_model
from ...pipeline.memory import check_memory
from ...pipeline.resolved_values import require_drawn_stars
from ...reconstruction.focal_plane_psf.model import FocalPlanePsf
from ...reconstruction.focal_plane_psf.stars import CcdStars, FocalPlaneStars
from ...reconstruction.psf_model.model import PsfModel
from ...reconstruction.psf_model.recipe import BASES
from .plan import FOCAL_PLANE, NOISE_FREE, Case, Plan
from .residuals import Residuals, case_metrics, measure_residuals
from .stars import ObservedCcd, SimulatedCcd, fit, observe, simulate, used_stars

#: One in each raft along two lines through the centre of the field, from the centre to the edge.
STUDY_CCDS = tuple(f"R{raft}_S11" for raft in ("02", "11", "13", "20", "22", "24", "31", "33", "42"))
# Electrons of a star without noise: with them the stated noise of e is 5e-5, to which the fitted optics are right.
_ELECTRONS = 1e8


@dataclass(frozen=True)
class Study:
    """Result of the study of PSF models, for the cases of a plan.

    Metrics of each fitted case, of adaptive moments, are ``rms_g_`` and ``rms_dt_g_`` (one component of g; dT/T),
    ``mean_g_`` (rms over the CCDs of the mean of one component), ``noise_law_g_`` (rms of g by noise alone) and
    ``xi_plus_g_..._short``, ``_long`` (below and beyond 10') of each of
    :data:`~pachon.studies.psf_choice.residuals.KINDS`, with an ``error_`` over five CCDs or more; of the
    weighted e as the paper's ``rms_e_``, ``rms_size_``, ``mean_e_``, ``noise_law_`` and ``xi_plus_``; and ``lost``,
    holdout positions at which the model has no shape, over all draws.

    `holdout_square` is the mean square residual at the holdout positions of each CCD, [n_ccd]: of g1, g2 and the
    relative sigma, half of dT/T, together, which are commensurate for a PSF of axes a and b: ln a = ln sigma + |g|,
    ln b = ln sigma - |g| to first order. Where images narrower than a pixel have no adaptive moments it is of the
    weighted e1, e2 and size.
    """

    plan: Plan
    metrics: dict[Case, dict[str, float]]
    problems: dict[Case, str]  #: reasons why the other cases could not be fitted
    holdout_square: dict[Case, np.ndarray]

    def recommended(self) -> Case | None:
        """Return the simplest case as good as the best one, of the base's number of stars and S/N; None without any.

        Cases are as good as the best one if their :attr:`holdout_square` exceeds its own by no more than the standard
        error of the excess over the CCDs (rule of one standard error, Breiman et al. 1984). The simplest case has the
        fewest free parameters on a CCD. Models of the whole focal plane are last, that with the telescope after the
        other: priors hold their parameters, which CCDs share, so that these cannot be counted beside free ones.
        """
        base = self.plan.base
        usable = [c for c, f in self.metrics.items() if (c.stars, c.snr) == (base.stars, base.snr) and not f["lost"]]
        if not usable:
            return None
        best = min(usable, key=lambda case: self.holdout_square[case].mean())
        as_good = []
        for case in usable:
            excess = self.holdout_square[case] - self.holdout_square[best]
            error = excess.std(ddof=1) / np.sqrt(len(excess)) if len(excess) > 1 else 0.0
            if excess.mean() <= error:
                as_good.append(case)
        return min(as_good, key=_complexity_key)

    def best_order(self, stars: int, interpolation: str) -> Case | None:
        """Return the case of the base's basis, components and S/N with the least :attr:`holdout_square`."""
        sought = replace(self.plan.base, stars=stars, interpolation=interpolation)
        same = [
            c for c, f in self.metrics.items() if c == replace(sought, order=c.order).normalised() and not f["lost"]
        ]
        return min(same, key=lambda case: self.holdout_square[case].mean()) if same else None


def study_experiment(config: Configuration, plan: Plan) -> Experiment:
    """Return the experiment of a plan, with as many observed stars as the largest case needs.

    Stars with defects, or of a catalogue, are a ConfigError, since the study draws them and adds its own noise.
    """
    require_drawn_stars(config)
    for key in ("neighbours", "cosmic_rays", "saturated"):
        if (value := getattr(config.stars, key)) > 0.0:
            raise ConfigError(f"stars.{key} = {value:g}: expected 0, the stars of a study have noise but no defects")
    return Experiment.from_config(with_options(config, stars__observed=max(plan.stars)))


def study(config: Configuration, plan: Plan, *, threads: int | None = None, reporter: Reporter | None = None) -> Study:
    """Simulate the stars of a configuration, and fit the PSF model of every case of a plan."""
    reporter = Reporter(quiet=True) if reporter is None else reporter
    experiment = study_experiment(config, plan)
    check_memory(experiment, threads)
    ccds = simulate(experiment, threads, reporter)
    cases = plan.cases()
    n_draws = {case: 1 if case.snr == NOISE_FREE else plan.draws for case in cases}
    samples: dict[Case, list[Residuals]] = {case: [] for case in cases}
    problems: dict[Case, str] = {}
    total, done = sum(n_draws.values()), 0
    with reporter.stage(f"{len(cases)} ways to model", total=total) as stage:
        for snr in sorted({case.snr for case in cases}):
            snr_cases = [case for case in cases if case.snr == snr]
            for draw in range(n_draws[snr_cases[0]]):
                observed = [observe(experiment, ccd, snr, draw) for ccd in ccds]
                # Principal components do not depend on how many are kept: one fit for all of these numbers.
                for _, group in groupby(sorted(snr_cases, key=_fit_key), key=_fit_key):
                    together = list(group)
                    most = max(together, key=lambda case: case.components)
                    try:
                        models = _models_of_ccds(most, experiment, ccds, observed, threads)
                        for case in together:
                            residuals = measure_residuals(experiment, case, ccds, observed, models, threads)
                            samples[case].append(residuals)
                    except PachonError as error:
                        problems |= dict.fromkeys(together, str(error))
                    stage.advance(len(together))
                done += len(snr_cases)
                stage.step(f"stars {snr_cases[0].noise_text}, noise {draw + 1}", done, total)
    fitted_cases = [case for case in cases if case not in problems]
    if not fitted_cases:
        raise DomainError(f"no model could be fitted: {problems[cases[0]]}")
    metrics = {case: case_metrics(samples[case]) for case in fitted_cases}
    squares = {case: np.mean([_holdout_square(s) for s in samples[case]], axis=0) for case in fitted_cases}
    return Study(plan, metrics, {case: problems[case] for case in cases if case in problems}, squares)


def _holdout_square(residuals: Residuals) -> np.ndarray:
    """Return the mean square of two components and of the size of each CCD, [n_ccd]; see :class:`Study`."""
    at_holdout = residuals.square[:, 1]
    of_g = at_holdout[:, 2:] @ (2.0, 0.25)
    return np.where(np.isfinite(of_g), of_g, at_holdout[:, :2] @ (2.0, 1.0))


def _models_of_ccds(
    case: Case,
    experiment: Experiment,
    ccds: Sequence[SimulatedCcd],
    observed: Sequence[ObservedCcd],
    threads: int | None,
) -> Sequence[PsfModel | FocalPlanePsf]:
    """Return the model of each CCD, which may be that of all of them."""
    if case.interpolation in FOCAL_PLANE:
        return [fit_focal_plane(case, experiment, ccds, observed, threads)] * len(ccds)
    return [fit(case, *pair) for pair in zip(ccds, observed, strict=True)]


def _fit_key(case: Case) -> tuple[Any, ...]:
    """Return the sort key of a case: cases of one fit are adjacent."""
    shared = case.basis in BASES and BASES[case.basis].ordered
    return (case.basis, case.interpolation, case.order, case.stars, 0 if shared else case.components)


def _complexity_key(case: Case) -> tuple[int, int]:
    """Return the sort key of a case: focal-plane models last, then the number of free parameters."""
    if case.interpolation in FOCAL_PLANE:
        return 1 + [*FOCAL_PLANE].index(case.interpolation), case.components * case.terms
    return 0, (case.components or 10**6) * case.recipe().interpolation.parameter_count(case.stars)


def fit_focal_plane(
    case: Case,
    experiment: Experiment,
    ccds: Sequence[SimulatedCcd],
    observed: Sequence[ObservedCcd],
    threads: int | None = None,
) -> FocalPlanePsf:
    """Fit the focal-plane model of a case to the first stars of each CCD, all CCDs together."""
    stars = FocalPlaneStars.of_ccds(
        [_stars_of_ccd(case, *pair) for pair in zip(ccds, observed, strict=True)],
        ccds[0].exposure.observed.pixel_scale,
        experiment.weight_fwhm,
    )
    names = [ccd.exposure.name for ccd in ccds]
    return fit_focal_plane_model(
        experiment, stars, telescope=case.interpolation == "focal_plane", ccds=names, threads=threads
    )


def _stars_of_ccd(case: Case, ccd: SimulatedCcd, observed: ObservedCcd) -> CcdStars:
    noisy_stars, electrons = observed.observation, np.minimum(observed.electrons, _ELECTRONS)
    x, y = ccd.exposure.positions.observed.T
    name, used = ccd.exposure.name, used_stars(case, observed)
    return CcdStars(name, x, y, noisy_stars.shapes, electrons, noisy_stars.noise, noisy_stars.images, used)
