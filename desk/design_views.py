"""Views that are computed where they are wanted: MTF, xi+, sensitivities, three dimensions, better states."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from ..core.errors import PachonError, check_choice
from ..design.images.mtf import mtf
from ..design.layout.layout import Layout
from ..design.layout.sections import surface_lines
from ..design.optimize.jacobian import ParameterColumns
from ..design.optimize.merit import Beams, SpotMerit
from ..design.optimize.sensitivity import sensitivity
from ..measure.correlation import SeparationBins, shear_correlation
from ..models.parameters.degrees_of_freedom import DegreesOfFreedom
from ..models.paraxial import following_stop
from ..wavefront.chief_rays import reference_rays
from ..wavefront.request import Request
from .state import DeskState
from .views import JMAX, RINGS, Scene, WhiskersView

#: Metrics of the sensitivities.
WAVEFRONT, SPOTS = f"rms of Z4 to Z{JMAX} at the star", "rms spot radius over the field"
METRICS = (WAVEFRONT, SPOTS, *(f"Z{j} at the star" for j in range(4, 12)))
#: Evaluations of the merit between two pictures of an optimisation.
_EVALUATIONS = 4
#: Whiskers on a CCD where they are many: for a correlation, and drawn after a moment.
PER_CCD = 10
#: Bins of separation.
_BINS = 10


@dataclass(frozen=True)
class MtfView:
    """Modulation transfer of the star, by frequency."""

    frequency: np.ndarray  #: on the detector [cycles/mm], [n]
    tangential: np.ndarray  #: contrast, [n]
    sagittal: np.ndarray
    limit: np.ndarray  #: of a perfect wavefront, mean of both directions


def mtf_view(scene: Scene) -> MtfView:
    """Return the modulation transfer of the optics at the star, diffraction included, without an atmosphere."""
    result = mtf(Request.of(scene.telescope, scene.field[None], scene.wavelength).on(scene.focal_plane))
    limit = 0.5 * (result.tangential_limit[0] + result.sagittal_limit[0])
    return MtfView(result.frequency * 1e-3, result.tangential[0], result.sagittal[0], limit)


@dataclass(frozen=True)
class CorrelationView:
    """Correlation function xi+ of the ellipticities (a - b) / (a + b) of whiskers; NaN in bins without pairs."""

    r_arcmin: np.ndarray  #: mean separation of the pairs [arcmin], [n]
    xi_plus: np.ndarray  #: of the state, [n]
    reference: np.ndarray  #: of the state that it is compared to, [n]
    change: np.ndarray  #: of the differences of ellipticity between both, star by star, [n]
    against: str  #: the state that it is compared to, in words
    count: int  #: of whiskers

    @property
    def numbers(self) -> dict[str, tuple[float, str]]:
        """The values at the shortest separation, with their units."""
        at = f"at {self.r_arcmin[0]:.2g} arcmin"
        return {
            f"xi+ of e {at}": (float(self.xi_plus[0]), ""),
            f"xi+ of its change from {self.against} {at}": (float(self.change[0]), ""),
        }


def separation_bins(fields: np.ndarray) -> SeparationBins:
    """Return bins from the least separation of field angles [rad], shape [n, 2], to the diameter of the field."""
    nearest = cKDTree(fields).query(fields, k=2)[0][:, 1]
    # A pair at the end of a bin may round out of it.
    return SeparationBins(0.9 * float(nearest.min()), 2.01 * float(np.hypot(*fields.T).max()), _BINS, exact=False)


def correlation_view(
    fields: np.ndarray, bins: SeparationBins, now: WhiskersView, reference: WhiskersView, against: str
) -> CorrelationView:
    """Return the correlations of whiskers at field angles [rad], shape [n, 2], of a state and of another one."""
    x, y = fields.T
    shapes = ((now.e1, now.e2), (reference.e1, reference.e2), (now.e1 - reference.e1, now.e2 - reference.e2))
    state, compared, change = (shear_correlation(x, y, e1, e2, bins=bins) for e1, e2 in shapes)
    return CorrelationView(state.r_arcmin, state.xi_plus, compared.xi_plus, change.xi_plus, against, len(x))


@dataclass(frozen=True)
class SensitivityView:
    """Derivatives of a metric by all degrees of freedom, at the state, on its CCDs."""

    metric: str
    value: float  #: of the metric, in its unit
    unit: str
    names: tuple[str, ...]  #: of the degrees of freedom, [n]
    units: tuple[str, ...]
    derivative: np.ndarray  #: unit of the metric per unit of the degree of freedom, [n]
    effect: np.ndarray  #: change of the metric by a step of the slider, [n]


def sensitivity_view(scene: Scene, metric: str) -> SensitivityView:
    """Return the exact derivatives of one of :data:`METRICS`."""
    check_choice("metric", metric, METRICS)
    bench = scene.bench
    if metric == SPOTS:
        residuals, slopes = _Spots(scene, bench.freedoms).derivatives()
        radius = float(np.linalg.norm(residuals))
        unit = "urad" if bench.nominal.design_data.afocal else "um"
        value, derivative = 1e6 * radius, 1e6 * (residuals @ slopes) / radius
    else:
        detector = scene.telescope.surfaces[-1]
        # A star sees of its CCD the height alone.
        shift = detector.matrix @ [0.0, 0.0, float(_heights(scene, scene.field[None])[0])]
        telescope = scene.telescope.perturbed(detector.name, shift=shift) if shift.any() else scene.telescope
        result = sensitivity(telescope, bench.freedoms, scene.field[None], scene.wavelength, n_zernike=JMAX)
        zernikes, matrix, unit = 1e9 * result.zernikes[0], 1e9 * result.matrix[0], "nm"
        if metric == WAVEFRONT:
            value = float(np.linalg.norm(zernikes[3:]))
            derivative = zernikes[3:] @ matrix[3:] / value
        else:
            place = METRICS.index(metric) + 1
            value, derivative = float(zernikes[place]), matrix[place]
    steps = {control.key: control.step for control in bench.controls}
    effect = derivative * np.array([steps[f"optics.{name}"] for name in bench.freedoms.names])
    return SensitivityView(metric, value, unit, bench.freedoms.names, bench.freedoms.units, derivative, effect)


def _heights(scene: Scene, fields: np.ndarray) -> np.ndarray:
    """Return the heights of the CCDs where the chief rays of fields land [m], shape [n]."""
    plane = scene.focal_plane
    if plane is None:
        return np.zeros(len(fields))
    end = reference_rays(Request.of(scene.telescope, fields, scene.wavelength), scene.wavelength, plane)
    x, y, _ = scene.telescope.surfaces[-1].to_local(end.position).T
    return np.asarray(plane.height(x, y))


class _Spots:
    """Spots over the field of the bench, on the CCDs of a scene, by degrees of freedom beyond its state."""

    def __init__(self, scene: Scene, freedoms: DegreesOfFreedom) -> None:
        telescope, fields = following_stop(scene.telescope), scene.bench.spot_fields
        self._prepared, self._parameters, self._matrix = freedoms.parameter_matrix(telescope)
        beams = Beams.of(telescope, fields, scene.wavelength, n_pupil=RINGS)
        self._merit = SpotMerit(telescope, beams, heights=_heights(scene, fields))

    def derivatives(self, values: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals, whose norm is the rms radius [m], and their derivatives at values of the freedoms."""
        changes = None if values is None else self._matrix @ values
        residuals, slopes = self._merit.derivatives(ParameterColumns.at(self._prepared, self._parameters, changes))
        return residuals, slopes @ self._matrix


