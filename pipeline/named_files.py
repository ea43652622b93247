"""Files that a run's configuration names, which lie beside the file of the configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core.errors import ConfigError
from ..core.files import path_beside
from ..core.yaml_reader import read_mapping

#: Sections and keys of a configuration that may name a file.
FILES = (
    ("", "telescope"),
    ("", "camera"),
    ("atmosphere", "site"),
    ("focal_plane", "heights"),
    ("active_optics", "states"),
    ("stars", "catalogue"),
)


def read_run(path: Path, folder: Path) -> Any:
    """Return the content of a run's configuration that a file in a folder names.

    Files beside the configuration have absolute paths where that is another folder. ConfigError if it is no YAML.
    """
    content = read_mapping(path, ConfigError)
    return content if path.parent.resolve() == folder.resolve() else with_named_files(content, path.parent)


def with_named_files(content: Any, folder: Path) -> Any:
    """Return the content of a configuration with absolute paths of those files that are there from a folder on."""
    for section, key in FILES:
        if isinstance(content, dict) and section in ("", *content):
            changed = with_path(content[section] if section else content, key, folder)
            content = {**content, section: changed} if section else changed
    return content


def with_path(section: Any, key: str, folder: Path) -> Any:
    """Return a section with the absolute path of a file that a key names relative to a folder."""
    if isinstance(section, dict) and isinstance(section.get(key), str):
        return {**section, key: path_beside(folder, section[key])}
    return section
