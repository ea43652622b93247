"""PSF against exposure time (Jee & Tyson 2011, Fig. 5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...core.plotting import new_figure, png_bytes, styled
from ...core.products import image_hdu, table_hdu
from ...core.units import ARCSEC
from ...models.ideal_telescope import without_aberration
from ...pipeline.measure.shapes import fwhm, measure_shapes
from ...wavefront.atmosphere.atmosphere import Atmosphere
from ...wavefront.atmosphere.turbulence import long_exposure_fwhm
from ...wavefront.psf.psf import make_psfs
from .bench import Bench
from .figure import FitsData, Reproduced, figure

_SITE = "cerro_pachon"
_TIMES = (0.0, 0.5, 1.0, 2.0, 5.0, 15.0)
_SPECKLE_WAVELENGTH = 600e-9
_SPECKLE_PIXEL, _SPECKLE_STAMP = 0.02, 125
#: Pixels of the width over those of the speckles: single speckles do not define a width.
_SPECKLE_BLOCK = 5
#: FWHM of the weight of the moments [rad].
_WEIGHT = 0.7 * ARCSEC


@figure(
    "fig5",
    "the PSF against exposure time",
    'speckles that add up to a rounder, smoother image; FWHM about 0.5" after 15 s at 600 nm',
    minutes=(0.3, 11.0),
)
def speckles(bench: Bench) -> Reproduced:
    """Expose one star for up to 15 s through turbulence alone, by the wave engine (Fig. 5)."""
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
