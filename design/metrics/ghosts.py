"""Ghosts: light reflected twice inside the optics, and its irradiance on the detector.

Every pair of lens surfaces, and every lens surface with the detector, makes a ghost of its own (:mod:`~.ghost_paths`).
Reflectivities are Fresnel's for bare glass at the angle of each ray, mean of both polarisations, or those of coatings.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import uniform_filter

from ...core.arguments import check_arguments, removed_arguments
from ...core.docstrings import Description, described
from ...core.errors import DomainError
from ...core.plotting import RED, figure_at, plain_text, styled
from ...core.threads import thread_count
from ...core.units import field_label, require_count
from ...models.telescope import Telescope
from ...raytrace.ideal_lens import require_image
from ...raytrace.rays import Projection
from ...wavefront.pupil_sampling import pupil_sampling
from ...wavefront.request import Request
from ..analyses.coatings import Coatings
from ..drawing import draw_circle, field_text, panels_of
from ..result import FieldResult
from .ghost_paths import GhostLight, GhostTrace, Reflectivities, ghost_pairs
from .principal_rays import principal_rays_of
from .spots import holding_radius

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Rays in each cell of the irradiance of a ghost, on average.
_RAYS_PER_CELL = 40
#: Least number of rays of a star.
_LEAST_RAYS = 400
#: Most rays of a ghost: a gigabyte.
_MOST_RAYS = 400_000
#: Rays of a star in the first trace, which finds the brightest ghosts.
_FIRST_RAYS = 4000
#: Rays of a ghost below which its area, and so its irradiance, is unknown.
_LEAST_OF_GHOST = 10
#: Fraction of the light of a ghost within the circle that its position and size are measured in.
_CORE = 0.98
#: Cells across the map of all ghosts.
_MAP = 160
#: Rays of a ghost in each cell of the map, at least: fewer are spread over the cells about it, as a large ghost on a
#: small detector would be single rays.
_MAP_RAYS = 10
#: Field of the star where none is given, over the radius of the field of view.
_FIELD = 0.5
#: Fraction of the light that a detector reflects, where none is given.
DETECTOR_REFLECTIVITY = 0.15
#: Ghosts with a panel of their own, the brightest.
_ALONE = 8
#: Decades of irradiance of the map.
_DECADES = 4.0


@dataclass(frozen=True)
class Ghost:
    """One ghost of a star.

    Attributes
    ----------
    first, second : str
        The reflecting surfaces, in that order.
    flux : float
        Light of the ghost over that of the direct image.
    peak : float
        Largest irradiance over the light of the direct image [1/m^2]; NaN with fewer than 10 rays.
    centroid : ndarray, shape [2]
        Centroid, x and y of the detector [m]; without stray rays, the outermost 2 % of the light, here and below.
    diameter : float
        Diameter of the circle about the centroid that holds the rays [m].
    focus : float
        Height above the detector at which the ghost is smallest [m]; NaN where its rays are parallel.
    irradiance : ndarray, shape [n, n]
        Irradiance over the light of the direct image [1/m^2], [y, x].
    edges : ndarray, shape [2, n + 1]
        Edges of the cells along x and along y [m].
    """

    first: str
    second: str
    flux: float
    peak: float
    centroid: np.ndarray
    diameter: float
    focus: float
    irradiance: np.ndarray
    edges: np.ndarray


@dataclass(frozen=True)
class Ghosts(FieldResult):
    """All ghosts of a star that two reflections make, the brightest irradiance first.

    Attributes
    ----------
    detector_reflectivity : float
        Fraction of the light that the detector reflects.
    ghosts : tuple of Ghost
        The ghosts.
    star : ndarray, shape [2]
        Position of the direct image, x and y of the detector [m].
    irradiance : ndarray, shape [n, n]
        Irradiance of all ghosts together over the light of the direct image [1/m^2], [y, x]; of large ones a mean over
        so much of the detector as ten rays need.
    edges : ndarray, shape [n + 1]
        Edges of the cells along either axis [m].
    image_radius : float
        Radius of the field of view on the detector [m].
    plate_scale : float
        Angle on the sky over length on the detector at the star [rad/m].
    """

    _table = ("first", "second", "flux", "peak", "centroid", "diameter", "focus")
    _images = ("irradiance",)

    detector_reflectivity: float
    ghosts: tuple[Ghost, ...]
    star: np.ndarray
    irradiance: np.ndarray
    edges: np.ndarray
    image_radius: float
    plate_scale: float

    @property
    def field(self) -> np.ndarray:
        """Field angles of the star [rad], shape [2]."""
        return self.fields[0]

    @property
    def flux(self) -> float:
        """Light of all ghosts together over that of the direct image."""
        return sum(g.flux for g in self.ghosts)

    @property
    def magnitudes(self) -> np.ndarray:
        """Peak irradiance of each ghost in magnitudes per square arc second, for a star of magnitude 0."""
        square_arcsec = (np.deg2rad(1.0 / 3600.0) / self.plate_scale) ** 2
        with np.errstate(divide="ignore"):
            return -2.5 * np.log10(np.array([g.peak for g in self.ghosts]) * square_arcsec)

    def _columns(self) -> dict[str, Any]:
        return {name: np.array([getattr(ghost, name) for ghost in self.ghosts]) for name in self._table}

    def _described(self, name: str) -> Description:
        return described(type(self) if name in self._images else Ghost, name)

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; lists run over the ghosts, the brightest first."""
        return {
            "telescope": self.telescope,
            "field_deg": np.rad2deg(self.field),
            "wavelength_nm": self.wavelength * 1e9,
            "detector_reflectivity": self.detector_reflectivity,
            "star_mm": self.star * 1e3,
            "total_flux": self.flux,
            "first": [g.first for g in self.ghosts],
            "second": [g.second for g in self.ghosts],
            "flux": np.array([g.flux for g in self.ghosts]),
            "peak_per_mm2": np.array([g.peak for g in self.ghosts]) * 1e-6,
            "peak_magnitudes_per_arcsec2": self.magnitudes,
            "diameter_mm": np.array([g.diameter for g in self.ghosts]) * 1e3,
            "centroid_mm": np.array([g.centroid for g in self.ghosts]).reshape(-1, 2) * 1e3,
            "focus_mm": np.array([g.focus for g in self.ghosts]) * 1e3,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the irradiance of all ghosts on the detector, and the brightest one by one."""
        with styled():
            figure = figure_at(ax, 11.6, 5.3)
            parts: Any = figure.subfigures(1, 2, width_ratios=[1.0, 1.12])
            map_figure, ghost_figure = parts
            _draw_map(map_figure.subplots(), self)
            shown = self.ghosts[:_ALONE]
            panels = panels_of(ghost_figure, len(shown), 2, _ALONE // 2)
            for axes, ghost, magnitude in zip(panels, shown, self.magnitudes, strict=False):
                _draw_ghost(axes, ghost, float(magnitude))
            ghost_figure.suptitle("the brightest: reflected at, and then at", fontsize=9.5)
            flux, reflected = 100 * self.flux, 100 * self.detector_reflectivity
            return self._titled(
                figure,
                f"ghosts of a star at {field_text(self.field)}, {self._nanometres()}, "
                f"{flux:.2g} % of its light (detector reflects {reflected:.3g} %)",
            )


@check_arguments
@dataclass(frozen=True)
class Reflectivity:
    """Light that surfaces reflect, for :func:`ghosts`.

    Attributes
    ----------
    lenses : float or mapping of str to float, optional
        Reflectivity of the lens surfaces at every angle, one for all or by name; bare glass by default.
    detector : float
        Fraction of the light that the detector reflects.
    coatings : Coatings or path, optional
        Coatings of lens surfaces, or their file, as in :func:`pachon.throughput`, for surfaces whose reflectivity is
        not stated: what they do not transmit is reflected.

    Raises
    ------
    DomainError
        If a number is not from 0 to 1.
    """

    lenses: float | Mapping[str, float] | None = None
    detector: float = DETECTOR_REFLECTIVITY
    coatings: Coatings | str | os.PathLike[str] | None = None

    def __post_init__(self) -> None:
        lenses = self.lenses if isinstance(self.lenses, Mapping) else {"the lenses": self.lenses}
        for name, value in (*lenses.items(), ("the detector", self.detector)):
            if value is not None and not 0.0 <= value <= 1.0:
                raise DomainError(f"reflectivity of {name} = {value!r}: expected a number from 0 to 1")


@removed_arguments(detector_reflectivity="reflectivity=Reflectivity(detector=...)")
@check_arguments
def ghosts(
    telescope: Telescope | Request,
    field: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    *,
    reflectivity: float | Mapping[str, float] | Reflectivity | None = None,
    n_pupil: int = 40000,
    brightest: int | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Ghosts:
    """Trace every ghost of a star that two reflections make.

    Parameters
    ----------
    telescope, wavelength, projection, threads
        As in :meth:`pachon.Request.of`.
    field : (tx, ty), optional
        Field angles of the star [rad] or Quantities; half-way to the edge of the field along +y by default.
    reflectivity : float, mapping of str to float, or Reflectivity, optional
        Reflectivity of the lens surfaces at every angle, one for all or by name; bare glass by default. Or
        :class:`Reflectivity`, which has that of the detector and coatings too. Absorption of glasses is left out.
    n_pupil : int
        Rays of the star in the entrance pupil, at least 400.
    brightest : int, optional
        Number of pairs of surfaces, those of the largest irradiance in a first trace of 4000 rays; all by default. The
        others are left out of map and total.
    progress : callable, optional
        Called with the number of pairs of surfaces done since the last call; the first trace of `brightest` is not
        counted.

    Raises
    ------
    UnknownNameError
        If a reflectivity or coating is given for a surface that does not exist.
    DomainError
        If a number is out of range, several fields are given, no surface can make a ghost, or the star itself does not
        reach the detector.
    """
    n_pupil = require_count(n_pupil, "n_pupil", _LEAST_RAYS, _MOST_RAYS)
    brightest = None if brightest is None else require_count(brightest, "brightest", 1)
    star_field: Any = None if field is None else [field]
    request = Request.of(
        telescope,
        star_field,
        wavelength,
        sampling="spiral",
        n_pupil=n_pupil,
        projection=projection,
        threads=threads,
        one_wavelength=True,
        default_fields=lambda telescope: [0.0, _FIELD * telescope.field_radius],
    )
    request.require_one_field()
    telescope, threads = request.telescope, request.threads
    require_image(telescope, "a map of ghosts")
    reflecting = reflectivity if isinstance(reflectivity, Reflectivity) else Reflectivity(reflectivity)
    coatings = Coatings.of(telescope, reflecting.coatings)
    surfaces = Reflectivities(telescope, reflecting.lenses, reflecting.detector, coatings, request.wavelength)
    pairs = ghost_pairs(telescope)
    if not pairs:
        raise DomainError(
            f"{telescope.name}: expected at least one lens surface and another, or a detector, for ghosts"
        )
    light = GhostTrace(telescope, request.launch(request.wavelength), surfaces, threads, request.focal_plane)
    image = light.star()
    if not image.weight.sum() > 0:
        raise DomainError(f"{field_label(request.fields[0])}: the star does not reach the detector")
    direct = float(image.weight.sum())
    star = np.average(image.position, axis=0, weights=image.weight)
    if brightest is not None and brightest < len(pairs):
        first_rays = request.launch(request.wavelength, pupil_sampling(telescope, "spiral", _FIRST_RAYS).points)
        first = GhostTrace(telescope, first_rays, surfaces, threads, request.focal_plane).ghosts(pairs)
        peaks = np.array([_measure(landing, 1.0).peak if landing.weight.sum() > 0 else np.nan for landing in first])
        pairs = [pairs[i] for i in sorted(np.argsort(-peaks, kind="stable")[:brightest])]
    landings = []
    for landing in light.ghosts(pairs):
        landings.append(landing)
        if progress is not None:
            progress(1)
    edge = telescope.field_radius * np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]])
    rim = request.at_fields(edge).bundles(request.wavelength, np.zeros((1, 2))).chief_landing()
    with ThreadPoolExecutor(thread_count(threads)) as pool:
        lit = [landing for landing in landings if landing.weight.sum() > 0]
        measured_ghosts = list(pool.map(partial(_measure, direct=direct), lit))
    # Where no ray from the edge of the field arrives, the map covers whole ghosts.
    radius = float(np.nanmax(np.linalg.norm(rim, axis=-1), initial=0.0)) or max(
        (g.diameter for g in measured_ghosts), default=1.0
    )
    edges = np.linspace(-1.1 * radius, 1.1 * radius, _MAP + 1)
    irradiance = np.zeros((_MAP, _MAP))
    for landing, ghost in zip(lit, measured_ghosts, strict=True):
        irradiance += _on_map(landing, edges, ghost.diameter) / direct
    return Ghosts(
        request=request,
        detector_reflectivity=float(reflecting.detector),
        ghosts=tuple(sorted(measured_ghosts, key=lambda g: (-np.nan_to_num(g.peak), g.first, g.second))),
        star=star,
        irradiance=irradiance,
        edges=edges,
        image_radius=radius,
        plate_scale=float(principal_rays_of(request).mean_plate_scale[0]),
    )


def _measure(landing: GhostLight, direct: float) -> Ghost:
    # Rays that graze the detector may land anywhere; position and size are those of most of the light.
    around = np.median(landing.position, axis=0)
    distance = np.linalg.norm(landing.position - around, axis=-1)
    core = distance <= holding_radius(distance, landing.weight, _CORE)
    weight, position, direction = landing.weight[core], landing.position[core], landing.direction[core]
    centroid = np.average(position, axis=0, weights=weight)
    off = position - centroid
    slope = direction[:, :2] / direction[:, 2:]
    slope = slope - np.average(slope, axis=0, weights=weight)
    along, spread = (float(np.average((a * slope).sum(axis=-1), weights=weight)) for a in (off, slope))
    cells = max(3, int(np.sqrt(len(weight) / _RAYS_PER_CELL)))
    half = np.maximum(np.abs(off).max(axis=0), 1e-9 * (1.0 + np.abs(centroid))) * (1.0 + 1e-6)
    edges = centroid[:, None] + half[:, None] * np.linspace(-1.0, 1.0, cells + 1)
    irradiance = _irradiance(landing, *edges) / direct
    return Ghost(
        first=landing.first,
        second=landing.second,
        flux=float(landing.weight.sum()) / direct,
        # Mean over nine cells: the number of rays in a single one is uncertain by a tenth and more.
        peak=float(uniform_filter(irradiance, 3, mode="constant").max()) if len(weight) >= _LEAST_OF_GHOST else np.nan,
        centroid=centroid,
        diameter=2.0 * float(np.linalg.norm(off, axis=-1).max()),
        focus=-along / spread if spread > 1e-18 else float("nan"),
        irradiance=irradiance,
        edges=edges,
    )


def _on_map(landing: GhostLight, edges: np.ndarray, diameter: float) -> np.ndarray:
    """Return the light per area of a ghost of a diameter [m] in the cells of the map, mean over some of them."""
    cell = float(edges[1] - edges[0])
    # Rays in each cell, on average.
    density = len(landing.weight) * cell**2 / max(0.25 * np.pi * diameter**2, cell**2)
    beside = min(int(np.ceil(0.5 * (np.sqrt(_MAP_RAYS / density) - 1.0))), len(edges) - 1)
    if beside <= 0:
        return _irradiance(landing, edges, edges)
    # Light beside the map counts in the means at its edge.
    wider = edges[0] + cell * np.arange(-beside, len(edges) + beside)
    mean: np.ndarray = uniform_filter(_irradiance(landing, wider, wider), 2 * beside + 1, mode="constant")
    return mean[beside:-beside, beside:-beside]


def _irradiance(landing: GhostLight, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the light per area in cells of given edges, [y, x]."""
    light, _, _ = np.histogram2d(landing.position[:, 1], landing.position[:, 0], bins=[y, x], weights=landing.weight)
    return light / np.outer(np.diff(y), np.diff(x))


def _draw_map(axes: Axes, result: Ghosts) -> None:
    from matplotlib.colors import LogNorm

    light = result.irradiance * 1e-6
    edges = result.edges * 1e3
    top = float(light.max())
    if top > 0:
        shown: Any = axes.pcolormesh(
            edges, edges, np.maximum(light, 1e-300), norm=LogNorm(top * 10.0**-_DECADES, top), cmap="magma"
        )
        axes.set_facecolor("black")
        key = axes.figure.colorbar(shown, ax=axes, shrink=0.82, pad=0.02)
        key.set_label("part of the star's light per mm²")
    axes.plot(*(result.star * 1e3), "+", color="white", markersize=9.0, markeredgewidth=1.2)
    place = result.star[0] * 1e3, result.star[1] * 1e3
    axes.annotate("star", place, xytext=(6, 5), textcoords="offset points", color="white", fontsize=8)
    draw_circle(axes, result.image_radius * 1e3, color="0.75", style=(0, (4, 3)))
    limits = edges[0], edges[-1]
    axes.set(aspect="equal", xlim=limits, ylim=limits, xlabel="detector x [mm]", ylabel="detector y [mm]")


def _draw_ghost(axes: Axes, ghost: Ghost, magnitude: float) -> None:
    light = np.where(ghost.irradiance > 0, ghost.irradiance, np.nan) * 1e-6
    x, y = ghost.edges * 1e3
    axes.pcolormesh(x, y, light, cmap="magma", vmin=0.0)
    axes.set(facecolor="black", aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color("0.8")
    axes.set_title(f"{plain_text(ghost.first)}\n{plain_text(ghost.second)}", fontsize=8, color=RED)
    axes.set_xlabel(
        f"⌀ {ghost.diameter * 1e3:.3g} mm\nflux {ghost.flux:.2g}\n"
        f"peak {ghost.peak * 1e-6:.2g}/mm²\n{magnitude:.1f} mag/arcsec²",
        fontsize=7.5,
    )
