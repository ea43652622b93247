"""PSF models as FITS extensions, lossless."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from astropy.io import fits

from ...core.errors import ProductError
from .basis import BASES, identity


def model_hdus(fields: Mapping[str, Any], name: str) -> list[fits.ImageHDU | fits.BinTableHDU]:
    """Return the fields of a model as extensions NAME_MEAN and so on.

    Fields that polynomials of principal components lack are written only for other models: header cards BASIS and
    SCALE, the star's weight and alpha (column ``pull``), and NAME_KERNEL.
    """
    mean = fits.ImageHDU(fields["mean"], name=f"{name}_MEAN")
    mean.header["ORDER"] = (fields["order"], "total degree of the polynomials")
    k = len(fields["components"])
    stars = [
        fits.Column("position", "2D", array=fields["positions"]),
        fits.Column("coefficient", f"{k}D", array=fields["coefficients"]),
        fits.Column("unexplained", "D", array=fields["unexplained"]),
        fits.Column("rejected", "K", array=fields["rejected"]),
    ]
    more = []
    if fields["basis"] != "pca":
        mean.header["BASIS"] = (fields["basis"], "kind of the components")
    if np.isfinite(fields["scale"]):
        mean.header["SCALE"] = (fields["scale"], "[pixel] rms width of the shapelets' Gaussian")
    if fields["weights"] is not None:
        stars.append(fits.Column("weight", "D", array=fields["weights"]))
    if fields["kernel"] is not None:
        stars.append(fits.Column("pull", f"{k}D", array=fields["alpha"]))
        more.append(fits.ImageHDU(fields["kernel"], name=f"{name}_KERNEL"))
    # The pixels' own components are unit vectors: thirty times the size of all else, and known.
    components = [] if fields["basis"] == "pixels" else [fits.ImageHDU(fields["components"], name=f"{name}_EIGEN")]
    return [
        mean,
        *components,
        fits.ImageHDU(fields["polynomial"], name=f"{name}_POLY"),
        fits.ImageHDU(np.array(fields["extent"]), name=f"{name}_EXTENT"),
        fits.BinTableHDU.from_columns(
            [fits.Column("eigenvalue", "D", array=fields["eigenvalues"])], name=f"{name}_SPECTRUM"
        ),
        fits.BinTableHDU.from_columns(stars, name=f"{name}_STARS"),
        *more,
    ]


def model_fields(hdus: Iterable[Any], name: str) -> dict[str, Any]:
    """Return the fields of a model from extensions of :func:`model_hdus`; ProductError if parts are missing."""
    found = {hdu.name: hdu for hdu in hdus}

    def part(key: str) -> Any:
        return found[f"{name}_{key}".upper()]

    try:
        mean, stars = part("MEAN"), part("STARS").data
        basis = mean.header.get("BASIS", "pca")
        if basis not in BASES:
            raise ProductError(f"PSF model {name!r}: BASIS = {basis!r}, expected one of {', '.join(BASES)}")
        polynomial, image = _native_float64(part("POLY").data), _native_float64(mean.data)
        if basis == "pixels":
            components = identity(image.size).reshape(image.size, *image.shape)
        else:
            components = _native_float64(part("EIGEN").data)
        k = len(components)
        extent = tuple(float(v) for v in part("EXTENT").data)
        kernel = found.get(f"{name}_KERNEL".upper())
        columns = part("STARS").columns.names
        fields = {
            "mean": image,
            "components": components,
            "coefficients": _native_float64(stars["coefficient"]).reshape(len(stars), -1),
            "polynomial": polynomial,
            "eigenvalues": _native_float64(part("SPECTRUM").data["eigenvalue"]),
            "positions": _native_float64(stars["position"]),
            "order": int(mean.header["ORDER"]),
            "extent": extent,
            "unexplained": _native_float64(stars["unexplained"]),
            "rejected": np.asarray(stars["rejected"], dtype=np.int64),
            "basis": basis,
            "scale": float(mean.header.get("SCALE", np.nan)),
            "weights": _native_float64(stars["weight"]) if "weight" in columns else None,
            "kernel": _native_float64(kernel.data) if kernel is not None else None,
            "alpha": _native_float64(stars["pull"]).reshape(len(stars), -1) if kernel is not None else None,
        }
    except KeyError as error:
        raise ProductError(f"no PSF model {name!r} in the FITS file: {error.args[0]} is missing") from error
    if components.shape[1:] != image.shape or polynomial.shape[1:] != (k,) or fields["coefficients"].shape[1] != k:
        raise ProductError(f"PSF model {name!r}: mean, components and polynomials have shapes that do not fit together")
    return fields


def _native_float64(array: Any) -> np.ndarray:
    """Return FITS numbers as float64 in the machine's own byte order."""
    return np.asarray(array, dtype=np.float64).copy()
