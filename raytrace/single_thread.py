"""Linear algebra on one thread, so that results do not depend on how many the machine has."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

_LOCK = threading.RLock()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold BLAS and LAPACK to one thread inside a with block.

    Several threads split the sums of a matrix product, and so round them, in a way that depends on their number; for
    the small matrices here they are no faster. The limit belongs to the process: one block runs at a time, or the end
    of one would lift the limit of another.
    """
    with _LOCK, threadpool_limits(limits=1, user_api="blas"):
        yield
