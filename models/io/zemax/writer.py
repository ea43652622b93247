"""Write a telescope as a sequential Zemax lens file (.zmx), with a glass catalogue (.agf) beside it where it needs one.

The axes are rotated as by the reader (see `frame`). Where the telescope's stop and stated aperture make its entrance
pupil, they are written; else a plane of its own in front carries the stop, so that the entrance pupil is that of the
telescope, and the reader recognises this plane by its comment. Surfaces off the axis or tilted stand between two
coordinate breaks, of which the second undoes the first.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ....core.errors import PrescriptionError, error_context
from ...design_data import FIELD_TYPES, DesignData
from ...media.dispersion import Dispersion
from ...media.medium import ConstantIndex, Medium, Sellmeier
from ...paraxial import stop_states_rays, with_true_aperture
from ...rotation import rotation_angles
from ...surface import Interaction
from ...telescope import VACUUM, Telescope
from ...thickness import is_fold
from ..glass_catalogue import NUMBERED, SELLMEIER_TERMS, GlassCatalogue
from ..lens.apertures import report_aperture
from ..lens.description import PUPIL_PLANE, LensSurface
from ..lens.sequence import lens_surfaces, stated_wavelengths
from ..lens.source import Findings
from ..lens.text import number_text, scaled
from ..writable import (
    report_obscuration,
    report_pupil_plane,
    report_unheld,
    require_met,
    require_sequential,
    with_formulas,
)
from .apertures import HELD_APERTURES, aperture_lines
from .gratings import grating_lines, with_grooves_along_x
from .links import add_link_lines
from .shapes import shape_lines
from .system import design_lines, stop_lines

MM = 1e-3
#: Names of the units of a file [m].
UNIT_NAMES = {1e-3: "MM", 1e-2: "CM", 0.0254: "IN", 1.0: "METER"}
#: Distance from an axis, over the distance from the origin, that is rounding.
_ROUNDING = 1e-15
#: Distance from an axis, over that from the origin, and cosines, that are rounding behind fold mirrors.
_TURNED = 4e-15
#: AGF coefficients of a glass of constant index: Schott's formula with its first term alone.
CONSTANT_FORMULA = 1


def telescope_to_zemax(telescope: Telescope, *, lenient: bool = False) -> tuple[str, str]:
    """Return the text of a lens file, and that of the glass catalogue that it needs; empty where it needs none.

    PrescriptionError, with surface and part, if a part of the telescope has no counterpart in a Zemax file; pickups,
    solves and apertures without one are left out with a warning where `lenient`.
    """
    t, findings = with_true_aperture(require_met(telescope)), Findings(lenient)
    with error_context(subject=t.name):
        require_sequential(t, "a Zemax file")
        t = with_formulas(t, _formula, findings)
    glasses = _glass_names(t)
    data = t.design_data
    unit = MM if data == DesignData() else data.unit
    own_stop = stop_states_rays(t)
    with error_context(subject=t.name):
        report_pupil_plane(t, findings, own_stop=own_stop)
    if data.telecentric and not own_stop:
        raise PrescriptionError(f"{t.name}: a telecentric object space needs its stop and its aperture in a Zemax file")
    lines = [
        "VERS 190513 30 123457 L123457",
        "MODE SEQ",
        f"NAME {' '.join((t.description or t.name).split())}",
        f"UNIT {UNIT_NAMES[unit]} X W X CM MR CPMM",
        *(stop_lines(data, unit) if own_stop else [f"ENPD {number_text(t.pupil_diameter / unit)}"]),
        *_field_lines(t, unit),
        *_wavelength_lines(t),
    ]
    first = t.surfaces[0].vertex[2] if own_stop else t.stop_z
    blocks = [["TYPE STANDARD", "CURV 0.0", *_glass_line(t.medium_before, glasses)]]
    distance = (t.object_distance - first) / unit
    blocks[0].append(f"DISZ {number_text(distance)}" if math.isfinite(distance) else "DISZ INFINITY")
    with error_context(subject=t.name):
        surfaces = tuple(map(with_grooves_along_x, lens_surfaces(t, data.stop if own_stop else None)))
    if not own_stop:
        # The plane of the stop, in front of all; z counts along the light, from the origin.
        blocks.append(
            [f"COMM {PUPIL_PLANE}", "STOP", "TYPE STANDARD", "CURV 0.0", *_glass_line(t.medium_before, glasses)]
        )
        surfaces = surfaces[1:]
    surfaces, turns = _along_folds(t, surfaces)
    numbered: dict[str, tuple[int, list[str]]] = {}
    chains = _chains(t, surfaces)
    for place, (name, surface) in enumerate(zip(t.surface_names, surfaces, strict=True)):
        chain = chains[place]
        if place and chain == chains[place - 1]:
            # Thicknesses within a chain are along its own axis.
            blocks[-1].append(f"DISZ {number_text(_along(surfaces[place - 1], surface) / unit)}")
        elif len(blocks) > 1:
            gap = surface.position[2] - surfaces[chains[place - 1]].position[2] if place else surface.distance or 0.0
            blocks[-1].append(f"DISZ {number_text(float(gap) / unit)}")
        lines_of_surface = _surface_lines(surface, glasses, unit, findings)
        if surface.stop:
            lines_of_surface.append("STOP")
            if data.aperture == "stop":
                lines_of_surface.append(f"DIAM {number_text((data.aperture_value or 0.0) / unit)} 1")
        if not surface.off_axis:
            blocks.append(lines_of_surface)
            numbered[name] = len(blocks) - 1, lines_of_surface
            continue
        first_of_chain = surfaces[chain]
        values = [*(v / unit for v in first_of_chain.position[:2]), *np.degrees(first_of_chain.tilt)]
        if chain == place:
            blocks.append([*_break_lines(values, 0), *_glass_line(surface.before, glasses), "DISZ 0"])
        blocks.append(lines_of_surface)
        numbered[name] = len(blocks) - 1, blocks[-1]
        if chain not in chains[place + 1 :]:
            blocks[-1].append(f"DISZ {number_text(_along(surface, first_of_chain) / unit)}")
            if surface is not surfaces[-1]:
                blocks.append([*_break_lines([-v for v in values], 1), *_glass_line(surface.after, glasses)])
                if place in turns:
                    blocks[-1].append("DISZ 0")
                    blocks.append([*_break_lines([0.0, 0.0, *turns[place]], 0), *_glass_line(surface.after, glasses)])
    if not blocks[-1][-1].startswith("DISZ"):
        blocks[-1].append("DISZ 0")
    left_out = add_link_lines(t, numbered, unit)
    with error_context(subject=t.name):
        report_unheld(t, left_out, "a Zemax file", lenient=lenient)
        report_obscuration(t, findings, "a Zemax file")
    for number, block in enumerate(blocks):
        lines += [f"SURF {number}", *(f"  {line}" for line in block)]
    return "\n".join(lines) + "\n", "".join(_catalogue_lines(glasses))


def _along_folds(
    t: Telescope, surfaces: Sequence[LensSurface]
) -> tuple[tuple[LensSurface, ...], dict[int, list[float]]]:
    """Return the surfaces in a frame that goes with the light, and the turn [deg] of it behind each fold mirror.

    As in Zemax, whose paraxial trace takes thicknesses alone, the frame turns by twice the tilt of a fold mirror;
    heights go on along its new axis.
    """
    origin, axes, height = np.zeros(3), np.eye(3), np.zeros(3)
    placed: list[LensSurface] = []
    turns: dict[int, list[float]] = {}
    for place, surface in enumerate(surfaces):
        if turns:
            position, own_axes = axes.T @ (surface.position - origin), axes.T @ surface.axes
            position[:2][np.abs(position[:2]) <= _TURNED * float(np.abs(surface.position).max())] = 0.0
            aligned = np.allclose(own_axes, np.eye(3), rtol=0.0, atol=_TURNED)
            surface = replace(surface, position=position + height, axes=np.eye(3) if aligned else own_axes)
        placed.append(surface)
        if is_fold(t, place):
            normal = surface.axes[:, 2]
            turn = (2.0 * np.outer(normal, normal) - np.eye(3)) @ np.diag([-1.0, -1.0, 1.0])
            ahead = np.array([0.0, 0.0, surface.position[2]])
            origin, axes, height = origin + axes @ (ahead - height), axes @ turn, ahead
            turns[place] = np.degrees(rotation_angles(turn)).tolist()
    return tuple(placed), turns


def _along(surface: LensSurface, following: LensSurface) -> float:
    """Return the distance of the vertex of a surface from that of another along the axis of the latter [m]."""
    return 0.0 if following is surface else float((following.position - surface.position) @ surface.axes[:, 2])


def _chains(t: Telescope, surfaces: Sequence[LensSurface]) -> list[int]:
    """Return for each surface the first one of its chain, which stands on one tilted or decentred axis.

    Where a thickness off the axis follows another one or is solved for, the surfaces on either side of it make a chain;
    all others stand between coordinate breaks of their own.
    """
    data = t.design_data
    linked = {solve.surface for solve in data.solves}
    linked |= {name for p in data.pickups if p.quantity == "thickness" for name in (p.surface, p.source)}
    chains: list[int] = []
    for place, surface in enumerate(surfaces):
        previous = surfaces[place - 1] if place else surface
        is_linked = bool(place) and t.surface_names[place - 1] in linked and surface.off_axis and previous.off_axis
        aside = surface.position - previous.position - previous.axes[:, 2] * _along(previous, surface)
        size = max(float(np.abs(s.position).max()) for s in (previous, surface))
        is_aligned = np.array_equal(surface.axes, previous.axes) and float(np.abs(aside).max()) <= _ROUNDING * size
        chains.append(chains[-1] if is_linked and is_aligned else place)
    return chains


def _field_lines(t: Telescope, unit: float) -> list[str]:
    """Return the lines of the fields: those that are stated, or three from the axis to the edge."""
    data, waves = t.design_data, len(stated_wavelengths(t))
    afocal = int(data.afocal)
    if data.fields:
        kind, telecentric = FIELD_TYPES.index(data.field_type), int(data.telecentric)
        head = [f"FTYP {kind} {telecentric} {len(data.fields)} {waves} 0 0 {afocal}"]
    else:
        edge = math.degrees(t.field_radius)
        head = [
            f"FTYP 0 0 3 {waves} 0 0 {afocal}",
            "XFLN 0 0 0",
            f"YFLN 0 {number_text(edge / math.sqrt(2))} {number_text(edge)}",
        ]
    return [*head, *design_lines(data, unit)]


def _wavelength_lines(t: Telescope) -> list[str]:
    waves = stated_wavelengths(t)
    weights = t.design_data.wavelength_weights or [1] * len(waves)
    lines = [f"WAVM {i} {_micrometres(w)} {a!r}" for i, (w, a) in enumerate(zip(waves, weights, strict=True), start=1)]
    return [*lines, f"PWAV {waves.index(t.default_wavelength) + 1}"]


def _micrometres(wavelength: float) -> str:
    return repr(scaled(wavelength, 6))


def _break_lines(values: list[float], order: int) -> list[str]:
    return [
        "TYPE COORDBRK",
        "CURV 0.0",
        *(f"PARM {i} {number_text(v)}" for i, v in enumerate(values, start=1)),
        f"PARM 6 {order}",
    ]


def _surface_lines(surface: LensSurface, glasses: dict[Medium, str], unit: float, findings: Findings) -> list[str]:
    lines = [f"COMM {surface.name}"]
    with error_context(subject=f"surface {surface.name}"):
        if surface.thin_lens is not None:
            focal_length = number_text(surface.thin_lens.focal_length / unit)
            lines += ["TYPE PARAXIAL", "CURV 0.0", f"PARM 1 {focal_length}", "PARM 2 1"]
        else:
            lines += shape_lines(surface.shape, unit) if surface.grating is None else grating_lines(surface, unit)
        if surface.interaction == Interaction.MIRROR:
            lines.append("GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0")
        elif surface.interaction != Interaction.DETECTOR:
            lines += _glass_line(surface.after, glasses)
    if surface.aperture is not None:
        aperture = aperture_lines(surface.aperture, unit)
        if aperture is None:
            report_aperture(surface.name, surface.aperture, "a Zemax file", HELD_APERTURES, findings)
        lines += aperture or []
    if surface.semi_diameter:
        lines.append(f"DIAM {number_text(surface.semi_diameter / unit)} 1")
    return lines


def _glass_line(medium: Medium, glasses: dict[Medium, str]) -> list[str]:
    return [] if medium == VACUUM else [f"GLAS {glasses[medium]} 0 0 1.5 40 0 0 0 0 0 0"]


def _glass_names(t: Telescope) -> dict[Medium, str]:
    """Return a name for every glass: its own where the bundled catalogue has the same under it, else a new one."""
    bundled = GlassCatalogue.bundled()
    media = dict.fromkeys([t.medium_before, *(s.medium_after for s in t.surfaces)])
    names: dict[Medium, str] = {}
    for medium in (m for m in media if m != VACUUM):
        name = re.sub(r"[^A-Z0-9_-]", "_", medium.name.upper())
        if name in bundled and bundled[name] == medium:
            names[medium] = name
            continue
        is_free = bool(re.match("[A-Z]", name)) and name not in (*names.values(), "MIRROR") and name not in bundled
        number = len(names) + 1
        while not is_free and (f"GLASS_{number}" in names.values()):
            number += 1
        names[medium] = name if is_free else f"GLASS_{number}"
    return names


def _catalogue_lines(glasses: dict[Medium, str]) -> Iterator[str]:
    bundled = GlassCatalogue.bundled()
    unlisted = {medium: name for medium, name in glasses.items() if not (name in bundled and bundled[name] == medium)}
    if unlisted:
        yield "CC Glasses of the lens file of the same name, written by pachon\n"
    for medium, name in unlisted.items():
        formula, coefficients, limits = _formula(medium)
        nd = float(medium.index(5.875618e-7)) if limits[0] <= 5.875618e-7 <= limits[1] else 0.0
        yield f"NM {name} {formula} 0 {nd:.6f} 0 0 0\n"
        yield f"CD {' '.join(number_text(c) for c in coefficients)}\n"
        yield f"LD {_micrometres(limits[0])} {_micrometres(limits[1])}\n"


def _formula(medium: Medium) -> tuple[int, list[float], tuple[float, float]]:
    """Return number and coefficients of a medium's formula, and its range of wavelengths [m]."""
    if isinstance(medium, ConstantIndex):
        return CONSTANT_FORMULA, [medium.n**2], (1e-8, 1e-3)
    if isinstance(medium, Sellmeier):
        pairs: list[Any] = [v for pair in zip(medium.B, medium.C, strict=True) for v in pair]
        number = next((k for k, terms in SELLMEIER_TERMS.items() if len(medium.B) <= terms), None)
        if number is not None:
            return number, pairs, medium.wavelength_range
    if isinstance(medium, Dispersion):
        kind = "schott" if medium.formula == "sumita" else medium.formula
        numbers = {formula: number for number, formula in NUMBERED.items()}
        if kind in numbers:
            return numbers[kind], list(medium.coefficients), medium.wavelength_range
    raise PrescriptionError(f"{type(medium).__name__} is none of the dispersion formulas of a Zemax glass catalogue")


def catalogue_path(path: Path) -> Path:
    """Return where the glass catalogue of a lens file stands."""
    return path.with_suffix(".agf")
