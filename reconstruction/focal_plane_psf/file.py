"""Focal-plane PSF models as FITS extensions, telescope and camera included."""

from __future__ import annotations

import json
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
from astropy.io import fits

from ...core.ccd_names import NAMES_VERSION, refuse_mirrored_names
from ...core.errors import ProductError, UnknownNameError
from ...models.camera.camera import Camera
from ...models.camera.ccd_surfaces import CcdSurfaces
from ...models.camera.focal_plane import FocalPlane
from ...models.camera.silicon import Silicon
from ...models.io.yaml.reader import read_telescope
from ...models.io.yaml.writer import telescope_to_yaml
from ...models.telescope import Telescope
from ...wavefront.aberration import ResidualWavefront
from ...wavefront.atmosphere.atmosphere import Atmosphere
from ...wavefront.atmosphere.moment_covariance import ExposedAir
from ...wavefront.atmosphere.polar_lags import PolarLags
from ...wavefront.psf.light import Light
from ...wavefront.psf.stamps import Stamps
from .covariance import Covariance, Places
from .field import ShapeField
from .fit import ShapeData
from .heights import HeightPrior
from .images import ResidualImages
from .layer_covariance import LayerCovariance
from .mosaic import Mosaic, PsfShapes
from .optics_part import OpticsPart
from .response import ExposureResponse, Instrument

#: Primary header and that of the first extension [bytes], two blocks of FITS each at most.
_BEGINNING = 4 * 2880

_Model = TypeVar("_Model", bound="ModelFields")


@dataclass(frozen=True, eq=False, repr=False)
class ModelFields:
    """Attributes of :class:`~pachon.FocalPlanePsf`, which describes them."""

    field: ShapeField
    used: np.ndarray
    leave_one_out: PsfShapes
    chi2: dict[str, float]
    evidence: float
    warnings: tuple[str, ...]
    weight_fwhm: float
    pixel_scale: float | None
    stamp_size: int
    mean_star: np.ndarray | None = None
    pca: ResidualImages | None = None


def model_hdus(model: ModelFields) -> list[fits.ImageHDU | fits.BinTableHDU]:
    """Return a focal-plane model as FITS extensions."""
    field = model.field
    mosaic, data = field.mosaic, field.data
    about: dict[str, Any] = {
        "chi2": model.chi2,
        "evidence": model.evidence if np.isfinite(model.evidence) else None,
        "warnings": list(model.warnings),
        "weight_fwhm": model.weight_fwhm,
        "pixel_scale": model.pixel_scale,
        "stamp_size": model.stamp_size,
        "half_size": mosaic.half_size,
        "ccds": list(mosaic.names),
    }
    camera: Camera | None = mosaic.camera
    if camera is not None:
        about["camera"] = {
            "name": camera.name,
            "names_version": NAMES_VERSION,
            "rafts": list(camera.raft_names),
            "raft_index": camera.raft_index.tolist(),
            "pixels": int(camera.pixels[0, 0]) if camera.alike else camera.pixels.tolist(),
            "pixel_size": camera.pixel_size,
            "transposed": camera.transposed,
        }
        if not camera.alike:
            about["camera"]["rotation_deg"] = camera.rotation_deg.tolist()
    predicted = model.leave_one_out
    hdus = [
        _image_hdu("CENTERS", mosaic.centers),
        _image_hdu("POSITION", data.places.xy),
        _image_hdu("STAR_CCD", data.places.ccd),
        _image_hdu("SHAPE", data.values),
        _image_hdu("NOISE", data.noise),
        _image_hdu("RESIDUAL", field.residuals),
        *_covariance_hdus(field.covariances),
        _image_hdu("USED", model.used.astype(np.int16)),
        _image_hdu("LEFT_OUT", np.stack([predicted.e1, predicted.e2, predicted.size], axis=1)),
    ]
    if data.places.amplitude is not None:
        hdus.append(_image_hdu("AMPLITUDE", data.places.amplitude, "of turbulence, over the mean over the field"))
    if model.mean_star is not None:
        hdus.append(_image_hdu("MEAN", model.mean_star))
    if model.pca is not None:
        pca = model.pca
        hdus += [
            _image_hdu("PCA", pca.components),
            _image_hdu("PCA_POSITION", pca.places.xy),
            _image_hdu("PCA_CCD", pca.places.ccd),
            _image_hdu("PCA_COEFFICIENT", pca.coefficients),
            _image_hdu("PCA_NOISE", pca.noise),
            _image_hdu("PCA_COVARIANCE", np.stack([_covariance_row(c) for c in pca.covariances])),
        ]
    if field.optics is not None and field.design is not None:
        optics = field.optics
        instrument, air = optics.instrument, optics.instrument.atmosphere
        about["telescope"] = telescope_to_yaml(instrument.telescope)
        about["seeing"] = optics.seeing
        about["degree"] = optics.prior.degree
        about["atmosphere"] = {"r0": air.r0, "outer_scale": air.outer_scale}
        about["instrument"] = {k: getattr(instrument.stamps, k) for k in ("pixel_size", "diffusion", "jitter")}
        if instrument.stamps.silicon is not None:
            about["silicon"] = asdict(instrument.stamps.silicon)
        about["radius"], about["center"] = optics.response.radius, optics.response.center
        surfaces = optics.plane.surfaces
        hdus += [
            _image_hdu("WAVELENGTHS", instrument.wavelengths),
            _image_hdu("HEIGHT_CUBIC", surfaces.polynomial),
            _image_hdu(
                "WAVEFRONT", np.column_stack([optics.aberration.coefficients, optics.aberration.field_gradient])
            ),
            _image_hdu("PARAMETER_COVARIANCE", optics.covariance),
            _image_hdu("RESPONSE", optics.response.polynomial),
            _image_hdu("DESIGN", field.design),
        ]
        if surfaces.grid is not None:
            hdus.append(_image_hdu("HEIGHT_SPLINE", surfaces.grid))
        for name, values in (("DISPERSION", instrument.light.dispersion), ("WEIGHTS", instrument.light.weights)):
            if values is not None:
                hdus.append(_image_hdu(name, np.asarray(values)))
    text = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
    return [_image_hdu("ABOUT", text, "JSON, one character of UTF-8 a pixel"), *hdus]


