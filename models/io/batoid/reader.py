"""Read a telescope from a YAML file of batoid.

The file is a tree of optics, each with a coordinate system within that of the optic around it; rays meet its leaves in
their order. The frame is batoid's global one, which is ours: +z towards the sky. Compound optics and lenses become
groups, whose motions pivot about their own origins, as in batoid.

What batoid has no place for stands under the key ``pachon`` beside ``opticalSystem``, or has a default. An unknown key
is an error, or with `lenient` a warning; the page docs/howto/batoid.md has the tables.
"""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from ....core.errors import DomainError, PrescriptionError, error_context
from ....core.schema import validated
from ...aperture import Annulus, Circle
from ...first_order import first_order
from ...media.medium import Medium
from ...shapes.shape import Plane
from ...surface import IDENTITY, Interaction, Matrix, Surface, Vector
from ...telescope import VACUUM, Telescope
from ..lens.source import Findings
from ..writable import require_met
from . import ROOT
from .apertures import clear_region
from .optics import BatoidFile, Compound, Extras, Frame, Interface, Optic, Screen

#: Wavelength [m] used where none is given, and the widest range: that of optical telescopes.
DEFAULT_WAVELENGTH = 550e-9
WIDEST_RANGE = (0.1e-6, 20e-6)
#: Field radius [rad] of a telescope without a focal length or an edge of its detector.
LEAST_FIELD = math.radians(0.1)
#: Field radius over the angle of the edge of the detector: apertures are drawn beyond the CCDs, on the LSST by 27 %.
FIELD_FRACTION = 0.75
#: Cosine of the largest tilt that counts as a misalignment, 8 degrees, and not as a fold.
ALMOST_ALIGNED = 0.99
_INTERACTIONS = {
    "Mirror": Interaction.MIRROR,
    "RefractiveInterface": Interaction.REFRACT,
    "OPDScreen": Interaction.PHASE,
}
_GLOBAL: Frame = (np.zeros(3), np.eye(3))


@dataclass(frozen=True)
class _Placed:
    """An optic with its path of names, its frame, and the media before and behind it."""

    optic: Optic
    path: tuple[str, ...]
    frame: Frame
    before: Medium
    after: Medium

    @property
    def vertex(self) -> Vector:
        return cast(Vector, tuple(map(float, self.frame[0])))

    @property
    def axes(self) -> Matrix:
        return cast(Matrix, tuple(tuple(map(float, row)) for row in self.frame[1]))


def batoid_telescope(content: dict[str, Any], path: Path, *, lenient: bool = False) -> Telescope:
    """Return the telescope of the content of a batoid file.

    PrescriptionError with file, key, value and expected value; with `lenient`, unknown keys are left out with a
    warning.
    """
    batoid_sections = {key: content[key] for key in (ROOT, "pachon") if key in content}
    drop = None
    if lenient:
        batoid_sections, drop = copy.deepcopy(batoid_sections), Findings(lenient).report
    file = validated(BatoidFile, batoid_sections, str(path), PrescriptionError, {"folder": path.parent}, drop=drop)
    with error_context(file=path):
        return _telescope(file, path)


