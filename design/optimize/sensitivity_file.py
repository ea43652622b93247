"""Files of sensitivity matrices: FITS or ECSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits

from ...core.errors import ConfigError
from ...core.products import card_text, table_hdu, write_ecsv, write_fits
from ...core.version import CREATOR, VERSION
from .sensitivity import Sensitivity


def write_sensitivity(path: Path, result: Sensitivity) -> None:
    """Write a sensitivity matrix, in the format of the suffix.

    ``.fits``: images MATRIX [field, zernike, parameter] and ZERNIKES [field, zernike], tables FIELDS and PARAMETERS.
    ``.ecsv``: a row for each field point and Zernike term, a column for each parameter.
    """
    x, y = np.rad2deg(result.fields.T)
    names, units = result.parameters.names, ["" if unit == "1" else unit for unit in result.parameters.units]
    if path.suffix == ".ecsv":
        n_field, n_zernike, _ = result.matrix.shape
        places = [np.repeat(v, n_zernike) for v in (x, y)]
        columns = {
            "field_x": (places[0], "deg", "field angle"),
            "field_y": (places[1], "deg", "field angle"),
            "noll": (np.tile(np.arange(1, n_zernike + 1), n_field), "", "Noll index of the annular Zernike term"),
            "zernike": (result.zernikes.ravel(), "m", "the term of the telescope as it is"),
        }
        for i, (name, unit) in enumerate(zip(names, units, strict=True)):
            columns[name] = (result.matrix[:, :, i].ravel(), _metres_per(unit), "derivative of the term")
        meta = {
            "creator": f"pachon {VERSION}",
            "telescope": result.telescope,
            "wavelength_m": result.wavelength,
            "obscuration": result.obscuration,
        }
        write_ecsv(path, columns, meta)
        return
    if path.suffix != ".fits":
        raise ConfigError(f"--out {path}: expected a name that ends in .fits or .ecsv")
    fields = {"X": (x, "deg", "field angle"), "Y": (y, "deg", "field angle")}
    addresses = [card_text(name) for name in names]
    listed = fits.BinTableHDU.from_columns(
        [
            fits.Column(name="ADDRESS", array=addresses, format=f"{max(map(len, addresses))}A"),
            fits.Column(name="UNIT", array=units, format="8A"),
        ],
        name="PARAMETERS",
    )
    matrix = fits.ImageHDU(result.matrix, name="MATRIX")
    matrix.header["COMMENT"] = "derivatives of annular Zernike terms [m per unit]: parameter fastest, then Noll, field"
    zernikes = fits.ImageHDU(result.zernikes, name="ZERNIKES")
    zernikes.header["BUNIT"] = "m"
    cards = [
        CREATOR,
        ("TELESCOP", result.telescope, "model"),
        ("WAVELEN", result.wavelength, "[m] vacuum wavelength"),
        ("OBSCURAT", result.obscuration, "inner over outer radius of the annulus"),
    ]
    write_fits(path, [matrix, zernikes, table_hdu("FIELDS", fields), listed], None, cards)


def _metres_per(unit: str) -> str:
    """Return metres per unit of a parameter, in the spelling of astropy."""
    spellings = {"": "m", "m": "", "rad": "m / rad", "1/m": "m2"}
    if unit.startswith("m^"):
        return f"m{1 - int(unit.removeprefix('m^'))}"
    return spellings.get(unit, f"m / {unit}")
