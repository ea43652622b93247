"""Observation of the stars of a CCD: noise, defects, centred stamps, and the selection for the PSF model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.random_streams import stream
from ...measure.shapes import Shapes, measure_shapes
from ...measure.stamps import center_stamps, observe_stamps, with_unit_sum
from ...measure.star_selection import StarFlag, flag_stars
from ..experiment import Experiment
from ..sensor.brighter_fatter import brighter_fatter
from .photometry import instrument_noise, sky_electrons_per_pixel
from .star_defects import add_defects


@dataclass(frozen=True)
class Observation:
    """Observed stars of a CCD."""

    noise: tuple[float, float]  #: sky and rms noise without light [electrons/pixel]
    images: np.ndarray  #: [n, size, size], centred on a pixel, unit sum; NaN where not possible
    shapes: Shapes  #: of the images; e and size are NaN where a defect was detected
    defects: np.ndarray  #: :class:`~.StarFlag` bits of detected defects, [n]; 0 without a search
    used: np.ndarray  #: [n] bool: whether the star is good enough for the PSF model


def observe_ccd(
    experiment: Experiment, name: str, images: np.ndarray, pixel_scale: float, electrons: np.ndarray, *, noisy: bool
) -> Observation:
    """Observe the stars of a CCD, with noise and defects if `noisy`.

    `images` [n, ny, nx] are noise-free stars of unit sum at their sub-pixel positions, `pixel_scale` [rad] and
    `electrons` [n] theirs; the name of the CCD is part of the key of its random streams.
    """
    config = experiment.config
    seconds = config.atmosphere.exposure_s
    sky = sky_electrons_per_pixel(experiment.band, seconds, pixel_scale)
    noise = instrument_noise(experiment.band, seconds)
    exposed, full_well = images.astype(np.float64), None
    if noisy:
        clean = observe_stamps(exposed, electrons, sky, noise, _stream(experiment, "noise", name))
        exposed, full_well = _with_defects(experiment, name, clean, exposed)
    first = measure_shapes(exposed, pixel_scale, experiment.weight_fwhm)
    centred = center_stamps(exposed, first.x, first.y, size=experiment.stamp_size, normalize=False)
    stamps = with_unit_sum(centred)
    shapes = measure_shapes(stamps, pixel_scale, experiment.weight_fwhm)
    defects = np.zeros(len(stamps), dtype=np.int32)
    if noisy and config.reconstruction.flag_stars:
        defects = flag_stars(centred, np.hypot(np.sqrt(sky), noise)).flags
        if full_well is not None:
            # Pixels are compared with the full well before they are shifted.
            defects = np.where((exposed >= full_well).any(axis=(1, 2)), defects | StarFlag.SATURATED, defects)
        e1, e2, size = (np.where(defects == 0, v, np.nan) for v in (shapes.e1, shapes.e2, shapes.size))
        shapes = replace(shapes, e1=e1, e2=e2, size=size)
    used = shapes.usable & np.isfinite(stamps).all(axis=(1, 2)) & (defects == 0)
    return Observation((sky, noise), stamps, shapes, defects, used)


def collected_images(
    experiment: Experiment, images: np.ndarray, pixel_scale: float, electrons: np.ndarray
) -> np.ndarray:
    """Return images of stars of given electrons as the CCD collects them: under the brighter-fatter effect, if on."""
    config = experiment.config
    if config.sensor.brighter_fatter is None:
        return images
    sky = sky_electrons_per_pixel(experiment.band, config.atmosphere.exposure_s, pixel_scale)
    # Columns of the CCD, along which charge is transferred, run along x of the stamps where pixels exchange x and y.
    along_pixels = images.swapaxes(1, 2) if experiment.camera.transposed else images
    collected = brighter_fatter(along_pixels, electrons, sensor=config.sensor.brighter_fatter, sky=sky)
    return collected.swapaxes(1, 2) if experiment.camera.transposed else collected


def _with_defects(
    experiment: Experiment, name: str, stamps: np.ndarray, images: np.ndarray
) -> tuple[np.ndarray, float | None]:
    """Return the stamps [electrons] with the defects of the configuration, and the full well where any saturate."""
    stars = experiment.config.stars
    if not (stars.neighbours or stars.cosmic_rays or stars.saturated):
        return stamps, None
    full_well = _saturation_level(stamps, stars.saturated)
    defective, _ = add_defects(
        stamps,
        images,
        _stream(experiment, "defects", name),
        neighbours=stars.neighbours,
        cosmic_rays=stars.cosmic_rays,
        full_well=full_well,
    )
    return defective, full_well


def _saturation_level(stamps: np.ndarray, fraction: float) -> float | None:
    """Return the level [electrons] that the peaks of a fraction of the stars exceed; None where that is no star."""
    peaks = np.sort(stamps.max(axis=(1, 2)))
    count = round(fraction * len(peaks))
    if count == 0:
        return None
    below = peaks[-count - 1] if count < len(peaks) else 0.0
    return float(0.5 * (below + peaks[-count]))


def _stream(experiment: Experiment, what: str, name: str) -> np.random.Generator:
    """Return the random stream of a CCD's noise or defects, another one for each visit."""
    config = experiment.config
    visit = (config.atmosphere.epoch,) if config.atmosphere.epoch else ()
    return stream(config.seed, what, name, *visit)
