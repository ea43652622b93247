"""Quick import of the modules that a short command needs."""

from __future__ import annotations

import gc
from collections.abc import Iterable
from importlib import import_module


def import_modules(names: Iterable[str]) -> None:
    """Import modules without searches for cyclic garbage.

    Their 100 000 to 200 000 objects stay. Searching them again and again while they are made, and ever after, takes an
    eighth of the processor time of a short command.
    """
    gc_enabled = gc.isenabled()
    gc.disable()
    try:
        for name in names:
            import_module(name)
        gc.freeze()
    finally:
        if gc_enabled:
            gc.enable()
