"""Images, stacks of visits and the null test with galaxies (Jee & Tyson 2011, Figs. 10 and 15 to 18)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ...core.products import Columns, image_hdu
from ...core.units import ARCMIN
from ...imaging.config import ImagesConfig
from ...imaging.draw import Window
from ...imaging.preview import cutouts_png
from ...imaging.scene import DEEP, draw_ccd
from ...measure.correlation import Correlation
from ...pipeline.config import with_options
from ...pipeline.simulate.ccd_exposure import expose_positions
from ...pipeline.simulate.photometry import effective_fwhm, limiting_magnitude
from ...sky.population import GalaxyPopulation
from ..visits.null_result import amplitude, density_slope, null_metrics, shot_noise
from ..visits.plots import correlation_picture, density_picture, ellipticity_picture, null_test_picture
from .bench import Bench
from .figure import EcsvData, FitsData, Reproduced, figure

#: Usable galaxies per square arcminute in the paper, by number of visits.
PAPER_DENSITY = {1: 10.0, 10: 24.0, 100: 42.0}
#: Visits from which a stack may be compared with that of the paper.
_ENOUGH = 10
_NAMES = {"psf": "PSF", "residual_stars": "residual at the stars", "residual_places": "residual where no star is"}
# CCD of the image of Fig. 10.
_CCD = "R22_S11"
# Side of this image [pixel].
_SIDE = 640
# Faintest galaxies of this image [AB mag].
_FAINTEST = 29.0


@figure(
    "fig10",
    "image of the sky",
    "100 arcsec of a CCD without noise, in 6000 s (27.5 mag at 5 sigma) and in 15 s",
    minutes=(0.02, 0.5),
)
def image_of_the_sky(bench: Bench) -> Reproduced:
    """Draw a cutout of a CCD at three depths (Fig. 10)."""
    options = {
        "run__ccds": (_CCD,),
        "run__seed": bench.seed,
        "run__stars__truth": bench.scale.truth,
        "run__atmosphere__screen_size": bench.scale.screen_size,
        "run__atmosphere__time_step_s": bench.scale.time_step,
    }
    experiment = with_options(ImagesConfig(), **options).experiment()
    columns, rows = experiment.camera.pixels[experiment.camera.ccd_index(_CCD)].tolist()
    corner = (columns - _SIDE) // 2, (rows - _SIDE) // 2
    galaxies = GalaxyPopulation(_FAINTEST, bench.seed)
    with experiment.screens(bench.threads):
        star = expose_positions(experiment, np.zeros((1, 2)), bench.threads)
        scene = draw_ccd(
            experiment, _CCD, galaxies.galaxies_in, window=Window(*corner, _SIDE, _SIDE), threads=bench.threads
        )
    width = effective_fwhm(star.image, star.pixel_scale)
    seconds = scene.exposure.time
    limit = limiting_magnitude(5.0, experiment.band, seconds, width)
    deep = limit + 1.25 * np.log10(DEEP / seconds)
    hdus = [image_hdu("ELECTRONS", scene.electrons, "expected electrons of galaxies and stars in one exposure")]
    depth_text = (
        f"galaxies to {_FAINTEST:g} mag; 5 sigma of a star at {deep:.2f} mag in {DEEP:g} s, at {limit:.2f} mag in"
        f" {seconds:g} s"
    )
    return Reproduced(
        {"": cutouts_png(scene, threads=bench.threads)},
        {"": FitsData(hdus, [("CCD", _CCD, ""), ("FAINTEST", _FAINTEST, "[mag] faintest galaxy")])},
        depth_text,
        abs(deep - 27.5) < 0.3,
        "the depth in 6000 s; galaxies are like those of the Ultra Deep Field, where the paper cuts out its pixels",
        {"limit_6000s_mag": float(deep), "limit_one_exposure_mag": float(limit)},
    )


@figure(
    "fig15",
    "ellipticities in a stack of rolled visits",
    "the PSF of 100 visits with random rolls is much rounder than that of one, and the stacked models follow it",
    minutes=(0.02, 0.3),
    of_visits=True,
)
def stacked_ellipticities(bench: Bench) -> Reproduced:
    """Show the ellipticities of one visit, of the stack, and of the residuals of models (Fig. 15)."""
    result = bench.stack
    stacks, first, last = result.summary["stacks"], min(result.stacks), max(result.stacks)
    last_metrics = stacks[str(last)]
    stack = result.stacks[last]
    columns = {
        name: (getattr(stack, name) / unit, text, description)
        for name, unit, text, description in (
            ("x", ARCMIN, "arcmin", "along x of the stack"),
            ("y", ARCMIN, "arcmin", "along y of the stack"),
            ("e1", 1.0, "", "of the true PSF"),
            ("e2", 1.0, "", "of the true PSF"),
            ("model_e1", 1.0, "", "of the mean of the models"),
            ("model_e2", 1.0, "", "of the mean of the models"),
        )
    }
    # Of all visits: how round a single one is, its turbulence decides.
    visits_e = np.array([visit.rms_e for visit in result.figures])
    single = float(np.sqrt(np.mean(visits_e**2)))
    ratio = single / last_metrics["rms_e"]
    # Of the mean over visits; that of the stack is smaller.
    error = 0.5 * ratio * float(np.std(visits_e**2)) / single**2 / math.sqrt(len(visits_e))
    return Reproduced(
        {"": ellipticity_picture(result.stacks)},
        {"": EcsvData(columns, {"visits": last})},
        f"rms |e| {single:.1e} in one visit ({visits_e.min():.1e} to {visits_e.max():.1e}),"
        f" {last_metrics['rms_e']:.1e} in {last}; the models leave"
        f" {last_metrics['rms_residual_e_stars']:.1e} at the stars and"
        f" {last_metrics['rms_residual_e_places']:.1e} where no star is",
        ratio > 2.0 - 2.0 * error if last >= _ENOUGH else None,
        f"{ratio:.2f} +- {error:.2f} times rounder in {last} visits"
        + (", too few for the comparison" if last < _ENOUGH else ""),
        {f"{key}_{n}": stacks[str(n)][key] for n in (first, last) for key in _STACK_KEYS} | {"rms_e_single": single},
    )


def _with_error(value: float, error: float) -> str:
    """Return the text of a correlation with its jackknife error, which few CCDs or tiles do not have."""
    return f"{value:.1e}, without an error," if math.isnan(error) else f"{value:.1e} +- {error:.0e}"


_STACK_KEYS = ("rms_e", "rms_residual_e_stars", "rms_residual_e_places")


@figure(
    "fig16",
    "PSF correlation in a stack of rolled visits",
    "xi+ of the PSF falls by the stack, but not below 1e-7 everywhere; that of the residual stays at 1e-8",
    minutes=(0.02, 0.3),
    of_visits=True,
)
def stacked_correlations(bench: Bench) -> Reproduced:
    """Show xi+ of the PSF and of the residual in the stacks (Fig. 16)."""
    result = bench.stack
    last = max(result.stacks)
    metrics = result.summary["stacks"][str(last)]
    mean_xi_plus = {
        kind: (metrics[f"xi_plus_{kind}_long"], metrics[f"xi_plus_{kind}_long_error"])
        for kind in ("psf", "residual_stars", "residual_places")
    }
    stars, star_error = mean_xi_plus["residual_stars"]
    return Reproduced(
        {"": correlation_picture(result.correlations)},
        {"": _correlation_data(result.correlations[last], last)},
        f"xi+ beyond 10' in {last} visits: "
        + ", ".join(f"{_NAMES[kind]} {_with_error(*mean)}" for kind, mean in mean_xi_plus.items()),
        abs(stars) < 1e-7 + 2.0 * star_error if last >= _ENOUGH and np.isfinite(star_error) else None,
        "residual at the stars, which the models are fitted to; where no star is the paper says nothing",
        {f"xi_plus_{kind}": value for kind, (value, _) in mean_xi_plus.items()}
        | {f"xi_plus_{kind}_error": error for kind, (_, error) in mean_xi_plus.items()},
    )


@figure(
    "fig17",
    "null test with galaxies",
    "10, 24 and 42 usable galaxies per square arcminute in 1, 10 and 100 visits; xi+ is that of shot noise",
    minutes=(0.02, 1.0),
    of_visits=True,
    of_galaxies=True,
)
def galaxy_correlations(bench: Bench) -> Reproduced:
    """Show xi+ of galaxies without shear (Fig. 17)."""
    results = bench.galaxies
    metrics = {n: null_metrics(result) for n, result in results.items()}
    last = max(results)
    density_ratios = {n: results[n].density / PAPER_DENSITY[n] for n in results if n in PAPER_DENSITY}
    near = all(abs(ratio - 1.0) < 0.15 for ratio in density_ratios.values())
    density = ", ".join(f"{results[n].density:.1f} in {n}" for n in results)
    apart = metrics[last]["xi_plus_difference_long"], metrics[last]["xi_plus_difference_long_error"]
    return Reproduced(
        {"": null_test_picture(results)},
        {"": _correlation_data(results[last].correlations, last)},
        f"usable per arcmin^2: {density}; PSF models alone add xi+ of {_with_error(*apart)} beyond 10' in {last}"
        " visits",
        near if density_ratios else None,
        "densities against the paper's: "
        + ", ".join(f"{100 * (r - 1):+.0f} % in {n}" for n, r in density_ratios.items()),
        {f"{key}_{n}": stack_metrics[key] for n, stack_metrics in metrics.items() for key in _NULL_KEYS},
    )


_NULL_KEYS = (
    "usable_per_arcmin2",
    "mean_abs_xi_plus",
    "shot_noise_xi_plus",
    *(f"{name}_{kind}" for kind in ("model", "true") for name in ("m1", "c1")),
)


def _correlation_data(correlations: Mapping[str, Correlation], visits: int) -> EcsvData:
    """Return xi+ of each kind in the stack of a number of visits as a table."""
    separation = next(iter(correlations.values())).r_arcmin
    columns: Columns = {"r_arcmin": (separation, "arcmin", "mean separation")}
    for kind, correlation in correlations.items():
        columns[f"xi_plus_{kind}"] = (correlation.xi_plus, "", f"xi+, {kind.replace('_', ', ')}")
        columns[f"error_{kind}"] = (correlation.error_plus, "", "its error")
    return EcsvData(columns, {"visits": visits})


@figure(
    "fig18",
    "shear noise against the density of galaxies",
    "the amplitude of xi+ goes as the density to the power -0.97 +- 0.06: shot noise",
    minutes=(0.01, 0.1),
    of_visits=True,
    of_galaxies=True,
)
def noise_against_density(bench: Bench) -> Reproduced:
    """Show the amplitude of xi+ against the density of usable galaxies (Fig. 18)."""
    results = bench.galaxies
    density = np.array([r.density for r in results.values()])
    amplitudes, shot_noises = (np.array([of(r) for r in results.values()]) for of in (amplitude, shot_noise))
    slopes = [density_slope(density, values) for values in (amplitudes, shot_noises)]
    text = ["none, of fewer than three stacks" if s is None else f"{s.value:.2f} +- {s.error:.2f}" for s in slopes]
    columns = {
        "visits": (np.array(list(results)), "", "in the stack"),
        "density": (density, "arcmin-2", "usable galaxies"),
        "amplitude": (amplitudes, "", "mean of |xi+| over the bins"),
        "shot_noise": (shot_noises, "", "the same of unrelated ellipticities"),
    }
    last = max(results)
    return Reproduced(
        {"": density_picture(results)},
        {"": EcsvData(columns, {})},
        f"slope {text[0]}, of the shot noise {text[1]}",
        abs(slopes[0].value + 0.97) < 0.12 if slopes[0] is not None and last >= _ENOUGH else None,
        "amplitudes over their shot noise: "
        + ", ".join(f"{f / n:.2f}" for f, n in zip(amplitudes, shot_noises, strict=True)),
        {
            f"{name}{end}": value
            for name, slope in zip(("slope", "slope_shot_noise"), slopes, strict=True)
            for end, value in zip(("", "_error"), (None, None) if slope is None else slope, strict=True)
        },
    )
