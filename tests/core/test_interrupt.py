"""Ctrl-C: raised at once, remembered where Python drops it."""

import os
import signal
import threading

import pytest

from pachon.core.interrupt import remembered_interrupts


class Clearing:
    """An object that the interrupt hits while it is cleared away, where Python drops exceptions."""

    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupt_is_raised_at_once():
    with remembered_interrupts(), pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupt_that_was_dropped_is_raised_by_the_next_check(capsys):
    before = signal.getsignal(signal.SIGINT)
    with remembered_interrupts() as check:
        check()
        item = Clearing()
        del item
        with pytest.raises(KeyboardInterrupt):
            check()
    assert capsys.readouterr().err == ""
    assert signal.getsignal(signal.SIGINT) is before


def test_another_thread_may_run_without_a_handler():
    done = []

    def work():
        with remembered_interrupts() as check:
            check()
            done.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [True]
