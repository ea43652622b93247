"""World coordinates of an image of any program: TAN, SIP, TPV, SCAMP's PV, TNX and ZPX, as astropy reads them."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from ...core.errors import ProductError, cut_short, shown

#: Cards of world coordinates, of the image itself and not of alternatives to it.
_CARDS = re.compile(
    r"(WCSAXES|CTYPE[12]|CUNIT[12]|CRVAL[12]|CRPIX[12]|CDELT[12]|CROTA[12]|CD[12]_[12]|PC[12]_[12]|PC00[12]00[12]"
    r"|PV[12]_\d+|WAT[012]_\d+|(A|B|AP|BP)_(ORDER|DMAX|\d+_\d+)|RADEC?SYS|EQUINOX|EPOCH|LONPOLE|LATPOLE)"
)
#: Cards whose numbers must be finite.
_NUMBERS = re.compile(r"(CRVAL|CRPIX|CDELT|CROTA|CD|PC|PV|A_|B_|AP_|BP_|EQUINOX|LONPOLE|LATPOLE)")
#: Systems of right ascension and declination; astropy has no frame for others, such as GAPPT.
_SYSTEMS = ("ICRS", "FK5", "FK4", "FK4-NO-E")
#: Largest determinant over the product of the sides of a pixel that still counts as none.
_FLAT = 1e-8


def world_cards(header: fits.Header, shape: tuple[int, int], path: Path) -> fits.Header | None:
    """Return the cards of the celestial world coordinates of an image; None where there are none.

    Raises
    ------
    ProductError
        If a number is none, or the coordinates are singular, not finite on the image, or of an unknown projection or
        system.
    """
    cards = fits.Header()
    kinds = [str(header.get(f"CTYPE{axis}", "")).strip().upper() for axis in (1, 2)]
    if not any(kind.startswith(("RA", "GLON")) for kind in kinds):
        return None
    for card in header.cards:
        if card.keyword == "EPOCH" and not _is_equinox(header, path):
            continue
        if card.keyword and _CARDS.fullmatch(card.keyword) and card.keyword not in cards:
            cards[card.keyword] = _value(header, card.keyword, path)
    if "WCSAXES" in cards:  # others, as of frequencies, have no cards here
        cards["WCSAXES"] = 2
    for key in ("RADESYS", "RADECSYS"):
        if system := str(cards.get(key, "")).strip().upper():
            if system not in _SYSTEMS:
                expected = f"{', '.join(_SYSTEMS[:-1])} or {_SYSTEMS[-1]}"
                raise ProductError(f"{key} = {cards[key]}: expected {expected}", file=path, key=key)
            cards[key] = system
    # wcslib takes the numbers of a projection as degrees where a header of an early IRAF has no unit.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            wcs = WCS(cards)
            scale = np.abs(np.linalg.det(wcs.pixel_scale_matrix))
            corners = [(0, 0), (shape[1] - 1, 0), (0, shape[0] - 1), (shape[1] - 1, shape[0] - 1)]
            sky = np.asarray(wcs.all_pix2world(np.array(corners, dtype=float), 0))
        except Exception as error:  # wcslib raises many kinds
            # wcslib begins with the line of its source.
            reason = cut_short(re.sub(r"^ERROR \d+ in .*?: ", "", " ".join(str(error).split())), 120)
            raise ProductError(
                f"CTYPE1 = {kinds[0]}: expected world coordinates that astropy reads ({reason})",
                file=path,
                key="CTYPE1",
            ) from None
    sides = np.prod(np.hypot(*wcs.pixel_scale_matrix))
    # wcslib puts a one in the place of a column of zeros, and takes a matrix of zeros for none.
    matrix = np.array([[float(cards.get(f"CD{i}_{j}", 0.0)) for j in (1, 2)] for i in (1, 2)])
    singular = any(key.startswith("CD") and key[2].isdigit() for key in cards) and not np.linalg.det(matrix)
    if singular or not (np.isfinite(scale) and scale > _FLAT * sides > 0.0):
        raise ProductError("CD1_1, CD1_2, CD2_1, CD2_2: expected a matrix with an inverse", file=path, key="CD1_1")
    if not wcs.has_celestial or not np.isfinite(sky).all():
        raise ProductError(
            f"CTYPE1 = {kinds[0]}, CTYPE2 = {kinds[1]}: expected world coordinates that reach the corners of the image",
            file=path,
            key="CTYPE1",
        )
    return cards


def _is_equinox(header: fits.Header, path: Path) -> bool:
    """Return whether EPOCH is the equinox of the coordinates, as in headers before EQUINOX."""
    return "EQUINOX" not in header and isinstance(_value(header, "EPOCH", path), (int, float))


def _value(header: fits.Header, key: str, path: Path) -> object:
    """Return the value of a card; ProductError where it is no number, and should be one."""
    try:
        value = header[key]
    except Exception as error:  # astropy raises its own errors for a card that it cannot parse
        raise ProductError(
            f"{key}: expected a FITS value ({' '.join(str(error).split())})", file=path, key=key
        ) from None
    if not _NUMBERS.match(key):
        return value
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise ProductError(f"{key} = {shown(value)}: expected a finite number", file=path, key=key)
    return value if isinstance(value, (int, float)) else number
