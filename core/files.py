"""Files written whole or not at all, with the same bytes for the same content.

A file is written under a temporary name in its own folder, flushed to the disk and then renamed. A run that is killed
or finds the disk full leaves no partial file under the final name.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

import numpy as np

from .errors import PachonError, ProductError, cut_short

# Size of the file that probes for free space [byte].
_PROBE = 4096
#: Key of a configuration among results.
_CONFIGURATION = "configuration"


def write_bytes(path: Path, data: bytes, error: type[PachonError] = ProductError) -> None:
    """Write a file whole, or raise `error` with the path and the system's reason and leave nothing behind."""
    _write(path, data, error, _publish)


def write_new_bytes(path: Path, data: bytes, error: type[PachonError] = ProductError) -> bool:
    """Write a file whole as :func:`write_bytes` does, and return True; or return False where there is one already.

    If several processes write the file at the same time, the result is True in one of them.
    """
    try:
        _write(path, data, error, publish_new)
    except FileExistsError:
        return False
    return True


def require_writable(path: Path, *, file: bool = False, error: type[PachonError] = ProductError) -> None:
    """Raise `error` where a path cannot be written, before anything is computed for it.

    A `file` needs a folder that there is; missing folders of other paths can be made.

    The nearest folder that there is gets a temporary file, which is removed: permissions alone do not tell of read-only
    file systems, quotas and full disks.
    """
    try:
        start = path if path.is_dir() else path.absolute().parent
        folder = start if file else next(place for place in (start, *start.parents) if place.exists())
        probe = folder / partial_path(path).name
        try:
            probe.write_bytes(bytes(_PROBE))
        finally:
            with suppress(OSError):
                probe.unlink()
    except (OSError, ValueError) as problem:
        raise error(f"cannot write {path}: {getattr(problem, 'strerror', None) or problem}") from None


def partial_path(path: Path) -> Path:
    """Return the temporary path under which this process writes a file."""
    return path.with_name(f".{path.name}.{_owning_process(os.getpid())}.partial")


