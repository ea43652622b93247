"""How many stars, which order, how many components, which basis: PSF models held against the truth.

Places, PSFs, magnitudes and noise are common to all cases: stars are simulated once, without noise, at as many places
of each CCD as the most demanding case needs, and elsewhere for the truth; noise is added, and a case of n stars takes
the first n. A difference between cases is the doing of the model. For each case the residual at the stars, which
flatters, stands beside that where no star is, which a galaxy sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np

from ...core.errors import ConfigError, DomainError, PachonError
from ...core.progress import Reporter
from ...core.random_streams import stream
from ...core.threads import one_blas_thread
from ...core.units import ARCMIN
from ...pipeline.config import Configuration, with_options
from ...pipeline.experiment import Experiment
from ...pipeline.measure.correlation import SEPARATION_RANGES, jackknife_error, shear_correlation
from ...pipeline.measure.shapes import Shapes, measure_shapes
from ...pipeline.memory import check_memory
from ...pipeline.psf_model.checks import snr_weights
from ...pipeline.psf_model.model import CLIP_SIGMA, PsfModel
from ...pipeline.psf_model.polynomial import Extent, design_matrix
from ...pipeline.simulate.ccd_exposure import CcdExposure
from ...pipeline.simulate.ccd_loop import simulate_ccds
from ...pipeline.simulate.ccd_observation import Observation, observe_ccd
from ...pipeline.simulate.photometry import (
    effective_fwhm,
    instrument_noise,
    limiting_magnitude,
    signal_to_noise,
    sky_electrons_per_pixel,
)
from ...pipeline.simulate.stamps import observe_stamps
from ...pipeline.simulate.star_field import make_star_field
from .plan import NOISE_FREE, Case, Plan

#: One in each raft along two lines through the centre of the field, from the centre to the edge.
STUDY_CCDS = tuple(f"R{raft}_S11" for raft in ("02", "11", "13", "20", "22", "24", "31", "33", "42"))
#: Residuals: observed - model at the stars, truth - model where no star is.
KINDS = ("at_stars", "away")
# Two bins of equal width in the logarithm: 0.56' to 10', and 10' to 180'.
_LOW, _HIGH = SEPARATION_RANGES["long"]
_BINS: dict[str, Any] = {
    "min_sep": _LOW**2 / _HIGH * ARCMIN,
    "max_sep": _HIGH * ARCMIN,
    "n_bins": 2,
}
RANGES = ("short", "long")


@dataclass(frozen=True)
class Study:
    """What came out.

    Attributes
    ----------
    plan : Plan
        What was tried.
    figures : dict of Case to dict
        Of each case that could be fitted: ``rms_e_`` and ``rms_size_`` (one component of e; relative size), ``mean_e_``
        (rms over the CCDs of the mean of one component), ``noise_law_`` (rms of e that noise alone should leave) and
        ``xi_plus_..._short``, ``_long`` (below and beyond 10') of each of :data:`KINDS`, with an ``error_`` over the
        CCDs where it has a meaning; ``lost``, places whose model has no shape, over all draws.
    problems : dict of Case to str
        Why the others could not be fitted.
    square_away : dict of Case to ndarray
        Of each CCD, the mean square of the residual where no star is: of e1, e2 and the relative size together, which
        for a PSF of axes a and b are on a par, ln a = ln size + |e| and ln b = ln size - |e| to first order.
    """

    plan: Plan
    figures: dict[Case, dict[str, float]]
    problems: dict[Case, str]
    square_away: dict[Case, np.ndarray]

    def recommended(self) -> Case | None:
        """Return the simplest case as good as the best one, of the base's number of stars and S/N; None without any.

        As good as the best are those whose :attr:`square_away` exceeds that of the best by no more than the standard
        error of the excess, CCD by CCD (the rule of one standard error, Breiman et al. 1984). Simplest is what has the
        fewest free numbers.
        """
        base = self.plan.base
        usable = [c for c, f in self.figures.items() if (c.stars, c.snr) == (base.stars, base.snr) and not f["lost"]]
        if not usable:
            return None
        best = min(usable, key=lambda case: self.square_away[case].mean())
        as_good = []
        for case in usable:
            excess = self.square_away[case] - self.square_away[best]
            error = excess.std(ddof=1) / np.sqrt(len(excess)) if len(excess) > 1 else 0.0
            if excess.mean() <= error:
                as_good.append(case)
        return min(as_good, key=_free_numbers)

    def best_order(self, stars: int, interpolation: str) -> Case | None:
        """Return the case of the base's basis, components and S/N with the least :attr:`square_away`."""
        sought = replace(self.plan.base, stars=stars, interpolation=interpolation)
        same = [c for c, f in self.figures.items() if c == replace(sought, order=c.order).settled() and not f["lost"]]
        return min(same, key=lambda case: self.square_away[case].mean()) if same else None


@dataclass(frozen=True)
class StudyCcd:
    """Stars of a CCD, shapes of the truth, and the stars observed without noise."""

    exposure: CcdExposure
    truth: Shapes
    quiet: Observation


@dataclass(frozen=True)
class SeenStars:
    """Stars of a CCD observed through noise: what was seen, S/N of each, and the variance of e1 and e2 by noise."""

    seen: Observation
    snr: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True)
