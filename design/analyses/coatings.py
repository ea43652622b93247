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
from the side of lower index to the glass (:mod:`~pachon.design.analyses.layer_stack`). A
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
from ...core.files import read_bytes
from ...core.schema import Section, either, expected, one_of
from ...core.schema import validated as validated_file
from ...core.units import metres
from ...core.yaml_reader import read_mapping
from ...models.io.yaml.values import Numbers, OptionalText, PositiveNumber, Text
from ...models.media.medium import wavelengths_within
from .layer_stack import CoatingTable, LayerStack, checked_cosines


@check_arguments
@dataclass(frozen=True)
class Coating:
    """Efficiency of a surface against the wavelength, for unpolarised light at any angle.

    Parameters
    ----------
    wavelengths : tuple of float, shape (n,)
        Vacuum wavelengths [m], ascending.
    efficiencies : tuple of float, shape (n,)
        Reflectivity or transmission, 0 to 1.
    name : str
        Name for messages.
    """

    wavelengths: tuple[float, ...]
    efficiencies: tuple[float, ...]
    name: str = ""

    def __post_init__(self) -> None:
        waves, values = np.array(self.wavelengths), np.array(self.efficiencies)
        if len(waves) < 2 or not (np.isfinite(waves).all() and (waves > 0).all() and (np.diff(waves) > 0).all()):
            raise ConfigError(f"wavelengths of {self.name or 'a coating'}: expected two or more, positive, ascending")
        if waves.shape != values.shape or not ((values >= 0) & (values <= 1)).all():
            text = f"expected {len(waves)} numbers from 0 to 1, as many as wavelengths"
            raise ConfigError(f"efficiency of {self.name or 'a coating'}: {text}")

    @check_arguments
    def efficiency(self, wavelength: float, cosine: ArrayLike, n1: float, n2: float) -> np.ndarray:
        """Return the efficiency at a wavelength, the same at all angles of incidence.

        Parameters
        ----------
        wavelength : float
            Vacuum wavelength [m]; a DomainError outside the table.
        cosine : array_like
            Cosine of the angle of incidence.
        n1, n2 : float
            Refractive indices before and behind.
        """
        return np.full(checked_cosines(cosine, n1, n2).shape, self.at(wavelength))

    def at(self, wavelength: ArrayLike) -> np.ndarray:
        """Return the efficiency at wavelengths [m]; a DomainError outside the table."""
        ends = (self.wavelengths[0], self.wavelengths[-1])
        w = wavelengths_within(wavelength, ends, f"coating {self.name}" if self.name else "the coating")
        return np.interp(w, self.wavelengths, self.efficiencies)


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

    surfaces: Mapping[str, Coating | CoatingTable | LayerStack] = field(default_factory=dict)
    glasses: Mapping[str, Absorption] = field(default_factory=dict)

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


class _LayerSection(Section):
    """One thin film."""

    index: PositiveNumber
    thickness_nm: PositiveNumber


class _CoatingSection(Section):
    """Efficiency against the wavelength, here or in a file; against the angle too; or thin films."""

    wavelength_nm: Numbers = ()
    efficiency: Numbers | tuple[Numbers, ...] = ()
    file: OptionalText = None
    angle_deg: Numbers = ()
    layers: tuple[_LayerSection, ...] = ()

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:
        if "layers" in content:
            for other in content:
                if other != "layers":
                    raise expected("layers alone", other)
            return
        either(content, "file", ("wavelength_nm", "efficiency"))
        if "angle_deg" in content and "file" in content:
            raise expected("file or angle_deg, not both", "angle_deg")

    def coating(self, name: str, folder: Path) -> Coating | CoatingTable | LayerStack:
        """Return the coating; paths of files start from the folder."""
        if self.layers:
            return LayerStack(
                tuple(layer.index for layer in self.layers),
                tuple(1e-9 * layer.thickness_nm for layer in self.layers),
                name,
            )
        if self.angle_deg:
            rows = [row if isinstance(row, tuple) else (row,) for row in self.efficiency]
            waves, angles = (
                tuple(map(float, v)) for v in (1e-9 * np.array(self.wavelength_nm), np.deg2rad(self.angle_deg))
            )
            return CoatingTable(waves, angles, tuple(rows), name)
        plain = [v for v in self.efficiency if not isinstance(v, tuple)]
        if len(plain) < len(self.efficiency):
            raise ConfigError(f"efficiency of {name}: expected numbers; rows of them go with angle_deg")
        return _plain(self.wavelength_nm, tuple(plain), self.file, name, folder)


class CoatingsFile(Section):
    """A file of coatings."""

    coatings_: Annotated[dict[str, _CoatingSection], Field(alias="coatings", default_factory=dict)]
    surfaces: dict[str, Text] = Field(default_factory=dict)
    glasses: dict[str, _GlassSection] = Field(default_factory=dict)

    def coatings(self, folder: Path) -> Coatings:
        """Return the coatings; paths of files start from the folder."""
        known: dict[str, Coating | CoatingTable | LayerStack] = {}
        glasses = {}
        for name, table in self.coatings_.items():
            with error_context(key=f"coatings.{name}"):
                known[name] = table.coating(name, folder)
        for surface, name in self.surfaces.items():
            if name not in known:
                raise ConfigError(f"surfaces.{surface} = {name!r}: expected {one_of(known, name)}")
        for name, glass in self.glasses.items():
            with error_context(key=f"glasses.{name}"):
                glasses[name] = Absorption(glass.coating(name, folder), 1e-3 * glass.thickness_mm)
        return Coatings({surface: known[name] for surface, name in self.surfaces.items()}, glasses)


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
    for number, line in enumerate(text.splitlines(), 1):
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
