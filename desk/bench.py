"""What a desk is about: a telescope, its degrees of freedom and camera, and the controls of a state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..core.errors import DomainError, PachonError, unknown_name
from ..design.metrics.principal_rays import principal_rays
from ..models.camera.camera import Camera
from ..models.camera.cameras import load_camera
from ..models.camera.focal_plane import FocalPlane
from ..models.camera.height_budget import BUDGET_KEYS, SIMULATED, TERMS
from ..models.io.prescription import load_telescope
from ..models.parameters.degrees_of_freedom import DegreeOfFreedom, DegreesOfFreedom
from ..models.parameters.degrees_of_freedom_file import load_degrees_of_freedom
from ..models.parameters.parameters import usual_parameters
from ..models.surface import Interaction
from ..models.telescope import Telescope
from ..wavefront.chief_rays import fields_at, reference_rays
from ..wavefront.request import Request
from .state import DeskState

#: Blur that a control makes at the ends of its slider, about [arcsec].
_BLUR = 2.0
#: The same for optics whose diffraction is larger, in depths of focus.
_DEPTHS = 20.0
#: Sideways motion over defocus, and tilt [rad] over sideways motion in focal lengths, at the ends of sliders.
_SIDEWAYS = 10.0
_TILT = 1.5
#: Change of radii and thicknesses at the ends of sliders, as a part of them.
_PART = 0.02
#: Surfaces of a lens that have radius and thickness as controls, at most.
_MOST_SURFACES = 20
#: Bending mode at the ends of its slider [um].
_BENDING = 1.0
#: Largest heights of the sliders over those of Table 1.
_TIMES = 4.0
_HEIGHT_LABELS = {
    "global": "Whole focal plane",
    "raft": "Rafts",
    "ccd": "CCDs on rafts",
    "tilt": "Tilts of CCDs",
    "potato_chip": "Potato chip of CCDs",
}
#: Places a side for spots, and stars in all that whiskers need at least.
_SPOTS = 5
_STARS = 60


@dataclass(frozen=True)
class Control:
    """A slider: its key in the state, label, unit, group and range."""

    key: str
    label: str
    unit: str
    group: str
    low: float
    high: float
    step: float


class Bench:
    """A telescope with all that a desk varies; what does not depend on the state is computed once."""

    def __init__(self, model: str | Telescope) -> None:
        # States of a telescope that was never a file name the one that it would be saved as.
        self.model = f"{model.name}.yaml" if isinstance(model, Telescope) else model
        self.nominal: Telescope = model if isinstance(model, Telescope) else load_telescope(model)
        self.camera: Camera | None = None if self.nominal.camera is None else load_camera(self.nominal.camera)
        self.freedoms = _freedoms(self.nominal)
        self._drawn_plane: FocalPlane | None = None
        principal = principal_rays(self.nominal, [(0.0, 0.0)])
        self.f_number = float(principal.mean_f_number[0])
        #: Angle on the sky over length on the detector [rad/m].
        self.plate_scale = float(principal.mean_plate_scale[0])

    @property
    def is_lsst(self) -> bool:
        """Whether the degrees of freedom are those of the LSST's active optics."""
        return self.freedoms.name == "lsst"

    @cached_property
    def start(self) -> DeskState:
        """The state at the beginning: the nominal telescope."""
        x, y = self.spot_fields[np.argmin(np.hypot(*(self.spot_fields - 0.5 * self.nominal.field_radius).T))]
        return DeskState(
            model=self.model,
            wavelength_nm=round(self.nominal.default_wavelength * 1e9, 3),
            field_deg=(round(math.degrees(x), 6), round(math.degrees(y), 6)),
            seeing_arcsec=0.6 if self.camera is not None else 0.0,
        )

    @cached_property
    def controls(self) -> tuple[Control, ...]:
        """All sliders, group by group."""
        sliders = [*self._optics_controls(), *self._height_controls()]
        low, high = (1e9 * w for w in self.nominal.band or self.nominal.wavelength_range)
        edge = math.degrees(self.nominal.field_radius)
        light = "Light and field"
        sliders.append(Control("wavelength_nm", "Wavelength", "nm", light, round(low, 1), round(high, 1), 1.0))
        for axis in "xy":
            step = _rounded(edge / 100.0)
            sliders.append(Control(f"field_deg.{axis}", f"Field {axis}", "deg", light, -_up(edge), _up(edge), step))
        sliders.append(Control("seeing_arcsec", "Seeing at 500 nm", "arcsec", light, 0.0, 2.0, 0.01))
        return tuple(sliders)

    def _optics_controls(self) -> list[Control]:
        sliders = []
        for member in self.freedoms.members:
            body, _, motion = member.name.rpartition("_")
            bends = motion.startswith("B") and self.is_lsst
            high = _BENDING if bends else self._reach(member)
            group = f"Bending modes of {body}" if bends else "Bodies"
            if motion in ("radius", "thickness"):
                group = "Radii and thicknesses"
            label = f"{body} {motion}"
            sliders.append(Control(f"optics.{member.name}", label, member.unit, group, -high, high, high / 100.0))
        return sliders

    def _reach(self, member: DegreeOfFreedom) -> float:
        """Return the value of a degree of freedom at the end of its slider."""
        motion = member.name.rpartition("_")[2]
        depth = _DEPTHS * self.nominal.default_wavelength * self.f_number**2
        defocus = max(_BLUR * math.radians(1.0 / 3600.0) / self.plate_scale * self.f_number, depth)
        if motion == "dz":
            return _rounded(defocus * 1e6)
        if motion in ("dx", "dy"):
            return _rounded(_SIDEWAYS * defocus * 1e6)
        if motion in ("rx", "ry"):
            return _rounded(_TILT * math.degrees(_SIDEWAYS * defocus * self.plate_scale) * 3600.0)
        [address] = member.of
        surface = self.nominal.surface(address.rpartition(".")[0])
        size = surface.shape.parameters["radius"] if motion == "radius" else _thickness(self.nominal, surface.name)
        return _rounded(_PART * abs(size) * 1e3)

    def _height_controls(self) -> list[Control]:
        if self.camera is None:
            return []
        sliders = []
        for term in TERMS:
            unit, high = ("urad" if term == "tilt" else "um"), _TIMES * 1e6 * getattr(SIMULATED, BUDGET_KEYS[term])
            label = f"{_HEIGHT_LABELS[term]}, PV"
            sliders.append(Control(f"heights.{term}", label, unit, "Heights of CCDs", 0.0, high, high / 100.0))
        return sliders

    @cached_property
    def lifted_names(self) -> tuple[str, ...]:
        """Rafts and CCDs that can be lifted."""
        return () if self.camera is None else (*self.camera.raft_names, *self.camera.ccd_names)

    def check(self, state: DeskState) -> DeskState:
        """Return a state as it is; PachonError where it is not one of this bench."""
        if state.model != self.model:
            raise DomainError(f"model = {state.model!r}: expected {self.model}, which this desk shows")
        for name in state.total_optics:
            self.freedoms.index(name)
        for name in state.lifts:
            if name not in self.lifted_names:
                raise unknown_name("CCD or raft", name, self.lifted_names)
        if state.heights and self.camera is None:
            raise DomainError("heights: expected none for a telescope without a camera")
        self.nominal.check_field(*np.deg2rad(state.field_deg))
        self.nominal.check_wavelength(state.wavelength_nm * 1e-9)
        return state

    def telescope(self, state: DeskState) -> Telescope:
        """Return the telescope of a state."""
        return self.freedoms.apply(self.nominal, state.total_optics)

    def focal_plane(self, state: DeskState) -> FocalPlane | None:
        """Return the CCDs of a state; None where they are on the nominal detector, or there are none."""
        if self.camera is None or not (state.heights or state.lifts or self.camera.placement is not None):
            return None
        plane = self.flat
        if state.heights:
            plane = self._drawn(state.seed).scaled(height_factors(state.heights))
        for name, lift in state.lifts.items():
            plane = plane.with_moved(name, dz=lift * 1e-6)
        return plane

    @cached_property
    def flat(self) -> FocalPlane:
        """Flat CCDs of the camera."""
        if self.camera is None:
            raise DomainError(f"{self.model}: expected a telescope with a camera")
        return FocalPlane.flat(self.camera)

    def _drawn(self, seed: int) -> FocalPlane:
        if self._drawn_plane is None or self._drawn_plane.seed != seed:
            self._drawn_plane = FocalPlane.from_budget(self.flat.camera, seed=seed)
        return self._drawn_plane

    @cached_property
    def spot_fields(self) -> np.ndarray:
        """Field angles of the spots [rad], shape [n, 2]: about five a side, none in a gap between CCDs."""
        axis = np.linspace(-1.0, 1.0, _SPOTS)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        if self.camera is None:
            return grid * self.nominal.field_radius / math.sqrt(2.0)
        low, high = (f(self.camera.centers, axis=0) for f in (np.min, np.max))
        half = 0.5 * (high - low) + (0.9 * self.camera.half_sizes[0] if len(self.camera) < _SPOTS**2 else 0.0)
        places = 0.5 * (low + high) + grid * half
        distance = np.linalg.norm(places[:, None] - self.camera.centers, axis=-1)
        if len(self.camera) >= _SPOTS**2:
            # In the corners of a round focal plane there are no CCDs.
            near = distance.min(axis=1) < 1.5 * np.linalg.norm(self.camera.half_sizes, axis=1).max()
            places = self.camera.centers[np.unique(distance[near].argmin(axis=1))]
        else:
            places = places[self.camera.ccd_at(*places.T) >= 0]
        return self._seen(places)[0]

    def stars(self, per_ccd: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Return places [m] and field angles [rad] of whiskers, one or ten a CCD, shape [n, 2] each."""
        if per_ccd not in self._stars:
            self._stars[per_ccd] = self._star_places(per_ccd)
        return self._stars[per_ccd]

    @cached_property
    def _stars(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        return {}

    def _star_places(self, per_ccd: int) -> tuple[np.ndarray, np.ndarray]:
        if self.camera is None:
            axis = np.linspace(-1.0, 1.0, 9 if per_ccd == 1 else 15)
            grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
            fields = self.nominal.field_radius * grid[np.hypot(*grid.T) <= 1.0]
            return self._landing(fields), fields
        count = len(self.camera)
        columns = math.ceil(math.sqrt(_STARS / count))
        rows = columns * (5 if per_ccd > 1 else 1)
        columns *= 2 if per_ccd > 1 else 1
        dx, dy = (v.ravel() for v in np.meshgrid(*(2.0 * (np.arange(n) + 0.5) / n - 1.0 for n in (columns, rows))))
        index = np.repeat(np.arange(count), len(dx))
        half = self.camera.half_sizes[index]
        local = np.tile(dx, count) * half[:, 0], np.tile(dy, count) * half[:, 1]
        fields, places = self._seen(np.stack(self.camera.from_local(index, *local), axis=-1))
        return places, fields

    def _landing(self, fields: np.ndarray) -> np.ndarray:
        """Return where the chief rays of fields [rad] land on the detector [m]; in scale where one does not."""
        wavelength = self.nominal.default_wavelength
        try:
            chief = reference_rays(Request.of(self.nominal, fields, wavelength), wavelength)
        except DomainError:
            return fields / self.plate_scale
        return self.nominal.surfaces[-1].to_local(chief.position)[:, :2]

    def _seen(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return field angles [rad] and places [m] of those places that the telescope covers."""
        fields = fields_at(self.nominal, places)
        inside = np.isfinite(fields).all(axis=1) & (np.hypot(*fields.T) <= self.nominal.field_limit)
        return fields[inside], places[inside]


def height_factors(heights: Mapping[str, float]) -> dict[str, float]:
    """Return factors of Table 1's simulated budget for peaks to valleys of its terms [um, urad]."""
    return {term: 1e-6 * heights.get(term, 0.0) / getattr(SIMULATED, BUDGET_KEYS[term]) for term in TERMS}


def _freedoms(telescope: Telescope) -> DegreesOfFreedom:
    """Return the degrees of freedom of a telescope: the LSST's where they fit, motions, and radii of lenses."""
    lsst = load_degrees_of_freedom("lsst")
    if {"M1", "M2", "M3"} <= set(telescope.surface_names) and "Camera" in telescope.groups:
        try:
            lsst.parameter_matrix(telescope)
            return lsst
        except PachonError:
            pass
    members = [
        DegreeOfFreedom(f"{p.target}_{p.name}", "um" if p.unit == "m" else "arcsec", {p.address: 1.0})
        for p in usual_parameters(telescope)
    ]
    acting = [s for s in telescope.surfaces[:-1] if s.interaction in (Interaction.REFRACT, Interaction.MIRROR)]
    if not telescope.groups and len(acting) <= _MOST_SURFACES:
        for surface in acting:
            radius = surface.shape.parameters.get("radius", np.inf)
            if np.isfinite(radius) and radius:
                members.append(DegreeOfFreedom(f"{surface.name}_radius", "mm", {f"{surface.name}.radius": 1.0}))
            if _thickness(telescope, surface.name):
                members.append(DegreeOfFreedom(f"{surface.name}_thickness", "mm", {f"{surface.name}.thickness": 1.0}))
    return DegreesOfFreedom(tuple(members), name=telescope.name)


def _thickness(telescope: Telescope, surface: str) -> float:
    """Return the distance from a surface to the next one [m]; 0 where it has none."""
    from ..models.parameters.parameters import Parameter

    try:
        return abs(Parameter.parse(f"{surface}.thickness", telescope).value(telescope))
    except PachonError:
        return 0.0


def _rounded(value: float) -> float:
    """Return 1, 2 or 5 times a power of ten near a positive number."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(math.log(m * power / value))) * power)


def _up(value: float) -> float:
    """Return a number of two digits at or above a positive one."""
    power = 10.0 ** (math.floor(math.log10(value)) - 1)
    return round(math.ceil(value / power - 1e-9) * power, 9)
