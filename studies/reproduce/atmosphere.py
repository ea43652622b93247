"""Ellipticities by the atmosphere alone (Jee & Tyson 2011, Fig. 6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...core.plotting import new_figure, png_bytes, styled
from ...core.random_streams import stream
from ...core.units import ARCMIN, ARCSEC
from ...models.ideal_telescope import without_aberration
from ...pipeline.measure.correlation import Correlation, shear_correlation
from ...pipeline.measure.shapes import measure_shapes
from ...pipeline.report.focal_plane_axes import TRUTH, draw_key_whisker, draw_whiskers, key_ellipticity, whiskers
from ...wavefront.atmosphere.atmosphere import Atmosphere
from ...wavefront.psf.psf import make_psfs
from .bench import Bench
from .figure import EcsvData, Reproduced, figure

_SITE = "cerro_pachon"
_EXPOSURES = (1.0, 5.0, 15.0, 60.0)
_VISIT = 15.0
_WAVELENGTH = 620e-9
#: Half the side of a CCD on the sky, and FWHM of the weight of the moments [rad].
_HALF_CCD, _WEIGHT = 6.8 * ARCMIN, 0.7 * ARCSEC
_PAIRS: dict[str, Any] = {"min_sep": 0.3 * ARCMIN, "max_sep": 12.0 * ARCMIN, "n_bins": 9}
_COLORS = ("#b8b8b8", "#7fa8d1", "#1f6fbf", "#0b2a55")


@figure(
    "fig6",
    "ellipticity by the atmosphere alone",
    "mean |e| below 1 % in 15 s, coherent over about 1'; xi+ falls with exposure time (1, 5, 15, 60 s), near 2e-5"
    " at most",
    minutes=(0.3, 15.0),
)
def ellipticity(bench: Bench) -> Reproduced:
    """Correlate ellipticities by the atmosphere alone on one CCD, by the fast engine (Fig. 6)."""
    scale = bench.scale
    fields = stream(bench.seed, "reproduce", "whiskers").uniform(-_HALF_CCD, _HALF_CCD, (scale.whisker_stars, 2))
    pairs = stream(bench.seed, "reproduce", "pairs").uniform(-_HALF_CCD, _HALF_CCD, (scale.pair_stars, 2))
    correlated: dict[float, list[Correlation]] = {time: [] for time in _EXPOSURES}
    visits: list[np.ndarray] = []
    mean_e: dict[float, list[float]] = {time: [] for time in _EXPOSURES}
    e = np.zeros(0, dtype=complex)
    for epoch in range(scale.pair_seeds):
        air = Atmosphere.from_site(
            _SITE, bench.seed, epoch=epoch, exposure=max(_EXPOSURES), screen_size=scale.screen_size
        )
        for time in _EXPOSURES:
            begun = beginning(air, time, scale.time_step)
            e_pairs = _atmosphere_ellipticity(bench, begun, pairs)
            correlated[time].append(shear_correlation(pairs[:, 0], pairs[:, 1], e_pairs.real, e_pairs.imag, **_PAIRS))
            mean_e[time].append(float(np.abs(e_pairs).mean()))
            if time == _VISIT:
                visits.append(e_pairs)
                if epoch == 0:
                    e = _atmosphere_ellipticity(bench, begun, fields)
        air.release()
    xi = {time: _mean_and_error(list_) for time, list_ in correlated.items()}
    r = correlated[_VISIT][0].r_arcmin
    near = int(np.argmin(np.abs(r - 1.0)))
    measured = {
        "mean_e_whiskers": float(np.abs(e).mean()),
        "mean_e_about_the_mean": float(np.abs(e - e.mean()).mean()),
        "shared_e_rms": float(np.sqrt(np.mean([abs(v.mean()) ** 2 for v in visits]))),
        "exposures": scale.pair_seeds,
        **{f"mean_e_{t:g}_s": float(np.mean(v)) for t, v in mean_e.items()},
        **{f"xi_plus_{t:g}_s_at_1_arcmin": float(plus[near]) for t, (plus, _, _) in xi.items()},
    }
    curve = {"separation_arcmin": (r, "arcmin", "mean separation of the pairs")}
    for time, (plus, error, minus) in xi.items():
        curve[f"xi_plus_{time:g}s"] = (plus, "", "xi+, mean over the exposures")
        curve[f"error_{time:g}s"] = (error, "", "error of that mean, from the scatter of the exposures")
        curve[f"xi_minus_{time:g}s"] = (minus, "", "xi-, mean over the exposures")
    whisker = {
        "x_arcmin": (fields[:, 0] / ARCMIN, "arcmin", "field angle x"),
        "y_arcmin": (fields[:, 1] / ARCMIN, "arcmin", "field angle y"),
        "e1": (e.real, "", "ellipticity along x"),
        "e2": (e.imag, "", "ellipticity along x = y"),
    }
    correlated_stars = {
        "exposure": (np.repeat(np.arange(len(visits)), len(pairs)), "", "number of the exposure of 15 s"),
        "x_arcmin": (np.tile(pairs[:, 0] / ARCMIN, len(visits)), "arcmin", "field angle x"),
        "y_arcmin": (np.tile(pairs[:, 1] / ARCMIN, len(visits)), "arcmin", "field angle y"),
        "e1": (np.concatenate(visits).real, "", "ellipticity along x"),
        "e2": (np.concatenate(visits).imag, "", "ellipticity along x = y"),
    }
    meta = {"engine": "fast", "wavelength_nm": _WAVELENGTH * 1e9, "exposures": scale.pair_seeds}
    levels = [float(xi[t][0][near]) for t in _EXPOSURES]
    falls = levels[0] > levels[1] > levels[2] > levels[3]
    # One exposure is not another: within a factor of three is as near as a few of them can tell.
    agrees = falls and measured["mean_e_15_s"] < 0.01 and 7e-6 < levels[2] < 6e-5
    told = ", ".join(f"{level:.0e}" for level in levels)
    return Reproduced(
        {"": _atmosphere_plot(fields / ARCMIN, e, r, xi)},
        {
            "": EcsvData(whisker, meta),
            "_stars": EcsvData(correlated_stars, meta),
            "_correlation": EcsvData(curve, meta),
        },
        f"mean |e| {100 * measured['mean_e_15_s']:.2f} % in 15 s; xi+ at 1' {told} for 1, 5, 15, 60 s (mean of"
        f" {scale.pair_seeds} exposures; +-{xi[_VISIT][1][near]:.0e} for 15 s)",
        agrees,
        "in all but the level at most: the ground layer at exactly 0 km gives all stars of an exposure one ellipticity"
        f" in common ({100 * measured['shared_e_rms']:.1f} % rms in 15 s), so that xi+ differs much between exposures"
        " and levels off beyond 1'",
        measured,
    )


def beginning(air: Atmosphere, exposure: float, time_step: float) -> Atmosphere:
    """Return the beginning of a longer exposure, with the same screens and at least 100 times."""
    count = max(100, round(exposure / time_step))
    return air.at_times((np.arange(count) + 0.5) * (exposure / count), exposure)


def _atmosphere_ellipticity(bench: Bench, air: Atmosphere, fields: np.ndarray) -> np.ndarray:
    """Return complex ellipticities of stars through the atmosphere alone."""
    telescope = without_aberration(bench.telescope)
    pixel = 0.2 * ARCSEC
    psfs = make_psfs(
        telescope,
        fields,
        [_WAVELENGTH],
        atmosphere=air,
        pixel_size=pixel * telescope.reference_sphere_radius,
        diffusion=0.0,
        threads=bench.threads,
    )
    shapes = measure_shapes(psfs.image, pixel, _WEIGHT)
    return shapes.e1 + 1j * shapes.e2


def _mean_and_error(measured: Sequence[Correlation]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean of xi+ over exposures, the error of that mean (NaN for one exposure), and the mean of xi-."""
    plus, minus = (np.array([getattr(c, name) for c in measured]) for name in ("xi_plus", "xi_minus"))
    count = len(measured)
    error = plus.std(axis=0, ddof=1) / math.sqrt(count) if count > 1 else np.full(plus.shape[1], np.nan)
    return plus.mean(axis=0), error, minus.mean(axis=0)