def is_model(path: Path) -> bool:
    """Return whether a file begins like a focal-plane model."""
    try:
        with path.open("rb") as file:
            return b"EXTNAME = 'ABOUT" in file.read(_BEGINNING)
    except OSError:
        return False


def read_model(kind: type[_Model], hdus: Iterable[fits.ImageHDU], path: Path) -> _Model:
    """Return a model of a class from the extensions of :func:`model_hdus`; ProductError where they are missing."""
    extensions = {hdu.name: hdu.data for hdu in hdus}

    def part(name: str) -> np.ndarray:
        values = np.asarray(extensions[name])
        return values.astype(values.dtype.newbyteorder("="))

    try:
        about = json.loads(bytes(part("ABOUT")))
        camera = None
        if "camera" in about:
            described = about["camera"]
            refuse_mirrored_names(about["ccds"], described.get("names_version"), path)
            camera = Camera(
                described["name"],
                tuple(about["ccds"]),
                tuple(described["rafts"]),
                np.array(described["raft_index"]),
                part("CENTERS"),
                np.broadcast_to(described["pixels"], (len(about["ccds"]), 2)).copy(),
                described["pixel_size"],
                rotation_deg=np.array(described.get("rotation_deg", [0.0])),
                transposed=described.get("transposed", False),
            )
        mosaic = Mosaic(tuple(about["ccds"]), part("CENTERS"), about["half_size"], camera)
        places = _places_of(mosaic, part("POSITION"), part("STAR_CCD"))
        if "AMPLITUDE" in extensions:
            places = replace(places, amplitude=part("AMPLITUDE"))
        pca = None
        if "PCA" in extensions:
            pca = ResidualImages(
                mosaic,
                part("PCA"),
                _places_of(mosaic, part("PCA_POSITION"), part("PCA_CCD")),
                part("PCA_COEFFICIENT"),
                part("PCA_NOISE"),
                tuple(_covariance_from_row(row) for row in part("PCA_COVARIANCE")),
            )
        optics = None
        if "telescope" in about and camera is not None:
            optics = _optics_part(about, part, frozenset(extensions), camera)
        return kind(
            field=ShapeField(
                mosaic,
                ShapeData(places, part("SHAPE"), part("NOISE")),
                part("RESIDUAL"),
                _covariances_of(part, extensions),
                optics,
                part("DESIGN") if optics is not None else None,
            ),
            used=part("USED").astype(bool),
            leave_one_out=PsfShapes(*part("LEFT_OUT").T),
            chi2=about["chi2"],
            evidence=np.nan if about["evidence"] is None else about["evidence"],
            warnings=tuple(about["warnings"]),
            weight_fwhm=about["weight_fwhm"],
            pixel_scale=about["pixel_scale"],
            stamp_size=about["stamp_size"],
            mean_star=part("MEAN") if "MEAN" in extensions else None,
            pca=pca,
        )
    except UnknownNameError:
        raise
    except KeyError as error:
        raise ProductError(f"no focal-plane PSF model ({error.args[0]} is missing)", file=path) from None


