"""Galaxies of imSim's sources: skyCatalogs' tables of HEALPix pixels, and instance catalogues.

Both have ellipticities and shears as GalSim has them, e2 > 0 from north-west to south-east, and half-light radii
sqrt(a b). Lensing is GalSim's: a reduced shear gamma/(1 - kappa), and radii larger by the root of the magnification.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import DomainError, ProductError, error_context
from ..core.files import parsing, read_bytes
from ..core.fits_files import unpacked_bytes
from ..core.table_files import read_columns
from ..core.units import ARCSEC
from ..models.camera.photometry import BANDS, LSST
from .galaxies import Galaxies
from .pointing import tangent_plane
from .sersic import GREATEST_INDEX, LEAST_INDEX
from .sky_shapes import along_tangent_plane

#: Columns by which a table is known as one of skyCatalogs.
SIGN_OF_SKY_CATALOGUE = frozenset({"shear_1", "size_disk_true", "size_minor_disk_true"})
#: Components of skyCatalogs' galaxies; knots have the place of their disk.
_COMPONENTS = ("bulge", "disk")
#: Kinds of objects with a profile; knots are drawn as the exponential disc that they fill.
_PROFILES = ("sersic2d", "knots")
#: Place of the words of an object in a line of an instance catalogue.
_LEAST_WORDS = 17
# Magnitude from which objects are invalid, as imSim has it.
_INVALID = 50.0
# Area over which SMTN-002 has the zero points of bands [cm^2].
_AREA_CM2 = LSST.area * 1e4


def is_instance_catalogue(path: Path) -> bool:
    """Return whether there is a file named as an instance catalogue is: text, which may be compressed."""
    return path.is_file() and (path.suffixes[-2:] == [".txt", ".gz"] or path.suffix.lower() == ".txt")


def galaxies_of_sky_catalogue(columns: Mapping[str, Any], path: Path, pointing: Any, band: str) -> Galaxies:
    """Return the galaxies of a table of skyCatalogs, with the fluxes of the file beside it.

    Ellipticities have the sign that skyCatalogs gives those of cosmoDC2: it turns them by 90 degrees. The part of the
    bulge is that of its spectrum, summed over all wavelengths.

    Raises
    ------
    ProductError
        If there are no fluxes, or a column is missing.
    DomainError
        If a value is none of a galaxy, or there is no pointing.
    """
    number = {name: _numbers(columns, name) for name in ("ra", "dec", "shear_1", "shear_2", "convergence")}
    ra, dec = np.deg2rad(number["ra"]), np.deg2rad(number["dec"])
    flux = _fluxes(columns, path, band)
    rows = np.flatnonzero(flux > 0.0)
    bulge = _bulge_fraction(columns, len(flux))
    xi, eta = tangent_plane(ra[rows], dec[rows], pointing)
    shear = number["shear_1"] + 1j * number["shear_2"], number["convergence"]
    parts: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    for name in _COMPONENTS:
        if f"size_{name}_true" not in columns:
            continue
        radius = np.sqrt(_numbers(columns, f"size_{name}_true") * _numbers(columns, f"size_minor_{name}_true"))
        ellipticity = -_numbers(columns, f"ellipticity_1_{name}_true") - 1j * _numbers(
            columns, f"ellipticity_2_{name}_true"
        )
        parts[name] = (*_lensed(radius * ARCSEC, ellipticity, *shear), _numbers(columns, f"sersic_{name}"))
    fractions = {"bulge": bulge, "disk": 1.0 - bulge} if "bulge" in parts else {"disk": np.ones(len(flux))}
    per_galaxy: list[list[float]] = []
    first = [0]
    radii = []
    for row in rows:
        whole = 0.0
        for name, (radius, e, sersic) in parts.items():
            fraction = float(fractions[name][row])
            if fraction > 0.0:
                # Ours has e2 > 0 along xi = eta, GalSim's across it.
                index = float(np.clip(sersic[row], LEAST_INDEX, GREATEST_INDEX))
                per_galaxy.append([fraction, float(radius[row]), e[row].real, -e[row].imag, index])
                whole += fraction * float(radius[row])
        first.append(len(per_galaxy))
        radii.append(whole)
    table = np.array(per_galaxy).reshape(-1, 5)
    zero, owner = np.zeros(len(table)), np.repeat(rows, np.diff(first))
    e1, e2 = along_tangent_plane(table[:, 2], table[:, 3], ra[owner], dec[owner], pointing)
    # Photons a second and square centimetre through the whole system (SMTN-002).
    magnitude = BANDS[band].zero_point - 2.5 * np.log10(_AREA_CM2 * flux[rows])
    return Galaxies(
        xi=xi,
        eta=eta,
        magnitude=magnitude,
        radius=np.array(radii),
        first=np.array(first),
        dx=zero,
        dy=zero,
        fraction=table[:, 0],
        component_radius=table[:, 1],
        e1=e1,
        e2=e2,
        sersic=table[:, 4],
    )


def galaxies_of_instance_catalogue(path: Path, pointing: Any) -> Galaxies:
    """Return the galaxies of an instance catalogue and of those that it includes; stars are left out.

    Magnitudes are those of the catalogue, AB at 500 nm, as of flat spectra. As in imSim, which sets the flux of an
    object after it is lensed, they are not magnified. Each component is a galaxy by itself.

    Raises
    ------
    ProductError
        If a file cannot be read, or a line is no object.
    DomainError
        If there is no galaxy, or no pointing.
    """
    rows = []
    for file, number, words in _object_lines(path, frozenset()):
        if len(words) <= 12 or words[12].lower() not in _PROFILES:
            continue
        with error_context(file=file, place=f"line {number}"):
            try:
                values = [float(word) for word in (*words[2:5], *words[7:10], *words[13:_LEAST_WORDS])]
            except ValueError:
                raise ProductError("expected numbers, as of an object of an instance catalogue") from None
            if len(values) != 10:
                raise ProductError(f"{len(words)} words: expected at least {_LEAST_WORDS} of a galaxy")
        if values[2] < _INVALID and values[6] >= values[7] > 0.0:
            rows.append([*values, words[12].lower() == "knots"])
    if not rows:
        raise DomainError("no galaxy: expected objects such as sersic2d", file=path)
    ra, dec, magnitude, gamma1, gamma2, kappa, a, b, angle, index, knots = np.array(rows).T
    ratio = b / a
    # imSim: beta = 90 deg - PA, from GalSim's x, which points west.
    ellipticity = (1.0 - ratio) / (1.0 + ratio) * np.exp(2j * (0.5 * np.pi - np.deg2rad(angle)))
    # phosim's shear has the other sign of gamma2.
    radius, e = _lensed(np.sqrt(a * b) * ARCSEC, ellipticity, gamma1 - 1j * gamma2, kappa)
    ra, dec = np.deg2rad(ra), np.deg2rad(dec)
    xi, eta = tangent_plane(ra, dec, pointing)
    e1, e2 = along_tangent_plane(e.real, -e.imag, ra, dec, pointing)
    sersic = np.where(knots > 0.0, 1.0, np.clip(index, LEAST_INDEX, GREATEST_INDEX))
    return Galaxies.single(xi, eta, magnitude, radius, e1=e1, e2=e2, sersic=sersic)


def _lensed(
    radius: np.ndarray, ellipticity: np.ndarray, gamma: np.ndarray, kappa: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return radii [rad] and ellipticities under a shear and a convergence."""
    g = gamma / (1.0 - kappa)
    return radius * np.sqrt(_magnification(gamma, kappa)), (ellipticity + g) / (1.0 + np.conj(g) * ellipticity)


