"""Pictures of images of CCDs: a whole CCD, and a cutout at several depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes

from ..core.plotting import ORANGE, new_figure, plain_text, png_bytes, styled
from ..core.units import ARCSEC
from .image_file import CcdImage
from .scene import CcdScene

#: Side of the cutouts [arcsec], and the long exposure beside the run's [s], as in Jee & Tyson 2011, fig. 10.
CUTOUT, DEEP = 100.0, 6000.0
#: Pixels along a side of the picture of a whole CCD, at most.
_MOST = 1024
#: Softening of the asinh stretch, and its upper end, in rms of the background.
_SOFT, _TOP = 3.0, 150.0


def preview_png(image: CcdImage) -> bytes:
    """Return a picture of an image, binned to about a thousand pixels, axes in arcsec from its middle."""
    data = image.image - _background_level(image)
    step = -(-max(data.shape) // _MOST)
    ny, nx = (n // step * step for n in data.shape)
    binned = data[:ny, :nx].reshape(ny // step, step, nx // step, step).mean(axis=(1, 3))
    noise = float(np.sqrt(np.median(image.variance))) / step
    with styled():
        figure = new_figure(7.0, 6.6)
        axes = figure.subplots()
        show_stretched(axes, binned, noise, pixel_scale_of(image) * step)
        draw_compass(axes, image)
        header = image.header
        axes.set_title(
            f"{plain_text(image.name)}, {plain_text(header['FILTER'])} band, {header['EXPTIME']:g} s", loc="left"
        )
        return png_bytes(figure)


def cutouts_png(scene: CcdScene, *, threads: int | None = None) -> bytes:
    """Return a cutout of 100 arcsec in one exposure, in 6000 s and without noise, side by side."""
    settings = scene.exposure
    deep = replace(settings, exposures=max(1, round(DEEP / settings.time)))
    panels = [
        (f"{settings.time:g} s", replace(settings, exposures=1, noise=True)),
        (f"{deep.total_time:g} s", replace(deep, noise=True)),
        ("without noise", replace(deep, noise=False)),
    ]
    part = _central_window(scene)
    with styled():
        figure = new_figure(10.5, 3.9)
        for axes, (title, exposure) in zip(figure.subplots(1, 3), panels, strict=True):
            image = part.exposed(exposure, threads=threads)
            show_stretched(
                axes,
                image.image - _background_level(image),
                float(np.sqrt(np.median(image.variance))),
                pixel_scale_of(image),
            )
            axes.set_title(f"{plain_text(scene.name)}, {exposure.band} band, {title}", loc="left")
            if axes.get_subplotspec().is_first_col():
                draw_compass(axes, image)
            else:
                axes.set_ylabel("")
        return png_bytes(figure)


def _central_window(scene: CcdScene) -> CcdScene:
    """Return the middle of a scene, as large as a cutout or the scene."""
    side = round(CUTOUT * ARCSEC / scene.exposure.pixel_scale)
    height, width = (min(side, n) for n in scene.electrons.shape)
    y, x = (scene.electrons.shape[0] - height) // 2, (scene.electrons.shape[1] - width) // 2
    window = replace(scene.window, x=scene.window.x + x, y=scene.window.y + y, width=width, height=height)
    return replace(scene, electrons=scene.electrons[y : y + height, x : x + width], window=window)


def _background_level(image: CcdImage) -> float:
    """Return the background that is left in an image [ADU]."""
    return 0.0 if image.header["SKYSUB"] else float(image.header["SKY"])


def pixel_scale_of(image: CcdImage) -> float:
    """Return the side of a pixel at the reference point [arcsec]."""
    return float(np.sqrt(abs(np.linalg.det(_cd_matrix(image))))) * 3600.0


def _cd_matrix(image: CcdImage) -> np.ndarray:
    return np.array([[image.header[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)])


def show_stretched(axes: Axes, data: np.ndarray, noise: float, scale: float) -> None:
    """Draw an image with an asinh stretch in units of its noise; pixels of `scale` arcsec."""
    height, width = (0.5 * scale * n for n in data.shape)
    stretched = np.arcsinh(data / (_SOFT * noise)) / np.arcsinh(_TOP / _SOFT)
    axes.imshow(stretched, cmap="gray", vmin=-0.12, vmax=1.0, extent=(-width, width, -height, height), origin="lower")
    axes.set_xlabel("x [arcsec]")
    axes.set_ylabel("y [arcsec]")


def draw_compass(axes: Axes, image: CcdImage) -> None:
    """Draw arrows towards north and east in a corner."""
    # Columns of the inverse of CD are the steps in pixels for a step in xi (east) and in eta (north).
    steps = np.linalg.inv(_cd_matrix(image))
    start, length = np.array([0.88, 0.12]), 0.07
    for label, step in zip("EN", steps.T, strict=True):
        end = start + length * step / np.hypot(*step)
        arrow = {"arrowstyle": "->", "color": ORANGE}
        axes.annotate("", tuple(end), tuple(start), "axes fraction", "axes fraction", arrowprops=arrow)
        x, y = start + 1.25 * (end - start)
        axes.text(x, y, label, color=ORANGE, ha="center", va="center", transform=axes.transAxes)
