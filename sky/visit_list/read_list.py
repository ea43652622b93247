"""Reader of visit lists: columns of a file to pointings, angles and air, with what does not fit."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, check_choice, error_context
from ...core.number_text import counted
from ...core.statistics import FWHM_PER_RMS
from ...core.units import ARCSEC, require_positive
from ...models.io.site_file import load_site
from .list_columns import ListColumns
from .list_table import open_list
from .rotation import rotator_angles
from .seeing import MONITOR_WIDTH, WAVELENGTH, fried_parameter, is_allowed
from .sky_angles import Location, SkyAngles, location_of, sky_angles
from .visit_list import VisitList, night_dates

#: Laws by which seeing grows away from the zenith.
AIRMASS_LAWS = ("von_karman", "opsim")
#: Time between two snaps, in which the camera is read out [s] (rubin_scheduler).
READOUT = 2.0
#: The same in instance catalogues, whose time of a visit it is a part of [s].
CATALOGUE_READOUT = 3.0
#: Difference of altitudes of list and astropy from which a remark is made [rad].
_ALTITUDE_DIFFERENCE = np.deg2rad(1.0)
#: Least airmass of a list: fits to it are a little below 1 at the zenith.
_LEAST_AIRMASS = 0.99
#: Numbers from which a night is a date YYYYMMDD.
_FIRST_DATE = 10_000_000
# Bands by their numbers in instance catalogues.
_BANDS = tuple("ugrizy")
# Filters of HSC: HSC-G, and HSC-R2 that is in the place of HSC-R.
_HSC_FILTER = re.compile(r"HSC-([GRIZY])2?", re.IGNORECASE)
# Angle of an LSST pixel, in which ConsDB has widths [rad].
_CONSDB_PIXEL = 0.2 * ARCSEC
_SECONDS_A_DAY = 86400.0
# Brightest and darkest sky [mag/arcsec^2]: between twilight and what marks an unknown sky, such as 0 or 99.
_SKIES = 5.0, 35.0


@check_arguments
def read_visit_list(
    path: str | Path,
    *,
    where: str | None = None,
    band: str | None = None,
    night: int | None = None,
    camera: str = "lsst",
    site: str = "cerro_pachon",
    airmass_law: Literal["von_karman", "opsim"] = "von_karman",
    outer_scale: float | None = None,
) -> VisitList:
    """Read the visits of a scheduler, an observatory or a catalogue.

    Files are databases of SQLite (rubin_scheduler, OpSim), headers of instance catalogues, and tables of CSV, ECSV,
    FITS and Parquet (which needs ``pyarrow``: ``pip install 'pachon[parquet]'``) with the names of columns of these or
    of ConsDB's visit1. The page "Visit lists" of the documentation has all names and every conversion.

    Parameters
    ----------
    path : str or Path
        The file.
    where : str, optional
        Condition on the columns of the file in SQL, such as ``"airmass < 1.4 and target_name like 'lowdust%'"``.
    band : str, optional
        Bands to take, with commas between: ``"r,i"``.
    night : int, optional
        Night to take: a date YYYYMMDD (that of TAI less twelve hours), or a number of the column ``night``.
    camera : str
        Camera whose convention rotSkyPos has, where there is no rotTelPos: comcam, or another for LSSTCam's.
    site : str
        Bundled site, for the place on the Earth and the outer scale of lists without one.
    airmass_law : {"von_karman", "opsim"}
        Seeing away from the zenith: that of turbulence with an outer scale, whose r0 falls as airmass^-0.6; or the
        seeing at the zenith times airmass^0.6, to which r0 is then fitted.
    outer_scale : float, optional
        Outer scale of lists without one [m]; that of the site by default.

    Returns
    -------
    VisitList
        In the order of the file; ``remarks`` says what was assumed and what does not fit.

    Raises
    ------
    ProductError
        If the file cannot be read, or lacks a column.
    ConfigError
        If `where` is no condition on its columns, or a word is unknown.
    DomainError
        If no visit is left, rows of one number differ, or a visit lacks a number, lies below the horizon, or has a
        seeing that the outer scale does not allow.
    """
    path = Path(path)
    check_choice("airmass_law", airmass_law, AIRMASS_LAWS)
    location = location_of(site)
    if outer_scale is None:
        outer_scale = float(load_site(site).outer_scale)
    else:
        require_positive(outer_scale, "outer_scale")
    with error_context(file=path), open_list(path) as table:
        columns = ListColumns.of(table, where)
        if not len(columns):
            raise DomainError("no visit" + ("" if where is None else f" with {where}") + ": expected at least one")
        rows = _selection(columns, band, night)
        columns = _each_visit_once(columns.rows(rows))
        if not len(columns):
            wanted = ", ".join(
                f"{name} {value}" for name, value in (("band", band), ("night", night)) if value is not None
            )
            raise DomainError(f"no visit of {wanted}: expected at least one")
        return _visits(columns, path, camera, location, outer_scale, airmass_law)


def _visits(
    columns: ListColumns, path: Path, camera: str, location: Location, outer_scale: float, airmass_law: str
) -> VisitList:
    """Return the visits of columns, in the order of the mapping from files to optics."""
    number = _visit_numbers(columns)
    columns.values["visit"] = number
    columns.require("ra"), columns.require("dec")
    ra = columns.complete("ra", lambda angle: np.abs(angle) <= 4.0 * np.pi, "a finite angle") % (2.0 * np.pi)
    dec = columns.complete("dec", lambda angle: np.abs(angle) <= 0.5 * np.pi, "-90 to 90 deg")
    snaps = columns.stated("snaps", _is_whole, "a whole number")
    # Of no number, and of 0, the exposure is not divided.
    snaps = np.where(snaps >= 1.0, snaps, 1.0).astype(np.int64)
    exposure = _exposure_times(columns, snaps)
    midpoint = _midpoints(columns, exposure, snaps)
    band = _bands(columns)
    angles = sky_angles(ra, dec, midpoint, location)
    altitude, azimuth = _horizontal(columns, angles)
    rotator = rotator_angles(columns, angles.zenith_position_angle, camera)
    roll = columns.numbers("roll")
    scale = columns.stated("outer_scale", lambda length: length > 0.0, "a length above 0 m")
    scale = np.where(np.isnan(scale), outer_scale, scale)
    epoch = columns.stated("epoch", _is_whole, "a whole number from 0")
    epoch = np.where(np.isnan(epoch), number, np.nan_to_num(epoch).astype(np.int64))
    return VisitList(
        visit=number,
        band=band,
        ra=ra,
        dec=dec,
        roll=np.where(np.isfinite(roll), roll, angles.zenith_position_angle),
        zenith_position_angle=angles.zenith_position_angle,
        rotator=rotator,
        altitude=altitude,
        azimuth=azimuth,
        midpoint=midpoint,
        exposure=exposure,
        snaps=snaps,
        r0=_fried_parameters(columns, scale, altitude, airmass_law),
        outer_scale=scale,
        wind_speed=columns.stated("wind_speed", lambda speed: speed >= 0.0, "a speed from 0 m/s"),
        wind_azimuth=columns.numbers("wind_azimuth"),
        sky=columns.stated(
            "sky", lambda sky: (sky > _SKIES[0]) & (sky < _SKIES[1]), "{:g} to {:g} mag".format(*_SKIES)
        ),
        epoch=epoch,
        weight=_weights(columns),
        source=path.name,
        remarks=tuple(columns.remarks),
    )


def _weights(columns: ListColumns) -> np.ndarray:
    """Return the weights of visits, NaN where there is none, with a remark where others have one."""
    weights = columns.stated("weight", lambda weight: weight > 0.0, "a weight above 0")
    without = np.isnan(weights)
    if without.any() and not without.all():
        theirs = "the inverse variance of a pixel of the sky [nJy-2], beside the weights of the others"
        columns.remarks.append(f"{int(without.sum())} of {len(columns)} visits without a weight have {theirs}")
    return weights


def _each_visit_once(columns: ListColumns) -> ListColumns:
    """Return columns without the rows that repeat a visit, as OpSim 3 does for each proposal, with equal values."""
    if "visit" not in columns.values:
        return columns
    _, first, inverse = np.unique(columns.values["visit"], return_index=True, return_inverse=True)
    of_visit = first[inverse]
    # A row without a number is no visit.
    repeats = (of_visit != np.arange(len(columns))) & np.isfinite(columns.values["visit"])
    for values in columns.values.values():
        repeats &= (values == values[of_visit]) | ((values != values) & (values[of_visit] != values[of_visit]))
    if not repeats.any():
        return columns
    merged = columns.rows(~repeats)
    rows_repeat = counted(int(repeats.sum()), "row repeats a visit", "rows repeat visits")
    visits_are = counted(len(merged), "visit is", "visits are")
    merged.remarks.append(f"{rows_repeat} with equal values, as of several proposals: {visits_are} taken")
    return merged


def _visit_numbers(columns: ListColumns) -> np.ndarray:
    """Return the numbers of the visits, those of the rows where there are none; DomainError where two are the same."""
    if "visit" not in columns.values:
        columns.remarks.append("no numbers of visits: rows are counted from 1")
        return np.arange(1, len(columns) + 1)
    values = columns.values["visit"]
    name = columns.source["visit"]
    wrong = np.flatnonzero(~_is_whole(values))
    if wrong.size:
        value = "nothing" if np.isnan(values[wrong[0]]) else f"{values[wrong[0]]:.15g}"
        raise DomainError(
            f"column {name}, row {wrong[0] + 1}: {value}: expected whole numbers from 0 in every row", key=name
        )
    numbers = values.astype(np.int64)
    unique, counts = np.unique(numbers, return_counts=True)
    if (counts > 1).any():
        twice = unique[counts > 1]
        rows = np.flatnonzero(numbers == twice[0])
        differing_columns = [
            columns.source[key] for key, column in columns.values.items() if len(np.unique(column[rows])) > 1
        ]
        reasons = f"; they differ in {', '.join(differing_columns)}"
        if len(twice) > 1:
            reasons += f"; {len(twice)} numbers are repeated"
        raise DomainError(
            f"{name} = {twice[0]}: {counted(counts[counts > 1][0], 'row')}, expected each visit once{reasons}", key=name
        )
    return numbers


def _is_whole(values: np.ndarray) -> np.ndarray:
    """Return whether numbers are whole, not negative, and no larger than those of 64 bits."""
    return np.asarray((values >= 0) & (values == np.round(values)) & (values < 2.0**63))


def _exposure_times(columns: ListColumns, snaps: np.ndarray) -> np.ndarray:
    """Return the times of all snaps together [s]."""
    key = columns.require("exposure", "visit_time")
    times = columns.complete(key, lambda seconds: seconds > 0.0, "a time above 0 s")
    if key == "exposure":
        return times
    readout = CATALOGUE_READOUT * (snaps - 1)
    wrong = np.flatnonzero(times <= readout)
    if wrong.size:
        name, first = columns.source[key], wrong[0]
        expected = f"more than {readout[first]:g} s between {snaps[first]} snaps"
        raise columns.visit_error(wrong, f"{name} = {times[first]:g} s", expected, name)
    return times - readout


def _midpoints(columns: ListColumns, exposure: np.ndarray, snaps: np.ndarray) -> np.ndarray:
    """Return the middles of the exposures [MJD, TAI]."""
    key = columns.require("midpoint", "start")
    days = columns.complete(key, lambda day: (day > 0.0) & (day < 1e6), "a modified Julian date")
    if key == "midpoint":
        return days
    return days + half_of_visit(exposure, snaps)


def half_of_visit(exposure: float | np.ndarray, snaps: int | np.ndarray) -> np.ndarray:
    """Return the time from the start of a visit to its middle [d], of the time [s] and number of its snaps."""
    return np.asarray(0.5 * (exposure + READOUT * (snaps - 1)) / _SECONDS_A_DAY)


def _bands(columns: ListColumns) -> np.ndarray:
    """Return the bands, u to y; DomainError names the first visit with another."""
    columns.require("band")
    names = _band_names(columns)
    wrong = np.flatnonzero(~np.isin(names, _BANDS))
    if wrong.size:
        name = columns.source["band"]
        value = f"{name} = {columns.values['band'][wrong[0]]}"
        raise columns.visit_error(wrong, value, f"one of {', '.join(_BANDS)}", name)
    return names


def _band_names(columns: ListColumns) -> np.ndarray:
    """Return the bands of physical filters such as r_57 and HSC-R2, and of numbers from 0; others as they are."""
    values = columns.values.get("band", np.full(len(columns), ""))
    names = []
    for value in values.tolist():
        if not isinstance(value, str):
            index = int(value) if np.isfinite(value) else -1
            names.append(_BANDS[index] if 0 <= index < len(_BANDS) and index == value else str(value))
            continue
        word = re.split(r"[\s_~]", value.strip(), maxsplit=1)[0]
        hsc_filter = _HSC_FILTER.fullmatch(word)
        word = hsc_filter[1] if hsc_filter else word
        names.append(word.lower() if word.lower() in _BANDS else value.strip())
    return np.array(names)


def _selection(columns: ListColumns, band: str | None, night: int | None) -> np.ndarray:
    """Return the mask of the visits of bands and of a night."""
    mask = np.ones(len(columns), dtype=bool)
    if band is not None:
        wanted_bands = [name.strip() for name in band.split(",")]
        if not set(wanted_bands) <= set(_BANDS):
            raise ConfigError(f"band = {band}: expected some of {', '.join(_BANDS)}, with commas between", key="band")
        columns.require("band")
        mask &= np.isin(_band_names(columns), wanted_bands)
    if night is None:
        return mask
    if night < _FIRST_DATE:
        columns.require("night")
        return np.asarray(mask & (columns.values["night"] == night))
    days = columns.numbers(columns.require("midpoint", "start"))
    # Half an exposure at noon does not matter.
    with np.errstate(invalid="ignore"):
        dates = night_dates(np.nan_to_num(days))
    text = str(night)
    try:
        date = np.datetime64(f"{text[:4]}-{text[4:6]}-{text[6:]}")
    except ValueError:
        raise ConfigError(f"night = {night}: expected a date YYYYMMDD, or the number of a night", key="night") from None
    return np.asarray(mask & (dates == date))


def _horizontal(columns: ListColumns, angles: SkyAngles) -> tuple[np.ndarray, np.ndarray]:
    """Return altitudes and azimuths [rad]: those of the list, by its airmass, or by place and time."""
    altitude = columns.numbers("altitude").copy()
    if "altitude" not in columns.values and "zenith_distance" in columns.values:
        altitude = 0.5 * np.pi - columns.numbers("zenith_distance")
    without = ~np.isfinite(altitude)
    if "airmass" in columns.values and without.any():
        airmass = columns.rows(without).stated("airmass", lambda airmass: airmass >= _LEAST_AIRMASS, "a number from 1")
        altitude[without] = np.arcsin(1.0 / np.maximum(airmass, 1.0))
    listed = np.isfinite(altitude)
    if not listed.all():
        visits_have = counted(len(columns), "visit has", "visits have")
        columns.remarks.append(f"{(~listed).sum()} of {visits_have} no altitude: it is that of place and time")
    difference = np.where(listed, np.abs(altitude - angles.altitude), 0.0)
    apart = np.flatnonzero(difference > _ALTITUDE_DIFFERENCE)
    if apart.size:
        worst = int(np.argmax(difference))
        altitudes_differ = counted(len(apart), "altitude differs", "altitudes differ")
        columns.remarks.append(
            f"{altitudes_differ} by over 1 deg from those by place and time, of visit "
            f"{columns.values['visit'][worst]} by {np.rad2deg(difference[worst]):.1f} deg; those of the list are taken"
        )
    altitude = np.where(listed, altitude, angles.altitude)
    below = np.flatnonzero(~(altitude > 0.0))
    if below.size:
        value = f"altitude = {np.rad2deg(altitude[below[0]]):.4g} deg"
        raise columns.visit_error(below, value, "a pointing above the horizon", "altitude")
    wrong = np.flatnonzero(~(altitude <= 0.5 * np.pi + 1e-9))
    if wrong.size:
        value = f"altitude = {np.rad2deg(altitude[wrong[0]]):.4g} deg"
        raise columns.visit_error(wrong, value, "at most 90 deg", "altitude")
    azimuth = columns.numbers("azimuth")
    return altitude, np.where(np.isfinite(azimuth), azimuth, angles.azimuth)


def _fried_parameters(
    columns: ListColumns, outer_scale: np.ndarray, altitude: np.ndarray, airmass_law: str
) -> np.ndarray:
    """Return the Fried parameters at 500 nm at the zenith [m]."""
    key = columns.require("seeing", "r0", "psf_seeing", "monitor")
    if "r0" in columns.values:
        return columns.complete("r0", lambda length: (length > 1e-3) & (length < 10.0), "a length from 0.001 to 10 m")
    seeing = columns.complete(key, lambda angle: angle > 0.0, "a width above 0")
    if key == "monitor":
        columns.remarks.append(f"{columns.source[key]} is that of a monitor, {MONITOR_WIDTH} lambda / r0")
        return MONITOR_WIDTH * WAVELENGTH / seeing
    if key == "psf_seeing":
        columns.remarks.append(f"{columns.source[key]} has the telescope in it, which is then in twice")
        seeing = seeing * (_CONSDB_PIXEL * FWHM_PER_RMS)
    middle = float(np.median(seeing)) / ARCSEC
    if not 0.02 <= middle <= 30.0:
        name = columns.source[key]
        raise DomainError(f"column {name}: its median is {middle:.3g} arcsec: expected widths in arcsec", key=name)
    growth = (1.0 / np.sin(altitude)) ** 0.6 if airmass_law == "opsim" else np.ones(len(columns))
    try:
        along_sight = fried_parameter(seeing * growth, outer_scale)
    except DomainError as error:
        wrong = np.flatnonzero(~is_allowed(seeing * growth, outer_scale))
        value, _, expected = error.problem.partition(": expected ")
        raise columns.visit_error(wrong, value, expected, columns.source[key]) from None
    return along_sight * growth
