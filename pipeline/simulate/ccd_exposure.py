"""Noise-free PSFs of the stars of one CCD, through optics, CCD heights and atmosphere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...core.errors import DomainError
from ...core.units import ARCSEC
from ...models.camera.focal_plane import FocalPlane
from ...models.ideal_telescope import without_aberration
from ...models.telescope import Telescope
from ...wavefront.aberration import ResidualWavefront
from ...wavefront.chief_rays import fields_at
from ...wavefront.psf.engine import center_focal_length
from ...wavefront.psf.engines import ENGINES
from ...wavefront.psf.psf import make_psfs
from ..experiment import Experiment
from ..measure.shapes import measure_shapes
from .photometry import limiting_magnitude
from .star_field import StarField, make_star_field

#: Pixels by which the stamp of an observed star is larger than the final one: room to centre it on a pixel.
_SHIFT_ROOM = 10
#: Distance of all stars from the edge of the CCD [pixel]: its height moves a star by micrometres.
_RIM = 2
#: Distance of observed stars from the edge of the CCD [pixel], so that the whole stamp lies on it.
_MARGIN = 20
#: FWHM for provisional magnitude limits; positions do not depend on it.
_PROVISIONAL_FWHM = 0.6 * ARCSEC
#: Focal ratio of the paraboloid that serves as ideal telescope: 1.75 deg from the axis its astigmatism is 1e-3 arcsec,
#: and e stays below 3e-4, the distortion of a tangent projection.
_IDEAL_RATIO = 1e5


@dataclass(frozen=True)
class NoiseFreeStars:
    """Noise-free stars.

    Attributes
    ----------
    image : ndarray, shape [n, ny, nx]
        Stamps of unit sum.
    pixel_scale : float
        Angle of a pixel [rad].
    fields : ndarray, shape [n, 2]
        Field angles [rad].
    lit_fraction : ndarray, shape [n]
        Part of the entrance pupil whose light arrives, mean over the wavelengths.
    """

    image: np.ndarray
    pixel_scale: float
    fields: np.ndarray
    lit_fraction: np.ndarray


@dataclass(frozen=True)
class CcdExposure:
    """Noise-free images of the stars of one CCD.

    Attributes
    ----------
    name : str
        Name of the CCD.
    places : StarField
        Positions of the stars, with provisional magnitudes.
    holdout : NoiseFreeStars
        PSFs at positions without an observed star, each centred on a pixel.
    observed : NoiseFreeStars
        PSFs of the observed stars, at their sub-pixel positions.
    """

    name: str
    places: StarField
    holdout: NoiseFreeStars
    observed: NoiseFreeStars


def holdout_positions(experiment: Experiment, name: str) -> np.ndarray:
    """Return the holdout positions of a CCD [m], shape [n, 2]; they depend on the seed alone."""
    return ccd_stars(experiment, name, _PROVISIONAL_FWHM).holdout


def expose_places(experiment: Experiment, positions: np.ndarray, threads: int | None = None) -> NoiseFreeStars:
    """Make noise-free PSFs at positions on the detector [m], shape [n, 2], of any CCDs.

    The position of a star is that of the chief ray of the middle wavelength, at the centre of a pixel.

    Raises
    ------
    DomainError
        If no light reaches one of them.
    """
    exposed = _expose(experiment, positions, np.zeros_like(positions), threads, None, size=experiment.stamp_size)
    _check_light(exposed, "some stars")
    return exposed


def _check_light(exposed: NoiseFreeStars, whose: str) -> None:
    if not exposed.lit_fraction.min() > 0.0:
        raise DomainError(f"no light reaches {whose}: expected a CCD within the field of the telescope")


def expose_ccd(
    experiment: Experiment, name: str, *, threads: int | None = None, progress: Callable[[int], None] | None = None
) -> CcdExposure:
    """Make the PSFs of the stars of one CCD: nearly all of the work, on all threads.

    Parameters
    ----------
    experiment : Experiment
        Telescope, focal plane, atmosphere and settings.
    name : str
        Name of the CCD.
    threads : int, optional
        Number of threads; no byte depends on it.
    progress : callable, optional
        Called with the number of PSFs made since the last call.

    Raises
    ------
    PachonError
        If a stage fails.
    """
    places = ccd_stars(experiment, name, _PROVISIONAL_FWHM)
    holdout = _expose_holdout(experiment, places.holdout, threads, progress)
    pixel = places.observed_pixel * (places.pixel_size / experiment.pixel_size)
    size = experiment.stamp_size + _SHIFT_ROOM
    observed = _expose(experiment, places.observed, pixel - np.rint(pixel), threads, progress, size=size)
    _check_light(observed, "some of its stars")
    return CcdExposure(name, places, holdout, observed)


def _expose_holdout(
    experiment: Experiment, positions: np.ndarray, threads: int | None, progress: Callable[[int], None] | None
) -> NoiseFreeStars:
    """Make noise-free PSFs whose centroid is the centre of a pixel.

    The atmosphere moves a star by a fraction of a pixel. The engine draws these PSFs at the position that compensates
    the shift. They are not resampled as observed stars are: an image that is not quite band-limited then rings along
    rows and columns.
    """

    def centroid(images: np.ndarray, pixel_scale: float) -> np.ndarray:
        shapes = measure_shapes(images, pixel_scale, experiment.weight_fwhm)
        return np.nan_to_num(np.stack([shapes.x, shapes.y], axis=1))

    zeros = np.zeros_like(positions)
    return _expose(experiment, positions, zeros, threads, progress, size=experiment.stamp_size, recenter=centroid)


def _expose(
    experiment: Experiment,
    positions: np.ndarray,
    offsets: np.ndarray,
    threads: int | None,
    progress: Callable[[int], None] | None,
    *,
    size: int,
    recenter: Callable[[np.ndarray, float], np.ndarray] | None = None,
) -> NoiseFreeStars:
    """Make the PSFs at positions on the detector, noise-free."""
    config, wavelengths = experiment.config, experiment.wavelengths
    fields = fields_at(experiment.telescope, positions, wavelengths[len(wavelengths) // 2], threads=threads)
    optics = _optics_of(experiment)
    psfs = make_psfs(
        optics.telescope,
        fields,
        wavelengths,
        focal_plane=optics.focal_plane,
        atmosphere=experiment.atmosphere,
        aberration=optics.aberration,
        engine=config.psf.engine,
        stamp_size=size,
        pixel_size=experiment.pixel_size * optics.magnification,
        diffusion=experiment.diffusion * optics.magnification,
        jitter=experiment.jitter,
        offsets=offsets,
        recenter=recenter,
        dispersion=experiment.dispersion,
        n_pupil=config.psf.n_pupil if "n_pupil" in ENGINES[config.psf.engine].options else None,
        threads=threads,
        progress=progress,
    )
    return NoiseFreeStars(psfs.image, float(psfs.pixel_scale), fields, psfs.lit_fraction.mean(axis=1))


class _Optics(NamedTuple):
    telescope: Telescope
    focal_plane: FocalPlane | None
    aberration: ResidualWavefront | None
    magnification: float


def _optics_of(experiment: Experiment) -> _Optics:
    """Return the optics of the exposure, and the scale of its images relative to the camera's."""
    telescope = experiment.telescope
    if not experiment.atmosphere_only:
        return _Optics(telescope, experiment.focal_plane, experiment.aberration, 1.0)
    ideal = without_aberration(telescope, _IDEAL_RATIO)
    here, there = (center_focal_length(t, experiment.wavelengths) for t in (telescope, ideal))
    return _Optics(ideal, None, None, there / here)


def _bounds(experiment: Experiment, name: str) -> tuple[float, float, float, float]:
    """Return the edges (xmin, xmax, ymin, ymax) of a CCD [m], less the margin without stars."""
    camera = experiment.camera
    x, y = map(float, camera.centers[camera.ccd_index(name)])
    half = camera.half_size - _RIM * camera.pixel_size
    return x - half, x + half, y - half, y + half


def ccd_stars(experiment: Experiment, name: str, width: float, least_light: float = 1.0) -> StarField:
    """Draw the stars of one CCD, the faintest of the S/N limit where vignetting is strongest."""
    config = experiment.config
    band, exposure = config.band or "r", config.atmosphere.exposure_s
    return make_star_field(
        name,
        _bounds(experiment, name),
        config.stars.truth,
        config.stars.observed,
        config.seed,
        fwhm=width,
        band=band,
        exposure=exposure,
        faint=limiting_magnitude(config.stars.snr_min, band, exposure, width) + 2.5 * np.log10(least_light),
        margin=_MARGIN,
        pixel_size=experiment.camera.pixel_size,
    )