class _Sample:
    """A case and a draw of the noise: [n_ccd, kind, e or size], [n_ccd, kind, component], [kind, range, ...]."""

    square: np.ndarray
    mean: np.ndarray
    law: np.ndarray
    xi: np.ndarray
    xi_left: np.ndarray
    lost: int


def study_experiment(config: Configuration, plan: Plan) -> Experiment:
    """Return the experiment to simulate: as many observed stars as the largest case needs.

    Raises
    ------
    ConfigError
        If that does not hold together, or stars are to have defects: the noise is the study's own.
    """
    for key in ("neighbours", "cosmic_rays", "saturated"):
        if (value := getattr(config.stars, key)) > 0.0:
            raise ConfigError(f"stars.{key} = {value:g}: expected 0, the stars of a study have noise but no defects")
    return Experiment.from_config(with_options(config, stars__observed=max(plan.stars)))


def study(config: Configuration, plan: Plan, *, threads: int | None = None, reporter: Reporter | None = None) -> Study:
    """Simulate the stars, and model them in every way of the plan.

    Parameters
    ----------
    config : Configuration
        Configuration of the stars and of the standard model.
    plan : Plan
        What to try.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    reporter : Reporter, optional
        Who tells how far it is; nobody by default.

    Raises
    ------
    PachonError
        If the stars cannot be simulated, or no case can be fitted; otherwise, one that cannot is in the result.
    """
    reporter = Reporter(quiet=True) if reporter is None else reporter
    experiment = study_experiment(config, plan)
    check_memory(experiment, threads)
    ccds = _simulate(experiment, threads, reporter)
    cases = plan.cases()
    n_draws = {case: 1 if case.snr == NOISE_FREE else plan.draws for case in cases}
    samples: dict[Case, list[_Sample]] = {case: [] for case in cases}
    problems: dict[Case, str] = {}
    total, done = sum(n_draws.values()), 0
    with reporter.stage(f"{len(cases)} ways to model", total=total) as stage:
        for snr in sorted({case.snr for case in cases}):
            wanted = [case for case in cases if case.snr == snr]
            for draw in range(n_draws[wanted[0]]):
                seen = [observe(experiment, ccd, snr, draw) for ccd in ccds]
                # Principal components are the same however many are kept: one fit for all of these numbers.
                for _, group in groupby(sorted(wanted, key=_fit_key), key=_fit_key):
                    together = list(group)
                    try:
                        models = [fit(together[-1], *pair) for pair in zip(ccds, seen, strict=True)]
                        for case in together:
                            samples[case].append(_sample(experiment, case, ccds, seen, models))
                    except PachonError as error:
                        problems |= dict.fromkeys(together, str(error))
                    stage.advance(len(together))
                done += len(wanted)
                stage.step(f"S/N {snr:g}, noise {draw + 1}", done, total)
    made = [case for case in cases if case not in problems]
    if not made:
        raise DomainError(f"no model could be fitted: {problems[cases[0]]}")
    figures = {case: _figures(samples[case]) for case in made}
    squares = {case: np.mean([s.square[:, 1] @ (2.0, 1.0) for s in samples[case]], axis=0) for case in made}
    return Study(plan, figures, {case: problems[case] for case in cases if case in problems}, squares)


def _fit_key(case: Case) -> tuple[Any, ...]:
    """Return what sorts cases by fits, and within a fit of principal components by their number."""
    shared = case.basis == "pca"
    return (case.basis, case.interpolation, case.order, case.stars, 0 if shared else case.components)


def _free_numbers(case: Case) -> int:
    components = case.components or 10**6
    return components * (case.stars if case.interpolation == "gp" else case.terms)


def _simulate(experiment: Experiment, threads: int | None, reporter: Reporter) -> list[StudyCcd]:
    """Make the noise-free stars of all CCDs."""

    def measured(exposure: CcdExposure) -> StudyCcd:
        truth = measure_shapes(exposure.truth.image, exposure.truth.pixel_scale, experiment.weight_fwhm)
        return StudyCcd(exposure, truth, _look_at(experiment, exposure, exposure.observed.image))

    with experiment.screens(threads, reporter):
        simulated = simulate_ccds(experiment, measured, title="stars", threads=threads, reporter=reporter)
    return list(simulated.results.values())


