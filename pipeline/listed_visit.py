"""Configurations of the visits of a list, and what headers say of them."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core.errors import ConfigError, PachonError, error_context
from ..core.number_text import counted
from ..core.products import Card
from ..models.camera.camera import Camera
from ..models.io.bundled import BUNDLED
from ..sky.visit_list.read_list import half_of_visit
from ..sky.visit_list.visit_list import ListedVisit, VisitList
from .config import Configuration, ListedVisitConfig, PointingConfig, configuration_of
from .experiment import Experiment
from .photometry import airmass_of
from .resolved_values import resolved_value

#: Names of cameras in headers; others have their own.
_INSTRUMENTS = {"lsst": "LSSTCam", "comcam": "LSSTComCam", "auxtel": "LATISS", "decam": "DECam", "hsc": "HSC"}
#: Band in the name of a model, such as lsst_v3.3_r.
_BAND_OF_NAME = re.compile(r"_([ugrizy])(?=_|$)")
_SECONDS_A_DAY = 86400.0
#: Modified Julian date of the epoch J2000.
_J2000 = 51544.5
#: Visits of a band of which one must have an experiment: others may lie too low, or have other values out of range.
_TRIED = 3


def telescope_of_band(name: str | None, band: str, folder: Path | None = None) -> str | None:
    """Return the model of a telescope in a band: the one of its name with that band's letter.

    ConfigError if a name has a band, and there is none with the other.
    """
    if name is None:
        return None
    path = Path(name)
    stem = name if name in BUNDLED else path.stem
    match = list(_BAND_OF_NAME.finditer(stem))[-1:]
    if not match or match[0][1] == band:
        return name
    other = f"{stem[: match[0].start(1)]}{band}{stem[match[0].end(1) :]}"
    if name in BUNDLED:
        if other in BUNDLED:
            return other
    elif ((folder or Path()) / (sibling := path.with_name(other + path.suffix))).is_file():
        return str(sibling)
    raise ConfigError(f"telescope = {name}: has no band {band}; expected visits in its band {match[0][1]}, or {other}")


def visit_configuration(config: Configuration, visit: ListedVisit, folder: Path | None = None) -> Configuration:
    """Return the configuration of a visit: pointing, angles, band, time and air of the list, all else as it is.

    ConfigError if the telescope has not its band, or a value is out of range.
    """
    content = config.as_dict()
    content["band"] = visit.band
    content["telescope"] = telescope_of_band(config.telescope, visit.band, folder)
    content["pointing"] = PointingConfig(
        ra_deg=math.degrees(visit.ra), dec_deg=math.degrees(visit.dec), position_angle_deg=math.degrees(visit.roll)
    ).model_dump()
    content["rotator_deg"] = math.degrees(visit.rotator)
    content["visit"] = ListedVisitConfig(number=visit.visit, mid_mjd=visit.midpoint, snaps=visit.snaps).model_dump()
    content["atmosphere"] |= {
        "epoch": visit.epoch,
        "r0_m": visit.r0,
        "outer_scale_m": visit.outer_scale,
        "exposure_s": visit.exposure,
        "zenith_angle_deg": max(math.degrees(visit.zenith_angle), 0.0),
        "zenith_position_angle_deg": math.degrees(visit.zenith_position_angle),
    }
    if math.isfinite(visit.wind_speed) and math.isfinite(visit.wind_azimuth):
        content["atmosphere"]["ground_wind_m_s"] = ground_wind(visit)
    return configuration_of(content, visit.label)


def ground_wind(visit: ListedVisit) -> tuple[float, float]:
    """Return the wind on the ground along x and y of an alt-azimuth telescope [m/s], as it crosses the pupil.

    +y points to the zenith and +z to the sky: a wind towards the azimuth B has, at the altitude h and azimuth A of the
    pointing, the components -sin(B - A) and -sin(h) cos(B - A) across the line of sight.
    """
    towards = visit.wind_azimuth + math.pi - visit.azimuth
    # Rolled against the vertical, x and y turn with the telescope.
    turn = visit.roll - visit.zenith_position_angle
    x, y = -math.sin(towards), -math.sin(visit.altitude) * math.cos(towards)
    c, s = math.cos(turn), math.sin(turn)
    return visit.wind_speed * (c * x - s * y), visit.wind_speed * (s * x + c * y)


def visit_experiment(config: Configuration, visit: ListedVisit, folder: Path | None = None) -> Experiment:
    """Return the experiment of a visit of a list, with the photometry of its sky and snaps.

    What the list says counts more than the configuration. The brightness of the sky is that at the telescope. Snaps are
    one exposure of their total time, with the read noise of all.
    """
    with error_context(subject=visit.label):
        experiment = Experiment.from_config(visit_configuration(config, visit, folder), folder)
        settings = experiment.config
        band = experiment.band
        updates = {
            "read_noise_e": band.read_noise * math.sqrt(visit.snaps / _snaps_within(config, "read_noise_e")),
            "full_well_e": band.full_well * visit.snaps / _snaps_within(config, "full_well_e"),
        }
        if math.isfinite(visit.sky):
            updates["dark_sky"] = visit.sky
        photometry = settings.photometry.model_copy(update=updates)
        settings = settings.model_copy(update={"photometry": photometry})
        if settings.stars.catalogue is not None:
            # Limits that are not given are those of this sky and these snaps.
            limits = {key: getattr(config.stars, key) for key in ("brightest", "faintest")}
            stars = settings.stars.model_copy(update=limits)
            return Experiment.from_config(settings.model_copy(update={"stars": stars}))
        return replace(experiment, config=settings)


def _snaps_within(config: Configuration, key: str) -> int:
    """Return the snaps that a number of the photometry is of: several in the configuration of a visit of a list."""
    return 1 if config.visit is None or getattr(config.photometry, key) is None else config.visit.snaps


def check_bands(config: Configuration, visits: VisitList, folder: Path | None = None) -> None:
    """Raise the error of a band of a list that the telescope has not: that of its first visit, where three fail.

    Where they fail by what the list says of them, such as a low altitude, the band is another matter.
    """
    for band in np.unique(visits.band):
        of_band = np.flatnonzero(visits.band == band)
        errors: list[PachonError] = []
        for index in of_band[:_TRIED]:
            try:
                visit_experiment(config, visits[int(index)], folder)
                break
            except PachonError as error:
                errors.append(error)
        else:
            if not _has_band(config, str(band), folder):
                raise errors[0].within(subject=f"band {band}, {counted(len(of_band), 'visit')} of {visits.source}")


def _has_band(config: Configuration, band: str, folder: Path | None) -> bool:
    """Return whether a configuration has an experiment in a band, whatever the visits."""
    content = config.as_dict() | {"band": band}
    try:
        content["telescope"] = telescope_of_band(config.telescope, band, folder)
        Experiment.from_config(configuration_of(content, f"band {band}"), folder)
    except PachonError:
        return False
    return True


def visit_cards(experiment: Experiment, ccd: str) -> list[Card]:
    """Return the cards of a header that name instrument, detector and time of a visit; none without a visit."""
    visit = experiment.config.visit
    if visit is None:
        return []
    exposure = experiment.config.atmosphere.exposure_s
    start = visit.mid_mjd - float(half_of_visit(exposure, visit.snaps))
    pointing = resolved_value(experiment.config.pointing)
    return [
        ("INSTRUME", instrument_of(experiment.camera), "camera"),
        ("DETECTOR", experiment.camera.ccd_index(ccd), "number of the CCD in the camera, from 0"),
        ("VISIT", visit.number, "number of the visit"),
        ("TIMESYS", "TAI", "of all times"),
        ("DATE-OBS", _date_of(start), "start of the exposure"),
        ("MJD-OBS", start, "[d] start of the exposure"),
        ("DATE-AVG", _date_of(visit.mid_mjd), "middle of the exposure"),
        ("MJD-AVG", visit.mid_mjd, "[d] middle of the exposure"),
        ("RA", pointing.ra_deg % 360.0, "[deg] pointing, ICRS"),
        ("DEC", pointing.dec_deg, "[deg] pointing, ICRS"),
        ("ROTTELPO", experiment.config.rotator_deg, "[deg] camera against telescope (rotTelPos)"),
        ("AIRMASS", airmass_of(experiment.config.atmosphere), "secant of the zenith angle"),
        ("NSNAP", visit.snaps, "snaps of the visit"),
    ]


def observation_cards(experiment: Experiment, ccd: str, exposure: float) -> list[Card]:
    """Return :func:`visit_cards`; without a visit those of instrument and detector, and a nominal date.

    The date is the epoch J2000, at which positions of catalogues need no proper motion, to the middle of an exposure
    [s], all of a sum together.
    """
    return visit_cards(experiment, ccd) or [
        ("INSTRUME", instrument_of(experiment.camera), "camera"),
        ("DETECTOR", experiment.camera.ccd_index(ccd), "number of the CCD in the camera, from 0"),
        *nominal_dates(exposure),
    ]


def nominal_dates(exposure: float) -> list[Card]:
    """Return the cards of the nominal date of an exposure [s] of no visit."""
    comment = "nominal: of no visit"
    return [
        ("TIMESYS", "TAI", "of all times"),
        ("DATE-OBS", _date_of(_J2000), comment),
        ("MJD-OBS", _J2000, f"[d] {comment}"),
        ("DATE-AVG", _date_of(_J2000 + 0.5 * exposure / _SECONDS_A_DAY), comment),
        ("MJD-AVG", _J2000 + 0.5 * exposure / _SECONDS_A_DAY, f"[d] {comment}"),
    ]


def instrument_of(camera: Camera) -> str:
    """Return the name of a camera in headers."""
    return _INSTRUMENTS.get(camera.name, camera.name)


def _date_of(mjd: float) -> str:
    """Return a modified Julian date as FITS has dates, to a millisecond."""
    milliseconds = round(mjd * _SECONDS_A_DAY * 1e3)
    return str(np.datetime64("1858-11-17T00:00:00.000") + np.timedelta64(milliseconds, "ms"))
