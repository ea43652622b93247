"""Ellipticity by the atmosphere alone: its size and correlation against exposure time.

Run: python benchmarks/atmosphere_exposure_times.py [--seeds N] [--stars N] [--folder FOLDER]

This is Figure 6 of Jee & Tyson (2011): stars in one CCD (13.6 arcmin), the site's six layers, exposures of 1, 5, 15 and
60 s that begin together, one wavelength, no optics (the f/1000 paraboloid of atmosphere_vs_galsim.py), no charge
diffusion. It prints mean |e| and xi+, and draws xi+ for the four exposures and the whiskers of 15 s.

The ground layer stands at two heights. At 0 km the light of all stars of an exposure crosses the same turbulence, which
adds one common ellipticity and a constant to xi+. At 200 m little changes within a CCD: the light of stars 13 arcmin
apart crosses the layer 0.8 m apart, a tenth of the pupil. The common part is absent from the correlation of
ellipticities less the mean of their exposure.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from atmosphere_vs_galsim import SITE, ellipticity, long_paraboloid, pachon_stars, through_screens

import pachon
from pachon import Atmosphere
from pachon.core.random_streams import stream
from pachon.core.units import ARCMIN, ARCSEC

EXPOSURES = (1.0, 5.0, 15.0, 60.0)
LIFTS = (0.0, 200.0)
FIELD = 6.8 * ARCMIN
PIXEL, STAMP = 0.2 * ARCSEC, 31
BINS = pachon.SeparationBins(0.2 * ARCMIN, 12.0 * ARCMIN, 10, exact=True)
WHISKER_STARS = 1500


def exposed(longest: Atmosphere, exposure: float, lift: float) -> Atmosphere:
    """Return the beginning of the longest exposure, in 300 steps or more of at most 0.05 s, with the ground lifted."""
    count = max(300, round(exposure / 0.05))
    return through_screens(
        longest,
        longest.screens("slopes"),
        exposure=exposure,
        times=(np.arange(count) + 0.5) * (exposure / count),
        altitudes=np.where(longest.altitudes == 0.0, lift, longest.altitudes),
    )


def ellipticities(atmosphere: Atmosphere, fields: np.ndarray) -> np.ndarray:
    telescope = long_paraboloid()
    plane = {"pixel_size": PIXEL * telescope.reference_sphere_radius, "size": STAMP}
    return ellipticity(pachon_stars(telescope, atmosphere, fields, **plane), PIXEL)


def study(seeds: int, stars: int) -> tuple[dict, np.ndarray]:
    """Return the statistics of each (lift, exposure) with the seeds along the first axis, and the separations."""
    fields = stream(0, "stars").uniform(-FIELD, FIELD, (stars, 2))
    table: dict = {(lift, t): {"mean": [], "xi": [], "within": []} for lift in LIFTS for t in EXPOSURES}
    for seed in range(seeds):
        longest = Atmosphere.from_site(SITE, seed, exposure=max(EXPOSURES))
        for (lift, t), row in table.items():
            e = ellipticities(exposed(longest, t, lift), fields)
            correlations = [
                pachon.shear_correlation(*fields.T, e.real, e.imag, bins=BINS, subtract_mean=subtract)
                for subtract in (False, True)
            ]
            row["mean"].append(np.mean(np.abs(e)))
            row["xi"].append(correlations[0].xi_plus)
            row["within"].append(correlations[1].xi_plus)
        longest.release()
        print(f"  seed {seed}: mean |e| in 15 s {table[0.0, 15.0]['mean'][-1]:.4f}", flush=True)
    arrays = {key: {name: np.array(v) for name, v in row.items()} for key, row in table.items()}
    return arrays, correlations[0].r_arcmin


def average(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(len(values))


def half_width(r: np.ndarray, xi: np.ndarray) -> float:
    """Return the separation at which a correlation has fallen to half of its first bin [arcmin]."""
    below = int(np.argmax(xi < 0.5 * xi[0]))
    fraction = (xi[below - 1] - 0.5 * xi[0]) / (xi[below - 1] - xi[below])
    return float(np.exp(np.log(r[below - 1]) + fraction * np.log(r[below] / r[below - 1])))


def draw_correlations(table: dict, r: np.ndarray, path: Path) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(11.0, 4.4), layout="constrained")
    titles = {"xi": "as observed", "within": "less the mean ellipticity of each exposure"}
    for panel, (name, title) in zip(axes, titles.items(), strict=True):
        for lift, style in zip(LIFTS, ("o-", "s--"), strict=True):
            for number, t in enumerate(EXPOSURES):
                mean, error = average(table[lift, t][name])
                label = f"{t:g} s" if lift == 0.0 else None
                place = r * 1.03 ** (number - 1.5)
                # Both sets have the same screens: one set of error bars is enough.
                error = error if lift == 0.0 else None
                panel.errorbar(place, mean, error, fmt=style, color=f"C{number}", ms=3, lw=1, capsize=2, label=label)
        panel.set_xscale("log")
        panel.set(xlabel="separation [arcmin]", ylabel=r"$\xi_+$", title=title)
        panel.set_xticks([0.2, 0.5, 1, 2, 5, 10], ["0.2", "0.5", "1", "2", "5", "10"])
        panel.minorticks_off()
    axes[0].set_yscale("log")
    axes[0].errorbar([], [], [], fmt="s--", color="k", ms=3, lw=1, label="ground layer at 200 m, not 0 km")
    axes[0].set(xlim=axes[1].get_xlim(), ylim=(2e-6, None))
    axes[0].legend(title="exposure", fontsize=8, title_fontsize=8, loc="lower left", ncols=3)
    axes[1].axhline(0.0, color="0.6", lw=0.8)
    axes[1].set_yscale("symlog", linthresh=1e-6)
    figure.savefig(path, dpi=110)


def draw_whiskers(path: Path) -> None:
    fields = stream(1, "stars").uniform(-FIELD, FIELD, (WHISKER_STARS, 2))
    longest = Atmosphere.from_site(SITE, 0, exposure=max(EXPOSURES))
    e = ellipticities(exposed(longest, 15.0, 0.0), fields)
    figure, axes = plt.subplots(1, 2, figsize=(12.0, 6.3), layout="constrained")
    scale = 0.6 / 0.01  # arcminutes a unit of |e|
    x, y = fields.T / ARCMIN
    for panel, values, title in (
        (axes[0], e, f"15 s: mean |e| {np.abs(e).mean():.2%}"),
        (axes[1], e - e.mean(), f"less the mean ellipticity: mean |e| {np.abs(e - e.mean()).mean():.2%}"),
    ):
        half = 0.5 * scale * np.abs(values) * np.exp(0.5j * np.angle(values))
        panel.plot([x - half.real, x + half.real], [y - half.imag, y + half.imag], color="k", lw=0.7)
        panel.plot([-6.6, -6.6 + scale * 0.01], [7.1, 7.1], color="C3", lw=2)
        panel.text(-5.8, 7.1, "1 %", color="C3", va="center")
        panel.set(xlim=(-7.0, 7.0), ylim=(-7.0, 7.4), aspect="equal", title=title)
        panel.set(xlabel="x [arcmin]", ylabel="y [arcmin]")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description="Ellipticity by the atmosphere alone against exposure time.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--stars", type=int, default=400)
    parser.add_argument("--folder", type=Path, help="folder for the plots")
    arguments = parser.parse_args()
    print(f"pachon {pachon.__version__}; {arguments.seeds} seeds, {arguments.stars} stars in one CCD")
    table, r = study(arguments.seeds, arguments.stars)
    near = int(np.argmin(np.abs(r - 1.0)))
    print(
        f"ground at  exposure  mean |e|            xi+ at {r[near]:.1f}'            the same, less the mean   half at"
    )
    for (lift, t), row in table.items():
        (mean, error), (xi, xi_error), (within, within_error) = (average(row[n]) for n in ("mean", "xi", "within"))
        print(
            f"{lift:5.0f} m  {t:6.0f} s  {mean:.4f} +- {error:.4f}   {xi[near]:.2e} +- {xi_error[near]:.0e}"
            f"   {within[near]:.2e} +- {within_error[near]:.0e}   {half_width(r, within):.2f}'"
        )
    if arguments.folder:
        draw_correlations(table, r, arguments.folder / "atmosphere_exposure_times.png")
        draw_whiskers(arguments.folder / "atmosphere_whiskers.png")


if __name__ == "__main__":
    main()
