"""Version of the names of CCDs in files that hold them.

In files of version 1, which have no number, the CCDs of the LSST and ComCam are named as in a mirror: R<row><column> of
the camera stands there where R<column><row> does, and CCDs have 4096 x 4096 pixels.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .errors import PachonError, ProductError

#: Version that is written.
NAMES_VERSION = 2
#: Header card of the version.
NAMES_CARD = ("CCDNAMES", NAMES_VERSION, "version of the names of CCDs")
#: Names of the CCDs of the LSST and ComCam.
_RUBIN = re.compile(r"R[0-4][0-4]_S[0-2GW][0-2]")


def refuse_mirrored_names(
    names: Iterable[str], version: Any, file: str | Path, error: type[PachonError] = ProductError
) -> None:
    """Raise `error` if a file of an older version names CCDs of the LSST or ComCam; `version` is None without one."""
    if version == NAMES_VERSION:
        return
    name = next((str(name) for name in names if _RUBIN.fullmatch(str(name))), None)
    if name is not None:
        raise error(
            f"names CCDs of the LSST, such as {name}, as in a mirror (docs/howto/camera.md): expected version "
            f"{NAMES_VERSION} of the names, found {1 if version is None else version}; make the file again",
            file=file,
        )
