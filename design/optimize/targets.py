"""Targets: numbers that an optimisation holds at a value, in addition to its merit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...core.arguments import check_arguments
from ...models.telescope import Telescope
from ...raytrace.adjoint.backward_pass import landing_gradient
from ...raytrace.adjoint.forward_pass import forward_pass
from ...raytrace.rays import field_direction, parallel_rays
from .jacobian import ParameterColumns

#: Angle [rad] between the two chief rays of the focal length; distortion enters as its square.
_SMALL_FIELD = 1e-4


@check_arguments
@dataclass(frozen=True)
class FocalLength:
    """Focal length: distance on the detector of two chief rays near the axis over the tangent of their angle.

    This is the scale on the detector. It differs from the paraxial focal length if the detector is not in the paraxial
    focus.

    Parameters
    ----------
    value : float
        Wanted focal length [m].
    weight : float
        An error of 1 mm counts as `weight` times 1 mm of rms spot or wavefront.
    wavelength : float, optional
        Vacuum wavelength [m]; the telescope's own by default.
    """

    value: float
    weight: float = 1.0
    wavelength: float | None = None

    def residuals(self, telescope: Telescope) -> np.ndarray:
        """Return the residual [m], shape [1]."""
        return self.derivatives(ParameterColumns.at(telescope, ()))[0]

    def derivatives(self, columns: ParameterColumns) -> tuple[np.ndarray, np.ndarray]:
        """Return the residual [m] and its derivatives, shape [1, n_parameter]."""
        telescope = columns.telescope
        angles = np.array([-0.5, 0.5]) * _SMALL_FIELD
        light = field_direction(angles, np.zeros(2))
        w = telescope.default_wavelength if self.wavelength is None else self.wavelength
        forward = forward_pass(telescope, parallel_rays(telescope, light, w, np.zeros((1, 2))))
        change = np.diff(columns.derivatives(forward, landing_gradient(forward)), axis=1)[:, 0]
        apart = np.diff(forward.landing[:2], axis=1)[:, 0]
        length = float(np.hypot(*apart))
        rate = self.weight / (2.0 * np.tan(0.5 * _SMALL_FIELD))
        return np.array([rate * length - self.weight * self.value]), (rate / length * apart @ change)[None]


@check_arguments
@dataclass(frozen=True)
class Target:
    """Any property of a telescope, with derivatives from central differences.

    Parameters
    ----------
    function : callable
        Function of a telescope that returns the number.
    value : float
        Wanted value.
    weight : float
        Factor from the number to an rms spot or wavefront [m].
    step : float
        Effect on wavefront or spots [m] of the step of a variable for the differences.
    """

    function: Callable[[Telescope], float]
    value: float
    weight: float = 1.0
    step: float = 1e-5

    def residuals(self, telescope: Telescope) -> np.ndarray:
        """Return the residual, shape [1]."""
        return np.array([self.weight * (float(self.function(telescope)) - self.value)])
