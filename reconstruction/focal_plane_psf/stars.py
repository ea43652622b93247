"""Stars of one exposure over a whole focal plane: positions, CCDs, shapes or stamps, and their noise."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

from ...core.arguments import check_arguments
from ...core.docstrings import Description
from ...core.errors import DomainError, ProductError
from ...core.files import parsing, require_file
from ...core.number_text import counted
from ...core.point_plots import draw_points
from ...core.result import Result
from ...core.units import ARCSEC, positive_angle, radians, real_array
from ...measure.shapes import Shapes, measure_shapes
from ..ccd_product import CcdProduct, ObservedStars, read_product
from .covariance import Places
from .mosaic import Mosaic, PsfShapes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Noise of e1, e2 and ln size times the S/N, of stars as wide as the weight, where no stamps are given.
NOISE_PER_SNR = (0.50, 0.50, 0.52)
#: Difference of angles of a rotator that are the same [rad].
SAME_ROTATOR = 1e-6
# Relative difference of weights that are the same.
_SAME_WEIGHT = 1e-6
# Pixels of the mean star that are changed at a time: of all at once, wide stamps would fill the memory.
_PIXELS_TOGETHER = 1024
# Least part of the variance of a shape that the good pixels of a star have: fewer would not be a star.
_LEAST_SHOWN = 0.05


class CcdStars(NamedTuple):
    """Observed stars of one CCD."""

    name: str  #: of the CCD
    x: np.ndarray  #: detector position [m]
    y: np.ndarray
    shapes: Shapes | ObservedStars  #: measured on the stamps
    electrons: np.ndarray  #: of each star
    noise: tuple[float, float]  #: sky, and rms noise without light [electrons/pixel]
    stamps: np.ndarray  #: centred, of unit flux, [n, ny, nx]
    used: np.ndarray  #: stars to use, [n] bool
    masks: np.ndarray | None = None  #: pixels of the stamps that were filled, [n, ny, nx] bool

    def columns(self) -> tuple[np.ndarray, ...]:
        """Return name, x, y, values, electrons, variance of a pixel without the star, stamp and mask of used stars."""
        used, shapes = self.used, self.shapes
        values = np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)[used]
        level = np.full(len(values), self.noise[0] + self.noise[1] ** 2)
        names = np.full(len(values), self.name)
        masks = np.zeros(self.stamps.shape, dtype=bool) if self.masks is None else self.masks
        return names, self.x[used], self.y[used], values, self.electrons[used], level, self.stamps[used], masks[used]


@dataclass(frozen=True, eq=False)
class FocalPlaneStars(Result):
    """Stars of one exposure.

    Attributes
    ----------
    ccd : tuple of str
        CCD of each star.
    x, y : ndarray, shape [n]
        Positions on the detector [m], or in pixels of the CCD where `pixels`.
    values : ndarray, shape [n, 3]
        e1, e2 and the logarithm of the weighted rms size [rad]; NaN for a star without a shape.
    noise : ndarray, shape [n, 3]
        Standard deviations of their noise; that of ln size is relative.
    stamps : ndarray, shape [n, ny, nx], or None
        Centred images of unit flux.
    pixel_scale : float or None
        Angle of a pixel of the stamps [rad].
    weight_fwhm : float
        Weight of the moments [rad].
    pixels : bool
        Whether positions are in pixels.
    rotator : float or None
        Angle of the camera from +x towards +y of the telescope frame [rad]; None where it is not known.
    """

    _table = ("ccd", "x", "y", "usable")
    _row_type = PsfShapes

    ccd: tuple[str, ...]
    x: np.ndarray
    y: np.ndarray
    values: np.ndarray
    noise: np.ndarray
    stamps: np.ndarray | None = None
    pixel_scale: float | None = None
    weight_fwhm: float = 0.7 * ARCSEC
    pixels: bool = False
    rotator: float | None = None

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the places of the stars, coloured by the weighted rms size."""
        x, y = (self.x, self.y) if self.pixels else (1e3 * self.x, 1e3 * self.y)
        labels = ("x [pixel]", "y [pixel]") if self.pixels else ("x [mm]", "y [mm]")
        size = np.exp(self.values[:, 2]) / ARCSEC
        return draw_points(ax, x, y, labels, color=size, color_label="weighted rms size [arcsec]", equal=True)

    def __len__(self) -> int:
        return len(self.x)

    def _columns(self) -> dict[str, Any]:
        """Return the columns of :meth:`from_table`."""
        shapes = PsfShapes.of_values(self.values)
        columns = {"ccd": self.ccd, "x": self.x, "y": self.y, "e1": shapes.e1, "e2": shapes.e2, "size": shapes.size}
        noise = {f"{name}_noise": values for name, values in zip(("e1", "e2", "size"), self.noise.T, strict=True)}
        return {**columns, **noise, "usable": self.usable}

    def _described(self, name: str) -> Description:
        if name in ("x", "y") and self.pixels:
            return Description("pix", "Positions in pixels of the CCD")
        return super()._described("noise" if name.endswith("_noise") else name)

    @property
    def usable(self) -> np.ndarray:
        """Stars with position, shape and noise, shape [n] bool."""
        good = np.isfinite(self.values).all(axis=1) & np.isfinite(self.noise).all(axis=1) & (self.noise > 0).all(axis=1)
        return good & np.isfinite(self.x) & np.isfinite(self.y)

    @classmethod
    @check_arguments
    def of_ccds(
        cls, ccds: Iterable[CcdStars], pixel_scale: float, weight_fwhm: float = 0.7 * ARCSEC, *, pixels: bool = False
    ) -> FocalPlaneStars:
        """Take the used stars of CCDs, whose noise is that of their photons and pixels.

        With `pixels` positions are in pixels of the CCDs, in place of metres on the detector.
        """
        parts = [ccd_columns.columns() for ccd_columns in ccds]
        if not any(len(ccd_columns[0]) for ccd_columns in parts):
            raise DomainError("no stars: expected products with stars that a PSF model can use")
        columns = (np.concatenate(column) for column in zip(*parts, strict=True))
        names, x, y, values, electrons, level, stamps, masks = columns
        noise = photon_noise(stamps, electrons, level, pixel_scale, weight_fwhm, masks)
        return cls(tuple(names.tolist()), x, y, values, noise, stamps, pixel_scale, weight_fwhm, pixels)

    @classmethod
    @check_arguments
    def from_products(cls, products: Sequence[CcdProduct], weight_fwhm: float = 0.7 * ARCSEC) -> FocalPlaneStars:
        """Take the observed stars that are good enough for a PSF model from the products of a run."""
        ccds = [
            CcdStars(p.name, o.x, o.y, o, o.electrons, p.noise, p.observed_images, o.used)
            for p, o in ((product, product.observed) for product in products)
        ]
        stars = cls.of_ccds(ccds, products[0].pixel_scale if products else np.nan, weight_fwhm)
        angles = sorted({product.rotator for product in products})
        if angles[-1] - angles[0] > SAME_ROTATOR:
            raise DomainError(
                f"rotator: {angles[0]:g} rad in a product, and {angles[-1]:g} rad in another: expected one exposure"
            )
        return replace(stars, rotator=angles[0])

    @classmethod
    @check_arguments
    def from_table(
        cls, table: Any, *, stamps: Any = None, pixel_scale: float | None = None, weight_fwhm: float = 0.7 * ARCSEC
    ) -> FocalPlaneStars:
        """Take stars from a table, structured array or mapping.

        Parameters
        ----------
        table : table, structured array or mapping
            Columns as below.
        stamps : array, optional
            Images of the stars, centred, [n, size, size].
        pixel_scale, weight_fwhm : float
            Pixel of the stamps, and weight of the moments [rad]; at least a pixel, better 2.5.

        Notes
        -----
        Columns, in any case: ``ccd`` (name), ``x``, ``y`` (lengths [m], other units are honoured; ``pix``: pixels of
        the CCD); ``e1``, ``e2``, ``size`` ([rad] or with a unit), or stamps, in a column ``stamp`` or as `stamps`,
        with `pixel_scale` [rad]; ``snr``, or ``e1_noise``, ``e2_noise`` and ``size_noise`` (relative). Stars
        whose ``used`` is false are left out.

        Raises
        ------
        DomainError
            If a column is missing or has values that are no numbers, or stamps are not square.
        """
        columns = _columns(table)
        if "ccd" not in columns:
            raise DomainError(f"stars: no column 'ccd' among {', '.join(columns) or 'none'}")
        x, y = (_quantity(columns, name, u.m) for name in "xy")
        in_pixels, y_in_pixels = (getattr(columns[name], "unit", None) == u.pix for name in "xy")
        if in_pixels != y_in_pixels:
            raise DomainError("stars: columns x and y: expected both in pixels, or both lengths")
        names = [v.decode().strip() if isinstance(v, bytes) else str(v).strip() for v in np.asarray(columns["ccd"])]
        given_stamps = columns.get("stamp") if stamps is None else stamps
        cube: np.ndarray | None = None
        if given_stamps is not None:
            images = real_array(getattr(given_stamps, "value", given_stamps), "stamps: expected real numbers")
            if images.ndim != 3 or images.shape[1] != images.shape[2]:
                raise DomainError(f"stamps have shape {images.shape}: expected [n, size, size]")
            if pixel_scale is None:
                raise DomainError("stamps: expected pixel_scale, the angle of a pixel in radians")
            if len(images) != len(x):
                raise DomainError(f"{counted(len(images), 'stamp')} for {counted(len(x), 'star')}")
            cube = images / images.sum(axis=(1, 2), keepdims=True)
        if "e1" in columns:
            size = _quantity(columns, "size", u.rad)
            with np.errstate(divide="ignore", invalid="ignore"):
                values = _concatenated(
                    {"e1": _quantity(columns, "e1"), "e2": _quantity(columns, "e2"), "size": np.log(size)}
                )
        elif cube is not None:
            shapes = measure_shapes(cube, pixel_scale or 0.0, weight_fwhm)
            values = np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)
        else:
            raise DomainError(f"stars: expected columns e1, e2, size or stamps; columns are {', '.join(columns)}")
        if "snr" in columns and "e1_noise" not in columns:
            snr, per_snr = _quantity(columns, "snr"), np.array(NOISE_PER_SNR)
            if cube is not None:
                per_snr = noise_per_snr(cube, snr, pixel_scale or 0.0, weight_fwhm)
            with np.errstate(divide="ignore"):
                noise = per_snr / snr[:, None]
        else:
            noise = _concatenated({f"{n}_noise": _quantity(columns, f"{n}_noise") for n in ("e1", "e2", "size")})
        stars = cls(tuple(names), x, y, values, noise, cube, pixel_scale, weight_fwhm, bool(in_pixels))
        lengths = {"ccd": len(names), "x": len(x), "y": len(y), "shapes": len(values), "noise": len(noise)}
        if len(set(lengths.values())) > 1:
            raise DomainError(f"stars: columns of different lengths, {lengths}")
        if "used" in columns and len(np.asarray(columns["used"])) != len(x):
            flags = counted(len(np.asarray(columns["used"])), "value")
            raise DomainError(f"stars: column 'used' has {flags} for {counted(len(x), 'star')}")
        if "used" in columns:
            stars = stars.chosen(np.asarray(columns["used"], dtype=bool))
        return stars

    @classmethod
    @check_arguments
    def read(cls, path: str | Path, **options: Any) -> FocalPlaneStars:
        """Read stars from the folder of a run, or from a FITS or ECSV table with the columns of :meth:`from_table`.

        Options are those of :meth:`from_table`. Runs, and tables of :meth:`write`, have the weight of their stars.
        """
        place = Path(path)
        if place.is_dir():
            files = sorted(place.glob("ccd_*.fits"))
            if not files:
                raise ProductError("no products of a run (ccd_*.fits)", file=place)
            weight = _product_weight_fwhm(files[0])
            stated_weight = positive_angle(options.pop("weight_fwhm", weight), "weight_fwhm")
            if not same_weight(stated_weight, weight):
                raise ProductError(other_weight(stated_weight, weight), file=files[0])
            products = [read_product(f, holdout_images=False) for f in files]
            return cls.from_products(products, weight, **options)
        require_file(place, ProductError)
        with parsing(place, "cannot be read as a table of stars", ProductError):
            kind = "fits" if place.suffix.lower() in (".fits", ".fit") else "ascii.ecsv"
            table = Table.read(place, format=kind)
        meta = {str(key).lower(): value for key, value in table.meta.items()}
        of_file = {"weight_fwhm": meta["weight_fwhm"]} if "weight_fwhm" in meta else {}
        rotator = meta.get("rotator")
        try:
            stars = cls.from_table(table, **of_file | options)
            return stars if rotator is None else replace(stars, rotator=float(radians(rotator, "rotator")))
        except DomainError as error:
            raise ProductError(error.reason, file=place) from None

    @check_arguments
    def chosen(self, which: np.ndarray | NDArray[np.bool_]) -> FocalPlaneStars:
        """Return some of the stars, by a mask [n] or indices."""
        index = np.arange(len(self))[which]
        return replace(
            self,
            ccd=tuple(self.ccd[i] for i in index),
            x=self.x[index],
            y=self.y[index],
            values=self.values[index],
            noise=self.noise[index],
            stamps=None if self.stamps is None else self.stamps[index],
        )


