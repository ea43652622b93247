"""Stars of a user's catalogue at their positions on the CCDs of a camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy import units as u

from ..core.errors import ConfigError, ProductError, error_context
from ..core.table_files import column_in_unit, read_columns
from ..models.camera.camera import Camera
from ..models.star_spectrum import COOLEST, HOTTEST, MISSING, TEMPERATURE_COLUMNS, ColorBands, color_temperature
from ..models.telescope import Telescope
from ..raytrace.rays import LOST, field_direction
from ..sky.pointing import Pointing
from ..wavefront.chief_rays import chief_rays
from .config import Configuration

#: Accepted names of columns, in lower case, in order of preference; ``{band}`` is that of the run.
NAMES: dict[str, tuple[str, ...]] = {
    "ra": ("ra", "ra_deg", "ra_icrs", "raj2000", "alpha_j2000"),
    "dec": ("dec", "dec_deg", "de_icrs", "decl", "dej2000", "delta_j2000"),
    "field_x": ("field_x_deg", "field_x"),
    "field_y": ("field_y_deg", "field_y"),
    "x": ("x_m",),
    "y": ("y_m",),
    "mag": ("mag", "{band}", "mag_{band}", "{band}_mag", "{band}mag", "magnitude"),
    "teff": TEMPERATURE_COLUMNS,
    "bp_rp": ("bp_rp", "bp-rp"),
    "g_r": ("g_r", "g-r"),
    "g_i": ("g_i", "g-i"),
    "r_i": ("r_i", "r-i"),
}
#: Columns with the spectrum of a star; the first one present is used.
_SPECTRA: tuple[Literal["teff"] | ColorBands, ...] = ("teff", "bp_rp", "g_r", "g_i", "r_i")
#: Pairs of columns with positions, and their default unit; the first pair present is used.
_PLACES = ((("ra", "dec"), u.deg), (("field_x", "field_y"), u.deg), (("x", "y"), u.m))
#: Columns of colours of unknown bands, which are not used.
_COLORS = ("color", "colour")
#: Distance of stars from the edge of a CCD [pixel], so that their stamps lie on it (as of drawn ones, rim included).
RIM = 22


@dataclass(frozen=True, eq=False)
class StarList:
    """Stars of a catalogue, by CCD.

    Attributes
    ----------
    name : str
        Name of the file.
    stars : dict of str to ndarray
        x, y [m] on the detector and AB magnitude of the stars of each CCD, [n, 3], in the order of x, y and magnitude.
    counts : dict of str to int
        Rows of the table, how many of them were left out, and how many are on the CCDs.
    unused : tuple of str
        Columns of colours of unknown bands in the table, which are ignored.
    spectrum : str or None
        Kind of the column with the spectra of the stars; None without one.
    kelvin : dict of str to ndarray
        Temperatures of the stars of each CCD [K], NaN without a colour, [n]; empty without such a column.
    """

    name: str
    stars: dict[str, np.ndarray]
    counts: dict[str, int]
    unused: tuple[str, ...] = ()
    spectrum: str | None = None
    kelvin: dict[str, np.ndarray] = field(default_factory=dict)

    def on(self, ccd: str) -> tuple[np.ndarray, np.ndarray]:
        """Return positions on the detector [m], shape [n, 2], and magnitudes of the stars of a CCD."""
        stars = self.stars.get(ccd, np.zeros((0, 3)))
        return stars[:, :2], stars[:, 2]

    def temperatures(self, ccd: str) -> np.ndarray | None:
        """Return the temperatures of the stars of a CCD [K], NaN without a colour; None where no star has one."""
        return None if self.spectrum is None else self.kelvin.get(ccd, np.zeros(0))

    @property
    def text(self) -> str:
        """One line that counts the stars."""
        counts_text = ", ".join(f"{n} {reason.replace('_', ' ')}" for reason, n in self.counts.items() if n)
        note = "" if self.spectrum is None else f"; spectra from column {self.spectrum}"
        if self.unused and self.spectrum is None:
            note = f"; column {', '.join(self.unused)} is not used: name its bands ({', '.join(_SPECTRA)})"
        return f"{self.name}: {counts_text or 'no stars'}{note}"


def pointing_of(config: Configuration) -> Pointing | None:
    """Return the pointing of a configuration, None without one."""
    aim = config.pointing
    if aim is None:
        return None
    return Pointing(*map(math.radians, (aim.ra_deg, aim.dec_deg, aim.position_angle_deg)))


def listed_stars(config: Configuration, telescope: Telescope, camera: Camera) -> StarList | None:
    """Return the stars of the catalogue of a resolved configuration, None where stars are drawn.

    Raises what :func:`place_stars` raises, within ``stars.catalogue``.
    """
    stars, wavelengths = config.stars, config.wavelengths_nm or ()
    if stars.catalogue is None:
        return None
    with error_context(key="stars.catalogue"):
        return place_stars(
            Path(stars.catalogue),
            telescope,
            camera,
            config.ccds or (),
            wavelength=wavelengths[len(wavelengths) // 2] * 1e-9,
            band=config.band or "r",
            brightest=-math.inf if stars.brightest is None else stars.brightest,
            faintest=math.inf if stars.faintest is None else stars.faintest,
            pointing=pointing_of(config),
            columns=stars.columns,
        )


def place_stars(
    path: Path,
    telescope: Telescope,
    camera: Camera,
    ccds: Sequence[str],
    *,
    wavelength: float,
    band: str,
    brightest: float,
    faintest: float,
    pointing: Pointing | None,
    columns: dict[str, str],
) -> StarList:
    """Read the stars of a catalogue on some CCDs, by chief rays traced to the nominal detector.

    Places are the first of these that the table has, units of the file honoured: right ascension and declination [deg],
    which need a `pointing`; field angles [deg], the slopes of the light as of the columns FIELD_X and FIELD_Y of a run;
    positions on the detector [m]. Rows without a finite place or magnitude, stars outside the limits, and those within
    :data:`RIM` pixels of the edge of a CCD are left out and counted. The order of the rows does not matter.

    Raises
    ------
    ConfigError
        If the places are celestial and there is no pointing.
    ProductError
        If the file cannot be read, or lacks a column: one line with the names that were looked for.
    """
    rows = _read_rows(path, columns, band)
    places, magnitude, kelvin = rows.places, rows.magnitude, rows.temperature
    if rows.kind == "ra" and pointing is None:
        raise ConfigError("right ascension and declination: expected pointing = {ra_deg, dec_deg}", file=path)
    counts = {"stars": len(places)}

    def keep(what: str, good: np.ndarray) -> None:
        nonlocal places, magnitude, kelvin
        counts[what] = int((~good).sum())
        places, magnitude, kelvin = places[good], magnitude[good], kelvin[good]

    keep("without_place_or_magnitude", np.isfinite(places).all(axis=1) & np.isfinite(magnitude))
    keep("too_bright", magnitude >= brightest)
    keep("too_faint", magnitude <= faintest)
    if rows.kind != "x":
        aim = pointing if rows.kind == "ra" else None
        slopes = np.tan(places) if aim is None else aim.to_slopes(aim.from_celestial(*places.T))
        places, lands = _landing_points(telescope, slopes, wavelength)
        keep("outside_the_field", lands)
    keep("off_the_ccds", camera.ccd_at(*places.T) >= 0)
    ccd = camera.ccd_at(*places.T, margin=-RIM * camera.pixel_size)
    keep("at_the_rim_of_a_ccd", ccd >= 0)
    ccd = ccd[ccd >= 0]
    on_ccds = np.isin(ccd, [camera.ccd_index(name) for name in ccds])
    keep("on_other_ccds", on_ccds)
    ccd = ccd[on_ccds]
    counts["on_the_ccds"] = len(ccd)
    if rows.spectrum is not None:
        counts["without_colour"] = int(np.isnan(kelvin).sum())
    stars = np.concatenate([places, magnitude[:, None]], axis=1)
    # Noise is drawn star by star: the same stars in another order of rows are the same run.
    order = np.lexsort((kelvin, stars[:, 2], stars[:, 1], stars[:, 0], ccd))
    ccd, stars, kelvin = ccd[order], stars[order], kelvin[order]
    ccd_masks = {name: ccd == camera.ccd_index(name) for name in ccds}
    by_ccd = {name: stars[mask] for name, mask in ccd_masks.items()}
    temperatures = {} if rows.spectrum is None else {name: kelvin[mask] for name, mask in ccd_masks.items()}
    return StarList(path.name, by_ccd, counts, rows.unused, rows.spectrum, temperatures)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of a catalogue."""

    kind: str  #: first column of the places: ra, field_x or x
    places: np.ndarray  #: [n, 2], rad or m
    magnitude: np.ndarray
    temperature: np.ndarray  #: [K], NaN where there is no colour
    spectrum: str | None  #: column of the colours
    unused: tuple[str, ...]  #: columns of colours


