"""Pictures of images of CCDs: a whole CCD, and a cutout at several depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.plotting import new_figure, plain_text, png_bytes, styled
from .image_file import CcdImage
from .scene import CcdScene, deep_exposures, middle_window
from .stretch import draw_compass, pixel_scale_of, show_stretched, sky_level


def preview_png(image: CcdImage) -> bytes:
    """Return the picture of an image as PNG."""
    return png_bytes(image.plot())


def cutouts_png(scene: CcdScene, *, threads: int | None = None) -> bytes:
    """Return a cutout of 100 arcsec in one exposure, in 6000 s and without noise, side by side."""
    settings = scene.exposure
    deep = replace(settings, exposures=deep_exposures(settings))
    panels = [
        (f"{settings.time:g} s", replace(settings, exposures=1, noise=True)),
        (f"{deep.total_time:g} s", replace(deep, noise=True)),
        ("without noise", replace(deep, noise=False)),
    ]
    central_scene = _middle(scene)
    with styled():
        figure = new_figure(10.5, 3.9)
        for axes, (title, exposure) in zip(figure.subplots(1, 3), panels, strict=True):
            image = central_scene.exposed(exposure, threads=threads)
            show_stretched(
                axes,
                image.image - sky_level(image.header),
                float(np.sqrt(np.median(image.variance))),
                pixel_scale_of(image.header),
            )
            axes.set_title(f"{plain_text(scene.name)}, {exposure.band} band, {title}", loc="left")
            if axes.get_subplotspec().is_first_col():
                draw_compass(axes, image.header)
            else:
                axes.set_ylabel("")
        return png_bytes(figure)


def _middle(scene: CcdScene) -> CcdScene:
    """Return the middle of a scene, as large as a cutout or the scene."""
    window = middle_window(scene.window, scene.exposure)
    y, x = window.y - scene.window.y, window.x - scene.window.x
    return replace(scene, electrons=scene.electrons[y : y + window.height, x : x + window.width], window=window)
