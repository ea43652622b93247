"""Files written whole or not at all, with the same bytes for the same content.

A file is written under a temporary name in its own folder, flushed to the disk and then renamed. A run that is killed
or finds the disk full leaves no partial file under the final name.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from .errors import PachonError, ProductError


def write_bytes(path: Path, data: bytes, error: type[PachonError] = ProductError) -> None:
    """Write a file whole, or raise `error` with the path and the system's reason and leave nothing behind."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        try:
            with open(partial, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        except BaseException:
            with suppress(OSError):
                partial.unlink()
            raise
    except OSError as problem:
        raise error(f"cannot write {path}: {problem.strerror or problem}") from None


def read_bytes(path: Path, error: type[PachonError]) -> bytes:
    """Return the content of a file, or raise `error` where it cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise error("no such file", file=path) from None
    except OSError as problem:
        raise error(f"cannot be read ({problem.strerror})", file=path) from None


def make_folder(folder: Path) -> None:
    """Make a folder, and those it lies in, where they are not there yet."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProductError(f"cannot make the folder {folder}: {error.strerror}") from None


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file with sorted keys; numbers that are not finite become null."""
    write_bytes(path, (json_text(content) + "\n").encode())


def json_text(content: Any) -> str:
    """Return indented JSON with sorted keys; numbers that are not finite become null."""
    return json.dumps(_plain(content), indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        # Nine digits are enough, and equal on machines whose sums differ in the last bits.
        return float(f"{value:.9g}") if np.isfinite(value) else None
    return value
