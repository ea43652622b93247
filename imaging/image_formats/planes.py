"""Image, variance and mask of a file, by the convention of the pipeline that wrote it.

A reader of a convention says which parts of a file are images, and which lie beside each: LSST and HSC (IMAGE, MASK,
VARIANCE), DES (SCI, MSK, WGT), Euclid's VIS (3-4.E.SCI, 3-4.E.RMS, 3-4.E.FLG), and any other file, whose companions
have usual names or are files of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...core.errors import ProductError
from ...core.mask_planes import HARMLESS, TOO_BRIGHT, bits_of, planes_in
from ...core.noise_planes import MASK_NAMES, NOISE_NAMES, NoiseKind, noise_kind
from ...core.number_text import counted
from .fits_parts import FitsPart, FitsParts, beside

#: Bit of saturated pixels in DES's masks (Morganson et al. 2018, PASP 130, 074501).
_DES_SATURATED = 2
#: Bit of the haloes of bright stars there, which marks an area.
_DES_STAR = 32
#: Bit DO_NOT_USE of JWST's planes DQ. Others, such as JUMP_DET of a cosmic ray taken out of a ramp, say what was
#: corrected, and are set in most cores of bright stars.
_JWST_BAD = 1
#: Bit SATURATED there.
_JWST_SATURATED = 2

#: Ends of the names of Euclid's extensions: the pixels, their rms, their flags.
_EUCLID_IMAGE, _EUCLID_RMS, _EUCLID_FLAGS = ".SCI", ".RMS", ".FLG"
#: Bits of Euclid's flags of saturated pixels: SAT, SATURATEDSTAR, ADCMAX (its data product description, VIS flag map).
_EUCLID_SATURATED = 1 << 3 | 1 << 19 | 1 << 21
#: Bits of bad pixels there: INVALID, HOT, COLD, COSMIC, GHOST, BAD_COLUMN, BAD_CLUSTER, OVRCOL, CHARINJ, SATXTALKGHOST,
#: NO_DATA. Others mark an area or an object.
_EUCLID_BAD = sum(1 << bit for bit in (0, 1, 2, 4, 5, 7, 8, 12, 15, 17, 22))


class Defects(NamedTuple):
    """Pixels with defects, bool [ny, nx]."""

    saturated: np.ndarray
    bad: np.ndarray


@dataclass(frozen=True)
class PlaneNames:
    """Extensions of one image: the pixels, their noise, their mask; empty names where there are none."""

    image: FitsPart
    noise: FitsPart | None = None
    kind: NoiseKind = NoiseKind.WEIGHT
    mask: FitsPart | None = None


def planes_of(file: FitsParts, extension: str | None) -> list[PlaneNames]:
    """Return the images of a file, or the one in an extension, each with the planes beside it.

    Parameters
    ----------
    file : FitsParts
        The file.
    extension : str, optional
        Name or number of the extension.

    Raises
    ------
    ProductError
        If there is no image, or no such one.
    """
    noise, masks = file.named(*NOISE_NAMES), file.named(*MASK_NAMES)
    of_euclid = _euclid_planes(file)
    companions = {part.index for part in file.parts if part.name in NOISE_NAMES or part.name in MASK_NAMES}
    companions |= {part.index for planes in of_euclid.values() for part in (planes.noise, planes.mask) if part}
    images = [part for part in file.parts if part.is_image and part.index not in companions]
    if not images:
        raise ProductError("has no image of two axes", file=file.path)
    if extension is not None:
        names = ", ".join(map(file.label, images))
        named = [part for part in images if extension.upper() == part.name]
        images = [part for part in images if extension.upper() in (file.label(part), str(part.index))] or named
        if not images:
            raise ProductError(f"extension = {extension}: expected one of {names}", file=file.path, key="extension")
    if of_euclid:
        return [of_euclid[part.index] for part in images if part.index in of_euclid]
    if companions and len(images) > 1:
        # IMAGE or SCI is what the planes belong to; catalogues of LSST have small images of PSFs and transmissions.
        images = [part for part in images if part.name in ("IMAGE", "SCI")] or [
            part for part in images if part.image_shape == (noise or images)[0].image_shape
        ]
    kind = (noise and noise_kind(noise[0].name, noise[0].header)) or NoiseKind.WEIGHT
    return [PlaneNames(part, beside(part, noise), kind, beside(part, masks)) for part in images]


def _euclid_planes(file: FitsParts) -> dict[int, PlaneNames]:
    """Return the images of Euclid's VIS with their planes, by their numbers; none of another file."""
    by_name = {part.name: part for part in file.parts if part.is_image}
    stems = {
        part.index: part.name.removesuffix(_EUCLID_IMAGE)
        for part in by_name.values()
        if part.name.endswith(_EUCLID_IMAGE)
    }
    return {
        index: PlaneNames(
            file.parts[index],
            by_name.get(f"{stem}{_EUCLID_RMS}"),
            NoiseKind.RMS,
            by_name.get(f"{stem}{_EUCLID_FLAGS}"),
        )
        for index, stem in stems.items()
    }


def companion_in(path: Path, image: FitsPart) -> tuple[FitsParts, FitsPart]:
    """Return the plane of a file of its own that belongs to an image: that of its name, or the only one.

    Raises
    ------
    ProductError
        If there is none.
    """
    file = FitsParts.of(path)
    planes = [part for part in file.parts if part.is_image]
    same_name = [part for part in planes if part.name and part.name == image.name]
    if not same_name and len(planes) != 1:
        raise ProductError(
            f"has {counted(len(planes), 'image')}: expected one, or one called {image.name or 'as that of the image'}",
            file=path,
        )
    # The first one, where the file has no image of that version.
    return file, beside(image, same_name or planes) or same_name[0]


def defects_of(values: np.ndarray, part: FitsPart, path: Path) -> Defects:
    """Return the saturated and the bad pixels that a mask marks.

    Cards MP_NAME number the planes of LSST's and of this program's masks; extensions MSK have the bits of DES, those of
    Euclid and of JWST (DQ) their own. In any other mask pixels that are not zero are bad: codes of other pipelines
    change with their versions.

    Raises
    ------
    ProductError
        If the mask has no whole numbers.
    """
    if values.dtype.kind not in "iub":
        if not np.isfinite(values).all() or (values != np.rint(values)).any():
            raise ProductError(f"mask {part.name} has type {values.dtype}: expected whole numbers", file=path)
        values = values.astype(np.int64)
    planes = planes_in(part.header, path)
    if planes:
        bits = values.astype(np.int64)
        saturated = (bits & bits_of(planes, TOO_BRIGHT)) != 0
        return Defects(saturated, (bits & bits_of(planes, planes.keys() - HARMLESS - TOO_BRIGHT)) != 0)
    if part.name.endswith(_EUCLID_FLAGS):
        bits = values.astype(np.int64)
        return Defects((bits & _EUCLID_SATURATED) != 0, (bits & _EUCLID_BAD) != 0)
    if part.name == "MSK":
        bits = values.astype(np.int64)
        return Defects((bits & _DES_SATURATED) != 0, (bits & ~np.int64(_DES_SATURATED | _DES_STAR)) != 0)
    if part.name == "DQ" and str(part.header.get("TELESCOP")).strip() == "JWST":
        bits = values.astype(np.int64)
        return Defects((bits & _JWST_SATURATED) != 0, (bits & _JWST_BAD) != 0)
    return Defects(np.zeros(values.shape, dtype=bool), values != 0)
