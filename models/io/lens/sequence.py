"""Surfaces and system data of a telescope in the terms of a lens file: light along +z, one axis, a unit of length.

Every surface stands on the axis of the object space, a thickness behind the one before it, decentred and tilted by
itself; the next one counts from the axis again. Where stop and stated aperture make the telescope's entrance pupil,
they are written; else a plane of its own in front, whose comment the reader knows, carries the stop.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ....core.errors import PrescriptionError, error_context
from ...design_data import DesignData
from ...media.air import STANDARD_ATMOSPHERE, ZERO_CELSIUS
from ...media.medium import ConstantIndex, Medium
from ...media.tabulated import TabulatedIndex
from ...paraxial import stop_makes_pupil, stop_states_rays, with_true_aperture
from ...shapes.shape import Plane
from ...surface import Interaction, Surface
from ...telescope import VACUUM, Telescope
from ..glass_catalogue import CATALOGUES, GlassCatalogue
from ..glass_search import find_glass, maker_of, makers_in
from ..writable import report_obscuration, report_pupil_plane, report_unheld, require_met, require_sequential
from .apertures import report_aperture
from .description import PUPIL_PLANE, LensSurface
from .frame import HALF_TURN, rotated_aperture, rotated_shape
from .source import Findings, Source

MM = 1e-3
#: Cosine, of the local z axis with the light, below which it is against the sense that the mirrors make.
_AGAINST = -1e-12
#: Words that are no names of glasses.
_WORDS = ("AIR", "REFL", "MIRROR", "MOD")
#: Decimals of thicknesses: a millimetre is taken apart to a femtometre.
_DECIMALS = 12
#: Newton steps to a mirror.
_STEPS = 20


@dataclass(frozen=True)
class LensSequence:
    """Surfaces and system data of a telescope as a lens file states them.

    `unit` is that of the file [m], `distance` that of the object from the first surface [m]. Fields are in degrees or
    metres in the axes of the file, vignetting factors in the same axes; `aperture` is as in
    :class:`~pachon.models.design_data.DesignData`, for the plane that carries the pupil its diameter.
    """

    telescope: Telescope
    file: str
    findings: Findings
    unit: float
    distance: float
    surfaces: tuple[LensSurface, ...]
    aperture: tuple[str, float]
    wavelengths: tuple[float, ...]
    wavelength_weights: tuple[float, ...]
    field_type: str
    fields: tuple[tuple[float, float], ...]
    field_weights: tuple[float, ...]
    vignetting: tuple[tuple[float, float, float, float, float], ...]

    @classmethod
    def of(
        cls,
        telescope: Telescope,
        file: str,
        units: Collection[float],
        *,
        aimed: str = "off",
        lenient: bool = False,
        along_light: bool = False,
        afocal: bool = False,
        straight: bool = False,
    ) -> LensSequence:
        """Return the surfaces and data of a telescope for a kind of `file`, as its name is said in messages.

        `units` are the units of length [m] that it may have, `aimed` is the aiming of its program. With `along_light`
        local z axes are along the light in front of an even number of mirrors, against it in front of an odd one.
        With `afocal` it can say that the image is at infinity; with `straight` distances are those along the axis of
        the object space, behind folds too.
        PrescriptionError for a telescope that no file of a sequence of surfaces can hold, and unless lenient, which
        makes it a warning, for links and coatings.
        """
        by_stop = telescope.design_data.aperture == "stop"
        t = with_true_aperture(require_met(telescope), straight=straight and not by_stop)
        data, findings = t.design_data, Findings(lenient)
        with error_context(subject=t.name):
            require_sequential(t, file)
            if data.telecentric:
                raise PrescriptionError(f"telecentric object space: {file} has no place for it")
            flags = ["afocal"] if data.afocal and not afocal else []
            report_unheld(t, (*data.pickups, *data.solves), file, lenient=lenient, others=flags)
            own_stop = stop_makes_pupil(t, straight=straight)
            if aimed != "off" and not own_stop:
                # The size of the stop has no place, and is written as the diameter of the entrance pupil.
                diameter = {"aperture": "entrance_pupil", "aperture_value": t.pupil_diameter}
                stated = t.with_design(**diameter) if by_stop else t
                own_stop = stop_states_rays(stated, straight=straight)
            report_pupil_plane(t, findings, own_stop=own_stop, aimed=aimed)
            report_obscuration(t, findings, file)
            if own_stop and data.aiming != aimed:
                problem = f"aiming = {data.aiming}: {file} does not state how rays are aimed"
                findings.note(PrescriptionError(problem), f"read back it is {aimed}")
            for surface in t.surfaces:
                if surface.thin_lens is not None:
                    raise PrescriptionError(f"surface {surface.name}: thin lens: {file} is written without them")
            surfaces = lens_surfaces(t, data.stop if own_stop else None, along_light=along_light)
        aperture = ("entrance_pupil", t.pupil_diameter)
        if own_stop and data.aperture is not None and data.aperture_value is not None:
            aperture = (data.aperture, data.aperture_value)
        waves = stated_wavelengths(t)
        fields, size = data.fields, math.degrees(1.0) if data.field_type == "angle" else 1.0
        if not fields:
            edge = t.field_radius
            fields = tuple((0.0, fraction * edge) for fraction in (0.0, 0.7, 1.0))
        vignetting = np.array(data.vignetting or [(0.0,) * 5] * len(fields)) * (-1.0, 1.0, 1.0, 1.0, -1.0) + 0.0
        return cls(
            telescope=t,
            file=file,
            findings=findings,
            unit=data.unit if data != DesignData() and data.unit in units else MM,
            distance=t.object_distance - (t.surfaces[0].vertex[2] if own_stop else t.stop_z),
            surfaces=surfaces,
            aperture=aperture,
            wavelengths=waves,
            wavelength_weights=data.wavelength_weights or (1.0,) * len(waves),
            field_type=data.field_type if data.fields else "angle",
            fields=tuple((_tidy(-x * size), _tidy(y * size)) for x, y in fields),
            field_weights=data.field_weights or (1.0,) * len(fields),
            vignetting=tuple(map(tuple, vignetting.tolist())),
        )

    @property
    def pupil_plane(self) -> bool:
        """Whether a plane of its own in front carries the stop."""
        return self.surfaces[0].name == PUPIL_PLANE

    @property
    def title(self) -> str:
        """Description of the telescope in one line, or its name."""
        return " ".join((self.telescope.description or self.telescope.name).split())

    @property
    def primary(self) -> int:
        """Place of the primary wavelength."""
        return self.wavelengths.index(self.telescope.default_wavelength)

    @property
    def celsius(self) -> float | None:
        """Stated temperature [deg C]."""
        kelvin = self.telescope.design_data.temperature
        # The difference of two numbers near 300 has rounding in its last digits.
        return None if kelvin is None else round(kelvin - ZERO_CELSIUS, 9) + 0.0

    @property
    def atmospheres(self) -> float | None:
        """Stated pressure [atm]."""
        pascal = self.telescope.design_data.pressure
        return None if pascal is None else pascal / STANDARD_ATMOSPHERE

    def thickness(self, surface: LensSurface) -> float:
        """Return the thickness behind a surface in the unit of the file, without the rounding of heights."""
        following = self.surfaces[self.surfaces.index(surface) + 1 :]
        gap = following[0].distance or 0.0 if following else 0.0
        return round(gap / self.unit, _DECIMALS) + 0.0

    def leave_out(self, text: str, instead: str) -> None:
        """Raise the error of what the file cannot hold or, if lenient, warn; `instead` is what is written."""
        self.findings.report(PrescriptionError(text), instead)

    def leave_out_aperture(self, surface: LensSurface, expected: str) -> None:
        """Raise the error of a surface whose clear aperture the file cannot hold; if lenient, warn."""
        assert surface.aperture is not None
        report_aperture(surface.name, surface.aperture, self.file, expected, self.findings)

    def stated_aperture(
        self, kinds: Collection[str], instead: str = "diameter of the entrance pupil"
    ) -> tuple[str, float]:
        """Return the aperture, of one of some kinds; if lenient the diameter of the entrance pupil [m] for another.

        `instead` is what it is written as.
        """
        if self.aperture[0] in kinds:
            return self.aperture
        aperture_name = self.aperture[0].replace("_", " ")
        text = f"aperture = {aperture_name}: {self.file} has no place for it"
        self.leave_out(text, f"written as the {instead}")
        return "entrance_pupil", self.telescope.pupil_diameter

    def glass_names(self, table: str, forbidden: str = "", *, stated_maker: bool = False) -> Mapping[Medium, str]:
        """Return a name for each medium but air; those of catalogues are theirs, the others are in capitals and new.

        Names of catalogues with a `forbidden` character are not taken; with `stated_maker` the file has that of the
        maker too. Unless lenient, PrescriptionError for a
        dispersion that the file has to hold as a table, `table` of its kind.
        """
        names: dict[Medium, str] = {}
        for medium in dict.fromkeys(m for s in self.surfaces for m in (s.before, s.after) if m != VACUUM):
            listed_name = catalogue_name(medium, stated_maker=stated_maker)
            if listed_name is not None and not set(listed_name) & set(forbidden):
                names[medium] = listed_name
                continue
            short_name = re.sub(r"[^A-Z0-9]", "", medium.name.upper())[:12]
            free = short_name[:1].isalpha() and short_name not in (*names.values(), *_WORDS)
            names[medium] = short_name if free else f"MEDIUM{len(names) + 1}"
            if not isinstance(medium, ConstantIndex) and not _is_table(medium):
                text = f"glass {medium.name or type(medium).__name__}: {self.file} has no place for its formula"
                self.leave_out(text, f"written as {table}")
        return names

    def index_table(
        self, medium: Medium, entries: int = 0, least: int = 2
    ) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return wavelengths [m] and indices of a medium: its own table of `least` entries or more, or another one.

        That has the stated wavelengths and up to `entries` in all, from one per cent below them to one above.
        """
        if isinstance(medium, TabulatedIndex) and _is_table(medium) and len(medium.wavelengths) >= least:
            return medium.wavelengths, medium.indices
        low, high = getattr(medium, "wavelength_range", (0.0, math.inf))
        low, high = max(low, 0.99 * min(self.wavelengths)), min(high, 1.01 * max(self.wavelengths))
        between = map(_tidy, np.linspace(low, high, max(entries - len(self.wavelengths), 0)).tolist())
        waves = tuple(sorted({*self.wavelengths, *(w for w in between if low <= w <= high)}))
        return waves, tuple(float(medium.index(wave)) for wave in waves)


