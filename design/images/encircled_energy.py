"""Encircled energy: fraction of the light of a star within a circle, of rays alone or with diffraction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import map_coordinates, spline_filter

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import ConfigError, DomainError, shown
from ...core.plotting import BLUE, ORANGE, RED, figure_at, styled
from ...core.units import arcseconds, metres, pure_numbers, require_count
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ...wavefront.request import Request
from ..drawing import FEW, field_colors, finish_axes, second_scale
from ..metrics.spots import SpotDiagram, SpotReference, light_by_distance, spots
from ..result import FieldResult
from .diffraction import DiffractionPsf, fft_psf, image_pixel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Parts of a pixel along each axis, for the fraction of it within a circle.
_PARTS = 4
#: Distance of a centre from an image, beyond which no light is told from other light [pixels].
_FARTHEST = 1e9
#: Order of the splines between the pixels of diffraction images, which are band-limited.
_ORDER = 5
#: Pairs of rings to a pixel on which these are sampled, and points on each to a pixel of the largest radius.
_RINGS = 4
_AROUND = 4
#: Default number of radii.
_RADII = 301
#: Pixels on a side of the diffraction images.
_PIXELS = 256
EnergyKind = Literal["diffraction", "geometric"]


@dataclass(frozen=True)
class EncircledEnergy(FieldResult):
    """Encircled energy of several field points, all wavelengths together.

    Attributes
    ----------
    kind : {"diffraction", "geometric"}
        With diffraction, or of rays alone.
    radius : ndarray, shape [n_radius]
        Radii about the centroid of the rays, or the chief ray, from zero [m].
    fraction : ndarray, shape [n_field, n_radius]
        Fraction of the light of the image within each radius.
    plate_scale : ndarray, shape [n_field]
        Angle on the sky over length on the detector [rad/m].
    """

    _on_image = ("radius", "plate_scale")

    kind: EnergyKind
    radius: np.ndarray
    fraction: np.ndarray
    plate_scale: np.ndarray

    @check_arguments
    def radius_holding(self, fraction: float) -> np.ndarray:
        """Return the radius that holds a fraction of the light [m], shape [n_field]; NaN beyond the curve."""
        if not 0 < fraction < 1:
            raise DomainError(f"fraction = {fraction!r}: expected a number between 0 and 1")
        crossings = np.array([_crossing(row, self.radius, fraction) for row in self.fraction])
        return np.where(self.fraction[:, -1] >= fraction, crossings, np.nan)

    def _columns(self) -> dict[str, Any]:
        return self._along("radius", "fraction")

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; lists run over the fields."""
        arcsec = arcseconds(self.plate_scale)
        radii = {f"ee{round(100 * fraction)}_radius": self.radius_holding(fraction) for fraction in (0.5, 0.8, 0.9)}
        return {
            "telescope": self.telescope,
            "kind": self.kind,
            "wavelength_nm": self.wavelengths * 1e9,
            **self.field_items(),
            **self.on_image({f"{name}_um": value * 1e6 for name, value in radii.items()}),
            **self.of_sky({f"{name}_arcsec": value * arcsec for name, value in radii.items()}),
            **self.on_image(
                self.of_sky({"plate_scale_arcsec_per_um": arcsec * 1e-6}) | {"radius_um": self.radius * 1e6}
            ),
            "fraction": self.fraction,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the curves, and the radii of 50 and 80 % against the field."""
        with styled():
            figure = figure_at(ax, 10.0, 4.2)
            curve_axes, radius_axes = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
            _draw_curves(curve_axes, self)
            _draw_radii(radius_axes, self)
            kind = "with diffraction" if self.kind == "diffraction" else "of rays alone"
            return self._titled(figure, f"encircled energy {kind}, {self._nanometres()}")


@removed_arguments(
    pixels="telescope=fft_psf(telescope, fields, wavelengths, pixels=...)",
    sampling="telescope=spots(telescope, fields, wavelengths, sampling=...)",
    wavelength_weights="telescope=Request.of(telescope, fields, wavelengths, wavelength_weights=...)",
    projection="telescope=Request.of(telescope, fields, wavelengths, projection=...)",
)
@check_arguments
def encircled_energy(
    telescope: Telescope | Request | DiffractionPsf | SpotDiagram,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    kind: EnergyKind | None = None,
    radii: ArrayLike | None = None,
    reference: SpotReference | None = None,
    n_pupil: int | None = None,
    focal_plane: FocalPlane | None = None,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> EncircledEnergy:
    """Return the encircled energy of a star over the field.

    Parameters
    ----------
    telescope : Telescope, Request, DiffractionPsf or SpotDiagram
        The telescope; a request in place of it, its fields and wavelengths, with a projection and weights of the
        wavelengths; or images or spots already made (:func:`pachon.fft_psf`, :func:`pachon.huygens_psf`,
        :func:`pachon.spots`), beside which only radii are stated.
    fields, wavelengths, threads
        As in :meth:`pachon.Request.of`.
    kind : {"diffraction", "geometric"}
        From diffraction images (:func:`pachon.fft_psf`) of 256 x 256 pixels, the default, or of the rays alone: those
        of a spiral, on which all radii differ, so that the curves are smooth.
    radii : array_like or Quantity, shape [n_radius], optional
        Radii [m], ascending; by default from zero to the edge of the images, or beyond the farthest ray.
    reference : {"centroid", "chief"}
        Centre of the circles: the centroid of the rays, the default, or the chief ray of the middle wavelength.
    n_pupil : int, optional
        Number of pupil points, as in :func:`pachon.fft_psf` ("diffraction") or in :meth:`pachon.Request.of`
        ("geometric").
    focal_plane : FocalPlane, optional
        CCD surfaces, as in :meth:`pachon.Request.on`; the nominal detector surface without it.
    progress : callable, optional
        Called with the number of pairs of field and wavelength done since the last call ("diffraction").

    Raises
    ------
    ConfigError
        If kind or reference is unknown, or something is stated twice.
    DomainError
        If radii do not ascend or go beyond the images, or no light passes.
    """
    circle_radii = None if radii is None else np.atleast_1d(metres(radii, "radii"))
    if circle_radii is not None and not (
        circle_radii.ndim == 1
        and np.isfinite(circle_radii).all()
        and (circle_radii >= 0).all()
        and (np.diff(circle_radii) > 0).all()
    ):
        raise DomainError(f"radii of shape {circle_radii.shape}: expected ascending lengths from 0, shape [n]")
    if isinstance(telescope, DiffractionPsf | SpotDiagram):
        sources = {
            "fields": fields,
            "wavelengths": wavelengths,
            "kind": kind,
            "reference": reference,
            "n_pupil": n_pupil,
            "focal_plane": focal_plane,
        }
        for name, value in sources.items():
            if value is not None:
                source = type(telescope).__name__
                raise ConfigError(f"{name} = {shown(value)}: given beside a {source}, which has its own", key=name)
        if isinstance(telescope, SpotDiagram):
            return _of_spots(telescope, circle_radii)
        return _of_images(telescope, circle_radii)
    kind = "diffraction" if kind is None else kind
    reference = "centroid" if reference is None else reference
    request = Request.of(telescope, fields, wavelengths, threads=threads).on(focal_plane)
    if kind == "geometric":
        return _of_spots(spots(request, sampling="spiral", n_pupil=n_pupil, reference=reference), circle_radii)
    return diffracted_energy(
        request, circle_radii, n_pupil=n_pupil, reference=reference, progress=progress, pixels=_PIXELS
    )


def diffracted_energy(
    request: Request,
    radii: np.ndarray | None = None,
    *,
    pixels: int,
    n_pupil: int | None = None,
    reference: SpotReference = "centroid",
    progress: Callable[[int], None] | None = None,
) -> EncircledEnergy:
    """Return the encircled energy of diffraction images of so many pixels a side, which are those of each field.

    All images have the pixels of the largest spots. Where these are too coarse for another field, the light near its
    middle is that of an image of this field alone.
    """
    psf = fft_psf(request, pixels=pixels, n_pupil=n_pupil, reference=reference, progress=progress)
    finer = {}
    for i in np.flatnonzero(psf.undersampled):
        single = request.at_fields(slice(i, i + 1))
        if image_pixel(single, pixels, reference) < psf.pixel:
            finer[i] = fft_psf(single, pixels=pixels, n_pupil=n_pupil, reference=reference)
    if radii is None:
        edges = {float(alone.axis[-1]) for alone in finer.values()} | {float(psf.axis[-1])}
        radii = np.unique(np.concatenate([np.linspace(0.0, edge, _RADII) for edge in edges]))
    energy = _of_images(psf, radii)
    radius, fraction = energy.radius, energy.fraction.copy()
    for i, alone in finer.items():
        edge = float(alone.axis[-1])
        (near, at_edge), (_, coarse_at_edge) = (
            (_light_within(image, radius / pixel), _light_within(image, np.array([edge / pixel]))[0])
            for image, pixel in ((alone.image[0], alone.pixel), (psf.image[i], psf.pixel))
        )
        fraction[i] = np.where(radius <= edge, near, at_edge + np.maximum(fraction[i] - coarse_at_edge, 0.0))
    return replace(energy, fraction=fraction)


def _of_images(psf: DiffractionPsf, radii: np.ndarray | None = None) -> EncircledEnergy:
    """Return the encircled energy about the middles of diffraction images, by default out to their edge [m]."""
    edge = float(psf.axis[-1])
    radius = np.linspace(0.0, edge, _RADII) if radii is None else radii
    if radius[-1] > edge * (1 + 1e-9):
        raise DomainError(f"radii to {radius[-1] * 1e6:.6g} um: expected at most {edge * 1e6:.6g} um, the images' edge")
    rows = [_light_within(image, radius / psf.pixel) for image in psf.image]
    return EncircledEnergy(psf.request, "diffraction", radius, np.stack(rows), psf.plate_scale)


def _light_within(image: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return the light within radii [pixels] of the middle pixel of a band-limited image, of samples at points."""
    coefficients, middle = spline_filter(image, order=_ORDER, mode="mirror"), image.shape[-1] // 2
    at = np.linspace(0.0, middle, 2 * _RINGS * middle + 1)
    angle = 2.0 * np.pi * (np.arange(_AROUND * middle) + 0.5) / (_AROUND * middle)
    around = np.stack([np.sin(angle), np.cos(angle)])

    def mean_on_ring(ring: float) -> float:
        on_ring = map_coordinates(coefficients, middle + ring * around, order=_ORDER, mode="mirror", prefilter=False)
        return float(on_ring.mean())

    mean = np.array([mean_on_ring(ring) for ring in at])
    # Simpson's rule over two rings at a time.
    light = 2.0 * np.pi * at * mean
    step = (light[:-2:2] + 4.0 * light[1:-1:2] + light[2::2]) * (at[2] / 6.0)
    edges, within = at[::2], np.concatenate([[0.0], np.cumsum(step)])
    return np.asarray(PchipInterpolator(edges, within)(np.minimum(radii, middle)))


@check_arguments
def energy_curve(
    image: np.ndarray, center: tuple[float, float] | None = None, *, parts: int = _PARTS
) -> tuple[np.ndarray, np.ndarray]:
    """Return the light within circles on an image, uniform within a pixel.

    Parameters
    ----------
    image : ndarray, shape [ny, nx]
        Light in each pixel.
    center : (x, y), optional
        Centre of the circles [pixels from the centre of the first one]; the centroid of the image by default.
    parts : int
        Parts of a pixel along each axis.

    Returns
    -------
    radius : ndarray, shape [n]
        Radii from zero, ascending [pixels].
    light : ndarray, shape [n]
        Light within each, in the unit of the image.

    Raises
    ------
    DomainError
        If the image is not finite, or there is no light for a centroid.
    """
    light = pure_numbers(image, "image")
    if light.ndim != 2 or not np.isfinite(light).all():
        raise DomainError(f"image of shape {light.shape}: expected a finite one, shape [ny, nx]")
    x, y = np.arange(light.shape[1], dtype=np.float64), np.arange(light.shape[0], dtype=np.float64)
    if center is None:
        total = light.sum()
        if not total > 0:
            raise DomainError(f"image of sum {total:.6g}: expected light, to have a centroid")
        center = float(light.sum(axis=0) @ x / total), float(light.sum(axis=1) @ y / total)
    if not max(map(abs, center)) <= _FARTHEST:
        raise DomainError(f"center = {shown(center)}: expected pixels within {_FARTHEST:g} of the image")
    parts = require_count(parts, "parts", 1, 100)
    inside = (np.arange(parts) + 0.5) / parts - 0.5
    across, along = (np.add.outer(v - c, inside).ravel() for v, c in zip((x, y), center, strict=True))
    squared = np.add.outer(along**2, across**2).ravel()
    order = np.argsort(squared, kind="stable")
    part_light = np.repeat(np.repeat(light / parts**2, parts, axis=0), parts, axis=1).ravel()[order]
    # Each part stands in the middle of its own light.
    within = np.cumsum(part_light) - 0.5 * part_light
    return np.concatenate([[0.0], np.sqrt(squared[order])]), np.concatenate([[0.0], within])


def _of_spots(diagram: SpotDiagram, radii: np.ndarray | None) -> EncircledEnergy:
    distance = np.where(diagram.weight > 0, np.linalg.norm(diagram.displacement, axis=-1), np.inf)
    farthest = float(distance[np.isfinite(distance)].max(initial=0.0))
    if not farthest > 0:
        raise DomainError(f"{diagram.telescope}: no spot of any size; expected rays that reach the detector")
    radius = np.linspace(0.0, 1.02 * farthest, _RADII) if radii is None else radii
    rows = []
    for at, weight in zip(distance, diagram.weight, strict=True):
        lit = weight > 0
        if not lit.any():
            rows.append(np.nan * radius)
            continue
        order = np.argsort(at[lit], kind="stable")
        distances, within = light_by_distance(at[lit][order], weight[lit][order])
        rows.append(np.interp(radius, distances, within, left=0.0, right=1.0))
    return EncircledEnergy(diagram.request, "geometric", radius, np.stack(rows), diagram.plate_scale)


def _crossing(fraction: np.ndarray, radius: np.ndarray, level: float) -> float:
    """Return where a rising curve reaches a fraction, by monotone cubics between points."""
    if not np.argmax(fraction >= level):
        return float(radius[0])
    return float(PchipInterpolator(radius, fraction - level, extrapolate=False).roots()[0])


def _draw_curves(axes: Axes, result: EncircledEnergy) -> None:
    labelled = len(result.fields) <= FEW
    colors = field_colors(len(result.fields))
    for label, row, color in zip(result.field_labels(), result.fraction, colors, strict=True):
        axes.plot(result.radius * 1e6, row, color=color, linewidth=1.3, label=label if labelled else None)
    for fraction in (0.5, 0.8):
        axes.axhline(fraction, color="0.6", linewidth=0.7, linestyle=(0, (4, 3)))
        axes.annotate(f"{100 * fraction:.0f} %", (1.0, fraction), xycoords=("axes fraction", "data"), xytext=(-3, 2),
                      textcoords="offset points", ha="right", fontsize=7.5, color="0.4")  # fmt: skip
    # Beyond the light of every field the curves are flat.
    full = np.flatnonzero((result.fraction >= 0.985).all(axis=0))
    edge = result.radius[full[0]] if len(full) else result.radius[-1]
    finish_axes(
        axes,
        xlim=(0.0, max(edge, 0.25 * result.radius[-1]) * 1e6),
        ylim=(0.0, 1.02),
        xlabel=result.image_text("radius about the centroid of the rays [µm]"),
        ylabel="fraction of the light within",
    )
    if result.on_sky and not result.in_angles:
        second_scale(axes, float(np.rad2deg(result.plate_scale[0])) * 3600e-6, "arc seconds")
    if labelled:
        axes.legend(loc="lower right")


def _draw_radii(axes: Axes, result: EncircledEnergy) -> None:
    away, distance = result.axis_distances()
    scale, unit = np.full(len(away), 1e6), result.image_text("µm")
    if result.on_sky and not result.in_angles:
        scale, unit = arcseconds(result.plate_scale), "arcsec"
    order = np.argsort(away, kind="stable")
    for fraction, color in ((0.9, ORANGE), (0.8, RED), (0.5, BLUE)):
        radius = (result.radius_holding(fraction) * scale)[order]
        axes.plot(
            away[order], radius, "o-", color=color, markersize=3.5, linewidth=1.2, label=f"{100 * fraction:.0f} %"
        )
    label = f"radius that holds the fraction [{unit}]"
    finish_axes(axes, ylim=(0.0, None), xlabel=distance, ylabel=label)
    axes.legend(loc="best", ncols=3)
