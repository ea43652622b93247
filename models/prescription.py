"""Telescope prescriptions: our YAML format, one surface a line, read strictly and written back exactly.

A file has a header and a table of surfaces in the order that light meets them::

    name: my_telescope
    source: where the figures come from
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

import contextlib
import os
from pathlib import Path

from .errors import PrescriptionError, unknown_name
from .prescription_reader import read_telescope
from .prescription_writer import telescope_to_yaml
from .telescope import Telescope
from .yaml_reader import read_yaml

DATA = Path(__file__).parent / "data"
BUNDLED = (*(f"lsst_v3.3_{band}" for band in "ugrizy"), "lsst_v3.3_g_vacuum_zemax_check", "paul_baker")


def bundled_names() -> tuple[str, ...]:
    """Return the names of the prescriptions that come with the package."""
    return BUNDLED


def load_telescope(name_or_path: str | os.PathLike[str]) -> Telescope:
    """Load a bundled prescription by name, or any prescription by the path of its file.

    Parameters
    ----------
    name_or_path : str or path
        Bundled name such as ``"lsst_v3.3_r"``, or path of a ``.yaml`` file.

    Returns
    -------
    Telescope
        The prescription.

    Raises
    ------
    UnknownNameError
        If it is neither a bundled name nor a path.
    PrescriptionError
        If the file cannot be read, or is malformed: one line with file, key, value and what was expected.
    """
    text = os.fspath(name_or_path)
    if text in BUNDLED:
        return read_telescope(read_yaml(DATA / f"{text}.yaml"))
    path = Path(text)
    if path.suffix.lower() in (".yaml", ".yml"):
        return read_telescope(read_yaml(path))
    if isinstance(name_or_path, os.PathLike) or len(path.parts) > 1 or path.is_file():
        raise PrescriptionError(f"{path}: expected a prescription file that ends in .yaml")
    raise unknown_name("telescope", text, BUNDLED)


def save_telescope(telescope: Telescope, path: str | os.PathLike[str]) -> None:
    """Write a prescription file.

    Parameters
    ----------
    telescope : Telescope
        What to write.
    path : str or path
        File to write; it is replaced as a whole, or left as it was.

    Raises
    ------
    PrescriptionError
        If the file cannot be written.
    """
    target = Path(path)
    scratch = target.with_name(target.name + ".part")
    try:
        scratch.write_text(telescope_to_yaml(telescope), encoding="utf-8")
        scratch.replace(target)
    except OSError as error:
        with contextlib.suppress(OSError):
            scratch.unlink()
        raise PrescriptionError(f"{target}: cannot be written ({error.strerror})") from None
