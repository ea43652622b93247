"""The threads that run slices of launches beside the caller's."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cache

# More than any machine has processors; threads are started as they are needed.
_MOST_THREADS = 4096
_NAME = "pachon-launch"


@cache
def helpers() -> ThreadPoolExecutor:
    """Return the threads, which stay from one launch to the next: starting two takes 0.3 ms.

    They run slices alone, which wait for nothing, so that launches from several threads at once cannot block each
    other.
    """
    return ThreadPoolExecutor(_MOST_THREADS, thread_name_prefix=_NAME)


def end_if_alone() -> bool:
    """End the threads, for a fork, and return whether the caller's is the only other one; if not, let them be.

    The next launch starts new ones.
    """
    others = [thread for thread in threading.enumerate() if not thread.name.startswith(_NAME)]
    if len(others) > 1:
        return False
    helpers().shutdown()
    helpers.cache_clear()
    return True


# A forked process has none of the threads of its parent.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=helpers.cache_clear)