def stated_wavelengths(t: Telescope) -> tuple[float, ...]:
    """Return the wavelengths that are stated, or the default and the edges of the band."""
    return t.design_data.wavelengths or tuple(dict.fromkeys([t.default_wavelength, *(t.band or ())]))


def catalogue_name(medium: Medium, *, stated_maker: bool = False) -> str | None:
    """Return the name under which the reader of lens files finds a medium in the bundled catalogues, or None.

    With `stated_maker` the file has the name of its maker beside that of the glass.
    """
    name = medium.name
    # Substances are not written by name: other programs have none of these.
    if not any(name in c for c in (GlassCatalogue.bundled(), *map(GlassCatalogue.of_maker, CATALOGUES[:-1]))):
        return None
    makers = makers_in([maker_of(medium) or ""]) if stated_maker else ()
    return name if find_glass(name, makers=makers) == medium else None


def quoted(text: str, forbidden: str) -> str:
    """Return a text in one line for a file in which some characters have a meaning; these become spaces."""
    return " ".join("".join(" " if c in forbidden else c for c in text).split())


def _tidy(number: float) -> float:
    """Return a number to 15 digits, without the rounding of its last bits."""
    return float(f"{number:.15g}") + 0.0


def _is_table(medium: Medium) -> bool:
    return isinstance(medium, TabulatedIndex) and medium.interpolation == "monotone"


