"""Views of a state: pure functions to arrays, in the units that are shown. Nothing here draws."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..core.errors import DomainError
from ..core.statistics import FWHM_PER_RMS, finite_median
from ..core.units import ARCSEC
from ..design.images.encircled_energy import energy_curve
from ..design.layout.layout import Layout, layout
from ..design.metrics.field_zernikes import FittedPupil, wavefront_zernikes
from ..design.metrics.spots import spots
from ..models.camera.focal_plane import FocalPlane
from ..models.telescope import Telescope
from ..sky.visit_list.seeing import KOLMOGOROV_WIDTH
from ..sky.visit_list.seeing import WAVELENGTH as SEEING_WAVELENGTH
from ..wavefront.atmosphere.atmosphere import Atmosphere
from ..wavefront.opd import wavefront_opd
from ..wavefront.psf.psf import make_psfs
from ..wavefront.psf.psf_moments import psf_moments
from ..wavefront.psf.stamps import Stamps
from ..wavefront.request import Request
from .bench import Bench
from .state import DeskState

#: Rings of pupil points of spots.
RINGS = 6
#: Cells across the pupil of the OPD map, and the highest Zernike term.
_GRID = 64
JMAX = 22
#: Points along a side of the map of heights.
_HEIGHTS = 100
#: Pixels along a side of PSFs; radii of encircled energy.
_PIXELS = 41
#: Least fraction of the stars whose moments under a weight exist for whiskers of these.
_MEASURED = 0.9
#: Pixels along a side of stamps of the camera.
_STAMP = 27
_RADII = 61
SITE = "cerro_pachon"


@dataclass(frozen=True)
class Scene:
    """A state and what it makes of the bench: telescope, CCDs, wavelength, field and atmosphere."""

    bench: Bench
    state: DeskState
    telescope: Telescope
    focal_plane: FocalPlane | None
    atmosphere: Atmosphere | None

    @classmethod
    def of(cls, bench: Bench, state: DeskState) -> Scene:
        """Return the scene of a state; PachonError where it is not one of the bench."""
        bench.check(state)
        return cls(bench, state, bench.telescope(state), bench.focal_plane(state), atmosphere(state.seeing_arcsec))

    @property
    def wavelength(self) -> float:
        """Vacuum wavelength [m]."""
        return self.state.wavelength_nm * 1e-9

    @property
    def field(self) -> np.ndarray:
        """Field angles of the star [rad], shape [2]."""
        return np.deg2rad(self.state.field_deg)


def atmosphere(seeing_arcsec: float) -> Atmosphere | None:
    """Return the atmosphere of a seeing; None for zero."""
    if not seeing_arcsec > 0.0:
        return None
    r0 = KOLMOGOROV_WIDTH * SEEING_WAVELENGTH / (seeing_arcsec * ARCSEC)
    return Atmosphere.from_site(SITE, 1, r0=r0)


@dataclass(frozen=True)
class SpotsView:
    """Spots over the field."""

    field_deg: np.ndarray  #: field angles [deg], [n, 2]
    x: np.ndarray  #: displacement of lit rays from their centroid [um], [n_ray]
    y: np.ndarray
    index: np.ndarray  #: field of each ray, [n_ray]
    rms_um: np.ndarray  #: rms radius [um], [n]; NaN where no light arrives
    rms_arcsec: np.ndarray
    lit: np.ndarray  #: lit fraction of the pupil, [n]
    unit: str = "um"  #: urad instead of um where the image is at infinity


def spots_view(scene: Scene) -> SpotsView:
    """Return the spots of the bench's fields; DomainError where no light arrives at any."""
    diagram = spots(
        scene.telescope, scene.bench.spot_fields, scene.wavelength, n_pupil=RINGS, focal_plane=scene.focal_plane
    )
    lit = diagram.weight[:, 0] > 0
    if not lit.any():
        raise DomainError("no light arrives at the detector: expected values within reach of the surfaces")
    index, _ = np.nonzero(lit)
    x, y = 1e6 * (diagram.displacement[:, 0] - diagram.centroid[:, None])[lit].T
    rms = diagram.rms_radius
    arcsec = rms * diagram.plate_scale / ARCSEC
    unit = diagram.image_unit("um")
    return SpotsView(np.rad2deg(diagram.fields), x, y, index, rms * 1e6, arcsec, diagram.lit_fraction, unit)


