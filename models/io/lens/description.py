"""The neutral description of a lens that readers of files fill in, each in the words of its format.

Frame: light enters along +z; each surface has the position of its vertex and its axes in this one frame, whatever the
file states them by. Lengths are in metres, system data in the terms of
:class:`~pachon.models.design_data.DesignData`. What is stated has its source, for messages.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from ....core.errors import PrescriptionError
from ...aperture import Aperture
from ...design_data import LENGTH_UNITS, BeamAperture, DesignData
from ...grating import Grating
from ...links import Pickup, Solve
from ...media.air import STANDARD_ATMOSPHERE, ZERO_CELSIUS
from ...media.medium import Medium
from ...rotation import rotation_angles
from ...shapes.shape import Shape
from ...surface import Interaction
from ...telescope import VACUUM
from ...thin_lens import ThinLens
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
    alone. `before` and `after` are the media on either side; `number` is that of the file. An `automatic` semi-diameter
    is that of the light of the lens as it stands in the file. Grooves are in its own axes.
    """

    source: Source
    shape: Shape
    position: np.ndarray
    axes: np.ndarray
    name: str = ""
    interaction: Interaction = Interaction.PASS
    before: Medium = VACUUM
    after: Medium = VACUUM
    aperture: Aperture | None = None
    semi_diameter: float = 0.0
    automatic: bool = False
    stop: bool = False
    distance: float | None = None
    number: int = 0
    grating: Grating | None = None
    thin_lens: ThinLens | None = None

    @property
    def off_axis(self) -> bool:
        """Whether it is decentred or tilted."""
        return bool(np.any(self.position[:2])) or not np.array_equal(self.axes, np.eye(3))

    @property
    def tilt(self) -> tuple[float, float, float]:
        """Angles about x, the new y and the new z, right-handed [rad]."""
        return (0.0, 0.0, 0.0) if np.array_equal(self.axes, np.eye(3)) else rotation_angles(self.axes)


@dataclass(frozen=True)
class StatedAperture:
    """Size of the beam as a file states it: kind and value as in DesignData."""

    kind: BeamAperture
    value: float
    source: Source


@dataclass
class LensDescription:
    """Surfaces and system data of a lens file.

    `object_distance` [m] counts from the first surface, `medium` is that in front of it. `apertures` are those that the
    file states, of which the first counts. `telecentric` is a finite object's, `largest_field` the largest distance of
    a field point from the axis in degrees or in the unit of the file.
    Each of `pickups` has the meanings that it may have, of which the first that the surfaces meet is taken.
    """

    path: Path
    format: Format
    findings: Findings
    title: str = ""
    version: str = "1"
    object_distance: float = math.inf
    medium: Medium = VACUUM
    surfaces: list[LensSurface] = field(default_factory=list)
    design: DesignData = field(default_factory=lambda: DesignData(length_unit="mm"))
    apertures: list[StatedAperture] = field(default_factory=list)
    telecentric: bool = False
    largest_field: float = 0.0
    primary_wavelength: float = 0.0
    pickups: list[tuple[Source, tuple[Pickup, ...]]] = field(default_factory=list)
    solves: list[Solve] = field(default_factory=list)
    sources: dict[str, Source] = field(default_factory=dict)

    @property
    def unit(self) -> float:
        """Unit of lengths of the file [m]."""
        return self.design.unit

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
        name = next(name for name, size in LENGTH_UNITS.items() if size == unit)
        self.design = replace(self.design, length_unit=name)

    def state_aperture(self, source: Source, kind: BeamAperture, value: float) -> None:
        """Add a size of the beam, as in DesignData."""
        self.apertures.append(StatedAperture(kind, value, source))

    def state_wavelengths(
        self, source: Source, wavelengths: Sequence[float], weights: Sequence[float] = (), primary: int = 0
    ) -> None:
        """Set vacuum wavelengths [m], their weights, 1 where they are missing, and the place of the primary one."""
        if not wavelengths or not all(0 < v < _LONGEST for v in wavelengths):
            raise source.error("positive wavelengths below a centimetre")
        self.state(source, wavelengths=tuple(wavelengths))
        self.state(source, wavelength_weights=_varied(weights, len(wavelengths)))
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
        self.state(source, field_weights=_varied(weights, len(self.design.fields)))

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

    def state_vignetted_ends(self, source: Source, *ends: Sequence[float]) -> None:
        """Set the parts of the pupil that are cut off: at the upper and the lower end along x, then along y."""
        (x, y) = (list(zip_longest(*ends[i : i + 2], fillvalue=0.0)) for i in (0, 2))
        # The pupil reaches from lower - 1 to 1 - upper.
        decentres = ([0.5 * (low - up) for up, low in column] for column in (x, y))
        compressions = ([0.5 * (low + up) for up, low in column] for column in (x, y))
        self.state_vignetting(source, *decentres, *compressions)

    def state_air(self, source: Source, celsius: float, atmospheres: float) -> None:
        """Set the temperature [deg C] and the pressure [atm] of the design."""
        self.state(source, temperature=celsius + ZERO_CELSIUS, pressure=atmospheres * STANDARD_ATMOSPHERE)

    def add(self, surface: LensSurface, *, mirror: bool = False) -> None:
        """Add a surface in the order of the light; what is in front of it, and behind a mirror, follows."""
        before = self.surfaces[-1].after if self.surfaces else self.medium
        after = before if mirror else surface.after
        passing = Interaction.PASS if after == before and surface.grating is None else Interaction.REFRACT
        if surface.thin_lens is not None:
            passing = Interaction.THIN_LENS
        followed = replace(
            surface,
            name=" ".join(surface.name.split()),
            interaction=Interaction.MIRROR if mirror else passing,
            before=before,
            after=after,
            number=surface.number or len(self.surfaces) + 1,
        )
        self.surfaces.append(followed)


def _varied(weights: Sequence[float], count: int) -> tuple[float, ...]:
    """Return the weights of a number of items, 1 where they are missing; none where all are equal."""
    full = (*weights, *(1.0,) * count)[:count]
    return full if len(set(full)) > 1 else ()
