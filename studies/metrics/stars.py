"""Metrics of the stars of a configuration: widths, ellipticities, correlations, PSF models.

Stars are noise-free, at positions that depend on the seed alone. Only the reconstruction models noisy stars, as a run
does.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from ...core.statistics import finite_mean, finite_median, rms
from ...core.units import ARCMIN, ARCSEC
from ...design.images.encircled_energy import energy_curve
from ...measure.correlation import SEPARATION_RANGES
from ...measure.shapes import fwhm
from ...pipeline.focal_plane_stage import apply_focal_plane_model
from ...pipeline.simulate.ccd_loop import simulate_ccds
from ...pipeline.simulate.ccd_model import model_ccds
from ...pipeline.simulate.photometry import effective_fwhm
from ...pipeline.summary import correlations, run_metrics
from ...reconstruction.ccd_product import MOMENTS
from ...reconstruction.psf_model.polynomial import design_matrix
from ...wavefront.opd import wavefront_opd
from ...wavefront.zernike import fit_zernikes
from .metric import THROUGHPUT, Metric, MetricTable
from .scene import Scene

#: Metrics of the stars on the CCDs of a configuration.
STARS: MetricTable[Scene] = MetricTable()
#: Rings of field angle of the mean ellipticity [deg].
_RINGS = ((0.0, 0.5), (0.5, 1.0), (1.0, 1.5), (1.5, 1.8))
#: Zernike terms of the wavefront, Noll.
_ZERNIKES = range(4, 12)
# CCDs are neighbours where their centres are no farther apart than this, over the side of a CCD.
_NEIGHBOUR = 1.15
# Order of the fit of ellipticity within a CCD, for its value at the border.
_BORDER_ORDER = 2

#: Ranges of separation, and kinds of residuals of ellipticity, in words.
_PAIRS = {
    name: f"{low:g} to {high:g} arcmin apart" if low > 0.0 else f"closer than {high:g} arcmin"
    for name, (low, high) in SEPARATION_RANGES.items()
}
_RESIDUALS = {
    "residual": "at the stars: observed - model",
    "away": "at holdout positions: noise-free - model",
}


@STARS.group(
    "fwhm",
    Metric(
        "effective_fwhm_arcsec",
        "arcsec",
        meaning="effective FWHM of the median star: that of the Gaussian with as many noise-equivalent pixels",
    ),
)
def width(scene: Scene) -> dict[str, float]:
    """Return the effective FWHM of the median star."""
    return {"effective_fwhm_arcsec": effective_fwhm(scene.stars.image, scene.stars.pixel_scale) / ARCSEC}


@STARS.group(
    "half_maximum",
    Metric("fwhm_arcsec", "arcsec", meaning="full width at half maximum, median of the stars, as runs have it"),
)
def width_at_half_maximum(scene: Scene) -> dict[str, float]:
    """Return the full width at half maximum, median of the stars."""
    return {"fwhm_arcsec": finite_median(fwhm(scene.stars.image, scene.stars.pixel_scale)) / ARCSEC}


@STARS.group(
    "adaptive",
    Metric("rms_g", meaning="rms of one component of g = (a-b)/(a+b) of adaptive moments of the noise-free stars"),
    Metric("mean_g", meaning="mean modulus of g of adaptive moments of the noise-free stars"),
    Metric(
        "median_distortion",
        meaning="median of |e| = (a^2-b^2)/(a^2+b^2) of adaptive moments, as in the LSST's requirements",
    ),
)
def adaptive_ellipticity(scene: Scene) -> dict[str, float]:
    """Return rms and mean of g, and the median of the distortion."""
    moments = scene.adaptive
    return {
        "rms_g": rms(np.stack([moments.g1, moments.g2])),
        "mean_g": finite_mean(np.hypot(moments.g1, moments.g2)),
        "median_distortion": finite_median(np.hypot(moments.e1, moments.e2)),
    }


@STARS.group(
    "rms_e",
    Metric("rms_e", meaning="rms of one component of the weighted e = (a-b)/(a+b) of the noise-free stars"),
    Metric("mean_e", meaning="mean modulus of the weighted e = (a-b)/(a+b) of the noise-free stars"),
)
def ellipticity(scene: Scene) -> dict[str, float]:
    """Return the rms of one component of e, and the mean modulus."""
    e = np.stack([scene.shapes.e1, scene.shapes.e2])
    return {"rms_e": float(np.sqrt(np.nanmean(e**2))), "mean_e": float(np.nanmean(np.hypot(*e)))}


@STARS.group(
    "e_rings",
    *(
        Metric(f"mean_e_{low:g}_to_{high:g}_deg", meaning=f"mean_e of the stars {low:g} to {high:g} deg from the axis")
        for low, high in _RINGS
    ),
)
def ellipticity_of_rings(scene: Scene) -> dict[str, float]:
    """Return the mean modulus of e in rings of field angle."""
    radius = np.rad2deg(np.hypot(*scene.stars.fields.T))
    size = np.hypot(scene.shapes.e1, scene.shapes.e2)
    metrics = {}
    for low, high in _RINGS:
        inside = size[(radius >= low) & (radius < high) & np.isfinite(size)]
        metrics[f"mean_e_{low:g}_to_{high:g}_deg"] = float(inside.mean()) if inside.size else np.nan
    return metrics


@STARS.group(
    "border_jump",
    Metric(
        "border_jump_e",
        meaning="rms jump of one component of e across borders between CCDs, from a quadratic fit within each",
    ),
)
def border_jump(scene: Scene) -> dict[str, float]:
    """Return the rms jump of one component of e across borders between neighbouring CCDs."""
    camera = scene.camera_experiment.camera
    ccds = [camera.ccd_index(name) for name in scene.ccds]
    centers = camera.centers[ccds]
    # In units of their sides CCDs are squares.
    sides = np.ptp(camera.corners(ccds), axis=1)
    near = cKDTree(centers / sides.min(axis=0)).query_pairs(_NEIGHBOUR)
    pairs = np.array(sorted(near)).reshape(-1, 2)
    if not len(pairs):
        return {"border_jump_e": np.nan}
    middles = centers[pairs].mean(axis=1)
    first = np.cumsum([0, *map(len, scene.positions)])
    # Ellipticity on either side of each border, by a fit within the CCD.
    sides = np.full((len(pairs), 2, 2), np.nan)
    for k, positions in enumerate(scene.positions):
        stars = slice(first[k], first[k + 1])
        e = np.stack([scene.shapes.e1[stars], scene.shapes.e2[stars]], axis=1)
        good, borders = np.isfinite(e).all(axis=1), pairs == k
        extent = camera.bounds([ccds[k]])
        points = np.concatenate([positions[good], middles[borders.any(axis=1)]])
        terms = design_matrix(points, extent, _BORDER_ORDER)
        if good.sum() >= terms.shape[1]:
            sides[borders] = terms[good.sum() :] @ np.linalg.lstsq(terms[: good.sum()], e[good], rcond=None)[0]
    jumps = sides[:, 0] - sides[:, 1]
    return {"border_jump_e": float(np.sqrt(np.nanmean(np.square(jumps))))}


@STARS.group(
    "xi_raw",
    *(
        Metric(
            f"xi_raw_{name}",
            meaning=f"mean correlation xi+ of the weighted e of the noise-free stars over pairs {range_}",
        )
        for name, range_ in _PAIRS.items()
    ),
)
def correlation(scene: Scene) -> dict[str, float]:
    """Return the mean of xi+ over short and long separations."""
    return {f"xi_raw_{name}": scene.correlation.mean_xi_plus(name) for name in SEPARATION_RANGES}


@STARS.group(
    "xi_g_raw",
    *(
        Metric(f"xi_g_raw_{name}", meaning=f"mean xi+ of g of adaptive moments of noise-free stars over pairs {range_}")
        for name, range_ in _PAIRS.items()
    ),
)
def correlation_of_g(scene: Scene) -> dict[str, float]:
    """Return the mean of xi+ of g over short and long separations."""
    return {f"xi_g_raw_{name}": scene.correlation_g.mean_xi_plus(name) for name in SEPARATION_RANGES}


@STARS.group(
    "xi_bins",
    Metric("xi_plus", meaning="ellipticity correlation xi+ of the noise-free stars in the bin about that separation"),
    Metric("xi_minus", meaning="ellipticity correlation xi- of the noise-free stars in the bin about that separation"),
)
def correlation_bins(scene: Scene) -> dict[str, float]:
    """Return xi+ and xi- of each bin of separation, by its middle: mean separations vary with the stars."""
    xi, edges = scene.correlation, np.geomspace(scene.bins.min_sep, scene.bins.max_sep, scene.bins.n_bins + 1) / ARCMIN
    middles = [f"{middle:.3g}_arcmin" for middle in np.sqrt(edges[1:] * edges[:-1])]
    plus = {f"xi_plus_{name}": float(v) for name, v in zip(middles, xi.xi_plus, strict=True)}
    minus = {f"xi_minus_{name}": float(v) for name, v in zip(middles, xi.xi_minus, strict=True)}
    return plus | minus


@STARS.group(
    "reconstruction",
    *(
        Metric(f"xi_{kind}_{name}", meaning=f"mean xi+ over pairs {range_} of the residuals of e {_RESIDUALS[kind]}")
        for kind in _RESIDUALS
        for name, range_ in _PAIRS.items()
    ),
    Metric("rms_residual_at_stars", meaning=f"rms of one component of the residuals of e {_RESIDUALS['residual']}"),
    Metric("rms_residual_away", meaning=f"rms of one component of the residuals of e {_RESIDUALS['away']}"),
    *(
        Metric(f"xi_g_{kind}_{name}", meaning=f"mean xi+ over pairs {range_} of the residuals of g {words}")
        for kind, words in _RESIDUALS.items()
        for name, range_ in _PAIRS.items()
    ),
    Metric("rms_residual_g_at_stars", meaning=f"rms of one component of the residuals of g {_RESIDUALS['residual']}"),
    Metric("rms_residual_g_away", meaning=f"rms of one component of the residuals of g {_RESIDUALS['away']}"),
)
def reconstruction(scene: Scene) -> dict[str, float]:
    """Return the residuals of PSF models of noisy stars, and their correlations."""
    experiment = scene.camera_experiment
    simulated = simulate_ccds(experiment, partial(model_ccds, experiment), threads=scene.threads)
    products = list(simulated.results.values())
    if experiment.config.reconstruction.model == "focal_plane":
        products, _ = apply_focal_plane_model(experiment, products, threads=scene.threads)
    correlated, correlated_g = (correlations(products, tuple(_RESIDUALS), moments) for moments in MOMENTS)
    together = run_metrics(products, correlated, correlated_g)["all"]
    metrics = {
        f"xi_{prefix}{kind}_{name}": float(together[f"xi_plus_{prefix}{kind}_{name}"])
        for prefix in ("", "g_")
        for kind in _RESIDUALS
        for name in SEPARATION_RANGES
    }
    residuals = [f"rms_residual_{prefix}{name}" for prefix in ("", "g_") for name in ("at_stars", "away")]
    return metrics | {key: float(together[key]) for key in residuals}


@STARS.group(
    "ee80",
    Metric("ee80_arcsec", "arcsec", meaning="radius of 80 % of the light in the stamp of the mean noise-free star"),
)
def ee80(scene: Scene) -> dict[str, float]:
    """Return the radius of 80 % of the light in the stamp of the mean star."""
    mean = scene.stars.image.astype(np.float64).mean(axis=0)
    radii, within = energy_curve(mean)
    radius = float(np.interp(0.8 * mean.sum(), within, radii))
    return {"ee80_arcsec": radius * scene.stars.pixel_scale / ARCSEC}


@STARS.group("throughput", *THROUGHPUT)
def lit_fraction(scene: Scene) -> dict[str, float]:
    """Return mean and minimum of the lit fraction of the pupil."""
    light = scene.stars.lit_fraction
    return {"throughput_mean": float(light.mean()), "throughput_min": float(light.min())}


@STARS.group(
    "zernikes",
    *(
        Metric(
            f"Z{j}_nm",
            "nm",
            meaning=f"annular Zernike term {j} (Noll) of the wavefront without atmosphere, rms over five fields",
        )
        for j in _ZERNIKES
    ),
)
def zernikes(scene: Scene) -> dict[str, float]:
    """Return the rms of each wavefront term over five fields, to the edge on either axis."""
    telescope, wavelengths = scene.telescope, scene.camera_experiment.wavelengths
    angles = telescope.field_radius * np.array([0.0, 0.5, 0.95])
    fields = {(0.0, 0.0), *((a, 0.0) for a in angles), *((0.0, a) for a in angles)}
    wavelength = float(wavelengths[len(wavelengths) // 2])
    field_coefficients = []
    for field in sorted(fields):
        opd = wavefront_opd(telescope, field, wavelength, grid=48, threads=scene.threads)
        fit = fit_zernikes(opd, 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, jmax=22)
        field_coefficients.append(fit.coefficients)
    rms = np.sqrt(np.mean(np.square(field_coefficients), axis=0)) * 1e9
    return {f"Z{j}_nm": float(rms[j - 1]) for j in _ZERNIKES}
