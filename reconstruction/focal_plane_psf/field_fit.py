"""Fit of the covariances and, with a telescope, of heights and alignment, to the stars of an exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.errors import DomainError
from ...core.progress import Reporter
from ...core.threads import one_blas_thread
from ...models.camera.camera import Camera
from ...models.camera.cameras import load_camera
from ...models.camera.focal_plane import FocalPlane
from ...models.camera.height_budget import BudgetName, HeightBudget
from ...models.telescope import Telescope
from .consistent_stars import LEAST_STARS, fit_statistics
from .field import ShapeField
from .fit import SHAPES, ExposureFit, ShapeData, Turbulence
from .heights import HeightPrior
from .likelihood import log_likelihood
from .mosaic import Mosaic
from .optics_part import OpticsPart
from .response import Instrument
from .stars import FocalPlaneStars
from .static_heights import StaticHeights

# Steps of the covariance without optics, of which only the likelihood is used where there is a telescope.
_ROUGH = 12


@dataclass(frozen=True, eq=False)
class FittedField:
    """A field, and how the fit went.

    Attributes
    ----------
    field : ShapeField
        The field.
    consistent : ndarray of bool, shape [n]
        Stars that the others do not contradict, those of the field.
    evidence : float
        Logarithm of the likelihood with the telescope over that without; NaN without a telescope.
    at_bounds : tuple of str
        Hyperparameters that ended on a bound.
    """

    field: ShapeField
    consistent: np.ndarray
    evidence: float
    at_bounds: tuple[str, ...]


def fit_field(
    mosaic: Mosaic,
    data: ShapeData,
    instrument: Instrument | None,
    prior: HeightPrior | None,
    alignment_rms: float,
    turbulence: Turbulence,
    threads: int | None,
    reporter: Reporter,
) -> FittedField:
    """Fit covariances and, with an instrument and a prior of the heights, heights and alignment."""
    with reporter.stage("covariance without optics"):
        statistics, consistent = fit_statistics(mosaic, data, 30 if instrument is None else _ROUGH, threads)
        data = data.chosen(consistent)
    if instrument is None or prior is None:
        bounds = tuple(f"{n} of {SHAPES[i]}" for i, fit in enumerate(statistics) for n in fit.at_bounds)
        field = ShapeField(mosaic, data, data.values, tuple(s.covariance for s in statistics))
        return FittedField(field, consistent, np.nan, bounds)
    fit = ExposureFit(data, instrument, prior, alignment_rms, threads, reporter)
    solution = fit.run(turbulence)
    with one_blas_thread():
        evidence = fit.log_evidence() - sum(
            log_likelihood(s.covariance, data.places, data.values[:, i : i + 1], data.noise[:, i : i + 1], fit.blocks)
            for i, s in enumerate(statistics)
        )
    data = fit.data
    slopes, columns = fit.derivatives()
    covariance = solution.covariance.astype(np.float32)
    optics = OpticsPart(
        instrument, solution.plane, solution.aberration, solution.seeing, prior, covariance, fit.response
    )
    residuals = data.values - optics.shapes(data.places, threads)
    design = optics.design_of(data.places, slopes, columns)
    field = ShapeField(mosaic, data, residuals, tuple(fit.covariances), optics, design)
    return FittedField(field, consistent, evidence, fit.at_bounds)


def mosaic_of(
    stars: FocalPlaneStars,
    telescope: Telescope | Instrument | None,
    focal_plane: FocalPlane | StaticHeights | None,
    camera: str | Camera | None,
) -> Mosaic:
    """Return the CCDs of the camera, or where there is none those of the stars."""
    if isinstance(telescope, Instrument):
        telescope = telescope.telescope
    if camera is None and focal_plane is not None:
        camera = focal_plane.camera
    if camera is None and telescope is not None:
        camera = telescope.camera
    if camera is not None:
        return Mosaic.of_camera(load_camera(camera))
    if telescope is not None:
        raise DomainError(f"camera: {telescope.name} names none, expected one with the heights of its CCDs")
    usable = stars.usable
    if stars.pixels:
        raise DomainError("x, y in pixels: expected a camera, or positions on the detector in metres")
    names = [n for n, good in zip(stars.ccd, usable, strict=True) if good]
    if not names:
        raise DomainError(f"0 of {len(stars)} stars have position, shape and noise: expected {LEAST_STARS} or more")
    return Mosaic.of_stars(names, np.stack([stars.x, stars.y], axis=1)[usable])


def height_prior(
    mosaic: Mosaic, plane: FocalPlane | StaticHeights | None, budget: BudgetName | HeightBudget | None
) -> HeightPrior:
    """Return the prior of heights that are known, learnt from other exposures, drawn from a budget, or free."""
    assert mosaic.camera is not None
    if isinstance(plane, StaticHeights):
        return plane.prior()
    if plane is not None:
        return HeightPrior.known(plane)
    return (
        HeightPrior.uninformative(mosaic.camera) if budget is None else HeightPrior.from_budget(mosaic.camera, budget)
    )
