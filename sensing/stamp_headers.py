"""Headers of observatories: camera, detector, angles of rotator and sky, band and gain of an exposure.

Keywords are those of LSST's raw files and exposures (obs_lsst, afw's VisitInfo), of ts_wep's DonutStamps, and of DECam
(NOIRLab's raw files; stamps of aaronroodman/Donut). A header says what it has: each value may be missing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits

from ..core.errors import ProductError
from ..core.products import text_of_card

#: Cameras by the names of instruments in headers, in lower case without separators.
_INSTRUMENTS = {
    "lsstcam": "lsst",
    "lsstcamsim": "lsst",
    "lsstcamimsim": "lsst",
    "lsstcamera": "lsst",
    "lsstcomcam": "comcam",
    "lsstcomcamsim": "comcam",
    "comcam": "comcam",
    "latiss": "auxtel",
    "decam": "decam",
}
#: Keywords that name the instrument.
_INSTRUMENT_KEYS = ("CAM_NAME", "INSTRUME", "INSTRUMENT", "CAMERA", "DTACQNAM")
#: Keywords that name or number the detector, in the order in which they count.
_DETECTOR_KEYS = ("DET_NAME", "DETNAME", "CCDNAME", "DETPOS", "DETECTOR", "LSST BUTLER DATAID DETECTOR", "EXTNAME")
#: Keywords of the pixel of the CCD, counted from 0, in the middle of a stamp.
_PIXEL_KEYS = (("CENT_X", "CENT_Y"), ("IX", "IY"))
#: Keywords of azimuth and altitude [deg].
_HORIZON_KEYS = (("BORE-AZ", "BORE-ALT"), ("AZSTART", "ELSTART"), ("AZ", "EL"))
#: Keywords of the position angle of the images' +y, LSST's rotation on the sky [deg].
_ROTATION_KEYS = ("ROTPA", "BORE-ROTANG")
#: Latitude of Cerro Pachon, where a header has none [deg].
_LATITUDE = -30.244639
#: Keywords of simulated donuts: telescope, wavelength [nm], pixel [um].
TELESCOPE_KEY, WAVELENGTH_KEY, PIXEL_KEY = "TELMODEL", "WAVELEN", "PIXEL_UM"
#: Keywords that are copied from header to header.
_KEYWORD = re.compile(r"[A-Z0-9_-]+( [A-Z0-9_-]+)*")
#: Mean wavelength and width [angstrom] at the end of DECam's names of filters.
_DECAM_FILTER = re.compile(r"^\s*(\w+)\s+DECam\s.*?\s(\d{4,5}(?:\.\d*)?)\s+\d+(?:\.\d*)?\s*$")


@dataclass(frozen=True)
class HeaderValues:
    """What the headers of a file say of an exposure; None for what they do not.

    Attributes
    ----------
    camera : str or None
        ``lsst``, ``comcam``, ``auxtel`` or ``decam``.
    rotator : float or None
        Angle of the camera from +x towards +y of the telescope [rad].
    parallactic_angle : float or None
        Parallactic angle [rad].
    band : str or None
        Name of the filter: u, g, r, i, z, y.
    wavelength : float or None
        Mean wavelength of the filter [m], where the header has it.
    gain : float or None
        Electrons of a unit of the images.
    telescope : str or None
        Bundled telescope, or path, of which simulated donuts are believed to be.
    pixel : float or None
        Side of their pixels [m].
    """

    camera: str | None = None
    rotator: float | None = None
    parallactic_angle: float | None = None
    band: str | None = None
    wavelength: float | None = None
    gain: float | None = None
    telescope: str | None = None
    pixel: float | None = None

    @property
    def model(self) -> str | None:
        """Name of the telescope: that stated, or the bundled one of camera and band; None where it is not known."""
        if self.telescope is not None:
            return self.telescope
        if self.camera == "lsst":
            return f"rubin_v3.14_{self.band}" if self.band in set("ugrizy") else None
        return None if self.camera is None else {"comcam": "comcam_r"}.get(self.camera, self.camera)

    @property
    def text(self) -> str:
        """What is known, in one line; empty without anything."""
        angles = {"rotator": self.rotator, "parallactic angle": self.parallactic_angle}
        parts = [
            *(word for word in (self.camera, self.telescope) if word),
            *([f"band {self.band}"] if self.band else []),
            *(f"{name} {np.rad2deg(angle):.4g} deg" for name, angle in angles.items() if angle is not None),
            *([f"gain {self.gain:.4g}"] if self.gain is not None else []),
        ]
        return ", ".join(parts)


def header_values(headers: Iterable[fits.Header], file: Path) -> HeaderValues:
    """Return what the headers of a file say of its exposure, the first that says it counting.

    Raises
    ------
    ProductError
        If a keyword that is known holds something else than its kind of value.
    """
    listed = list(headers)
    camera = next((c for h in listed if (c := _camera(h)) is not None), None)
    parallactic = next((q for h in listed if (q := _parallactic_angle(h, file)) is not None), None)
    band, wavelength = next(((b, w) for h in listed for b, w in [_band(h)] if b is not None), (None, None))
    rotator = None
    # On the Nasmyth platform of LATISS and on DECam's equatorial mount the relation is another one.
    if parallactic is not None and camera in ("lsst", "comcam"):
        rotation = next((r for h in listed if (r := _sky_rotation(h, file)) is not None), None)
        if rotation is not None:
            # Images' +y has the position angle q - rotator - 90 deg.
            rotator = float(np.remainder(parallactic - rotation - 0.5 * np.pi + np.pi, 2.0 * np.pi) - np.pi)
    gain = next((g for h in listed if (g := gain_of(h, file)) is not None and np.isfinite(g)), None)
    simulated = next((h for h in listed if TELESCOPE_KEY in h), None)
    if simulated is None:
        return HeaderValues(camera, rotator, parallactic, band, wavelength, gain)
    telescope, pixel = text_of_card(str(simulated[TELESCOPE_KEY]).strip()), 1e-6 * _number(simulated, PIXEL_KEY, file)
    wavelength = 1e-9 * _number(simulated, WAVELENGTH_KEY, file)
    return HeaderValues(camera, rotator, parallactic, band, wavelength, gain, telescope, pixel)


def detector_of(header: fits.Header) -> str | int | None:
    """Return name or number of the detector of an image; None where its header has none."""
    if "RAFTBAY" in header and "CCDSLOT" in header:
        return f"{header['RAFTBAY']}_{header['CCDSLOT']}"
    for key in _DETECTOR_KEYS:
        value = header.get(key)
        if isinstance(value, int) and not isinstance(value, bool):
            return value
        if isinstance(value, str) and re.fullmatch(r"R\w\w_S\w\w|F?[NS]\d+", value.strip()):
            return value.strip()
    return None


def pixel_of(header: fits.Header, shape: tuple[int, ...], file: Path) -> tuple[float, float]:
    """Return the pixel of the CCD, from 0, in the middle of a stamp; NaN where its header does not say."""
    for x, y in _PIXEL_KEYS:
        if x in header and y in header:
            return _number(header, x, file), _number(header, y, file)
    if "LTV1" in header and "LTV2" in header:
        corner_x, corner_y = corner_of(header, file)
        return corner_x + 0.5 * (shape[-1] - 1), corner_y + 0.5 * (shape[-2] - 1)
    return float("nan"), float("nan")


def corner_of(header: fits.Header, file: Path) -> tuple[float, float]:
    """Return the pixel of the CCD, from 0, in the corner of an image: (0, 0) but for cut-outs of LSST's images."""
    return tuple(-_number(header, key, file) if key in header else 0.0 for key in ("LTV1", "LTV2"))  # type: ignore[return-value]


