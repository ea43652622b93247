"""Results of commands in one sentence, which stands above their tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from ..core.number_text import counted

#: Figures of one stack, of one case or of one image, by name.
Figures = Mapping[str, Any]


def percent_text(fraction: float) -> str:
    """Return a fraction in per cent; words where there is none."""
    return f"{100 * fraction:.2g} %" if math.isfinite(fraction) else "an unknown amount"


def images_verdict(objects: Mapping[str, int], images: int) -> str:
    """Return what a set of images holds, by the objects on those that were drawn."""
    kept = images - len(objects)
    if not objects:
        return f"No image is drawn: {counted(kept, 'image was', 'images were')} there already."
    sources = counted(sum(objects.values()), "star or galaxy", "stars and galaxies")
    earlier = f"; {counted(kept, 'image was', 'images were')} there already" if kept else ""
    return f"{counted(len(objects), 'image')} with {sources}{earlier}."


def visits_verdict(stacks: Mapping[str, Figures]) -> str:
    """Return how the PSFs and their models have averaged, from the first to the last of the stacks."""
    last = max(stacks, key=int)
    first = min(stacks, key=int)
    figures = stacks[last]
    where = "In one visit" if int(last) == 1 else f"Stacked over {last} visits"
    residual = percent_text(figures["rms_residual_g_places"])
    before = "" if first == last else f", from {percent_text(stacks[first]['rms_residual_g_places'])} over {first}"
    return (
        f"{where} the PSF has an rms ellipticity |g| of {percent_text(figures['rms_g'])}; where no star is, its model "
        f"errs by {residual}{before}."
    )


def null_verdict(stacks: Mapping[str, Figures]) -> str:
    """Return what the PSF models do to the correlation of ellipticities, in the deepest stack."""
    last = max(stacks, key=int)
    figures = stacks[last]
    galaxies = f"In the stack of {counted(int(last), 'visit')}, {figures['usable']} galaxies"
    change, noise = figures["xi_plus_difference_long"], figures["shot_noise_xi_plus"]
    if not math.isfinite(change):
        return f"{galaxies}: no pairs are farther apart than 10', where the effect of PSF models is measured."
    return (
        f"{galaxies}: the PSF models add ξ+ = {change:.1e} beyond 10', beside a shot noise of {noise:.1e} over all "
        "separations."
    )


def stack_verdict(stacks: Mapping[str, Figures]) -> str:
    """Return how many galaxies the deepest of the stacked images have, and what their pixels cost."""
    last = max(stacks, key=int)
    figures = stacks[last]
    densities = [f"{figures[key]:.1f}" for key in ("usable_per_arcmin2", "usable_per_arcmin2_stamps")]
    return (
        f"The stacked images of {counted(int(last), 'visit')} have {densities[0]} galaxies per arcmin² usable for "
        f"shear; on stamps of their own there would be {densities[1]}."
    )


def measure_verdict(measured: Mapping[str, Figures], left_out: int) -> str:
    """Return what was measured on images."""
    lost = f"; {counted(left_out, 'image')} could not be measured" if left_out else ""
    if not measured:
        return f"No image could be measured; {counted(left_out, 'image is', 'images are')} left out."
    stars, galaxies = (sum(figures[key] for figures in measured.values()) for key in ("stars", "usable"))
    usable = counted(galaxies, "galaxy", "galaxies")
    return f"{counted(len(measured), 'image')}: {counted(stars, 'star')}, and {usable} usable for shear{lost}."


def model_verdict(figures: Figures) -> str:
    """Return how well a PSF model of a table of stars describes stars that it was not fitted to."""
    of_stars = f"{figures['used']} of {counted(figures['stars'], 'star')}"
    error, noise = figures["rms_e_held_out"], figures["rms_e_noise"]
    if not math.isfinite(error):
        return f"The PSF model is fitted to {of_stars}, too few to hold any out: its error is unknown."
    noise_text = f", of which {percent_text(noise)} is noise of the stars" if math.isfinite(noise) else ""
    return (
        f"The PSF model is fitted to {of_stars}; held out, it differs from them by {percent_text(error)} rms "
        f"in weighted e{noise_text}."
    )


def diagnose_verdict(overall: Figures, missing: int) -> str:
    """Return the residuals of a run where no star is, beside what a constant PSF would leave."""
    lost = f"; {counted(missing, 'CCD is', 'CCDs are')} left out" if missing else ""
    name = "g" if math.isfinite(overall.get("rms_g_away", math.nan)) else "e"
    residual, scatter = (overall.get(f"rms_{key}", math.nan) for key in (f"{name}_away", f"scatter_{name}"))
    words = "g" if name == "g" else "weighted e"
    where = f"Over {counted(overall['ccds'], 'CCD')}"
    return (
        f"{where} the PSF model errs by {percent_text(residual)} rms in {words} where no star is, against "
        f"{percent_text(scatter)} of a constant PSF on each{lost}."
    )


def attribution_verdict(metrics: Mapping[str, Figures]) -> str:
    """Return the cause without which the ellipticity of the PSFs falls most."""
    full = metrics["full"]["rms_g_truth"]
    changes = {case: m["rms_g_truth"] - full for case, m in metrics.items() if case != "full"}
    finite = {case: change for case, change in changes.items() if math.isfinite(change)}
    if not math.isfinite(full) or not finite:
        return "The adaptive moments of the PSFs cannot be measured, so no cause can be named by them."
    cause = min(finite, key=lambda case: finite[case])
    if finite[cause] >= 0.0:
        return f"The PSFs have {percent_text(full)} rms in g; none of the causes alone makes them less round."
    return (
        f"The PSFs have {percent_text(full)} rms in g; {cause} matters most, without it they have "
        f"{percent_text(full + finite[cause])}."
    )


def shim_verdict(merit: str, parts: str, before: Any, after: Any) -> str:
    """Return the gain of shims over the focal plane focused as a whole, in the merit that was minimised."""
    name, scale, unit, key = {
        "fwhm": ("mean FWHM", 1.0, " arcsec", "fwhm"),
        "ellipticity": ("rms of g", 1e3, "e-3", "rms_g"),
        "xi": ("rms of ξ+ of g", 1e6, "e-6", "rms_xi_g"),
    }[merit]
    start, end = scale * getattr(before, key), scale * getattr(after, key)
    moved = {"ccds": "CCDs"}.get(parts, parts)
    verb = "lower" if end < start else "do not lower"
    return f"Shims of {moved} {verb} the {name}: {start:.4g}{unit} focused as a whole, {end:.4g}{unit} with them."


def reproduced_verdict(figures: Mapping[str, Figures]) -> str:
    """Return how many figures agree with the paper."""
    verdicts = [figure["verdict"] for figure in figures.values()]
    agreeing = verdicts.count("agrees")
    differing = ", ".join(name for name, figure in figures.items() if figure["verdict"] == "differs")
    incomparable = verdicts.count("cannot be compared")
    differ = f"; {differing} {'differ' if ',' in differing else 'differs'}" if differing else ""
    open_text = f"; {incomparable} cannot be compared" if incomparable else ""
    return f"{agreeing} of {counted(len(verdicts), 'figure')} agree with the paper{differ}{open_text}."


def piff_verdict(models: Iterable[Figures]) -> str:
    """Return the residuals that each of the compared models leaves at the stars."""
    residuals = [f"{model['model']} {percent_text(float(model['rms_e']))}" for model in models]
    return f"Rms in e that models leave at the stars: {', '.join(residuals)}."
