"""Files of degrees of freedom, YAML.

::

    name: my_active_optics
    source: where the figures come from
    figures:
      M1M3: {surfaces: [M1, M3], zernike: {outer_radius: 4.18, inner_radius: 0.55, terms: 22}}
      M2_bending: {surfaces: [M2], grids: {B1: m2_mode_1.fits, B2: m2_mode_2.fits}}
    degrees_of_freedom:
      - {name: M2_dz, unit: um, of: M2.dz}
      - {name: M1M3_B1, unit: um, of: {M1M3.Z5: 1.0, M1M3.Z12: -0.1}}
      - {name: M2_B1, unit: um, of: M2_bending.B1}

Radii are in metres; a file of a grid is FITS (:mod:`~pachon.models.io.grid_file`), its path relative to this file. `of`
is an address, or several with what one of the degree of freedom does to each: the address's SI unit per SI unit. An
address that begins with the name of a figure is a term of it.
"""

from __future__ import annotations

import os
from pathlib import Path

from ...core.errors import ConfigError, PachonError, PrescriptionError, unknown_name
from ...core.yaml_reader import Section, read_yaml
from ...models.io.grid_file import read_grid
from ...models.io.prescription import DATA
from ...models.shapes.freeform import ZernikeSag
from ...models.shapes.modes import GridModes
from ...models.shapes.shape import Shape
from .degrees_of_freedom import DegreesOfFreedom, Figure, Freedom

#: Those that come with the package, by the file that they are in.
BUNDLED = {"lsst": "lsst_degrees_of_freedom.yaml"}


def load_degrees_of_freedom(name_or_path: str | os.PathLike[str]) -> DegreesOfFreedom:
    """Load degrees of freedom that come with the package by name ("lsst"), or a file of them by its path.

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
    return _read(read_yaml(DATA / BUNDLED[text] if text in BUNDLED else Path(text)))


def _read(top: Section) -> DegreesOfFreedom:
    top.allow("name", "description", "source", "figures", "degrees_of_freedom")
    listed = top.section("figures", optional=True)
    figures = tuple(_figure(name, listed.section(name)) for name in listed.keys())  # noqa: SIM118 - no mapping
    freedoms = tuple(_freedom(one) for one in top.sections("degrees_of_freedom", "name"))
    try:
        return DegreesOfFreedom(
            freedoms, figures, top.text("name"), top.text("description", ""), top.text("source", "")
        )
    except ConfigError as error:
        raise PrescriptionError(str(error), file=top.source) from None


def _freedom(section: Section) -> Freedom:
    section.allow("name", "unit", "of")
    if not isinstance(section.value("of"), dict):
        return Freedom(section.text("name"), section.text("unit"), {section.text("of"): 1.0})
    weights = section.section("of")
    of = {address: weights.number(address) for address in weights.keys()}  # noqa: SIM118 - a Section is no mapping
    if not of:
        raise section.error("of", "an address, or addresses with what one does to each")
    return Freedom(section.text("name"), section.text("unit"), of)


def _figure(name: str, section: Section) -> Figure:
    section.allow("surfaces", "zernike", "grids")
    if ("zernike" in section) == ("grids" in section):
        raise PrescriptionError(f"{section.source}: {section.place}: expected either zernike or grids")
    if "." in name:
        raise PrescriptionError(f"{section.source}: {section.place}: expected a name without a dot")
    surfaces = section.names("surfaces")
    shape: Shape
    if "zernike" in section:
        rims = section.section("zernike")
        rims.allow("outer_radius", "inner_radius", "terms")
        terms = rims.number("terms", positive=True)
        if terms % 1 or terms > 500:
            raise rims.error("terms", "the highest Noll index, a whole number up to 500")
        try:
            shape = ZernikeSag(
                (0.0,) * int(terms), rims.number("outer_radius", positive=True), rims.number("inner_radius", 0.0)
            )
        except PrescriptionError as error:
            raise rims.placed(error) from None
        return Figure(name, surfaces, shape)
    files = section.section("grids")
    if not files.keys():
        raise section.error("grids", "names of modes with their FITS files")
    # A relative path is meant from where the file lies.
    folder = Path(section.source).parent
    grids = {mode: read_grid(folder / files.text(mode)) for mode in files.keys()}  # noqa: SIM118 - no mapping
    try:
        return Figure(name, surfaces, GridModes(grids))
    except PachonError as error:
        raise PrescriptionError(f"{section.place}.grids: {error}", file=section.source) from None
