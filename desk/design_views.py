"""Views that are computed where they are wanted: MTF, sensitivities, three dimensions, better states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.errors import check_choice
from ..design.images.mtf import mtf
from ..design.layout.layout import Layout
from ..design.layout.sections import surface_lines
from ..design.optimize.jacobian import ParameterColumns
from ..design.optimize.merit import Beams
from ..design.optimize.merit_function import SpotSize
from ..design.optimize.optimize import optimize
from ..design.optimize.sensitivity import sensitivity
from ..design.optimize.solver import LeastSquares
from ..models.parameters.degrees_of_freedom import unit_size
from ..wavefront.request import Request
from .state import DeskState
from .views import JMAX, RINGS, Scene

#: Metrics of the sensitivities.
WAVEFRONT, SPOTS = f"rms of Z4 to Z{JMAX} at the star", "rms spot radius over the field"
METRICS = (WAVEFRONT, SPOTS, *(f"Z{j} at the star" for j in range(4, 12)))
#: Evaluations of the merit between two pictures of an optimisation.
_EVALUATIONS = 4


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
class SensitivityView:
    """Derivatives of a metric by all degrees of freedom, at the state, on the flat detector."""

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
        unit, (value, derivative) = "um", _spot_slopes(scene)
    else:
        result = sensitivity(scene.telescope, bench.freedoms, scene.field[None], scene.wavelength, n_zernike=JMAX)
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


def _spot_slopes(scene: Scene) -> tuple[float, np.ndarray]:
    """Return the rms spot radius [um] and its derivatives by the degrees of freedom."""
    telescope, parameters, matrix = scene.bench.freedoms.parameter_matrix(scene.telescope)
    beams = Beams.of(telescope, scene.bench.spot_fields, scene.wavelength, n_pupil=RINGS)
    columns = ParameterColumns.at(telescope, parameters)
    residuals, slopes = SpotSize().of(telescope, beams).derivatives(columns)
    radius = float(np.linalg.norm(residuals))
    return 1e6 * radius, 1e6 * (residuals @ slopes / radius) @ matrix


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
    """Return the state after some steps of :func:`~pachon.optimize` over degrees of freedom of one parameter.

    The merit is the rms spot radius over the field of the bench, on the flat detector.
    """
    bench, state = scene.bench, scene.state
    addresses = [bench.variables[name] for name in names]
    result = optimize(
        scene.telescope,
        addresses,
        "spots",
        bench.spot_fields,
        scene.wavelength,
        n_pupil=RINGS,
        solver=LeastSquares(max_steps=_EVALUATIONS),
    )
    before, after = (float(merit) for merit in result.merits)
    if after < before:
        change = dict(zip(result.addresses, result.changes, strict=True))
        for name, address in zip(names, addresses, strict=True):
            key, unit = f"optics.{name}", bench.freedoms.units[bench.freedoms.index(name)]
            state = state.with_value(key, state.value(key) + float(change[address]) / unit_size(unit))
    return Improvement(state, 1e6 * before, 1e6 * min(before, after))
