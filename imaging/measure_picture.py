"""Picture of a measured image, by which to judge it: objects on the image, stellar locus, stars and their PSF."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import EllipseCollection

from ..core.number_text import counted
from ..core.plotting import BLUE, ORANGE, new_figure, png_bytes, styled
from .image_psf import psfs_on
from .measure import ImageCatalogue
from .stretch import draw_image, pixel_scale_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Stars of the largest S/N in the mean star.
_MEAN_OF = 100
#: Semi-major axes of the ellipses of galaxies [rms width with the PSF].
_ELLIPSE = 3.0


def measured_png(catalogue: ImageCatalogue) -> bytes:
    """Return the picture of a catalogue as PNG.

    Stars are circles, usable galaxies ellipses of three rms widths. Below are the mean of the stars by flux, of the
    PSFs at their places, and the difference, on a scale of a twentieth of the peak.
    """
    with styled():
        figure = new_figure(11.0, 9.0)
        grid = figure.add_gridspec(2, 6, height_ratios=(2.2, 1.0))
        _draw_objects(figure.add_subplot(grid[0, :4]), catalogue)
        catalogue.plot(ax=figure.add_subplot(grid[0, 4:]))
        _draw_ellipticities(figure.add_subplot(grid[1, 4:]), catalogue)
        lower_axes = [figure.add_subplot(grid[1, k : k + 1]) for k in range(3)]
        _draw_mean_star(lower_axes, catalogue)
        return png_bytes(figure)


def _draw_objects(axes: Axes, catalogue: ImageCatalogue) -> None:
    """Draw the image with its stars and usable galaxies."""
    image, objects = catalogue.image, catalogue.objects
    draw_image(axes, image.image, image.variance, image.header)
    scale = pixel_scale_of(image.header) if image.has_sky else 1.0
    ny, nx = image.image.shape

    def places(rows: np.ndarray) -> np.ndarray:
        return scale * np.stack([objects.x[rows] - 0.5 * (nx - 1), objects.y[rows] - 0.5 * (ny - 1)], axis=1)

    galaxies, stars = catalogue.galaxies[catalogue.usable], catalogue.stars.index
    for rows, color, minor, theta in (
        (galaxies, BLUE, objects.b, objects.theta),
        (stars, ORANGE, objects.a, np.zeros(len(objects))),
    ):
        axes.add_collection(
            EllipseCollection(
                2.0 * _ELLIPSE * scale * objects.a[rows],
                2.0 * _ELLIPSE * scale * minor[rows],
                np.rad2deg(theta[rows]),
                units="xy",
                offsets=places(rows),
                offset_transform=axes.transData,
                facecolors="none",
                edgecolors=color,
                linewidths=0.8,
            )
        )
    galaxies = counted(int(catalogue.usable.sum()), "usable galaxy", "usable galaxies")
    title = f"{image.name}: {counted(len(catalogue.stars), 'star')}, {galaxies}"
    axes.set_title(title, loc="left")


def _draw_ellipticities(axes: Axes, catalogue: ImageCatalogue) -> None:
    """Draw e1 and e2 of the usable galaxies before the PSF."""
    usable = catalogue.usable
    axes.plot(catalogue.fits.e1[usable], catalogue.fits.e2[usable], ".", color=BLUE, markersize=3)
    axes.set(xlim=(-1, 1), ylim=(-1, 1), aspect="equal", xlabel="e1 of galaxies", ylabel="e2")


def _draw_mean_star(row: list[Axes], catalogue: ImageCatalogue) -> None:
    """Draw the mean star, the mean PSF at the same places and the difference."""
    stars = catalogue.stars
    brightest = np.argsort(-stars.snr, kind="stable")[:_MEAN_OF]
    if not len(brightest):
        for axes in row:
            axes.set_axis_off()
        return
    stamps = stars.stamps[brightest]
    # By flux: faint stars have their noise, and a galaxy among them.
    flux = stamps.sum(axis=(1, 2))
    places, colours = stars.positions[brightest], catalogue.colours
    star_colours: np.ndarray | float | None = None
    if colours is not None:
        star_colours = colours.at(places)
        star_colours = colours.mean if np.isnan(star_colours).all() else star_colours
    psfs = psfs_on(catalogue.image, catalogue.psf, places, None, star_colours) * flux[:, None, None]
    side = min(stamps.shape[1], psfs.shape[1])
    mean_star, mean_psf = (_middle(images.sum(axis=0), side) / flux.sum() for images in (stamps, psfs))
    peak = float(mean_psf.max())
    for axes, values, top, title in (
        (row[0], mean_star, peak, "mean star"),
        (row[1], mean_psf, peak, "mean PSF there"),
        (row[2], mean_star - mean_psf, 0.05 * peak, "difference x 20"),
    ):
        axes.imshow(values, cmap="RdBu_r", vmin=-top, vmax=top, origin="lower")
        axes.set(xticks=[], yticks=[])
        axes.set_title(title, fontsize=8.5)


def _middle(image: np.ndarray, side: int) -> np.ndarray:
    first = (image.shape[0] - side) // 2
    return image[first : first + side, first : first + side]
