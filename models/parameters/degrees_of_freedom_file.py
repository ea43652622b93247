"""Files of degrees of freedom, YAML.

::

    name: my_active_optics
    source: where the numbers come from
    figures:
      M1M3: {surfaces: [M1, M3], zernike: {outer_radius: 4.18, inner_radius: 0.55, terms: 22}}
      M2_bending: {surfaces: [M2], grids: {B1: m2_mode_1.fits, B2: m2_mode_2.fits}}
    degrees_of_freedom:
      - {name: M2_dz, unit: um, of: M2.dz}
      - {name: M1M3_B1, unit: um, of: {M1M3.Z5: 1.0, M1M3.Z12: -0.1}}
      - {name: M2_B1, unit: um, of: M2_bending.B1}

Radii are in metres; a file of a grid is FITS (:mod:`~pachon.models.io.grid_file`), its path relative to this file.
Maps in HDF5 files (:func:`~pachon.read_hdf5_map`) stand under ``hdf5`` in place of ``grids``:
``{M1: {file: m1.h5, half_width: 4.18, unit: 0.5e-6, quarter_turns: -1}}``. `of`
is an address, or several with the change of each by one of the degree of freedom: the address's SI unit per SI unit. An
address that begins with the name of a deformation (`figures`) is a term of it. The file ``bend.yaml`` of batoid_rubin's
bending modes (:mod:`~.bending_folder`) may stand in place of such a file.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, PrescriptionError, error_context, unknown_name
from ...core.schema import Section, checked, expected, mapping, problem, validated
from ...core.yaml_reader import as_number, read_mapping
from ..io.bundled import DATA
from ..io.grid_file import read_grid
from ..io.hdf5_map import read_hdf5_map
from ..io.yaml.values import ROWS, Names, Number, PositiveNumber, Text
from ..shapes.grid import GridSag
from ..shapes.modes import GridModes
from ..shapes.polynomial import ZernikeSag
from ..shapes.shape import Shape
from .bending_folder import CHOICE, bending_modes
from .degrees_of_freedom import DegreeOfFreedom, DegreesOfFreedom, SurfaceDeformation

#: Those that come with the package, by the file that they are in.
BUNDLED = {"lsst": "lsst_degrees_of_freedom.yaml"}


@check_arguments
def load_degrees_of_freedom(name_or_path: str | os.PathLike[str]) -> DegreesOfFreedom:
    """Load degrees of freedom that come with the package by name ("lsst"), or a file of them by its path.

    The ``bend.yaml`` of batoid_rubin gives the fifty of Rubin's active optics, with the bending modes of its folder.

    Raises
    ------
    UnknownNameError
        If it is neither a name nor a path.
    PrescriptionError
        If the file cannot be read, or is malformed: one line with file, key, value and what was expected.
    """
    text = os.fspath(name_or_path)
    if text not in BUNDLED and Path(text).suffix.lower() not in (".yaml", ".yml"):
        raise unknown_name("degrees of freedom", text, BUNDLED)
    path = DATA / BUNDLED[text] if text in BUNDLED else Path(text)
    content = read_mapping(path)
    if CHOICE in content:
        # The motions of M2 and of the camera are the first ten, as in batoid_rubin.
        return bending_modes(content, path, load_degrees_of_freedom("lsst").members[:10])
    file = validated(DegreesOfFreedomFile, content, str(path), PrescriptionError)
    members = tuple(DegreeOfFreedom(d.name, d.unit, d.of) for d in file.degrees_of_freedom)
    deformations = []
    for name, section in file.figures.items():
        with error_context(file=path, key=f"figures.{name}"):
            deformations.append(SurfaceDeformation(name, section.surfaces, section.shape(path.parent)))
    try:
        return DegreesOfFreedom(members, tuple(deformations), file.name, file.description, file.source)
    except ConfigError as error:
        raise PrescriptionError(str(error), file=path) from None


def _weights(value: Any) -> Any:
    if isinstance(value, dict) and value:
        return value
    if not isinstance(value, str) or not value.strip():
        raise expected("an address, or addresses with the change of each by one of the degree of freedom")
    return {value: 1.0}


def _highest_term(value: Any) -> int | None:
    number = as_number(value)
    return int(number) if number is not None and number % 1 == 0 and 0 < number <= 500 else None


def _quarter_turns(value: Any) -> int | None:
    number = as_number(value)
    return int(number) if number is not None and number % 1 == 0 and abs(number) <= 3 else None


def _without_dots(value: Any) -> Any:
    for name in value if isinstance(value, dict) else ():
        if "." in name:
            raise problem(": expected a name without a dot", name)
    return value


class FreedomSection(Section):
    """A degree of freedom."""

    name: Text
    unit: Text
    of: Annotated[dict[str, Number], BeforeValidator(_weights)]


class ZernikeSection(Section):
    """Zernike polynomials up to a term."""

    outer_radius: PositiveNumber
    inner_radius: Number = 0.0
    terms: Annotated[int, checked(_highest_term, "the highest Noll index, a whole number up to 500")]


class Hdf5MapSection(Section):
    """Map in an HDF5 file, which says neither where its nodes are nor its unit."""

    file: Text
    half_width: PositiveNumber
    unit: PositiveNumber
    dataset: Text | None = None
    quarter_turns: Annotated[int, checked(_quarter_turns, "a whole number from -3 to 3")] = 0

    def map(self, folder: Path) -> GridSag:
        """Return the map; the path of its file starts from the folder."""
        return read_hdf5_map(
            folder / self.file, self.half_width, unit=self.unit, dataset=self.dataset, quarter_turns=self.quarter_turns
        )


class DeformationSection(Section):
    """Deformations of surfaces: Zernike polynomials, or maps of sag in files by the name of the mode."""

    surfaces: Names
    zernike: Annotated[ZernikeSection | None, mapping] = None
    grids: Annotated[dict[str, Text] | None, checked(lambda v: v or None, "names of modes with their FITS files")] = (
        None
    )
    hdf5: Annotated[dict[str, Hdf5MapSection] | None, checked(lambda v: v or None, "modes with their maps")] = None

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        if sum(key in content for key in ("zernike", "grids", "hdf5")) != 1:
            raise problem(": expected one of zernike, grids, hdf5")

    def shape(self, folder: Path) -> Shape:
        """Return the deformation; paths of files start from the folder."""
        if self.zernike is not None:
            with error_context(key="zernike"):
                rims = self.zernike
                return ZernikeSag((0.0,) * rims.terms, rims.outer_radius, rims.inner_radius)
        if self.hdf5 is not None:
            with error_context(key="hdf5"):
                return GridModes({mode: section.map(folder) for mode, section in self.hdf5.items()})
        with error_context(key="grids"):
            return GridModes({mode: read_grid(folder / file) for mode, file in (self.grids or {}).items()})


class DegreesOfFreedomFile(Section):
    """A file of degrees of freedom."""

    name: Text
    description: Text = ""
    source: Text = ""
    figures: Annotated[dict[str, DeformationSection], BeforeValidator(_without_dots)] = Field(default_factory=dict)
    degrees_of_freedom: Annotated[tuple[FreedomSection, ...], ROWS]
