"""Pictures of the report of a run, half of them drawn by a second process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from ...core.page import Picture
from ...core.second_process import Submit
from ...measure.correlation import Correlation
from ...reconstruction.ccd_product import CCD_KINDS, CcdProduct, CcdStars
from ..experiment import Experiment
from ..resolved_values import noise_free_components
from ..summary import CORRELATED, has_focal_plane_model
from .focal_plane_plots import close_up_plot, heights_plot, whiskers_plot
from .psf_plots import eigen_psf_plot, spectrum_plot, stamps_plot
from .statistics_plots import correlation_plot, models_plot, scatter_plot

#: Function that draws a plot.
Plot = Callable[[], bytes]
_Stars = TypeVar("_Stars", bound=CcdStars)
#: More CCDs than this are shown by their closest to the axis, their middle and their farthest one.
_CLOSE_UPS = 3

#: Where the heights come from: none, measured ones or a budget.
_HEIGHTS = {
    "none": "All are zero: this camera has no budget of heights, or flat ones are chosen.",
    "measured": "They are measured ones.",
    "budget": "Steps between CCDs and rafts, tilts and the ripple within a CCD (the potato chip) come from the height "
    "budget, each term from its own random stream.",
}


@dataclass(frozen=True)
class _PendingPicture:
    """Picture of the report that is not drawn yet."""

    title: str
    draw: Plot
    shows: str
    of_paper: str = ""  #: content of the paper's figure
    apart: bool = False  #: drawn by the second process
    wanted: bool = True


def draw_pictures(
    experiment: Experiment,
    products: Sequence[CcdProduct],
    correlated: dict[str, Correlation],
    correlated_g: dict[str, Correlation],
    submit: Submit,
) -> list[Picture]:
    """Return the pictures of a run in the order of the report; no byte depends on where they are drawn.

    Correlations are those of the weighted e, and of g of the adaptive moments.
    """
    config, plane = experiment.config, experiment.focal_plane
    flat_plane = plane.terms == () and not (plane.measured.any() or plane.polynomial.any())
    heights = "none" if flat_plane else "measured" if config.focal_plane.heights is not None else "budget"
    # The paper's figures are the LSST's.
    paper = experiment.camera.name == "lsst"
    optics, focal_plane_model = not config.atmosphere.enabled, has_focal_plane_model(products)
    # Stars of few coarse pixels have no adaptive moments.
    of_models = correlated_g if {"residual", "away", *CCD_KINDS} <= correlated_g.keys() else correlated
    recipe, radius = config.reconstruction.psf_recipe(), experiment.field_radius_on_detector
    # Without images and models, stars are soon sent to another process.
    stars, close = [p.ccd_stars for p in products], closest_middle_farthest(products)
    components = noise_free_components(config)
    jackknife = all(c.n_patches for c in correlated.values())
    errors = (
        "by jackknife over the CCDs"
        if jackknife
        else "from the scatter of the ellipticities alone, and too small: there are too few CCDs for a jackknife"
    )
    unweighted = recipe.weights == "equal" and not recipe.interpolation.needs_noise
    at_stars = (
        "Residuals at the stars of a CCD sum to zero by construction, so their correlation between CCDs cancels "
        "whatever the error of the model is"
        if unweighted and not focal_plane_model
        else "Residuals at the stars hold the noise of each star, some of which the model has followed"
    )
    planned = [
        _PendingPicture(
            "Focal plane",
            partial(heights_plot, plane, [p.name for p in products], radius),
            f"Height of every CCD surface over the nominal focal plane, positive towards the sky. {_HEIGHTS[heights]} "
            "The same surface as a mesh: focal_plane.glb.",
            "Fig. 7 shows one realisation of "
            + ("the same budget" if heights == "budget" else "a budget")
            + " (Table 1), ±10 µm in all.",
            apart=True,
        ),
        _PendingPicture(
            "Whiskers over the field",
            partial(whiskers_plot, stars, plane, radius),
            "Each whisker is one star: its length is |e| = (a-b)/(a+b) of the weighted moments, its direction that "
            "of the elongation. All "
            "panels share one scale, given by the key above their right corner, so lengths can be compared. "
            + (
                ""
                if flat_plane
                else "The pattern follows the heights behind it: whiskers jump where the CCD border is a step. "
            )
            + "Residuals at the stars hold the noise of each star itself.",
            "Fig. 8 (optics alone): |e| above 10 % in most places and near 30 % at the edge of the field, jumping at "
            "CCD borders."
            if optics
            else "Fig. 11 (observed) and Fig. 12 (residual): the pattern of the optics alone (Fig. 8), made rounder by "
            "the atmosphere, and residuals without visible pattern. The paper compares with the observed stars only.",
            apart=True,
        ),
        _PendingPicture(
            "Whiskers close up",
            partial(close_up_plot, closest_middle_farthest(stars), plane),
            "The CCD closest to the axis, one half-way out and the farthest one. The last column is the error "
            "for galaxies: that of the model at places where there was no star to fit.",
            "The paper notes a small-scale variation even within a CCD, from tilt and potato chip, and so fits "
            "polynomials CCD by CCD.",
            apart=True,
        ),
        _PendingPicture(
            "Eigen-PSFs of the noise-free PSFs",
            partial(eigen_psf_plot, close[0], noise_free=True),
            f"Mean PSF of one CCD and its first {min(components, 20)} principal components, each with the part of the "
            "variance along it. Order and signs are fixed, so that runs can be compared.",
            "Fig. 9: components of 4000 PSFs of the atmosphere alone. The first resemble shapelets; structure gets "
            "finer with n.",
        ),
        _PendingPicture(
            "Eigen-PSFs of the observed stars",
            partial(eigen_psf_plot, close[0], noise_free=False),
            "The same CCD, from the stars that were observed: components beyond the first few are noise.",
            "The paper keeps 20 components for observed stars too.",
            # Single pixels and shapelets look the same whatever the stars are.
            wanted=recipe.basis.ordered,
        ),
        _PendingPicture(
            "Number of components needed",
            partial(spectrum_plot, products),
            "Eigenvalues of every CCD, and the part of the variance that components beyond n hold. Where the "
            "eigenvalues of the observed stars bend away from those of the noise-free PSFs, noise takes over; the dot "
            "is the elbow, the point farthest below the straight line from the first eigenvalue to the last.",
            "The paper finds it by eye and that about 20 components suffice; they should hold over 99 % "
            "of the variance of the noise-free PSFs.",
        ),
        _PendingPicture(
            "Ellipticity before and after",
            partial(scatter_plot, stars),
            "Weighted e. Left, as in Jee & Tyson (2011): ellipticity of the observed stars, and what is left when "
            "the model is subtracted. Right: the same for the noise-free PSFs at places where no star was fitted.",
            "Fig. 13: residuals (red) far more compact than observed stars (blue), centred on zero.",
        ),
        _PendingPicture(
            "Correlation of g",
            partial(
                correlation_plot,
                {k: correlated_g[k] for k in CORRELATED if k in correlated_g},
                False,
                "g of adaptive moments",
            ),
            "Of g = (a - b)/(a + b) of adaptive moments, as DES, HSC and Rubin define it, and as requirements on "
            "shear are meant: ξ+ and ξ- by TreeCorr; filled symbols are positive, open ones negative. Error bars are "
            f"{errors}, cut off where they would pass zero. Triangles, away from the stars, apply to galaxies.",
            apart=True,
            wanted=bool(correlated_g),
        ),
        _PendingPicture(
            "Correlation of the weighted e",
            partial(correlation_plot, {k: correlated[k] for k in CORRELATED}, paper),
            "The same of the weighted e, as in Jee & Tyson (2011), about a quarter of that of g: ξ+ and ξ- by "
            "TreeCorr; filled symbols are positive, open ones negative. Error bars are "
            f"{errors}, cut off where they would pass zero. {at_stars}; "
            "triangles, away from the stars, apply to galaxies. Where the CCDs lie in a row, long pairs all point "
            "along it, and an ellipticity common to the field does not average out of ξ-.",
            "Fig. 14: ξ+ of about 3e-5 before, about 1e-8 after the correction (189 CCDs, at the stars only), below "
            "1e-7 from 10 arcmin to 3 degrees; ξ- similar.",
        ),
        _PendingPicture(
            "Stars",
            partial(stamps_plot, close),
            "Observed stamps from the brightest to the faintest star of three CCDs, the model at their places, and "
            "the difference in units of each pixel's noise: where the model is right to within the star's own noise, "
            "only that noise is left. A bright star can show more: the noise of fainter stars is in the model."
            + (
                " The model here is the CCD's own: that of the focal plane has shapes only."
                if focal_plane_model
                else ""
            ),
        ),
        _PendingPicture(
            "Residuals of both models",
            partial(models_plot, of_models),
            f"ξ+ of {'g' if of_models is correlated_g else 'the weighted e'}, of the residuals of the two models, "
            "fitted to the same stars: of the whole focal plane, which all other plots show, and CCD by CCD. Filled "
            "symbols are positive, open ones negative."
            + (
                " Residuals at the stars sum to zero over each CCD where it has a model of its own, so their "
                "correlation between CCDs cancels whatever the error of that model is."
                if unweighted
                else ""
            ),
            wanted=focal_plane_model,
        ),
    ]
    planned = [plot for plot in planned if plot.wanted]
    elsewhere = submit(_draw_all, [p.draw for p in planned if p.apart])
    local_pngs = iter(_draw_all([p.draw for p in planned if not p.apart]))
    remote_pngs = iter(elsewhere())
    return [
        Picture(p.title, next(remote_pngs if p.apart else local_pngs), p.shows, p.of_paper if paper else "")
        for p in planned
    ]


def _draw_all(plots: Sequence[Plot]) -> list[bytes]:
    return [plot() for plot in plots]


def closest_middle_farthest(products: Sequence[_Stars]) -> list[_Stars]:
    """Return the CCD closest to the axis, the middle one and the farthest, or all where there are no more."""
    ordered = sorted(products, key=lambda p: (round(float(np.hypot(*p.center)), 9), p.name))
    if len(ordered) <= _CLOSE_UPS:
        return ordered
    return [ordered[0], ordered[len(ordered) // 2], ordered[-1]]
