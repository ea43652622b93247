"""What the camera sees of the stars of a CCD: noise, defects, centred stamps, and which of them make a model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import DomainError
from ...core.random_streams import stream
from ..experiment import Experiment
from ..measure.shapes import Shapes, measure_shapes
from ..measure.star_selection import StarFlag, flag_stars, told_flags
from .photometry import instrument_noise, sky_electrons_per_pixel
from .stamps import center_stamps, observe_stamps
from .star_defects import spoil_stamps


@dataclass(frozen=True)
class Observation:
    """Observed stars of a CCD.

    Attributes
    ----------
    noise : tuple of float
        Sky [electrons/pixel] and rms noise without light [electrons/pixel].
    images : ndarray, shape [n, size, size]
        Stamps centred on a pixel, of unit sum; NaN where a star could not be centred.
    shapes : Shapes
        Of the stamps; e and size are NaN where a defect was found.
    defects : ndarray of int, shape [n]
        :class:`~pachon.pipeline.measure.star_selection.StarFlag` bits that were found; 0 where nobody looked.
    used : ndarray of bool, shape [n]
        Whether a model is to be fitted to the star.
    """

    noise: tuple[float, float]
    images: np.ndarray
    shapes: Shapes
    defects: np.ndarray
    used: np.ndarray

    def require(self, least: int) -> None:
        """Refuse a CCD of which fewer stars can be used.

        Raises
        ------
        DomainError
            One line with what the others have.
        """
        left = int(self.used.sum())
        if left < least:
            counts = told_flags(self.defects)
            raise DomainError(
                f"{left} of {len(self.used)} stars left{f' ({counts})' if counts else ''}: expected at least {least}"
            )


def observe_ccd(
    experiment: Experiment, name: str, images: np.ndarray, pixel_scale: float, electrons: np.ndarray, *, noisy: bool
) -> Observation:
    """Look at the stars of a CCD.

    Parameters
    ----------
    experiment : Experiment
        Says what noise, defects and selection there are.
    name : str
        Name of the CCD, in the key of its random streams.
    images : array
        [n, ny, nx] noise-free stars of unit sum, where they fall on their pixels.
    pixel_scale : float
        Angle of a pixel [rad].
    electrons : array
        [n] electrons of each star.
    noisy : bool
        Whether there are noise and defects at all.
    """
    config = experiment.config
    seconds = config.atmosphere.exposure_s
    sky, noise = sky_electrons_per_pixel(config.band or "r", seconds, pixel_scale), instrument_noise(seconds)
    seen, full_well = images.astype(np.float64), None
    if noisy:
        clean = observe_stamps(seen, electrons, sky, noise, _stream(experiment, "noise", name))
        seen, full_well = _spoilt(experiment, name, clean, seen)
    first = measure_shapes(seen, pixel_scale, experiment.weight_fwhm)
    stamps = center_stamps(seen, first.x, first.y, size=experiment.stamp_size)
    shapes = measure_shapes(stamps, pixel_scale, experiment.weight_fwhm)
    defects = np.zeros(len(stamps), dtype=np.int32)
    if noisy and config.reconstruction.flag_stars:
        centred = center_stamps(seen, first.x, first.y, size=experiment.stamp_size, normalize=False)
        defects = flag_stars(centred, np.hypot(np.sqrt(sky), noise)).flags
        if full_well is not None:
            # Before they are shifted, pixels tell whether they are full.
            defects = np.where((seen >= full_well).any(axis=(1, 2)), defects | StarFlag.SATURATED, defects)
        e1, e2, size = (np.where(defects == 0, v, np.nan) for v in (shapes.e1, shapes.e2, shapes.size))
        shapes = replace(shapes, e1=e1, e2=e2, size=size)
    used = shapes.usable & np.isfinite(stamps).all(axis=(1, 2)) & (defects == 0)
    return Observation((sky, noise), stamps, shapes, defects, used)


def _spoilt(
    experiment: Experiment, name: str, stamps: np.ndarray, images: np.ndarray
) -> tuple[np.ndarray, float | None]:
    """Return the stamps [electrons] with the defects that are asked for, and where pixels are full, if any are."""
    stars = experiment.config.stars
    if not (stars.neighbours or stars.cosmic_rays or stars.saturated):
        return stamps, None
    full_well = _full_well(stamps, stars.saturated)
    spoilt, _ = spoil_stamps(
        stamps,
        images,
        _stream(experiment, "defects", name),
        neighbours=stars.neighbours,
        cosmic_rays=stars.cosmic_rays,
        full_well=full_well,
    )
    return spoilt, full_well


def _full_well(stamps: np.ndarray, fraction: float) -> float | None:
    """Return the level [electrons] that the peaks of a fraction of the stars exceed; None where that is no star."""
    peaks = np.sort(stamps.max(axis=(1, 2)))
    count = round(fraction * len(peaks))
    if count == 0:
        return None
    below = peaks[-count - 1] if count < len(peaks) else 0.0
    return float(0.5 * (below + peaks[-count]))


def _stream(experiment: Experiment, what: str, name: str) -> np.random.Generator:
    """Return the random stream of a CCD's noise or defects: each visit has its own, and the first the plain one."""
    config = experiment.config
    visit = (config.atmosphere.epoch,) if config.atmosphere.epoch else ()
    return stream(config.seed, what, name, *visit)
