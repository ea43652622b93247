"""Stamps of files as the fit of donuts takes them: planes, angles and places from headers and options."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import remainder, tau
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import ConfigError, ProductError
from .completion import YAML

if TYPE_CHECKING:
    import numpy as np

    from ..models.telescope import Telescope
    from ..sensing.frames import DonutFrames
    from ..sensing.stamp_files import DonutStamps
    from ..sensing.stamp_headers import HeaderValues
    from .donut_options import FrameOptions

#: Body that each camera's telescope moves out of focus.
_MOVED = {"lsst": "Camera", "comcam": "Camera", "auxtel": "M2", "decam": "DECam"}
#: Names of detectors that stand out of focus themselves: LSST's corner sensors and DECam's focus chips.
_OUT_OF_FOCUS = re.compile(r"\w+_SW\d|F[NS]\d")
#: Difference of angles of two exposures in a row, on both sides of focus: a rotator follows the sky. 1.1 degrees take
#: 4 % of an astigmatism for the other one [rad].
_SAME_ANGLE = 0.02


@dataclass(frozen=True)
class StampFiles:
    """Contents of files of stamps.

    Attributes
    ----------
    paths : sequence of Path
        The files.
    stamps : sequence of DonutStamps
        Stamps of each.
    """

    paths: Sequence[Path]
    stamps: Sequence[DonutStamps]

    @classmethod
    def read(
        cls, paths: Sequence[Path], positions: Path | None, size: int, mask: Path | None, variance: Path | None
    ) -> StampFiles:
        """Read files; ConfigError where a plane of its own goes with several of them."""
        from ..sensing.stamp_files import read_stamps

        for path in paths:
            if path.suffix.lower() in YAML:
                text = "expected FITS files of stamps; a telescope is --telescope, and its camera stands in its file"
                raise ConfigError(text, file=path)
        for option, plane in (("--mask", mask), ("--variance", variance)):
            if plane is not None and len(paths) > 1:
                raise ConfigError(f"{option} = {plane} for {len(paths)} files: expected one file of stamps with it")
        resolved: set[Path] = set()
        for path in paths:
            if path.resolve() in resolved:
                raise ConfigError("given twice: its donuts would count as two exposures", file=path)
            resolved.add(path.resolve())
        return cls(paths, [read_stamps(path, positions, size, mask=mask, variance=variance) for path in paths])

    def header(self) -> HeaderValues:
        """Return what the headers say; ProductError where files are of different cameras or angles."""
        import numpy as np

        first = self.stamps[0].header
        for path, stamps in zip(self.paths, self.stamps, strict=True):
            header = stamps.header
            angles = [(v.rotator, v.parallactic_angle) for v in (first, header)]
            same = all(
                (a is None) == (b is None) and (a is None or b is None or abs(remainder(a - b, tau)) < _SAME_ANGLE)
                for a, b in zip(*angles, strict=True)
            )
            instrument = [(h.camera, h.band, h.telescope, h.pixel) for h in (first, header)]
            if instrument[0] != instrument[1] or not same:
                text = f"{header.text or 'no header'}: expected that of {self.paths[0]}, {first.text or 'no header'}"
                raise ProductError(f"{text}; give files of one pointing", file=path)
            if not (first.wavelength is None or np.isclose(first.wavelength, header.wavelength or 0.0)):
                raise ProductError("filter: expected that of the other files", file=path)
        return first

    def moved(self) -> str | None:
        """Return the body that moves: the one that the files name, or that of their camera; None where it is not known.

        LSST's corner detectors and DECam's focus chips stand out of focus, as moved detectors.
        """
        from ..sensing.stamp_files import one_body

        named = one_body([stamps.moved or "" for stamps in self.stamps], self.paths[-1])
        detectors = [str(name) for stamps in self.stamps for name in stamps.detectors]
        if named is not None or any(_OUT_OF_FOCUS.fullmatch(name) for name in detectors):
            return named
        return _MOVED.get(self.stamps[0].header.camera or "")


@dataclass(frozen=True)
class DonutInputs:
    """Stamps as the fit takes them.

    Attributes
    ----------
    images, masks : list of ndarray
        Stamps [electrons] along the axes of the camera, and pixels to leave out.
    fields : ndarray, shape [n, 2]
        Field angles in the telescope frame [rad].
    defocus : ndarray, shape [n]
        Shifts of what was moved for the exposure [m].
    heights : ndarray, shape [n]
        Distances behind the focus of sensors that stand out of it, such as LSSTCam's corner sensors [m].
    variances : list of float or None
        Variance of sky and readout [electron^2] of variance planes; None where there is none.
    axes : list of ndarray
        Axes of the stamps of the files in the frame of the camera.
    """

    images: list[np.ndarray]
    masks: list[np.ndarray]
    fields: np.ndarray
    defocus: np.ndarray
    heights: np.ndarray
    variances: list[float | None]
    axes: list[np.ndarray]


def donut_inputs(
    files: StampFiles,
    options: FrameOptions,
    frames: DonutFrames,
    telescope: Telescope,
    gain: float | None,
    field: np.ndarray | None,
) -> DonutInputs:
    """Return the stamps of files for a telescope with its camera at the angle of the rotator.

    Files without field angles have one that is given [rad]; gains are those of the images' headers unless one is given.
    """
    import numpy as np

    from ..sensing.frames import along_camera, stamp_matrix
    from ..sensing.stamp_files import sky_of_variance
    from ..sensing.stamp_places import on_camera, stamp_places

    images, masks, variances, axes = [], [], [], []
    fields, defocus, heights = [], [], []
    for path, stamps in zip(files.paths, files.stamps, strict=True):
        places = stamp_places(stamps, telescope, path, options.field_projection) if on_camera(stamps) else None
        if places is not None and stamps.fields is None:
            fields.append(places.fields)
        else:
            fields.append(_fields(path, stamps, options, frames, field))
        nominal = np.zeros(len(stamps)) if places is None else places.heights
        lacking = np.flatnonzero(~stamps.has_defocus & (nominal == 0.0))
        if stamps.has_defocus.any() and lacking.size:
            text = f"stamp {lacking[0] + 1} has no defocus, others have one: expected it of all"
            raise ProductError(text, file=path, key="defocus_um")
        # Of a sensor that stands out of focus files say how far: nothing was moved.
        heights.append(np.where((nominal != 0.0) & stamps.has_defocus, stamps.defocus, nominal))
        defocus.append(np.where(nominal != 0.0, 0.0, stamps.defocus))
        for k, (image, mask) in enumerate(zip(stamps.images, stamps.masks, strict=True)):
            if places is None or options.stamp_axes is not None:
                matrix = stamp_matrix(frames.stamp_axes)
            else:
                matrix = places.axes[k]
            stated = (stamps.gains[k] or stamps.header.gain or 1.0) if gain is None else gain
            # Of images in another unit the variance says nothing of the light's own noise: all of it is measured.
            is_known = bool(np.isfinite(stated))
            electrons = stated if is_known else 1.0
            images.append(along_camera(electrons * image, matrix))
            masks.append(along_camera(mask, matrix))
            axes.append(matrix)
            plane = None if stamps.variances is None or not is_known else sky_of_variance(stamps.variances[k], mask)
            variances.append(None if plane is None else electrons**2 * plane)
    return DonutInputs(
        images, masks, np.concatenate(fields), np.concatenate(defocus), np.concatenate(heights), variances, axes
    )


def _fields(
    path: Path, stamps: DonutStamps, options: FrameOptions, frames: DonutFrames, field: np.ndarray | None
) -> np.ndarray:
    """Return field angles in the telescope frame: those of the file, or the one given for all stamps."""
    import numpy as np

    angles = stamps.fields
    if angles is None:
        if field is None:
            text = "no field angles: expected FIELD_X and FIELD_Y, a table with them, or --field-deg"
            raise ConfigError(text, file=path)
        angles = np.tile(field, (len(stamps), 1))
    return frames.fields_of_telescope(angles, options.names[0], projection=options.field_projection)
