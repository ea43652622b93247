"""PSF models of images, of whatever program: read from a file, and drawn at pixels of an image."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy import units as u

from ..core.errors import DomainError, PachonError, ProductError
from ..measure.catalogue.star_locus import stamp_side
from ..measure.shapes import half_light_radii
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from ..reconstruction.piff.psf import PiffPsf, load_piff
from ..reconstruction.psf_model.model import PsfModel
from ..reconstruction.psfex import PsfexPsf, load_psfex
from .image_file import CcdImage

#: Kinds of models that images are measured with.
ImagePsf = PsfModel | FocalPlanePsf | PiffPsf | PsfexPsf
#: Side of a stamp on which the half-light radius of a model is measured [pixel].
_WIDE_SIDE = 63
#: Readers of files, by the kind that they read.
_READERS: dict[str, Callable[[Path], ImagePsf]] = {
    "PsfModel": PsfModel.read,
    "FocalPlanePsf": FocalPlanePsf.read,
    "Piff": load_piff,
    "PSFEx": load_psfex,
}


def load_image_psf(path: Path) -> ImagePsf:
    """Read a PSF model: one of this program, of a CCD or of the focal plane, of Piff, or of PSFEx.

    Raises
    ------
    ProductError
        If the file is missing, or none of these; of one that is damaged, the reason of the reader that came furthest.
    """
    reasons = {}
    for name, read in _READERS.items():
        try:
            return read(path)
        except ProductError as error:
            reasons[name] = error.problem
            if "no such file" in error.problem or "cannot be read" in error.problem:
                raise
    reason = "; ".join(f"{name}: {problem}" for name, problem in reasons.items())
    raise ProductError(f"no PSF model ({reason})", file=path)


def psfs_on(
    image: CcdImage, psf: ImagePsf, places: np.ndarray, threads: int | None, colour: np.ndarray | float | None = None
) -> np.ndarray:
    """Return PSF images of unit sum at pixels (x, y) of an image, the first one's centre at (0, 0), [n, m, m].

    They are for colours [n], or one, where the model depends on them: one of a CCD, or Piff's with one property.

    Raises
    ------
    DomainError
        If the model has no such CCD, or needs properties that the image has not, such as colours.
    """
    try:
        if isinstance(psf, PsfModel):
            stamps = psf.at(places, colour=colour)
        elif isinstance(psf, FocalPlanePsf):
            # Centroids at the rim may lie outside by a part of a pixel.
            inside = np.clip(places, -0.5, np.array(image.image.shape[::-1]) - 0.5)
            stamps = psf.draw(image.name, *(image.pixels_of_ccd(inside).T * u.pix), threads=threads)
        elif isinstance(psf, PiffPsf):
            chip = _chip_of(image, psf)
            properties = _properties_of(psf, colour, len(places))
            first = None if properties is None else {key: values[:1] for key, values in properties.items()}
            wide = psf.at(places[:1] + 1.0, chip=chip, size=_WIDE_SIDE, properties=first)
            side = stamp_side(half_light_radii(wide)[0])
            stamps = psf.at(places + 1.0, chip=chip, size=side, properties=properties)
        else:
            wide = psf.at(places[:1] + 1.0, size=_WIDE_SIDE)
            stamps = psf.at(places + 1.0, size=stamp_side(half_light_radii(wide)[0]))
    except PachonError as error:
        raise error.within(subject=f"PSF model of {image.name}") from None
    total = stamps.sum(axis=(1, 2), keepdims=True)
    if not (np.isfinite(total) & (total > 0.0)).all():
        raise DomainError(
            f"PSF model of {image.name}: expected positive flux at all objects, such as of a model of this image"
        )
    return np.asarray(stamps / total)


def _properties_of(psf: PiffPsf, colour: np.ndarray | float | None, count: int) -> dict[str, np.ndarray] | None:
    """Return colours of objects as the one property of a model of Piff, unknown ones as the mean of the others."""
    if colour is None or len(psf.property_names) != 1:
        return None
    values = np.broadcast_to(np.asarray(colour, dtype=np.float64), (count,))
    known_values = values[np.isfinite(values)]
    if not len(known_values):
        return None
    return {psf.property_names[0]: np.where(np.isfinite(values), values, known_values.mean())}


def _chip_of(image: CcdImage, psf: PiffPsf) -> int | None:
    """Return the number of the chip of an image in a model of many chips; None in a model of one."""
    return None if len(psf.chips) == 1 else image.header.get("CCDNUM")
