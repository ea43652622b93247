"""The PSF engines by name."""

from __future__ import annotations

from ...core.errors import check_choice
from .engine import PsfEngine
from .fast import FastEngine
from .long_exposure import LongExposureEngine
from .statistical import StatisticalEngine
from .wave import WaveEngine

#: Engines by name: a new one is added here.
ENGINES: dict[str, type[PsfEngine]] = {
    engine.name: engine for engine in (FastEngine, WaveEngine, LongExposureEngine, StatisticalEngine)
}


def psf_engine(engine: str | PsfEngine) -> PsfEngine:
    """Return an engine, or that of a name with its default options; an unknown name is a ConfigError."""
    if isinstance(engine, PsfEngine):
        return engine
    check_choice("engine", engine, ENGINES)
    return ENGINES[engine]()
