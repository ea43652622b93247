"""Planes of the masks of images in FITS files, whose cards MP_NAME number them as LSST and HSC do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .errors import ProductError, shown

#: Planes of pixels of a star that is too bright.
TOO_BRIGHT = frozenset({"SAT", "SATUR", "SATURATED", "SUSPECT"})
#: Planes of LSST and HSC that mark an area, an object or what has been corrected: such a pixel is as good as any. On
#: stacks CLIPPED, REJECTED and SENSOR_EDGE mark pixels that an image is left out of; INEXACT_PSF is all three.
HARMLESS = frozenset(
    {
        "BRIGHT_OBJECT",
        "CLIPPED",
        "CROSSTALK",
        "DETECTED",
        "DETECTED_NEGATIVE",
        "FAKE",
        "HIGH_VARIANCE",
        "INEXACT_PSF",
        "INJECTED",
        "INJECTED_CORE",
        "INJECTED_TEMPLATE",
        "NOT_DEBLENDED",
        "PARTLY_VIGNETTED",
        "REJECTED",
        "SENSOR_EDGE",
    }
)
# Start of the cards that name planes; their value is the number of the bit.
_CARD = "MP_"
# Bits of a mask of whole numbers of 64 bits, without that of the sign.
_MOST_BITS = 63
# Longest keyword of a card that is not of the kind HIERARCH.
_KEYWORD = 8


def planes_in(header: Mapping[str, Any], path: Path) -> dict[str, int]:
    """Return the numbers of the bits of a mask by the names of their planes; empty where a header names none.

    ProductError, of a file, for what is no number of a bit.
    """
    planes = {}
    for keyword in header:
        key = str(keyword).upper()
        if not key.startswith(_CARD):
            continue
        bit = header[keyword]
        if isinstance(bit, bool) or not isinstance(bit, int) or not 0 <= bit < _MOST_BITS:
            text = f"{key} = {shown(bit)}: expected the number of a bit of the mask, 0 to {_MOST_BITS - 1}"
            raise ProductError(text, file=path, key=key)
        planes[key[len(_CARD) :]] = bit
    return planes


def bits_of(planes: Mapping[str, int], names: Iterable[str]) -> np.int64:
    """Return the bits of those planes that have one of the names."""
    return np.int64(sum(1 << planes[name] for name in set(names) & planes.keys()))


def bad_bits(header: Mapping[str, Any], path: Path) -> np.int64:
    """Return the bits of pixels that are not used: of all planes but :data:`HARMLESS`; all where none are named."""
    planes = planes_in(header, path)
    return bits_of(planes, planes.keys() - HARMLESS) if planes else np.int64(-1)


def plane_card(name: str, bit: int) -> tuple[str, int, str]:
    """Return keyword, value and comment of the card of a plane with a bit of the mask."""
    keyword = f"{_CARD}{name}"
    return keyword if len(keyword) <= _KEYWORD else f"HIERARCH {keyword}", bit.bit_length() - 1, f"bit of {name}"
