"""A second process: its results, errors and end."""

import os
import signal
import sys
import threading
from multiprocessing import get_context

import pytest

from pachon.core.errors import ProductError
from pachon.core.second_process import second_process

needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="no second process elsewhere")


def fails():
    raise ProductError("no space left", file="a.fits")


def dies():
    os.kill(os.getpid(), signal.SIGKILL)


@needs_linux
def test_computations_are_done_by_one_other_process():
    with second_process(2) as submit:
        first, second, product = submit(os.getpid), submit(os.getpid), submit(pow, 2, 10)
        assert first() == second() != os.getpid()
        assert product() == 1024
        other = first()
    with pytest.raises(ProcessLookupError):
        os.kill(other, 0)


class Recorded:
    """Argument that records the threads in which it is pickled."""

    def __init__(self, threads):
        self.threads = threads

    def __reduce__(self):
        self.threads.append(threading.get_ident())
        return int, (7,)


@needs_linux
def test_arguments_are_those_of_the_moment_of_the_call():
    # Pickled in another thread, an object that this one goes on to change ended a run, now and then.
    numbers, threads = [1, 2], []
    with second_process(2) as submit:
        total, seven = submit(sum, numbers), submit(abs, Recorded(threads))
        numbers.append(10)
        assert (total(), seven()) == (3, 7)
    assert threads == [threading.get_ident()]


def test_one_thread_has_one_process():
    with second_process(1) as submit:
        assert submit(os.getpid)() == os.getpid()


def test_a_process_with_other_threads_is_not_forked():
    end = threading.Event()
    waiting = threading.Thread(target=end.wait)
    waiting.start()
    try:
        with second_process(2) as submit:
            assert submit(os.getpid)() == os.getpid()
    finally:
        end.set()
        waiting.join()


def in_a_pool(_):
    with second_process(2) as submit:
        return submit(os.getpid)() == os.getpid()


@needs_linux
def test_processes_that_may_have_no_others_do_all_themselves():
    with get_context("fork").Pool(1) as pool:
        assert pool.map(in_a_pool, [0]) == [True]


@needs_linux
def test_an_error_of_the_other_process_is_raised_where_its_result_is_waited_for():
    with second_process(2) as submit:
        result = submit(fails)
        with pytest.raises(ProductError, match=r"no space left") as found:
            result()
    assert str(found.value) == str(ProductError("no space left", file="a.fits"))


@needs_linux
def test_a_killed_process_is_one_clear_line():
    with second_process(2) as submit:
        result = submit(dies)
        with pytest.raises(ProductError, match=r"^the second process died, killed or short of memory"):
            result()


@needs_linux
def test_the_other_process_ends_with_a_block_that_fails():
    found = []

    def interrupted():
        with second_process(2) as submit:
            found.append(submit(os.getpid)())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with pytest.raises(ProcessLookupError):
        os.kill(found[0], 0)
