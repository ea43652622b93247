"""PSF models as FITS extensions, lossless."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
from astropy.io import fits

from ...core.errors import ProductError
from .file_parts import ModelParts
from .fit import ModelFit
from .recipe import BASES, FITTED_INTERPOLATIONS

# Images before the tables; others follow these.
_FIRST_IMAGES = ("EIGEN", "POLY")


_Model = TypeVar("_Model", bound=ModelFit)


def model_hdus(model: ModelFit, name: str) -> list[fits.ImageHDU | fits.BinTableHDU]:
    """Return a model as extensions NAME_MEAN and so on, those of its basis and its interpolation among them."""
    basis, interpolation = model.basis.parts(), model.interpolation.parts()
    images = {**basis.images, **interpolation.images}
    mean = fits.ImageHDU(images.pop("MEAN"), name=f"{name}_MEAN")
    for keyword, card in (interpolation.cards | basis.cards).items():
        mean.header[keyword] = card
    columns = {
        "position": model.interpolation.positions,
        "coefficient": model.coefficients,
        "unexplained": model.unexplained,
        "rejected": model.rejected,
        **interpolation.columns,
    }
    return [
        mean,
        *(fits.ImageHDU(images.pop(ending), name=f"{name}_{ending}") for ending in _FIRST_IMAGES if ending in images),
        fits.ImageHDU(np.array(model.interpolation.extent), name=f"{name}_EXTENT"),
        _table({"eigenvalue": model.basis.eigenvalues}, f"{name}_SPECTRUM"),
        _table(columns, f"{name}_STARS"),
        *(fits.ImageHDU(image, name=f"{name}_{ending}") for ending, image in images.items()),
    ]


def _table(columns: dict[str, np.ndarray], name: str) -> fits.BinTableHDU:
    """Return columns [n] or [n, k] of numbers as a table."""
    formats = {key: ("K" if values.dtype.kind == "i" else "D", values.shape[1:]) for key, values in columns.items()}
    return fits.BinTableHDU.from_columns(
        [
            fits.Column(key, f"{shape[0] if shape else ''}{code}", array=columns[key])
            for key, (code, shape) in formats.items()
        ],
        name=name,
    )


def read_model(model_class: type[_Model], hdus: Iterable[Any], name: str) -> _Model:
    """Return a model of a class from extensions of :func:`model_hdus`; ProductError if parts are missing."""
    start = f"{name}_".upper()
    extensions = {hdu.name.removeprefix(start): hdu for hdu in hdus if hdu.name.startswith(start)}

    def extension(ending: str) -> Any:
        if ending not in extensions:
            raise KeyError(f"{start}{ending}")
        return extensions[ending]

    try:
        stars = extension("STARS")
        parts = ModelParts(
            dict(extension("MEAN").header),
            {ending: _native_float64(hdu.data) for ending, hdu in extensions.items() if hdu.is_image},
            {column: _native_float64(stars.data[column]) for column in stars.columns.names},
            _native_float64(extension("SPECTRUM").data["eigenvalue"]),
            tuple(float(v) for v in extension("EXTENT").data),  # type: ignore[arg-type]
            name,
        )
        kind = parts.cards.get("BASIS", "pca")
        if kind not in BASES:
            raise ProductError(f"PSF model {name!r}: BASIS = {kind!r}, expected one of {', '.join(BASES)}")
        basis = BASES[kind].fitted.of_parts(parts)
        fitted = next((fitted for fitted in FITTED_INTERPOLATIONS if fitted.reads(parts)), None)
        if fitted is None:
            raise ProductError(f"PSF model {name!r}: INTERP = {parts.cards.get('INTERP')!r}, which is none of pachon's")
        interpolation = fitted.of_parts(parts)
        model = model_class(
            basis,
            interpolation,
            parts.columns["coefficient"].reshape(len(stars.data), -1),
            parts.columns["unexplained"],
            parts.columns["rejected"].astype(np.int64),
        )
    except KeyError as error:
        raise ProductError(f"no PSF model {name!r} in the FITS file: {error.args[0]} is missing") from error
    k = len(basis.components)
    if (
        basis.components.shape[1:] != basis.mean.shape
        or interpolation.polynomial.shape[1:] != (k,)
        or model.coefficients.shape[1] != k
        or (interpolation.colour is not None and interpolation.colour.slope.shape[1:] != (k,))
    ):
        raise ProductError(f"PSF model {name!r}: mean, components and polynomials have shapes that do not fit together")
    return model


def _native_float64(array: Any) -> np.ndarray:
    """Return FITS numbers as float64 in the machine's own byte order."""
    return np.asarray(array, dtype=np.float64).copy()
