"""The PSF engines by name."""

from __future__ import annotations

from typing import Literal

from ...core.errors import check_choice
from .engine import PsfEngine
from .fast import FastEngine
from .long_exposure import LongExposureEngine
from .statistical import StatisticalEngine
from .wave import WaveEngine

EngineName = Literal["fast", "wave", "long_exposure", "statistical"]
#: Engines by name: a new one is added here.
ENGINES: dict[EngineName, type[PsfEngine]] = {
    "fast": FastEngine,
    "wave": WaveEngine,
    "long_exposure": LongExposureEngine,
    "statistical": StatisticalEngine,
}


def psf_engine(engine: EngineName | PsfEngine) -> PsfEngine:
    """Return an engine, or that of a name with its default options; an unknown name is a ConfigError."""
    if isinstance(engine, PsfEngine):
        return engine
    check_choice("engine", engine, ENGINES)
    return ENGINES[engine]()
