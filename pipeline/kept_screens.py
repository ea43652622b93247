"""Screens that a worker keeps from one job for the next: with 8192 samples a side they take seconds to make."""

from __future__ import annotations

import threading
from dataclasses import replace

from ..wavefront.atmosphere.atmosphere import Atmosphere
from .experiment import Experiment

_lock = threading.Lock()
_kept: list[Atmosphere] = []


def with_kept_screens(experiment: Experiment) -> Experiment:
    """Return an experiment with the screens of the last one in this process, where they are the same.

    Those of the last one are freed where they are others. The threads of a worker share one set.
    """
    if experiment.atmosphere is None or not experiment.screen_kinds:
        return experiment
    with _lock:
        atmosphere = experiment.atmosphere.with_screens_of(_kept[0]) if _kept else experiment.atmosphere
        if atmosphere is experiment.atmosphere:
            for before in _kept:
                before.release()
            _kept[:] = [atmosphere]
    return replace(experiment, atmosphere=atmosphere)