@dataclass(frozen=True)
class OpdView:
    """Wavefront of the star."""

    opd_nm: np.ndarray  #: OPD without piston and tilt [nm], rows along +y, [64, 64]; NaN without light
    half_m: float  #: half of the side of the map [m]
    noll: np.ndarray  #: Noll indices from 4
    zernikes_nm: np.ndarray  #: coefficients of annular Zernikes [nm]
    rms_nm: float
    pupil: FittedPupil = "full"  #: points of the Zernikes: the whole annulus, or where light passes


def opd_view(scene: Scene) -> OpdView:
    """Return the OPD map and the annular Zernikes at the star's field."""
    opd = wavefront_opd(scene.telescope, scene.field, scene.wavelength, grid=_GRID, focal_plane=scene.focal_plane)
    flat = opd.without_tilt * 1e9
    request = Request.of(scene.telescope, scene.field[None], scene.wavelength).on(scene.focal_plane)
    fit = wavefront_zernikes(request, jmax=JMAX)
    zernikes = fit.coefficients[0] * 1e9
    lit = np.isfinite(flat)
    rms = float(np.sqrt(np.mean(flat[lit] ** 2))) if lit.any() else math.nan
    step = float(opd.x[0, 1] - opd.x[0, 0]) if opd.x.shape[1] > 1 else 0.0
    half = float(np.abs(opd.x).max()) + 0.5 * abs(step)
    return OpdView(flat, half, np.arange(4, JMAX + 1), zernikes[3:], rms, fit.pupil)


