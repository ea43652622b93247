"""Read a Zemax lens file: its blocks as the surfaces of a lens.

Coordinate breaks become positions and rotations of the surfaces behind them, and nothing else remains of them. A line
that is not understood is an error that names file, surface and keyword, or with `lenient` a warning; keywords that have
no effect on rays are listed in `file`. The page docs/reference/zemax.md has the tables.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ...media.medium import Medium
from ...rotation import rotation_matrix
from ...surface import Interaction
from ...telescope import VACUUM
from ..lens.axial_ray import AxialRay
from ..lens.description import LensDescription, LensSurface
from ..lens.glasses import Glasses, numbered_glass, offset_glass
from ..lens.source import Findings, Source
from .apertures import read_aperture
from .configurations import with_configuration
from .file import IGNORED_HEADER, IGNORED_SURFACE, Block, ZemaxFile, read_zemax_file
from .links import state_links
from .shapes import read_grating, read_shape, read_thin_lens
from .system import FORMAT, object_distance, read_system

#: Name of a glass without a name.
NO_NAME = "___BLANK"
#: Solve of a glass whose index and Abbe number differ from those of the catalogue.
_OFFSET = 4
#: Index and Abbe number that Zemax writes behind the name of a catalogue glass, whatever the glass.
PLACEHOLDER = (1.5, 40.0)


def read_zemax_lens(
    path: Path, findings: Findings, glasses: Glasses, configuration: int | None = None
) -> LensDescription:
    """Return the description of a Zemax lens file, of several configurations by default of the one it was saved in."""
    return described(read_zemax_file(path), findings, glasses, configuration)


def described(
    file: ZemaxFile, findings: Findings, glasses: Glasses, configuration: int | None = None
) -> LensDescription:
    """Return the description of the parts of a lens file."""
    return _LensReader(with_configuration(file, configuration, findings), findings, glasses).lens()


class _LensReader:
    """Surfaces of a file one after the other, with the local frame of the light."""

    def __init__(self, file: ZemaxFile, findings: Findings, glasses: Glasses) -> None:
        self.file = file
        self.findings = findings
        self.glasses = glasses
        self.description = LensDescription(file.path, FORMAT, findings)
        self.origin, self.axes = np.zeros(3), np.eye(3)
        #: Distance along the axis from the last surface [m].
        self.distance = 0.0
        #: The paraxial marginal ray, where thicknesses are solved for.
        self.axial_ray: AxialRay | None = None
        #: Whether a coordinate break is marked as the stop, which the next surface is then.
        self.stop_ahead = False

    def lens(self) -> LensDescription:
        """Return the description of the lens."""
        lens, header, first = self.description, self.file.header, self.file.surfaces[0]
        lens.medium = self._glass(first)[1]
        read_system(lens, header)
        lens.object_distance = object_distance(first, lens.unit)
        if self.file.solved and lens.design.wavelengths:
            self.axial_ray = self._axial_ray()
        for number, block in enumerate(self.file.surfaces[1:], start=1):
            self._surface(number, block)
            block.report_rest(IGNORED_SURFACE, self.findings)
        header.report_rest(IGNORED_HEADER, self.findings)
        first.used |= {"TYPE", "CURV", "DISZ", "CONI"}
        first.report_rest(IGNORED_SURFACE, self.findings)
        state_links(lens, self.file.surfaces)
        return lens

    def _surface(self, number: int, block: Block) -> None:
        last = number == len(self.file.surfaces) - 1
        self.stop_ahead |= bool(block.all("STOP"))
        kind = block.text("TYPE").split()[:1]
        thickness = block.number("DISZ", 0.0, infinite=True) * self.description.unit
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
            self._acting(number, block)
        if self.axial_ray is not None:
            if number in self.file.solved and not last:
                with Source(block.file, block.place).context():
                    thickness = self.axial_ray.solved_thickness(0.0, "MAZH")
            self.axial_ray.advance(thickness)
        self.distance += thickness
        self.origin = self.origin + self.axes[:, 2] * thickness

    def _axial_ray(self) -> AxialRay:
        """Return the marginal ray in front of the first surface, of any height."""
        lens = self.description
        index = float(lens.medium.index(lens.primary_wavelength))
        finite = math.isfinite(lens.object_distance)
        ray = AxialRay(0.0, 1.0, index, scaled=False) if finite else AxialRay(1.0, 0.0, index, scaled=False)
        ray.advance(lens.object_distance if finite else 0.0)
        return ray

    def _pass_axial_ray(self) -> None:
        """Refract or reflect the marginal ray at the last surface."""
        if self.axial_ray is None:
            return
        surface, before = self.description.surfaces[-1], self.axial_ray.index
        index = float(surface.after.index(self.description.primary_wavelength))
        after = -before if surface.interaction == Interaction.MIRROR else math.copysign(index, before)
        self.axial_ray.pass_surface(surface.shape.curvatures[1], after)

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
        shift = np.array([dx, dy, 0.0]) * self.description.unit
        if backwards:
            for axis in (2, 1, 0):
                self.axes = self.axes @ rotation_matrix(np.where(np.arange(3) == axis, angles, 0.0))
            self.origin = self.origin + self.axes @ shift
        else:
            self.origin = self.origin + self.axes @ shift
            self.axes = self.axes @ rotation_matrix(angles)

    def _acting(self, number: int, block: Block) -> None:
        lens, source = self.description, Source(block.file, block.place)
        with source.context():
            shape = read_shape(block, lens.unit, self.findings)
            aperture = read_aperture(block, lens.unit, self.findings)
            grating, thin_lens = read_grating(block), read_thin_lens(block, lens.unit)
        mirror, medium = self._glass(block)
        if thin_lens is not None and mirror:
            raise block.problem("TYPE PARAXIAL, GLAS MIRROR: a thin lens that reflects is not read")
        surface = LensSurface(
            source,
            shape,
            self.origin,
            self.axes,
            name=block.text("COMM"),
            after=medium,
            aperture=aperture,
            semi_diameter=block.number("DIAM", 0.0) * lens.unit,
            automatic=_automatic_semi_diameter(block),
            stop=self.stop_ahead,
            distance=self.distance,
            number=number,
            grating=grating,
            thin_lens=thin_lens,
        )
        lens.add(surface, mirror=mirror)
        self._pass_axial_ray()
        self.stop_ahead, self.distance = False, 0.0

    def _glass(self, block: Block) -> tuple[bool, Medium]:
        """Return whether a surface is a mirror, and the medium behind it where it is not."""
        line = block.last("GLAS")
        if line is None or not line.words:
            return False, VACUUM
        name = line.words[0].upper()
        if name == "MIRROR":
            return True, VACUUM
        if name in self.file.glasses:
            return False, self.file.glasses[name]
        nd, vd, deviation = line.number(3, 0.0), line.number(4, 0.0), line.number(5, 0.0)
        # The second word: 1 is a model glass, defined by the numbers that follow and not by its name; 2 a glass picked
        # up from another surface, a model glass too where it has no name.
        solve = line.number(1, 0.0)
        model = nd > 0 and (solve == 1 or (solve == 2 and name == NO_NAME))
        if not model:
            medium = self.glasses.get(name, self.file.header.text("GCAT").split())
            if medium is not None:
                return False, offset_glass(
                    medium, line.number(9, 0.0), line.number(10, 0.0), line
                ) if solve == _OFFSET else medium
            error = self.glasses.missing(name, line)
            if nd <= 0 or (nd, vd) == PLACEHOLDER:
                raise error
            self.findings.report(error, "taken as a model glass of its indices")
        return False, numbered_glass(nd, vd, deviation, name, line)


def _automatic_semi_diameter(block: Block) -> bool:
    """Return whether Zemax computes the semi-diameter of a surface, of the light as it is: DIAM with 0 behind it."""
    line = block.last("DIAM")
    return line is not None and len(line.words) > 1 and line.number(1) == 0
