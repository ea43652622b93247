"""Residuals of PSF models at the stars and at holdout positions, and their metrics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...core.errors import DomainError
from ...core.statistics import finite_mean
from ...core.threads import one_blas_thread
from ...core.units import ARCMIN
from ...measure.adaptive_moments import AdaptiveMoments
from ...measure.correlation import FEWEST_PATCHES, SEPARATION_RANGES, SeparationBins, jackknife_error, shear_correlation
from ...measure.rho_statistics import trace_of_moments
from ...measure.shapes import Shapes, measure_shapes
from ...pipeline.experiment import Experiment
from ...reconstruction.focal_plane_psf.adaptive_shapes import AdaptiveShapes
from ...reconstruction.focal_plane_psf.model import FocalPlanePsf
from ...reconstruction.focal_plane_psf.mosaic import PsfShapes
from ...reconstruction.psf_model.model import PsfModel
from ...reconstruction.psf_model.polynomial import Extent, design_matrix
from .plan import POLYNOMIALS, Case
from .stars import ObservedCcd, SimulatedCcd, star_moments, used_stars

#: Residuals: observed - model at the stars, and noise-free PSF - model at the holdout positions.
KINDS = ("at_stars", "away")
#: Rows of the residuals of a CCD: weighted e1 and e2.
_E = slice(0, 2)
#: Row of the relative weighted size.
_SIZE = 2
#: Rows of g1 and g2 of adaptive moments.
_G = slice(3, 5)
#: Row of dT/T of adaptive moments.
_DT = 5
# Two bins of equal width in the logarithm: 0.56' to 10', and 10' to 180'.
_LOW, _HIGH = SEPARATION_RANGES["long"]
_BINS = SeparationBins(_LOW**2 / _HIGH * ARCMIN, _HIGH * ARCMIN, 2)


@dataclass(frozen=True)
class Residuals:
    """Residuals of one case and one draw of the noise, for each of :data:`KINDS`."""

    square: np.ndarray  #: [n_ccd, kind, 4] mean squares of one component of e, of the relative size, of g, of dT/T
    mean: np.ndarray  #: [n_ccd, kind, 4] means of e1, e2, g1 and g2
    law: np.ndarray  #: [n_ccd, kind, 2] mean squares of e and of g by :func:`noise_law`
    xi: np.ndarray  #: [kind, 2, 2] xi+ of e and of g, of short and long separations, of all CCDs
    xi_left: np.ndarray  #: [kind, 2, n_ccd, 2] the same without each CCD
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
    lost = 0
    law = np.full((len(ccds), 2, 2), np.nan)
    for i, (ccd, stars, model) in enumerate(zip(ccds, observed, models, strict=True)):
        if isinstance(model, PsfModel) and model.basis.kind.ordered:
            model = model.truncated(min(case.components, model.n_components))
        used = used_stars(case, stars)
        exposure, places = ccd.exposure, ccd.exposure.positions
        jobs = (
            (
                places.observed[used],
                Shapes(*(v[used] for v in vars(stars.observation.shapes).values())),
                stars.moments,
                exposure.observed,
                used,
            ),
            (
                places.holdout,
                ccd.holdout,
                ccd.holdout_moments,
                exposure.holdout,
                np.ones(len(places.holdout), dtype=bool),
            ),
        )
        for k, (at, shapes, moments, exposed, star_mask) in enumerate(jobs):
            model_shapes: Shapes | PsfShapes
            model_moments: AdaptiveMoments | AdaptiveShapes
            if isinstance(model, PsfModel):
                images = model.at(at)
                model_shapes = measure_shapes(images, exposed.pixel_scale, experiment.weight_fwhm)
                model_moments = star_moments(images, exposed.pixel_scale, threads)
            else:
                model_shapes = model.shapes(exposure.name, *at.T, threads=threads)
                model_moments = model.adaptive_shapes(model_shapes)
            if not np.isfinite(model_shapes.e1).any():
                raise DomainError(f"CCD {exposure.name}: the model has no shape anywhere")
            trace, model_trace = (trace_of_moments(m.sigma, m.g1, m.g2) for m in (moments, model_moments))
            residuals[k].append(
                np.stack(
                    [
                        shapes.e1 - model_shapes.e1,
                        shapes.e2 - model_shapes.e2,
                        shapes.size / model_shapes.size - 1.0,
                        moments.g1[star_mask] - model_moments.g1,
                        moments.g2[star_mask] - model_moments.g2,
                        1.0 - model_trace / trace[star_mask],
                    ]
                )
            )
            fields[k].append(exposed.fields[star_mask])
            if k == 1:
                lost += int((np.isnan(model_shapes.e1) | (np.isnan(model_moments.g1) & moments.usable)).sum())
        if isinstance(model, PsfModel) and case.interpolation in POLYNOMIALS:
            laws = (
                noise_law(places.observed[used], places.holdout, v[used], model.weights, case.order, model.extent)
                for v in (stars.variance, stars.variance_g)
            )
            law[i] = np.transpose([*laws])
    correlated = [
        [residual_correlations(field, [r[rows] for r in kind]) for rows in (_E, _G)]
        for field, kind in zip(fields, residuals, strict=True)
    ]
    return Residuals(
        square=np.stack(
            [[[finite_mean(r[rows] ** 2) for rows in (_E, _SIZE, _G, _DT)] for r in kind] for kind in residuals],
            axis=1,
        ),
        mean=np.stack([[[finite_mean(v) for v in (*r[_E], *r[_G])] for r in kind] for kind in residuals], axis=1),
        law=law,
        xi=np.array([[c[0] for c in kind] for kind in correlated]),
        xi_left=np.array([[c[1] for c in kind] for kind in correlated]),
        lost=lost,
    )


def residual_correlations(fields: list[np.ndarray], residuals: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return xi+ of residuals below and beyond 10', [2], and without each CCD, [n_ccd, 2].

    NaN of one CCD, and where a CCD has no residual: images narrower than a pixel have no adaptive moments.
    """
    if len(fields) < 2 or not all(np.isfinite(r).all(axis=0).any() for r in residuals):
        return np.full(2, np.nan), np.full((len(fields), 2), np.nan)
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
        enough = len(ccd_squares) >= FEWEST_PATCHES
        error = ccd_squares.std(ddof=1) / np.sqrt(len(ccd_squares)) if enough else np.nan
        result[f"error_{name}"] = float(0.5 * error / value) if value > 0.0 else np.nan

    for k, kind in enumerate(KINDS):
        root(f"rms_g_{kind}", square[:, :, k, 2])
        root(f"rms_dt_g_{kind}", square[:, :, k, 3])
        root(f"mean_g_{kind}", (mean[:, :, k, 2:] ** 2).mean(axis=-1))
        root(f"rms_e_{kind}", square[:, :, k, 0])
        root(f"rms_size_{kind}", square[:, :, k, 1])
        root(f"mean_e_{kind}", (mean[:, :, k, :2] ** 2).mean(axis=-1))
        for m, prefix in ((1, "g_"), (0, "")):
            result[f"noise_law_{prefix}{kind}"] = float(np.sqrt(law[:, :, k, m].mean()))
            for b, name in enumerate(SEPARATION_RANGES):
                result[f"xi_plus_{prefix}{kind}_{name}"] = float(xi[:, k, m, b].mean())
                without_ccd = xi_without[:, k, m, :, b].mean(axis=0)
                error = float(jackknife_error(without_ccd)) if len(without_ccd) >= FEWEST_PATCHES else np.nan
                result[f"error_xi_plus_{prefix}{kind}_{name}"] = error
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
