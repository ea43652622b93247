"""Second stage of a run: a PSF model of the whole focal plane in place of the CCDs' own models.

It reads measured shapes alone, never what a model says, so that it can be repeated: after a run was stopped, or with
more CCDs, it leaves what one uninterrupted run leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..core.products import Stamp, read_fits, write_hdus
from ..core.progress import Reporter
from .ccd_product import CcdProduct, Stars, of_ccd_model, write_focal_plane_columns
from .experiment import Experiment
from .focal_plane_psf.model import FocalPlanePsf
from .focal_plane_psf.stars import FocalPlaneStars

#: Name of the focal-plane model in the folder of a run.
FOCAL_PLANE_PSF_NAME = "focal_plane_psf.fits"
_StarsKind = TypeVar("_StarsKind", bound=Stars)


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
    # Stars of an ideal telescope are no reason to fit one.
    model = fit_focal_plane_model(
        experiment, products, telescope=not experiment.atmosphere_only, threads=threads, reporter=reporter
    )
    left_out, first, applied = model.leave_one_out, 0, []
    total = sum(len(p.observed) + len(p.holdout) for p in products)
    with reporter.stage("focal-plane PSF model on the CCDs", total=total) as stage:
        for product in products:
            observed = _with_model(product.name, product.observed, model, threads)
            holdout = _with_model(product.name, product.holdout, model, threads)
            used = observed.used
            own = slice(first, first + int(used.sum()))
            e1, e2 = np.full((2, len(used)), np.nan)
            e1[used], e2[used] = left_out.e1[own], left_out.e2[own]
            observed = replace(observed, leave_one_out_e1=e1, leave_one_out_e2=e2)
            applied.append(replace(product, observed=observed, holdout=holdout))
            first = own.stop
            stage.advance(len(observed) + len(holdout))
    return applied, model


def fit_focal_plane_model(
    experiment: Experiment,
    products: Sequence[Any],
    *,
    telescope: bool,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> FocalPlanePsf:
    """Fit one model to the used stars of all CCDs.

    Parameters
    ----------
    experiment : Experiment
        Telescope, camera and atmosphere of the products.
    products : sequence of CcdProduct
        Products, or objects with the name, noise, pixel scale, observed stars and stamps of products.
    telescope : bool
        Whether the model has the telescope of the experiment, or is of turbulence and CCDs alone.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    reporter : Reporter, optional
        Progress display; silent by default.

    Raises
    ------
    DomainError
        If there are too few stars.
    """
    if telescope:
        return FocalPlanePsf.fit_run(experiment, products, threads=threads, reporter=reporter)
    stars = FocalPlaneStars.from_products(products, experiment.weight_fwhm)
    names = [product.name for product in products]
    return FocalPlanePsf.fit(stars, camera=experiment.camera, ccds=names, threads=threads, reporter=reporter)


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
    own = of_ccd_model(stars)
    shapes, sigma = model.predict(name, stars.x, stars.y, threads=threads)
    return replace(
        stars,
        model_e1=shapes.e1,
        model_e2=shapes.e2,
        model_size=shapes.size,
        ccd_e1=own.model_e1,
        ccd_e2=own.model_e2,
        ccd_size=own.model_size,
        sigma_e1=sigma.e1,
        sigma_e2=sigma.e2,
        sigma_size=sigma.size,
    )
