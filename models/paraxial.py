"""Paraxial rays along an axis: the entrance pupil that a stop makes, and its size by the aperture that is stated.

Heights are traced along the light, ``s = -z``, from the first surface. At a surface of curvature ``c`` along s::

    n' u' = n u - h c (n' - n)        h_next = h + u t

with the index n negative behind an odd number of mirrors.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from .media.medium import Medium
from .parabasal import stop_center_point
from .surface import Interaction, Surface
from .telescope import Telescope
from .thickness import is_fold

#: Height at the stop, over that of a ray from its middle, below which the entrance pupil is at infinity.
_NO_IMAGE = 1e-9
#: Difference of two pupils that rounding makes, over their size.
_ROUNDING = 1e-12
#: Largest radius of a reference sphere [m]; paths to a sphere that large are those to a plane, to 1e-10 m at a blur of
#: a millimetre.
_LARGEST_SPHERE = 1e4
#: Smallest radius of a reference sphere, over the diameter of the entrance pupil.
_SMALLEST_SPHERE = 1e-2
#: Radius of a reference sphere in units of that of the beam on the detector, at least.
_WIDER = 2.0


@dataclass
class ParaxialSurfaces:
    """Surfaces of a paraxial trace: curvatures [1/m], media, mirrors and the distance to the next [m].

    Like Zemax it traces in the plane x = 0; where no surface is curved there, in the plane y = 0.
    """

    rows: list[tuple[tuple[float, float], Medium, Medium, bool]] = field(default_factory=list)
    powers: list[float] = field(default_factory=list)
    distances: list[float] = field(default_factory=list)
    stop: int = 0
    stop_radius: float = 0.0
    _ahead: float = 0.0

    @classmethod
    def of(
        cls, telescope: Telescope, stop: str, *, front: bool = False, tilted: bool = False, straight: bool = False
    ) -> ParaxialSurfaces:
        """Return the surfaces of a telescope, with one of them as the stop; DomainError if one is off the axis.

        With `front` they end with the stop; with `tilted` they may be off the axis, as for Zemax, and fold mirrors are
        unfolded. With `straight` nothing is: distances are those along z, as of a file whose surfaces all stand on the
        axis of the object space.
        """
        paraxial, medium = cls(), telescope.medium_before
        unfolded = tilted and not straight
        folds = [unfolded and is_fold(telescope, i) for i in range(len(telescope.surfaces))]
        place, axis = np.array(telescope.surfaces[0].vertex), np.array([0.0, 0.0, -1.0])
        for surface, fold in zip(telescope.surfaces, folds, strict=True):
            if not tilted:
                require_on_axis(surface, telescope.name)
            # Counted along the light in front of an even number of mirrors, and against it in front of an odd one.
            ahead = np.array(surface.vertex) - place
            paraxial.advance(float(axis @ ahead) if any(folds) else -float(ahead[2]))
            place = place + axis * (axis @ ahead) if any(folds) else np.array(surface.vertex)
            if surface.name == stop:
                paraxial.mark_stop(0.0)
            mirror = surface.interaction == Interaction.MIRROR
            sign = -1.0 if straight else math.copysign(1.0, axis @ surface.matrix[:, 2])
            x, y = surface.shape.curvatures if straight else curvatures_across(surface)
            lens = surface.thin_lens
            power = 0.0 if lens is None else 1.0 / lens.focal_length
            paraxial.add((sign * x, sign * y), medium, surface.medium_after, mirror=mirror, power=power)
            if front and surface.name == stop:
                break
            if fold:
                normal = surface.matrix[:, 2]
                axis = 2.0 * (axis @ normal) * normal - axis
            medium = surface.medium_after
        return paraxial

    def add(
        self, curvatures: tuple[float, float], before: Medium, after: Medium, *, mirror: bool, power: float = 0.0
    ) -> None:
        """Add a surface of given curvatures along x and y, or a thin lens of a power [1/m]."""
        self.powers.append(power)
        self.rows.append((curvatures, before, after, mirror))
        self.distances.append(self._ahead)
        self._ahead = 0.0

    def advance(self, thickness: float) -> None:
        """Go on along the axis [m]; coordinate breaks do it too."""
        self._ahead += thickness

    def mark_stop(self, radius: float, *, first: bool = False) -> None:
        """Take the next surface (or the first) for the stop, with its semi-diameter [m]."""
        self.stop, self.stop_radius = (0 if first else len(self.rows)), radius

    def trace(self, height: float, slope: float, wavelength: float) -> tuple[np.ndarray, float]:
        """Return the heights [m] at the surfaces, and the last slope, of a ray by its first height [m] and slope."""
        heights = []
        n = float(self.rows[0][1].index(wavelength))
        axis = 1 if any(curvatures[1] for curvatures, *_ in self.rows) else 0
        for (curvatures, _, after, mirror), power, distance in zip(self.rows, self.powers, self.distances, strict=True):
            height += slope * distance
            heights.append(height)
            glass = float(after.index(wavelength))
            n_after = -n if mirror else math.copysign(glass, n)
            slope = (n * slope - height * curvatures[axis] * (n_after - n) - height * power) / n_after
            n = n_after
        return np.array(heights), slope

    def object_distance_at(self, place: int, wavelength: float, object_distance: float) -> float:
        """Return the distance along the light of the image of the object that a surface has in front of it [m].

        `object_distance` [m] is that from the object to the first surface; the result is negative where the image is
        behind the surface.
        """
        height, slope = (1.0, 0.0) if math.isinf(object_distance) else (object_distance, 1.0)
        side = 1.0
        if place:
            front = ParaxialSurfaces(self.rows[:place], self.powers[:place], self.distances[:place])
            heights, slope = front.trace(height, slope, wavelength)
            height = float(heights[-1])
            side = -1.0 if sum(mirror for *_, mirror in front.rows) % 2 else 1.0
        height += slope * self.distances[place]
        return side * height / slope if slope else math.inf


@dataclass(frozen=True)
class StopImage:
    """Paraxial image of the stop by the surfaces in front of it: the entrance pupil.

    Attributes
    ----------
    surfaces : ParaxialSurfaces
        The surfaces.
    wavelength : float
        Vacuum wavelength [m].
    object_distance : float
        From the object to the first surface [m].
    z : float
        From the first surface to the entrance pupil, along the light [m]. In a telecentric object space, whose chief
        rays are parallel to the axis, that is the first surface.
    telecentric : bool
        Whether the object space is telecentric.
    stop_scale : float
        Height at the stop for each unit of height in the entrance pupil.
    image_scale, image_slope : float
        Height [m] and slope of the chief ray at the last surface for each unit of the tangent of the field angle.
    focal_length : float
        Effective focal length [m]; infinite of an afocal system.
    """

    surfaces: ParaxialSurfaces
    wavelength: float
    object_distance: float
    z: float
    telecentric: bool
    stop_scale: float
    image_scale: float
    image_slope: float
    focal_length: float

    @classmethod
    def of(
        cls, surfaces: ParaxialSurfaces, wavelength: float, object_distance: float, *, telecentric: bool
    ) -> StopImage | None:
        """Return the image of the stop; None where it is at infinity, and so is the object or it has no distance."""
        heights, end_slope = surfaces.trace(1.0, 0.0, wavelength)
        across, across_slope = surfaces.trace(0.0, 1.0, wavelength)
        scale, offset = float(heights[surfaces.stop]), float(across[surfaces.stop])
        at_infinity = abs(scale) < _NO_IMAGE * max(1.0, abs(offset))
        telecentric = telecentric or at_infinity
        if telecentric and (not math.isfinite(object_distance) or object_distance == 0):
            return None
        if telecentric:
            # The chief ray of the field angle t starts at the height -t object_distance.
            z = 0.0
            image, slope = -object_distance * float(heights[-1]), -object_distance * end_slope
            # At unit height in the plane of the first surface its slope is 1 / object_distance.
            scale += offset / object_distance
        else:
            z = offset / scale
            image, slope = float(across[-1] - z * heights[-1]), across_slope - z * end_slope
        focal_length = -1.0 / end_slope if end_slope else math.inf
        return cls(surfaces, wavelength, object_distance, z, telecentric, scale, image, slope, focal_length)

    def beam_radius(self, diameter: float) -> float:
        """Return the paraxial radius of the light of the object on the axis at the last surface [m].

        `diameter` is that of the entrance pupil [m].
        """
        height, slope, distance = 0.5 * diameter, 0.0, self.object_distance + self.z
        if math.isfinite(distance) and distance:
            slope = height / distance
            height = slope * self.object_distance
        heights, _ = self.surfaces.trace(height, slope, self.wavelength)
        return abs(float(heights[-1]))

    def diameter(self, aperture: str, value: float) -> float:
        """Return the diameter of the entrance pupil [m] of an aperture of DesignData; 0 or infinite if it has none."""
        distance = abs(self.object_distance + self.z)
        if aperture == "entrance_pupil":
            return value
        if aperture == "stop":
            return 2.0 * value / abs(self.stop_scale) if self.stop_scale else math.inf
        if not value > 0:
            return 0.0
        if aperture == "object_na":
            sine = value / float(self.surfaces.rows[0][1].index(self.wavelength))
            return 2.0 * distance * math.tan(math.asin(sine)) if sine < 1 else math.inf
        if aperture == "f_number" or math.isinf(self.object_distance):
            return abs(self.focal_length) / value
        # The paraxial working f-number, 1 / (2 n u): of the cone of light from the object to the image.
        _, slope = self.surfaces.trace(self.object_distance, 1.0, self.wavelength)
        cone = abs(slope * float(self.surfaces.rows[-1][2].index(self.wavelength)))
        return distance / (value * cone) if cone else math.inf


def stop_image(telescope: Telescope, *, front: bool = False, tilted: bool = False, straight: bool = False) -> StopImage:
    """Return the paraxial image of a telescope's stop at its default wavelength.

    With `front` the surfaces behind the stop are left out, and may be off the axis; its image, and the pupil of an
    aperture that is not a focal ratio, do not depend on them. `tilted` and `straight` are those of
    :meth:`ParaxialSurfaces.of`.
    DomainError if its design data name no stop, a surface is off the axis, or the image is at infinity.
    """
    data = telescope.design_data
    if data.stop is None:
        raise DomainError(f"{telescope.name}: expected a surface that is the stop (design data: stop)")
    surfaces = ParaxialSurfaces.of(telescope, data.stop, front=front, tilted=tilted, straight=straight)
    distance = telescope.object_distance - telescope.surfaces[0].vertex[2]
    image = StopImage.of(surfaces, telescope.default_wavelength, distance, telecentric=data.telecentric)
    if image is None:
        raise DomainError(f"{telescope.name}: the stop {data.stop!r} makes an entrance pupil at infinity (telecentric)")
    return image


def reference_radius(
    pupil_distance: float, focal_length: float, pupil_diameter: float, beam_radius: float = 0.0
) -> float:
    """Return the radius [m] of the reference sphere through the exit pupil.

    ``pupil_distance`` is that from the exit pupil to the image [m], which may be infinite, ``beam_radius`` that of the
    light of one point on the detector. Where the exit pupil is at the image, or rays of a detector far from the focus
    would miss the sphere, the focal length takes its place. A sphere has at most 1e4 m.
    """
    least = max(_SMALLEST_SPHERE * pupil_diameter, _WIDER * beam_radius)
    radius = next((abs(v) for v in (pupil_distance, focal_length) if abs(v) > least), max(1.0, least))
    return min(radius, _LARGEST_SPHERE)


@check_arguments
def with_floating_pupil(telescope: Telescope) -> Telescope:
    """Return the telescope with the entrance pupil that its stop and the aperture that it states make now.

    Surfaces that were changed move the image of the stop and, at a stated focal ratio, its diameter.

    Raises
    ------
    DomainError
        If the design data have no stop or no aperture, a surface is off the axis, or the pupil has no finite size.
    """
    return floating_pupil(telescope)


def floating_pupil(telescope: Telescope, *, tilted: bool = False, straight: bool = False) -> Telescope:
    """Return :func:`with_floating_pupil`; with `tilted` of surfaces off the axis too, as if they were on it.

    `straight` is that of :meth:`ParaxialSurfaces.of`.
    """
    data = telescope.design_data
    front = data.aperture not in ("f_number", "working_f_number")
    image = stop_image(telescope, front=front, tilted=tilted, straight=straight)
    if data.aperture is None or data.aperture_value is None:
        raise DomainError(f"{telescope.name}: expected an aperture in its design data")
    diameter = image.diameter(data.aperture, data.aperture_value)
    if not 0 < diameter < math.inf:
        raise DomainError(
            f"{telescope.name}: {data.aperture} = {data.aperture_value:g}: expected a pupil of finite size"
        )
    return replace(telescope, stop_z=_pupil_height(telescope, image), pupil_diameter=diameter)


def _pupil_height(telescope: Telescope, image: StopImage) -> float:
    """Return the height of the image of the stop [m], telescope frame."""
    return telescope.surfaces[0].vertex[2] - image.z + 0.0


def stop_is_inside(t: Telescope) -> bool:
    """Return whether the stop has mirrors or lens surfaces in front of it: a change of them moves its image."""
    if t.design_data.stop is None:
        return False
    front = t.surfaces[: t.surface_names.index(t.design_data.stop)]
    return any(s.interaction in (Interaction.MIRROR, Interaction.REFRACT, Interaction.THIN_LENS) for s in front)


def following_stop(t: Telescope) -> Telescope:
    """Return a telescope whose rays follow its stop when it changes: aimed at it where it is inside.

    Rays that are aimed anyway, those of a telecentric object space, and those of a telescope whose stop is in front of
    all mirrors and lenses stay as they are.
    """
    data = t.design_data
    if data.aiming != "off" or data.telecentric or not stop_is_inside(t):
        return t
    return t.with_design(aiming="real")


def with_moved_pupil(t: Telescope, *, straight: bool = False) -> Telescope:
    """Return a changed telescope with its entrance pupil where its stop, inside it, is imaged now.

    The diameter of the pupil stays, of an object at a finite distance the angle of the beam; a stated size of the stop
    keeps that. Another aperture that the change made untrue becomes a diameter. As for Zemax, surfaces off the axis
    count as if they were on it. A telescope without such a pupil, or whose stop is not inside, is returned as it is.
    `straight` is that of :meth:`ParaxialSurfaces.of`.
    """
    data = t.design_data
    if data.telecentric or not stop_is_inside(t) or stop_makes_pupil(t, straight=straight):
        return t
    with suppress(DomainError):
        stated = t
        if data.aperture not in ("stop", "object_na"):
            height = _pupil_height(t, stop_image(t, front=True, tilted=True, straight=straight))
            farther = (t.object_distance - height) / (t.object_distance - t.stop_z)
            diameter = t.pupil_diameter * (abs(farther) if math.isfinite(t.object_distance) else 1.0)
            stated = t.with_design(aperture="entrance_pupil", aperture_value=diameter)
        return floating_pupil(stated, tilted=True, straight=straight)
    return t


def following_pupil(changed: Telescope, unchanged: Telescope) -> Telescope:
    """Return a changed telescope whose entrance pupil has moved with the image of its stop, sideways too.

    Where the stop is inside, the pupil moves along the axis as :func:`with_moved_pupil` says. Off the axis it moves by
    as much as the ray along the axis that passes the middle of the stop. In a telecentric object space it keeps the
    stated aperture.
    """
    if changed.design_data.telecentric:
        with suppress(DomainError):
            return floating_pupil(changed, tilted=True) if stop_makes_pupil(unchanged) else changed
        return changed
    moved = with_moved_pupil(changed)
    if not stop_is_inside(changed):
        return moved
    with suppress(DomainError):
        if moved is not changed and not stop_makes_pupil(unchanged):
            # The stop makes a pupil that is not the one stated: both move by the same.
            planes = [
                floating_pupil(t.with_design(aperture="entrance_pupil", aperture_value=t.pupil_diameter), tilted=True)
                for t in (changed, unchanged)
            ]
            moved = replace(changed, stop_z=changed.stop_z + planes[0].stop_z - planes[1].stop_z)
    with suppress(DomainError):
        shift = stop_center_point(moved, moved.default_wavelength) - stop_center_point(
            unchanged, unchanged.default_wavelength
        )
        if shift.any():
            x, y = (float(v) for v in unchanged.pupil_center + shift)
            moved = replace(moved, pupil_center=(x, y))
    return moved


def stop_makes_pupil(t: Telescope, *, straight: bool = False) -> bool:
    """Return whether stop and aperture are stated, and make the entrance pupil of the telescope.

    `straight` is that of :meth:`ParaxialSurfaces.of`.
    """
    if t.design_data.stop is None or t.design_data.aperture is None:
        return False
    try:
        floating = floating_pupil(t, tilted=True, straight=straight)
    except DomainError:
        return False
    close = {"rel_tol": _ROUNDING, "abs_tol": _ROUNDING * t.pupil_diameter}
    same_plane = math.isclose(floating.stop_z, t.stop_z, **close)
    return same_plane and math.isclose(floating.pupil_diameter, t.pupil_diameter, **close)


def stop_states_rays(t: Telescope, *, straight: bool = False) -> bool:
    """Return whether a lens file that states stop, aperture and ray aiming has the rays of a telescope.

    Stop and aperture make its entrance pupil; or they need not, as rays of given angles are aimed at the stop, and the
    aperture is the diameter of their beam. A reader has a place for the pupil then, without effect on the rays.
    `straight` is that of :meth:`ParaxialSurfaces.of`.
    """
    if stop_makes_pupil(t, straight=straight):
        return True
    data = t.design_data
    if data.stop is None or data.aiming == "off" or math.isfinite(t.object_distance) or data.field_type != "angle":
        return False
    if (data.aperture, data.aperture_value) != ("entrance_pupil", t.pupil_diameter):
        return False
    surfaces = ParaxialSurfaces.of(t, data.stop, tilted=True, straight=straight)
    return StopImage.of(surfaces, t.default_wavelength, math.inf, telecentric=False) is not None


def with_true_aperture(telescope: Telescope, *, straight: bool = False) -> Telescope:
    """Return a telescope of the same rays whose stop and stated aperture make its entrance pupil, where there is one.

    A focal ratio that a change has made untrue becomes the diameter of the pupil, which stays. Where rays are aimed at
    the stop, the entrance pupil moves to where the stop is imaged now; elsewhere the plane of the pupil stays, whether
    or not the stop makes it. `straight` is that of :meth:`ParaxialSurfaces.of`.
    """
    data = telescope.design_data
    if data.stop is None or data.telecentric or stop_makes_pupil(telescope, straight=straight):
        return telescope
    stated = telescope
    if data.aperture in (None, "f_number", "working_f_number", "entrance_pupil"):
        stated = telescope.with_design(aperture="entrance_pupil", aperture_value=telescope.pupil_diameter)
    # Field angles of an object at a finite distance are those of rays through the middle of the pupil.
    same_fields = math.isinf(telescope.object_distance) or (bool(data.fields) and data.field_type != "angle")
    if data.aiming != "off" and same_fields:
        if stop_is_inside(telescope):
            stated = with_moved_pupil(stated, straight=straight)
        elif math.isinf(telescope.object_distance):
            # Surfaces off the axis have no such image; the rays do not depend on it.
            with suppress(DomainError):
                stated = with_floating_pupil(stated)
    untrue = data.aperture in ("f_number", "working_f_number") and not _states_diameter(telescope, straight)
    return stated if untrue or stop_states_rays(stated, straight=straight) else telescope


def _states_diameter(t: Telescope, straight: bool) -> bool:
    """Return whether the stated aperture makes the diameter of the pupil, or cannot be compared with it."""
    try:
        floating = floating_pupil(t, tilted=True, straight=straight)
    except DomainError:
        return True
    return math.isclose(floating.pupil_diameter, t.pupil_diameter, rel_tol=_ROUNDING)


def require_on_axis(surface: Surface, name: str) -> None:
    """Raise a DomainError for a surface off the axis of its telescope."""
    axis = surface.matrix[:, 2]
    if surface.vertex[0] or surface.vertex[1] or axis[0] or axis[1] or axis[2] < 0:
        raise DomainError(f"surface {surface.name} of {name}: expected one on the axis, not perturbed")


def curvatures_across(surface: Surface, axes: np.ndarray | None = None) -> tuple[float, float]:
    """Return the curvatures [1/m] of a surface on the axis along x and y of the telescope; `axes` are its own there."""
    shape_curvatures = surface.shape.curvatures
    if shape_curvatures[0] == shape_curvatures[1]:
        return shape_curvatures
    # Euler's theorem: squares of the cosines between the axes weight the curvatures of the surface.
    frame = surface.matrix if axes is None else axes
    along_x, along_y = frame[:2, :2] ** 2 @ np.array(shape_curvatures)
    return float(along_x), float(along_y)
