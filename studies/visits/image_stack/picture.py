"""Picture of one part of the sky in stacks of increasing depth."""

from __future__ import annotations

import numpy as np

from ....core.number_text import counted
from ....core.plotting import new_figure, png_bytes, styled
from ....imaging.image_file import CcdImage
from ....imaging.scene import CUTOUT
from ....imaging.stretch import draw_compass, pixel_scale_of, show_stretched


def stacks_png(images: dict[int, CcdImage]) -> bytes:
    """Return the middle 100 arcsec of the stacks of a tile by number of visits, each in units of its own noise."""
    with styled():
        figure = new_figure(3.5 * len(images), 3.9)
        for axes, (visits, image) in zip(np.atleast_1d(figure.subplots(1, len(images))), images.items(), strict=True):
            scale = pixel_scale_of(image.header)
            side = min(round(CUTOUT / scale), *image.image.shape)
            y, x = ((n - side) // 2 for n in image.image.shape)
            noise = float(np.sqrt(np.median(image.variance[image.mask == 0])))
            show_stretched(axes, image.image[y : y + side, x : x + side], noise, scale)
            axes.set_title(f"{counted(visits, 'visit')}, {image.header['EXPTIME']:g} s", loc="left")
            if axes.get_subplotspec().is_first_col():
                draw_compass(axes, image.header)
            else:
                axes.set_ylabel("")
        return png_bytes(figure)
