"""Bounds of time, memory and messages within which wrong input is to be refused."""

import resource
import signal
from contextlib import contextmanager
from pathlib import Path

#: Time [s] that a call may take before it counts as a hang, memory [byte] for a file, and for a call with its threads.
SECONDS, MEMORY, MEMORY_OF_CALL = 2.0, 500_000_000, 2_000_000_000
#: Longest error message [lines, characters].
LINES, CHARACTERS = 3, 800


class Hang(BaseException):
    """A call that does not end."""


@contextmanager
def bounded(memory=MEMORY):
    """Limit time and memory of a block; Hang, or MemoryError."""

    def stop(*_):
        raise Hang

    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    previous = signal.signal(signal.SIGALRM, stop)
    resource.setrlimit(resource.RLIMIT_AS, (used + memory, limits[1]))
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)
        resource.setrlimit(resource.RLIMIT_AS, limits)