def _write(path: Path, data: bytes, error: type[PachonError], publish: Callable[[Path, Path], None]) -> None:
    """Write a temporary file, give it its final name by a function, and leave no temporary file behind."""
    partial = partial_path(path)
    try:
        try:
            with open(partial, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            publish(partial, path)
        finally:
            with suppress(OSError):
                partial.unlink()
    except FileExistsError:
        raise
    except OSError as problem:
        raise error(f"cannot write {path}: {problem.strerror or problem}") from None


def _publish(partial: Path, path: Path) -> None:
    """Give a temporary file its final name."""
    content = os.stat(partial)
    try:
        os.replace(partial, path)
    except FileNotFoundError:
        # A network file system repeats a request whose answer it lost, and finds it done.
        if not (path.exists() and os.path.samestat(content, os.stat(path))):
            raise


def publish_new(partial: Path, path: Path) -> None:
    """Give a temporary file its final name, or raise FileExistsError where there is one already."""
    try:
        os.link(partial, path)
    except FileExistsError:
        # As of a rename: an answer may be lost of a link that was made.
        if not os.path.samefile(partial, path):
            raise
    except OSError:
        # File systems without hard links, such as FAT.
        with open(path, "xb") as file:
            try:
                file.write(partial.read_bytes())
                file.flush()
            except OSError:
                path.unlink()
                raise


@contextmanager
def marked_folder(folder: Path) -> Iterator[str]:
    """Put a file of a unique name into a folder, and yield the name; processes that find it share the folder.

    The file is a temporary one, which :func:`make_folder` knows.
    """
    mark = folder / f".{uuid4().hex}.{_owning_process(os.getpid())}.partial"
    write_bytes(mark, b"")
    try:
        yield mark.name
    finally:
        with suppress(OSError):
            mark.unlink()


@contextmanager
def folder_of_worker(folder: Path, mark: str) -> Iterator[Path]:
    """Yield a folder that contains its mark (:func:`marked_folder`), or a temporary one where the mark is missing."""
    if (folder / mark).is_file():
        yield folder
        return
    with TemporaryDirectory(prefix="pachon_") as temporary_folder:
        yield Path(temporary_folder)


def _remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of processes that ended; those of live ones, and of other machines, stay."""
    for left_over in folder.glob(".*.partial"):
        owner = left_over.name.removesuffix(".partial")
        process = owner.rpartition("-")[2]
        if owner.endswith(f".{_owning_process(process)}") and process.isdecimal() and not _is_running(int(process)):
            with suppress(OSError):
                left_over.unlink()


def _owning_process(process: int | str) -> str:
    """Return the part of the name of temporary files that tells machine and process."""
    return f"{platform.node()}-{process}"


def _is_running(process: int) -> bool:
    if os.name == "nt":
        # There, signal 0 would end the process.
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        # A process of another user.
        return True
    return True


def read_bytes(path: Path, error: type[PachonError], *, max_bytes: int | None = None) -> bytes:
    """Return the content of a file, or raise `error` where it cannot be read or has more than `max_bytes` [byte]."""
    require_file(path, error)
    try:
        with open(path, "rb") as file:
            data = file.read(-1 if max_bytes is None else max_bytes + 1)
    except OSError as problem:
        raise error(f"cannot be read ({problem.strerror})", file=path) from None
    if max_bytes is not None and len(data) > max_bytes:
        raise error(f"expected a file of at most {max_bytes} bytes", file=path)
    return data


def read_arrays(path: Path, problem: str, error: type[PachonError]) -> dict[str, np.ndarray]:
    """Return the arrays of a NumPy file (.npz) by name, or raise `error` with a problem where it is not whole.

    The checksum of each array is checked; NumPy and zipfile raise all kinds of errors for a damaged table of contents.
    """
    data = read_bytes(path, error)
    with parsing(path, problem, error), np.load(io.BytesIO(data), allow_pickle=False) as content:
        return dict(content)


def text_lines(text: str) -> list[str]:
    """Return the lines of the text of a file, which end in line feeds, carriage returns or both.

    Form feeds, NEL (U+0085) and the separators of Unicode, at which :meth:`str.splitlines` divides too, stand within
    lines: editors and other programs do not count lines there.
    """
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return lines[:-1] if lines[-1] == "" else lines


def content_hash(path: Path, error: type[PachonError]) -> str:
    """Return the SHA-256 of the content of a file, in hexadecimal; errors as of :func:`read_bytes`."""
    return hashlib.sha256(read_bytes(path, error)).hexdigest()


@contextmanager
def parsing(path: str | os.PathLike[str], problem: str, error: type[PachonError]) -> Iterator[None]:
    """Raise `error` with a problem, such as ``"no FITS file"``, where another package cannot make sense of a file.

    Parsers of others raise whatever a damaged file leads them to.
    """
    try:
        yield
    except PachonError:
        raise
    except Exception as cause:
        reason = cut_short(" ".join(str(cause).split()), 120) or type(cause).__name__
        raise error(f"{problem} ({reason})", file=path) from None


def path_beside(folder: Path, name: str) -> str:
    """Return the absolute path of a file that a name means from a folder on; the name where there is none."""
    path = folder / name
    return str(path.resolve()) if path.is_file() else name


def require_file(path: Path, error: type[PachonError]) -> None:
    """Raise `error` where a path is not that of a regular file: a pipe or device would be read without end."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise error("no such file", file=path) from None
    except (OSError, ValueError) as problem:
        raise error(f"cannot be read ({getattr(problem, 'strerror', None) or problem})", file=path) from None
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe, device or socket"
        raise error(f"cannot be read (it is {kind}; expected a file)", file=path)


def make_folder(folder: Path) -> None:
    """Make a folder and those it lies in, or remove from it the temporary files of processes that ended."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProductError(f"cannot make the folder {folder}: {error.strerror}") from None
    _remove_leftovers(folder)


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write a JSON file with sorted keys; numbers that are not finite become null."""
    write_bytes(path, (json_text(content) + "\n").encode())


def json_text(content: Any) -> str:
    """Return indented JSON with sorted keys; numbers that are not finite become null."""
    return json.dumps(plain_values(content), indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False)


def plain_values(value: Any, digits: int | None = 9) -> Any:
    """Return a value for JSON: lists for arrays, None for numbers that are not finite, rounded to `digits` if given.

    Nine digits are enough, and equal on machines whose sums differ in the last bits. A configuration keeps its own, of
    which a date has more.
    """
    if isinstance(value, dict):
        return {str(k): plain_values(v, None if k == _CONFIGURATION else digits) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_values(v, digits) for v in value]
    if isinstance(value, np.ndarray):
        return plain_values(value.tolist(), digits)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        if not np.isfinite(value):
            return None
        return value if digits is None else float(f"{value:.{digits}g}")
    return value
