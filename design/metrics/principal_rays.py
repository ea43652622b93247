"""Chief and marginal rays, traced: where they land, the focal ratio they make, and where the exit pupil is.

The exit pupil is the image of the entrance pupil. Rays of neighbouring directions through one point of the entrance
pupil meet again at that point's image; with ``X`` and ``d`` position and direction of a ray behind the last surface and
primes for their change with the direction of the light, they meet at ``X + t d`` with ``t = -(X' . d') / (d' . d')``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.errors import DomainError
from ...core.plotting import BLUE, GREY, ORANGE, new_figure, styled
from ...models.telescope import Telescope
from ...raytrace.rays import RayStatus, field_direction, launch_bundles
from ...raytrace.trace import trace
from ...wavefront.bundles import trace_bundles
from ...wavefront.chief_rays import JACOBIAN_STEP
from ...wavefront.pupil_sampling import pupil_sampling
from ...wavefront.request import field_points, wavelength_points

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Rays "near" the chief ray pass the entrance pupil so far from its centre, in units of its radius.
_NEAR = 0.01
#: The marginal rays: through the rim of the entrance pupil, along the field (tangential) and across it (sagittal).
MARGINAL = ("tangential +", "tangential -", "sagittal +", "sagittal -")


@dataclass(frozen=True)
class PrincipalRays:
    """Chief and marginal rays of several field points, in the telescope frame.

    Tangential is the direction of the field point seen from the axis (y, on the axis); sagittal is across it.

    Attributes
    ----------
    telescope : str
        Name of the telescope.
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    wavelength : float
        Vacuum wavelength [m].
    chief_position, chief_direction : ndarray, shape [n_field, 3]
        Where the chief ray meets the detector [m], and its direction there.
    chief_landing : ndarray, shape [n_field, 2]
        The same place in the detector's own x and y [m].
    chief_angle : ndarray, shape [n_field]
        Angle of incidence of the chief ray on the detector [rad].
    marginal_position, marginal_direction : ndarray, shape [n_field, 4, 3]
        The same of the marginal rays, blocked or not, NaN where they do not arrive, in the order of :data:`MARGINAL`.
    f_number : ndarray, shape [n_field, 2]
        Working focal ratio, tangential and sagittal, that the diffraction limit goes with: 1 over the refractive index
        times the change of the rays' direction cosines, along the detector, from rim to rim of the entrance pupil, by a
        linear fit over the lit rays. On the axis of a telescope that fulfils the sine condition it is 1/(2 n sin u).
    plate_scale : ndarray, shape [n_field, 2]
        Angle on the sky over length on the detector [rad/m], tangential and sagittal.
    exit_pupil : ndarray, shape [n_field, 3]
        Centre of the exit pupil [m]; not finite where the telescope is telecentric.
    exit_pupil_distance : ndarray, shape [n_field, 2]
        From the detector to the exit pupil along the chief ray [m], for tangential and sagittal neighbours of the chief
        ray; negative in front of the detector. `exit_pupil` is half-way between the two.
    exit_pupil_diameter : ndarray, shape [n_field, 2]
        Diameter of the exit pupil [m], tangential and sagittal, as rays near the chief ray magnify the entrance pupil.
    """

    telescope: str
    fields: np.ndarray
    wavelength: float
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

    def summary(self) -> dict[str, Any]:
        """Return the figures by name, units in the names; lists run over the fields, pairs are tangential, sagittal."""
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelength * 1e9,
            "field_deg": np.rad2deg(self.fields),
            "chief_landing_mm": self.chief_landing * 1e3,
            "chief_incidence_deg": np.rad2deg(self.chief_angle),
            "f_number": self.f_number,
            "plate_scale_arcsec_per_um": np.rad2deg(self.plate_scale) * 3600e-6,
            "exit_pupil_m": self.exit_pupil,
            "exit_pupil_distance_m": self.exit_pupil_distance,
            "exit_pupil_diameter_m": self.exit_pupil_diameter,
        }

    def plot(self) -> Figure:
        """Draw focal ratio, plate scale, exit pupil and incidence against the distance from the axis."""
        radius = np.rad2deg(np.linalg.norm(self.fields, axis=-1))
        order = np.argsort(radius, kind="stable")
        scale = np.rad2deg(self.plate_scale) * 3600e-6
        pairs = [
            ("working focal ratio", self.f_number),
            ('plate scale ["/µm]', scale),
            ("exit pupil, from the detector [m]", self.exit_pupil_distance),
            ("diameter of the exit pupil [m]", self.exit_pupil_diameter),
        ]
        with styled():
            figure = new_figure(11.0, 6.4)
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
                axes.grid(True, color="0.92", linewidth=0.6)
                axes.ticklabel_format(useOffset=False)
            for axes in panels[2:5]:
                axes.set_xlabel("distance from the axis [deg]")
                axes.tick_params(labelbottom=True)
            figure.suptitle(f"{self.telescope}: chief and marginal rays, {self.wavelength * 1e9:.4g} nm", fontsize=11)
            return figure


def principal_rays(
    telescope: Telescope,
    fields: Any = None,
    wavelength: Any = None,
    *,
    projection: str = "zemax",
    threads: int | None = None,
) -> PrincipalRays:
    """Trace chief and marginal rays, and find exit pupil, focal ratio and plate scale from rays beside them.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; five from the axis to the edge by default.
    wavelength : float or Quantity, optional
        Vacuum wavelength [m]; the telescope's own by default.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
    threads : int, optional
        Number of threads; all processors by default.

    Raises
    ------
    DomainError
        If a field or the wavelength lies outside what the telescope covers, or a chief ray does not reach the detector.
    """
    points = field_points(telescope, fields)
    (w,) = wavelength_points(telescope, wavelength)
    n = len(points)
    light = field_direction(points[:, 0], points[:, 1], projection)
    slopes = light[:, :2] / -light[:, 2:]
    radius = np.hypot(*slopes.T)
    tangential = np.where((radius > 0)[:, None], slopes / np.where(radius > 0, radius, 1.0)[:, None], [0.0, 1.0])
    sagittal = np.stack([tangential[:, 1], -tangential[:, 0]], axis=-1)
    axes = np.stack([tangential, sagittal], axis=1)
    steps = JACOBIAN_STEP * np.concatenate([np.zeros((n, 1, 2)), axes, -axes], axis=1)
    # Per field: the chief ray's direction and four beside it; each through the pupil's centre, near it and at its rim.
    near = (slopes[:, None] + steps).reshape(-1, 2)
    rim = 0.5 * telescope.pupil_diameter * np.stack([axes, -axes], axis=2).reshape(n, 4, 2)
    pupil = np.repeat(np.concatenate([np.zeros((n, 1, 2)), _NEAR * rim, rim], axis=1), 5, axis=0)
    directions = field_direction(near[:, 0], near[:, 1], "gnomonic")
    end = trace(telescope, launch_bundles(telescope, directions, w, pupil), threads=threads)
    position, direction = end.position.reshape(n, 5, 9, 3), end.direction.reshape(n, 5, 9, 3)
    chief_position, chief_direction = position[:, 0, 0], direction[:, 0, 0]
    reached = (end.status.reshape(n, 5, 9)[:, :, :5] <= RayStatus.VIGNETTED).all(axis=(1, 2))
    if not reached.all():
        bad = np.rad2deg(points[~reached][0])
        raise DomainError(f"field = ({bad[0]:.6g}, {bad[1]:.6g}) deg: the chief ray does not reach the detector")

    detector = telescope.surfaces[-1]
    normal = detector.matrix[:, 2]
    sky = directions.reshape(n, 5, 3)
    moved = position[:, [1, 2], 0] - position[:, [3, 4], 0]
    turned = direction[:, [1, 2], 0] - direction[:, [3, 4], 0]
    scale = np.linalg.norm(sky[:, [1, 2]] - sky[:, [3, 4]], axis=-1) / np.linalg.norm(moved, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -(moved * turned).sum(axis=-1) / (turned**2).sum(axis=-1)
        pupil_center = chief_position + distance.mean(axis=1)[:, None] * chief_direction
        # The plane of the exit pupil is parallel to the detector.
        start, along = position[:, 0, 1:5], direction[:, 0, 1:5]
        to_plane = ((pupil_center[:, None] - start) @ normal) / (along @ normal)
        crossing = start + to_plane[..., None] * along
        diameter = np.linalg.norm(crossing[:, [0, 2]] - crossing[:, [1, 3]], axis=-1) / _NEAR
    return PrincipalRays(
        telescope=telescope.name,
        fields=points,
        wavelength=float(w),
        chief_position=chief_position,
        chief_direction=chief_direction,
        chief_landing=detector.to_local(chief_position)[:, :2],
        chief_angle=np.arccos(np.clip(np.abs(chief_direction @ normal), 0.0, 1.0)),
        marginal_position=position[:, 0, 5:],
        marginal_direction=direction[:, 0, 5:],
        f_number=_focal_ratios(telescope, points, float(w), axes, projection, threads),
        plate_scale=scale,
        exit_pupil=pupil_center,
        exit_pupil_distance=distance,
        exit_pupil_diameter=diameter,
    )


def _focal_ratios(
    telescope: Telescope, fields: np.ndarray, wavelength: float, axes: np.ndarray, projection: str, threads: int | None
) -> np.ndarray:
    """Return focal ratios [n_field, 2] along axes [n_field, 2, 2] of the pupil; NaN where no light arrives."""
    pupil = pupil_sampling(telescope, "gauss", 6)
    unit = pupil.points / (0.5 * telescope.pupil_diameter)
    bundles = trace_bundles(telescope, fields, wavelength, pupil.points, projection, threads)
    ratios = np.full((len(fields), 2), np.nan)
    for i, lit in enumerate(bundles.lit):
        plane = np.stack([np.ones(lit.sum()), *unit[lit].T], axis=-1)
        root = np.sqrt(pupil.weights[lit])[:, None]
        slopes, _, rank, _ = np.linalg.lstsq(plane * root, bundles.direction[i, lit, :2] * root, rcond=None)
        if rank == 3:
            ratios[i] = 1.0 / (2.0 * bundles.index * np.linalg.norm(axes[i] @ slopes[1:], axis=-1))
    return ratios
