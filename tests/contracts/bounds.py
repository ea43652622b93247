"""Bounds of time, memory and messages within which wrong input is to be refused."""

import resource
import signal
from contextlib import ExitStack, contextmanager
from pathlib import Path

#: Times that a call may take before it counts as a hang [s]: of the processor, and by the clock of a busy machine.
SECONDS, PATIENCE = 2.0, 60.0
#: Memory for a file, and for a call with its threads [byte].
MEMORY, MEMORY_OF_CALL = 500_000_000, 2_000_000_000
#: Longest error message [lines, characters].
LINES, CHARACTERS = 3, 800


class Hang(BaseException):
    """A call that does not end."""


@contextmanager
def bounded(memory=MEMORY, processor_seconds=SECONDS):
    """Limit time and memory of a block; Hang, or MemoryError."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    with ExitStack() as after:
        for name, timer, seconds in (
            (signal.SIGPROF, signal.ITIMER_PROF, processor_seconds),
            (signal.SIGALRM, signal.ITIMER_REAL, PATIENCE * processor_seconds / SECONDS),
        ):
            after.callback(signal.signal, name, signal.signal(name, _stop))
            after.callback(signal.setitimer, timer, 0.0)
            signal.setitimer(timer, seconds)
        resource.setrlimit(resource.RLIMIT_AS, (used + memory, limits[1]))
        after.callback(resource.setrlimit, resource.RLIMIT_AS, limits)
        yield


def _stop(*_):
    raise Hang
