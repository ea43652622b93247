"""Telescope prescriptions: our YAML format, one surface a line, read strictly and written back exactly.

A file has a header and a table of surfaces in the order that light meets them::

    name: my_telescope
    source: where the numbers come from
    version: "1"
    units: {length: m, angle: deg, wavelength: um}
    stop: {z: 0.44}
    pupil: {diameter: 8.36, obscuration: 0.612}
    launch_distance: 15.0
    reference_sphere_radius: 5.0
    field: {radius: 1.75, limit: 2.5}
    wavelengths: {range: [0.3, 1.2], default: 0.624, band: [0.545, 0.703]}
    media:
      silica: {B: [0.696, 0.408, 0.897], C: [0.00468, 0.0135, 97.9], range: [0.21, 3.71]}
    groups:
      L1: [L1_entrance, L1_exit]
    surfaces:
      - {name: M1, type: mirror, shape: conic, z: 0.0, radius: 19.8, conic: -1.2, annulus: [2.6, 4.2]}

Telescope frame: origin at the primary's vertex, +z towards the sky; a positive radius has its centre on the +z side.
`coefficients` of an even asphere belong to r^4, r^6, r^8...; a mirror or detector stays in the medium before it.
`C` of a Sellmeier glass is in um^2 whatever the unit of wavelength.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, PrescriptionError, check_choice, unknown_name
from ...core.files import content_hash, write_bytes
from ...core.yaml_reader import read_mapping
from ..mesh_file import files_of_mesh
from ..telescope import Telescope
from .batoid import ROOT as BATOID_ROOT
from .bundled import BUNDLED, bundled_file
from .glass_catalogue import GlassCatalogue
from .yaml.reader import MAX_BYTES, read_telescope, telescope_of

#: Readers of lens files by their endings: Zemax and its archives, CODE V, OSLO, optiland, ray-optics. Modules are
#: imported where they are needed, like the writers.
_READERS = {
    ".zmx": "zemax.reader:read_zemax_lens",
    ".zar": "zar.reader:read_zemax_archive",
    ".seq": "codev.reader:read_codev_file",
    ".len": "oslo.reader:read_oslo_file",
    ".json": "optiland.reader:read_optiland_file",
    ".roa": "rayoptics.reader:read_rayoptics_file",
}
#: Formats that telescopes are written in; empty for that of the ending.
LensFormat = Literal["", "pachon", "batoid", "zemax", "codev", "oslo", "optiland", "rayoptics"]
#: Writers of lens files of one text, by their formats.
_WRITERS = {
    "codev": "codev.writer:telescope_to_codev",
    "oslo": "oslo.writer:telescope_to_oslo",
    "optiland": "optiland.writer:telescope_to_optiland",
    "rayoptics": "rayoptics.writer:telescope_to_rayoptics",
}
#: Endings of files that a telescope is written to, and their formats.
WRITTEN: dict[str, LensFormat] = {
    ".yaml": "pachon", ".yml": "pachon", ".zmx": "zemax", ".seq": "codev", ".len": "oslo", ".json": "optiland",
    ".roa": "rayoptics",
}  # fmt: skip
#: Endings of lens files of several configurations.
_CONFIGURED = (".zmx", ".zar")
#: What to do with files of other programs whose format is not published, by their ending.
_OTHER_PROGRAMS = {
    ".zos": "a session of Zemax OpticStudio: save the lens there as .zmx",
    ".zprj": "a project of Zemax OpticStudio: save the lens there as .zmx",
    ".zda": "an analysis of Zemax OpticStudio: save the lens there as .zmx",
    ".otx": "a lens of OpTaliX: export it there to CODE V, as .seq",
}
#: Endings of files that a telescope is read from.
ENDINGS = (".yaml", ".yml", *_READERS)


def _imported(reference: str) -> Any:
    """Return the function of a module of this package, ``module:function``."""
    module, name = reference.split(":")
    return getattr(import_module(f".{module}", __package__), name)


@check_arguments
def load_telescope(
    name_or_path: str | os.PathLike[str],
    *,
    lenient: bool = False,
    glass_catalogues: Iterable[GlassCatalogue | str | os.PathLike[str]] = (),
    configuration: int | None = None,
) -> Telescope:
    """Load a bundled prescription by name, or any prescription by the path of its file.

    Parameters
    ----------
    name_or_path : str or path
        Bundled name such as ``"lsst_v3.3_r"``, or path of a ``.yaml`` file, ours or batoid's, or of a lens file:
        ``.zmx`` or ``.zar`` (Zemax), ``.seq`` (CODE V), ``.len`` (OSLO), ``.json`` (optiland), ``.roa`` (ray-optics).
    lenient : bool
        Of a batoid or lens file: warn about keys or lines that are not understood and go on without them.
    glass_catalogues : iterable of GlassCatalogue or path
        AGF catalogues to look up the glasses of a lens file in, first of all; then comes one beside the file that has
        its name and ends in .agf, then the bundled ones, then those that the user has configured.
    configuration : int, optional
        Number from 1 of one of several configurations of a Zemax file, such as the positions of a zoom lens; by default
        the one in which the file was saved. The number is added to the name of the telescope.

    Returns
    -------
    Telescope
        The prescription.

    Raises
    ------
    UnknownNameError
        If it is neither a bundled name nor a path.
    PrescriptionError
        If the file cannot be read, or is malformed: one line with file, key, value and expected value.
    """
    text = os.fspath(name_or_path)
    if configuration is not None and Path(text).suffix.lower() not in _CONFIGURED:
        problem = f"configuration = {configuration}: expected a file that ends in {' or '.join(_CONFIGURED)}"
        raise PrescriptionError(problem, subject=text)
    glass_catalogues = tuple(glass_catalogues)
    if glass_catalogues and (text in BUNDLED or Path(text).suffix.lower() in (".yaml", ".yml")):
        problem = f"glass_catalogues: expected a lens file ({', '.join(_READERS)}); this one has its indices in it"
        raise PrescriptionError(problem, subject=text)
    if text in BUNDLED:
        return _bundled(text)
    path = Path(text)
    if path.suffix.lower() in (".yaml", ".yml"):
        content = read_mapping(path, max_bytes=MAX_BYTES, exact=True)
        if BATOID_ROOT not in content:
            return telescope_of(content, path)
        # Imported where it is needed, like the writer: the sections of the format take time to make.
        from .batoid.reader import batoid_telescope

        return batoid_telescope(content, path, lenient=lenient)
    if path.suffix.lower() in _READERS:
        from .lens.build import read_lens

        reader = _imported(_READERS[path.suffix.lower()])
        if configuration is not None:
            reader = partial(reader, configuration=configuration)
        telescope = read_lens(path, reader, lenient=lenient, glass_catalogues=glass_catalogues)
        return telescope if configuration is None else replace(telescope, name=f"{telescope.name}_{configuration}")
    if (hint := _OTHER_PROGRAMS.get(path.suffix.lower())) is not None:
        raise PrescriptionError(hint, file=path)
    if isinstance(name_or_path, os.PathLike) or len(path.parts) > 1 or path.is_file():
        raise PrescriptionError(f"expected a prescription file that ends in {', '.join(ENDINGS)}", file=path)
    raise unknown_name("telescope", text, BUNDLED)


def prescription_digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a prescription file and of the files that it names.

    These are grids, meshes, user-defined apertures and glass catalogues. The catalogues that the user has configured
    belong to those of a lens file. That of a file that names no other is the SHA-256 of its bytes.

    Raises
    ------
    PrescriptionError
        If a file cannot be read.
    """
    path = Path(path)
    digest = content_hash(path, PrescriptionError)
    if path.suffix.lower() in _READERS:
        from .user_glasses import user_catalogues

        named = [path.with_suffix(".agf").name, *(os.path.abspath(p) for p in user_catalogues())]
        if path.suffix.lower() == ".zmx":
            from .lens.text import read_text
            from .zemax.user_apertures import named_apertures

            named += [os.path.abspath(p) for p in named_apertures(path, read_text(path))]
    else:
        named = sorted(set(_texts(read_mapping(path, max_bytes=MAX_BYTES))))
    # os.path takes every text, also such as are too long for a name.
    files = [name for name in named if os.path.isfile(path.parent / name)]
    for name in files:
        # A list that grows: files of meshes name no others.
        beside = (os.path.join(os.path.dirname(name), mesh) for mesh in files_of_mesh(path.parent / name))
        files += [mesh for mesh in beside if os.path.isfile(path.parent / mesh) and mesh not in files]
    digests = [digest, *(content_hash(path.parent / name, PrescriptionError) for name in files)]
    return hashlib.sha256("".join(digests).encode()).hexdigest() if files else digest


