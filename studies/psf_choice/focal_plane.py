"""Focal-plane models of the study of PSF models: one for the noisy stars of all CCDs together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...pipeline.experiment import Experiment
from ...pipeline.focal_plane_psf.model import FocalPlanePsf
from ...pipeline.focal_plane_stage import fit_focal_plane_model
from .plan import Case
from .stars import ObservedCcd, SimulatedCcd, used_stars

# Electrons of a star without noise: with them the stated noise of e is 5e-5, to which the fitted optics are right.
_ELECTRONS = 1e8


@dataclass(frozen=True)
class _Stars:
    """Stars of a CCD as the product of a run has them."""

    x: np.ndarray
    y: np.ndarray
    e1: np.ndarray
    e2: np.ndarray
    size: np.ndarray
    electrons: np.ndarray
    used: np.ndarray


@dataclass(frozen=True)
class _Product:
    """Part of the product of a CCD to which a focal-plane model is fitted."""

    name: str
    pixel_scale: float
    noise: tuple[float, float]
    observed: _Stars
    observed_images: np.ndarray


def fit_focal_plane(
    case: Case,
    experiment: Experiment,
    ccds: Sequence[SimulatedCcd],
    observed: Sequence[ObservedCcd],
    threads: int | None = None,
) -> FocalPlanePsf:
    """Fit the focal-plane model of a case to the first stars of each CCD, all CCDs together."""
    products = [_product(case, *pair) for pair in zip(ccds, observed, strict=True)]
    return fit_focal_plane_model(experiment, products, telescope=case.interpolation == "focal_plane", threads=threads)


def _product(case: Case, ccd: SimulatedCcd, observed: ObservedCcd) -> _Product:
    exposure, found = ccd.exposure, observed.observation
    x, y = exposure.positions.observed.T
    stars = _Stars(
        x,
        y,
        found.shapes.e1,
        found.shapes.e2,
        found.shapes.size,
        np.minimum(observed.electrons, _ELECTRONS),
        used_stars(case, observed),
    )
    return _Product(exposure.name, exposure.observed.pixel_scale, found.noise, stars, found.images)
