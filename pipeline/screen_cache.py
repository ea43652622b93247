"""Cache of the phase screens in a worker process: screens of 8192 x 8192 samples take seconds to make."""

from __future__ import annotations

import threading
from dataclasses import replace

from ..wavefront.atmosphere.atmosphere import Atmosphere
from .experiment import Experiment

_cache_lock = threading.Lock()
_cached: list[Atmosphere] = []


def with_cached_screens(experiment: Experiment) -> Experiment:
    """Return the experiment with the cached screens of this process, where they are the same.

    Otherwise the cached screens are freed, and those of the experiment take their place. All threads of a worker share
    one set of screens.
    """
    if experiment.atmosphere is None or not experiment.screen_kinds:
        return experiment
    with _cache_lock:
        atmosphere = experiment.atmosphere
        if _cached and atmosphere.store.key == _cached[0].store.key:
            atmosphere = replace(atmosphere, store=_cached[0].store)
        else:
            for before in _cached:
                before.release()
            _cached[:] = [atmosphere]
    return replace(experiment, atmosphere=atmosphere)
