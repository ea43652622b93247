"""Observation of the stars of a CCD: noise, defects, centred stamps, and the selection for the PSF model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ...core.errors import PachonError, attempt
from ...core.groups import rows_of, slices_of
from ...core.random_streams import stream
from ...measure.shapes import Shapes, measure_shapes
from ...measure.stamps import center_stamps, observe_stamps
from ...measure.star_flux import with_unit_flux
from ...measure.star_selection import StarFlag, flag_stars
from ..experiment import Experiment
from ..sensor.brighter_fatter import brighter_fatter
from .photometry import instrument_noise, sky_electrons_per_pixel
from .star_defects import add_defects


@dataclass(frozen=True)
class Observation:
    """Observed stars of a CCD."""

    noise: tuple[float, float]  #: sky and rms noise without light [electrons/pixel]
    images: np.ndarray  #: [n, size, size], centred on a pixel, unit flux; NaN where not possible
    shapes: Shapes  #: of the images; e and size are NaN where a defect was detected
    defects: np.ndarray  #: :class:`~.StarFlag` bits of detected defects, [n]; 0 without a search
    used: np.ndarray  #: [n] bool: whether the star is good enough for the PSF model


class CollectedStars(NamedTuple):
    """Noise-free stars of a CCD, as it collects their light."""

    name: str  #: of the CCD
    images: np.ndarray  #: of unit sum, at their sub-pixel positions, [n, ny, nx]
    pixel_scale: float  #: [rad]
    electrons: np.ndarray  #: [n]
    lit_fraction: float = 1.0  #: part of the sky's light that arrives


def observe_ccd(experiment: Experiment, stars: CollectedStars, *, noisy: bool) -> Observation:
    """Observe the stars of a CCD as :func:`observe_ccds` does."""
    observation = observe_ccds(experiment, [stars], noisy=noisy)[0]
    if isinstance(observation, PachonError):
        raise observation
    return observation


def observe_ccds(
    experiment: Experiment, ccds: Sequence[CollectedStars], *, noisy: bool
) -> list[Observation | PachonError]:
    """Observe the stars of CCDs, with noise and defects if `noisy`; with the error of a CCD in its place.

    Pixels and stamps of all CCDs are alike. The name of a CCD is part of the key of its random streams, and no CCD
    changes a byte of another: together they cost less, as stars are centred and measured at once.
    """
    config, pixel_scale = experiment.config, ccds[0].pixel_scale
    full_sky = sky_electrons_per_pixel(experiment.band, config.atmosphere.exposure_s, pixel_scale)
    skies = [full_sky * ccd.lit_fraction for ccd in ccds]
    noise = instrument_noise(experiment.band, config.atmosphere.exposure_s)
    exposed = [
        attempt(_exposed, experiment, ccd, sky, noise, noisy=noisy) for ccd, sky in zip(ccds, skies, strict=True)
    ]
    groups = [stars[0] for stars in exposed if not isinstance(stars, PachonError)]
    if not groups:
        return [stars for stars in exposed if isinstance(stars, PachonError)]
    together = np.concatenate(groups)
    first = measure_shapes(together, pixel_scale, experiment.weight_fwhm)
    centred = center_stamps(together, first.x, first.y, size=experiment.stamp_size, normalize=False)
    stamps = np.concatenate([with_unit_flux(centred[part])[0] for part in slices_of(groups)])
    shapes = measure_shapes(stamps, pixel_scale, experiment.weight_fwhm)
    parts = iter(slices_of(groups))

    def observed(part: slice, sky: float, images: np.ndarray, full_well: float | None) -> Observation:
        """Select the stars of a CCD."""
        own, defects = rows_of(shapes, part), np.zeros(len(images), dtype=np.int32)
        if noisy and config.reconstruction.flag_stars:
            defects = flag_stars(centred[part], np.hypot(np.sqrt(sky), noise)).flags
            if full_well is not None:
                # Pixels are compared with the full well before they are shifted.
                defects = np.where((images >= full_well).any(axis=(1, 2)), defects | StarFlag.SATURATED, defects)
            e1, e2, size = (np.where(defects == 0, v, np.nan) for v in (own.e1, own.e2, own.size))
            own = replace(own, e1=e1, e2=e2, size=size)
        used = own.usable & np.isfinite(stamps[part]).all(axis=(1, 2)) & (defects == 0)
        return Observation((sky, noise), stamps[part], own, defects, used)

    return [
        stars if isinstance(stars, PachonError) else attempt(observed, next(parts), sky, *stars)
        for stars, sky in zip(exposed, skies, strict=True)
    ]


def _exposed(
    experiment: Experiment, ccd: CollectedStars, sky: float, noise: float, *, noisy: bool
) -> tuple[np.ndarray, float | None]:
    """Return the images of the stars of a CCD [electrons] if `noisy`, and the full well where any saturate."""
    images = ccd.images.astype(np.float64)
    if not noisy:
        return images, None
    clean = observe_stamps(images, ccd.electrons, sky, noise, _stream(experiment, "noise", ccd.name))
    return _with_defects(experiment, ccd.name, clean, images)


def collected_images(
    experiment: Experiment, images: np.ndarray, pixel_scale: float, electrons: np.ndarray, lit_fraction: float = 1.0
) -> np.ndarray:
    """Return images of stars of given electrons as the CCD collects them: under the brighter-fatter effect, if on.

    A part of the light of the sky on the axis arrives, of which pixels have charge too.
    """
    config = experiment.config
    if config.sensor.brighter_fatter is None:
        return images
    sky = lit_fraction * sky_electrons_per_pixel(experiment.band, config.atmosphere.exposure_s, pixel_scale)
    # Columns of the CCD, along which charge is transferred, run along x of the stamps where pixels exchange x and y.
    along_pixels = images.swapaxes(1, 2) if experiment.camera.transposed else images
    # The charge of each snap moves boundaries.
    snaps = experiment.snaps
    collected = brighter_fatter(along_pixels, electrons / snaps, sensor=config.sensor.brighter_fatter, sky=sky / snaps)
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
