"""Read a lens file of any format as a telescope."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from ....core.errors import PrescriptionError, error_context
from ...telescope import Telescope
from ...thickness import impossible_thicknesses
from ..glass_catalogue import GlassCatalogue
from .build import telescope_of
from .description import LensDescription
from .glasses import Glasses
from .source import Findings

#: Reads the description of a lens from a file.
Reader = Callable[[Path, Findings, Glasses], LensDescription]


def read_lens(
    path: Path,
    reader: Reader,
    *,
    lenient: bool = False,
    glass_catalogues: Iterable[GlassCatalogue | str | os.PathLike[str]] = (),
) -> Telescope:
    """Read a lens file with the reader of its format."""
    findings = Findings(lenient)
    with error_context(file=path):
        telescope = telescope_of(reader(path, findings, Glasses(path, glass_catalogues)))
    for text in impossible_thicknesses(telescope):
        findings.note(PrescriptionError(text, file=path), "read as it is: rays go back within it")
    return telescope
