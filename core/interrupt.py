"""Reliable Ctrl-C: Python drops an interrupt that arrives while an object is deleted."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


@contextmanager
def remembered_interrupts() -> Iterator[Callable[[], None]]:
    """Record Ctrl-C inside a with block; yield a function that raises KeyboardInterrupt if it was pressed.

    An interrupt raises KeyboardInterrupt at once, as ever. Where that is dropped, in the ``__del__`` of an array, say,
    Python prints a traceback and goes on; here it prints nothing, and the next call of the function raises it again.
    """
    pressed = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    def dropped(unraisable: Any) -> None:
        if not isinstance(unraisable.exc_value, KeyboardInterrupt):
            usual(unraisable)

    # Python lets the main thread alone set handlers; elsewhere no signal arrives either.
    if threading.current_thread() is not threading.main_thread():
        yield check
        return
    before, usual = signal.signal(signal.SIGINT, handle), sys.unraisablehook
    sys.unraisablehook = dropped
    try:
        yield check
    finally:
        sys.unraisablehook = usual
        signal.signal(signal.SIGINT, before)
