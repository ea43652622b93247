"""Residuals of PSF models at the stars and at holdout positions, and their metrics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...core.errors import DomainError
from ...core.threads import one_blas_thread
from ...core.units import ARCMIN
from ...measure.correlation import SEPARATION_RANGES, SeparationBins, jackknife_error, shear_correlation
from ...measure.shapes import Shapes, measure_shapes
from ...pipeline.experiment import Experiment
from ...reconstruction.focal_plane_psf.model import FocalPlanePsf
from ...reconstruction.focal_plane_psf.mosaic import PsfShapes
from ...reconstruction.psf_model.model import PsfModel
from ...reconstruction.psf_model.polynomial import Extent, design_matrix
from .plan import POLYNOMIALS, Case
from .stars import ObservedCcd, SimulatedCcd, used_stars

#: Residuals: observed - model at the stars, and noise-free PSF - model at the holdout positions.
KINDS = ("at_stars", "away")
# Two bins of equal width in the logarithm: 0.56' to 10', and 10' to 180'.
_LOW, _HIGH = SEPARATION_RANGES["long"]
_BINS = SeparationBins(_LOW**2 / _HIGH * ARCMIN, _HIGH * ARCMIN, 2)


@dataclass(frozen=True)
class Residuals:
    """Residuals of one case and one draw of the noise, for each of :data:`KINDS`."""

    square: np.ndarray  #: [n_ccd, kind, 2] mean squares of one component of e, and of the relative size
    mean: np.ndarray  #: [n_ccd, kind, 2] means of e1 and e2
    law: np.ndarray  #: [n_ccd, kind] mean squares of e by :func:`noise_law`
    xi: np.ndarray  #: [kind, 2] xi+ of short and long separations, of all CCDs
    xi_left: np.ndarray  #: [kind, n_ccd, 2] the same without each CCD
    lost: int  #: holdout positions at which the model has no shape


def measure_residuals(
    experiment: Experiment,
    case: Case,
    ccds: Sequence[SimulatedCcd],
    observed: Sequence[ObservedCcd],
    models: Sequence[PsfModel | FocalPlanePsf],
    threads: int | None = None,
) -> Residuals:
    """Measure the residuals of the models of all CCDs, one for each."""
    residuals: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    fields: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    law = np.full((len(ccds), 2), np.nan)
    for i, (ccd, stars, model) in enumerate(zip(ccds, observed, models, strict=True)):
        if isinstance(model, PsfModel) and model.basis.kind.ordered:
            model = model.truncated(min(case.components, model.n_components))
        used = used_stars(case, stars)
        exposure, places = ccd.exposure, ccd.exposure.positions
        jobs = (
            (
                places.observed[used],
                Shapes(*(v[used] for v in vars(stars.observation.shapes).values())),
                exposure.observed,
                used,
            ),
            (places.holdout, ccd.holdout, exposure.holdout, np.ones(len(places.holdout), dtype=bool)),
        )
        for k, (at, shapes, exposed, star_mask) in enumerate(jobs):
            model_shapes: Shapes | PsfShapes
            if isinstance(model, PsfModel):
                model_shapes = measure_shapes(model.at(at), exposed.pixel_scale, experiment.weight_fwhm)
            else:
                model_shapes = model.shapes(exposure.name, *at.T, threads=threads)
            if not np.isfinite(model_shapes.e1).any():
                raise DomainError(f"CCD {exposure.name}: the model has no shape anywhere")
            residuals[k].append(
                np.stack(
                    [shapes.e1 - model_shapes.e1, shapes.e2 - model_shapes.e2, shapes.size / model_shapes.size - 1.0]
                )
            )
            fields[k].append(exposed.fields[star_mask])
        if isinstance(model, PsfModel) and case.interpolation in POLYNOMIALS:
            law[i] = noise_law(
                places.observed[used], places.holdout, stars.variance[used], model.weights, case.order, model.extent
            )
    correlated = [residual_correlations(*pair) for pair in zip(fields, residuals, strict=True)]
    return Residuals(
        square=np.stack(
            [[[np.nanmean(r[:2] ** 2), np.nanmean(r[2] ** 2)] for r in kind] for kind in residuals], axis=1
        ),
        mean=np.stack([[np.nanmean(r[:2], axis=1) for r in kind] for kind in residuals], axis=1),
        law=law,
        xi=np.stack([c[0] for c in correlated]),
        xi_left=np.stack([c[1] for c in correlated]),
        lost=sum(int(np.isnan(r[0]).sum()) for r in residuals[1]),
    )


def residual_correlations(fields: list[np.ndarray], residuals: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return xi+ of residuals below and beyond 10', [2], and without each CCD, [n_ccd, 2]; NaN of one CCD."""
    if len(fields) < 2:
        return np.full(2, np.nan), np.full((1, 2), np.nan)
    x, y = np.concatenate(fields).T
    e = np.concatenate(residuals, axis=1)[:2]
    patch = np.repeat(np.arange(len(fields)), [len(f) for f in fields])
    correlation = shear_correlation(x, y, *e, bins=_BINS, patch=patch)
    return correlation.xi_plus, correlation.leave_one_out_plus


