"""Heights of the focal plane and their budget (Jee & Tyson 2011, Fig. 7 and Table 1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...core.plotting import new_figure, png_bytes, styled
from ...models.camera.camera import Camera
from ...models.camera.focal_plane import FocalPlane
from ...models.camera.height_budget import SIMULATED, SPECIFICATION, TERMS
from ...pipeline.report.focal_plane_axes import OBSERVED
from ...pipeline.report.focal_plane_plots import heights_plot
from .bench import Bench
from .figure import EcsvData, Reproduced, figure

_TERM_NAMES = ("global focal plane", "raft height", "CCD to CCD height", "CCD tilt", "potato chip")


@figure(
    "fig7",
    "heights of the focal plane",
    "one realisation of Table 1: steps between CCDs and rafts, tilts, waves within CCDs; at most about 10 µm off",
    minutes=(0.05, 0.05),
)
def heights(bench: Bench) -> Reproduced:
    """Draw the heights of the CCD surfaces (Fig. 7)."""
    plane = bench.focal_plane
    table = plane.to_table(8)
    z = np.asarray(table["z"]) * 1e6
    names = np.asarray(table["ccd"])
    within = np.array([np.ptp(z[names == name]) for name in plane.names])
    measured = {
        "largest_um": float(np.abs(z).max()),
        "fraction_beyond_10_um": float(np.mean(np.abs(z) > 10.0)),
        "peak_to_valley_um": float(np.ptp(z)),
        "rms_um": float(z.std()),
        "median_within_a_ccd_um": float(np.median(within)),
    }
    columns = {
        "ccd": (names, "", "name of the CCD"),
        "x_mm": (np.round(np.asarray(table["x"]) * 1e3, 6), "mm", "detector x"),
        "y_mm": (np.round(np.asarray(table["y"]) * 1e3, 6), "mm", "detector y"),
        "height_um": (np.round(z, 6), "um", "height along +z, towards the sky"),
    }
    agrees = measured["fraction_beyond_10_um"] < 0.05 and measured["largest_um"] > 5.0
    return Reproduced(
        {"": heights_plot(plane, (), bench.field_radius)},
        {"": EcsvData(columns, {"budget": "simulated", **measured})},
        f"{100 * measured['fraction_beyond_10_um']:.1f} % of the area more than 10 µm off, at most"
        f" {measured['largest_um']:.1f} µm; {measured['peak_to_valley_um']:.1f} µm peak to valley,"
        f" {measured['rms_um']:.1f} µm rms; within a CCD {measured['median_within_a_ccd_um']:.1f} µm",
        agrees,
        "another realisation of the same budget; its terms add up to 42 µm peak to valley where all are at their ends",
        measured,
    )


@figure(
    "table1",
    "height budget of the focal plane",
    "simulated, peak to valley: global 10 µm, raft 6.5 µm, CCD 10 µm, tilt 2.5e-4 rad, potato chip 5 µm",
    minutes=(0.05, 0.05),
)
def height_budget(bench: Bench) -> Reproduced:
    """Compare the drawn terms of the height budget with those of the paper (Table 1)."""
    drawn = {name: drawn_heights(bench.camera, bench.seed, name) for name in ("specification", "simulated")}
    allowed = {
        name: np.array([b.global_height, b.raft_height, b.ccd_height, b.ccd_tilt * 1e-2, b.potato_chip]) * 1e6
        for name, b in (("specification", SPECIFICATION), ("simulated", SIMULATED))
    }
    units = ["um", "um", "um", "1e-4 rad", "um"]
    columns: dict[str, tuple[np.ndarray, str, str]] = {
        "term": (np.array(_TERM_NAMES), "", "term of the budget"),
        "unit": (np.array(units), "", "unit of its values"),
    }
    for name in drawn:
        columns[f"paper_{name}"] = (allowed[name], "", f"Table 1, {name}, peak to valley")
        columns[f"drawn_{name}"] = (drawn[name], "", f"peak to valley of what was drawn from {name}")
    ratio = drawn["simulated"] / allowed["simulated"]
    agrees = all((drawn[n] <= 1.001 * allowed[n]).all() and (drawn[n] > 0.8 * allowed[n]).all() for n in drawn)
    values = {
        "specification: paper": allowed["specification"],
        "simulated: paper": allowed["simulated"],
        "specification: drawn": drawn["specification"],
        "simulated: drawn": drawn["simulated"],
    }
    told = ", ".join(f"{v:.3g}" for v in drawn["simulated"])
    return Reproduced(
        {"": _budget_plot(_TERM_NAMES, values, ["µm" if u == "um" else u.replace("1e-4", "10⁻⁴") for u in units])},
        {"": EcsvData(columns, {"what": "peak to valley of each term of the focal plane's height"})},
        f"{told} (µm; tilt in 1e-4 rad), {100 * ratio.min():.0f} to {100 * ratio.max():.0f} % of the budget",
        agrees,
        "global and potato chip are scaled to the budget exactly; rafts, CCDs and tilts are uniform within it, so that"
        " a finite number of them falls a little short",
        {f"drawn_{name}": values for name, values in drawn.items()},
    )


def drawn_heights(camera: Camera, seed: int, budget: str) -> np.ndarray:
    """Return the drawn peak to valley of each term: four in um, the tilt (fourth) in 1e-4 rad.

    The potato chip is that of the median CCD; pistons and tilts are over all rafts or CCDs.
    """
    result = []
    for term in TERMS:
        plane = FocalPlane.from_budget(camera, seed=seed, terms=term, budget=budget)
        height = np.asarray(plane.to_table(64 if term == "potato_chip" else 4)["z"]).reshape(len(camera), -1)
        if term == "tilt":
            slopes = plane.gradient(*camera.centers.T)
            result.append(float(np.ptp(np.arctan(slopes), axis=0).max()) * 1e4)
        elif term == "potato_chip":
            result.append(float(np.median(np.ptp(height, axis=1))) * 1e6)
        else:
            result.append(float(np.ptp(height)) * 1e6)
    return np.array(result)


def _budget_plot(rows: Sequence[str], values: Mapping[str, np.ndarray], units: Sequence[str]) -> bytes:
    """Draw the terms of the height budget, allowed and drawn."""
    colors = ("0.8", "0.55", "#9cc3e6", OBSERVED)
    with styled():
        figure = new_figure(9.0, 4.4)
        axes = figure.add_subplot()
        height = 0.8 / len(values)
        place = np.arange(len(rows))
        for k, ((label, bars), color) in enumerate(zip(values.items(), colors, strict=True)):
            shift = place + (k - 0.5 * (len(values) - 1)) * height
            axes.barh(shift, bars, height, color=color, label=label)
            for y, value in zip(shift, bars, strict=True):
                axes.annotate(
                    f"{value:.2f}", (value, y), xytext=(3, 0), textcoords="offset points", va="center", size=7
                )
        axes.set_yticks(place, [f"{row} [{unit}]" for row, unit in zip(rows, units, strict=True)])
        axes.invert_yaxis()
        axes.set(
            xlim=(0.0, 1.15 * max(float(v.max()) for v in values.values())),
            xlabel="peak to valley, in the unit of each row",
        )
        axes.legend(loc="lower right")
        return png_bytes(figure)