def lens_surfaces(t: Telescope, stop: str | None, *, along_light: bool = False) -> tuple[LensSurface, ...]:
    """Return the surfaces in the frame of a lens; where no surface is the `stop`, its plane is the first of them.

    With `along_light` local z axes are along the light in front of an even number of mirrors, against it in front of an
    odd one. PrescriptionError for a surface that no lens file can hold.
    """
    medium, sign = t.medium_before, 1.0
    # The ray through the middle of the entrance pupil, along the axis.
    start, direction = HALF_TURN @ [0.0, 0.0, t.stop_z], np.array([0.0, 0.0, 1.0])
    written = Source("")
    surfaces: list[LensSurface] = []
    if stop is None:
        plane = LensSurface(written, Plane(), np.array([0.0, 0.0, -t.stop_z]), np.eye(3), PUPIL_PLANE)
        surfaces.append(replace(plane, before=medium, after=medium, stop=True, distance=0.0))
    for surface in t.surfaces:
        axes = HALF_TURN @ surface.matrix @ HALF_TURN + 0.0
        against = along_light and sign * float(direction @ axes[:, 2]) < _AGAINST
        aligned, axes = _reversed(surface, axes) if against else (surface, axes)
        position = HALF_TURN @ np.array(surface.vertex) + 0.0
        screen = surface.interaction == Interaction.DETECTOR and surface is not t.surfaces[-1]
        with error_context(subject=f"surface {surface.name}"):
            if surface.interaction == Interaction.PHASE:
                raise PrescriptionError("phase screens cannot be written")
            placed = LensSurface(
                written,
                rotated_shape(aligned.shape),
                position,
                axes,
                name=" ".join(surface.name.split()),
                # A detector in front of others has no place in lens files; the light passes it there too.
                interaction=Interaction.PASS if screen else surface.interaction,
                before=medium,
                after=surface.medium_after,
                aperture=None if aligned.aperture is None else rotated_aperture(aligned.aperture),
                semi_diameter=surface.semi_diameter or 0.0,
                stop=surface.name == stop,
                distance=float(position[2] - surfaces[-1].position[2]) if surfaces else 0.0,
                grating=None if aligned.grating is None else aligned.grating.rotated(),
                thin_lens=surface.thin_lens,
            )
        surfaces.append(placed)
        medium = surface.medium_after
        if surface.interaction == Interaction.MIRROR:
            start, direction = _reflected(start, direction, placed, t.default_wavelength)
            sign = -sign
    return tuple(surfaces)


