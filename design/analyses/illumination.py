"""Relative illumination: light on the detector against the field, by the projected solid angle of its light.

An extended source of one radiance L makes the irradiance ``L A`` on the detector, where A is the area that the rays
which meet at a point of it fill in direction cosines along the detector, times the square of the index there: the solid
angle of the exit pupil, projected (Rimmer 1986, Proc. SPIE 655, 99). Since étendue is conserved, each element of the
entrance pupil contributes its area times ``|det d(l, m)/d(X, Y)|``, with direction cosines l, m of the incoming ray
along the pupil and landing points X, Y, at the same point of the pupil. With a small pupil and an image free of
distortion that goes as the fourth power of the cosine of the field angle.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, GREY, ORANGE
from ...core.units import require_count
from ...models.telescope import Telescope
from ...raytrace.ideal_lens import require_image
from ...raytrace.rays import Projection, object_points
from ...wavefront.request import Request
from ..drawing import finish_axes
from .analysis import Analysis, Columns, field_line
from .coatings import Coatings
from .throughput import coatings_of, efficiencies

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Change of the slopes of the light on either side for the Jacobian.
_STEP = 1e-4
#: Neighbours, in these steps.
_STEPS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


@dataclass(frozen=True)
class RelativeIllumination(Analysis):
    """Irradiance of the detector by a uniform source, field by field.

    Attributes
    ----------
    solid_angle : ndarray, shape [n_field]
        Solid angle of the light on the detector, projected on it [sr], vignetting included.
    axis_solid_angle : float
        The same on the axis [sr].
    lit_fraction : ndarray, shape [n_field]
        Fraction of the area of the entrance pupil that is lit.
    chief_cosine : ndarray, shape [n_field]
        Cosine of the field angle.
    """

    solid_angle: np.ndarray
    axis_solid_angle: float
    lit_fraction: np.ndarray
    chief_cosine: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """Irradiance relative to the axis, shape [n_field]."""
        return self.solid_angle / self.axis_solid_angle

    @property
    def f_number(self) -> float:
        """Focal ratio in air of an unobscured cone of the solid angle on the axis."""
        return float(0.5 * np.sqrt(np.pi / self.axis_solid_angle))

    @property
    def _title(self) -> str:
        return f"relative illumination at {self._nanometres()}"

    def _table_columns(self) -> Columns:
        return self._field_columns() | {
            "relative_illumination": (self.relative, "", "illumination of the detector over that on the axis"),
            "projected_solid_angle": (self.solid_angle, "sr", "projected solid angle of the light"),
            "lit_fraction": (self.lit_fraction, "", "lit fraction of the entrance pupil"),
        }

    def _values(self) -> dict[str, Any]:
        return {
            "relative_illumination": self.relative,
            "projected_solid_angle_sr": self.solid_angle,
            "lit_fraction": self.lit_fraction,
            "smallest_relative": float(self.relative.min()),
            "f_number_of_axis_cone": self.f_number,
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        (axes,) = panels
        distance, label = self.axis_distances()
        order = np.argsort(distance, kind="stable")
        axes.plot(distance[order], 100 * self.relative[order], color=BLUE, linewidth=1.6, label="relative illumination")
        lit = 100 * self.lit_fraction[order]
        axes.plot(distance[order], lit, "--", color=ORANGE, linewidth=1.0, label="lit part of the entrance pupil")
        fourth = 100 * self.chief_cosine[order] ** 4
        axes.plot(distance[order], fourth, ":", color=GREY, linewidth=1.0, label="cos⁴ of the field angle")
        top = max(102.0, 1.02 * float(100 * self.relative.max()))
        finish_axes(axes, xlim=(0, None), ylim=(0, top), xlabel=label, ylabel="[%]")
        axes.legend(loc="lower left")


@check_arguments
def relative_illumination(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    *,
    coatings: Coatings | str | os.PathLike[str] | None = None,
    n_pupil: int = 2000,
    projection: Projection | None = None,
    threads: int | None = None,
) -> RelativeIllumination:
    """Trace the relative illumination of the detector.

    Parameters
    ----------
    telescope, wavelength, projection, threads
        As in :meth:`pachon.Request.of`.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; a line from the axis along +y to the edge of the field of view by default.
    coatings : Coatings or path, optional
        As in :func:`~pachon.throughput`: losses of coated and bare surfaces and of glasses, an empty ``Coatings()`` for
        bare surfaces alone. Nothing is lost by default.
    n_pupil : int
        Points of the pupil, at equal areas.

    Raises
    ------
    DomainError
        If no light reaches the detector on the axis, or a table does not cover the wavelength or the angle of a ray.
    ConfigError
        If the file of coatings is malformed, or layers stand on what is not a lens surface.
    UnknownNameError
        If a coating belongs to no surface, or absorption to no glass.
    """
    count = require_count(n_pupil, "n_pupil", 16, 10**6)
    request = Request.of(
        telescope,
        fields,
        wavelength,
        sampling="spiral",
        n_pupil=count,
        projection=projection,
        threads=threads,
        one_wavelength=True,
        default_fields=field_line,
    )
    telescope = request.telescope
    require_image(telescope, "a relative illumination")
    bare = coatings is None and all(s.coating is None for s in telescope.surfaces)
    telescope_coatings = None if bare else coatings_of(telescope, coatings)
    # Each field with its own vignetting factors; the axis is not one of the stated fields.
    field_requests = [
        request.at_fields(np.zeros((1, 2))),
        *(request.at_fields(slice(i, i + 1)) for i in range(len(request.fields))),
    ]
    solid, lit = [], []
    for field_request in field_requests:
        area, fraction = _projected(field_request, telescope_coatings)
        solid.append(area)
        lit.append(fraction)
    if not solid[0] > 0:
        raise DomainError(f"telescope {telescope.name}: expected one with light on the axis; all of it is vignetted")
    cosine = -request.directions[:, 2]
    return RelativeIllumination(request, np.array(solid[1:]), solid[0], np.array(lit[1:]), cosine)


def _projected(request: Request, coatings: Coatings | None) -> tuple[float, float]:
    """Return projected solid angle [sr], times what coatings leave, and lit fraction of one field."""
    telescope, sample, wavelength = request.telescope, request.pupil, request.wavelength
    lit = request.bundles(wavelength).lit[0]
    if not lit.any():
        return 0.0, 0.0
    points = sample.points[lit]
    cones = _cones_of_the_object if telescope.design_data.telecentric else _cones_through_the_pupil
    ratio = cones(request, points)
    if coatings is not None:
        for efficiency in efficiencies(request, coatings, wavelength)[1].values():
            ratio = ratio * efficiency[0, lit]
    finite = np.isfinite(ratio)
    index = float(telescope.medium_before.index(wavelength))
    area = np.pi * (0.5 * telescope.pupil_diameter * index) ** 2 * (1.0 - telescope.pupil_obscuration**2)
    fraction = float(sample.weights[lit].sum())
    mean = float(np.average(ratio[finite], weights=sample.weights[lit][finite])) if finite.any() else 0.0
    return area * fraction * mean, fraction * float(request.pupil_areas[0])


def _cones_through_the_pupil(request: Request, points: np.ndarray) -> np.ndarray:
    """Return the projected solid angle at the detector over the area of the pupil [sr/m^2] at pupil points [n, 2].

    The étendue is that of neighbouring fields through one point of the entrance pupil.
    """
    telescope, wavelength, element = request.telescope, request.wavelength, np.ones(len(points))
    if request.vignetting is not None or telescope.design_data.aiming != "off" or any(telescope.pupil_center):
        # The area that an element of the pupil of the request fills in the plane of the entrance pupil.
        step = 0.5 * _STEP * telescope.pupil_diameter
        around = np.concatenate([points, *(points + step * s for s in _STEPS)])
        points, *moved = request.entrance_points(wavelength, around).reshape(5, -1, 2)
        element = _determinant(np.array(moved)) / (2.0 * step) ** 2
    # Rays are not aimed again.
    straight = request.at_fields(request.slopes + _STEP * _STEPS)
    unaimed = replace(telescope.with_design(aiming="off"), pupil_center=(0.0, 0.0))
    beside = replace(straight, telescope=unaimed, projection="gnomonic")
    landing = beside.bundles(wavelength, points).landing()
    cosines = beside.launch(wavelength, points).direction.reshape(4, -1, 3)[..., :2]
    # Both over the same change of the field: their ratio is per metre of the detector.
    return np.asarray(element * _determinant(cosines) / _determinant(landing))


def _cones_of_the_object(request: Request, points: np.ndarray) -> np.ndarray:
    """Return the same in a telecentric object space, whose aperture is the same cone at all points of the object.

    The étendue is that of neighbouring points of the object, in one direction.
    """
    telescope, wavelength = request.telescope, request.wavelength
    step = 0.5 * _STEP * telescope.pupil_diameter
    around = np.concatenate([points + step * s for s in _STEPS])
    cosines = request.launch(wavelength, around).direction.reshape(4, -1, 3)[..., :2]
    beside = replace(request.at_fields(request.slopes + _STEP * _STEPS), projection="gnomonic")
    places = object_points(telescope, beside.directions)[:, None, :2]
    landing = beside.bundles(wavelength, request.vignetted(points).reshape(-1, 2)).landing()
    return np.asarray(_determinant(cosines) / (2.0 * step) ** 2 * _determinant(places) / _determinant(landing))


def _determinant(values: np.ndarray) -> np.ndarray:
    """Return the size of the Jacobian [n] of values [4, n, 2] at fields on either side in x, and in y."""
    (a, b), (c, d) = (values[0] - values[1]).T, (values[2] - values[3]).T
    return np.abs(a * d - b * c)
