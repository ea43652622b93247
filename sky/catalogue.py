"""Galaxies in tables: catalogues of Sersic profiles, and tables of components written and read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy import units as u
from astropy.table import Column
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError, ProductError, error_context
from ..core.files import write_bytes
from ..core.products import Columns, table_hdu, write_ecsv, write_fits
from ..core.table_files import parquet_bytes, read_columns
from ..core.units import ARCSEC, radians
from ..models.camera.photometry import BandName
from .galaxies import Galaxies
from .imsim_galaxies import (
    SIGN_OF_SKY_CATALOGUE,
    galaxies_of_instance_catalogue,
    galaxies_of_sky_catalogue,
    is_instance_catalogue,
)
from .pointing import tangent_plane
from .sersic import GREATEST_INDEX, INDICES, LEAST_INDEX
from .sky_shapes import along_tangent_plane

#: Kinds of the files that are written, by their endings.
FORMATS = {".ecsv": "ECSV", ".fits": "FITS", ".fit": "FITS", ".parquet": "Parquet"}
#: Names of columns, in any case; the first is the one that messages name.
NAMES = {"mag": ("mag", "magnitude"), "half_light_radius": ("half_light_radius", "hlr"), "n": ("n", "sersic")}
# Columns of a table of components: unit, description.
_PER_GALAXY = {
    "xi": ("rad", "position on the tangent plane, towards east"),
    "eta": ("rad", "likewise, towards north"),
    "magnitude": ("mag", "AB, of the whole galaxy"),
    "radius": ("rad", "half-light radius of the whole galaxy"),
}
_PER_COMPONENT = {
    "dx": ("rad", "offset from the position, towards east"),
    "dy": ("rad", "likewise, towards north"),
    "fraction": ("", "fraction of the light of the galaxy"),
    "component_radius": ("rad", "half-light radius sqrt(a b)"),
    "e1": ("", "(a - b)/(a + b), > 0 along xi"),
    "e2": ("", "likewise, > 0 along xi = eta"),
    "sersic": ("", "Sersic index"),
}


EllipticityConvention = Literal["galsim", "tangent_plane"]
#: Conventions of e2: the sign that turns it into ours, > 0 along xi = eta, and what it means.
CONVENTIONS: dict[EllipticityConvention, tuple[float, str]] = {
    "galsim": (-1.0, "e2 > 0 from north-west to south-east, as of GalSim, TreeCorr, DES and Rubin"),
    "tangent_plane": (1.0, "e2 > 0 from north-east to south-west, along xi = eta"),
}


@check_arguments
def read_galaxies(
    path: str | Path,
    *,
    pointing: ArrayLike | None = None,
    convention: EllipticityConvention | None = None,
    band: BandName = "r",
) -> Galaxies:
    """Read galaxies from a table: ECSV, CSV, FITS (its first table) or Parquet.

    Columns of a catalogue, in any case; units of the file are honoured, and where it has none these hold:

    ====================== =======================================================================================
    ``ra``, ``dec``        positions [deg], with `pointing`; or ``xi``, ``eta``, on the tangent plane [rad]
    ``mag``                AB magnitude
    ``half_light_radius``  sqrt(a b) of the isophote that holds half of the light [arcsec]
    ``e1``, ``e2``         (a - b)/(a + b), e1 > 0 east to west, e2 by the `convention`; default 0
    ``q``, ``pa``          instead: axis ratio b/a, and position angle from north towards east [deg]
    ``n``                  Sersic index, 0.3 to 6.2; default 1
    ====================== =======================================================================================

    A table of components, as :func:`write_galaxies` writes it, is recognised by its columns, and so is one of
    skyCatalogs (``galaxy_*.parquet``, with ``galaxy_flux_*.parquet`` beside it). A file that ends in .txt or .txt.gz is
    an instance catalogue.

    Parameters
    ----------
    path : str or Path
        The table.
    pointing : (float, float) or Quantity, optional
        Right ascension and declination of the pointing [rad], for ``ra`` and ``dec``.
    convention : {"galsim", "tangent_plane"}, optional
        Sense of a column ``e2``: > 0 from north-west to south-east ("galsim", as of GalSim, TreeCorr, DES, Rubin), or
        from north-east to south-west ("tangent_plane", as tables of components have it). Needed where it is not 0.
    band : str
        Band of the fluxes of skyCatalogs, u to y.

    Returns
    -------
    Galaxies

    Raises
    ------
    ProductError
        If the file cannot be read, or lacks a column.
    ConfigError
        If the convention is unknown.
    DomainError
        If a value is none of a galaxy, or the convention of ``e2`` is not given.
    """
    path = Path(path)
    if is_instance_catalogue(path):
        return galaxies_of_instance_catalogue(path, pointing)
    columns = read_columns(path)
    with error_context(file=path):
        if set(columns) >= SIGN_OF_SKY_CATALOGUE:
            return galaxies_of_sky_catalogue(columns, path, pointing, band)
        if {"galaxy", "component_radius"} <= set(columns):
            return _from_components(columns)
        return _from_catalogue(columns, pointing, convention)


@check_arguments
def write_galaxies(path: str | Path, galaxies: Galaxies) -> None:
    """Write galaxies as a table of their components, ECSV, FITS or Parquet by the ending of the path.

    Every row is a component, attributes of its galaxy repeated. :func:`read_galaxies` returns the same numbers.

    Raises
    ------
    ProductError
        If the ending is another, or the file cannot be written.
    """
    path = Path(path)
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise ProductError(f"ending {path.suffix!r}: expected one of {', '.join(FORMATS)}", file=path)
    owner = galaxies.owner
    columns: Columns = {"galaxy": (owner.astype(np.int32), "", "index of the galaxy")}
    columns |= {name: (getattr(galaxies, name)[owner], *text) for name, text in _PER_GALAXY.items()}
    columns |= {name: (getattr(galaxies, name), *text) for name, text in _PER_COMPONENT.items()}
    if kind == "ECSV":
        write_ecsv(path, columns, {})
    elif kind == "FITS":
        write_fits(path, [table_hdu("COMPONENTS", columns)], None, [])
    else:
        write_bytes(path, parquet_bytes(path, columns, error=ProductError))


def _column_values(
    columns: dict[str, Column | np.ndarray], name: str, unit: u.UnitBase | None = None, default: float | None = None
) -> np.ndarray:
    """Return a column as numbers, in rad where it has a unit of angle; `unit` is that of a column without one."""
    key = next((alias for alias in NAMES.get(name, (name,)) if alias in columns), None)
    if key is None and default is not None:
        return np.full(len(next(iter(columns.values()))), float(default))
    if key is None:
        raise ProductError(f"no column {name!r}; columns are {', '.join(columns) or 'none'}", key=name)
    column = columns[key]
    values = np.ma.filled(np.ma.asarray(column).astype(object), np.nan) if hasattr(column, "mask") else column
    try:
        numbers = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.zeros((0, 0))
    if numbers.ndim != 1:
        raise DomainError(f"column {key!r}: expected one number in every row", key=key)
    bad = np.flatnonzero(~np.isfinite(numbers))
    if len(bad):
        raise DomainError(f"column {key!r}, row {bad[0] + 1}: expected a finite number", key=key)
    if unit is None:
        return numbers
    column_unit = getattr(column, "unit", None)
    if isinstance(column_unit, u.UnrecognizedUnit):
        raise DomainError(f"column {key!r} in {column_unit}: expected a unit of angle", key=key)
    return radians(u.Quantity(numbers, column_unit or unit), key)


def _from_catalogue(
    columns: dict[str, Column | np.ndarray], pointing: Any, convention: EllipticityConvention | None = None
) -> Galaxies:
    """Return galaxies of one component from the columns of a catalogue."""
    celestial: tuple[np.ndarray, np.ndarray] | None = None
    if "xi" in columns or "eta" in columns:
        xi, eta = (_column_values(columns, name, u.rad) for name in ("xi", "eta"))
    elif "ra" in columns or "dec" in columns:
        celestial = _column_values(columns, "ra", u.deg), _column_values(columns, "dec", u.deg)
        xi, eta = tangent_plane(*celestial, pointing)
    else:
        column_names = ", ".join(columns) or "none"
        raise ProductError(f"no columns 'ra' and 'dec', nor 'xi' and 'eta'; columns are {column_names}", key="ra")
    magnitude = _column_values(columns, "mag")
    radius = _column_values(columns, "half_light_radius", u.arcsec)
    if "q" in columns:
        ratio = _column_values(columns, "q")
        _require_all((ratio > 0.0) & (ratio <= 1.0), ratio, "q", "an axis ratio above 0, at most 1")
        # From north towards east is from eta towards xi.
        e = (1.0 - ratio) / (1.0 + ratio) * np.exp(2j * (0.5 * np.pi - _column_values(columns, "pa", u.deg)))
        e1, e2 = e.real, e.imag
    else:
        has_ellipticity = "e1" in columns or "e2" in columns
        e1, e2 = (_column_values(columns, name, default=None if has_ellipticity else 0.0) for name in ("e1", "e2"))
        if e2.any():
            e2 = _sign_of(convention) * e2
    if celestial is not None:
        e1, e2 = along_tangent_plane(e1, e2, *celestial, pointing)
    sersic = _column_values(columns, "n", default=1.0)
    ellipticity = np.hypot(e1, e2)
    _require_all(radius > 0.0, radius / ARCSEC, "half_light_radius", "a radius above 0 arcsec")
    _require_all(ellipticity < 1.0, ellipticity, "e1, e2", "an ellipticity below 1")
    _require_all((sersic >= LEAST_INDEX) & (sersic <= GREATEST_INDEX), sersic, "n", INDICES)
    return Galaxies.single(xi, eta, magnitude, radius, e1=e1, e2=e2, sersic=sersic)


def _require_all(good: np.ndarray, values: np.ndarray, column: str, expectation: str) -> None:
    """Raise DomainError for the first row of a column, as far as there is one, whose value is not good."""
    if not good.all():
        row = int(np.argmin(good))
        raise DomainError(f"column {column!r}, row {row + 1}: {values[row]:g}, expected {expectation}", key=column)


def _sign_of(convention: EllipticityConvention | None) -> float:
    """Return the sign that turns e2 of a convention into ours, or raise DomainError where none is given."""
    if convention is None:
        choices = ", or ".join(f"{name} ({meaning})" for name, (_, meaning) in CONVENTIONS.items())
        raise DomainError(f"column 'e2' without a convention: expected convention = {choices}", key="convention")
    return CONVENTIONS[convention][0]


def _from_components(columns: dict[str, Column | np.ndarray]) -> Galaxies:
    """Return galaxies from the columns of a table of components."""
    owner = _column_values(columns, "galaxy")
    first = np.flatnonzero(np.diff(owner, prepend=-1.0))
    if not np.array_equal(owner[first], np.arange(len(first))):
        raise DomainError(
            "column 'galaxy': expected 0, 1, 2..., with the components of a galaxy together", key="galaxy"
        )
    values = {
        name: _column_values(columns, name, u.rad if unit == "rad" else None)
        for name, (unit, _) in (_PER_GALAXY | _PER_COMPONENT).items()
    }
    values |= {name: values[name][first] for name in _PER_GALAXY}
    return Galaxies(first=np.append(first, len(owner)), **values)
