"""A lock between processes that would make the same file: one makes it, the others wait and take what it has left."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows: each process works for itself.
    fcntl = None  # type: ignore[assignment]

#: Longest wait for another process [s]; the largest module of kernels compiles for 40 s.
LONGEST_WAIT = 300.0
#: Time between two attempts [s].
PAUSE = 0.05


@contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Hold the lock of a file, which is made and left; go on without it where files have no locks."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = path.open("w")
    except OSError:
        # A folder that cannot be written is reported by the work itself.
        yield
        return
    with lock:
        _acquire(lock)
        yield


def _acquire(lock: IO[str]) -> None:
    if fcntl is None:
        return
    end = time.monotonic() + LONGEST_WAIT
    while time.monotonic() < end:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(PAUSE)
        except OSError:
            return
        else:
            return
