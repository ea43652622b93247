"""Geometric image of a bar target, or of any small picture on the sky: every pixel of it is traced through the pupil.

Rays of one pixel start from different points of it and go through different points of the pupil, both quasi-random, so
that an image without aberrations is smooth. Diffraction is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import DomainError
from ...core.plotting import figure_of
from ...core.units import angle as one_angle
from ...core.units import arcseconds, field_label, length, pure_numbers, require_count, require_positive
from ...models.telescope import Telescope
from ...raytrace.launch import launch_bundles
from ...raytrace.rays import Projection, RayStatus, field_direction
from ...raytrace.trace import trace
from ...wavefront.request import RAYS_AT_ONCE, Request
from ..metrics.principal_rays import principal_rays_of
from .analysis import Analysis, Columns, require_focus

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Steps of the quasi-random sequence of Roberts in two dimensions: inverse powers of the plastic number.
_STEPS = np.array([0.7548776662466927, 0.5698402909980532])
#: Most rays of one image.
_MOST_RAYS = 10**8
#: Most pixels along a side, of target and image.
_MOST_PIXELS = 4096


@dataclass(frozen=True)
class TargetImage(Analysis):
    """Geometric image of a target.

    Attributes
    ----------
    target : ndarray, shape [ny, nx]
        Brightness on the sky, rows along +y of the field angles.
    target_pixel : float
        Side of its pixels [rad].
    image : ndarray, shape [n, n]
        Light on each pixel of the detector, rows along its +y; the sum over a boundless detector is that of the target
        times the lit fraction of the pupil.
    pixel : float
        Side of the pixels of the image [m].
    center : ndarray, shape [2]
        Middle of the image on the detector [m].
    """

    target: np.ndarray
    target_pixel: float
    image: np.ndarray
    pixel: float
    center: np.ndarray

    @property
    def light_inside(self) -> float:
        """Light on the image over light of the target."""
        return float(self.image.sum() / self.target.sum())

    @property
    def _title(self) -> str:
        return f"geometric image of a target, {self._nanometres()}"

    @property
    def _panels(self) -> tuple[int, int, float, float]:
        return 1, 2, 9.0, 4.6

    def _table_columns(self) -> Columns:
        along = (np.arange(len(self.image)) - 0.5 * (len(self.image) - 1)) * self.pixel * 1e6
        return {
            "x": (along, "um", "x of the detector from the middle of the image"),
            "y": (along[:, None], "um", "y of the detector from the middle of the image"),
            "light": (self.image, "", "light of each pixel"),
        }

    def _values(self) -> dict[str, Any]:
        return {
            "target_pixel_arcsec": float(arcseconds(np.array(self.target_pixel))),
            "pixel_um": self.pixel * 1e6,
            "pixels": len(self.image),
            "center_mm": self.center * 1e3,
            "light_inside": self.light_inside,
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        sky, detector = panels
        scale, unit = (3600.0, "arcsec") if self.target_pixel * max(self.target.shape) < 0.01 else (1.0, "deg")
        width, height = (0.5 * scale * np.rad2deg(self.target_pixel) * n for n in self.target.shape[::-1])
        style: dict[str, Any] = {"cmap": "gray", "vmin": 0.0, "aspect": "equal"}
        sky.imshow(self.target, extent=(-width, width, -height, height), **style)
        sky.set(xlabel=f"field x [{unit}]", ylabel=f"field y [{unit}]", title="target")
        half = 0.5 * len(self.image) * self.pixel * 1e6
        picture = detector.imshow(self.image, extent=(-half, half, -half, half), **style)
        detector.set(xlabel="detector x [µm]", ylabel="detector y [µm]", title="geometric image")
        figure_of(detector).colorbar(picture, ax=detector, fraction=0.046, pad=0.02)


@check_arguments
def bar_target(pixels: int = 96, *, bars: int = 3) -> np.ndarray:
    """Return a bar target: upright bars on the left, level ones on the right, as wide as the gaps between them.

    Parameters
    ----------
    pixels : int
        Pixels on a side, at least 16.
    bars : int
        Bars of each kind, one to an eighth of the pixels.

    Returns
    -------
    ndarray, shape [pixels, pixels]
        1 in the bars, 0 elsewhere.

    Raises
    ------
    DomainError
        If a number is out of range.
    """
    n = require_count(pixels, "pixels", 16, _MOST_PIXELS)
    count = require_count(bars, "bars", 1, n // 8)
    # Bars and gaps of either kind fill two fifths of the side.
    u = (np.arange(n) + 0.5) / n
    phase = (2 * count - 1) / 0.4

    def striped(start: float) -> np.ndarray:
        inside = (u >= start) & (u < start + 0.4)
        return np.asarray(inside & (np.floor((u - start) * phase).astype(int) % 2 == 0))

    tall = (u >= 0.3) & (u < 0.7)
    upright, level = np.outer(tall, striped(0.05)), np.outer(striped(0.3), (u >= 0.55) & (u < 0.95))
    return np.where(upright | level, 1.0, 0.0)


@removed_arguments(wavelength_weights="telescope=Request.of(telescope, field, wavelengths, wavelength_weights=...)")
@check_arguments
def target_image(
    telescope: Telescope | Request,
    target: ArrayLike | None = None,
    *,
    width: ArrayLike | None = None,
    field: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    n_rays: int = 400,
    pixel: ArrayLike | None = None,
    pixels: int | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> TargetImage:
    """Trace the geometric image of a target.

    Parameters
    ----------
    telescope, wavelengths, projection, threads
        As in :meth:`pachon.Request.of`; a request has weights of the wavelengths too.
    target : array_like, shape [ny, nx], optional
        Brightness on the sky, not negative, rows along +y of the field angles; :func:`bar_target` by default.
    width : float or Quantity, optional
        Width of the target, along x [rad]; by default that of 60 Airy radii.
    field : array_like or Quantity, shape [2]
        Field angles of its middle [rad].
    n_rays : int
        Rays of each pixel of the target and each wavelength.
    pixel : float or Quantity, optional
        Side of the pixels of the image [m]; that of a pixel of the target, imaged, by default.
    pixels : int, optional
        Pixels on a side of the image; a quarter more than of the target by default.

    Raises
    ------
    DomainError
        If the target is not an image with light, a number is out of range, several fields are given, or no light or
        parallel light arrives.
    """
    picture = bar_target() if target is None else pure_numbers(target, "target")
    if picture.ndim != 2 or max(picture.shape) > _MOST_PIXELS or not (np.isfinite(picture).all() and picture.size):
        raise DomainError(f"target of shape {picture.shape}: expected an image of finite numbers [ny, nx]")
    if not ((picture >= 0).all() and picture.sum() > 0):
        raise DomainError("target: expected brightness that is not negative, and some light")
    count = require_count(n_rays, "n_rays", 1, 10**6)
    rays = count * np.count_nonzero(picture)
    if rays > _MOST_RAYS:
        raise DomainError(f"n_rays = {count}: expected fewer; {rays:.3g} rays are more than {_MOST_RAYS:.0e}")
    request = Request.of(
        telescope,
        field,
        wavelengths,
        sampling="spiral",
        default_fields=lambda telescope: (0.0, 0.0),
        n_pupil=count,
        projection=projection,
        threads=threads,
    )
    request.require_nominal_detector("images of targets")
    request.require_one_field()
    telescope = request.telescope
    principal = principal_rays_of(request)
    if np.isnan(principal.mean_f_number).any():
        raise DomainError(f"{field_label(request.fields[0])}: no light passes; expected a lit pupil")
    require_focus(telescope, principal.f_number, principal.mean_plate_scale)
    scale = float(principal.mean_plate_scale[0])
    airy = 1.22 * request.middle * float(principal.mean_f_number[0]) * scale
    across = 60.0 * airy if width is None else one_angle(width, "width")
    step = require_positive(across, "width", "radians") / picture.shape[1]
    side = step / scale if pixel is None else require_positive(length(pixel, "pixel"), "pixel", "metres")
    n = int(np.ceil(1.25 * max(picture.shape))) if pixels is None else require_count(pixels, "pixels", 3, _MOST_PIXELS)
    center = principal.chief_landing[0]
    half = 0.5 * n * side
    image = np.zeros((n, n))
    for weight, landing, light in _landings(request, picture, step):
        inside = np.histogram2d(
            landing[:, 1] - center[1],
            landing[:, 0] - center[0],
            bins=n,
            range=[[-half, half], [-half, half]],
            weights=light * weight,
        )
        image += inside[0]
    return TargetImage(request, picture, step, image, side, center)


def _landings(request: Request, picture: np.ndarray, step: float) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Yield weight of a wavelength, landing points [n, 2] of lit rays and their light, some pixels at a time."""
    telescope, count = request.telescope, len(request.pupil)
    points = request.vignetted(request.pupil.points).reshape(count, 2)
    row, column = np.nonzero(picture)
    middle = 0.5 * (np.array(picture.shape) - 1)
    offset = np.stack([column - middle[1], row - middle[0]], axis=-1)
    within = (0.5 + np.outer(np.arange(count), _STEPS)) % 1.0 - 0.5
    detector = telescope.surfaces[-1]
    at_once = max(1, RAYS_AT_ONCE // count)
    for first in range(0, len(row), at_once):
        batch = slice(first, first + at_once)
        angles = request.fields[0] + step * (offset[batch, None] + within)
        telescope.check_field(angles[..., 0], angles[..., 1])
        directions = field_direction(angles[..., 0].ravel(), angles[..., 1].ravel(), request.projection)
        pupil = np.tile(points, (len(angles), 1))[:, None]
        light = np.repeat(request.pupil_areas[0] * picture[row[batch], column[batch]] / count, count)
        for wavelength, weight in zip(request.wavelengths, request.weights, strict=True):
            rays = launch_bundles(telescope, directions, float(wavelength), pupil)
            end = trace(telescope, rays, threads=request.threads)
            lit = end.status == RayStatus.OK
            yield float(weight), detector.to_local(end.position[lit])[:, :2], light[lit]
