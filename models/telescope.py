"""A telescope: surfaces in the order of the light, entrance pupil, field of view and wavelengths.

Telescope frame: right-handed, origin at the vertex of the primary, +z along the optical axis towards the sky.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError, PrescriptionError, unknown_name
from ..core.notebook import Pictured
from ..core.number_text import counted
from ..core.units import broadcast_together, metres, radians
from .coating import AnyCoating
from .design_data import DesignData
from .media.medium import ConstantIndex, Medium, check_wavelength_range, wavelengths_within
from .obstruction import Obstruction
from .rotation import rotation_matrix
from .shapes.shape import Shape
from .shapes.sum import Sum
from .surface import Interaction, Matrix, Surface, Vector, move_frame

VACUUM = ConstantIndex(1.0)
#: Sine of the least angle between the normal of a detector and the telescope's x, of which its own x has a turn.
_LEAST_ALONG_X = 0.5
#: Interactions without a change of medium.
_STAYING = {Interaction.MIRROR: "mirror", Interaction.PASS: "baffle", Interaction.PHASE: "phase screen"}


@check_arguments
@dataclass(frozen=True)
class Telescope(Pictured):
    r"""An unfolded optical prescription.

    Parameters
    ----------
    name, source, version, description : str
        Name, source, version and description of the prescription. Names, those of surfaces too, are printable
        characters of any script; FITS products have them as ASCII with escapes such as ``\xfc``, and pictures letter
        by letter.
    surfaces : tuple of Surface
        Surfaces in the order of the light.
    stop_z : float
        Height of the plane of the entrance pupil [m], telescope frame; pupil coordinates are given in this plane.
    pupil_diameter : float
        Outer diameter of the entrance pupil [m].
    pupil_obscuration : float
        Inner over outer diameter of the entrance pupil.
    launch_distance : float
        Distance from the origin, against the light, of the plane that rays start from [m].
    reference_sphere_radius : float
        Radius of the sphere that the wavefront is measured on [m].
    field_radius : float
        Radius of the field of view [rad].
    field_limit : float
        Largest field angle that the model covers [rad].
    wavelength_range : tuple of float, shape (2,)
        Vacuum wavelengths covered [m].
    default_wavelength : float
        Wavelength used where none is given [m].
    band : tuple of float, shape (2,), optional
        Edges of the pass band [m]; the wavelength range where not given.
    medium_before : Medium
        Medium in front of the first surface.
    groups : mapping of str to tuple of str
        Names of surfaces that move together.
    group_frames : mapping of str to (vertex, rotation), optional
        Frame of each group: its pivot [m] and axes. By default that of its first surface.
    camera : str, optional
        Name of the camera at the focus, or path of its file.
    obstructions : tuple of Obstruction
        Meshes that block light between the surfaces.
    object_distance : float
        Height of the plane of the object [m], telescope frame; infinite for the sky. At a finite distance a field angle
        is that of the ray from the object through the centre of the entrance pupil.
    design_data : DesignData
        Aperture, fields, wavelengths and stop as the designer stated them, the defaults of calculations.
    site : str, optional
        Name of the site, or path of its file.
    dispersion_corrector : str, optional
        Surface or group that moves across the axis to take out the dispersion by the air.
    pupil_center : tuple of float, shape (2,)
        Centre of the entrance pupil in its plane [m]; off the axis where changes have moved the image of a stop there.
    """

    #: Function that error messages name to whoever gives a name in place of a telescope.
    LOADER = "pachon.load_telescope"

    name: str
    surfaces: tuple[Surface, ...]
    stop_z: float
    pupil_diameter: float
    pupil_obscuration: float
    launch_distance: float
    reference_sphere_radius: float
    field_radius: float
    field_limit: float
    wavelength_range: tuple[float, float]
    default_wavelength: float
    source: str = ""
    version: str = ""
    description: str = ""
    band: tuple[float, float] | None = None
    medium_before: Medium = VACUUM
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict, hash=False)
    group_frames: Mapping[str, tuple[Vector, Matrix]] = field(default_factory=dict, hash=False)
    camera: str | None = None
    obstructions: tuple[Obstruction, ...] = ()
    object_distance: float = math.inf
    design_data: DesignData = field(default_factory=DesignData)
    site: str | None = None
    dispersion_corrector: str | None = None
    pupil_center: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        names = [s.name for s in self.surfaces]
        if not names:
            raise PrescriptionError("surfaces = []: expected at least one surface")
        for key, text in (("name", self.name), *(("surface name", n) for n in names)):
            if not text.isprintable():
                raise PrescriptionError(f"{key} = {text!r}: expected letters, signs and spaces, no control characters")
        for repeated in {n for n in names if names.count(n) > 1}:
            raise PrescriptionError(f"surface name {repeated!r} occurs more than once: expected unique names")
        medium = self.medium_before
        for surface in self.surfaces:
            kind = _STAYING.get(surface.interaction)
            if kind and surface.medium_after != medium:
                raise PrescriptionError(f"surface {surface.name!r}: expected a {kind} to stay in the medium before it")
            medium = surface.medium_after
        for group, members in self.groups.items():
            if group in names:
                raise PrescriptionError(f"group {group!r} has the name of a surface: expected another name")
            if not members:
                raise PrescriptionError(f"group {group!r} = []: expected the names of its surfaces")
            for member in members:
                if member not in names:
                    raise PrescriptionError(f"group {group!r}: {unknown_name('surface', member, names)}")
        corrector = self.dispersion_corrector
        if corrector is not None and corrector not in (*names, *self.groups):
            unknown = unknown_name("surface or group", corrector, (*names, *self.groups))
            raise PrescriptionError(f"dispersion_corrector: {unknown}")
        for key in ("pupil_diameter", "launch_distance", "reference_sphere_radius", "field_radius", "field_limit"):
            if not (np.isfinite(getattr(self, key)) and getattr(self, key) > 0):
                raise PrescriptionError(f"{key} = {getattr(self, key)!r}: expected a positive number")
        if self.field_radius > self.field_limit * (1 + 1e-12):
            radius, limit = (f"{math.degrees(v):.6g} deg" for v in (self.field_radius, self.field_limit))
            raise PrescriptionError(f"field_radius = {radius}: expected at most the field_limit, {limit}")
        for key in ("stop_z", "pupil_center"):
            if not np.isfinite(getattr(self, key)).all():
                raise PrescriptionError(f"{key} = {getattr(self, key)!r}: expected a finite number")
        if not 0 <= self.pupil_obscuration < 1:
            raise PrescriptionError(f"pupil_obscuration = {self.pupil_obscuration!r}: expected 0 <= value < 1")
        if math.isnan(self.object_distance) or self.object_distance == self.stop_z:
            raise PrescriptionError(f"object_distance = {self.object_distance!r}: expected a number other than stop_z")
        self._check_obstructions()
        check_wavelength_range(self.wavelength_range)
        low, high = self.wavelength_range
        if self.band is None:
            object.__setattr__(self, "band", (low, high))
        for key, values in (("default_wavelength", (self.default_wavelength,)), ("band", self.band or ())):
            if not all(low <= v <= high for v in values):
                raise PrescriptionError(
                    f"{key} = {getattr(self, key)!r}: expected within the wavelength range, {low:g} to {high:g} m"
                )
        self.design_data.check_within(names, self.wavelength_range, self.default_wavelength, self.object_distance)
        frames = {g: self.group_frames.get(g) or self._surface_frame(m[0]) for g, m in self.groups.items()}
        object.__setattr__(self, "groups", MappingProxyType({g: tuple(m) for g, m in self.groups.items()}))
        object.__setattr__(self, "group_frames", MappingProxyType(frames))

    def _check_obstructions(self) -> None:
        acting = [s.name for s in self.surfaces if s.interaction != Interaction.PASS]
        named = [o.name for o in self.obstructions]
        for repeated in {n for n in named if named.count(n) > 1}:
            raise PrescriptionError(f"obstruction {repeated!r} occurs more than once: expected unique names")
        for obstruction in self.obstructions:
            for name in obstruction.before or ():
                if name not in acting:
                    wrong = unknown_name("mirror, lens surface or detector", name, acting)
                    raise PrescriptionError(f"obstruction {obstruction.name!r}: before: {wrong}")
            if obstruction.height > self.launch_distance:
                raise PrescriptionError(
                    f"obstruction {obstruction.name!r} reaches z = {obstruction.height:.6g} m: expected it below "
                    f"launch_distance = {self.launch_distance:.6g} m, where rays start"
                )

    def __repr__(self) -> str:
        size, field = f"{self.pupil_diameter:.6g} m", f"{math.degrees(self.field_radius):.6g} deg"
        return f"<Telescope {self.name}: {counted(len(self.surfaces), 'surface')}, pupil {size}, field radius {field}>"

    def __reduce__(self) -> tuple[Any, ...]:
        # A mapping proxy cannot be pickled: hand over plain dictionaries.
        plain: dict[str, Any] = {name: getattr(self, name) for name in self.__dataclass_fields__}
        plain |= {"groups": dict(self.groups), "group_frames": dict(self.group_frames)}
        return partial(Telescope, **plain), ()

    def _surface_frame(self, name: str) -> tuple[Vector, Matrix]:
        surface = self.surface(name)
        return surface.vertex, surface.rotation

    @cached_property
    def surface_names(self) -> tuple[str, ...]:
        """Names of the surfaces in the order of the light."""
        return tuple(s.name for s in self.surfaces)

    def surface(self, name: str) -> Surface:
        """Return the surface of that name.

        Raises
        ------
        UnknownNameError
            If no surface has the name.
        """
        for surface in self.surfaces:
            if surface.name == name:
                return surface
        raise unknown_name(f"surface of {self.name}", name, self.surface_names)

    def with_shape(self, name: str, shape: Shape) -> Telescope:
        """Return the telescope with another shape of one surface; this one stays as it is.

        Raises
        ------
        UnknownNameError
            If no surface has the name.
        """
        changed = replace(self.surface(name), shape=shape)
        return replace(self, surfaces=tuple(changed if s.name == name else s for s in self.surfaces))

    def with_other_surfaces(
        self, surfaces: Sequence[Surface], medium_before: Medium, obstructions: Sequence[Obstruction] = ()
    ) -> Telescope:
        """Return the telescope with other surfaces and obstructions, in a medium before them.

        Groups, dispersion corrector, stop, fields and links are of the surfaces that are gone: it has none.
        """
        return replace(
            self,
            surfaces=tuple(surfaces),
            medium_before=medium_before,
            obstructions=tuple(obstructions),
            groups={},
            group_frames={},
            dispersion_corrector=None,
            design_data=DesignData(),
        )

    def with_coatings(self, coatings: Mapping[str, AnyCoating]) -> Telescope:
        """Return the telescope with coatings of surfaces by their names, and of no others.

        UnknownNameError if no surface has a name.
        """
        for name in coatings:
            self.surface(name)
        return replace(self, surfaces=tuple(s.coated(coatings.get(s.name)) for s in self.surfaces))

    def with_deformation(self, name: str, deformation: Shape) -> Telescope:
        """Return the telescope with a deformation added to the sag of one surface.

        Parameters
        ----------
        name : str
            Name of the surface.
        deformation : Shape
            Sag to add [m], in the surface's own frame: a bending mode or a measured error, for example.

        Raises
        ------
        UnknownNameError
            If no surface has the name.
        """
        shape = self.surface(name).shape
        parts = shape.parts if isinstance(shape, Sum) else (shape,)
        return self.with_shape(name, Sum((*parts, deformation)))

    def perturbed(
        self,
        name: str,
        *,
        shift: ArrayLike = (0.0, 0.0, 0.0),
        tilt: ArrayLike = (0.0, 0.0, 0.0),
        about: ArrayLike | None = None,
    ) -> Telescope:
        """Return the telescope with one surface, or a group of surfaces, rotated and then shifted.

        The rotation is Rx @ Ry @ Rz in the axes of the surface (or group) itself, the order of a Zemax coordinate
        break. Decentre and tilt do not commute: here the rotation comes first, about a point that does not move, and
        the shift second, along the axes of the telescope.

        Parameters
        ----------
        name : str
            Name of a surface or a group.
        shift : array or Quantity, shape (3,)
            Displacement [m] in the telescope frame.
        tilt : array or Quantity, shape (3,)
            Angles (rx, ry, rz) [rad].
        about : array or Quantity, shape (3,), optional
            Fixed point of the rotation [m], telescope frame; the vertex of the surface, or for a group that of its
            first surface, by default.

        Returns
        -------
        Telescope
            A new telescope; this one stays as it is.

        Raises
        ------
        UnknownNameError
            If no surface or group has the name.
        DomainError
            If `shift`, `tilt` or `about` is not three finite numbers.
        """
        if name in self.groups:
            members, (pivot, axes) = set(self.groups[name]), self.group_frames[name]
        elif name in self.surface_names:
            members, (pivot, axes) = {name}, self._surface_frame(name)
        else:
            raise unknown_name("surface or group", name, (*self.surface_names, *self.groups))
        dr, angles = metres(shift, "shift"), radians(tilt, "tilt")
        centre = metres(pivot if about is None else about, "about")
        for label, value in (("shift", dr), ("tilt", angles), ("about", centre)):
            if value.shape != (3,) or not np.all(np.isfinite(value)):
                raise DomainError(f"{label} = {value.tolist()}: expected three finite numbers")
        rotation = np.eye(3)
        if np.any(angles):
            frame = np.array(axes)
            rotation = frame @ rotation_matrix(angles) @ frame.T
        surfaces = tuple(
            s.moved(rotation=rotation, about=centre, shift=dr) if s.name in members else s for s in self.surfaces
        )
        frames = dict(self.group_frames)
        if name in self.groups:
            # Groups within the moved group go along; moving one surface alone leaves its group's pivot where it was.
            for group, inner in self.groups.items():
                if members.issuperset(inner):
                    frames[group] = move_frame(*frames[group], rotation=rotation, about=centre, shift=dr)
        return replace(self, surfaces=surfaces, group_frames=frames)

    @property
    def length_unit(self) -> tuple[str, float]:
        """Unit of lengths in tables and its length [m]: the file's, else mm for pupils under a metre, m for others."""
        if self.design_data != DesignData():
            return self.design_data.length_unit, self.design_data.unit
        return ("mm", 1e-3) if self.pupil_diameter < 1.0 else ("m", 1.0)

    @property
    def rotator(self) -> float:
        """Angle of the detector's axes about its normal, from those that :func:`unturned_axes` has [rad].

        It is the angle of :meth:`with_rotator` where the design's axes are those of the telescope.
        """
        axes, across = unturned_axes(self.surfaces[-1]), self.surfaces[-1].matrix[:, 0]
        return 0.0 if axes is None else math.atan2(float(axes[:, 1] @ across), float(axes[:, 0] @ across))

    def with_rotator(self, angle: ArrayLike) -> Telescope:
        """Return the telescope with its camera rotated about the camera's own axis.

        The detector is rotated, and with it the axes of positions, CCD heights and images. Lenses and filter rotate
        too, which changes nothing of a rotationally symmetric lens; shifts, tilts and deformations of them stay as they
        are in the telescope frame (``perturbed("Camera", tilt=(0, 0, angle))`` rotates these as well). So do
        obstructions.

        Parameters
        ----------
        angle : float or Quantity
            From +x towards +y of the telescope frame [rad].

        Raises
        ------
        DomainError
            If the angle is not one finite number.
        """
        turn = radians(angle, "angle")
        if turn.ndim or not np.isfinite(turn):
            raise DomainError(f"angle = {turn.tolist()}: expected one finite number")
        # Whole turns leave no trace of rounding.
        return self.perturbed(self.surfaces[-1].name, tilt=(0.0, 0.0, math.remainder(float(turn), 2.0 * math.pi)))

    def with_obstructions(self, *obstructions: Obstruction) -> Telescope:
        """Return the telescope with more meshes that block light.

        Raises
        ------
        PrescriptionError
            If a name occurs already, an obstruction names a surface that is none of its own, or rises above where rays
            start.
        """
        return replace(self, obstructions=(*self.obstructions, *obstructions))

    def in_medium(self, medium: Medium) -> Telescope:
        """Return the telescope in another medium: in air, where its prescription has vacuum before and behind lenses.

        Parameters
        ----------
        medium : Medium
            What takes the place of `medium_before`, there and behind surfaces that have the same, such as
            ``pachon.Air(69328.0, 293.15)``.
        """
        surfaces = (
            replace(s, medium_after=medium) if s.medium_after == self.medium_before else s for s in self.surfaces
        )
        return replace(self, medium_before=medium, surfaces=tuple(surfaces))

    @property
    def sphere_radius(self) -> float:
        """Radius of reference spheres [m]: `reference_sphere_radius`, infinite where the image is."""
        return math.inf if self.design_data.afocal else self.reference_sphere_radius

    def with_design(self, **changes: Any) -> Telescope:
        """Return the telescope with other :class:`DesignData`, such as ``aiming="real"``.

        Raises
        ------
        PrescriptionError
            If a value is not as expected.
        """
        return replace(self, design_data=replace(self.design_data, **changes))

    def check_wavelength(self, wavelength: ArrayLike) -> np.ndarray:
        """Return the wavelength [m] as a float64 array.

        Raises
        ------
        DomainError
            If it lies outside `wavelength_range`.
        """
        return wavelengths_within(wavelength, self.wavelength_range, self.name)

    def check_field(self, tx: ArrayLike, ty: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the field angles [rad] as float64 arrays.

        Raises
        ------
        DomainError
            If ``hypot(tx, ty)`` exceeds `field_limit`.
        """
        x, y = broadcast_together({"tx": radians(tx, "tx"), "ty": radians(ty, "ty")})
        # Rounding of a limit that was converted from degrees must not exclude the limit itself.
        bad = ~(np.hypot(x, y) <= self.field_limit * (1 + 1e-12))
        if np.any(bad):
            worst = np.rad2deg([np.atleast_1d(v)[np.atleast_1d(bad)][0] for v in (x, y)])
            raise DomainError(
                f"field = ({worst[0]:.6g}, {worst[1]:.6g}) deg: "
                f"expected within {np.rad2deg(self.field_limit):.6g} deg of the axis for {self.name}"
            )
        return x, y


def unturned_axes(detector: Surface) -> np.ndarray | None:
    """Return the axes of a detector [3, 3] with x as near to the telescope's as a turn about its normal makes it.

    None where the normal is nearer to the telescope's x than 60 deg.
    """
    normal = detector.matrix[:, 2]
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    length = np.linalg.norm(x)
    if length < _LEAST_ALONG_X:
        return None
    x /= length
    return np.stack([x, np.cross(normal, x), normal], axis=1)