def case_metrics(samples: Sequence[Residuals]) -> dict[str, float]:
    """Return the metrics of a case from its draws; see :class:`~pachon.studies.psf_choice.study.Study`."""
    square, mean, law, xi, xi_without = (
        np.stack([getattr(s, key) for s in samples]) for key in ("square", "mean", "law", "xi", "xi_left")
    )
    result: dict[str, float] = {}

    def root(name: str, squares: np.ndarray) -> None:
        # Mean squares [n_draw, n_ccd]: the draws of a CCD share its PSF, so the CCDs give the error.
        ccd_squares = squares.mean(axis=0)
        result[name] = value = float(np.sqrt(ccd_squares.mean()))
        error = ccd_squares.std(ddof=1) / np.sqrt(len(ccd_squares)) if len(ccd_squares) > 1 else np.nan
        result[f"error_{name}"] = float(0.5 * error / value) if value > 0.0 else np.nan

    for k, kind in enumerate(KINDS):
        root(f"rms_e_{kind}", square[:, :, k, 0])
        root(f"rms_size_{kind}", square[:, :, k, 1])
        root(f"mean_e_{kind}", (mean[:, :, k] ** 2).mean(axis=-1))
        result[f"noise_law_{kind}"] = float(np.sqrt(law[:, :, k].mean()))
        for b, name in enumerate(SEPARATION_RANGES):
            result[f"xi_plus_{kind}_{name}"] = float(xi[:, k, b].mean())
            result[f"error_xi_plus_{kind}_{name}"] = float(jackknife_error(xi_without[:, k, :, b].mean(axis=0)))
    result["lost"] = float(sum(s.lost for s in samples))
    return result


def noise_law(
    stars: np.ndarray, places: np.ndarray, variance: np.ndarray, weights: np.ndarray | None, order: int, extent: Extent
) -> tuple[float, float]:
    r"""Return the mean square residual of a polynomial fit by noise, at its stars and elsewhere.

    With the terms t at a position, T at the stars and weights W, the fit to values y is a y with
    a = t (T' W T)^-1 T' W. Independent noise causes the mean square :math:`\sum_j a_j^2 \sigma_j^2` there, and
    :math:`\sum_j (\delta_{ij} - a_j)^2 \sigma_j^2` of observed - model at star i. For equal noise and weights the mean
    of the latter is exactly 1 - p/n of the noise for p terms and n stars. Model - noise-free PSF has p/n at the stars,
    and about that elsewhere, more in gaps between the stars.

    Shapes: `stars` [n, 2], `places` elsewhere [m, 2], `variance` of the noise and `weights` [n].
    """
    root = np.ones(len(stars)) if weights is None else np.sqrt(weights)
    terms = design_matrix(stars, extent, order)
    with one_blas_thread():
        solve = np.linalg.pinv(terms * root[:, None]) * root
        at_stars = np.eye(len(stars)) - terms @ solve
        holdout = design_matrix(places, extent, order) @ solve
        return float((at_stars**2 @ variance).mean()), float((holdout**2 @ variance).mean())
