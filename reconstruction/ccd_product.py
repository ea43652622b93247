"""Product of one CCD: stars, stamps and PSF models, and their FITS file.

Correlations, summary and report are computed from these files alone, so a resumed run and an uninterrupted one have the
same input.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from astropy.io import fits

from ..core.errors import ProductError, check_choice, unknown_name
from ..core.products import Stamp, column, image_hdu, read_fits, table_hdu, write_fits, write_hdus
from ..core.units import ARCSEC
from ..measure.rho_statistics import trace_of_moments
from .psf_model.model import PsfModel


class _Unit(NamedTuple):
    name: str
    size: float


_MM, _DEG, _SEC, _NONE = _Unit("mm", 1e-3), _Unit("deg", np.pi / 180.0), _Unit("arcsec", ARCSEC), _Unit("", 1.0)
_MODEL = "PSF"
_NOISE_FREE_MODEL = "TRUEPSF"
#: Ellipticities of a CCD, see :meth:`CcdProduct.ellipticity`.
KINDS = ("truth", "observed", "residual", "left_out", "away")
#: Ellipticities, see :meth:`CcdProduct.ellipticity`: of the weighted moments (e), and of the adaptive ones (g).
MOMENTS = ("e", "g")
#: Residuals of the CCD's own model in runs with a focal-plane model.
CCD_KINDS = ("residual_ccd", "away_ccd")
#: FITS card that says which model the columns MODEL_E1 and so on are of; only in runs with a focal-plane model.
MODEL_CARD = "PSFMODEL"
# FITS card of the angle of the camera; only in runs with one.
_ROTATOR_CARD = "ROTATOR"
_COLUMNS: dict[str, tuple[str, _Unit, str]] = {
    "x": ("X", _MM, "detector x"),
    "y": ("Y", _MM, "detector y"),
    "field_x": ("FIELD_X", _DEG, "field angle, slope of the light along x"),
    "field_y": ("FIELD_Y", _DEG, "field angle, slope of the light along y"),
    "ra": ("RA", _DEG, "right ascension, ICRS, without refraction"),
    "dec": ("DEC", _DEG, "declination, ICRS, without refraction"),
    "e1_sky": ("E1_SKY", _NONE, "E1, E2 on the sky, > 0 from east to west"),
    "e2_sky": ("E2_SKY", _NONE, "likewise, > 0 from north-west to south-east"),
    "g1_sky": ("G1_SKY", _NONE, "G1, G2 on the sky, > 0 from east to west"),
    "g2_sky": ("G2_SKY", _NONE, "likewise, > 0 from north-west to south-east"),
    "magnitude": ("MAG", _Unit("mag", 1.0), "AB magnitude"),
    "electrons": ("ELECTRON", _Unit("electron", 1.0), "electrons of the star in the exposure"),
    "colour": ("COLOUR", _Unit("nm", 1e-9), "mean wavelength of the star in the band"),
    "snr": ("SNR", _NONE, "signal to noise of PSF photometry"),
    "e1": ("E1", _NONE, "ellipticity (a-b)/(a+b) along x"),
    "e2": ("E2", _NONE, "ellipticity along x = y"),
    "size": ("SIZE", _SEC, "weighted rms size (Q11 Q22 - Q12^2)^(1/4)"),
    "fwhm": ("FWHM", _SEC, "full width at half maximum"),
    "flags": ("FLAGS", _NONE, "shape flags, 0 is good"),
    "used": ("USED", _NONE, "whether the model was fitted to the star"),
    "defects": ("DEFECTS", _NONE, "1 neighbour, 2 cosmic ray, 4 full, 8 unusable"),
    "model_e1": ("MODEL_E1", _NONE, "ellipticity of the model there"),
    "model_e2": ("MODEL_E2", _NONE, "ellipticity of the model there"),
    "model_size": ("MODELSZ", _SEC, "weighted rms size of the model there"),
    "g1": ("G1", _NONE, "g of adaptive moments, (a-b)/(a+b) along x"),
    "g2": ("G2", _NONE, "g of adaptive moments along x = y"),
    "sigma": ("SIGMA", _SEC, "size of adaptive moments, |M|^(1/4)"),
    "adaptive_flags": ("G_FLAGS", _NONE, "flags of adaptive moments, 0 is good"),
    "model_g1": ("MODEL_G1", _NONE, "g of the model there"),
    "model_g2": ("MODEL_G2", _NONE, "g of the model there"),
    "model_sigma": ("MODELSIG", _SEC, "size of adaptive moments of the model"),
    "leave_one_out_g1": ("LOO_G1", _NONE, "of the model fitted without the star"),
    "leave_one_out_g2": ("LOO_G2", _NONE, "of the model fitted without the star"),
    "leave_one_out_sigma": ("LOO_SIG", _SEC, "of the model fitted without the star"),
    "leave_one_out_e1": ("LOO_E1", _NONE, "of the model fitted without the star"),
    "leave_one_out_e2": ("LOO_E2", _NONE, "of the model fitted without the star"),
    "ccd_e1": ("CCD_E1", _NONE, "ellipticity of the CCD's own model there"),
    "ccd_e2": ("CCD_E2", _NONE, "ellipticity of the CCD's own model there"),
    "ccd_size": ("CCD_SIZE", _SEC, "weighted rms size of the CCD's own model"),
    "ccd_g1": ("CCD_G1", _NONE, "g of the CCD's own model there"),
    "ccd_g2": ("CCD_G2", _NONE, "g of the CCD's own model there"),
    "ccd_sigma": ("CCD_SIG", _SEC, "size of adaptive moments, CCD's own model"),
    "sigma_e1": ("SIG_E1", _NONE, "predicted uncertainty of MODEL_E1"),
    "sigma_e2": ("SIG_E2", _NONE, "predicted uncertainty of MODEL_E2"),
    "sigma_size": ("SIG_SIZE", _SEC, "predicted uncertainty of MODELSZ"),
}
# Columns that a focal-plane model replaces, and those with the replaced values of the CCD's own model.
_REPLACED = frozenset(
    [f"MODEL_{key}" for key in ("E1", "E2", "G1", "G2")]
    + [f"LOO_{key}" for key in ("E1", "E2", "G1", "G2", "SIG")]
    + ["MODELSZ", "MODELSIG", "SIG_E1", "SIG_E2", "SIG_SIZE", "RES_E1", "RES_E2"]
)
_CCD_COLUMNS = {"CCD_E1": "MODEL_E1", "CCD_E2": "MODEL_E2", "CCD_SIZE": "MODELSZ"}
_CCD_COLUMNS |= {"CCD_G1": "MODEL_G1", "CCD_G2": "MODEL_G2", "CCD_SIG": "MODELSIG"}


@dataclass(frozen=True)
class Stars:
    """Positions and shapes, one array element a star.

    e and size are those of moments under a round weight (:func:`~.measure_shapes`), g and sigma those of adaptive
    ones (:func:`~.adaptive_moments`), as DES, HSC and Rubin have them. ``ra``, ``dec`` and those that end in ``_sky``
    are None without a pointing; the latter are along the axes of the sky, as :func:`~pachon.to_sky` has them.
    Where the model is one of the whole focal plane, ``ccd_`` has the ellipticity and size [rad] of the CCD's own model,
    and ``sigma_`` the uncertainty (standard deviation) that the focal-plane model predicts of its own; else all are
    None.
    """

    x: np.ndarray  #: detector position [m]
    y: np.ndarray
    field_x: np.ndarray  #: field angle [rad]
    field_y: np.ndarray
    e1: np.ndarray  #: measured ellipticity, NaN where flagged
    e2: np.ndarray
    size: np.ndarray  #: weighted rms size [rad]
    flags: np.ndarray  #: :class:`~.ShapeFlag` bits, int
    model_e1: np.ndarray  #: ellipticity of the model at the position of the star
    model_e2: np.ndarray
    model_size: np.ndarray  #: weighted rms size of the model there [rad]
    g1: np.ndarray  #: ellipticity of adaptive moments, NaN where flagged
    g2: np.ndarray
    sigma: np.ndarray  #: size of adaptive moments [rad]
    adaptive_flags: np.ndarray  #: :class:`~.MomentFlag` bits, int
    model_g1: np.ndarray  #: of the model at the position of the star
    model_g2: np.ndarray
    model_sigma: np.ndarray  #: [rad]
    ra: np.ndarray | None = field(default=None, kw_only=True)  #: right ascension and declination [rad]
    dec: np.ndarray | None = field(default=None, kw_only=True)
    e1_sky: np.ndarray | None = field(default=None, kw_only=True)
    e2_sky: np.ndarray | None = field(default=None, kw_only=True)
    g1_sky: np.ndarray | None = field(default=None, kw_only=True)
    g2_sky: np.ndarray | None = field(default=None, kw_only=True)
    ccd_e1: np.ndarray | None = field(default=None, kw_only=True)
    ccd_e2: np.ndarray | None = field(default=None, kw_only=True)
    ccd_size: np.ndarray | None = field(default=None, kw_only=True)
    ccd_g1: np.ndarray | None = field(default=None, kw_only=True)
    ccd_g2: np.ndarray | None = field(default=None, kw_only=True)
    ccd_sigma: np.ndarray | None = field(default=None, kw_only=True)
    sigma_e1: np.ndarray | None = field(default=None, kw_only=True)
    sigma_e2: np.ndarray | None = field(default=None, kw_only=True)
    sigma_size: np.ndarray | None = field(default=None, kw_only=True)

    @property
    def residual_e1(self) -> np.ndarray:
        """Measured minus model ellipticity, first component."""
        return self.e1 - self.model_e1

    @property
    def residual_e2(self) -> np.ndarray:
        """Measured minus model ellipticity, second component."""
        return self.e2 - self.model_e2

    def __len__(self) -> int:
        return len(self.x)


_StarsKind = TypeVar("_StarsKind", bound=Stars)


def of_ccd_model(stars: _StarsKind) -> _StarsKind:
    """Return stars with the CCD's own model in place of a focal-plane model.

    Ellipticities of the model fitted without the star stay those of the focal-plane model.
    """
    if stars.ccd_e1 is None or stars.ccd_e2 is None or stars.ccd_size is None:
        return stars
    assert stars.ccd_g1 is not None
    assert stars.ccd_g2 is not None
    assert stars.ccd_sigma is not None
    return replace(
        stars,
        model_e1=stars.ccd_e1,
        model_e2=stars.ccd_e2,
        model_size=stars.ccd_size,
        model_g1=stars.ccd_g1,
        model_g2=stars.ccd_g2,
        model_sigma=stars.ccd_sigma,
        ccd_e1=None,
        ccd_e2=None,
        ccd_size=None,
        ccd_g1=None,
        ccd_g2=None,
        ccd_sigma=None,
        sigma_e1=None,
        sigma_e2=None,
        sigma_size=None,
    )


@dataclass(frozen=True)
class HoldoutStars(Stars):
    """Noise-free PSFs at positions without an observed star."""

    fwhm: np.ndarray  #: full width at half maximum of the PSF, pixel included [rad]


@dataclass(frozen=True)
class ObservedStars(Stars):
    """Observed stars."""

    magnitude: np.ndarray  #: AB
    electrons: np.ndarray  #: in the exposure
    snr: np.ndarray  #: signal to noise of PSF photometry
    used: np.ndarray  #: bool: whether the model was fitted to the star
    #: :class:`~.StarFlag` bits of detected defects, such a star has no ellipticity; 0 without a search.
    defects: np.ndarray
    leave_one_out_e1: np.ndarray  #: of the model fitted without the star, at the star; NaN where it was not used
    leave_one_out_e2: np.ndarray
    leave_one_out_g1: np.ndarray
    leave_one_out_g2: np.ndarray
    leave_one_out_sigma: np.ndarray  #: [rad]
    #: Mean wavelength in the band [m], NaN where the spectrum is unknown; None where all are.
    colour: np.ndarray | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class CcdStars:
    """Stars of one CCD: their positions and shapes, without images and models of PSFs."""

    name: str
    center: tuple[float, float]  #: on the detector [m]
    holdout: HoldoutStars
    observed: ObservedStars
    rotator: float = field(default=0.0, kw_only=True)  #: of the camera, from +x towards +y of the telescope frame [rad]

    @property
    def has_focal_plane_model(self) -> bool:
        """Whether ellipticities and sizes of the model are those of a model of the whole focal plane."""
        return self.observed.ccd_e1 is not None

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of ellipticity: :data:`KINDS`, and :data:`CCD_KINDS` with a focal-plane model."""
        return KINDS + CCD_KINDS if self.has_focal_plane_model else KINDS

    def stars(self, kind: str) -> HoldoutStars | ObservedStars:
        """Return the stars that a kind of ellipticity belongs to; kinds are those of :meth:`ellipticity`."""
        if kind not in self.kinds:
            raise unknown_name("kind", kind, self.kinds)
        if kind in CCD_KINDS:
            return of_ccd_model(self.holdout) if kind == "away_ccd" else of_ccd_model(self.observed)
        return self.holdout if kind in ("truth", "away") else self.observed

    def sky_positions(self, kind: str) -> np.ndarray:
        """Return field angles along the axes of the detector [rad], [2, n], at the positions of :meth:`stars`.

        Ellipticities refer to these axes, so correlations need them.
        """
        stars = self.stars(kind)
        return to_detector_axes(np.stack([stars.field_x, stars.field_y]), self.rotator)

    def ellipticity(self, kind: str, moments: str = "e") -> tuple[np.ndarray, np.ndarray]:
        """Return both components of one kind, at the positions of :meth:`stars`.

        They are e1 and e2 of the weighted moments, or with ``moments="g"`` g1 and g2 of the adaptive ones.

        Kinds: of the noise-free PSFs (``truth``) and of the stars (``observed``); observed - model at the stars
        (``residual``) and with the model fitted without the star (``left_out``); truth - model at holdout positions
        (``away``); with a focal-plane model, ``residual_ccd`` and ``away_ccd`` of the CCD's own model. Another one
        raises UnknownNameError.
        """
        check_choice("moments", moments, MOMENTS)
        stars = self.stars(kind)
        first, second = (getattr(stars, f"{moments}{i}") for i in (1, 2))
        if kind in ("truth", "observed"):
            return first, second
        model = "leave_one_out" if kind == "left_out" else "model"
        return first - getattr(stars, f"{model}_{moments}1"), second - getattr(stars, f"{model}_{moments}2")

    def relative_size_residual(self, kind: str, moments: str = "e") -> np.ndarray:
        """Return (T - T of the model)/T, T = Q11 + Q22, of a kind of residual, at the positions of :meth:`stars`.

        Products hold no weighted size of the models fitted without a star: of ``left_out`` there are adaptive moments.
        """
        check_choice("moments", moments, MOMENTS)
        stars = self.stars(kind)
        model = "leave_one_out_" if kind == "left_out" else "model_"
        keys = ("sigma", "g1", "g2") if moments == "g" else ("size", "e1", "e2")
        trace, model_trace = (
            trace_of_moments(*(getattr(stars, f"{start}{key}") for key in keys)) for start in ("", model)
        )
        result: np.ndarray = 1.0 - model_trace / trace
        return result


