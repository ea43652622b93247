"""Screens that a worker keeps from one job for the next: with 8192 samples a side they take seconds to make."""

from __future__ import annotations

import threading
from dataclasses import replace

from ..wavefront.atmosphere.atmosphere import Atmosphere
from .experiment import Experiment

_cache_lock = threading.Lock()
_cached: list[Atmosphere] = []


def with_cached_screens(experiment: Experiment) -> Experiment:
    """Return an experiment with the screens of the last one in this process, where they are the same.

    Those of the last one are freed where they are others. The threads of a worker share one set.
    """
    if experiment.atmosphere is None or not experiment.screen_kinds:
        return experiment
    with _cache_lock:
        atmosphere = experiment.atmosphere.with_screens_of(_cached[0]) if _cached else experiment.atmosphere
        if atmosphere is experiment.atmosphere:
            for before in _cached:
                before.release()
            _cached[:] = [atmosphere]
    return replace(experiment, atmosphere=atmosphere)
