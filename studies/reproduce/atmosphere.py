"""Figures of Jee & Tyson (2011) that the atmosphere makes alone: dispersion, screens, speckles, ellipticities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...core.products import image_hdu, table_hdu
from ...core.random_streams import stream
from ...core.units import ARCMIN, ARCSEC
from ...models.ideal_telescope import without_aberration
from ...models.io.prescription import load_telescope
from ...models.io.site_file import load_site
from ...pipeline.measure.correlation import Correlation, shear_correlation
from ...pipeline.measure.shapes import fwhm, measure_shapes
from ...wavefront.atmosphere.atmosphere import Atmosphere
from ...wavefront.atmosphere.refraction import dispersion_shift
from ...wavefront.atmosphere.turbulence import long_exposure_fwhm, path_variance
from ...wavefront.psf.psf import make_psfs
from .drawing import atmosphere_figure, dispersion_figure, screens_figure, speckles_figure
from .parts import Bench, EcsvData, FitsData, Reproduced

_SITE = "cerro_pachon"
_BANDS = "ugrizy"
_LARGEST_ZENITH = 60
_SEEING = 0.7
#: So large a piece of the screens is drawn and kept [m], with at most so many samples on a side.
_PIECE, _KEPT = 200.0, 400
_TIMES = (0.0, 0.5, 1.0, 2.0, 5.0, 15.0)
_SPECKLE_WAVELENGTH = 600e-9
_SPECKLE_PIXEL, _SPECKLE_STAMP = 0.02, 125
#: Pixels of the width are so many of the speckles' on a side: half of one bright speckle says nothing of it.
_SPECKLE_BLOCK = 5
_EXPOSURES = (1.0, 5.0, 15.0, 60.0)
_VISIT = 15.0
_WAVELENGTH = 620e-9
#: Half the side of a CCD on the sky [rad], and the weight of the moments [rad].
_HALF_CCD, _WEIGHT = 6.8 * ARCMIN, 0.7 * ARCSEC
_PAIRS: dict[str, Any] = {"min_sep": 0.3 * ARCMIN, "max_sep": 12.0 * ARCMIN, "n_bins": 9}


def dispersion(bench: Bench) -> Reproduced:
    """Compute how far apart the air puts the edges of each band (Fig. 3)."""
    weather = load_site(_SITE).weather
    zenith = np.arange(0, _LARGEST_ZENITH + 1, dtype=np.float64)
    spread = {}
    for band in _BANDS:
        telescope = load_telescope(f"lsst_v3.3_{band}")
        edges = telescope.band or telescope.wavelength_range
        shift = np.array([dispersion_shift(edges, edges[0], z, 0.0, weather) for z in np.deg2rad(zenith)])
        spread[band] = np.abs(shift[:, 1, 0]) / ARCSEC
    at_45 = {band: float(values[45]) for band, values in spread.items()}
    # A line of length d adds d^2/12 to the variance of a round image along it.
    variance = (_SEEING / math.sqrt(8.0 * math.log(2.0))) ** 2
    longer = math.sqrt(1.0 + max(at_45["r"], at_45["i"]) ** 2 / 12.0 / variance)
    e = (longer - 1.0) / (longer + 1.0)
    squared = (longer**2 - 1.0) / (longer**2 + 1.0)
    measured = {f"{band}_at_45_deg_arcsec": value for band, value in at_45.items()}
    measured |= {
        "elongation": longer - 1.0,
        "elongation_of_variance": longer**2 - 1.0,
        "e": e,
        "e_squared_axes": squared,
    }
    columns = {"zenith_angle_deg": (zenith, "deg", "zenith angle")}
    columns |= {f"{b}_arcsec": (v, "arcsec", f"dispersion between the edges of {b}") for b, v in spread.items()}
    agrees = max(at_45["r"], at_45["i"]) < 0.35 and e <= 0.04
    return Reproduced(
        {"": dispersion_figure(zenith, spread)},
        {"": EcsvData(columns, {"site": _SITE, "formula": "Filippenko 1982"})},
        'r and i below about 0.3" at 45°: 9 % elongation, |e| up to 0.04 at 0.7" seeing',
        f'at 45°: r {at_45["r"]:.2f}", i {at_45["i"]:.2f}" from edge to edge; at 0.7" seeing'
        f" {100 * (longer - 1.0):.0f} % longer, {100 * (longer**2 - 1.0):.0f} % in variance, |e| = {e:.3f}",
        "agrees" if agrees else "differs",
        "with light spread evenly over the band, in (a-b)/(a+b); the paper's 9 % and 0.04 are those of the variance and"
        f" of (a²-b²)/(a²+b²), here {squared:.3f}. Edges are those of the bands of v3.3",
        measured,
    )


def screens(bench: Bench) -> Reproduced:
    """Draw the screens of the six layers and compare their strength with theory (Fig. 4)."""
    air = Atmosphere.from_site(_SITE, bench.seed, screen_size=bench.scale.screen_size)
    across = round(_PIECE / air.screen_pixel)
    block = -(-across // _KEPT)
    size = across // block
    path = np.empty((air.layer_count, size, size))
    rms = np.empty(air.layer_count)
    for layer in range(air.layer_count):
        screen = air.low_screen(layer, "samples", threads=bench.threads)
        rms[layer] = np.sqrt(np.mean(np.square(screen, dtype=np.float64))) * 1e6
        piece = screen[: size * block, : size * block].reshape(size, block, size, block)
        path[layer] = piece.mean(axis=(1, 3), dtype=np.float64) * 1e6
    theory = np.sqrt(path_variance(air.r0, air.outer_scale) * air.weights) * 1e6
    ratio = rms / theory
    total = float(np.sqrt((rms**2).sum() / (theory**2).sum()))
    layers = {
        "ALTITUDE": (air.altitudes / 1e3, "km", "above the telescope"),
        "WEIGHT": (air.weights, "", "fraction of the turbulence"),
        "WIND_X": (air.velocities[:, 0], "m/s", "wind along x"),
        "WIND_Y": (air.velocities[:, 1], "m/s", "wind along y"),
        "RMS": (rms, "um", "rms path of the screen"),
        "RMS_THEO": (theory, "um", "rms path by von Karman theory, all modes"),
    }
    hdus = [
        image_hdu("PATH", path, f"path [um], a piece of each low screen; means of {block} x {block} samples"),
        table_hdu("LAYERS", layers),
    ]
    cards = [
        ("SIDE", air.screen_length, "[m] side of the screens"),
        ("STEP", block * air.screen_pixel, "[m] side of a pixel of PATH"),
        ("SAMPLES", air.screen_size, "samples on a side as they are used"),
        ("R0", air.r0, "[m] Fried parameter at 500 nm"),
        ("L0", air.outer_scale, "[m] outer scale"),
    ]
    return Reproduced(
        {
            "": screens_figure(
                path, size * block * air.screen_pixel, air.altitudes, air.weights, bench.telescope.pupil_diameter
            )
        },
        {"": FitsData(hdus, cards)},
        "six von Karman screens, 8192² over 1.3 km; r0 = 0.16 m, L0 = 25 m, weights 0.652 to 0.022",
        f"six screens, {air.screen_size}² over {air.screen_length / 1e3:g} km; rms path {total:.3f} of theory over all,"
        f" {ratio.min():.3f} to {ratio.max():.3f} layer by layer",
        "agrees" if abs(total - 1.0) < 0.05 else "differs",
        "modes are Gaussian, where the paper's eq. 2 gives each a fixed modulus; modes too fine for this screen are on"
        " a second one, which is not drawn",
        {"rms_um": rms, "rms_theory_um": theory, "rms_over_theory": total},
    )


def speckles(bench: Bench) -> Reproduced:
    """Follow one star through 15 s of turbulence, without optics and charge diffusion (Fig. 5), by the wave engine."""
    size, length = bench.scale.speckle_screen
    telescope = without_aberration(bench.telescope)
    air = Atmosphere.from_site(
        _SITE,
        bench.seed,
        exposure=_TIMES[-1],
        time_step=bench.scale.speckle_step,
        screen_size=size,
        screen_length=length,
        fine_size=1024,
    )
    images, before = [], 0
    total = np.zeros((_SPECKLE_STAMP, _SPECKLE_STAMP))
    for time in _TIMES:
        # An exposure goes on from the one before, so it is their sum, and no moment is computed twice.
        steps = max(1, round(time / air.exposure * len(air.times)))
        new = air.times[before:steps]
        if len(new):
            psfs = make_psfs(
                telescope,
                np.zeros((1, 2)),
                [_SPECKLE_WAVELENGTH],
                atmosphere=air.at_times(new),
                engine="wave",
                pixel_size=_SPECKLE_PIXEL * ARCSEC * telescope.reference_sphere_radius,
                stamp_size=_SPECKLE_STAMP,
                diffusion=0.0,
                pupil_spacing=bench.scale.speckle_spacing,
                threads=bench.threads,
            )
            total = total + len(new) * float(psfs.inside[0]) * psfs.image[0]
            before = steps
        images.append(total / total.sum())
    air.release()
    stack = np.array(images)
    pixel = _SPECKLE_PIXEL * ARCSEC
    coarse = _SPECKLE_STAMP // _SPECKLE_BLOCK
    binned = stack.reshape(-1, coarse, _SPECKLE_BLOCK, coarse, _SPECKLE_BLOCK).sum(axis=(2, 4))
    width = fwhm(binned, _SPECKLE_BLOCK * pixel) / ARCSEC
    # One moment is a heap of speckles, of no width that means anything.
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
        {"": speckles_figure(stack, _TIMES, width, e, _SPECKLE_PIXEL)},
        {"": FitsData(hdus, [("WAVELEN", _SPECKLE_WAVELENGTH * 1e9, "[nm] wavelength")])},
        'speckles that add up to a rounder, smoother image; FWHM about 0.5" after 15 s at 600 nm',
        f'FWHM {width[-1]:.3f}" after 15 s (theory of an endless exposure {theory / ARCSEC:.3f}"); |e|'
        f" {100 * abs(e[0]):.0f} % at one moment, {100 * abs(e[-1]):.1f} % after 15 s",
        "agrees" if agrees else "differs",
        f"one star, {len(air.times)} moments by Fourier optics, no optics and no charge diffusion, as in the paper;"
        ' the width is that on pixels of 0.1"',
        measured,
    )


def ellipticity(bench: Bench) -> Reproduced:
    """Measure ellipticities by the atmosphere alone on one CCD, and correlate them (Fig. 6), by the fast engine."""
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
            seen = _atmosphere_ellipticity(bench, begun, pairs)
            correlated[time].append(shear_correlation(pairs[:, 0], pairs[:, 1], seen.real, seen.imag, **_PAIRS))
            mean_e[time].append(float(np.abs(seen).mean()))
            if time == _VISIT:
                visits.append(seen)
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
        {"": atmosphere_figure(fields / ARCMIN, e, r, xi)},
        {
            "": EcsvData(whisker, meta),
            "_stars": EcsvData(correlated_stars, meta),
            "_correlation": EcsvData(curve, meta),
        },
        "mean |e| below 1 % in 15 s, coherent over about 1'; xi+ falls with exposure time (1, 5, 15, 60 s), near 2e-5"
        " at most",
        f"mean |e| {100 * measured['mean_e_15_s']:.2f} % in 15 s; xi+ at 1' {told} for 1, 5, 15, 60 s (mean of"
        f" {scale.pair_seeds} exposures; +-{xi[_VISIT][1][near]:.0e} for 15 s)",
        "agrees" if agrees else "differs",
        "in all but the level at most: the ground layer at exactly 0 km gives all stars of an exposure one ellipticity"
        f" in common ({100 * measured['shared_e_rms']:.1f} % rms in 15 s), so that xi+ differs much between exposures"
        " and levels off beyond 1'",
        measured,
    )


def beginning(air: Atmosphere, exposure: float, time_step: float) -> Atmosphere:
    """Return the beginning of a longer exposure, through the same screens, in 100 moments or more."""
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