def _read_rows(path: Path, columns: dict[str, str], band: str) -> _Rows:
    """Read places and magnitudes of all rows; ProductError if a column is missing or none of numbers."""
    table = read_columns(path)
    with error_context(file=path):
        column_names = {key: _column_name(table, key, columns, band) for key in NAMES}
        complete_pairs = [(pair, unit) for pair, unit in _PLACES if all(column_names[key] for key in pair)]
        pair, unit = complete_pairs[0] if complete_pairs else _PLACES[0]
        absent_keys = [key for key in (*pair, "mag") if column_names[key] is None]
        if absent_keys:
            looked = "; ".join(f"{key}: {', '.join(_column_names(key, columns, band))}" for key in absent_keys)
            raise ProductError(
                f"no column {', '.join(absent_keys)} ({looked}); columns are {', '.join(table) or 'none'}"
            )
        magnitude = column_in_unit(table, str(column_names["mag"]), None)
        places = np.stack([column_in_unit(table, str(column_names[key]), unit) for key in pair], axis=1)
        for key in _SPECTRA:
            if key in columns and column_names[key] is None:
                raise ProductError(f"no column {columns[key]} ({key}); columns are {', '.join(table)}")
        spectrum = next((key for key in _SPECTRA if column_names[key]), None)
        kelvin = np.full(len(magnitude), np.nan)
        if spectrum is not None:
            kelvin = _star_temperatures(column_in_unit(table, str(column_names[spectrum]), None), spectrum)
    unused = tuple(name for name in _COLORS if name in table)
    return _Rows(pair[0], places, magnitude, kelvin, spectrum, unused)


