"""Degrees of freedom of the telescope in each visit from a file, such as those left by an active-optics loop.

A table (ECSV) with a column ``visit`` and one column a degree of freedom, with units; the entry ``degrees_of_freedom``
of its metadata names the set, ``lsst`` by default.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core.errors import ConfigError, error_context
from ..core.files import parsing, read_bytes, text_lines
from ..models.telescope import Telescope

#: Endings of files of states.
ENDINGS = (".ecsv",)


def with_active_optics_state(telescope: Telescope, path: str, visit: int) -> Telescope:
    """Return a telescope perturbed as in one visit of a file.

    Raises
    ------
    ConfigError
        If the file cannot be read, is no table of states, or has no such visit.
    UnknownNameError, DomainError
        If a column is no degree of freedom, or a value is not finite or has a unit that does not convert.
    """
    # Degrees of freedom come with the kernels of derivatives, which take a quarter of a second.
    from astropy.table import QTable

    from ..models.parameters.degrees_of_freedom_file import load_degrees_of_freedom

    file = Path(path)
    text = read_bytes(file, ConfigError)
    with parsing(file, "expected a table of states (ECSV)", ConfigError):
        table = QTable.read(text_lines(text.decode()), format="ascii.ecsv")
    with error_context(file=file):
        if "visit" not in table.colnames or len(table.colnames) < 2:
            raise ConfigError("columns: expected visit, and degrees of freedom such as M2_dz")
        rows = np.flatnonzero(np.asarray(table["visit"]) == visit)
        if len(rows) != 1:
            raise ConfigError(f"visit = {visit}: expected one row of that visit among {len(table)}")
        freedoms = load_degrees_of_freedom(str(table.meta.get("degrees_of_freedom", "lsst")))
        return freedoms.apply(telescope, {name: table[name][rows[0]] for name in table.colnames if name != "visit"})
