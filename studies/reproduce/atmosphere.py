"""PSF and ellipticities by the atmosphere alone (Jee & Tyson 2011, Figs. 5 and 6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ...core.plotting import new_figure, png_bytes, styled
from ...core.products import image_hdu, table_hdu
from ...core.random_streams import stream
from ...core.units import ARCMIN, ARCSEC
from ...measure.correlation import Correlation, SeparationBins, shear_correlation
from ...measure.focal_plane_axes import TRUTH, draw_key_whisker, draw_whiskers, key_ellipticity, whiskers
from ...measure.shapes import fwhm, measure_shapes
from ...models.ideal_telescope import ideal_telescope
from ...wavefront.atmosphere.atmosphere import Atmosphere
from ...wavefront.atmosphere.screen_sampling import ScreenSampling
from ...wavefront.atmosphere.turbulence import long_exposure_fwhm
from ...wavefront.psf.psf import make_psfs
from ...wavefront.psf.stamps import Stamps
from ...wavefront.psf.wave import WaveEngine
from .bench import Bench
from .figure import EcsvData, FitsData, Reproduced, figure

_SITE = "cerro_pachon"
_TIMES = (0.0, 0.5, 1.0, 2.0, 5.0, 15.0)
_SPECKLE_WAVELENGTH = 600e-9
#: Side of a pixel of the speckle images [arcsec].
_SPECKLE_PIXEL = 0.02
#: Pixels along a side of the speckle images.
_SPECKLE_STAMP = 125
#: Pixels of the width over those of the speckles: single speckles do not define a width.
_SPECKLE_BLOCK = 5
#: FWHM of the weight of the moments [rad].
_WEIGHT = 0.7 * ARCSEC
_EXPOSURES = (1.0, 5.0, 15.0, 60.0)
_VISIT = 15.0
_WAVELENGTH = 620e-9
#: Half the side of a CCD on the sky [rad].
_HALF_CCD = 6.8 * ARCMIN
#: Separations at which the bins of the correlation begin and end [rad].
_SEPARATIONS = (0.3 * ARCMIN, 12.0 * ARCMIN)
#: Bins of separation.
_BINS = 9
_COLORS = ("#b8b8b8", "#7fa8d1", "#1f6fbf", "#0b2a55")


@figure(
    "fig5",
    "the PSF against exposure time",
    'speckles that add up to a rounder, smoother image; FWHM about 0.5" after 15 s at 600 nm',
    minutes=(0.2, 11.0),
)
def speckles(bench: Bench) -> Reproduced:
    """Expose one star for up to 15 s through turbulence alone, by the wave engine (Fig. 5)."""
    size, length = bench.scale.speckle_screen
    telescope = ideal_telescope(bench.optics.telescope)
    air = Atmosphere.from_site(
        _SITE,
        bench.seed,
        exposure=_TIMES[-1],
        time_step=bench.scale.speckle_step,
        screens=ScreenSampling(screen_size=size, screen_length=length, fine_size=1024),
    )
    images, before = [], 0
    total = np.zeros((_SPECKLE_STAMP, _SPECKLE_STAMP))
    for time in _TIMES:
        # An exposure goes on from the one before, so it is their sum, and no moment is computed twice.
        steps = max(1, round(time / air.exposure * len(air.times)))
        added_times = air.times[before:steps]
        if len(added_times):
            psfs = make_psfs(
                telescope,
                np.zeros((1, 2)),
                [_SPECKLE_WAVELENGTH],
                atmosphere=air.at_times(added_times),
                stamps=Stamps(
                    _SPECKLE_STAMP, _SPECKLE_PIXEL * ARCSEC * telescope.reference_sphere_radius, diffusion=0.0
                ),
                engine=WaveEngine(pupil_spacing=bench.scale.speckle_spacing),
                threads=bench.threads,
            )
            total = total + len(added_times) * float(psfs.inside[0]) * psfs.image[0]
            before = steps
        images.append(total / total.sum())
    air.release()
    stack = np.array(images)
    pixel = _SPECKLE_PIXEL * ARCSEC
    coarse = _SPECKLE_STAMP // _SPECKLE_BLOCK
    binned = stack.reshape(-1, coarse, _SPECKLE_BLOCK, coarse, _SPECKLE_BLOCK).sum(axis=(2, 4))
    width = fwhm(binned, _SPECKLE_BLOCK * pixel) / ARCSEC
    # An instantaneous image is a speckle pattern without a meaningful width.
    width[np.array(_TIMES) < 1.0] = np.nan
    shapes = measure_shapes(stack, pixel, _WEIGHT)
    e = shapes.e1 + 1j * shapes.e2
    theory = long_exposure_fwhm(
        _SPECKLE_WAVELENGTH,
        air.r0,
        air.outer_scale,
        diameter=telescope.pupil_diameter,
        obscuration=telescope.pupil_obscuration,
    )
    columns = {
        "EXPTIME": (np.array(_TIMES), "s", "exposure; 0 for one moment"),
        "FWHM": (width, "arcsec", "none while speckles stand apart"),
        "E1": (e.real, "", "ellipticity along x"),
        "E2": (e.imag, "", "ellipticity along x = y"),
    }
    hdus = [image_hdu("PSF", stack, f"unit sum, pixels of {_SPECKLE_PIXEL} arcsec"), table_hdu("SHAPES", columns)]
    measured = {
        "fwhm_15_s_arcsec": float(width[-1]),
        "fwhm_theory_arcsec": theory / ARCSEC,
        "e_one_moment": float(abs(e[0])),
        "e_15_s": float(abs(e[-1])),
    }
    agrees = abs(width[-1] - 0.5) < 0.07 and abs(e[-1]) < abs(e[0])
    return Reproduced(
        {"": _speckles_plot(stack, _TIMES, width, e, _SPECKLE_PIXEL)},
        {"": FitsData(hdus, [("WAVELEN", _SPECKLE_WAVELENGTH * 1e9, "[nm] wavelength")])},
        f'FWHM {width[-1]:.3f}" after 15 s (theory of an endless exposure {theory / ARCSEC:.3f}"); |e|'
        f" {100 * abs(e[0]):.0f} % at one moment, {100 * abs(e[-1]):.1f} % after 15 s",
        agrees,
        f"one star, {len(air.times)} moments by Fourier optics, no optics and no charge diffusion, as in the paper;"
        ' the width is that on pixels of 0.1"',
        measured,
    )


def _speckles_plot(images: np.ndarray, times: Sequence[float], width: np.ndarray, e: np.ndarray, pixel: float) -> bytes:
    """Draw one star after each exposure time, over its peak, with its FWHM and |e|."""
    half = 0.5 * pixel * images.shape[1]
    with styled():
        figure = new_figure(10.2, 7.0)
        panels = figure.subplots(2, -(-len(images) // 2), sharex=True, sharey=True).ravel()
        for i, (axes, stamp) in enumerate(zip(panels, images, strict=False)):
            image = axes.imshow(
                stamp / stamp.max(), extent=(-half, half, -half, half), cmap="magma", vmin=0.0, vmax=1.0
            )
            size = f'FWHM {width[i]:.2f}", ' if np.isfinite(width[i]) else ""
            time = f"{times[i]:g} s" if times[i] else "one moment"
            axes.set_title(f"{time}: {size}|e| {100 * abs(e[i]):.1f} %", loc="left", fontsize=9)
            if i >= len(panels) // 2:
                axes.set_xlabel("x [arcsec]")
            if i % (len(panels) // 2) == 0:
                axes.set_ylabel("y [arcsec]")
        bar = figure.colorbar(image, ax=list(panels), fraction=0.02, pad=0.01, aspect=40)
        bar.set_label("over the peak of each")
        return png_bytes(figure)


@figure(
    "fig6",
    "ellipticity by the atmosphere alone",
    "mean |e| below 1 % in 15 s, coherent over about 1'; xi+ falls with exposure time (1, 5, 15, 60 s), near 2e-5"
    " at most",
    minutes=(0.15, 15.0),
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
            _SITE,
            bench.seed,
            epoch=epoch,
            exposure=max(_EXPOSURES),
            screens=ScreenSampling(screen_size=scale.screen_size),
        )
        for time in _EXPOSURES:
            begun = shortened_exposure(air, time, scale.time_step)
            e_pairs = _atmosphere_ellipticity(bench, begun, pairs)
            correlated[time].append(
                shear_correlation(
                    pairs[:, 0],
                    pairs[:, 1],
                    e_pairs.real,
                    e_pairs.imag,
                    bins=SeparationBins(*_SEPARATIONS, _BINS),
                )
            )
            mean_e[time].append(float(np.abs(e_pairs).mean()))
            if time == _VISIT:
                visits.append(e_pairs)
                if epoch == 0:
                    e = _atmosphere_ellipticity(bench, begun, fields)
        begun.release()
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
    values = ", ".join(f"{level:.0e}" for level in levels)
    return Reproduced(
        {"": _atmosphere_plot(fields / ARCMIN, e, r, xi)},
        {
            "": EcsvData(whisker, meta),
            "_stars": EcsvData(correlated_stars, meta),
            "_correlation": EcsvData(curve, meta),
        },
        f"mean |e| {100 * measured['mean_e_15_s']:.2f} % in 15 s; xi+ at 1' {values} for 1, 5, 15, 60 s (mean of"
        f" {scale.pair_seeds} exposures; +-{xi[_VISIT][1][near]:.0e} for 15 s)",
        agrees,
        "in all but the level at most: the ground layer at exactly 0 km gives all stars of an exposure one ellipticity"
        f" in common ({100 * measured['shared_e_rms']:.1f} % rms in 15 s), so that xi+ differs much between exposures"
        " and levels off beyond 1'",
        measured,
    )


def shortened_exposure(air: Atmosphere, exposure: float, time_step: float) -> Atmosphere:
    """Return the first part of an exposure, with the same screens and at least 100 time steps."""
    count = max(100, round(exposure / time_step))
    return air.at_times((np.arange(count) + 0.5) * (exposure / count), exposure)


def _atmosphere_ellipticity(bench: Bench, air: Atmosphere, fields: np.ndarray) -> np.ndarray:
    """Return complex ellipticities of stars through the atmosphere alone."""
    telescope = ideal_telescope(bench.optics.telescope)
    pixel = 0.2 * ARCSEC
    psfs = make_psfs(
        telescope,
        fields,
        [_WAVELENGTH],
        atmosphere=air,
        stamps=Stamps(pixel_size=pixel * telescope.reference_sphere_radius, diffusion=0.0),
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
        whisker_axes, xi_axes = figure.subplots(1, 2)
        edge = 7.2
        key = key_ellipticity(np.abs(e))
        scale = 0.5 / key
        draw_whiskers(whisker_axes, whiskers(positions[:, 0], positions[:, 1], e.real, e.imag, scale), TRUTH, 0.7)
        whisker_axes.set(
            xlim=(-edge, edge), ylim=(-edge, edge), aspect="equal", xlabel="x [arcmin]", ylabel="y [arcmin]"
        )
        whisker_axes.set_title(f"15 s, atmosphere alone: mean |e| {100 * np.abs(e).mean():.2f} %", loc="left")
        draw_key_whisker(whisker_axes, key, scale, 1.0)
        for (time, (plus, error, minus)), color in zip(xi.items(), _COLORS, strict=True):
            xi_axes.errorbar(r, plus, error, fmt="o-", color=color, markersize=3, linewidth=1.2, capsize=2)
            xi_axes.plot(r, minus, "--", color=color, linewidth=1.0)
            xi_axes.plot([], [], "o-", color=color, markersize=3, label=f"{time:g} s")
        xi_axes.plot([], [], "-", color="0.3", label="ξ+")
        xi_axes.plot([], [], "--", color="0.3", label="ξ-")
        xi_axes.axhline(0.0, color="0.7", linewidth=0.6)
        xi_axes.set_xscale("log")
        xi_axes.set_yscale("symlog", linthresh=1e-5)
        xi_axes.set_xticks([0.3, 0.5, 1, 2, 5, 10], ["0.3", "0.5", "1", "2", "5", "10"])
        xi_axes.minorticks_off()
        xi_axes.set(xlabel="separation [arcmin]", ylabel="correlation of the ellipticity")
        xi_axes.set_title("mean of the exposures, with the error of that mean", loc="left")
        figure.legend(*xi_axes.get_legend_handles_labels(), ncols=6, loc="outside lower right")
        return png_bytes(figure)
