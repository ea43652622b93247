"""Glass catalogues that a user has configured once, for all lens files.

The environment variable ``PACHON_GLASS_PATH`` lists AGF files, or folders of them, separated as in ``PATH``. Without it
they stand in the user's configuration, ``$XDG_CONFIG_HOME/pachon/config.yaml`` or ``~/.config/pachon/config.yaml``::

    glass_catalogues:
      - ~/glasses/schott.agf
      - ~/glasses/others      # a folder: every .agf file in it, by name

Paths are absolute, or relative to the folder of the configuration.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path

from ...core.errors import ConfigError, PrescriptionNote
from ...core.schema import Section, validated
from ...core.yaml_reader import read_mapping

#: Environment variable with the paths of glass catalogues.
VARIABLE = "PACHON_GLASS_PATH"


class UserConfiguration(Section):
    """The user's configuration."""

    glass_catalogues: tuple[str, ...] = ()


def user_configuration_path() -> Path:
    """Return where the user's configuration stands, if there is one."""
    base = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(base).expanduser() / "pachon" / "config.yaml"


def user_catalogues() -> tuple[Path, ...]:
    """Return the paths of the AGF files that the user has configured, in their order.

    Of an entry that is neither an AGF file nor a folder with some there is a PrescriptionNote: the lenses whose
    glasses stand elsewhere do not need it.

    Raises
    ------
    ConfigError
        If the configuration cannot be read.
    """
    if VARIABLE in os.environ:
        listed = [entry for entry in os.environ[VARIABLE].split(os.pathsep) if entry]
        return tuple(path for entry in listed for path in _files(Path(entry).expanduser(), VARIABLE))
    source = user_configuration_path()
    if not source.is_file():
        return ()
    settings = validated(UserConfiguration, read_mapping(source, error=ConfigError), str(source), ConfigError, {})
    places = [source.parent / Path(text).expanduser() for text in settings.glass_catalogues]
    return tuple(path for place in places for path in _files(place, f"{source}: glass_catalogues"))


def _files(place: Path, key: str) -> list[Path]:
    if place.is_dir() and os.access(place, os.R_OK):
        catalogue_paths = sorted(path for path in place.iterdir() if path.suffix.lower() == ".agf")
    else:
        catalogue_paths = [place] if place.is_file() else []
    if not catalogue_paths:
        problem = f"{key}: {place}: expected an AGF file, or a folder with some; it is left out"
        warnings.warn(problem, PrescriptionNote, stacklevel=2)
    return catalogue_paths
