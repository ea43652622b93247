"""One CCD, from its stars to its PSF model: what of a run can be done on its own, whatever the other CCDs are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...core.errors import DomainError, PachonError
from ...models.camera.focal_plane import FocalPlane
from ...models.ideal_telescope import without_aberration
from ...models.telescope import Telescope
from ...wavefront.aberration import ResidualWavefront
from ...wavefront.psf.image_plane import focal_length
from ...wavefront.psf.psf import make_psfs
from ...wavefront.pupil_optics import fields_at, trace_pupils
from ..ccd_product import CcdProduct, ObservedStars, TruthStars
from ..experiment import Experiment, truth_components
from ..measure.shapes import Shapes, fwhm, measure_shapes
from ..psf_model.checks import snr_weights
from ..psf_model.model import CLIP_SIGMA, PsfModel
from ..psf_model.polynomial import term_count
from .ccd_observation import observe_ccd
from .photometry import ARCSEC, limiting_magnitude, signal_to_noise
from .star_field import StarField, make_star_field

#: An observed star is drawn on a stamp so many pixels larger than the one kept: room to shift it onto a pixel's centre.
_SHIFT_ROOM = 10
#: Stars keep this many pixels from the rim: a ray that meets a CCD 20 um higher up lands micrometres farther in or out.
_RIM = 2
#: Observed stars keep this many pixels from the edge of the CCD, so that the whole stamp lies on it.
_MARGIN = 20
#: Sets magnitude limits until the PSF is known; positions do not depend on it.
_PROVISIONAL_FWHM = 0.6 * ARCSEC
#: Focal ratio of the paraboloid that stands for a telescope without aberrations: 1.75 deg from the axis its astigmatism
#: is 1e-3 arcsec, and e stays under 3e-4, the stretch that a flat field has from tangents in place of angles.
_PLAIN_RATIO = 1e5


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


def truth_places(experiment: Experiment, name: str) -> np.ndarray:
    """Return the places of a CCD where a run has noise-free PSFs [m], shape [n, 2]; they depend on the seed alone."""
    return _star_field(experiment, name, _PROVISIONAL_FWHM).truth


def expose_places(experiment: Experiment, positions: np.ndarray, threads: int | None = None) -> Exposed:
    """Make noise-free PSFs at positions on the detector [m], shape [n, 2], of any CCDs.

    A star stands where the chief ray of the middle wavelength lands, at the centre of a pixel.

    Raises
    ------
    DomainError
        If no light reaches one of them.
    """
    exposed = _expose(experiment, positions, np.zeros_like(positions), threads, None, size=experiment.stamp_size)
    _check_light(exposed, "some stars")
    return exposed


def _check_light(exposed: Exposed, whose: str) -> None:
    if not exposed.light.min() > 0.0:
        raise DomainError(f"no light reaches {whose}: expected a CCD within the field of the telescope")


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
        _check_light(observed, "some of its stars")
        return CcdExposure(name, places, truth, observed)
    except PachonError as error:
        raise error.within(subject=f"CCD {name}") from None


def model_ccd(experiment: Experiment, exposure: CcdExposure, *, noisy: bool = True) -> CcdProduct:
    """Look at the stars of one CCD through noise, and model the PSF from what was seen.

    Parameters
    ----------
    experiment : Experiment
        Telescope, focal plane, atmosphere and settings.
    exposure : CcdExposure
        The stars.
    noisy : bool
        Without noise, what stands out is the PSF: no pixel is rejected, as for the truth.

    Raises
    ------
    PachonError
        If a stage fails: one line that starts with the name of the CCD.
    """
    try:
        return _model(experiment, exposure, noisy)
    except PachonError as error:
        raise error.within(subject=f"CCD {exposure.name}") from None


def _model(experiment: Experiment, exposure: CcdExposure, noisy: bool) -> CcdProduct:
    config = experiment.config
    name, places, truth, observed = exposure.name, exposure.places, exposure.truth, exposure.observed
    bounds = _bounds(experiment, name)
    truth_images = truth.image.astype(np.float64)
    truth_shapes = measure_shapes(truth_images, truth.pixel_scale, experiment.weight_fwhm)
    # Places do not depend on the limits of magnitude, which in turn need to know how much light the stars lose.
    width = effective_fwhm(truth.image, truth.pixel_scale)
    stars = _star_field(experiment, name, width, least_light=float(observed.light.min()))
    electrons = stars.electrons * observed.light
    snr = signal_to_noise(
        stars.magnitude - 2.5 * np.log10(observed.light), stars.band, config.atmosphere.exposure_s, width
    )
    seen = observe_ccd(experiment, name, observed.image, observed.pixel_scale, electrons, noisy=noisy)
    fit, used = config.reconstruction, seen.used
    least = 1 + (fit.components or 0) if fit.basis == "pca" else 2
    seen.require(max(least, term_count(fit.order or 0)))
    model = PsfModel.fit(
        seen.images[used],
        stars.observed[used],
        basis=fit.basis,
        interpolation=fit.interpolation,
        weights=snr_weights(fit.weights, snr[used]),
        n_components=fit.components,
        order=fit.order,
        extent=bounds,
        clip_sigma=CLIP_SIGMA if noisy else None,
    )
    # Noise-free stars have no outliers: what stands out there is the PSF.
    truth_model = PsfModel.fit(
        truth_images,
        places.truth,
        n_components=truth_components(config),
        order=fit.truth_order,
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
        noise=seen.noise,
        truth=TruthStars(
            **_positions(places.truth, truth.fields),
            **_shapes(truth_shapes, at_truth),
            fwhm=fwhm(truth.image, truth.pixel_scale),
        ),
        observed=ObservedStars(
            **_positions(stars.observed, observed.fields),
            **_shapes(seen.shapes, at_stars),
            magnitude=stars.magnitude,
            electrons=electrons,
            snr=snr,
            defects=seen.defects,
            used=used,
            left_out_e1=left_out_e1,
            left_out_e2=left_out_e2,
        ),
        truth_images=truth_images.astype(np.float32),
        observed_images=seen.images.astype(np.float32),
        model=model,
        truth_model=truth_model,
    )


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
    fields = fields_at(experiment.telescope, positions, wavelengths[len(wavelengths) // 2], threads=threads)
    seen = _seen_through(experiment)
    psfs = make_psfs(
        seen.telescope,
        fields,
        wavelengths,
        focal_plane=seen.focal_plane,
        atmosphere=experiment.atmosphere,
        aberration=seen.aberration,
        engine=config.psf.engine,
        stamp_size=size,
        pixel_size=experiment.pixel_size * seen.magnification,
        diffusion=experiment.diffusion * seen.magnification,
        jitter=experiment.jitter,
        offsets=offsets,
        recenter=recenter,
        dispersion=experiment.dispersion,
        n_pupil=config.psf.n_pupil,
        threads=threads,
        progress=advance,
    )
    return Exposed(psfs.image, float(psfs.pixel_scale), fields, psfs.lit_fraction.mean(axis=1))


class _Seen(NamedTuple):
    telescope: Telescope
    focal_plane: FocalPlane | None
    aberration: ResidualWavefront | None
    magnification: float


def _seen_through(experiment: Experiment) -> _Seen:
    """Return what stars are seen through, and how much larger than on the camera's CCDs their images are."""
    telescope = experiment.telescope
    if not experiment.air_alone:
        return _Seen(telescope, experiment.focal_plane, experiment.aberration, 1.0)
    plain = without_aberration(telescope, _PLAIN_RATIO)
    axis = np.zeros((1, 2))
    here, there = (
        focal_length(trace_pupils(t, axis, experiment.wavelengths, axis).jacobian)[0] for t in (telescope, plain)
    )
    return _Seen(plain, None, None, float(there / here))


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
        "model_size": model.size,
    }
