"""Read a telescope from a prescription file in YAML; the format is described in `prescription`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, create_model

from ....core.errors import PachonError, PrescriptionError, error_context
from ....core.schema import Section, Tagged, expected, one_of, validated
from ....core.yaml_reader import read_mapping
from ...coating import AnyCoating
from ...grating import Grating
from ...media.medium import Medium
from ...obstruction import Obstruction
from ...rotation import rotation_matrix
from ...surface import IDENTITY, Interaction, Matrix, Surface
from ...telescope import VACUUM, Telescope
from ...thin_lens import ThinLens
from ..writable import require_met
from .apertures import ApertureKeys, ObstructionSection
from .coatings import CoatingSection
from .design import DesignSection
from .media import AnyMedium
from .shapes import SURFACE_SHAPES, ShapeSection
from .values import (
    ROWS,
    Angle,
    Band,
    FileUnits,
    Length,
    Names,
    Number,
    OptionalAngles,
    OptionalBand,
    OptionalLength,
    OptionalNameOrFile,
    OptionalPlace,
    OptionalText,
    PositiveAngle,
    PositiveLength,
    PositiveNumber,
    Rotation,
    Text,
    Wavelength,
    WholeNumber,
    names,
)

INTERACTIONS = {
    "mirror": Interaction.MIRROR,
    "refract": Interaction.REFRACT,
    "detector": Interaction.DETECTOR,
    "baffle": Interaction.PASS,
    "phase": Interaction.PHASE,
    "thin_lens": Interaction.THIN_LENS,
}


class GratingSection(Section):
    """Grooves of a surface and the order of the light behind it."""

    order: WholeNumber
    lines_per_mm: PositiveNumber
    groove_angle: Angle = 0.0

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        for key, text in (("order", "a whole number"), ("lines_per_mm", "a positive number")):
            if key not in content:
                raise expected(text, key)

    def grating(self) -> Grating:
        """Return the grating."""
        return Grating(self.order, self.lines_per_mm, self.groove_angle)


class ThinLensSection(Section):
    """Ideal thin lens."""

    focal_length: Length
    object_distance: Length = math.inf

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        if "focal_length" not in content:
            raise expected("a number", "focal_length")

    def lens(self) -> ThinLens:
        """Return the lens."""
        return ThinLens(self.focal_length, self.object_distance)


class SurfaceKeys(ApertureKeys):
    """Keys of a surface beside those of its shape."""

    name: Text
    type: Literal["mirror", "refract", "detector", "baffle", "phase", "thin_lens"]
    x: Length = 0.0
    y: Length = 0.0
    z: Length
    tilt: OptionalAngles = None
    rotation: Rotation = IDENTITY
    medium: OptionalText = None
    semi_diameter: OptionalLength = None
    coating: OptionalText = None
    grating: GratingSection | None = None
    thin_lens: ThinLensSection | None = None

    @classmethod
    def keys(cls) -> list[str]:
        """Return the keys, those of every surface first."""
        first = ["name", "type", "shape", *(key for key in SurfaceKeys.__annotations__ if key not in ("name", "type"))]
        return list(dict.fromkeys([*first, *super().keys()]))

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        super().check(content)
        if content.get("type") == "refract" and "medium" not in content:
            raise expected("a text", "medium")
        if "tilt" in content and "rotation" in content:
            raise expected("tilt or rotation, not both", "tilt")

    def surface(
        self, media: dict[str, Medium], medium_before: Medium, coatings: dict[str, AnyCoating] | None = None
    ) -> Surface:
        """Return the surface."""
        coating_sections = coatings or {}
        if self.coating is not None and self.coating not in coating_sections:
            expected_coating = one_of(coating_sections, self.coating) if coating_sections else "a section coatings"
            raise PrescriptionError(f"coating = {self.coating!r}: expected {expected_coating}", key="coating")
        assert isinstance(self, ShapeSection)
        return Surface(
            name=self.name,
            interaction=INTERACTIONS[self.type],
            shape=self.build(),
            vertex=(self.x, self.y, self.z),
            medium_after=_chosen("medium", self.medium, media, medium_before),
            aperture=self.clear_aperture(),
            rotation=self.rotation if self.tilt is None else _matrix(rotation_matrix(self.tilt)),
            semi_diameter=self.semi_diameter,
            grating=None if self.grating is None else self.grating.grating(),
            thin_lens=None if self.thin_lens is None else self.thin_lens.lens(),
        ).coated(None if self.coating is None else coating_sections[self.coating])


def _surface_kind(content: dict[str, Any]) -> str:
    return "sum" if isinstance(content.get("shape"), list) else _BY_SHAPE.kind(content)


_SURFACES: dict[str, type[SurfaceKeys]] = {
    name: create_model(f"{name}_surface", __base__=(SurfaceKeys, section))  # type: ignore[arg-type]
    for name, section in SURFACE_SHAPES.items()
}
_BY_SHAPE = Tagged.by_value("shape", {name: section for name, section in _SURFACES.items() if name != "sum"})


class StopSection(Section):
    """Plane of the entrance pupil, and its centre."""

    z: Length
    center: tuple[Length, Length] = (0.0, 0.0)


class PupilSection(Section):
    """Entrance pupil."""

    diameter: PositiveLength
    obscuration: Number


class FieldSection(Section):
    """Field of view."""

    radius: PositiveAngle
    limit: PositiveAngle


class WavelengthsSection(Section):
    """Wavelengths covered."""

    range: Band
    default: Wavelength
    band: OptionalBand = None


class GroupSection(Section):
    """Surfaces that move together, and the frame of their motions; that of the first surface without a pivot."""

    surfaces: Names
    pivot: OptionalPlace
    rotation: Rotation = IDENTITY


def _group(value: Any) -> Any:
    if isinstance(value, dict):
        return value
    if (surfaces := names(value)) is None:
        raise expected("a list of names")
    return GroupSection.model_construct(surfaces=surfaces, pivot=None)


def _no_vacuum(media: Any) -> Any:
    if isinstance(media, dict) and "vacuum" in media:
        raise expected("another name: vacuum is defined already, with index 1", "vacuum")
    return media


_SURFACE = Tagged(_SURFACES, _surface_kind, built=False, key="shape")
_OBSTRUCTION = Tagged({"mesh": ObstructionSection}, lambda content: "mesh")


class Prescription(Section):
    """A prescription file."""

    name: Text
    description: Text = ""
    source: Text
    version: Text
    units: FileUnits
    stop: StopSection
    pupil: PupilSection
    launch_distance: PositiveLength
    object_distance: Length = math.inf
    reference_sphere_radius: PositiveLength
    field: FieldSection
    wavelengths: WavelengthsSection
    design: DesignSection = DesignSection()
    camera: OptionalNameOrFile = None
    site: OptionalNameOrFile = None
    dispersion_corrector: OptionalText = None
    medium_before: OptionalText = None
    media: Annotated[dict[str, AnyMedium], BeforeValidator(_no_vacuum)] = Field(default_factory=dict)
    coatings: dict[str, CoatingSection] = Field(default_factory=dict)
    groups: dict[str, Annotated[GroupSection, BeforeValidator(_group)]] = Field(default_factory=dict)
    obstructions: Annotated[tuple[Annotated[Obstruction, _OBSTRUCTION], ...], ROWS] = ()
    surfaces: Annotated[tuple[Annotated[SurfaceKeys, _SURFACE], ...], ROWS]

    def problems(self) -> list[PachonError]:
        """Return the errors of media and surfaces that cannot be made, each by itself."""
        errors: list[PachonError] = []
        media: dict[str, Medium] = {"vacuum": VACUUM}
        for name, medium in self.media.items():
            try:
                media[name] = medium.medium(name)
            except PachonError as error:
                errors.append(error.within(key=f"media.{name}"))
                media[name] = VACUUM
        coatings: dict[str, AnyCoating] = {}
        for name, coating_section in self.coatings.items():
            try:
                coatings[name] = coating_section.made(name)
            except PachonError as error:
                errors.append(error)
        for section in self.surfaces:
            if section.coating in self.coatings and section.coating not in coatings:
                continue
            try:
                section.surface(media, VACUUM, coatings)
            except PachonError as error:
                errors.append(error.within(key=f"surfaces[{section.name}]"))
        return errors

    def telescope(self) -> Telescope:
        """Return the telescope."""
        coatings = {name: section.made(name) for name, section in self.coatings.items()}
        media: dict[str, Medium] = {"vacuum": VACUUM}
        for name, medium in self.media.items():
            with error_context(key=f"media.{name}"):
                media[name] = medium.medium(name)
        medium_before = _chosen("medium_before", self.medium_before, media, VACUUM)
        surfaces: list[Surface] = []
        for section in self.surfaces:
            with error_context(key=f"surfaces[{section.name}]"):
                behind = surfaces[-1].medium_after if surfaces else medium_before
                surfaces.append(section.surface(media, behind, coatings))
        return Telescope(
            name=self.name,
            description=self.description,
            source=self.source,
            version=self.version,
            surfaces=tuple(surfaces),
            stop_z=self.stop.z,
            pupil_center=self.stop.center,
            pupil_diameter=self.pupil.diameter,
            pupil_obscuration=self.pupil.obscuration,
            launch_distance=self.launch_distance,
            object_distance=self.object_distance,
            reference_sphere_radius=self.reference_sphere_radius,
            field_radius=self.field.radius,
            field_limit=self.field.limit,
            wavelength_range=self.wavelengths.range,
            default_wavelength=self.wavelengths.default,
            band=self.wavelengths.band,
            camera=self.camera,
            site=self.site,
            dispersion_corrector=self.dispersion_corrector,
            medium_before=medium_before,
            groups={name: group.surfaces for name, group in self.groups.items()},
            group_frames={name: (g.pivot, g.rotation) for name, g in self.groups.items() if g.pivot is not None},
            obstructions=self.obstructions,
            design_data=self.design.data(),
        )


#: Longest prescription [byte]: grids and meshes may be written out in it.
MAX_BYTES = 64_000_000


def read_telescope(path: Path) -> Telescope:
    """Read a prescription file; PrescriptionError of one line with file, key, value and expected value."""
    return telescope_of(read_mapping(path, max_bytes=MAX_BYTES, exact=True), path)


def telescope_of(content: dict[str, Any], path: Path) -> Telescope:
    """Return the telescope of the content of a prescription file; errors as for :func:`read_telescope`."""
    prescription = validated(Prescription, content, str(path), PrescriptionError, {"folder": path.parent})
    with error_context(file=path):
        return require_met(prescription.telescope())


def _chosen(key: str, name: str | None, media: dict[str, Medium], default: Medium) -> Medium:
    if name is None:
        return default
    if name not in media:
        raise PrescriptionError(f"{key} = {name!r}: expected {one_of(media, name)}", key=key)
    return media[name]


def _matrix(rows_of_floats: np.ndarray) -> Matrix:
    a, b, c = (tuple(map(float, row)) for row in rows_of_floats)
    return (a, b, c)  # type: ignore[return-value]
