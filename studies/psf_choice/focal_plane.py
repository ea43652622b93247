"""Focal-plane models of the study of PSF models: one for the noisy stars of all CCDs together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...pipeline.experiment import Experiment
from ...pipeline.focal_plane_stage import fit_focal_plane_model
from ...reconstruction.focal_plane_psf.model import FocalPlanePsf
from ...reconstruction.focal_plane_psf.stars import CcdStars, FocalPlaneStars
from .plan import Case
from .stars import ObservedCcd, SimulatedCcd, used_stars

# Electrons of a star without noise: with them the stated noise of e is 5e-5, to which the fitted optics are right.
_ELECTRONS = 1e8


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