def _telescope(file: BatoidFile, path: Path) -> Telescope:
    system, extras = file.system, file.pachon
    first_medium = system.medium_before or VACUUM
    placed = [*_within(system, _GLOBAL, first_medium, system.medium_after or first_medium, ())]
    names = _short_names([p.path for p in placed])
    surfaces: list[Surface] = []
    for leaf in (p for p in placed if isinstance(p.optic, Interface)):
        behind = surfaces[-1].medium_after if surfaces else first_medium
        surfaces.append(_surface(leaf, names[leaf.path], behind))
    if placed[-1].optic.type != "Detector":
        raise PrescriptionError(f"{ROOT}.items: expected a Detector as the last optic, not a {placed[-1].optic.type}")
    surfaces[-1] = replace(surfaces[-1], interaction=Interaction.DETECTOR)
    groups = {names[p.path]: p for p in placed if isinstance(p.optic, Compound)}
    frames = {name: (p.vertex, p.axes) for name, p in groups.items()}
    members = {name: _members(p, placed, names) for name, p in groups.items()}
    low, high = _wavelength_range(first_medium, surfaces)
    default = min(max(DEFAULT_WAVELENGTH, low), high)
    waves, field = extras.wavelengths, extras.field
    telescope = Telescope(
        name=system.name or path.stem,
        source=extras.source or f"batoid file {path.name}",
        version=extras.version,
        description=extras.description,
        surfaces=tuple(surfaces),
        stop_z=_stop_height(system),
        pupil_diameter=system.pupil_size or _first_diameter(surfaces),
        pupil_obscuration=system.pupil_obscuration,
        launch_distance=system.back_distance,
        reference_sphere_radius=system.sphere_radius or 1.0,
        field_radius=field.radius if field else LEAST_FIELD,
        field_limit=field.limit if field else math.radians(5.0),
        wavelength_range=waves.range if waves else (low, high),
        default_wavelength=waves.default if waves else default,
        band=waves.band if waves else (max(0.99 * default, low), min(1.01 * default, high)),
        camera=extras.camera,
        site=extras.site,
        dispersion_corrector=extras.dispersion_corrector,
        medium_before=first_medium,
        groups=members | {name: group.surfaces for name, group in extras.groups.items()},
        design_data=extras.design.data(),
        group_frames=frames | {n: (g.pivot, g.rotation) for n, g in extras.groups.items() if g.pivot is not None},
    )
    return _completed(require_met(_with_extras(telescope, extras)), system, extras)


def _with_extras(telescope: Telescope, extras: Extras) -> Telescope:
    """Return the telescope with the semi-diameters and coatings that the section of ours states."""
    sizes, coated = extras.semi_diameters, extras.coated
    for key, stated in (("semi_diameters", set(sizes)), ("coated", set(coated))):
        if unknown_surfaces := sorted(stated - set(telescope.surface_names)):
            raise PrescriptionError(f"{unknown_surfaces[0]!r}: expected the name of a surface", key=f"pachon.{key}")
    coatings = {name: section.made(name) for name, section in extras.coatings.items()}
    for name, coating in coated.items():
        if coating not in coatings:
            expected_coating = f"one of {', '.join(coatings)}" if coatings else "a section coatings"
            raise PrescriptionError(f"{coating!r}: expected {expected_coating}", key=f"pachon.coated.{name}")
    surfaces = tuple(
        replace(s, semi_diameter=sizes.get(s.name)).coated(coatings.get(coated.get(s.name, "")))
        for s in telescope.surfaces
    )
    return replace(telescope, surfaces=surfaces) if sizes or coated else telescope


def _within(
    compound: Compound, frame: Frame, before: Medium, after: Medium, path: tuple[str, ...]
) -> Iterator[_Placed]:
    """Yield the optics within another one in the order of the light, each before those within it."""
    for item, (item_before, item_after) in zip(compound.items, compound.media(before, after), strict=True):
        own_before = item.medium_before or item_before
        placed_optic = _Placed(
            item, (*path, item.name or item.type), item.frame(frame), own_before, item.medium_after or item_after
        )
        yield placed_optic
        if isinstance(item, Compound):
            yield from _within(item, placed_optic.frame, placed_optic.before, placed_optic.after, placed_optic.path)


def _short_names(paths: list[tuple[str, ...]]) -> dict[tuple[str, ...], str]:
    """Return the last name of each path, or all of them where others have the same last name."""
    count = Counter(path[-1] for path in paths)
    return {path: path[-1] if count[path[-1]] == 1 else ".".join(path) for path in paths}


def _members(group: _Placed, placed: list[_Placed], names: dict[tuple[str, ...], str]) -> tuple[str, ...]:
    """Return the names of the surfaces within a group."""
    inside = (p for p in placed if isinstance(p.optic, Interface) and p.path[: len(group.path)] == group.path)
    return tuple(names[p.path] for p in inside)


