"""Images of any program as :class:`~pachon.CcdImage`: pixels, variance, mask, world coordinates, gain, zero point."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError, ProductError
from ...core.fits_files import readable_cards
from ...core.noise_planes import NoiseKind
from ...core.units import ARCSEC, positive_angle, require_positive
from ...measure.pixel_masks import clipped_level, empty_pixels
from ..image_file import CcdImage
from .fits_parts import FitsPart, FitsParts
from .header_cards import BAND_KEYS, CHIP_KEYS, GAIN_KEYS, HeaderCards, Sourced
from .pixel_noise import (
    BlankImageError,
    PixelVariance,
    Sky,
    measured_variance,
    photon_slope,
    scaled_to_sky,
    variance_of_plane,
    with_photons,
)
from .planes import Defects, PlaneNames, companion_in, defects_of, planes_of
from .world_cards import world_cards

#: Bits of the mask of an image of another program.
SATURATED_BIT = 1
BAD_BIT = 2
WeightName = Literal["weight", "variance", "rms"]
#: Cards of the observation that stay as they are.
_KEPT = ("OBJECT", "TELESCOP", "INSTRUME", "DATE-OBS", "MJD-OBS", "CCDNUM")
#: Card of images of Pan-STARRS whose pixels are no linear measure of light.
_SOFTENING = "BSOFTEN"
#: Bytes of a pixel, its variance and its mask.
_PLANE_BYTES = 10
#: Least noise of a pixel: below it variances are zero, or in coarse steps, in single precision.
_LEAST_NOISE = 1e-21
#: Fewest pixels along a side of an image: the stamps of stars have as many.
_LEAST_SIDE = 32


@check_arguments
@dataclass(frozen=True)
class ImageSettings:
    """What the header of an image lacks, or has otherwise.

    Attributes
    ----------
    weight : str, Path or None
        FITS file of the noise of the pixels: the extension of the image's name, or its only image.
    weight_kind : str
        ``weight``: inverse variance, in any scale, as SExtractor's MAP_WEIGHT; ``variance``; or ``rms``.
    mask : str, Path or None
        FITS file of the mask.
    gain : float or None
        Electrons in a unit of the image.
    zero_point : float or None
        Magnitude of a unit of the image.
    pixel_scale : float, Quantity or None
        Angle of a pixel of an image without world coordinates [rad].
    saturation : float or None
        Level from which on pixels are saturated [unit of the image].
    """

    weight: str | Path | None = None
    weight_kind: WeightName = "weight"
    mask: str | Path | None = None
    gain: float | None = None
    zero_point: float | None = None
    pixel_scale: ArrayLike | None = None
    saturation: float | None = None

    def __post_init__(self) -> None:
        for name in ("gain", "saturation"):
            if getattr(self, name) is not None:
                require_positive(getattr(self, name), name)
        if self.zero_point is not None and not math.isfinite(self.zero_point):
            raise DomainError(f"zero_point = {self.zero_point}: expected the magnitude of a unit of the image")
        if self.pixel_scale is not None:
            object.__setattr__(self, "pixel_scale", positive_angle(self.pixel_scale, "pixel_scale"))

    @property
    def files(self) -> list[Path]:
        """Files of weight and mask."""
        return [Path(path) for path in (self.weight, self.mask) if path is not None]


@dataclass(frozen=True)
class ImageSource:
    """One image of a file.

    Attributes
    ----------
    path : Path
        The file.
    extension : str or None
        Name or number of the extension in a file of several images; None for the only one.
    n_bytes : int
        Size of its pixels, variance and mask in memory [byte].
    among : int
        Number of images of the file that are read, this one included.
    """

    path: Path
    extension: str | None = None
    n_bytes: int = field(default=0, compare=False)
    among: int = field(default=1, compare=False)


def image_sources(path: Path, extension: str | None = None) -> list[ImageSource]:
    """Return the images of a file; ProductError if it has none, or is no FITS file."""
    file = FitsParts.of(path)
    images = planes_of(file, extension)
    several = len(images) > 1 or extension is not None
    return [
        ImageSource(
            path,
            file.label(planes.image) if several else None,
            _PLANE_BYTES * int(np.prod(planes.image.image_shape)),
            len(images),
        )
        for planes in images
    ]


@check_arguments
def load_image(path: str | Path, *, extension: str | None = None, settings: ImageSettings | None = None) -> CcdImage:
    """Read an image of a CCD from a FITS file of any program.

    Read are images of LSST and HSC (IMAGE, MASK, VARIANCE), of DES (SCI, MSK, WGT), of Euclid's VIS (3-4.E.SCI and so
    on), those with extensions of weights, variances, errors and masks of usual names, and plain ones, in one or many
    extensions, compressed by fpack or gzip.
    World coordinates are those that astropy reads: TAN, SIP, TPV, TNX and others. What is in no card, and cannot be
    measured, is asked for; ``image.origins`` says where each thing came from.

    Without a plane of noise the variance is that of the sky in cells of 64 pixels, and of the photons of the light.
    Weights on another scale than the noise of the sky are scaled to it.

    Parameters
    ----------
    path : str or Path
        The file.
    extension : str, optional
        Name or number of the extension, in a file of several images; name and version, as ``SCI,2``, of equal names.
    settings : ImageSettings, optional
        Weight and mask in files of their own, gain, zero point, pixel scale, saturation.

    Returns
    -------
    CcdImage
        In the unit of the file, its sky as it is; saturated pixels have the bit 1, others to leave out the bit 2.

    Raises
    ------
    ProductError
        If the file is missing, damaged, or has no such image, planes have different shapes, all weights are zero, a
        card is no number, or there is neither a gain nor a variance that shows it, or neither world coordinates nor a
        pixel scale.
    """
    path, settings = Path(path), settings or ImageSettings()
    file = FitsParts.of(path)
    if settings == ImageSettings() and extension is None and _is_own(file):
        return CcdImage.read(path)
    with readable_cards(path, ProductError):
        images = planes_of(file, extension)
        if len(images) > 1:
            names = ", ".join(file.label(planes.image) for planes in images)
            raise ProductError(
                f"has {len(images)} images: expected extension = one of {names}", file=path, key="extension"
            )
        return _image_of(file, images[0], settings)


def _is_own(file: FitsParts) -> bool:
    """Return whether a file is one of ``pachon images``."""
    return "CCD" in file.parts[0].header and any(part.name == "TRUTH" for part in file.parts)


def _image_of(file: FitsParts, planes: PlaneNames, settings: ImageSettings) -> CcdImage:
    """Return an image with the planes beside it, all that is unknown from its header or measured."""
    part, path = planes.image, file.path
    if min(part.image_shape) < _LEAST_SIDE:
        ny, nx = part.image_shape
        raise ProductError(f"image of {nx} x {ny} pixels: expected at least {_LEAST_SIDE} along each side", file=path)
    if _SOFTENING in part.header:
        raise ProductError(
            f"{_SOFTENING} = {part.header[_SOFTENING]}: pixels are inverse hyperbolic sines of the light, as of stacks "
            "of Pan-STARRS: expected linear ones",
            file=path,
            key=_SOFTENING,
        )
    cards = HeaderCards(part.header, path)
    header = fits.Header()
    origins = {"image": f"{path.name} {part.name}".strip()}
    world = world_cards(part.header, (part.image_shape[0], part.image_shape[1]), path)
    if world is not None:
        header.extend(world)
        origins["world coordinates"] = str(world["CTYPE1"])
    elif settings.pixel_scale is not None:
        header["PIXSCALE"] = (float(np.asarray(settings.pixel_scale)) / ARCSEC, "[arcsec] side of a pixel")
        origins["pixel scale"] = "settings"
    else:
        raise ProductError(
            f"no world coordinates (CTYPE1 = {part.header.get('CTYPE1', 'missing')!r}: expected RA---TAN or the "
            "like): expected pixel_scale",
            file=path,
            key="pixel_scale",
        )
    image = file.pixels(part).astype(np.float64)
    defects, origins["mask"] = _defects(file, planes, settings)
    saturation = Sourced(settings.saturation, "settings") if settings.saturation is not None else cards.saturation()
    finite = np.isfinite(image)
    if settings.saturation is None and not defects.saturated.any():
        level = clipped_level(image, finite & ~defects.bad)
        # A card of raw pixels is too high for those less their bias.
        if level is not None and (saturation is None or level < saturation.value):
            saturation = Sourced(level, "clipped pixels")
    if saturation is not None:
        defects = Defects(defects.saturated | (image >= saturation.value), defects.bad)
        origins["saturation"] = saturation.source
    bad = ~finite | empty_pixels(image) | (defects.bad & ~defects.saturated)
    plane = _noise_plane(file, planes, settings)
    if plane is not None:
        bad |= plane.without
    if (bad | defects.saturated).all():
        raise BlankImageError("all pixels are masked, saturated or not finite: expected some that are good", file=path)
    sky = Sky.of(image, bad | defects.saturated, path)
    noise = float(np.median(sky.rms))
    if noise < _LEAST_NOISE:
        raise ProductError(
            f"noise of {noise:.2g} in a pixel: expected {_LEAST_NOISE:g} or more, in a larger unit, for squares in "
            "single precision",
            file=path,
        )
    light = np.where(bad, 0.0, image - sky.level)
    gain = Sourced(settings.gain, "settings") if settings.gain is not None else cards.gain()
    variance, gain = _variance(plane, sky, light, bad | defects.saturated, gain)
    if gain is None:
        raise ProductError(
            f"no gain (none of {', '.join(GAIN_KEYS[1:4])}, ..., and no variance with photon noise): expected gain",
            file=path,
            key="gain",
        )
    zero_point = Sourced(settings.zero_point, "settings") if settings.zero_point is not None else cards.zero_point()
    origins |= {"variance": variance.source, "gain": gain.source}
    origins["zero point"] = "unknown" if zero_point is None else zero_point.source
    _add_cards(header, cards, gain, zero_point)
    header["SKYSUB"] = (False, "whether the background is subtracted")
    header["SKY"] = (float(np.median(sky.level)), "background, measured")
    mask = np.where(bad, BAD_BIT, 0) | np.where(defects.saturated & finite, SATURATED_BIT, 0)
    label = file.label(part)
    name = image_stem(path) if label in ("SCI", "IMAGE") or not part.name else label
    return CcdImage(
        name,
        np.where(bad, sky.level, image).astype(np.float32),
        np.where(bad, 1.0, variance.values).astype(np.float32),
        mask.astype(np.int16),
        header,
        mask_bits={SATURATED_BIT: "SAT", BAD_BIT: "BAD"},
        origins=origins,
    )


def image_stem(path: Path) -> str:
    """Return the name of a file without .fits, and without .fz or .gz behind it."""
    name = path.name
    for ending in (".fz", ".gz"):
        name = name.removesuffix(ending)
    return Path(name).stem


def _defects(file: FitsParts, planes: PlaneNames, settings: ImageSettings) -> tuple[Defects, str]:
    """Return the pixels with defects, and where they are marked."""
    mask_file, part = file, planes.mask
    if settings.mask is not None:
        mask_file, part = companion_in(Path(settings.mask), planes.image)
    if part is None:
        return Defects(*np.zeros((2, *planes.image.image_shape), dtype=bool)), "none"
    _require_shape(mask_file, part, planes.image)
    return defects_of(mask_file.pixels(part), part, mask_file.path), f"{mask_file.path.name} {part.name}".strip()


def _noise_plane(file: FitsParts, planes: PlaneNames, settings: ImageSettings) -> PixelVariance | None:
    """Return the variance by the plane of noise; None where there is none."""
    noise_file, part, kind = file, planes.noise, planes.kind
    if settings.weight is not None:
        noise_file, part = companion_in(Path(settings.weight), planes.image)
        kind = NoiseKind(settings.weight_kind)
    if part is None:
        return None
    _require_shape(noise_file, part, planes.image)
    variance = variance_of_plane(noise_file.pixels(part), kind, f"{noise_file.path.name} {part.name}".strip())
    if variance.without.all():
        raise BlankImageError(f"{part.name or 'image'}: no pixel has a {kind.value} above zero", file=noise_file.path)
    return variance


def _require_shape(file: FitsParts, part: FitsPart, image: FitsPart) -> None:
    if part.image_shape != image.image_shape:
        (ny, nx), (rows, columns) = part.image_shape, image.image_shape
        raise ProductError(
            f"{part.name or 'image'} has {nx} x {ny} pixels: expected {columns} x {rows}, those of the image",
            file=file.path,
        )


def _variance(
    plane: PixelVariance | None, sky: Sky, light: np.ndarray, unfit: np.ndarray, gain: Sourced | None
) -> tuple[PixelVariance, Sourced | None]:
    """Return variance and gain, each from the other where it is unknown; `unfit` pixels do not count."""
    if plane is None:
        variance = measured_variance(sky)
        return (variance if gain is None else with_photons(variance, light, gain.value)), gain
    variance = scaled_to_sky(plane, sky, unfit)
    slope = photon_slope(variance, light, unfit, sky.rms)
    if gain is None and slope is not None and slope.gain is not None:
        gain = Sourced(slope.gain, f"slope of {variance.source} against the light")
    elif gain is not None and slope is not None and slope.lacks_photons(gain.value):
        variance = with_photons(variance, light, gain.value)
    return variance, gain


def _add_cards(header: fits.Header, cards: HeaderCards, gain: Sourced, zero_point: Sourced | None) -> None:
    """Add the cards of the exposure under the names that images of this program have."""
    header["GAIN"] = (gain.value, "electrons in a unit of the image")
    if zero_point is not None:
        header["ZEROPNT"] = (zero_point.value, "magnitude of a unit of the image")
    if (time := cards.exposure_time()) is not None:
        header["EXPTIME"] = (time.value, f"[s] {time.source}")
    if (band := cards.text(BAND_KEYS)) is not None:
        header["FILTER"] = band
    # Other observatories have names there.
    if (chip := cards.text(CHIP_KEYS)) is not None and re.fullmatch(r"\d+(\.0)?", chip):
        header["CCDNUM"] = (int(float(chip)), "number of the CCD")
    for key in _KEPT:
        if key not in header and (text := cards.text((key,))) is not None:
            header[key] = text
