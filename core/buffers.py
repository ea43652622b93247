"""Memory pool for large arrays.

The first write to fresh memory costs a page fault for every 4 kB, a fifth of the time of a trace. Memory of deleted
arrays is reused without these faults.
"""

from __future__ import annotations

import math
import mmap
import threading
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

#: Smallest array that uses the pool [bytes]; the allocator reuses the memory of smaller ones itself.
_LEAST = 1 << 20
#: Size of a huge page [bytes].
_HUGE_PAGE = 1 << 21
#: Largest total of the unused blocks [bytes].
MOST = 1 << 28
#: Largest size of a block over that of the array that uses it.
_SLACK = 1.25


def _mapped(count: int) -> np.ndarray:
    """Return fresh memory of `count` bytes, in huge pages where the system has them.

    A fault and an entry of the translation buffers then stand for 2 MB in place of 4 kB, and no vector lies across two
    cache lines.
    """
    if count < _HUGE_PAGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return np.empty(count, dtype=np.uint8)
    try:
        pages = mmap.mmap(-1, count + _HUGE_PAGE)
    except OSError:
        # Too little memory is NumPy's to say.
        return np.empty(count, dtype=np.uint8)
    with suppress(OSError):  # a kernel without huge pages
        pages.madvise(mmap.MADV_HUGEPAGE)
    memory = np.frombuffer(pages, dtype=np.uint8)
    first = -memory.ctypes.data % _HUGE_PAGE
    return memory[first : first + count]


class _MemoryPool:
    """Unused blocks of memory, oldest first; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._free: list[np.ndarray] = []

    @property
    def size(self) -> int:
        """Memory of the blocks [bytes]."""
        return sum(block.nbytes for block in self._free)

    def take(self, count: int) -> np.ndarray:
        """Return a block of at least `count` bytes, the one used last if several fit."""
        with self._lock:
            for i in reversed(range(len(self._free))):
                if count <= self._free[i].nbytes <= _SLACK * count:
                    return self._free.pop(i)
        return _mapped(count)

    def give(self, block: np.ndarray) -> None:
        """Return a block to the pool, and free the oldest ones beyond its limit."""
        # Garbage collection may delete an array within these lines; its block is then freed.
        if not self._lock.acquire(blocking=False):
            return
        try:
            self._free.append(block)
            while self.size > MOST:
                del self._free[0]
        finally:
            self._lock.release()


_POOL = _MemoryPool()


class _PooledMemory:
    """Memory of one array, which returns to the pool with the last view of it."""

    def __init__(self, block: np.ndarray, shape: tuple[int, ...], dtype: np.dtype) -> None:
        self._block, self._blocks = block, _POOL
        self.__array_interface__: dict[str, Any] = {
            "data": (block.ctypes.data, False),
            "shape": shape,
            "typestr": dtype.str,
            "version": 3,
        }

    def __del__(self) -> None:
        self._blocks.give(self._block)


def empty(shape: tuple[int, ...], dtype: DTypeLike = np.float64) -> np.ndarray:
    """Return an uninitialised array; the memory of a large one comes from the pool."""
    kind = np.dtype(dtype)
    count = math.prod(shape) * kind.itemsize
    return np.empty(shape, kind) if count < _LEAST else np.asarray(_PooledMemory(_POOL.take(count), shape, kind))