def _product_weight_fwhm(product: Path) -> float:
    """Return the weight of the moments in a product of a run [rad]."""
    with parsing(product, "no weight of the moments, WFWHM", ProductError):
        return float(fits.getval(product, "WFWHM")) * ARCSEC


def photon_noise(
    stamps: np.ndarray,
    electrons: np.ndarray,
    level: np.ndarray,
    pixel_scale: float,
    weight_fwhm: float,
    masks: np.ndarray | None = None,
) -> np.ndarray:
    r"""Return standard deviations of e1, e2 and ln size of stars of given electrons, shape [n, 3].

    With the mean star I of unit sum, the derivatives g of a shape with respect to its pixels, and F electrons over a
    background of variance V a pixel, the variance is :math:`\sum g^2 (V / F^2 + I / F)`, over the part of it that the
    pixels without a mask have.

    Parameters
    ----------
    stamps : ndarray, shape [n, ny, nx]
        Stars of unit flux.
    electrons : ndarray, shape [n]
        Of each star.
    level : ndarray, shape [n]
        Variance of a pixel without the star [electron^2].
    masks : ndarray of bool, shape [n, ny, nx], optional
        Pixels of the stamps that tell nothing of the shape.
    """
    mean, slopes = _mean_star(stamps, electrons / np.sqrt(electrons + level), pixel_scale, weight_fwhm)
    white, photons = slopes**2, slopes**2 * np.maximum(mean.ravel(), 0.0)
    of_white, light = (level / electrons**2)[:, None], electrons[:, None]
    variances = white.sum(axis=1) * of_white + photons.sum(axis=1) / light
    if masks is not None and (masked := np.flatnonzero(masks.any(axis=(1, 2)))).size:
        hidden = masks[masked].reshape(len(masked), -1)
        of_hidden = hidden @ white.T * of_white[masked] + hidden @ photons.T / light[masked]
        # Shapes are those of the other pixels: as much less is known of them.
        variances[masked] /= np.maximum(1.0 - of_hidden / variances[masked], _LEAST_SHOWN)
    return np.sqrt(variances)


