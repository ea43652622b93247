"""One CCD, from its stars to its PSF model: what of a run can be done on its own, whatever the other CCDs are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..models.errors import DomainError, PachonError
from ..models.random_streams import stream
from ..wavefront.psf import make_psfs
from ..wavefront.pupil_optics import fields_at
from .ccd_product import CcdProduct, ObservedStars, TruthStars
from .experiment import Experiment
from .photometry import ARCSEC, instrument_noise, limiting_magnitude, signal_to_noise, sky_electrons_per_pixel
from .psf_model import PsfModel
from .shapes import Shapes, fwhm, measure_shapes
from .stamps import center_stamps, observe_stamps
from .star_field import StarField, make_star_field

#: An observed star is drawn on a stamp so many pixels larger than the one kept: room to shift it onto a pixel's centre.
_SHIFT_ROOM = 10
#: Stars keep this many pixels from the rim: a ray that meets a CCD 20 um higher up lands micrometres farther in or out.
_RIM = 2
#: Observed stars keep this many pixels from the edge of the CCD, so that the whole stamp lies on it.
_MARGIN = 20
#: Sets magnitude limits until the PSF is known; positions do not depend on it.
_PROVISIONAL_FWHM = 0.6 * ARCSEC


@dataclass(frozen=True)
class Exposed:
    """Noise-free stars.

    Attributes
    ----------
    image : ndarray, shape [n, ny, nx]
        Stamps of unit sum.
    pixel_scale : float
        Angle of a pixel [rad].
    fields : ndarray, shape [n, 2]
        Field angles [rad].
    light : ndarray, shape [n]
        Light of each star over what an unvignetted pupil lets through.
    """

    image: np.ndarray
    pixel_scale: float
    fields: np.ndarray
    light: np.ndarray


@dataclass(frozen=True)
class CcdExposure:
    """The stars of one CCD as the telescope shows them, before noise.

    Attributes
    ----------
    name : str
        Name of the CCD.
    places : StarField
        Positions of the stars; their magnitudes are provisional.
    truth : Exposed
        PSFs for the truth, each seen at the centre of a pixel.
    observed : Exposed
        PSFs of the stars that will be observed, where they fall on their pixels.
    """

    name: str
    places: StarField
    truth: Exposed
    observed: Exposed


def expose_ccd(
    experiment: Experiment, name: str, *, threads: int | None = None, advance: Callable[[int], None] | None = None
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
    advance : callable, optional
        Called with a number of PSFs after so many have been made.

    Raises
    ------
    PachonError
        If a stage fails: one line that starts with the name of the CCD.
    """
    try:
        places = _star_field(experiment, name, _PROVISIONAL_FWHM)
        truth = _truth(experiment, places.truth, threads, advance)
        pixel = places.observed_pixel * (places.pixel_size / experiment.pixel_size)
        size = experiment.stamp_size + _SHIFT_ROOM
        observed = _expose(experiment, places.observed, pixel - np.rint(pixel), threads, advance, size=size)
        if not observed.light.min() > 0.0:
            raise DomainError("no light reaches some of its stars: expected a CCD within the field of the telescope")
        return CcdExposure(name, places, truth, observed)
    except PachonError as error:
        raise type(error)(f"CCD {name}: {error}") from None


def model_ccd(experiment: Experiment, exposure: CcdExposure) -> CcdProduct:
    """Look at the stars of one CCD through noise, and model the PSF from what was seen.

    Parameters
    ----------
    experiment : Experiment
        Telescope, focal plane, atmosphere and settings.
    exposure : CcdExposure
        The stars.

    Raises
    ------
    PachonError
        If a stage fails: one line that starts with the name of the CCD.
    """
    try:
        return _model(experiment, exposure.name, exposure.places, exposure.truth, exposure.observed)
    except PachonError as error:
        raise type(error)(f"CCD {exposure.name}: {error}") from None


