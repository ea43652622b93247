"""HEALPix pixels of the sky that a visit covers, and its PSF there."""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import numpy as np

from ...core.errors import ConfigError
from ...pipeline.experiment import Experiment
from ...pipeline.photometry import pixel_angle
from ...pipeline.resolved_values import resolved_value
from ...raytrace.rays import field_direction
from ...sky.sky_shapes import along_sky, jacobians_on_sky
from ...wavefront.chief_rays import chief_rays, fields_at
from .detector_row import PlaceShapes

#: Step on the detector of the central differences for the axes of the sky [m]: 2 arcsec of the LSST.
_SKY_STEP = 1e-4
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


def shapes_on_sky(experiment: Experiment, places: PlaceShapes) -> tuple[np.ndarray, np.ndarray]:
    """Return g of the PSFs at places along the axes of the sky, > 0 from east to west and north-west to south-east."""
    pointing, wavelengths = resolved_value(experiment.pointing), experiment.wavelengths

    def celestial_of(xy: np.ndarray) -> np.ndarray:
        fields = fields_at(experiment.telescope, xy, wavelengths[len(wavelengths) // 2], threads=1)
        return pointing.to_celestial(pointing.to_sky(np.tan(fields)))

    _, jacobians = jacobians_on_sky(celestial_of, places.xy, _SKY_STEP)
    return along_sky(places.g1, places.g2, jacobians)


def interpolated(experiment: Experiment, ccd: int, places: PlaceShapes, xy: np.ndarray) -> np.ndarray:
    """Return sigma, g1 and g2 on the sky and area at points of a CCD [m], shape [n, 4].

    They are those of a polynomial over the CCD, of the second order where there are at least twelve places, of the
    first where there are six, else of the mean.
    """
    values = np.stack([places.sigma, *shapes_on_sky(experiment, places), places.area], axis=1)
    good = np.isfinite(values).all(axis=1)
    order = 2 if good.sum() >= 12 else 1 if good.sum() >= 6 else 0
    camera = experiment.camera
    design, points = (_monomials(camera.to_uv(ccd, at), order) for at in (places.xy[good], xy))
    return np.asarray(points @ np.linalg.lstsq(design, values[good], rcond=None)[0])


def _monomials(uv: np.ndarray, order: int) -> np.ndarray:
    """Return the monomials of points [n, 2] up to an order."""
    u, v = uv.T
    return np.stack([u**i * v**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)
