"""Second stage of a run: a PSF model of the whole focal plane in place of the CCDs' own models.

Its input is measured shapes alone, not those of any model, so that it can be repeated: after an interruption, or with
more CCDs, products are those of one uninterrupted run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..core.products import Stamp, read_fits, write_hdus
from ..core.progress import Reporter
from ..models.camera.focal_plane import FocalPlane
from ..reconstruction.ccd_product import CcdProduct, Stars, of_ccd_model, write_focal_plane_columns
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from ..reconstruction.focal_plane_psf.optics_prior import OpticsPrior
from ..reconstruction.focal_plane_psf.response import Instrument
from ..reconstruction.focal_plane_psf.stars import FocalPlaneStars
from ..reconstruction.focal_plane_psf.static_heights import StaticHeights
from ..wavefront.psf.light import Light
from ..wavefront.psf.stamps import Stamps
from .experiment import Experiment

#: Name of the focal-plane model in the folder of a run.
FOCAL_PLANE_PSF_NAME = "focal_plane_psf.fits"
_StarsKind = TypeVar("_StarsKind", bound=Stars)
# Mean wavefront of turbulence over an exposure of 15 s, common to all stars, rms [m].
_AIR_WAVEFRONT = 0.1e-6


def apply_focal_plane_model(
    experiment: Experiment,
    products: Sequence[CcdProduct],
    *,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> tuple[list[CcdProduct], FocalPlanePsf]:
    """Fit one model to the used stars of all CCDs, and put its shapes into the products.

    Parameters
    ----------
    experiment : Experiment
        Telescope, camera and atmosphere of the products.
    products : sequence of CcdProduct
        Products with the stamps of their observed stars. Those that have a focal-plane model already get the new one.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    reporter : Reporter, optional
        Progress display; silent by default.

    Returns
    -------
    products : list of CcdProduct
        Products whose ``model_``, ``leave_one_out_`` and ``sigma_`` are of the focal-plane model; ``ccd_`` has the
        shapes of the CCD's own model. All else is as it was.
    model : FocalPlanePsf
        The model.

    Raises
    ------
    DomainError
        If there are too few stars.
    """
    reporter = Reporter(quiet=True) if reporter is None else reporter
    # Stars of an ideal telescope have no optics to fit.
    model = fit_focal_plane_model(
        experiment,
        FocalPlaneStars.from_products(products, experiment.weight_fwhm),
        telescope=not experiment.atmosphere_only,
        ccds=[product.name for product in products],
        threads=threads,
        reporter=reporter,
    )
    left_out = model.leave_one_out
    adaptive = model.adaptive_shapes(left_out)
    left_out_values = np.stack([left_out.e1, left_out.e2, adaptive.g1, adaptive.g2, adaptive.sigma])
    first, applied = 0, []
    total = sum(len(p.observed) + len(p.holdout) for p in products)
    with reporter.stage("focal-plane PSF model on the CCDs", total=total) as stage:
        for product in products:
            observed = _with_model(product.name, product.observed, model, threads)
            holdout = _with_model(product.name, product.holdout, model, threads)
            used = observed.used
            ccd_rows = slice(first, first + int(used.sum()))
            columns = np.full((5, len(used)), np.nan)
            columns[:, used] = left_out_values[:, ccd_rows]
            names = (f"leave_one_out_{key}" for key in ("e1", "e2", "g1", "g2", "sigma"))
            observed = replace(observed, **dict(zip(names, columns, strict=True)))
            applied.append(replace(product, observed=observed, holdout=holdout))
            first = ccd_rows.stop
            stage.advance(len(observed) + len(holdout))
    return applied, model


def fit_focal_plane_model(
    experiment: Experiment,
    stars: FocalPlaneStars,
    heights: FocalPlane | StaticHeights | None = None,
    *,
    telescope: bool = True,
    components: int = 3,
    ccds: Sequence[str] | None = None,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> FocalPlanePsf:
    """Fit one model to stars of a run, with priors from its configuration.

    The size of the residual of the active optics is known, to which the air near the ground adds its mean over the
    exposure.

    Parameters
    ----------
    experiment : Experiment
        Telescope, camera and atmosphere of the stars.
    stars : FocalPlaneStars
        The stars.
    heights : FocalPlane or StaticHeights, optional
        Heights of the CCDs as far as they are known. By default their budget is known, but not their draw.
    telescope : bool
        Whether the model has the telescope of the experiment, or is of turbulence and CCDs alone.
    components : int
        Principal components of the residual stamps.
    ccds : sequence of str, optional
        CCDs that the model is for; those without stars are named in its warnings. By default all.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    reporter : Reporter, optional
        Progress display; silent by default.

    Raises
    ------
    DomainError
        If there are too few stars.
    """
    options: dict[str, Any] = {"camera": experiment.camera, "components": components, "ccds": ccds}
    options |= {"threads": threads, "reporter": reporter}
    if not telescope:
        return FocalPlanePsf.fit(stars, **options)
    focal = experiment.config.focal_plane
    if heights is None and focal.budget == "flat" and focal.heights is None and not focal.moved:
        heights = FocalPlane.flat(experiment.camera)
    residual = experiment.config.active_optics.residual_um * 1e-6
    prior = OpticsPrior(experiment.focal_plane.budget, float(np.hypot(residual, _AIR_WAVEFRONT)))
    options["turbulence"] = experiment.config.reconstruction.turbulence
    return FocalPlanePsf.fit(stars, instrument_of(experiment), heights, prior=prior, **options)


def instrument_of(experiment: Experiment) -> Instrument:
    """Return telescope, light, air and detector of an experiment, all but heights and alignment."""
    return Instrument.of(
        experiment.telescope,
        Light(experiment.wavelengths, dispersion=experiment.dispersion),
        experiment.atmosphere,
        stamps=Stamps(
            experiment.stamp_size,
            experiment.pixel_size,
            experiment.diffusion,
            experiment.jitter,
            experiment.silicon,
        ),
        weight_fwhm=experiment.weight_fwhm,
    )


def write_focal_plane_model(folder: Path, products: Sequence[CcdProduct], model: FocalPlanePsf, stamp: Stamp) -> None:
    """Write the model into the folder of a run, with the stamp of the run, and its shapes into the CCDs' products."""
    for product in products:
        write_focal_plane_columns(folder, product)
    path = folder / FOCAL_PLANE_PSF_NAME
    model.write(path)
    hdus = read_fits(path)
    for keyword, value, comment in stamp.cards():
        hdus[0].header[keyword] = (value, comment)
    write_hdus(path, hdus)


def _with_model(name: str, stars: _StarsKind, model: FocalPlanePsf, threads: int | None) -> _StarsKind:
    """Return stars of a CCD with the shapes that the model has there, and those of the CCD's own model."""
    ccd_columns = of_ccd_model(stars)
    shapes, sigma = model.predict(name, stars.x, stars.y, threads=threads)
    adaptive = model.adaptive_shapes(shapes)
    return replace(
        stars,
        model_e1=shapes.e1,
        model_e2=shapes.e2,
        model_size=shapes.size,
        model_g1=adaptive.g1,
        model_g2=adaptive.g2,
        model_sigma=adaptive.sigma,
        ccd_e1=ccd_columns.model_e1,
        ccd_e2=ccd_columns.model_e2,
        ccd_size=ccd_columns.model_size,
        ccd_g1=ccd_columns.model_g1,
        ccd_g2=ccd_columns.model_g2,
        ccd_sigma=ccd_columns.model_sigma,
        sigma_e1=sigma.e1,
        sigma_e2=sigma.e2,
        sigma_size=sigma.size,
    )