@dataclass(frozen=True)
class Line:
    """A line of a surface, or a ray, in space."""

    name: str
    kind: str  #: "mirror", "refract", "detector", "pass"... or "ray"
    points: np.ndarray  #: [n, 3] [m], telescope frame; NaN breaks it


def space_view(drawing: Layout) -> tuple[Line, ...]:
    """Return rings and meridians of the surfaces, and rays all around the pupil."""
    lines = [Line("ray", "ray", path) for bundle in drawing.bundles for path in bundle]
    for surface in drawing.telescope.surfaces:
        kind = surface.interaction.name.lower()
        lines += [Line(surface.name, kind, points) for points in surface_lines(surface, drawing.reach[surface.name])]
    return tuple(lines)


def projected(points: np.ndarray, azimuth: float, elevation: float) -> np.ndarray:
    """Return points [n, 3] as seen from a direction, along its right and its upward axis, [n, 2].

    The azimuth [rad] goes from +x to +y and the elevation [rad] from there to +z. There is no perspective.
    """
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.array([-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth), np.cos(elevation)])
    return points @ np.stack([right, up], axis=-1)


@dataclass(frozen=True)
class Improvement:
    """A state with smaller spots."""

    state: DeskState
    before_um: float  #: rms spot radius over the field [um]
    after_um: float


def improved(scene: Scene, names: list[str]) -> Improvement:
    """Return the state after some steps of least squares over degrees of freedom, within the ranges of their sliders.

    The merit is the rms spot radius over the field of the bench, on the CCDs of the scene.
    """
    bench, state = scene.bench, scene.state
    spots = _Spots(scene, bench.freedoms.select(names))
    start, slopes = spots.derivatives()
    before = float(np.linalg.norm(start))
    controls = {control.key: control for control in bench.controls}
    sliders = [controls[f"optics.{name}"] for name in names]
    start_values = np.array([state.value(control.key) for control in sliders])
    low = np.minimum([control.low for control in sliders] - start_values, 0.0)
    high = np.maximum([control.high for control in sliders] - start_values, 0.0)

    @lru_cache(maxsize=2)
    def at(*values: float) -> tuple[np.ndarray, np.ndarray]:
        try:
            return spots.derivatives(np.array(values))
        except PachonError:
            # The solver takes a shorter step.
            return np.full_like(start, np.inf), slopes

    # In units of the merit: the tolerances of the solver are relative to 1.
    solution = least_squares(
        lambda values: at(*values)[0] / before,
        np.zeros(len(names)),
        jac=lambda values: at(*values)[1] / before,
        bounds=(low, high),
        x_scale=[control.high for control in sliders],
        max_nfev=_EVALUATIONS,
    )
    after = before * float(np.linalg.norm(solution.fun))
    if after < before:
        for control, value, change in zip(sliders, start_values, solution.x, strict=True):
            state = state.with_value(control.key, float(value + change))
    return Improvement(state, 1e6 * before, 1e6 * min(before, after))