def _reflected(
    position: np.ndarray, direction: np.ndarray, mirror: LensSurface, wavelength: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return where a ray of a wavelength [m] meets a mirror and its direction behind it."""
    vertex, axes = mirror.position, mirror.axes
    place, along = (position - vertex) @ axes, direction @ axes
    # A ray that misses the mirror, or runs along it, has no direction behind it.
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            gradient = np.array([*(-float(v) for v in mirror.shape.gradient(*place[:2])), 1.0])
            place = place - along * (place[2] - float(mirror.shape.sag(*place[:2]))) / (along @ gradient)
    normal = gradient / np.linalg.norm(gradient)
    if mirror.grating is None:
        return vertex + axes @ place, axes @ (along - 2.0 * (along @ normal) * normal)
    grooves = np.array([*mirror.grating.path_gradient, 0.0]) * wavelength / float(mirror.before.index(wavelength))
    sideways = along + grooves
    sideways = sideways - (sideways @ normal) * normal
    # Of an evanescent order there is none either.
    with np.errstate(invalid="ignore"):
        outward = np.sqrt(1.0 - sideways @ sideways) * np.sign(along @ normal)
    return vertex + axes @ place, axes @ (sideways - outward * normal)


def _reversed(surface: Surface, axes: np.ndarray) -> tuple[Surface, np.ndarray]:
    """Return the same surface with its own axes rotated by half a turn about its y axis, and these axes."""
    aperture = None if surface.aperture is None else rotated_aperture(surface.aperture)
    grating = None if surface.grating is None else surface.grating.rotated()
    turned = replace(surface, shape=rotated_shape(surface.shape), aperture=aperture, grating=grating)
    return turned, axes @ HALF_TURN
