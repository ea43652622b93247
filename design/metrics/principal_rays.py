"""Chief and marginal rays: landing points, focal ratios, plate scale and exit pupil.

The exit pupil is the image of the entrance pupil. Rays of neighbouring directions through one point of the entrance
pupil meet again at the image of that point. With ``X`` and ``d`` position and direction of a ray behind the last
surface and primes for their change with the direction of the light, they meet at ``X + t d`` with
``t = -(X' . d') / (d' . d')``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, GREY, ORANGE, figure_at, length_unit_of, styled
from ...core.units import field_label
from ...models.telescope import Telescope
from ...raytrace.ideal_lens import image_points
from ...raytrace.launch import launch_bundles
from ...raytrace.rays import Projection, RayStatus, field_direction
from ...raytrace.trace import trace
from ...wavefront.chief_rays import JACOBIAN_STEP
from ...wavefront.pupil_sampling import pupil_sampling
from ...wavefront.request import Request
from ..drawing import finish_axes
from ..result import FieldResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Distance of the rays "near" the chief ray from the centre of the entrance pupil, in units of its radius.
_NEAR = 0.01
#: Rings of pupil points that focal ratios are fitted to.
_RINGS = 6
#: Cosine of the angle between axes of image and sky below which they stand across each other, and 1 less that above
#: which they are the same.
_ACROSS = 1e-6
_SAME = 1e-12
#: Marginal rays, through the rim of the entrance pupil: along the field (tangential) and across it (sagittal).
MARGINAL = ("tangential +", "tangential -", "sagittal +", "sagittal -")


@dataclass(frozen=True)
class PrincipalRays(FieldResult):
    """Chief and marginal rays of several field points, in the telescope frame.

    Tangential is the direction from the axis to the field point (y, on the axis); sagittal is across it.

    Attributes
    ----------
    chief_position, chief_direction : ndarray, shape [n_field, 3]
        Intersection of the chief ray with the detector [m], and its direction there.
    chief_landing : ndarray, shape [n_field, 2]
        The same intersection in x and y of the detector [m].
    chief_angle : ndarray, shape [n_field]
        Angle of incidence of the chief ray on the detector [rad].
    marginal_position, marginal_direction : ndarray, shape [n_field, 4, 3]
        The same of the marginal rays in the order of :data:`MARGINAL`, vignetted or not; NaN where they do not arrive.
    f_number : ndarray, shape [n_field, 2]
        Working focal ratio, tangential and sagittal, which sets the diffraction limit: 1 over the refractive index
        times the change of the rays' direction cosines, along the detector, from rim to rim of the entrance pupil, by a
        linear fit over the lit rays. On the axis of a telescope that fulfils the sine condition it is 1/(2 n sin u).
    plate_scale : ndarray, shape [n_field, 2]
        Angle on the sky over length on the detector [rad/m], tangential and sagittal.
    exit_pupil : ndarray, shape [n_field, 3]
        Centre of the exit pupil [m]; not finite where the telescope is telecentric.
    exit_pupil_distance : ndarray, shape [n_field, 2]
        Distance from the detector to the exit pupil along the chief ray [m], tangential and sagittal; negative in front
        of the detector. `exit_pupil` is half-way between the two.
    exit_pupil_diameter : ndarray, shape [n_field, 2]
        Diameter of the exit pupil [m], tangential and sagittal, by the magnification near the chief ray.
    """

    _table = (
        "fields",
        "chief_landing",
        "chief_angle",
        "f_number",
        "plate_scale",
        "exit_pupil",
        "exit_pupil_distance",
        "exit_pupil_diameter",
    )

    _on_image = ("chief_landing", "plate_scale")

    chief_position: np.ndarray
    chief_direction: np.ndarray
    chief_landing: np.ndarray
    chief_angle: np.ndarray
    marginal_position: np.ndarray
    marginal_direction: np.ndarray
    f_number: np.ndarray
    plate_scale: np.ndarray
    exit_pupil: np.ndarray
    exit_pupil_distance: np.ndarray
    exit_pupil_diameter: np.ndarray

    @property
    def mean_f_number(self) -> np.ndarray:
        """Geometric mean of both focal ratios, shape [n_field]."""
        return np.sqrt(self.f_number.prod(axis=1))

    @property
    def mean_plate_scale(self) -> np.ndarray:
        """Geometric mean of both plate scales [rad/m], shape [n_field]."""
        return np.sqrt(self.plate_scale.prod(axis=1))

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; lists run over the fields, pairs are tangential, sagittal."""
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelength * 1e9,
            **self.field_items(),
            **self.on_image({"chief_landing_mm": self.chief_landing * 1e3}),
            "chief_incidence_deg": np.rad2deg(self.chief_angle),
            **({} if self.in_angles else {"f_number": self.f_number}),
            **self.on_image(self.of_sky({"plate_scale_arcsec_per_um": np.rad2deg(self.plate_scale) * 3600e-6})),
            "exit_pupil_m": self.exit_pupil,
            "exit_pupil_distance_m": self.exit_pupil_distance,
            "exit_pupil_diameter_m": self.exit_pupil_diameter,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw focal ratio, plate scale, exit pupil and incidence against the distance from the axis."""
        radius, distance = self.axis_distances()
        order = np.argsort(radius, kind="stable")
        lengths = np.abs([self.exit_pupil_distance, self.exit_pupil_diameter])
        unit, size = length_unit_of(float(lengths.max(where=np.isfinite(lengths), initial=0.0)))
        pairs = [
            ("working focal ratio", self.f_number),
            (self.image_text('plate scale ["/µm]'), np.rad2deg(self.plate_scale) * 3600e-6),
            (f"exit pupil, from the detector [{unit}]", self.exit_pupil_distance * size),
            (f"diameter of the exit pupil [{unit}]", self.exit_pupil_diameter * size),
        ]
        with styled():
            figure = figure_at(ax, 11.0, 6.4)
            panels = figure.subplots(2, 3, sharex=True).ravel()
            for axes, (label, values) in zip(panels, pairs, strict=False):
                axes.plot(radius[order], values[order, 0], ".-", color=BLUE, label="tangential")
                axes.plot(radius[order], values[order, 1], ".-", color=ORANGE, label="sagittal")
                axes.set_ylabel(label)
            panels[0].legend(loc="best")
            panels[4].plot(radius[order], np.rad2deg(self.chief_angle[order]), ".-", color=GREY)
            panels[4].set_ylabel("incidence of the chief ray [deg]")
            panels[5].set_axis_off()
            for axes in panels[:5]:
                finish_axes(axes)
                axes.ticklabel_format(useOffset=False)
            for axes in panels[2:5]:
                axes.set_xlabel(distance)
                axes.tick_params(labelbottom=True)
            return self._titled(figure, f"chief and marginal rays, {self._nanometres()}")


#: Slope of the rays over the pupil [rad] below which light is parallel: what is left is rounding.
PARALLEL = 1e-12


@check_arguments
def principal_rays(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    *,
    projection: Projection | None = None,
    threads: int | None = None,
) -> PrincipalRays:
    """Trace chief and marginal rays; find exit pupil, focal ratio, plate scale.

    Parameters
    ----------
    telescope, fields, wavelength, projection, threads
        As in :meth:`pachon.Request.of`.

    Raises
    ------
    DomainError
        If a field or the wavelength lies outside what the telescope covers, or a chief ray does not reach the detector.
    """
    request = Request.of(telescope, fields, wavelength, projection=projection, threads=threads, one_wavelength=True)
    _ = request.wavelength  # one only
    return principal_rays_of(request)


def principal_rays_of(request: Request) -> PrincipalRays:
    """Return chief and marginal rays for the field points of a request at its middle wavelength."""
    telescope, wavelength = request.telescope, request.middle
    pupil = pupil_sampling(telescope, "gauss", _RINGS)
    # Heights of CCDs change none of it: all is on the nominal detector.
    request = replace(request, wavelengths=np.array([wavelength]), weights=np.ones(1), pupil=pupil, focal_plane=None)
    n, slopes, axes = len(request.fields), request.slopes, tangential_axes(request)
    steps = JACOBIAN_STEP * np.concatenate([np.zeros((n, 1, 2)), axes, -axes], axis=1)
    # Per field: the direction of the chief ray and four beside it; each through centre, near zone and rim of the pupil.
    near = (slopes[:, None] + steps).reshape(-1, 2)
    rim = 0.5 * telescope.pupil_diameter * np.stack([axes, -axes], axis=2).reshape(n, 4, 2)
    through = np.repeat(request.vignetted(np.concatenate([np.zeros((n, 1, 2)), _NEAR * rim, rim], axis=1)), 5, axis=0)
    directions = field_direction(near[:, 0], near[:, 1], "gnomonic")
    end = trace(telescope, launch_bundles(telescope, directions, wavelength, through), threads=request.threads)
    image = image_points(telescope, end).reshape(n, 5, 9, 3)
    position, direction = end.position.reshape(n, 5, 9, 3), end.direction.reshape(n, 5, 9, 3)
    chief_position, chief_direction = position[:, 0, 0], direction[:, 0, 0]
    reached = (end.status.reshape(n, 5, 9)[:, :, :5] <= RayStatus.VIGNETTED).all(axis=(1, 2))
    if not reached.all():
        raise DomainError(f"{field_label(request.fields[~reached][0])}: the chief ray does not reach the detector")
    detector = telescope.surfaces[-1]
    normal = detector.matrix[:, 2]
    sky = directions.reshape(n, 5, 3)
    moved = position[:, [1, 2], 0] - position[:, [3, 4], 0]
    rotated = direction[:, [1, 2], 0] - direction[:, [3, 4], 0]
    on_image = np.linalg.norm(image[:, [1, 2], 0] - image[:, [3, 4], 0], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.linalg.norm(sky[:, [1, 2]] - sky[:, [3, 4]], axis=-1) / on_image
        distance = -(moved * rotated).sum(axis=-1) / (rotated**2).sum(axis=-1)
        pupil_center = chief_position + distance.mean(axis=1)[:, None] * chief_direction
        # The plane of the exit pupil is parallel to the detector.
        start, along = position[:, 0, 1:5], direction[:, 0, 1:5]
        to_plane = ((pupil_center[:, None] - start) @ normal) / (along @ normal)
        crossing = start + to_plane[..., None] * along
        diameter = np.linalg.norm(crossing[:, [0, 2]] - crossing[:, [1, 3]], axis=-1) / _NEAR
    return PrincipalRays(
        request=request,
        chief_position=chief_position,
        chief_direction=chief_direction,
        chief_landing=detector.to_local(image[:, 0, 0])[:, :2],
        chief_angle=np.arccos(np.clip(np.abs(chief_direction @ normal), 0.0, 1.0)),
        marginal_position=position[:, 0, 5:],
        marginal_direction=direction[:, 0, 5:],
        f_number=_focal_ratios(request, axes),
        plate_scale=scale,
        exit_pupil=pupil_center,
        exit_pupil_distance=distance,
        exit_pupil_diameter=diameter,
    )


def tangential_axes(request: Request) -> np.ndarray:
    """Return unit vectors along the field (y on the axis) and across it for each field, shape [n_field, 2, 2].

    The first axis after the fields is tangential, sagittal; the last x, y of pupil and detector.
    """
    slopes = request.slopes
    radius = np.hypot(*slopes.T)[:, None]
    tangential = np.where(radius > 0, slopes / np.where(radius > 0, radius, 1.0), [0.0, 1.0])
    return np.stack([tangential, np.stack([tangential[:, 1], -tangential[:, 0]], axis=-1)], axis=1)


def image_axes(request: Request) -> np.ndarray:
    """Return unit vectors on the detector along the image of a field and across it, shape [n_field, 2, 2].

    They are the :func:`tangential_axes` where the image has the axes of the sky, upright or inverted; else the nearest
    orthogonal ones to the motion of the image with the field, such as on a detector that is turned or behind a fold.
    Their signs are those nearest to the axes of the sky.
    """
    axes = tangential_axes(request)
    slopes = (request.slopes[:, None] + JACOBIAN_STEP * np.concatenate([axes, -axes], axis=1)).reshape(-1, 2)
    beside = replace(request.at_fields(slopes), projection="gnomonic", focal_plane=None)
    ends = beside.bundles(request.middle, np.zeros((1, 2))).chief_landing().reshape(-1, 2, 2, 2)
    moved = ends[:, 0] - ends[:, 1]
    arrived = np.isfinite(moved).all(axis=(1, 2))
    image_basis, _, sky_basis = np.linalg.svd(np.where(arrived[:, None, None], moved, axes))
    turned = image_basis @ sky_basis
    along = (turned * axes).sum(axis=-1, keepdims=True)
    turned = np.where(along < -_ACROSS, -turned, turned)
    # Differences of landing points would turn axes of symmetry by their rounding.
    return np.where(np.abs(along) > 1.0 - _SAME, axes, turned)


def _focal_ratios(request: Request, axes: np.ndarray) -> np.ndarray:
    """Return focal ratios [n_field, 2] along axes [n_field, 2, 2] of the pupil.

    NaN where no light arrives, infinite where it is parallel.
    """
    weights, unit = request.pupil.weights, request.unit_pupil
    bundles = request.bundles(request.wavelength)
    cosines = bundles.cosines
    ratios = np.full((len(request.fields), 2), np.nan)
    for i, lit in enumerate(bundles.lit):
        plane = np.stack([np.ones(lit.sum()), *unit[lit].T], axis=-1)
        root = np.sqrt(weights[lit])[:, None]
        slopes, _, rank, _ = np.linalg.lstsq(plane * root, cosines[i, lit] * root, rcond=None)
        if rank == 3:
            cone = np.linalg.norm(axes[i] @ slopes[1:], axis=-1)
            with np.errstate(divide="ignore"):
                ratios[i] = 1.0 / (2.0 * bundles.index * np.where(cone < PARALLEL, 0.0, cone))
    return ratios
