"""HEALPix pixels of the sky that a visit covers, and its PSF there."""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import numpy as np

from ...core.errors import ConfigError
from ...models.camera.camera import Camera
from ...pipeline.experiment import Experiment
from ...pipeline.photometry import pixel_angle
from ...pipeline.resolved_values import resolved_value
from ...raytrace.rays import field_direction
from ...sky.sky_shapes import along_sky
from ...wavefront.chief_rays import chief_rays
from .detector_row import PlaceShapes

#: Room about the outermost corner of a CCD, for distortion.
_MARGIN = 1.05


class SkyPixels(NamedTuple):
    """PSF of a visit at the centres of HEALPix pixels, nested, on its CCDs."""

    pixel: np.ndarray  #: nested indices, [n]
    ccd: np.ndarray  #: of the camera, [n]
    xy: np.ndarray  #: centres of the pixels on the focal plane [m], [n, 2]


def healpix_module() -> ModuleType:
    """Return the module that finds HEALPix pixels, or raise a ConfigError that says how to get it."""
    try:
        import hpgeom
    except ImportError:
        raise ConfigError(
            "maps need the package healsparse: pip install 'pachon[healpix]', or maps: {nside: 0}", key="maps.nside"
        ) from None
    return hpgeom


def covered_pixels(experiment: Experiment, nside: int) -> SkyPixels:
    """Return the HEALPix pixels whose centres lie on the CCDs of an experiment, by its chief rays."""
    hpgeom = healpix_module()
    pointing, camera = resolved_value(experiment.pointing), experiment.camera
    names = resolved_value(experiment.config.ccds)
    wanted_ccds = np.array([camera.ccd_index(name) for name in names])
    reach = float(np.hypot(*camera.corners(wanted_ccds).reshape(-1, 2).T).max())
    radius = _MARGIN * reach / camera.pixel_size * pixel_angle(experiment.telescope, camera.pixel_size)
    center = math.degrees(pointing.ra), math.degrees(pointing.dec)
    index = np.asarray(hpgeom.query_circle(nside, *center, math.degrees(radius), nest=True), dtype=np.int64)
    ra, dec = hpgeom.pixel_to_angle(nside, index, nest=True)
    slopes = pointing.to_slopes(pointing.from_celestial(np.deg2rad(ra), np.deg2rad(dec)))
    directions = field_direction(*np.arctan(slopes).T)
    wavelength = experiment.wavelengths[len(experiment.wavelengths) // 2]
    landed = chief_rays(experiment.telescope, directions, float(wavelength))
    xy = experiment.telescope.surfaces[-1].to_local(landed.position)[:, :2]
    lit = np.hypot(*xy.T) <= experiment.field_radius_on_detector
    ccd = camera.ccd_at(*xy.T)
    rows = np.flatnonzero(np.isin(ccd, wanted_ccds) & lit)
    return SkyPixels(index[rows], ccd[rows], xy[rows])


def interpolated(camera: Camera, ccd: int, places: PlaceShapes, jacobians: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return sigma, g1 and g2 on the sky and area at points of a CCD [m], shape [n, 4].

    `jacobians` are d(west, north)/d(x, y) at the points, [n, 2, 2]: g1 > 0 from east to west, g2 > 0 from north-west to
    south-east. Values are those of a polynomial over the CCD, of the second order where there are at least twelve
    places, of the first where there are six, else of the mean: of g along x and y, since near a pole the sky turns.
    """
    values = np.stack([places.sigma, places.g1, places.g2, places.area], axis=1)
    good = np.isfinite(values).all(axis=1)
    order = 2 if good.sum() >= 12 else 1 if good.sum() >= 6 else 0
    design, points = (_monomials(camera.to_uv(ccd, at), order) for at in (places.xy[good], xy))
    sigma, g1, g2, area = (points @ np.linalg.lstsq(design, values[good], rcond=None)[0]).T
    return np.stack([sigma, *along_sky(g1, g2, jacobians), area], axis=1)


def _monomials(uv: np.ndarray, order: int) -> np.ndarray:
    """Return the monomials of points [n, 2] up to an order."""
    u, v = uv.T
    return np.stack([u**i * v**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)
