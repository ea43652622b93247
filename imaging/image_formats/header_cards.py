"""Gain, zero point, saturation, band and exposure time in headers, by the keywords of many observatories."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from astropy.io import fits

from ...core.errors import ProductError, shown

#: Electrons in an ADU. ESO's GAIN is the inverse of its CONAD.
GAIN_KEYS = ("ESO DET OUT1 CONAD", "EGAIN", "GAIN", "GAINEFF", "CCDGAIN", "ATODGAIN", "EFFGAIN")
#: Gains of the amplifiers of a CCD, whose mean counts.
AMPLIFIER_GAINS = ("GAINA", "GAINB", "GAIN1", "GAIN2", "GAIN3", "GAIN4")
#: Magnitude of one unit of the image.
ZERO_POINT_KEYS = (
    "ZEROPNT", "MAGZERO", "MAGZPT", "MAGZP", "MAG_ZERO", "MAGZEROP", "SEXMGZPT", "PHOTZP", "ZPAB", "ZP", "ZEROPOINT",
    "MAG0", "PHOT_ZP",
)  # fmt: skip
#: Flux of magnitude zero in units of the image, of the LSST pipelines.
FLUX_OF_MAGNITUDE_ZERO = "FLUXMAG0"
#: Level of saturated pixels.
SATURATION_KEYS = ("SATURATE", "SATURATA", "SATURATB", "SATURATN", "SATLEVEL", "SATUR", "SATURVAL", "MAXLIN")
BAND_KEYS = ("FILTER", "BAND", "FILTNAM", "FILTER1", "FILTNAME", "INSFILTE")
EXPOSURE_KEYS = ("EXPTIME", "TEXPTIME", "EXPOSURE", "EXPTOT", "ITIME")
#: Keywords of the number of a CCD.
CHIP_KEYS = ("CCDNUM", "DET-ID", "IMAGEID", "CHIP")
#: Zero points of AB magnitudes by the unit of an image.
UNIT_ZERO_POINTS = {"nJy": 31.4, "uJy": 23.9, "Jy": 8.9, "nanomaggy": 22.5, "nmgy": 22.5, "maggy": 0.0}
#: Units of electrons; per second where the exposure time is to be multiplied.
_ELECTRONS = re.compile(r"^(electrons?|e-?|photoelectrons?)\b", re.IGNORECASE)
_PER_SECOND = re.compile(r"(/\s*s(ec(ond)?s?)?$|\bs(ec)?\s*(\^|\*\*)?-1$)", re.IGNORECASE)


class Sourced(NamedTuple):
    """A number and where it came from."""

    value: float
    source: str


@dataclass(frozen=True, eq=False)
class HeaderCards:
    """Cards of the header of an image; errors name its file and the keyword."""

    header: fits.Header
    path: Path

    def number(self, keys: Sequence[str], *, positive: bool = True) -> Sourced | None:
        """Return the first number among keywords, or None; ProductError for a text, NaN, or one that must be above 0.

        Zero stands for an unknown one in many headers, so it counts as absent where numbers must be positive.
        """
        for key in keys:
            value = self._value(key)
            if value is None or value == "" or (positive and value == 0):
                continue
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise ProductError(f"{key} = {shown(value)}: expected a finite number", file=self.path, key=key)
            if positive and value < 0.0:
                raise ProductError(f"{key} = {shown(value)}: expected a number above 0", file=self.path, key=key)
            return Sourced(float(value), key)
        return None

    def text(self, keys: Sequence[str]) -> str | None:
        """Return the first text or number among keywords that is not empty, as a text."""
        texts = (str(value).strip() for key in keys if (value := self._value(key)) is not None)
        return next((text for text in texts if text), None)

    def _value(self, key: str) -> object:
        if key not in self.header:
            return None
        try:
            value = self.header[key]
        except Exception as error:  # astropy raises its own errors for a card that it cannot parse
            raise ProductError(
                f"{key}: expected a FITS value ({' '.join(str(error).split())})", file=self.path, key=key
            ) from None
        if isinstance(value, fits.card.Undefined):
            return None
        if isinstance(value, str):
            try:
                return float(value.strip())
            except ValueError:
                return value.strip()
        return value

    def gain(self) -> Sourced | None:
        """Return the electrons in a unit of the image, or None where no card has it."""
        unit = self.text(("BUNIT",)) or ""
        per_second = bool(_PER_SECOND.search(unit))
        if _ELECTRONS.match(unit):
            gain: Sourced | None = Sourced(1.0, f"BUNIT {unit}")
        elif unit in UNIT_ZERO_POINTS:
            # A gain of the camera is none of calibrated pixels.
            return None
        else:
            gain = self.number(GAIN_KEYS)
            amplifiers = [sourced for key in AMPLIFIER_GAINS if (sourced := self.number((key,))) is not None]
            if gain is None and amplifiers:
                gain = Sourced(
                    float(np.mean([gain.value for gain in amplifiers])), ", ".join(gain.source for gain in amplifiers)
                )
        if gain is None or not per_second:
            return gain
        time = self.exposure_time()
        return None if time is None else Sourced(gain.value * time.value, f"{gain.source} times {time.source}")

    def zero_point(self) -> Sourced | None:
        """Return the magnitude of one unit of the image, or None where no card has it."""
        if (flux := self.number((FLUX_OF_MAGNITUDE_ZERO,))) is not None:
            return Sourced(2.5 * math.log10(flux.value), flux.source)
        unit = self.text(("BUNIT",)) or ""
        if unit in UNIT_ZERO_POINTS:
            return Sourced(UNIT_ZERO_POINTS[unit], f"BUNIT {unit}")
        return self.number(ZERO_POINT_KEYS)

    def saturation(self) -> Sourced | None:
        """Return the least level of saturated pixels [unit of the image], or None where no card has it."""
        levels = [level for key in SATURATION_KEYS if (level := self.number((key,))) is not None]
        return min(levels, default=None)

    def exposure_time(self) -> Sourced | None:
        """Return the exposure time [s], or None where no card has it."""
        return self.number(EXPOSURE_KEYS)