def _model(experiment: Experiment, name: str, places: StarField, truth: Exposed, observed: Exposed) -> CcdProduct:
    config = experiment.config
    n_components = config.reconstruction.components
    bounds = _bounds(experiment, name)
    truth_images = truth.image.astype(np.float64)
    truth_shapes = measure_shapes(truth_images, truth.pixel_scale, experiment.weight_fwhm)
    # Places do not depend on the limits of magnitude, which in turn need to know how much light the stars lose.
    width = effective_fwhm(truth.image, truth.pixel_scale)
    stars = _star_field(experiment, name, width, least_light=float(observed.light.min()))
    electrons = stars.electrons * observed.light
    exposure = config.atmosphere.exposure_s
    sky = sky_electrons_per_pixel(stars.band, exposure, observed.pixel_scale)
    noise = instrument_noise(exposure)
    seen = observe_stamps(observed.image, electrons, sky, noise, stream(*_noise_key(experiment, name)))
    observed_shapes, observed_images = _centered(experiment, seen, observed.pixel_scale)

    used = observed_shapes.usable & np.isfinite(observed_images).all(axis=(1, 2))
    model = PsfModel.fit(
        observed_images[used],
        stars.observed[used],
        n_components=n_components,
        order=config.reconstruction.order,
        extent=bounds,
    )
    # Noise-free stars have no outliers: what stands out there is the PSF.
    truth_model = PsfModel.fit(
        truth_images,
        places.truth,
        n_components=n_components,
        order=config.reconstruction.truth_order,
        extent=bounds,
        clip_sigma=None,
    )

    def shapes_of(images: np.ndarray) -> Shapes:
        return measure_shapes(images, observed.pixel_scale, experiment.weight_fwhm)

    at_truth, at_stars = shapes_of(model.at(places.truth)), shapes_of(model.at(stars.observed))
    left_out = shapes_of(model.leave_one_out())
    left_out_e1, left_out_e2 = np.full((2, len(used)), np.nan)
    left_out_e1[used], left_out_e2[used] = left_out.e1, left_out.e2
    return CcdProduct(
        name=name,
        center=_center(experiment, name),
        pixel_scale=truth.pixel_scale,
        noise=(sky, noise),
        truth=TruthStars(
            **_positions(places.truth, truth.fields),
            **_shapes(truth_shapes, at_truth),
            fwhm=fwhm(truth.image, truth.pixel_scale),
        ),
        observed=ObservedStars(
            **_positions(stars.observed, observed.fields),
            **_shapes(observed_shapes, at_stars),
            magnitude=stars.magnitude,
            electrons=electrons,
            snr=signal_to_noise(stars.magnitude - 2.5 * np.log10(observed.light), stars.band, exposure, width),
            used=used,
            left_out_e1=left_out_e1,
            left_out_e2=left_out_e2,
        ),
        truth_images=truth_images.astype(np.float32),
        observed_images=observed_images.astype(np.float32),
        model=model,
        truth_model=truth_model,
    )


def _noise_key(experiment: Experiment, name: str) -> tuple[int, *tuple[str | int, ...]]:
    """Return what the photon noise of a CCD hangs on: each visit has its own, and the first the plain one."""
    config = experiment.config
    visit = (config.atmosphere.epoch,) if config.atmosphere.epoch else ()
    return config.seed, "noise", name, *visit


def _truth(
    experiment: Experiment, positions: np.ndarray, threads: int | None, advance: Callable[[int], None] | None
) -> Exposed:
    """Make noise-free PSFs whose centroid is the centre of a pixel.

    The atmosphere moves a star by a part of a pixel. The engine draws the truth at the place that undoes this; it is
    not shifted as observed stars are: a shift of an image that is not quite band-limited rings along rows and columns.
    """

    def seen_at(images: np.ndarray, pixel_scale: float) -> np.ndarray:
        moved = measure_shapes(images, pixel_scale, experiment.weight_fwhm)
        return np.nan_to_num(np.stack([moved.x, moved.y], axis=1))

    nothing = np.zeros_like(positions)
    return _expose(experiment, positions, nothing, threads, advance, size=experiment.stamp_size, recenter=seen_at)