def _look_at(experiment: Experiment, exposure: CcdExposure, images: np.ndarray) -> Observation:
    """Centre and measure images of the stars of a CCD; what noise they are to have, they have."""
    scale = exposure.observed.pixel_scale
    return observe_ccd(experiment, exposure.name, images, scale, exposure.places.electrons, noisy=False)


def observe(experiment: Experiment, ccd: StudyCcd, snr_min: float, draw: int) -> SeenStars:
    """Look at the stars of a CCD through noise.

    Parameters
    ----------
    experiment : Experiment
        Settings.
    ccd : StudyCcd
        The stars.
    snr_min : float
        Signal-to-noise ratio of the faintest star where the least light arrives; infinite for no noise.
    draw : int
        Which draw of the noise.
    """
    exposed, places, name = ccd.exposure.observed, ccd.exposure.places, ccd.exposure.name
    n_stars = len(exposed.image)
    if snr_min == NOISE_FREE:
        return SeenStars(ccd.quiet, np.full(n_stars, np.inf), np.zeros(n_stars))
    seed, light = experiment.config.seed, exposed.light
    width = effective_fwhm(ccd.exposure.truth.image, ccd.exposure.truth.pixel_scale)
    faint = limiting_magnitude(snr_min, places.band, places.exposure, width) + 2.5 * np.log10(light.min())
    # The same stars, one after the other, brought up to the limit together.
    stars = make_star_field(
        name, places.bounds, 0, n_stars, seed, fwhm=width, band=places.band, exposure=places.exposure, faint=faint
    )
    sky = sky_electrons_per_pixel(places.band, places.exposure, exposed.pixel_scale)
    rng = stream(seed, "study", "noise", name, draw)
    images = observe_stamps(exposed.image, stars.electrons * light, sky, instrument_noise(places.exposure), rng)
    seen = _look_at(experiment, ccd.exposure, images)
    snr = signal_to_noise(stars.magnitude - 2.5 * np.log10(light), places.band, places.exposure, width)
    # The noise of e goes as the inverse of S/N; its size is taken from all stars together.
    noise = np.stack([seen.shapes.e1 - ccd.quiet.shapes.e1, seen.shapes.e2 - ccd.quiet.shapes.e2])
    return SeenStars(seen, snr, np.mean((noise * snr)[:, seen.used] ** 2) / snr**2)


def fit(case: Case, ccd: StudyCcd, seen: SeenStars) -> PsfModel:
    """Model the first stars of a CCD as the case says.

    Raises
    ------
    PachonError
        If they cannot be modelled so.
    """
    used = _chosen(case, seen)
    return PsfModel.fit(
        seen.seen.images[used],
        ccd.exposure.places.observed[used],
        basis=case.basis,  # type: ignore[arg-type]
        interpolation="gp" if case.interpolation == "gp" else "polynomial",
        weights=None if case.interpolation == "gp" else snr_weights(case.interpolation, seen.snr[used]),
        # Should a star not be usable, the stars give one principal component less.
        n_components=min(case.components, used.sum() - 1) if case.basis == "pca" else case.components or None,
        order=case.order,
        extent=ccd.exposure.places.bounds,
        clip_sigma=None if case.snr == NOISE_FREE else CLIP_SIGMA,  # without noise, what stands out is the PSF
    )


def _chosen(case: Case, seen: SeenStars) -> np.ndarray:
    return seen.seen.used & (np.arange(len(seen.snr)) < case.stars)


def noise_law(
    stars: np.ndarray,
    places: np.ndarray,
    variance: np.ndarray,
    weights: np.ndarray | None,
    order: int,
    extent: Extent,
) -> tuple[float, float]:
    r"""Return the mean square that noise leaves of a polynomial fit, at its stars and at other places.

    With the terms t at a place, those of the stars T and their weights W, the fit at the place is a y of the values
    y, a = t (T' W T)^-1 T' W. Values of independent noise leave :math:`\sum_j a_j^2 \sigma_j^2` there, and of
    observed - model at star i :math:`\sum_j (\delta_{ij} - a_j)^2 \sigma_j^2`. For equal noise and no weights the
    latter is 1 - p/n of the noise in the mean, exactly, p being the number of terms and n that of stars; model - truth
    at the stars p/n; and elsewhere about that, more where the stars leave gaps.

    Parameters
    ----------
    stars, places : array
        Positions, [n, 2] and [m, 2].
    variance : array
        Of the noise of each star, [n].
    weights : array or None
        Of the stars, [n].
    order : int
        Of the polynomial.
    extent : tuple of float
        That of the polynomials.
    """
    root = np.ones(len(stars)) if weights is None else np.sqrt(weights)
    terms = design_matrix(stars, extent, order)
    with one_blas_thread():
        solve = np.linalg.pinv(terms * root[:, None]) * root
        at_stars = np.eye(len(stars)) - terms @ solve
        away = design_matrix(places, extent, order) @ solve
        return float((at_stars**2 @ variance).mean()), float((away**2 @ variance).mean())


