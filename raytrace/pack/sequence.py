"""Surfaces in the order of the light, apart from a telescope."""

from __future__ import annotations

from dataclasses import dataclass

from ...models.media.medium import Medium
from ...models.obstruction import Obstruction
from ...models.surface import Surface
from ...models.telescope import VACUUM


@dataclass(frozen=True)
class SurfaceSequence:
    """Surfaces without pupil, fields or wavelengths; packed as those of a telescope."""

    surfaces: tuple[Surface, ...]
    medium_before: Medium = VACUUM
    obstructions: tuple[Obstruction, ...] = ()
