"""Memory that is used again: never while a view of it lives, never more than a limit."""

import threading

import numpy as np
import pytest

from pachon.core import buffers

COUNT = 1 << 18  #: float64 numbers of 2 MB


@pytest.fixture(autouse=True)
def blocks(monkeypatch):
    """No blocks yet."""
    monkeypatch.setattr(buffers, "_POOL", buffers._MemoryPool())
    return lambda: buffers._POOL


def test_memory_is_used_again_once_the_last_view_is_gone():
    first = buffers.empty((COUNT,))
    first[:] = 1.0
    address, view = first.ctypes.data, first.reshape(2, -1).T[1:]
    del first
    other = buffers.empty((COUNT,))
    other[:] = 2.0
    assert other.ctypes.data != address
    assert (view == 1.0).all()
    del view
    assert buffers.empty((2, COUNT // 2)).ctypes.data == address


def test_a_block_of_another_size_is_left(blocks):
    array = buffers.empty((COUNT,))
    address = array.ctypes.data
    del array
    for other in (2 * COUNT, COUNT // 2):
        array = buffers.empty((other,))
        assert array.flags.writeable
        assert array.ctypes.data != address
    # A little smaller is as good.
    other = buffers.empty((COUNT - 100,), np.int64)
    assert (other.shape, other.dtype) == ((COUNT - 100,), np.int64)
    assert other.ctypes.data == address
    assert blocks().size == 8 * 2 * COUNT  # the first of the others


def test_small_arrays_are_numpys_own(blocks):
    array = buffers.empty((100, 3), np.int32)
    assert array.flags.owndata
    assert (array.shape, array.dtype) == ((100, 3), np.int32)
    del array
    assert blocks().size == 0


def test_the_oldest_go_where_it_is_too_much(blocks, monkeypatch):
    monkeypatch.setattr(buffers, "MOST", 40 * COUNT)
    many = [buffers.empty((COUNT,)) for _ in range(8)]
    last = many[-1].ctypes.data
    while many:
        del many[0]
    assert blocks().size == 40 * COUNT
    assert buffers.empty((COUNT,)).ctypes.data == last


def test_threads_never_share_memory():
    wrong = []

    def work(number):
        for _ in range(50):
            array = buffers.empty((COUNT,))
            array[::64] = number
            if not (array[::64] == number).all():
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
