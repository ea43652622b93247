"""The PSF engines by name."""

from __future__ import annotations

from .engine import PsfEngine
from .fast import FastPsfEngine
from .long_exposure import LongExposureEngine
from .wave import WavePsfEngine

#: Engines by name: a new one is added here.
ENGINES: dict[str, type[PsfEngine]] = {
    engine.name: engine for engine in (FastPsfEngine, WavePsfEngine, LongExposureEngine)
}