@dataclass(frozen=True)
class WhiskersView:
    """Shapes of stars over the focal plane."""

    x_mm: np.ndarray  #: places on the detector [mm], [n]
    y_mm: np.ndarray
    e1: np.ndarray  #: ellipticity (a - b) / (a + b) along the axes of the detector
    e2: np.ndarray
    fwhm_arcsec: np.ndarray  #: of the Gaussian of the same size [arcsec]
    method: str  #: what was measured, in words

    @property
    def e(self) -> np.ndarray:
        """Modulus of the ellipticity."""
        return np.hypot(self.e1, self.e2)

    def ends(self, length_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return x0, y0, x1, y1 [mm] of whiskers whose length for e = 1 is given [mm]."""
        angle, half = 0.5 * np.arctan2(self.e2, self.e1), 0.5 * length_mm * self.e
        dx, dy = half * np.cos(angle), half * np.sin(angle)
        return self.x_mm - dx, self.y_mm - dy, self.x_mm + dx, self.y_mm + dy


def whiskers_view(scene: Scene, per_ccd: int = 1) -> WhiskersView:
    """Return the shapes of stars by their moments, without images: adaptive ones with an atmosphere.

    Second moments of rays, with a Gaussian of the seeing, stand in for them far from focus, where the others of many
    stars do not exist, and for telescopes other than the LSST, whose vignetted pupils take seconds.
    """
    places, star_fields = scene.bench.stars(per_ccd)
    rays = _ray_whiskers(scene, places, star_fields)
    if not scene.bench.is_lsst:
        return rays
    try:
        view = _weighted_whiskers(scene, places, star_fields)
    except DomainError:
        return rays
    if np.isfinite(view.e1).mean() < _MEASURED:
        return rays
    if scene.atmosphere is not None:
        return view
    # Within its weight no star is wider than that: its width is that of rays, pixels and diffusion.
    stamps = stamps_of(scene)
    blur = FWHM_PER_RMS * math.hypot(stamps.pixel_size / math.sqrt(12.0), stamps.diffusion)
    fwhm = np.hypot(rays.fwhm_arcsec, blur * scene.bench.plate_scale / ARCSEC)
    return replace(view, fwhm_arcsec=fwhm)


def _ray_whiskers(scene: Scene, places: np.ndarray, star_fields: np.ndarray) -> WhiskersView:
    diagram = spots(scene.telescope, star_fields, scene.wavelength, n_pupil=RINGS, focal_plane=scene.focal_plane)
    lit, weight = diagram.weight[:, 0] > 0, diagram.weight[:, 0]
    away = np.where(lit[..., None], diagram.displacement[:, 0] - diagram.centroid[:, None], 0.0)
    away = away * (diagram.plate_scale / ARCSEC)[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        xx, yy, xy = (np.sum(weight * away[..., i] * away[..., j], axis=1) for i, j in ((0, 0), (1, 1), (0, 1)))
        xx, yy, xy = (moment / weight.sum(axis=1) for moment in (xx, yy, xy))
        # Kolmogorov's FWHM falls with the fifth root of the wavelength.
        air = (scene.state.seeing_arcsec * (scene.wavelength / SEEING_WAVELENGTH) ** -0.2 / FWHM_PER_RMS) ** 2
        xx, yy = xx + air, yy + air
        root = np.sqrt(np.maximum(xx * yy - xy**2, 0.0))
        norm = xx + yy + 2.0 * root
        e1, e2 = (xx - yy) / norm, 2.0 * xy / norm
    method = "Whiskers: second moments of rays" + " and seeing" * (air > 0)
    x_mm, y_mm = places.T * 1e3
    return WhiskersView(x_mm, y_mm, e1, e2, FWHM_PER_RMS * np.sqrt(root), method)


def _weighted_whiskers(scene: Scene, places: np.ndarray, star_fields: np.ndarray) -> WhiskersView:
    moments = psf_moments(
        scene.telescope,
        star_fields,
        scene.wavelength,
        focal_plane=scene.focal_plane,
        atmosphere=scene.atmosphere,
        stamps=stamps_of(scene),
    )
    air = scene.atmosphere is not None
    e1, e2, size = (moments.g1, moments.g2, moments.sigma) if air else (moments.e1, moments.e2, moments.size)
    method = "Whiskers: adaptive moments" if air else "Whiskers: optics, weight of 0.3 arcsec"
    x_mm, y_mm = places.T * 1e3
    return WhiskersView(x_mm, y_mm, e1, e2, FWHM_PER_RMS * size / ARCSEC, method)


def stamps_of(scene: Scene) -> Stamps:
    """Return stamps with the pixels of the camera; without one of 10 um."""
    camera = scene.bench.camera
    return Stamps(size=_STAMP) if camera is None else Stamps.of_camera(camera, size=_STAMP)


@dataclass(frozen=True)
class HeightsView:
    """Heights of the CCDs."""

    height_um: np.ndarray  #: rows along +y, [n, n]; NaN in gaps
    half_mm: float  #: half of the side of the map [mm]


def heights_view(plane: FocalPlane) -> HeightsView:
    """Return a map of the heights of CCDs, positive along +z of the telescope."""
    half = 1.03 * float(plane.camera.reach)
    axis = half * (2.0 * (np.arange(_HEIGHTS) + 0.5) / _HEIGHTS - 1.0)
    return HeightsView(1e6 * plane.height(*np.meshgrid(axis, axis)), half * 1e3)


@dataclass(frozen=True)
class ImagesView:
    """Images of the star, and the light within circles about their centroids."""

    optics: np.ndarray  #: optics alone, fraction of the light in each pixel, rows along +y
    optics_arcsec: float  #: side of its pixels [arcsec]
    seen: np.ndarray | None  #: with the atmosphere, in pixels of the camera; None without one
    seen_arcsec: float
    radius_arcsec: np.ndarray  #: radii of encircled energy [arcsec]
    optics_energy: np.ndarray  #: of rays alone, within each radius
    seen_energy: np.ndarray | None


def images_view(scene: Scene) -> ImagesView:
    """Return images and encircled energies of the star."""
    field, wavelength, plane = scene.field[None], scene.wavelength, scene.focal_plane
    rays = spots(scene.telescope, field, wavelength, sampling="spiral", n_pupil=4000, focal_plane=plane)
    scale = float(rays.plate_scale[0]) / ARCSEC
    lit = rays.weight[0, 0] > 0
    if not lit.any():
        raise DomainError(f"field {scene.state.field_deg} deg: no light arrives")
    landing = (rays.displacement[0, 0] - rays.centroid[0])[lit] * scale
    away, light = np.hypot(*landing.T), rays.weight[0, 0][lit]
    light = light / light.sum()
    airy = float(rays.airy_radius[0]) * scale
    reach = 1.2 * max(float(np.quantile(away, 0.99)), airy)
    image, _, _ = np.histogram2d(landing[:, 1], landing[:, 0], bins=_PIXELS, range=[[-reach, reach]] * 2, weights=light)
    seen = seen_curve = None
    pixel, inside = 0.0, 1.0
    largest = reach
    if scene.atmosphere is not None:
        stamp = make_psfs(
            scene.telescope,
            field,
            wavelength,
            focal_plane=plane,
            atmosphere=scene.atmosphere,
            stamps=stamps_of(scene),
            engine="long_exposure",
        )
        seen, pixel, inside = stamp.image[0], stamp.pixel_scale / ARCSEC, float(stamp.inside[0])
        largest = max(reach, 3.0 * scene.state.seeing_arcsec)
    radius = np.linspace(0.0, largest, _RADII)
    order = np.argsort(away)
    held = np.interp(radius, away[order], np.cumsum(light[order]) - 0.5 * light[order], left=0.0, right=1.0)
    if seen is not None:
        at, within = energy_curve(seen)
        seen_curve = inside * np.interp(radius, at * pixel, within)
    return ImagesView(image, 2.0 * reach / _PIXELS, seen, pixel, radius, held, seen_curve)


@dataclass(frozen=True)
class Piece:
    """A surface or lens in section."""

    name: str
    text: str  #: radius and glass, in words
    z_m: np.ndarray  #: along the axis [m]
    y_m: np.ndarray
    glass: bool


@dataclass(frozen=True)
class SectionView:
    """The section x = 0 of the telescope, and rays."""

    pieces: tuple[Piece, ...]
    rays: tuple[tuple[np.ndarray, np.ndarray], ...]  #: z, y of each ray [m]
    ray_fields: np.ndarray  #: index of the field of each ray


def layout_of(scene: Scene) -> Layout:
    """Return the layout, with rays of the axis and of a field near the edge."""
    edge = scene.bench.nominal.field_radius
    return layout(scene.telescope, [(0.0, 0.0), (0.0, 0.9 * edge)], scene.wavelength)


def section_view(scene: Scene, drawing: Layout) -> SectionView:
    """Return the surfaces, lenses and rays in section."""
    pieces = []
    for lens in drawing.lenses:
        front, back = (_finite(drawing.profiles[name]) for name in (lens.front, lens.back))
        if len(front) and len(back):
            rim = np.concatenate([front, back[::-1]])
            text = f"glass of index {lens.index:.5g}"
            pieces.append(Piece(lens.name, text, rim[:, 2], rim[:, 1], True))
    for surface in scene.telescope.surfaces:
        profile = drawing.profiles[surface.name]
        pieces.append(Piece(surface.name, _surface_text(scene, surface.name), profile[:, 2], profile[:, 1], False))
    paths = [(path, i) for i, fan in enumerate(drawing.fans) for path in fan]
    rays = tuple((path[:, 2], path[:, 1]) for path, _ in paths)
    return SectionView(tuple(pieces), rays, np.array([i for _, i in paths], dtype=int))


def _surface_text(scene: Scene, name: str) -> str:
    surface = scene.telescope.surface(name)
    radius = surface.shape.parameters.get("radius", math.inf)
    shape = f"radius {radius:.6g} m" if math.isfinite(radius) and radius else "flat or by its terms"
    return f"{shape}, {surface.interaction.name.lower()}"


def _finite(points: np.ndarray) -> np.ndarray:
    return points[np.isfinite(points).all(axis=1)]


def numbers(
    spots_now: SpotsView | None, opd: OpdView | None, whiskers: WhiskersView | None, images: ImagesView | None
) -> dict[str, tuple[float, str]]:
    """Return the numbers that stand beside the pictures, with their units; those of missing views are left out."""
    table: dict[str, tuple[float, str]] = {}
    if spots_now is not None:
        table["spot rms radius, median"] = (finite_median(spots_now.rms_um), spots_now.unit)
        table["spot rms radius, median on the sky"] = (finite_median(spots_now.rms_arcsec), "arcsec")
        table["spot rms radius, largest"] = (float(np.nanmax(spots_now.rms_um, initial=0.0)), spots_now.unit)
    if opd is not None:
        table["wavefront rms at the star"] = (opd.rms_nm, "nm")
    if whiskers is not None:
        table["FWHM, median"] = (finite_median(whiskers.fwhm_arcsec), "arcsec")
        table["ellipticity, median"] = (100.0 * finite_median(whiskers.e), "%")
    if images is not None:
        curve = images.optics_energy if images.seen_energy is None else images.seen_energy
        reached = curve >= 0.8
        radius = float(np.interp(0.8, curve, images.radius_arcsec)) if reached.any() else math.nan
        table["80 % of the light at the star within"] = (radius, "arcsec")
    return table