def noise_per_snr(stamps: np.ndarray, snr: np.ndarray, pixel_scale: float, weight_fwhm: float) -> np.ndarray:
    r"""Return the noise of e1, e2 and ln size times the signal-to-noise ratio of PSF photometry, shape [3].

    For white noise it is :math:`|g| |I|`, with the mean star I of unit sum and the derivatives g of its shape with
    respect to the pixels. Where photons of the star itself are most of the noise it is up to a fourth less.
    """
    good = np.isfinite(stamps).all(axis=(1, 2)) & np.isfinite(snr) & (snr > 0.0)
    if not good.any():
        return np.array(NOISE_PER_SNR)
    mean, slopes = _mean_star(stamps[good], snr[good], pixel_scale, weight_fwhm)
    return np.sqrt((slopes**2).sum(axis=1) * (mean**2).sum())


def _mean_star(
    stamps: np.ndarray, snr: np.ndarray, pixel_scale: float, weight_fwhm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean star [ny, nx], and the derivatives of its e1, e2 and ln size by pixel [3, ny nx]."""
    weight = np.minimum(snr, 100.0) ** 2
    mean = np.einsum("n,nyx->yx", weight / weight.sum(), stamps.astype(np.float64))
    step = 1e-6

    def values(images: np.ndarray) -> np.ndarray:
        shapes = measure_shapes(images, pixel_scale, weight_fwhm)
        return np.stack([shapes.e1, shapes.e2, np.log(shapes.size)])

    slopes = np.empty((3, mean.size))
    for first in range(0, mean.size, _PIXELS_TOGETHER):
        pixels = np.arange(first, min(first + _PIXELS_TOGETHER, mean.size))
        changed = np.repeat(mean.reshape(1, -1), len(pixels), axis=0)
        changed[np.arange(len(pixels)), pixels] += step
        slopes[:, pixels] = values(changed.reshape(-1, *mean.shape))
    return mean, (slopes - values(mean[None])) / step


def places_of(mosaic: Mosaic, stars: FocalPlaneStars) -> Places:
    """Return the places of stars."""
    x, y = (stars.x * u.pix, stars.y * u.pix) if stars.pixels else (stars.x, stars.y)
    return mosaic.places(stars.ccd, x, y)


def stars_of(stars: Any, weight_fwhm: float | None = None) -> FocalPlaneStars:
    """Return stars given in any of the accepted ways: themselves, a table, or the path of a file or of a run.

    Under a weight of the moments [rad] other than theirs, where it is known, they are a DomainError or ProductError.
    """
    options = {} if weight_fwhm is None else {"weight_fwhm": weight_fwhm}
    if isinstance(stars, (str, Path)):
        return FocalPlaneStars.read(stars, **options)
    if not isinstance(stars, FocalPlaneStars):
        return FocalPlaneStars.from_table(stars, **options)
    # Stars without stamps may leave theirs unstated.
    stated = stars.stamps is not None or not same_weight(stars.weight_fwhm, FocalPlaneStars.weight_fwhm)
    if weight_fwhm is not None and stated and not same_weight(weight_fwhm, stars.weight_fwhm):
        raise DomainError(other_weight(weight_fwhm, stars.weight_fwhm), key="weight_fwhm")
    return stars


def same_weight(one: float, other: float) -> bool:
    """Return whether two weights of moments are the same, but for rounding."""
    return math.isclose(one, other, rel_tol=_SAME_WEIGHT)


def other_weight(given: float, of_stars: float) -> str:
    """Return the message of a weight of the moments that is not that of the stars [rad]."""
    expected = f"expected {of_stars / ARCSEC:.4g}, under which the stars were measured"
    return f"weight_fwhm = {given / ARCSEC:.4g} arcsec: {expected}"


def _concatenated(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Return columns of one length side by side."""
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise DomainError(f"stars: columns of different lengths, {lengths}")
    return np.stack(list(columns.values()), axis=1)


def _columns(table: Any) -> dict[str, Any]:
    names = getattr(table, "colnames", None) or getattr(getattr(table, "dtype", None), "names", None)
    if names is None:
        if not isinstance(table, Mapping):
            raise DomainError(f"stars = {type(table).__name__}: expected a table, a mapping or the path of a file")
        names = list(table)
    return {str(name).lower(): table[name] for name in names}


def _quantity(columns: Mapping[str, Any], name: str, unit: u.UnitBase | None = None) -> np.ndarray:
    """Return a column as float64; in the unit, where it has another; masked values are NaN."""
    if name not in columns:
        raise DomainError(f"stars: no column {name!r}; columns are {', '.join(columns) or 'none'}")
    column = columns[name]
    column_unit = getattr(column, "unit", None)
    values = column.filled(np.nan) if hasattr(column, "filled") and np.ma.isMaskedArray(column) else column
    try:
        array = np.asarray(getattr(values, "value", values), dtype=np.float64)
    except (TypeError, ValueError):
        raise DomainError(f"stars: column {name!r} of type {np.asarray(values).dtype}: expected numbers") from None
    if array.ndim != 1:
        raise DomainError(f"stars: column {name!r} has shape {array.shape}: expected one number a star")
    if unit is None or column_unit is None or str(column_unit) in ("", "pix"):
        return array
    try:
        return array * u.Unit(column_unit).to(unit)
    except u.UnitConversionError:
        raise DomainError(f"stars: column {name!r} in {column_unit}: expected a unit that converts to {unit}") from None