@dataclass(frozen=True)
class CcdProduct(CcdStars):
    """Stars, stamps and PSF models of one CCD."""

    pixel_scale: float  #: angle of a stamp's pixel [rad]
    noise: tuple[float, float]  #: sky and rms noise without light [electrons/pixel]
    holdout_images: np.ndarray  #: float32 [n, ny, nx], centred, unit sum; empty if not read
    observed_images: np.ndarray  #: likewise, unit flux; NaN where a star could not be centred
    model: PsfModel  #: fitted to the observed stars
    noise_free_model: PsfModel  #: fitted to the noise-free PSFs

    @property
    def ccd_stars(self) -> CcdStars:
        """The stars alone, a hundredth of the memory."""
        return CcdStars(self.name, self.center, self.holdout, self.observed, rotator=self.rotator)


def to_detector_axes(field: np.ndarray, rotator: float) -> np.ndarray:
    """Return field angles [2, ...] [rad] along the axes of a detector that is rotated by an angle [rad]."""
    if rotator == 0.0:
        return field
    cosine, sine = math.cos(rotator), math.sin(rotator)
    return np.stack([cosine * field[0] + sine * field[1], cosine * field[1] - sine * field[0]])


def product_path(folder: Path, ccd: str, prefix: str = "") -> Path:
    """Return the path of the product of a CCD; its name may begin with that of a visit."""
    return folder / f"{prefix}ccd_{ccd}.fits"