def defocus_of(header: fits.Header, file: Path) -> float:
    """Return the shift of the detector [m]; NaN where the header has none."""
    if "DEFOC_UM" in header:
        return 1e-6 * _number(header, "DEFOC_UM", file)
    if "DFC_TYPE" in header:
        side = str(header["DFC_TYPE"]).strip().lower()
        if side not in ("extra", "intra"):
            raise ProductError(f"DFC_TYPE = {header['DFC_TYPE']!r}: expected extra or intra", file=file, key="DFC_TYPE")
        # 1.5 mm is what ts_wep takes where its files have no distance.
        distance = 1e-3 * (_number(header, "DFC_DIST", file) if "DFC_DIST" in header else 1.5)
        return distance if side == "extra" else -distance
    return float("nan")


def stamp_header(primary: fits.Header, header: fits.Header, index: int) -> fits.Header:
    """Return the header of a stamp with values of its own in the lists of a primary header, as ts_wep writes them.

    A keyword that occurs several times in the primary header holds one value a stamp; one that occurs once, and not in
    the stamp's header, holds for all.
    """
    values: dict[str, list[object]] = {}
    for card in primary.cards:
        values.setdefault(card.keyword, []).append(card.value)
    merged = fits.Header()
    for key, listed in values.items():
        if _KEYWORD.fullmatch(key) and key not in (
            "COMMENT",
            "HISTORY",
            "SIMPLE",
            "BITPIX",
            "NAXIS",
            "EXTEND",
            "EXTNAME",
        ):
            merged[_card_name(key)] = listed[index] if len(listed) > index else listed[0]
    for card in header.cards:
        if _KEYWORD.fullmatch(card.keyword) and card.keyword not in ("COMMENT", "HISTORY"):
            merged[_card_name(card.keyword)] = card.value
    return merged


