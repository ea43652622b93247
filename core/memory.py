"""Free memory, so that a job too large is refused before the system ends the process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from .errors import DomainError

# Files of control groups: version 2, then version 1.
_UNIFIED = ("memory.max", "memory.current", "inactive_file")
_LEGACY = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")


def available_bytes(root: Path = Path("/")) -> int | None:
    """Return the bytes that this process may still take without swapping.

    On Linux it is the least of the machine's available memory and of the room left in each control group of the process
    (containers and batch systems set their limits there), by the files in ``proc`` and ``sys`` under `root`. Cached
    files, which the kernel drops when it must, count as free. None on systems without these files.
    """
    return min((*_machine_memory(root), *_control_groups(root)), default=None)


def require_bytes(needed: int, what: str) -> None:
    """Raise DomainError, with a text that starts with ``what``, if a job needs more memory than is known to be free."""
    free = available_bytes()
    if free is not None and needed > free:
        raise DomainError(f"{what}: needs about {readable(needed)} of memory, {readable(free)} are free")


def readable(count: float) -> str:
    """Return a number of bytes in MB or GB."""
    size, unit = (count / 1e9, "GB") if count >= 0.95e9 else (count / 1e6, "MB")
    return f"{size:.0f} {unit}" if size >= 9.95 else f"{size:.1f} {unit}"


def _machine_memory(root: Path) -> Iterator[int]:
    for line in _lines(root / "proc/meminfo"):
        words = line.split()
        if len(words) > 1 and words[0] == "MemAvailable:" and words[1].isdigit():
            yield 1024 * int(words[1])


def _control_groups(root: Path) -> Iterator[int]:
    for line in _lines(root / "proc/self/cgroup"):
        number, _, controllers_and_path = line.partition(":")
        controllers, _, path = controllers_and_path.partition(":")
        if number == "0" and not controllers:
            base, names = root / "sys/fs/cgroup", _UNIFIED
        elif "memory" in controllers.split(","):
            base, names = root / "sys/fs/cgroup/memory", _LEGACY
        else:
            continue
        # Limits of all groups above count too. Inside a container the path may be that of the host: then there is
        # nothing but the base.
        inner = Path(path.strip().lstrip("/"))
        for folder in (inner, *inner.parents):
            yield from _group_room(base / folder, *names)


def _group_room(folder: Path, limit_name: str, used_name: str, cached_key: str) -> Iterator[int]:
    """Return the room left in one group, if it has a limit."""
    limit, used = (next(iter(_lines(folder / name)), "").strip() for name in (limit_name, used_name))
    if limit.isdigit() and used.isdigit():
        cached = [int(w[1]) for w in (line.split() for line in _lines(folder / "memory.stat")) if w[0] == cached_key]
        yield max(0, int(limit) - int(used) + sum(cached))


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except (OSError, UnicodeDecodeError):
        return []