def write_product(
    folder: Path, product: CcdProduct, stamp: Stamp, cards: list[tuple[str, Any, str]], prefix: str = ""
) -> None:
    """Write the product of one CCD; `cards` (keyword, value, comment) describe the run: telescope, band, exposure."""
    header = [
        ("CCD", product.name, "name of the CCD"),
        ("XCENTER", product.center[0] * 1e3, "[mm] centre of the CCD"),
        ("YCENTER", product.center[1] * 1e3, "[mm] centre of the CCD"),
        ("PIXSCALE", product.pixel_scale / ARCSEC, "[arcsec] pixel of the stamps"),
        ("SKY", product.noise[0], "[electron/pixel] expected sky"),
        ("NOISE", product.noise[1], "[electron/pixel] rms noise without light"),
        *cards,
    ]
    if product.rotator:
        header.append((_ROTATOR_CARD, math.degrees(product.rotator), "[deg] camera, +x towards +y of telescope"))
    hdus = [
        table_hdu("STARS", _stars_table(product.observed)),
        table_hdu("TRUTH", _stars_table(product.holdout)),
        image_hdu("STAMPS", product.observed_images, "each star centred, of unit flux"),
        image_hdu("TRUTH_PSF", product.holdout_images, "each PSF centred, of unit sum"),
        *product.model.to_hdus(_MODEL),
        *product.noise_free_model.to_hdus(_NOISE_FREE_MODEL),
    ]
    write_fits(product_path(folder, product.name, prefix), hdus, stamp, header)