def _magnification(gamma: np.ndarray, kappa: np.ndarray) -> np.ndarray:
    return np.asarray(1.0 / ((1.0 - kappa) ** 2 - np.abs(gamma) ** 2))


def _numbers(columns: Mapping[str, Any], name: str) -> np.ndarray:
    """Return a column as finite numbers."""
    if name not in columns:
        raise ProductError(f"no column {name!r}; columns are {', '.join(columns)}", key=name)
    try:
        values = np.asarray(columns[name], dtype=np.float64)
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    if values.ndim != 1 or not np.isfinite(values).all():
        raise DomainError(f"column {name!r}: expected a finite number in every row", key=name)
    return values


def _fluxes(columns: Mapping[str, Any], path: Path, band: str) -> np.ndarray:
    """Return the fluxes in a band [photons/s/cm^2], of the table or of the file of fluxes beside it."""
    name = f"lsst_flux_{band}"
    if name in columns:
        return _numbers(columns, name)
    beside = path.with_name(path.name.replace("galaxy_", "galaxy_flux_", 1))
    if beside == path or not beside.is_file():
        raise ProductError(f"no column {name!r}, and no file {beside.name} beside it with fluxes", key=name)
    flux_columns = read_columns(beside)
    with error_context(file=beside):
        flux = _numbers(flux_columns, name)
        flux_ids, ids = (np.asarray(table.get("galaxy_id", np.zeros(0))) for table in (flux_columns, columns))
        order = np.argsort(flux_ids)
        if len(flux_ids) != len(flux) or len(ids) == 0:
            raise ProductError("no column 'galaxy_id' in both tables", key="galaxy_id")
        rows = order[np.clip(np.searchsorted(flux_ids[order], ids), 0, len(order) - 1)]
        if not np.array_equal(flux_ids[rows], ids):
            raise ProductError(f"expected the fluxes of all galaxies of {path.name}", key="galaxy_id")
    return flux[rows]


def _bulge_fraction(columns: Mapping[str, Any], count: int) -> np.ndarray:
    """Return the part of the bulge in the light of galaxies, of the sums of the spectra of their components."""
    if "sed_val_bulge" not in columns:
        return np.zeros(count)
    light = {
        name: np.array([np.sum(values) for values in columns[f"sed_val_{name}"]], dtype=np.float64)
        for name in ("bulge", "disk", "knots")
        if f"sed_val_{name}" in columns
    }
    total = np.sum(list(light.values()), axis=0)
    return np.divide(light["bulge"], total, out=np.zeros(count), where=total > 0.0)


def _object_lines(path: Path, opened: frozenset[Path]) -> Iterator[tuple[Path, int, list[str]]]:
    """Yield file, number and words of each object of an instance catalogue, those of included files too."""
    if path.resolve() in opened:
        raise ProductError("includes itself", file=path)
    data = read_bytes(path, ProductError)
    with parsing(path, "damaged or no text", ProductError):
        text = unpacked_bytes(path, data, ProductError).decode()
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if words[:1] == ["includeobj"] and len(words) == 2:
            yield from _object_lines(path.parent / words[1], opened | {path.resolve()})
        elif words[:1] == ["object"]:
            yield path, number, words