def _sample(
    experiment: Experiment, case: Case, ccds: Sequence[StudyCcd], seen: Sequence[SeenStars], models: Sequence[PsfModel]
) -> _Sample:
    """Look at the residuals of all CCDs."""
    residuals: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    fields: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    law = np.full((len(ccds), 2), np.nan)
    for i, (ccd, stars, whole) in enumerate(zip(ccds, seen, models, strict=True)):
        model = whole.truncated(min(case.components, whole.n_components)) if case.basis == "pca" else whole
        used = _chosen(case, stars)
        exposure, places = ccd.exposure, ccd.exposure.places
        jobs = (
            (
                places.observed[used],
                Shapes(*(v[used] for v in vars(stars.seen.shapes).values())),
                exposure.observed,
                used,
            ),
            (places.truth, ccd.truth, exposure.truth, np.ones(len(places.truth), dtype=bool)),
        )
        for k, (at, shapes, exposed, chosen) in enumerate(jobs):
            found = measure_shapes(model.at(at), exposed.pixel_scale, experiment.weight_fwhm)
            if not found.usable.any():
                raise DomainError(f"CCD {exposure.name}: the model has no shape anywhere")
            residuals[k].append(np.stack([shapes.e1 - found.e1, shapes.e2 - found.e2, shapes.size / found.size - 1.0]))
            fields[k].append(exposed.fields[chosen])
        if case.interpolation != "gp":
            law[i] = noise_law(
                places.observed[used], places.truth, stars.variance[used], model.weights, case.order, model.extent
            )
    correlated = [_correlations(*pair) for pair in zip(fields, residuals, strict=True)]
    return _Sample(
        square=np.stack(
            [[[np.nanmean(r[:2] ** 2), np.nanmean(r[2] ** 2)] for r in kind] for kind in residuals], axis=1
        ),
        mean=np.stack([[np.nanmean(r[:2], axis=1) for r in kind] for kind in residuals], axis=1),
        law=law,
        xi=np.stack([c[0] for c in correlated]),
        xi_left=np.stack([c[1] for c in correlated]),
        lost=sum(int(np.isnan(r[0]).sum()) for r in residuals[1]),
    )


def _correlations(fields: list[np.ndarray], residuals: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return xi+ of residuals below and beyond 10', [2], and without each CCD, [n_ccd, 2]; NaN of one CCD."""
    if len(fields) < 2:
        return np.full(2, np.nan), np.full((1, 2), np.nan)
    x, y = np.concatenate(fields).T
    e = np.concatenate(residuals, axis=1)[:2]
    patch = np.repeat(np.arange(len(fields)), [len(f) for f in fields])
    found = shear_correlation(x, y, *e, **_BINS, patch=patch)
    return found.xi_plus, found.leave_one_out_plus


def _figures(samples: Sequence[_Sample]) -> dict[str, float]:
    """Return the figures of a case from its draws."""
    square, mean, law, xi, left = (
        np.stack([getattr(s, key) for s in samples]) for key in ("square", "mean", "law", "xi", "xi_left")
    )
    result: dict[str, float] = {}

    def root(name: str, squares: np.ndarray) -> None:
        # Of mean squares [n_draw, n_ccd]: the draws of a CCD share its PSF, so that the CCDs give the error.
        each = squares.mean(axis=0)
        result[name] = value = float(np.sqrt(each.mean()))
        error = each.std(ddof=1) / np.sqrt(len(each)) if len(each) > 1 else np.nan
        result[f"error_{name}"] = float(0.5 * error / value) if value > 0.0 else np.nan

    for k, kind in enumerate(KINDS):
        root(f"rms_e_{kind}", square[:, :, k, 0])
        root(f"rms_size_{kind}", square[:, :, k, 1])
        root(f"mean_e_{kind}", (mean[:, :, k] ** 2).mean(axis=-1))
        result[f"noise_law_{kind}"] = float(np.sqrt(law[:, :, k].mean()))
        for b, name in enumerate(RANGES):
            result[f"xi_plus_{kind}_{name}"] = float(xi[:, k, b].mean())
            result[f"error_xi_plus_{kind}_{name}"] = float(jackknife_error(left[:, k, :, b].mean(axis=0)))
    result["lost"] = float(sum(s.lost for s in samples))
    return result
