"""Large arrays whose memory is used again.

The first write to fresh memory costs the system a page fault for every 4 kB, a fifth of the time of a trace. The memory
of a result that is gone has had them.
"""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

#: Smallest array whose memory is kept [bytes]; the allocator itself keeps that of smaller ones.
_LEAST = 1 << 20
#: Memory that waits to be used again, at most [bytes].
MOST = 1 << 28
#: A block may be so much larger than the array that it is given to.
_SLACK = 1.25


class _MemoryPool:
    """Blocks of memory that wait to be used again, the oldest first; safe with threads."""

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
        return np.empty(count, dtype=np.uint8)

    def give(self, block: np.ndarray) -> None:
        """Keep a block, and let the oldest go where it is too much."""
        # A garbage collection may end an array within these lines: such a block is not kept.
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
    """Owner of the memory of one array, which ends with the last view of it."""

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
    """Return an array of unset values; that of a large one goes back into use with the last view of it."""
    kind = np.dtype(dtype)
    count = math.prod(shape) * kind.itemsize
    return np.empty(shape, kind) if count < _LEAST else np.asarray(_PooledMemory(_POOL.take(count), shape, kind))