def _atmosphere_plot(
    positions: np.ndarray, e: np.ndarray, r: np.ndarray, xi: Mapping[float, tuple[np.ndarray, ...]]
) -> bytes:
    """Draw whiskers on one CCD, and correlations for each exposure time."""
    with styled():
        figure = new_figure(12.0, 5.6)
        left, right = figure.subplots(1, 2)
        edge = 7.2
        key = key_ellipticity(np.abs(e))
        scale = 0.5 / key
        draw_whiskers(left, whiskers(positions[:, 0], positions[:, 1], e.real, e.imag, scale), TRUTH, 0.7)
        left.set(xlim=(-edge, edge), ylim=(-edge, edge), aspect="equal", xlabel="x [arcmin]", ylabel="y [arcmin]")
        left.set_title(f"15 s, atmosphere alone: mean |e| {100 * np.abs(e).mean():.2f} %", loc="left")
        draw_key_whisker(left, key, scale, 1.0)
        for (time, (plus, error, minus)), color in zip(xi.items(), _COLORS, strict=True):
            right.errorbar(r, plus, error, fmt="o-", color=color, markersize=3, linewidth=1.2, capsize=2)
            right.plot(r, minus, "--", color=color, linewidth=1.0)
            right.plot([], [], "o-", color=color, markersize=3, label=f"{time:g} s")
        right.plot([], [], "-", color="0.3", label="ξ+")
        right.plot([], [], "--", color="0.3", label="ξ-")
        right.axhline(0.0, color="0.7", linewidth=0.6)
        right.set_xscale("log")
        right.set_yscale("symlog", linthresh=1e-5)
        right.set_xticks([0.3, 0.5, 1, 2, 5, 10], ["0.3", "0.5", "1", "2", "5", "10"])
        right.minorticks_off()
        right.set(xlabel="separation [arcmin]", ylabel="correlation of the ellipticity")
        right.set_title("mean of the exposures, with the error of that mean", loc="left")
        figure.legend(*right.get_legend_handles_labels(), ncols=6, loc="outside lower right")
        return png_bytes(figure)
