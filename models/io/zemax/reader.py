"""Read a sequential lens file as a telescope, from its parts in the terms of Zemax.

Frame: Zemax sends light along +z, a telescope along -z. The telescope's axes are those of the object space of the
file rotated by half a turn about y, ``(x, y, z) = (-X, Y, Z0 - Z)``; `Z0` is where the first surface with power lies,
so that its vertex is at z = 0. A field of the file at angles (tx, ty) is the field (-tx, ty) here. Coordinate breaks
become positions and rotations of the surfaces behind them, and nothing else remains of them.

A line that is not understood is an error that names file, surface and keyword, or with `lenient` a warning; keywords
that have no effect on rays are listed in `file`. The page docs/zemax.md has the tables.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ....core.errors import PrescriptionError, error_context
from ...design_data import DesignData
from ...element_groups import element_groups
from ...media.dispersion import model_glass
from ...media.medium import Medium, RelativeToAir
from ...paraxial import ParaxialSurfaces
from ...rotation import rotation_matrix
from ...shapes.shape import Plane
from ...surface import Interaction, Surface
from ...telescope import VACUUM, Telescope
from ...thickness import impossible_thicknesses
from ..glass_catalogue import GlassCatalogue
from ..glass_search import find_glass, glass_hint
from .apertures import read_aperture
from .design import Fields, length_unit, read_aiming, read_environment, read_fields, stated_fields
from .file import IGNORED_HEADER, IGNORED_SURFACE, Block, Findings, ZemaxFile
from .frame import HALF_TURN, rotated_aperture, rotated_axes, rotated_shape
from .links import with_links
from .shapes import read_shape
from .system import UNITS, Pupil, Wavelengths, read_pupil, read_wavelengths

#: Comment of the plane that the writer puts in front to carry the entrance pupil.
PUPIL_COMMENT = "pachon entrance pupil"
#: Name of a glass without a name.
NO_NAME = "___BLANK"
#: Index and Abbe number that Zemax writes behind the name of a catalogue glass, whatever the glass.
PLACEHOLDER = (1.5, 40.0)


def read_lens(
    path: Path,
    parts: Callable[[Path, Findings], ZemaxFile],
    *,
    lenient: bool = False,
    glass_catalogues: Iterable[GlassCatalogue | str | os.PathLike[str]] = (),
) -> Telescope:
    """Read a lens file of Zemax or CODE V; `parts` reads its parts in the terms of a Zemax file.

    Lengths are in metres, indices as in the file: relative to air, whose index is 1.
    """
    findings = Findings(lenient)
    with error_context(file=path):
        file = parts(path, findings)
        catalogues = [c if isinstance(c, GlassCatalogue) else GlassCatalogue.read(c) for c in glass_catalogues]
        beside = path.with_suffix(".agf")
        catalogues += [GlassCatalogue.read(beside)] if beside.is_file() else []
        telescope = _LensReader(file, findings, catalogues).telescope()
    for text in impossible_thicknesses(telescope):
        findings.note(PrescriptionError(text, file=path), "read as it is: rays go back within it")
    return telescope


class _LensReader:
    """Surfaces of a file one after the other, with the local frame and the medium of the light."""

    def __init__(self, file: ZemaxFile, findings: Findings, catalogues: list[GlassCatalogue]) -> None:
        self.file = file
        self.findings = findings
        self.catalogues = catalogues
        words = file.header.text("UNIT").split() or ["MM"]
        if words[0].upper() not in UNITS:
            raise file.header.problem(f"UNIT {words[0]}: expected one of {', '.join(UNITS)}")
        self.unit = UNITS[words[0].upper()]
        self.origin, self.axes = np.zeros(3), np.eye(3)
        self.medium = self.first_medium = self._glass(file.surfaces[0], VACUUM)[1]
        self.surfaces: list[Surface] = []
        self.names: dict[int, str] = {}
        self.paraxial = ParaxialSurfaces()
        self.stop: Block | None = None

    def telescope(self) -> Telescope:
        """Return the telescope that the file describes."""
        header, findings = self.file.header, self.findings
        waves, fields = read_wavelengths(header), read_fields(header)
        self._check_environment()
        pupil_plane = False
        for number, block in enumerate(self.file.surfaces[1:], start=1):
            comment = block.text("COMM")
            if block.all("STOP"):
                self.stop = block
                self.paraxial.mark_stop(block.number("DIAM", 0.0) * self.unit)
                pupil_plane = number == 1 and comment == PUPIL_COMMENT
            self._surface(number, block)
            block.report_rest(IGNORED_SURFACE, findings)
        if self.stop is None:
            findings.report(header.problem("no surface is the stop (STOP)"), "the first is taken")
            self.paraxial.mark_stop(0.0, first=True)
        pupil = read_pupil(self.file, self.paraxial, self.unit, waves.primary, fields, findings)
        stop = None if pupil_plane else self.surfaces[self.paraxial.stop].name
        data = self._design_data(fields, waves, pupil, stop)
        header.report_rest(IGNORED_HEADER, findings)
        self.file.surfaces[0].used |= {"TYPE", "CURV", "DISZ", "CONI"}
        self.file.surfaces[0].report_rest(IGNORED_SURFACE, findings)
        if pupil_plane:
            del self.surfaces[0]
            del self.names[1]
        z0 = _first_power(self.surfaces)
        surfaces = tuple(self._placed(s, z0) for s in self.surfaces)
        low, high = self._wavelength_range(waves.values)
        reach = max(max(abs(v) for s in surfaces for v in s.vertex), abs(pupil.image.z + z0), pupil.diameter)
        limit = min(max(2 * pupil.field_radius, math.radians(5.0)), math.radians(85.0))
        telescope = Telescope(
            name=self.file.path.stem,
            source=f"{self.file.program} file {self.file.path.name}",
            version=(header.text("VERS").split() or ["1"])[0],
            description=header.text("NAME"),
            surfaces=surfaces,
            # Heights count against the light.
            stop_z=float(z0 - pupil.image.z) + 0.0,
            pupil_diameter=pupil.diameter,
            pupil_obscuration=0.0,
            launch_distance=3.0 * reach / math.cos(limit),
            reference_sphere_radius=pupil.reference_radius,
            field_radius=pupil.field_radius,
            field_limit=limit,
            wavelength_range=(low, high),
            default_wavelength=waves.primary,
            band=waves.band(low, high),
            medium_before=self.first_medium,
            object_distance=float(z0 + pupil.image.object_distance),
            groups=element_groups(surfaces, self.first_medium),
            design_data=data,
        )
        return with_links(telescope, self.file.surfaces, self.names, self.unit, findings)

    def _design_data(self, fields: Fields, waves: Wavelengths, pupil: Pupil, stop: str | None) -> DesignData:
        telecentric = pupil.image.telecentric
        aiming = read_aiming(self.file.header)
        temperature, pressure = read_environment(self.file.header)
        return DesignData(
            length_unit=length_unit(self.unit),
            aperture=pupil.aperture[0],
            aperture_value=pupil.aperture[1],
            stop=stop,
            # Zemax aims no rays in a telecentric object space; a file without a stop has nothing to aim at.
            aiming="off" if telecentric or stop is None else aiming,
            **stated_fields(fields, self.unit),
            wavelengths=waves.values,
            wavelength_weights=waves.weights if len(set(waves.weights)) > 1 else (),
            temperature=temperature,
            pressure=pressure,
            telecentric=telecentric,
            afocal=fields.afocal,
        )

    def _check_environment(self) -> None:
        line = self.file.header.last("ENVD")
        if line is not None and line.number(2, 0.0) != 0 and (line.number(0), line.number(1, 1.0)) != (20.0, 1.0):
            text = f"{line.shown}: indices are not adjusted to temperature and pressure"
            self.findings.report(line.problem(text))

    def _surface(self, number: int, block: Block) -> None:
        last = number == len(self.file.surfaces) - 1
        kind = block.text("TYPE").split()[:1]
        thickness = block.number("DISZ", 0.0, infinite=True) * self.unit
        if not math.isfinite(thickness):
            if not last:
                raise block.problem("DISZ INFINITY: expected a finite thickness")
            thickness = 0.0
        if kind and kind[0].upper() == "COORDBRK":
            if last:
                raise block.problem("TYPE COORDBRK: expected the image as the last surface")
            self._break(block)
        else:
            self._tilt(block)
            self._acting(number, block, last)
        self.paraxial.advance(thickness)
        self.origin = self.origin + self.axes[:, 2] * thickness

    def _break(self, block: Block) -> None:
        values = block.table("PARM")
        for i in sorted(set(values) - {1, 2, 3, 4, 5, 6}):
            if values[i] != 0:
                self.findings.report(block.problem(f"PARM {i} {values[i]:g}: not understood for TYPE COORDBRK"))
        block.used |= {"CURV", "CONI", "GLAS", "XDAT"}
        dx, dy, *tilt = (values.get(i, 0.0) for i in range(1, 6))
        self._move(dx, dy, tilt, backwards=values.get(6, 0.0) != 0)

    def _tilt(self, block: Block) -> None:
        """Apply the tilt and decentre of a surface itself, before it."""
        for line in block.all("SCBD"):
            numbers = [line.number(i, 0.0) for i in range(len(line.words))]
            if not any(numbers[3:]):
                continue
            if numbers[:3] != [1.0, 0.0, 0.0] or len(numbers) < 8:
                text = f"{line.shown}: only a tilt before the surface (SCBD 1 0 0) is read"
                self.findings.report(line.problem(text))
                continue
            self._move(numbers[3], numbers[4], numbers[5:8], backwards=False)

    def _move(self, dx: float, dy: float, tilt: list[float], *, backwards: bool) -> None:
        """Decentre, then tilt about x, the new y, the new z [deg]; backwards: tilts first, and z before y and x."""
        angles = np.radians(tilt)
        shift = np.array([dx, dy, 0.0]) * self.unit
        if backwards:
            for axis in (2, 1, 0):
                self.axes = self.axes @ rotation_matrix(np.where(np.arange(3) == axis, angles, 0.0))
            self.origin = self.origin + self.axes @ shift
        else:
            self.origin = self.origin + self.axes @ shift
            self.axes = self.axes @ rotation_matrix(angles)

    def _acting(self, number: int, block: Block, last: bool) -> None:
        try:
            with error_context(file=block.source, place=block.place):
                shape = read_shape(block, self.unit, self.findings)
                aperture = read_aperture(block, self.unit, self.findings)
        except (OverflowError, ZeroDivisionError):
            raise block.problem("the parameters of its shape are too large or too small") from None
        mirror, after = self._glass(block, VACUUM)
        if mirror:
            interaction, after = Interaction.MIRROR, self.medium
        elif last:
            interaction, after = Interaction.DETECTOR, self.medium
        else:
            interaction = Interaction.PASS if after == self.medium else Interaction.REFRACT
        semi_diameter = block.number("DIAM", 0.0) * self.unit
        self.names[number] = self._name(number, block.text("COMM"), last)
        self.paraxial.add(shape.curvatures, self.medium, after, mirror=mirror)
        self.medium = after
        x, y, z = (float(v) for v in self.origin)
        self.surfaces.append(
            Surface(
                name=self.names[number],
                interaction=interaction,
                shape=rotated_shape(shape),
                vertex=(x, y, z),
                medium_after=after,
                aperture=None if aperture is None else rotated_aperture(aperture),
                rotation=rotated_axes(self.axes),
                semi_diameter=semi_diameter if semi_diameter > 0 else None,
            )
        )

    def _name(self, number: int, comment: str, last: bool) -> str:
        taken = {s.name for s in self.surfaces}
        name = " ".join(comment.split()) or ("Image" if last else f"S{number}")
        return name if name not in taken else f"{name} (S{number})"

    def _glass(self, block: Block, none: Medium) -> tuple[bool, Medium]:
        """Return whether a surface is a mirror, and the medium behind it where it is not."""
        line = block.last("GLAS")
        if line is None or not line.words:
            return False, none
        name = line.words[0].upper()
        if name == "MIRROR":
            return True, none
        if name in self.file.glasses:
            return False, self.file.glasses[name]
        nd, vd, deviation = line.number(3, 0.0), line.number(4, 0.0), line.number(5, 0.0)
        # The second word: 1 is a model glass, defined by the numbers that follow and not by its name; 2 a glass picked
        # up from another surface, a model glass too where it has no name.
        solve = line.number(1, 0.0)
        model = nd > 1 and (solve == 1 or (solve == 2 and name == NO_NAME))
        if not model:
            found = find_glass(name, self.catalogues)
            if found is not None:
                return False, found
            hint = glass_hint(name, self.catalogues)
            error = line.problem(f"{line.shown}: the glass is in no catalogue: {hint}")
            if nd <= 1 or (nd, vd) == PLACEHOLDER:
                raise error
            self.findings.report(error, "taken as a model glass of its indices")
        try:
            return False, replace(model_glass(nd, vd, deviation), name=name)
        except PrescriptionError as problem:
            raise line.problem(f"{line.shown}: {problem}") from None

    def _placed(self, surface: Surface, z0: float) -> Surface:
        x, y, z = HALF_TURN @ (np.array(surface.vertex) - np.array([0.0, 0.0, z0])) + 0.0
        return replace(surface, vertex=(float(x), float(y), float(z)))

    def _wavelength_range(self, waves: tuple[float, ...]) -> tuple[float, float]:
        low, high = min(0.1e-6, *waves), max(20e-6, *waves)
        for medium in (self.first_medium, *(s.medium_after for s in self.surfaces)):
            glass = medium.relative if isinstance(medium, RelativeToAir) else medium
            covered = getattr(glass, "wavelength_range", ())
            if not covered:
                continue
            if not covered[0] <= min(waves) <= max(waves) <= covered[1]:
                raise self.file.header.problem(
                    f"WAVM {min(waves) * 1e6:g} to {max(waves) * 1e6:g} um: expected "
                    f"{covered[0] * 1e6:g} to {covered[1] * 1e6:g} um, which glass {medium.name} covers"
                )
            low, high = max(low, covered[0]), min(high, covered[1])
        return low, high


def _first_power(surfaces: list[Surface]) -> float:
    """Return where along the axis the first curved mirror or lens surface is, or else the first flat one."""
    acting = [s for s in surfaces if s.interaction in (Interaction.MIRROR, Interaction.REFRACT)]
    curved = [s for s in acting if not isinstance(s.shape, Plane)]
    return (curved or acting or surfaces)[0].vertex[2]
