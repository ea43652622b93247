import threading

import numpy  # noqa: F401  (the BLAS to be held)
from threadpoolctl import threadpool_info

from pachon.core.threads import one_blas_thread


def blas_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_one_thread_inside_and_the_old_number_after():
    before = blas_threads()
    with one_blas_thread():
        assert blas_threads() == {1}
        with one_blas_thread():
            assert blas_threads() == {1}
        assert blas_threads() == {1}
    assert blas_threads() == before


def test_one_block_at_a_time():
    inside, seen = threading.Event(), []

    def other():
        with one_blas_thread():
            seen.append(inside.is_set())

    with one_blas_thread():
        thread = threading.Thread(target=other)
        thread.start()
        thread.join(0.05)
        assert not seen  # waits for this block to end
        inside.set()
    thread.join()
    assert seen == [True]
