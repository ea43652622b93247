"""The neutral description of a lens that readers of files fill in, each in the words of its format.

Frame: light enters along +z; each surface has the position of its vertex and its axes in this one frame, whatever the
file states them by. Lengths are in metres, system data in the terms of
:class:`~pachon.models.design_data.DesignData`. What is stated has its source, for messages.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ....core.errors import PrescriptionError
from ...aperture import Aperture
from ...design_data import LENGTH_UNITS, DesignData
from ...links import Pickup, Solve
from ...media.medium import Medium
from ...shapes.shape import Shape
from ...surface import Interaction
from ...telescope import VACUUM
from .source import Findings, Source

#: Name of the plane that writers put in front to carry the entrance pupil.
PUPIL_PLANE = "pachon entrance pupil"
#: Distance of an object, in units of the file, from which it is at infinity.
INFINITE = 1e9
#: Longest wavelength of a file [m].
_LONGEST = 1e-2
#: Largest angle of a field from the axis [rad].
WIDEST = math.radians(89.0)


@dataclass(frozen=True)
class Format:
    """Name of the program of a format, and its words for what every lens file has to state, for messages."""

    program: str
    aperture: str
    wavelengths: str
    stop: str


@dataclass(frozen=True, eq=False)
class LensSurface:
    """A surface of a lens, shape and aperture in its own axes.

    `position` [m] and `axes` (columns, [3, 3]) are in the frame of the lens, `distance` is that along the axis of the
    light from the surface before it [m], negative behind an odd number of mirrors; None if its file states places
    alone. `before` and `after` are the media on either side; `number` is that of the file.
    """

    name: str
    interaction: Interaction
    shape: Shape
    position: np.ndarray
    axes: np.ndarray
    before: Medium
    after: Medium
    aperture: Aperture | None = None
    semi_diameter: float | None = None
    stop: bool = False
    distance: float | None = None
    number: int = 0
    source: Source = field(default_factory=lambda: Source(""))


@dataclass(frozen=True)
class StatedAperture:
    """Size of the beam as a file states it: kind and value as in DesignData."""

    kind: str
    value: float
    source: Source


@dataclass
class LensDescription:
    """Surfaces and system data of a lens file.

    `unit` is that of the file [m]; `object_distance` [m] counts from the first surface, `medium` is that in front of
    it. `apertures` are those that the file states, of which the first counts. `telecentric` is a finite object's,
    `largest_field` the largest distance of a field point from the axis in degrees or in the unit of the file.
    Each of `pickups` has the meanings that it may have, of which the first that the surfaces meet is taken.
    """

    path: Path
    format: Format
    findings: Findings
    title: str = ""
    version: str = "1"
    unit: float = 1e-3
    object_distance: float = math.inf
    medium: Medium = VACUUM
    surfaces: list[LensSurface] = field(default_factory=list)
    design: DesignData = field(default_factory=DesignData)
    apertures: list[StatedAperture] = field(default_factory=list)
    telecentric: bool = False
    largest_field: float = 0.0
    primary_wavelength: float = 0.0
    pickups: list[tuple[Source, tuple[Pickup, ...]]] = field(default_factory=list)
    solves: list[Solve] = field(default_factory=list)
    sources: dict[str, Source] = field(default_factory=dict)

    def problem(self, text: str) -> PrescriptionError:
        """Return an error of the file as a whole."""
        return PrescriptionError(text, file=self.path)

    def state(self, source: Source, **values: Any) -> None:
        """Set design data; PrescriptionError of the statement if they are not as expected."""
        with source.context():
            self.design = replace(self.design, **values)
        self.sources |= dict.fromkeys(values, source)

    def state_unit(self, unit: float) -> None:
        """Set the unit of lengths [m]."""
        self.unit = unit
        name = next(name for name, size in LENGTH_UNITS.items() if size == unit)
        self.design = replace(self.design, length_unit=name)

    def state_aperture(self, source: Source, kind: str, value: float) -> None:
        """Add a size of the beam, as in DesignData."""
        self.apertures.append(StatedAperture(kind, value, source))

    def state_wavelengths(
        self, source: Source, wavelengths: Sequence[float], weights: Sequence[float] = (), primary: int = 0
    ) -> None:
        """Set vacuum wavelengths [m], their weights and the place of the primary one."""
        if not wavelengths or not all(0 < v < _LONGEST for v in wavelengths):
            raise source.error("positive wavelengths below a centimetre")
        self.state(source, wavelengths=tuple(wavelengths))
        if len(set(weights)) > 1:
            self.state(source, wavelength_weights=tuple(weights))
        self.primary_wavelength = wavelengths[primary]

    def state_fields(self, source: Source, kind: str, points: Iterable[Sequence[float]]) -> None:
        """Set field points [n, 2], in degrees or in the unit of the file, in the frame of the lens."""
        rows = np.array(list(points), dtype=np.float64).reshape(-1, 2)
        if kind == "angle" and not np.all(np.hypot(*rows.T) < math.degrees(WIDEST)):
            raise source.problem(f"{source.keyword}: expected fields within 89 degrees of the axis")
        self.largest_field = float(np.hypot(*rows.T).max(initial=0.0))
        # x changes its sign between the axes of the lens and those of a telescope.
        scale = math.radians(1.0) if kind == "angle" else self.unit
        mirrored = rows * np.array([-scale, scale]) + 0.0
        self.state(source, field_type=kind, fields=tuple(map(tuple, mirrored.tolist())))

    def state_field_weights(self, source: Source, weights: Sequence[float]) -> None:
        """Set the weights of the fields; what is missing is 1."""
        count = len(self.design.fields)
        full = (*weights, *(1.0,) * count)[:count]
        if len(set(full)) > 1:
            self.state(source, field_weights=full)

    def state_vignetting(self, source: Source, *columns: Sequence[float]) -> None:
        """Set decentres and compressions of the pupil along x and y, and its angles [deg], of the fields.

        What is missing is 0.
        """
        count = len(self.design.fields)
        rows = np.array([(*column, *(0.0,) * count)[:count] for column in columns]).reshape(-1, count).T
        rows = np.pad(rows, ((0, 0), (0, 5 - rows.shape[1])))
        mirrored = rows * np.array([-1.0, 1.0, 1.0, 1.0, -math.radians(1.0)]) + 0.0
        if mirrored.any():
            self.state(source, vignetting=tuple(map(tuple, mirrored.tolist())))

    def add(
        self,
        source: Source,
        shape: Shape,
        position: np.ndarray,
        axes: np.ndarray,
        *,
        name: str = "",
        mirror: bool = False,
        medium: Medium = VACUUM,
        aperture: Aperture | None = None,
        semi_diameter: float = 0.0,
        stop: bool = False,
        distance: float | None = None,
        number: int | None = None,
    ) -> None:
        """Add a surface in the order of the light; `medium` is that behind one that is no mirror."""
        before = self.surfaces[-1].after if self.surfaces else self.medium
        after = before if mirror else medium
        passing = Interaction.PASS if after == before else Interaction.REFRACT
        surface = LensSurface(
            name=" ".join(name.split()),
            interaction=Interaction.MIRROR if mirror else passing,
            shape=shape,
            position=position,
            axes=axes,
            before=before,
            after=after,
            aperture=aperture,
            semi_diameter=semi_diameter if semi_diameter > 0 else None,
            stop=stop,
            distance=distance,
            number=len(self.surfaces) + 1 if number is None else number,
            source=source,
        )
        self.surfaces.append(surface)