def _texts(content: Any) -> Iterator[str]:
    """Yield all values of plain mappings and lists that are texts."""
    if isinstance(content, str):
        yield content
    elif isinstance(content, (dict, list)):
        for item in content.values() if isinstance(content, dict) else content:
            yield from _texts(item)


@cache
def _bundled(name: str) -> Telescope:
    # Telescopes are immutable, and a sweep loads the same at every point.
    return read_telescope(bundled_file(name))


@check_arguments
def save_telescope(
    telescope: Telescope, path: str | os.PathLike[str], *, format: LensFormat = "", lenient: bool = False
) -> None:
    """Write a prescription file: YAML, ours or batoid's, or a lens file of another program.

    Glasses of a Zemax file that the bundled catalogue does not have go to a catalogue (.agf) of the same name beside
    it.

    Parameters
    ----------
    telescope : Telescope
        Prescription to write.
    path : str or path
        File to write; it is replaced as a whole, or left as it was.
    format : {"", "pachon", "batoid", "zemax", "codev", "oslo", "optiland", "rayoptics"}
        Format; by default that of the ending: Zemax (``.zmx``), CODE V (``.seq``), OSLO (``.len``), optiland
        (``.json``), ray-optics (``.roa``), else ours.
    lenient : bool
        Of pickups, solves and system data that the format has no place for: warn, and write the file without them.

    Raises
    ------
    ConfigError
        If there is no such format, or the ending is that of another.
    PrescriptionError
        If the name has none of these endings, or the file cannot be written or hold the telescope.
    """
    for file, text in prescription_files(telescope, path, format=format, lenient=lenient).items():
        write_bytes(file, text.encode("utf-8", "replace"), PrescriptionError)


