"""Images of the CCDs of a visit: galaxies and stars of the sky, registered to it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ....imaging.draw import Window, add_stamps, draw_galaxies
from ....imaging.exposure import ExposedImage, Exposure, expose
from ....imaging.galaxies import SkyGalaxies
from ....imaging.psf_field import PsfField, to_pixel
from ....imaging.scene import STAR_ROOM, galaxies_near
from ....pipeline.experiment import Experiment
from ....pipeline.simulate.ccd_exposure import NoiseFreeStars, expose_centered, expose_positions
from ....pipeline.simulate.star_field import magnitudes_at
from ..plan import Visit
from ..psf_visit import magnitude_limits, middle_wavelength
from ..sky_points import SkyPoints
from .visit_wcs import VisitWcs

#: Pixels along the edges of a CCD that are not stacked. A star beyond the edge is not drawn; of a drawn one, less than
#: 1e-5 of the light a pixel falls so far away.
RIM = 20
#: Bit of the mask of the rim.
EDGE = 2
#: Least distance of a star from the edge of the CCD [pixel]: its height moves it by micrometres.
_LEAST_DEPTH = 2


@dataclass(frozen=True, eq=False)
class Sky:
    """Stars and galaxies of the sky, the same in all visits.

    Attributes
    ----------
    points : SkyPoints
        Stars, and places where the PSF is known too.
    galaxies : callable
        Galaxies with xi and eta in two ranges [rad].
    """

    points: SkyPoints
    galaxies: SkyGalaxies


def visit_image(
    experiment: Experiment,
    visit: Visit,
    name: str,
    wcs: VisitWcs,
    sky: Sky,
    exposure: Exposure,
    window: Window,
    *,
    depth: int = 1,
    threads: int | None = None,
) -> ExposedImage:
    """Draw and expose a CCD of a visit, or a part of it.

    Stars are those of :func:`~..psf_visit.visit_psfs`, each with its own PSF; galaxies have the PSF of these stars and
    of the places between them, interpolated. The image is registered exactly: centroids of stars are where the sky is
    without turbulence and heights, as those of the PSFs of a visit are centred.

    Parameters
    ----------
    experiment : Experiment
        The experiment of the visit, its screens made.
    visit : Visit
        Pointing and roll.
    name : str
        Name of the CCD.
    wcs : VisitWcs
        Its world coordinates.
    sky : Sky
        Stars and galaxies.
    exposure : Exposure
        Depth and noise of one visit.
    window : Window
        Part of the CCD.
    depth : int
        Visits of the deepest stack, below whose noise the light that galaxies lose must stay.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.

    Raises
    ------
    PachonError
        If the PSF of the CCD cannot be fitted, or no light reaches a star.
    """
    config, points, camera = experiment.config, sky.points, experiment.camera
    pixels = camera.pixels[camera.ccd_index(name)]
    xy = visit.on_detector(experiment.telescope, points.sky, middle_wavelength(experiment), threads)
    at = to_pixel(experiment, name, xy)
    inside = (np.abs(at - 0.5 * (pixels - 1)) <= 0.5 * pixels - _LEAST_DEPTH).all(axis=1)
    rows = np.flatnonzero(inside & (np.hypot(xy[:, 0], xy[:, 1]) <= experiment.field_radius_on_detector))

    def expose_stars(experiment: Experiment) -> NoiseFreeStars:
        return expose_centered(experiment, xy[rows], threads, along=name)

    psfs = expose_stars(experiment)
    field = PsfField.of_stars(experiment, name, xy[rows], psfs, expose_stars)
    galaxies = galaxies_near(sky.galaxies, wcs, window)
    places = wcs.to_pixel(np.stack([galaxies.xi, galaxies.eta], axis=1))
    electrons = exposure.electrons(galaxies.magnitude) * field.lit_fraction(places)
    noise = exposure.noise_rms / np.sqrt(depth)
    scene = draw_galaxies(galaxies, electrons, field, wcs, window=window, noise=noise, threads=threads)
    reach = 0.5 * (field.stamp + STAR_ROOM)
    star_rows = np.flatnonzero(points.star[rows] & window.contains(at[rows], reach))
    if len(star_rows):
        nearest = np.rint(at[rows[star_rows]])
        offsets = at[rows[star_rows]] - nearest + psfs.offset[star_rows]
        stars = expose_positions(experiment, xy[rows[star_rows]], threads, room=STAR_ROOM, offsets=offsets, along=name)
        magnitude = magnitudes_at(points.quantile[rows[star_rows]], *magnitude_limits(experiment))
        light = (exposure.electrons(magnitude) * stars.lit_fraction).astype(np.float32)
        corners = nearest.astype(np.int64) - stars.image.shape[1] // 2 - (window.x, window.y)
        add_stamps(scene, stars.image * light[:, None, None], corners)
    on_rows = partial(field.light.on_rows, (window.x, window.y), window.shape)
    exposed = expose(scene, exposure, config.seed, name, visit.epoch, lit_fraction=on_rows, threads=threads)
    exposed.mask[_rim_mask(window, pixels)] |= EDGE
    return exposed


def _rim_mask(window: Window, pixels: np.ndarray) -> np.ndarray:
    """Return whether pixels of a window are on the rim of the CCD of `pixels` along x and y, shape [ny, nx]."""
    x, y = (start + np.arange(n) for start, n in ((window.x, window.width), (window.y, window.height)))
    inner = [(v >= RIM) & (v < n - RIM) for v, n in zip((x, y), pixels, strict=True)]
    return ~(inner[1][:, None] & inner[0])