def _optics_part(
    about: Mapping[str, Any], part: Callable[[str], np.ndarray], names: frozenset[str], camera: Camera
) -> OpticsPart:
    instrument = Instrument.of(
        _telescope_from_text(about["telescope"]),
        Light(part("WAVELENGTHS"), *(part(name) if name in names else None for name in ("WEIGHTS", "DISPERSION"))),
        Atmosphere.from_site("cerro_pachon", seed=0, **about["atmosphere"]),
        stamps=Stamps(
            about["stamp_size"],
            **about["instrument"],
            silicon=Silicon(**about["silicon"]) if "silicon" in about else None,
        ),
        weight_fwhm=about["weight_fwhm"],
    )
    cubic = part("HEIGHT_CUBIC")
    grid = part("HEIGHT_SPLINE") if "HEIGHT_SPLINE" in names else None
    surfaces = CcdSurfaces(camera.half_sizes, cubic, np.zeros((len(cubic), 2, 4)), grid)
    wavefront, telescope = part("WAVEFRONT"), instrument.telescope
    return OpticsPart(
        instrument,
        FocalPlane(camera, surfaces, np.ones(len(camera), dtype=bool)),
        ResidualWavefront(
            wavefront[:, 0], telescope.pupil_diameter, telescope.pupil_obscuration, wavefront[:, 1:].copy()
        ),
        about["seeing"],
        HeightPrior.uninformative(camera, degree=about["degree"]),
        part("PARAMETER_COVARIANCE"),
        ExposureResponse(part("RESPONSE"), about["radius"], about["center"]),
    )


def _telescope_from_text(text: str) -> Telescope:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "telescope.yaml"
        path.write_text(text, encoding="utf-8")
        return read_telescope(path)


def _places_of(mosaic: Mosaic, xy: np.ndarray, ccd: np.ndarray) -> Places:
    return mosaic.at(xy, ccd.astype(np.int64))


def _covariance_hdus(covariances: Sequence[Covariance | LayerCovariance]) -> list[fits.ImageHDU]:
    """Return the covariances of the shapes: a row of each, or layers and a table of all three."""
    layered = covariances[0]
    if not isinstance(layered, LayerCovariance):
        rows = [_covariance_row(c) for c in covariances if isinstance(c, Covariance)]
        return [_image_hdu("COVARIANCE", np.stack(rows))]
    air = layered.air
    layers = np.column_stack([air.altitudes, air.weights, air.velocities])
    numbers = [air.exposure, air.r0, air.outer_scale, air.cutoff, air.diameter, air.obscuration]
    return [
        _image_hdu("LAYERS", layers, "altitude [m], weight, wind along x and y of the sky [m/s]"),
        _image_hdu("AIR", np.array(numbers), "exposure [s], r0 [m], L0 [m], cut-off [rad/m], pupil [m], obscuration"),
        _image_hdu("LAYER_COVARIANCE", layered.table, "of e1, e2, ln size: 11, 22, 33, 12, 13, 23"),
        _image_hdu("LAGS", np.array([layered.lags.unit, layered.lags.step]), "first scale [rad] and step of rings"),
        _image_hdu("TO_SKY", layered.to_sky, "[1/m] field slopes by positions on the detector"),
        _image_hdu("STAR_VARIANCE", np.stack([layered.constant, layered.nugget]), "common to all, and of each"),
    ]


def _covariances_of(
    part: Callable[[str], np.ndarray], names: Container[str]
) -> tuple[Covariance | LayerCovariance, ...]:
    if "LAYERS" not in names:
        return tuple(_covariance_from_row(row) for row in part("COVARIANCE"))
    layers, table = part("LAYERS"), part("LAYER_COVARIANCE")
    air = ExposedAir(
        tuple(layers[:, 0].tolist()),
        tuple(layers[:, 1].tolist()),
        tuple((x, y) for x, y in layers[:, 2:].tolist()),
        *part("AIR").tolist(),
    )
    unit, step = part("LAGS").tolist()
    lags = PolarLags(unit, step, *table.shape[:2])
    return (LayerCovariance(air, part("TO_SKY"), lags, table, *part("STAR_VARIANCE")),)


def _covariance_row(covariance: Covariance) -> np.ndarray:
    parts = [[covariance.constant], covariance.amplitude, covariance.matrix.ravel(), covariance.ccd]
    return np.concatenate([*parts, [covariance.nugget]])


def _covariance_from_row(row: np.ndarray) -> Covariance:
    n = (len(row) - 5) // 5
    matrix = row[1 + n : 1 + 5 * n].reshape(n, 2, 2)
    return Covariance(float(row[0]), row[1 : 1 + n], matrix, row[1 + 5 * n : 4 + 5 * n], float(row[-1]))


def _image_hdu(name: str, values: np.ndarray, comment: str | None = None) -> fits.ImageHDU:
    hdu = fits.ImageHDU(np.ascontiguousarray(values), name=name)
    if comment:
        hdu.header["COMMENT"] = comment
    return hdu