def _surface(leaf: _Placed, name: str, behind: Medium) -> Surface:
    optic = leaf.optic
    assert isinstance(optic, Interface)
    interaction = _INTERACTIONS.get(optic.type, Interaction.PASS)
    # In batoid only refraction depends on the media.
    refracts = interaction == Interaction.REFRACT
    # Its files give an Interface no obscuration.
    blocked = None if optic.type == "Interface" else optic.obscuration
    if refracts and leaf.before != behind:
        place = ".".join((ROOT, *leaf.path, "inMedium"))
        raise PrescriptionError(f"{place} = {leaf.before!r}: expected the medium of the light there, {behind!r}")
    return Surface(
        name=name,
        interaction=interaction,
        shape=optic.screen if isinstance(optic, Screen) else optic.shape,
        vertex=leaf.vertex,
        medium_after=leaf.after if refracts else behind,
        aperture=None if blocked is None else clear_region(blocked),
        rotation=leaf.axes,
    )


def _stop_height(system: Compound) -> float:
    """Return the height [m] of the plane of the stop; as in batoid the origin where there is none."""
    if system.steps:
        raise PrescriptionError(f"{ROOT}.coordSys: expected none, the system in the global frame")
    if system.stop is None:
        return 0.0
    (x, y, z), axes = system.stop.frame(_GLOBAL)
    if x or y or not np.array_equal(axes, np.eye(3)) or not isinstance(system.stop.shape, Plane):
        raise PrescriptionError(f"{ROOT}.stopSurface: expected a Plane on the axis, at right angles to it")
    return float(z)


def _outer_radius(surface: Surface) -> float | None:
    """Return the outer radius [m] of a round aperture; None for others."""
    clear = surface.aperture
    return clear.radius if isinstance(clear, Circle) else clear.outer if isinstance(clear, Annulus) else None


def _first_diameter(surfaces: list[Surface]) -> float:
    """Return the diameter [m] of the first round aperture, the pupil of a file without pupilSize."""
    for radius in map(_outer_radius, surfaces):
        if radius is not None:
            return 2.0 * radius
    raise PrescriptionError(f"{ROOT}.pupilSize is missing")


def _wavelength_range(first_medium: Medium, surfaces: list[Surface]) -> tuple[float, float]:
    """Return the wavelengths [m] that all media cover."""
    ranges = [getattr(m, "wavelength_range", WIDEST_RANGE) for m in (first_medium, *(s.medium_after for s in surfaces))]
    low, high = max(r[0] for r in (WIDEST_RANGE, *ranges)), min(r[1] for r in (WIDEST_RANGE, *ranges))
    if low >= high:
        raise PrescriptionError(f"{ROOT}: expected media with a common range of wavelengths")
    return low, high


def _completed(telescope: Telescope, system: Compound, extras: Extras) -> Telescope:
    """Return the telescope with field of view and reference sphere by its focal length, where the file has none."""
    try:
        focal_length = abs(first_order(_straightened(telescope)).focal_length)
    except DomainError:
        # Folded, or without a focus.
        return telescope
    radius, edge = telescope.field_radius, _outer_radius(telescope.surfaces[-1])
    if extras.field is None and edge is not None:
        radius = FIELD_FRACTION * math.atan(edge / focal_length)
    limit = telescope.field_limit if extras.field else max(telescope.field_limit, 2.0 * radius)
    sphere = system.sphere_radius or focal_length
    return replace(telescope, field_radius=radius, field_limit=limit, reference_sphere_radius=sphere)


def _straightened(telescope: Telescope) -> Telescope:
    """Return the telescope without decentres and tilts, unless these fold it."""
    if any(s.matrix[2, 2] < ALMOST_ALIGNED for s in telescope.surfaces):
        return telescope
    centred = (replace(s, vertex=(0.0, 0.0, s.vertex[2]), rotation=IDENTITY) for s in telescope.surfaces)
    return replace(telescope, surfaces=tuple(centred))
