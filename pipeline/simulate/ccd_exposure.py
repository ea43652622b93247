"""Noise-free PSFs of the stars of one CCD, through optics, CCD heights and atmosphere."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ...core.errors import ConfigError, DomainError
from ...core.groups import slices_of
from ...measure.shapes import measure_shapes
from ...models.camera.camera import Camera
from ...models.ideal_telescope import ideal_telescope
from ...models.star_spectrum import blackbody_photons
from ...wavefront.chief_rays import fields_of_groups
from ...wavefront.psf.engine import center_focal_length
from ...wavefront.psf.engines import psf_engine
from ...wavefront.psf.light import Light
from ...wavefront.psf.psf import make_psfs
from ...wavefront.psf.stamps import Stamps
from ..experiment import Experiment
from ..resolved_values import resolved_value
from ..sensor.displacement import displace_stamps
from .photometry import PROVISIONAL_FWHM, electrons, limiting_magnitude, vignetted
from .star_field import CcdOutline, Depth, StarField, make_star_field

#: Pixels by which the stamp of an observed star is larger than the final one: room to centre it on a pixel.
_SHIFT_ROOM = 10
#: Distance of all stars from the edge of the CCD [pixel]: its height moves a star by micrometres.
_RIM = 2
#: Distance of observed stars from the edge of the CCD [pixel], so that the whole stamp lies on it.
_MARGIN = 20
#: Focal ratio of the paraboloid that serves as ideal telescope: 1.75 deg from the axis its astigmatism is 1e-3 arcsec,
#: and e stays below 3e-4, the distortion of a tangent projection.
_IDEAL_RATIO = 1e5


@dataclass(frozen=True)
class NoiseFreeStars:
    """Noise-free stars."""

    image: np.ndarray  #: [n, ny, nx], unit sum
    pixel_scale: float  #: angle of a pixel [rad]
    fields: np.ndarray  #: field angles [rad], [n, 2]
    lit_fraction: np.ndarray  #: light that arrives over that on the axis, mean over wavelengths, [n]
    offset: np.ndarray  #: place of the reference point from the centre of the middle pixel [pixel], [n, 2]
    first: np.ndarray | None = None  #: images as the engine drew them before they were centred, likewise

    def part(self, index: slice) -> NoiseFreeStars:
        """Return some of the stars."""
        return replace(
            self,
            image=self.image[index],
            fields=self.fields[index],
            lit_fraction=self.lit_fraction[index],
            offset=self.offset[index],
            first=None,
        )


@dataclass(frozen=True)
class CcdExposure:
    """Noise-free images of the stars of one CCD."""

    name: str
    positions: StarField  #: with provisional magnitudes
    holdout: NoiseFreeStars  #: each centred on a pixel
    observed: NoiseFreeStars  #: at their sub-pixel positions
    centered: NoiseFreeStars | None = None  #: the observed stars again, each centred on a pixel, where asked for


def holdout_positions(experiment: Experiment, name: str) -> np.ndarray:
    """Return the holdout positions of a CCD [m], shape [n, 2]; they depend on the seed alone."""
    return ccd_stars(experiment, name, PROVISIONAL_FWHM).holdout


def expose_positions(
    experiment: Experiment,
    positions: np.ndarray,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    room: int = 0,
    offsets: np.ndarray | None = None,
    along: str | None = None,
    temperatures: np.ndarray | None = None,
) -> NoiseFreeStars:
    """Make noise-free PSFs at positions on the detector [m], shape [n, 2], of any CCDs.

    The position of a star is that of the chief ray of the middle wavelength, at the centre of a pixel, or `offsets`
    [pixel] from it; stamps are larger than those of the run by `room` pixels, and lie along the axes of the focal plane
    or, with `along`, those of the pixels of a CCD. They are blackbodies of `temperatures` [K] where these are given.
    DomainError if no light reaches one of them.
    """
    stars = _expose(
        experiment, [positions], threads, progress, room=room, offsets=offsets, along=along, temperatures=temperatures
    )
    return _require_light(stars)


def expose_ccd(
    experiment: Experiment,
    name: str,
    stars: StarField | None = None,
    *,
    centered: bool = False,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> CcdExposure:
    """Make the PSFs of the stars of one CCD: nearly all of the work, on all threads.

    `stars` are by default drawn over the CCD. With `centered` the observed ones are drawn once more on the centre of a
    pixel, which costs next to nothing. No byte of the others depends on that, and none at all on the number of threads;
    `progress` is called with the number of PSFs made since the last call.
    """
    positions = ccd_stars(experiment, name, PROVISIONAL_FWHM) if stars is None else stars
    return expose_ccds(experiment, {name: positions}, centered=centered, threads=threads, progress=progress)[0]


def expose_ccds(
    experiment: Experiment,
    stars: Mapping[str, StarField],
    *,
    centered: bool = False,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[CcdExposure]:
    """Make the PSFs of the stars of several CCDs as :func:`expose_ccd` does, by one call of the engine for all.

    No byte of a CCD depends on the others: what the engine does once a call is most of the time of a few stars.
    """
    fields = list(stars.values())
    holdout_groups = [field.holdout for field in fields]
    recenter = partial(_centroids, experiment)
    holdout = _expose(experiment, holdout_groups, threads, progress, recenter=recenter)
    groups = [field.observed for field in fields]
    pixels = [field.observed_pixel * (field.ccd.pixel_size / experiment.pixel_size) for field in fields]
    offsets = np.concatenate([pixel - np.rint(pixel) for pixel in pixels])
    kelvin = _temperatures(fields)
    centered_stars = None
    if centered:
        observed, centered_stars = _expose_twice(experiment, groups, offsets, threads, progress, temperatures=kelvin)
    else:
        observed = _expose(
            experiment,
            groups,
            threads,
            progress,
            offsets=offsets,
            room=_SHIFT_ROOM,
            cut_off=True,
            temperatures=kelvin,
        )
    exposures = []
    of_holdout, of_observed = (slices_of(parts) for parts in (holdout_groups, groups))
    for (name, field), first, second in zip(stars.items(), of_holdout, of_observed, strict=True):
        exposures.append(
            CcdExposure(
                name,
                field,
                holdout.part(first),
                _require_light(observed.part(second)),
                None if centered_stars is None else centered_stars.part(second),
            )
        )
    return exposures


def _temperatures(fields: Sequence[StarField]) -> np.ndarray | None:
    """Return the temperatures of the observed stars of all fields [K], NaN for flat spectra; None where all are."""
    if all(field.temperature is None for field in fields):
        return None
    return np.concatenate(
        [np.full(len(f.observed), np.nan) if f.temperature is None else f.temperature for f in fields]
    )


def _expose_twice(
    experiment: Experiment,
    groups: Sequence[np.ndarray],
    offsets: np.ndarray,
    threads: int | None,
    progress: Callable[[int], None] | None,
    temperatures: np.ndarray | None,
) -> tuple[NoiseFreeStars, NoiseFreeStars]:
    """Make the PSFs of observed stars, with the room of their stamps, and the same on the centre of a pixel."""
    moved = _expose(
        experiment,
        groups,
        threads,
        progress,
        room=_SHIFT_ROOM,
        cut_off=True,
        offsets=offsets,
        recenter=partial(_centroids, experiment),
        temperatures=temperatures,
    )
    assert moved.first is not None
    middles = np.concatenate(groups) - offsets * experiment.pixel_size
    images = _with_static_displacements(experiment, middles, moved.first)
    rim = _SHIFT_ROOM // 2
    inner = moved.image[:, rim:-rim, rim:-rim]
    light = inner.sum(axis=(1, 2), keepdims=True, dtype=np.float64)
    centered = (inner / np.where(light > 0.0, light, 1.0)).astype(np.float32)
    return replace(moved, image=images, offset=offsets), replace(moved, image=centered)


def expose_centered(
    experiment: Experiment,
    positions: np.ndarray,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    along: str | None = None,
) -> NoiseFreeStars:
    """Make noise-free PSFs as :func:`expose_positions` does, their centroids at the centre of a pixel."""
    # The engine draws them at the position that compensates their shift by the atmosphere. Resampling, as of observed
    # stars, would leave ringing along rows and columns where an image is not quite band-limited.
    recenter = partial(_centroids, experiment)
    stars = _expose(experiment, [positions], threads, progress, recenter=recenter, along=along)
    return replace(stars, first=None)


def _centroids(experiment: Experiment, images: np.ndarray, pixel_scale: float) -> np.ndarray:
    """Return centroids (x, y) from the centre of the middle pixel [pixel], shape [n, 2], 0 where there are none."""
    shapes = measure_shapes(images, pixel_scale, experiment.weight_fwhm)
    return np.nan_to_num(np.stack([shapes.x, shapes.y], axis=1))


def _require_light(stars: NoiseFreeStars) -> NoiseFreeStars:
    """Return the stars, or raise a DomainError if no light reaches one of them."""
    if not (stars.lit_fraction > 0.0).all():
        raise DomainError("no light reaches some stars: expected a CCD within the field of the telescope")
    return stars


def _expose(
    experiment: Experiment,
    groups: Sequence[np.ndarray],
    threads: int | None,
    progress: Callable[[int], None] | None = None,
    *,
    room: int = 0,
    cut_off: bool = False,
    offsets: np.ndarray | None = None,
    recenter: Callable[[np.ndarray, float], np.ndarray] | None = None,
    along: str | None = None,
    temperatures: np.ndarray | None = None,
) -> NoiseFreeStars:
    """Make PSFs at positions on the detector, `offsets` [pixel] from the centre of a pixel, on stamps with `room`.

    Positions are those of groups [m], [n, 2] each, one after the other; no byte of a group depends on the others. With
    `cut_off` the room is for centring alone, and wings may wrap around there.
    Stars are blackbodies of `temperatures` [K]; spectra are flat where they are NaN, and by default.
    """
    config, wavelengths = experiment.config, experiment.wavelengths
    positions, middle = np.concatenate(groups), float(wavelengths[len(wavelengths) // 2])
    fields = fields_of_groups(experiment.telescope, positions, [len(group) for group in groups], middle, threads)
    # Stamps are drawn along the axes of the CCD's frame, and exchange x and y where its pixels do.
    transposed = along is not None and experiment.camera.transposed
    if transposed and offsets is not None:
        offsets = offsets[:, ::-1]
    if along is not None:
        frame = experiment.camera.frame(experiment.camera.ccd_index(along))
        positions, experiment = np.stack(frame.along_ccd(*positions.T), axis=1), experiment.along(along)
    telescope = experiment.telescope
    optical, magnification = not experiment.atmosphere_only, 1.0
    if not optical:
        ideal = ideal_telescope(telescope, _IDEAL_RATIO).with_rotator(experiment.rotator)
        focal_length, ideal_focal_length = (center_focal_length(t, wavelengths) for t in (telescope, ideal))
        telescope, magnification = ideal, ideal_focal_length / focal_length
    psfs = make_psfs(
        telescope,
        fields,
        Light(
            wavelengths,
            None if temperatures is None else blackbody_photons(temperatures, wavelengths),
            experiment.dispersion,
        ),
        focal_plane=experiment.focal_plane if optical else None,
        atmosphere=experiment.atmosphere,
        aberration=experiment.aberration if optical else None,
        stamps=Stamps(
            experiment.stamp_size + room,
            experiment.pixel_size * magnification,
            experiment.diffusion * magnification,
            experiment.jitter,
            experiment.silicon,
            offsets,
            recenter,
            room if cut_off else 0,
        ),
        engine=psf_engine(config.psf.engine).with_n_pupil(config.psf.n_pupil),
        threads=threads,
        progress=progress,
    )
    image = _with_static_displacements(experiment, positions - psfs.offset * experiment.pixel_size, psfs.image)
    offset = psfs.offset
    if transposed:
        image, offset = np.ascontiguousarray(image.swapaxes(1, 2)), offset[:, ::-1]
    on_axis = experiment.lit_fraction_on_axis if optical else 1.0
    lit_fraction = psfs.lit_fraction.mean(axis=1) / on_axis
    return NoiseFreeStars(image, float(psfs.pixel_scale), fields, lit_fraction, offset, psfs.first)


def _with_static_displacements(experiment: Experiment, middles: np.ndarray, images: np.ndarray) -> np.ndarray:
    """Apply the static displacements of the CCDs to stamps; `middles` are the positions of their middle pixels.

    No star is moved as a whole: stamps are centred on their star.
    """
    camera = experiment.camera
    ccds = camera.ccd_at(*middles.T, margin=camera.pixel_size)
    for ccd in np.unique(ccds[ccds >= 0]):
        effects = experiment.displacements(camera.ccd_names[ccd])
        if not effects:
            return images
        on_ccd = ccds == ccd
        stamps = images[on_ccd].astype(np.float64)
        moved = displace_stamps(stamps, effects, middles[on_ccd] - camera.centers[ccd], experiment.pixel_size)
        # What crosses the rim of a stamp must not change the sum, which is 1, or 0 of a dark star.
        total = moved.sum(axis=(1, 2), keepdims=True)
        images[on_ccd] = moved * (stamps.sum(axis=(1, 2), keepdims=True) / np.where(total > 0.0, total, 1.0))
    return images


def ccd_outline(camera: Camera, name: str) -> CcdOutline:
    """Return the part of a CCD on which stars may stand."""
    bounds, turn = camera.rectangle(camera.ccd_index(name), _RIM * camera.pixel_size)
    return CcdOutline(name, bounds, camera.pixel_size, turn)


def ccd_stars(experiment: Experiment, name: str, width: float, least_light: float = 1.0) -> StarField:
    """Draw the stars of one CCD, the faintest of the S/N limit where vignetting is strongest.

    Observed stars are those of the catalogue where the configuration has one.
    """
    config, camera, listed = experiment.config, experiment.camera, experiment.star_list
    band, exposure = experiment.band, config.atmosphere.exposure_s
    at_rim = vignetted(band, least_light)
    faint = limiting_magnitude(config.stars.snr_min, at_rim, exposure, width) + 2.5 * np.log10(least_light)
    depth = Depth(band, exposure, faint=faint)
    try:
        depth.limits(width)
    except DomainError as error:
        if error.key == "faint":
            text = f"stars.snr_min = {config.stars.snr_min:g}: expected less: stars of magnitude {faint:.2f} saturate"
            raise ConfigError(text, key="stars.snr_min") from None
        raise
    drawn = make_star_field(
        ccd_outline(camera, name),
        config.stars.truth,
        config.stars.observed if listed is None else 0,
        config.seed,
        fwhm=width,
        depth=depth,
        margin=_MARGIN,
    )
    if listed is None:
        return drawn
    positions, magnitude = listed.on(name)
    return replace(
        drawn,
        observed=positions,
        magnitude=magnitude,
        electrons=electrons(magnitude, band, exposure),
        temperature=listed.temperatures(name),
        bright=resolved_value(config.stars.brightest),
        faint=resolved_value(config.stars.faintest),
    )
