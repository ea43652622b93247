"""Planes of noise and masks beside the images of FITS files: names of their extensions, by many programs."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Any


class NoiseKind(Enum):
    """What a plane of noise holds: inverse variance, variance, or rms."""

    WEIGHT = "weight"
    VARIANCE = "variance"
    RMS = "rms"


#: Names of extensions of noise. Of a drizzled image with errors and weights the former, which come first, have the
#: noise of photons in them, and its scale.
NOISE_NAMES: Mapping[str, NoiseKind] = {
    "VARIANCE": NoiseKind.VARIANCE,
    "VAR": NoiseKind.VARIANCE,
    "ERR": NoiseKind.RMS,
    "ERROR": NoiseKind.RMS,
    "RMS": NoiseKind.RMS,
    "SIGMA": NoiseKind.RMS,
    "STDDEV": NoiseKind.RMS,
    "UNCERT": NoiseKind.RMS,
    "WGT": NoiseKind.WEIGHT,
    "WEIGHT": NoiseKind.WEIGHT,
    "WHT": NoiseKind.WEIGHT,
    "WTMAP": NoiseKind.WEIGHT,
    "IVAR": NoiseKind.WEIGHT,
    "INVVAR": NoiseKind.WEIGHT,
}
#: Names of extensions of masks.
MASK_NAMES = ("MASK", "MSK", "DQ", "QUALITY", "FLAGS", "DQM", "BPM")
#: What the card UTYPE says of a plane of noise, in files of astropy's CCDData: its class.
_UNCERTAINTIES: Mapping[str, NoiseKind] = {
    "StdDevUncertainty": NoiseKind.RMS,
    "VarianceUncertainty": NoiseKind.VARIANCE,
    "InverseVariance": NoiseKind.WEIGHT,
}


def noise_kind(name: str, header: Mapping[str, Any]) -> NoiseKind | None:
    """Return what the plane of an extension holds, by its card UTYPE, else its name; None where it has no noise."""
    kind = NOISE_NAMES.get(name)
    return kind and _UNCERTAINTIES.get(str(header.get("UTYPE", "")).strip(), kind)
