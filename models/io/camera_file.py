"""Camera files in YAML: one CCD a line, in the frame of the focal plane.

A file names its source, and has a table of CCDs::

    name: my_camera
    source: where the numbers come from
    pixel_um: 15.0
    pixels: [2048, 4096]
    ccds:
      - {name: A1, x_mm: -16.9, y_mm: 0.0}
      - {name: A2, x_mm: 16.9, y_mm: 0.0, rotation_deg: 180, raft: A, dz_um: 12, rx_urad: 50}

docs/howto/camera.md has all keys.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ...core.errors import PachonError, PrescriptionError
from ...core.files import content_hash
from ...core.schema import Count, Fraction, NotNegative, Positive, Real, Section, Switch, validated
from ...core.yaml_reader import read_mapping
from ..camera.camera import Camera
from ..camera.photometry import (
    BANDS,
    DARK_CURRENT,
    FULL_WELL,
    LSST,
    READ_NOISE,
    THROUGHPUT,
    Band,
    BandName,
    CameraPhotometry,
)
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


class BandSection(Section):
    """One band, measured."""

    zero_point: Real
    dark_sky: Real
    extinction: NotNegative
    effective_nm: Positive

    def band(self, name: BandName, source: str) -> Band:
        """Return the band, its edges as far from its effective wavelength as those of the LSST's, in proportion."""
        wavelength, lsst = self.effective_nm / 1e9, BANDS[name]
        low, high = (end * wavelength / lsst.effective_wavelength for end in lsst.wavelength_range)
        return Band(name, self.zero_point, self.dark_sky, self.extinction, wavelength, (low, high), source=source)


class PhotometrySection(Section):
    """Zero points, sky and noise."""

    source: Text
    throughput: Fraction = THROUGHPUT
    read_noise_e: NotNegative = READ_NOISE
    dark_current_e_s: NotNegative = DARK_CURRENT
    full_well_e: Positive = FULL_WELL
    gain: Positive = 1.0
    area_m2: Positive | None = None
    bands: dict[BandName, BandSection] = Field(default_factory=dict)

    def photometry(self) -> CameraPhotometry:
        """Return the photometry of the camera."""
        if not self.throughput:
            raise PrescriptionError("photometry.throughput = 0: expected more than 0", key="photometry.throughput")
        if self.bands and self.area_m2 is None:
            text = "photometry.area_m2: expected the collecting area [m2] of the telescope that the bands are those of"
            raise PrescriptionError(text, key="photometry.area_m2")
        return CameraPhotometry(
            tuple(band.band(name, self.source) for name, band in self.bands.items()),
            self.area_m2 or 0.0,
            self.throughput,
            self.read_noise_e,
            self.dark_current_e_s,
            self.full_well_e,
            self.gain,
        )


class CameraFile(Section):
    """A camera file."""

    name: Text
    description: Text = ""
    source: Text
    license: Text = ""
    pixel_um: Positive
    pixels: Pixels | None = None
    photometry: Literal["lsst"] | PhotometrySection | None = None
    height_budget: Literal["simulated", "specification", "flat"] = "flat"
    transposed: Switch = False
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
            photometry=self._photometry(),
            height_budget=self.height_budget,
            transposed=self.transposed,
        )

    def _photometry(self) -> CameraPhotometry:
        if isinstance(self.photometry, PhotometrySection):
            return self.photometry.photometry()
        return LSST if self.photometry == "lsst" else CameraPhotometry()

    def _pixels_of(self, ccd: CcdSection) -> Any:
        ccd_pixels = self.pixels if ccd.pixels is None else ccd.pixels
        if ccd_pixels is None:
            key = f"ccds[{ccd.name}].pixels"
            raise PrescriptionError(f"{key}: expected [NX, NY], there or for all CCDs as pixels", key=key)
        return ccd_pixels

    def _vendors(self) -> tuple[str, ...]:
        named = [ccd.name for ccd in self.ccds if ccd.vendor is not None]
        for ccd in self.ccds:
            if named and ccd.vendor is None:
                key = f"ccds[{ccd.name}].vendor"
                raise PrescriptionError(f"{key}: expected a text, as {named[0]} has one", key=key)
        return tuple(str(ccd.vendor) for ccd in self.ccds) if named else ()


def is_camera_file(path: Path) -> bool:
    """Return whether a YAML file is of a camera, whole or not; PrescriptionError where it cannot be read."""
    return is_camera(read_mapping(path))


def is_camera(content: dict[str, Any]) -> bool:
    """Return whether the content of a file has pixels or CCDs of a camera; configurations name CCDs by texts."""
    ccds = content.get("ccds")
    has_ccds = isinstance(ccds, list) and any(isinstance(ccd, dict) for ccd in ccds)
    return has_ccds or not {"pixel_um", "pixels"}.isdisjoint(content)


def read_camera(path: Path) -> Camera:
    """Read a camera file; PrescriptionError of one line with file, key, value and what was expected."""
    return _read(path, content_hash(path, PrescriptionError))


@lru_cache(maxsize=16)
def _read(path: Path, content: str) -> Camera:
    """Return the camera of a file of a content; kept, so that all points of a sweep share one."""
    del content
    file = validated(CameraFile, read_mapping(path), str(path), PrescriptionError)
    try:
        return file.camera()
    except PachonError as error:
        raise PrescriptionError(error.problem, file=path, key=error.key) from None
