"""Glass catalogues that the user has named once: PACHON_GLASS_PATH, or the key ``glass_path`` of a configuration.

The configuration is ``~/.config/pachon/config.yaml`` (``$XDG_CONFIG_HOME/pachon/config.yaml``)::

    glass_path: [~/glasses, /opt/zemax/Glasscat/SCHOTT.AGF]

Both name folders, all of whose AGF files are taken in alphabetical order, or single files; in the variable they are
separated as in PATH. Such catalogues are looked in last, for glasses that no other catalogue has.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from ...core.errors import PrescriptionError
from ...core.yaml_reader import read_mapping
from .glass_catalogue import GlassCatalogue

VARIABLE = "PACHON_GLASS_PATH"


def settings_path() -> Path:
    """Return the path of the user's configuration, whether it is there or not."""
    folder = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(folder).expanduser() / "pachon" / "config.yaml"


def user_catalogues() -> Iterator[GlassCatalogue]:
    """Yield the user's glass catalogues, each read when it is reached.

    A PrescriptionError names the variable or key of a path that is not there, or the file that is no catalogue.
    """
    for file in _files():
        yield _catalogue(file, file.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _catalogue(path: Path, changed: int) -> GlassCatalogue:
    """Return a catalogue; `changed` is the time of its last change, so that a new one is read again."""
    del changed
    return GlassCatalogue.read(path)


def _files() -> Iterator[Path]:
    for where, name in _named():
        path = Path(name).expanduser()
        if path.is_dir():
            yield from sorted(p for p in path.iterdir() if p.suffix.lower() == ".agf")
        elif path.is_file():
            yield path
        else:
            raise PrescriptionError(f"{where} = {name!r}: expected a folder or a glass catalogue, .agf")


def _named() -> Iterator[tuple[str, str]]:
    """Yield the paths of variable and configuration, with what names them."""
    for name in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        yield VARIABLE, name
    path = settings_path()
    if not path.is_file():
        return
    content = read_mapping(path)
    for key in content:
        if key != "glass_path":
            raise PrescriptionError(f"unknown key {key}: expected glass_path", file=path, key=key)
    given: Any = content.get("glass_path", [])
    names = [given] if isinstance(given, str) else given
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        problem = f"glass_path = {given!r}: expected a path, or a list of them"
        raise PrescriptionError(problem, file=path, key="glass_path")
    for name in names:
        yield f"glass_path of {path}", name