def write_focal_plane_columns(folder: Path, product: CcdProduct) -> None:
    """Write the shapes of the focal-plane model into the tables of a product's file; all other bytes stay.

    The values of the CCD's own model are read from the file, so that a repetition changes nothing.
    """
    path = product_path(folder, product.name)
    hdus = read_fits(path)
    for name, stars in (("STARS", product.observed), ("TRUTH", product.holdout)):
        before, table = hdus[name], _stars_table(stars)
        column_names = before.columns.names
        for key, (_, unit, description) in table.items():
            source = key if key in column_names else _CCD_COLUMNS.get(key, key)
            if key not in _REPLACED:
                table[key] = (column(before, source), unit, description)
        hdus[name] = table_hdu(name, table)
    hdus[0].header[MODEL_CARD] = "focal_plane"
    write_hdus(path, hdus)


def read_product(path: Path, stamp: Stamp | None = None, *, holdout_images: bool = True) -> CcdProduct:
    """Read the product of one CCD; without `holdout_images`, its largest part, these are empty.

    A missing or damaged file, or one with another stamp than the one given, raises ProductError.
    """
    hdus = read_fits(path, stamp)
    header = hdus[0].header
    try:
        return CcdProduct(
            name=header["CCD"],
            center=(header["XCENTER"] * 1e-3, header["YCENTER"] * 1e-3),
            pixel_scale=header["PIXSCALE"] * ARCSEC,
            noise=(header["SKY"], header["NOISE"]),
            holdout=_stars_from_hdu(HoldoutStars, hdus["TRUTH"]),
            observed=_stars_from_hdu(ObservedStars, hdus["STARS"]),
            holdout_images=_image_from_hdu(hdus["TRUTH_PSF"])[: None if holdout_images else 0].copy(),
            observed_images=_image_from_hdu(hdus["STAMPS"]),
            model=PsfModel.from_hdus(hdus, _MODEL),
            noise_free_model=PsfModel.from_hdus(hdus, _NOISE_FREE_MODEL),
            rotator=math.radians(header.get(_ROTATOR_CARD, 0.0)),
        )
    except KeyError as error:
        raise ProductError(f"no product of a CCD ({' '.join(str(error).split())})", file=path) from None


def _image_from_hdu(hdu: fits.ImageHDU) -> np.ndarray:
    return np.asarray(hdu.data, dtype=np.float32)


def _stars_table(stars: Stars) -> dict[str, tuple[np.ndarray, str, str]]:
    table = {}
    for key, (name, unit, description) in _COLUMNS.items():
        values = getattr(stars, key, None)
        if values is None:
            continue
        table[name] = (values / unit.size if values.dtype.kind == "f" else values, unit.name, description)
    table["RES_E1"] = (stars.residual_e1, "", "measured minus model")
    table["RES_E2"] = (stars.residual_e2, "", "measured minus model")
    return table


def _stars_from_hdu(kind: type[_StarsKind], hdu: fits.BinTableHDU) -> _StarsKind:
    values = {}
    for attribute in fields(kind):
        name, unit, _ = _COLUMNS[attribute.name]
        if attribute.default is None and name not in hdu.columns.names:
            continue
        data = column(hdu, name)
        values[attribute.name] = data * unit.size if data.dtype.kind == "f" else data
    return kind(**values)
