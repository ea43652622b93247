"""Camera files in YAML: one CCD a line, in the frame of the focal plane.

A file names its source, and has a table of CCDs::

    name: my_camera
    source: where the numbers come from
    pixel_um: 15.0
    pixels: [2048, 4096]
    ccds:
      - {name: A1, x_mm: -16.9, y_mm: 0.0}
      - {name: A2, x_mm: 16.9, y_mm: 0.0, rotation_deg: 180, raft: A, dz_um: 12, rx_urad: 50}

docs/camera.md has all keys.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ...core.errors import PachonError, PrescriptionError
from ...core.files import read_bytes
from ...core.schema import Count, Positive, Real, Section, validated
from ...core.yaml_reader import read_mapping
from ..camera.camera import Camera
from .yaml.values import ROWS, OptionalText, Text

#: Pixels along x and y of a CCD.
Pixels = tuple[Count, Count]


class CcdSection(Section):
    """One CCD."""

    name: Text
    x_mm: Real
    y_mm: Real
    rotation_deg: Real = 0.0
    pixels: Pixels | None = None
    raft: OptionalText = None
    vendor: OptionalText = None
    dz_um: Real = 0.0
    rx_urad: Real = 0.0
    ry_urad: Real = 0.0


class CameraFile(Section):
    """A camera file."""

    name: Text
    description: Text = ""
    source: Text
    license: Text = ""
    pixel_um: Positive
    pixels: Pixels | None = None
    ccds: Annotated[tuple[CcdSection, ...], ROWS, Field(min_length=1)]

    def camera(self) -> Camera:
        """Return the camera."""
        rafts = tuple(dict.fromkeys(ccd.raft for ccd in self.ccds if ccd.raft is not None))
        placement = np.array([(c.dz_um, c.rx_urad, c.ry_urad) for c in self.ccds]) / 1e6
        return Camera(
            name=self.name,
            ccd_names=tuple(ccd.name for ccd in self.ccds),
            raft_names=rafts,
            raft_index=np.array([-1 if ccd.raft is None else rafts.index(ccd.raft) for ccd in self.ccds]),
            centers=np.array([(ccd.x_mm, ccd.y_mm) for ccd in self.ccds]) / 1e3,
            pixels=np.array([self._pixels_of(ccd) for ccd in self.ccds]),
            pixel_size=self.pixel_um / 1e6,
            vendors=self._vendors(),
            rotation_deg=np.array([ccd.rotation_deg for ccd in self.ccds]),
            placement=placement if placement.any() else None,
        )

    def _pixels_of(self, ccd: CcdSection) -> Any:
        found = self.pixels if ccd.pixels is None else ccd.pixels
        if found is None:
            key = f"ccds[{ccd.name}].pixels"
            raise PrescriptionError(f"{key}: expected [NX, NY], there or for all CCDs as pixels", key=key)
        return found

    def _vendors(self) -> tuple[str, ...]:
        named = [ccd.name for ccd in self.ccds if ccd.vendor is not None]
        for ccd in self.ccds:
            if named and ccd.vendor is None:
                key = f"ccds[{ccd.name}].vendor"
                raise PrescriptionError(f"{key}: expected a text, as {named[0]} has one", key=key)
        return tuple(str(ccd.vendor) for ccd in self.ccds) if named else ()


def is_camera_file(path: Path) -> bool:
    """Return whether a YAML file has the pixels of a camera; PrescriptionError where it cannot be read."""
    return "pixel_um" in read_mapping(path)


def read_camera(path: Path) -> Camera:
    """Read a camera file; PrescriptionError of one line with file, key, value and what was expected."""
    return _read(path, hashlib.sha256(read_bytes(path, PrescriptionError)).hexdigest())


@lru_cache(maxsize=16)
def _read(path: Path, content: str) -> Camera:
    """Return the camera of a file of a content; kept, so that all points of a sweep share one."""
    del content
    file = validated(CameraFile, read_mapping(path), str(path), PrescriptionError)
    try:
        return file.camera()
    except PachonError as error:
        raise PrescriptionError(error.problem, file=path, key=error.key) from None