def prescription_files(
    telescope: Telescope, path: str | os.PathLike[str], *, format: LensFormat = "", lenient: bool = False
) -> dict[Path, str]:
    """Return the texts of the files that :func:`save_telescope` writes, by their paths; errors are its own."""
    target = Path(path)
    if target.suffix.lower() == ".zar":
        raise PrescriptionError("the layout of Zemax archives is not published: save as .zmx", file=target)
    if target.suffix.lower() not in WRITTEN:
        raise PrescriptionError(f"expected a name that ends in {', '.join(WRITTEN)}", file=target)
    of_ending = WRITTEN[target.suffix.lower()]
    format = format or of_ending
    check_choice("format", format, dict.fromkeys(("pachon", "batoid", *WRITTEN.values())))
    if format != of_ending and (format, of_ending) != ("batoid", "pachon"):
        expected = f"{of_ending}, that of names that end in {target.suffix}"
        raise ConfigError(f"format = {format}: expected {expected}", file=target, key="format")
    if format == "zemax":
        from .zemax.writer import catalogue_path, telescope_to_zemax

        lens, glasses = telescope_to_zemax(telescope, lenient=lenient)
        return ({catalogue_path(target): glasses} if glasses else {}) | {target: lens}
    if format == "batoid":
        from .batoid.writer import telescope_to_batoid

        return {target: telescope_to_batoid(telescope)}
    if format in _WRITERS:
        return {target: _imported(_WRITERS[format])(telescope, lenient=lenient)}
    from .yaml.writer import telescope_to_yaml

    return {target: telescope_to_yaml(telescope)}
