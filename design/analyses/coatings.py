"""Coatings of surfaces and absorption of glasses, as tables against the wavelength, and their file.

::

    coatings:
      silver: {wavelength_nm: [400, 600, 1000], efficiency: [0.93, 0.97, 0.98]}
      broadband: {file: ar_coating.csv}
      dichroic: {wavelength_nm: [400, 700], angle_deg: [0, 30, 60], efficiency: [[0.99, 0.98, 0.9], [0.98, 0.97, 0.9]]}
      mgf2: {layers: [{index: 1.38, thickness_nm: 99.6}]}
    surfaces: {M1: silver, M2: silver, L1_entrance: broadband, L1_exit: broadband}
    glasses:
      silica: {thickness_mm: 25, wavelength_nm: [350, 1000], efficiency: [0.995, 0.999]}

The efficiency is the reflectivity of a mirror, the transmission of a lens surface, the quantum efficiency of the
detector, or the internal transmission of a thickness of a glass; between wavelengths, and angles of incidence from the
normal on the side of lower index, it is interpolated linearly. Layers are films without absorption on a lens surface,
from the side of lower index to the glass (:mod:`~pachon.models.layer_stack`). A
file is text of two columns, wavelength [nm] and efficiency, with commas or spaces; its path is relative to this file.
Glasses have the names that they have in the prescription.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, error_context
from ...core.files import read_bytes, text_lines
from ...core.schema import Section, either, expected, one_of
from ...core.schema import validated as validated_file
from ...core.units import metres
from ...core.yaml_reader import read_mapping
from ...models.coating import AnyCoating, Coating
from ...models.io.yaml.coatings import CoatingSection
from ...models.io.yaml.values import Numbers, OptionalText, PositiveNumber, Text
from ...models.telescope import Telescope


@check_arguments
@dataclass(frozen=True)
class Absorption:
    """Internal transmission of a glass.

    Parameters
    ----------
    transmission : Coating
        Internal transmission of the thickness against the wavelength.
    thickness : float
        Thickness of the glass that was measured [m].
    """

    transmission: Coating
    thickness: float

    def __post_init__(self) -> None:
        if not 0 < self.thickness < np.inf:
            raise ConfigError(f"thickness = {self.thickness!r} m: expected a positive length")

    def through(self, path: ArrayLike, wavelength: float) -> np.ndarray:
        """Return the internal transmission of paths [m] at a wavelength [m]."""
        return np.asarray(self.transmission.at(wavelength) ** (metres(path, "path") / self.thickness))


@check_arguments
@dataclass(frozen=True)
class Coatings:
    """Coatings by name of the surface, and absorption by name of the glass.

    Parameters
    ----------
    surfaces : mapping of str to Coating, CoatingTable or LayerStack
        Coatings of mirrors, lens surfaces and the detector; of several surfaces one may be the same. Layers are those
        of lens surfaces.
    glasses : mapping of str to Absorption
        Internal transmission of glasses.
    """

    surfaces: Mapping[str, AnyCoating] = field(default_factory=dict)
    glasses: Mapping[str, Absorption] = field(default_factory=dict)

    @classmethod
    def of(cls, telescope: Telescope, given: Coatings | str | os.PathLike[str] | None = None) -> Coatings:
        """Return the coatings of the surfaces of a telescope, in their place those that are given, or of a file."""
        overrides = given if isinstance(given, Coatings) else cls() if given is None else cls.read(given)
        prescribed = {s.name: s.coating for s in telescope.surfaces if s.coating is not None}
        return cls({**prescribed, **overrides.surfaces}, overrides.glasses)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Coatings:
        """Read a file of coatings, YAML.

        Raises
        ------
        ConfigError
            If it cannot be read or is malformed: one line with file, key, value and what was expected.
        """
        source = Path(path)
        content = validated_file(CoatingsFile, read_mapping(source, ConfigError), str(source), ConfigError)
        with error_context(file=source):
            return content.coatings(source.parent)


class _TableSection(Section):
    """Efficiency against the wavelength, here or in a file."""

    wavelength_nm: Numbers = ()
    efficiency: Numbers = ()
    file: OptionalText = None

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:
        either(content, "file", ("wavelength_nm", "efficiency"))

    def coating(self, name: str, folder: Path) -> Coating:
        """Return the coating; paths of files start from the folder."""
        return _plain(self.wavelength_nm, self.efficiency, self.file, name, folder)


class _GlassSection(_TableSection):
    """Internal transmission of a thickness of a glass."""

    thickness_mm: PositiveNumber


class _CoatingSection(CoatingSection):
    """Coating as in prescriptions, or its table in a file."""

    file: OptionalText = None

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:
        if "file" not in content or "layers" in content:
            super().check(content)
            return
        either(content, "file", ("wavelength_nm", "efficiency"))
        if "angle_deg" in content:
            raise expected("file or angle_deg, not both", "angle_deg")

    def coating_in(self, name: str, folder: Path) -> AnyCoating:
        """Return the coating; paths of files start from the folder."""
        return self.coating(name) if self.file is None else _plain((), (), self.file, name, folder)


class CoatingsFile(Section):
    """A file of coatings."""

    coatings_: Annotated[dict[str, _CoatingSection], Field(alias="coatings", default_factory=dict)]
    surfaces: dict[str, Text] = Field(default_factory=dict)
    glasses: dict[str, _GlassSection] = Field(default_factory=dict)

    def coatings(self, folder: Path) -> Coatings:
        """Return the coatings; paths of files start from the folder."""
        named_coatings: dict[str, AnyCoating] = {}
        glasses = {}
        for name, table in self.coatings_.items():
            with error_context(key=f"coatings.{name}"):
                named_coatings[name] = table.coating_in(name, folder)
        for surface, name in self.surfaces.items():
            if name not in named_coatings:
                raise ConfigError(f"surfaces.{surface} = {name!r}: expected {one_of(named_coatings, name)}")
        for name, glass in self.glasses.items():
            with error_context(key=f"glasses.{name}"):
                glasses[name] = Absorption(glass.coating(name, folder), 1e-3 * glass.thickness_mm)
        return Coatings({surface: named_coatings[name] for surface, name in self.surfaces.items()}, glasses)


def _plain(waves: tuple[float, ...], values: tuple[float, ...], file: str | None, name: str, folder: Path) -> Coating:
    """Return the coating of wavelengths [nm] and efficiencies, or of a file of them."""
    nm, efficiency = (np.array(waves), np.array(values)) if file is None else _two_columns(folder / file)
    return Coating(tuple(map(float, nm * 1e-9)), tuple(map(float, efficiency)), name)


#: Longest file of a table [byte].
_MAX_BYTES = 1_000_000


def _two_columns(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return wavelength [nm] and efficiency of a text file; lines that begin with # are comments."""
    rows = []
    text = read_bytes(path, ConfigError, max_bytes=_MAX_BYTES).decode("utf-8", errors="replace")
    for number, line in enumerate(text_lines(text), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            first, second = map(float, words)
        except ValueError:
            problem = f"{line.strip()!r}: expected two numbers, wavelength [nm] and efficiency"
            raise ConfigError(problem, file=path, place=f"line {number}") from None
        rows.append((first, second))
    if len(rows) < 2:
        raise ConfigError("expected two or more lines of wavelength [nm] and efficiency", file=path)
    nm, values = np.array(rows).T
    return nm, values
