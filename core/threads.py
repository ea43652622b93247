"""Numbers of threads, and linear algebra on one thread so that results do not depend on that number."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import lru_cache

from threadpoolctl import ThreadpoolController

#: More threads than any machine has processors only take memory.
_MOST_THREADS = 128
_LOCK = threading.RLock()


def thread_count(threads: int | None) -> int:
    """Return the number of threads to use: the given number, or the processors this process may run on."""
    if threads is not None:
        from .units import require_count  # with NumPy, which `--help` does without

        return min(require_count(threads, "threads", 1), _MOST_THREADS)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    """Return the BLAS libraries in memory. Finding them takes a millisecond; new ones come with new modules."""
    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold BLAS and LAPACK to one thread inside a with block.

    Several threads split the sums of a matrix product, and so round them, in a way that depends on their number; for
    the small matrices here they are no faster. The limit belongs to the process: one block runs at a time, or the end
    of one would lift the limit of another.
    """
    with _LOCK:
        libraries = _libraries(len(sys.modules))
        on_one_thread = all(library.num_threads == 1 for library in libraries.lib_controllers)
        # In a block inside another one there is nothing to change; a limit costs a tenth of a millisecond.
        with nullcontext() if on_one_thread else libraries.limit(limits=1):
            yield