def _card_name(keyword: str) -> str:
    return keyword if len(keyword) <= 8 and " " not in keyword else f"HIERARCH {keyword}"


def _camera(header: fits.Header) -> str | None:
    for key in _INSTRUMENT_KEYS:
        value = header.get(key)
        if isinstance(value, str):
            if name := _INSTRUMENTS.get(re.sub(r"[^a-z]", "", value.lower())):
                return name
            if "decam" in value.lower():
                return "decam"
    return None


def _parallactic_angle(header: fits.Header, file: Path) -> float | None:
    """Return the parallactic angle [rad], given, or from azimuth and altitude."""
    if "BORESIGHT_PAR_ANGLE_RAD" in header:
        return _finite(header, "BORESIGHT_PAR_ANGLE_RAD", file)
    for azimuth_key, altitude_key in _HORIZON_KEYS:
        if azimuth_key in header and altitude_key in header:
            azimuth, altitude = _finite(header, azimuth_key, file), _finite(header, altitude_key, file)
            if azimuth is not None and altitude is not None:
                latitude = _finite(header, "OBS-LAT", file) if "OBS-LAT" in header else None
                degrees = azimuth, altitude, _LATITUDE if latitude is None else latitude
                return parallactic_angle(*np.deg2rad(degrees))
    return None


def parallactic_angle(azimuth: float, altitude: float, latitude: float) -> float:
    """Return the position angle of the zenith, from north through east [rad].

    Parameters
    ----------
    azimuth, altitude, latitude : float
        Of the pointing, azimuth from north through east, and of the site [rad].
    """
    east = -np.sin(azimuth) * np.cos(latitude)
    north = np.sin(latitude) * np.cos(altitude) - np.cos(latitude) * np.sin(altitude) * np.cos(azimuth)
    return float(np.arctan2(east, north))


def _sky_rotation(header: fits.Header, file: Path) -> float | None:
    """Return the position angle of the images' +y [rad]."""
    if "BORESIGHT_ROT_ANGLE_RAD" in header:
        return _finite(header, "BORESIGHT_ROT_ANGLE_RAD", file)
    kind = str(header.get("ROTTYPE", header.get("ROTCOORD", "sky"))).strip().lower()
    for key in _ROTATION_KEYS:
        if key in header and kind == "sky" and (degrees := _finite(header, key, file)) is not None:
            return float(np.deg2rad(degrees))
    return None


def _band(header: fits.Header) -> tuple[str | None, float | None]:
    """Return name and mean wavelength [m] of the filter."""
    for key in ("BANDPASS", "FILTER", "FILTER1"):
        value = header.get(key)
        if not isinstance(value, str):
            continue
        if match := _DECAM_FILTER.match(value):
            return match[1].lower(), 1e-10 * float(match[2])
        if match := re.match(r"^\s*(?:SDSS)?([ugrizyUGRIZY])(?:_\w+|\d*)?(?:~.*)?\s*$", value):
            return match[1].lower(), None
    return None, None


def gain_of(header: fits.Header, file: Path) -> float | None:
    """Return electrons of a unit of an image, 1 for one in electrons; None where its header does not say.

    NaN for an image that is said to be in another unit, without a gain.
    """
    unit = str(header.get("BUNIT", "")).strip().lower()
    if unit in ("electron", "electrons", "e-", "e"):
        return 1.0
    keys = [key for key in ("GAIN", "GAINA", "GAINB") if key in header]
    values = [_number(header, key, file) for key in keys[:1] if key == "GAIN"] or [
        _number(header, key, file) for key in keys
    ]
    if not values:
        return float("nan") if unit else None
    gain = float(np.mean(values))
    if not (np.isfinite(gain) and gain > 0.0):
        raise ProductError(f"{keys[0]} = {header[keys[0]]!r}: expected electrons of a unit, above 0", file=file)
    return gain


def _finite(header: fits.Header, key: str, file: Path) -> float | None:
    """Return a number of a header; None for NaN, which ts_wep writes for what it does not know."""
    value = _number(header, key, file)
    return value if np.isfinite(value) else None


def _number(header: fits.Header, key: str, file: Path) -> float:
    value = header[key]
    if isinstance(value, str) and value.strip().lower() in ("", "nan", "none"):
        return float("nan")
    if isinstance(value, fits.card.Undefined) or value is None:
        return float("nan")
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ProductError(f"{key} = {value!r}: expected a number", file=file, key=key)
    return float(value)