def effective_fwhm(images: np.ndarray, pixel_scale: float) -> float:
    """Return the FWHM of the Gaussian with as many noise-equivalent pixels as the median star [rad].

    The noise-equivalent number of pixels of an image P of unit sum is 1/sum(P^2), and 2.266 FWHM^2 pixels that of a
    Gaussian (SMTN-002).
    """
    pixels = 1.0 / np.median((images**2).sum(axis=(1, 2)))
    return float(np.sqrt(pixels / 2.266) * pixel_scale)


def _expose(
    experiment: Experiment,
    positions: np.ndarray,
    offsets: np.ndarray,
    threads: int | None,
    advance: Callable[[int], None] | None,
    *,
    size: int,
    recenter: Callable[[np.ndarray, float], np.ndarray] | None = None,
) -> Exposed:
    """Make the PSFs at positions on the detector, noise-free."""
    config, wavelengths = experiment.config, experiment.wavelengths
    told = 0

    def tell(done: int) -> None:
        nonlocal told
        if advance is not None:
            advance(done - told)
        told = done

    fields = fields_at(experiment.telescope, positions, wavelengths[len(wavelengths) // 2], threads=threads)
    psfs = make_psfs(
        experiment.telescope,
        fields,
        wavelengths,
        focal_plane=experiment.focal_plane,
        atmosphere=experiment.atmosphere,
        aberration=experiment.aberration,
        engine=config.psf.engine,
        stamp_size=size,
        pixel_size=experiment.pixel_size,
        diffusion=experiment.diffusion,
        jitter=experiment.jitter,
        offsets=offsets,
        recenter=recenter,
        dispersion=experiment.dispersion,
        n_pupil=config.psf.n_pupil,
        threads=threads,
        progress=tell,
    )
    return Exposed(psfs.image, float(psfs.pixel_scale), fields, psfs.throughput.mean(axis=1))


def _centered(experiment: Experiment, images: np.ndarray, pixel_scale: float) -> tuple[Shapes, np.ndarray]:
    """Shift stars to the centre of a pixel, cut the stamps, and measure the shapes there."""
    first = measure_shapes(images, pixel_scale, experiment.weight_fwhm)
    stamps = center_stamps(images, first.x, first.y, size=experiment.stamp_size)
    return measure_shapes(stamps, pixel_scale, experiment.weight_fwhm), stamps


def _center(experiment: Experiment, name: str) -> tuple[float, float]:
    """Return the centre of a CCD [m]."""
    x, y = experiment.camera.centers[experiment.camera.ccd_index(name)]
    return float(x), float(y)


def _bounds(experiment: Experiment, name: str) -> tuple[float, float, float, float]:
    """Return the edges (xmin, xmax, ymin, ymax) of a CCD [m], less the rim that no star comes into."""
    camera = experiment.camera
    x, y = _center(experiment, name)
    half = camera.half_size - _RIM * camera.pixel_size
    return x - half, x + half, y - half, y + half


def _star_field(experiment: Experiment, name: str, width: float, least_light: float = 1.0) -> StarField:
    """Draw the stars of one CCD, the faintest still of the wanted S/N where the least light arrives."""
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


def _positions(positions: np.ndarray, fields: np.ndarray) -> dict[str, np.ndarray]:
    return {"x": positions[:, 0], "y": positions[:, 1], "field_x": fields[:, 0], "field_y": fields[:, 1]}


def _shapes(measured: Shapes, model: Shapes) -> dict[str, np.ndarray]:
    return {
        "e1": measured.e1,
        "e2": measured.e2,
        "size": measured.size,
        "flags": measured.flags,
        "model_e1": model.e1,
        "model_e2": model.e2,
    }