def _star_temperatures(values: np.ndarray, kind: Literal["teff"] | ColorBands) -> np.ndarray:
    """Return the temperatures [K] of a column of temperatures or colours, NaN where a row has none."""
    values = np.where(values > MISSING, values, np.nan)
    temperatures = values if kind == "teff" else color_temperature(values, kind)
    temperatures = np.where(np.isfinite(temperatures) & (temperatures > 0.0), temperatures, np.nan)
    return np.clip(temperatures, COOLEST, HOTTEST)


def _landing_points(telescope: Telescope, slopes: np.ndarray, wavelength: float) -> tuple[np.ndarray, np.ndarray]:
    """Return where chief rays meet the nominal detector [m], shape [n, 2], NaN where none does, and whether they do."""
    with np.errstate(invalid="ignore"):
        inside = np.flatnonzero(np.hypot(*np.arctan(slopes).T) <= telescope.field_limit)
    light = field_direction(slopes[inside, 0], slopes[inside, 1], "gnomonic")
    end = chief_rays(telescope, light, wavelength)
    lost = np.isin(end.status, LOST)
    places = np.full(slopes.shape, np.nan)
    places[inside[~lost]] = telescope.surfaces[-1].to_local(end.position)[~lost, :2]
    return places, np.isfinite(places[:, 0])


def _column_names(key: str, columns: dict[str, str], band: str) -> tuple[str, ...]:
    """Return the names that a column may have: one that is given, as it is, and in small letters."""
    if key in columns:
        return tuple(dict.fromkeys((columns[key], columns[key].lower())))
    return tuple(name.format(band=band) for name in NAMES[key])


def _column_name(table: dict[str, Any], key: str, columns: dict[str, str], band: str) -> str | None:
    """Return the name of a column in a table, or None."""
    return next((name for name in _column_names(key, columns, band) if name in table), None)
