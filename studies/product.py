"""Files of a study: tables, plots, metrics, configuration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.files import write_bytes, write_json
from ..core.products import Columns, write_ecsv
from ..core.version import VERSION
from ..pipeline.config import Configuration, to_yaml
from ..pipeline.run_folder import CONFIG_NAME


def write_products(
    folder: Path,
    tables: Mapping[str, tuple[str, Columns]],
    pictures: Mapping[str, bytes],
    metrics: Mapping[str, Mapping[str, Any]],
    meta: Mapping[str, Any],
    config: Configuration,
    heading: str,
) -> tuple[str, ...]:
    """Write the files of a study into an existing folder, and return their names.

    `tables` (subject and columns), `pictures` (PNG) and `metrics` (JSON) are by file name. `meta` goes into tables and
    metrics; `heading` explains the configuration in its file.
    """
    for name, (subject, columns) in tables.items():
        write_ecsv(folder / name, columns, {"what": subject, **meta})
    for name, png in pictures.items():
        write_bytes(folder / name, png)
    for name, content in metrics.items():
        write_json(folder / name, {**content, **meta})
    write_bytes(folder / CONFIG_NAME, to_yaml(config, (f"pachon {VERSION}: {heading}",)).encode())
    return *tables, *pictures, *metrics, CONFIG_NAME
