"""Point spread functions of many stars, by any of the engines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import DomainError
from ...core.plotting import draw_stamps
from ...core.result import Result
from ...core.units import ARCSEC, metres, pure_numbers, radians
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ..aberration import ResidualWavefront
from ..atmosphere.atmosphere import Atmosphere
from ..request import Request
from .engine import PsfEngine, PsfInputs, PsfRenderer, Recenter, Stars, center_focal_length
from .engines import EngineName, psf_engine
from .light import Light
from .stamps import Stamps

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Value of :attr:`Psfs.flags` for a dark star: none of its light reaches the focal plane, and its image is zero.
DARK = 1


@dataclass(frozen=True)
class Psfs(Result):
    """Point spread functions of stars.

    Attributes
    ----------
    image : ndarray of float32, shape [n_star, ny, nx]
        Fraction of the light of the stamp in each pixel: of unit sum. ``[y, x]`` along the axes of the detector.
    pixel_scale : float
        Angle on the sky of a pixel [rad], at the centre of the field.
    fields : ndarray, shape [n_star, 2]
        Field angles [rad].
    wavelengths : ndarray, shape [n_wave]
        Vacuum wavelengths [m].
    reference_point : ndarray, shape [n_star, 3]
        Intersection of the chief ray of the middle wavelength with the CCD, telescope frame [m]. It lies at the centre
        of pixel ``[size // 2, size // 2]`` plus the star's offset.
    offset : ndarray, shape [n_star, 2]
        Place (x, y) of that point from the centre of the middle pixel [pixels].
    lit_fraction : ndarray, shape [n_star, n_wave]
        Lit fraction of the annular pupil.
    inside : ndarray, shape [n_star]
        Fraction of the light that falls on the stamp and, in silicon, turns into charge. Wings that wrap around count:
        on a stamp of 6 arcsec in a seeing of 0.7 arcsec they are 0.003 of the light of long exposures and of the
        statistical engine, 0.0005 of that of the fast one.
    flags : ndarray of int, shape [n_star]
        0, or :data:`DARK`.
    first : ndarray of float32, shape [n_star, ny, nx], optional
        With a ``recenter`` of the stamps, images before they were drawn once more, of unit sum.
    """

    _table = ("fields", "reference_point", "offset", "lit_fraction", "inside", "flags")
    _images = ("image",)

    image: np.ndarray
    pixel_scale: float
    fields: np.ndarray
    wavelengths: np.ndarray
    reference_point: np.ndarray
    offset: np.ndarray
    lit_fraction: np.ndarray
    inside: np.ndarray
    flags: np.ndarray
    first: np.ndarray | None = None

    def _label(self) -> str:
        waves = [f"{1e9 * w:.6g}" for w in self.wavelengths[:3]] + ["..."] * (len(self.wavelengths) > 3)
        pixel = f"pixels of {self.pixel_scale / ARCSEC:.4g} arcsec"
        return f"images {list(self.image.shape)}, {pixel}, {', '.join(waves)} nm"

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the first six images, each with a square root stretch."""
        titles = [f"({x:.3g}, {y:.3g})°" for x, y in np.rad2deg(self.fields)]
        return draw_stamps(ax, self.image, self.pixel_scale / ARCSEC, titles)


@removed_arguments(
    wavelength_weights="wavelengths=Light(wavelengths, weights=...)",
    dispersion="wavelengths=Light(wavelengths, dispersion=...)",
    stamp_size="stamps=Stamps(size=...)",
    n_pupil="engine=FastEngine(n_pupil=...) or LongExposureEngine(n_pupil=...)",
    oversampling="engine=FastEngine(oversampling=...)",
    padding="engine=WaveEngine(padding=...)",
    pupil_spacing="engine=WaveEngine(pupil_spacing=...)",
    projection="Request.of(telescope, fields, wavelengths, projection=...) in place of the telescope",
)
@check_arguments
def make_psfs(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | Light | None = None,
    *,
    focal_plane: FocalPlane | None = None,
    atmosphere: Atmosphere | None = None,
    aberration: ResidualWavefront | None = None,
    stamps: Stamps | None = None,
    engine: EngineName | PsfEngine = "fast",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Psfs:
    """Make the point spread functions of stars.

    Each image is sampled by the pixels of the detector. It depends on the star and the exposure alone: not on the other
    stars of the call, the number of threads or the batches.

    Parameters
    ----------
    telescope : Telescope or Request
        The telescope; or a :class:`~pachon.Request` in place of it, of fields and wavelengths.
    fields : array_like or Quantity, shape [n_star, 2]
        Field angles [rad], of the light's own travel, in the projection "zemax"; a request may have another one.
    wavelengths : array_like or Quantity, shape [n_wave], or Light
        Vacuum wavelengths [m], of equal numbers of photons before the telescope; or :class:`Light`, which holds spectra
        and atmospheric dispersion too.
    focal_plane : FocalPlane, optional
        CCD heights; the nominal flat plane by default.
    atmosphere : Atmosphere, optional
        The exposure; none outside the atmosphere.
    aberration : ResidualWavefront, optional
        Wavefront error that active optics leaves; none by default.
    stamps : Stamps, optional
        Pixels, charge diffusion, silicon, jitter, and places of the stars; by default 31 x 31 pixels of 10 um.
    engine : FastEngine, WaveEngine, LongExposureEngine, StatisticalEngine, or their names
        The engine with its options, or "fast", "wave", "long_exposure" or "statistical" with its defaults.
        :class:`FastEngine`: geometric optics with filters. :class:`WaveEngine`: Fourier optics, the slow reference
        engine. :class:`LongExposureEngine`: mean over all turbulence, the quickest for many stars per call; it needs an
        atmosphere, of which it uses the Fried parameter and the outer scale only. :class:`StatisticalEngine`: exposures
        of 5 s and more whose ellipticities and sizes are drawn from the theory of turbulence; it needs an atmosphere.
    threads : int, optional
        Number of threads; all processors by default.
    progress : callable, optional
        Called after each batch with the number of its stars.

    Returns
    -------
    Psfs

    Raises
    ------
    ConfigError
        If the engine is unknown or needs an atmosphere, or fields or wavelengths are given beside a request.
    DomainError
        If an argument is outside its range or of the wrong shape, silicon is transparent at a wavelength, or a star
        falls between the CCDs.
    """
    options, stamps = psf_engine(engine), stamps or Stamps()
    inputs, stars = psf_inputs(telescope, fields, wavelengths, focal_plane, atmosphere, aberration, stamps, threads)
    return _render_stars(options.renderer(inputs), inputs, stars, stamps.recenter, progress)


def psf_inputs(
    telescope: Telescope | Request,
    fields: ArrayLike | None,
    wavelengths: ArrayLike | Light | None,
    focal_plane: FocalPlane | None,
    atmosphere: Atmosphere | None,
    aberration: ResidualWavefront | None,
    stamps: Stamps,
    threads: int | None,
) -> tuple[PsfInputs, Stars]:
    """Return the inputs of a renderer and its stars for checked arguments of :func:`make_psfs`."""
    projection: Projection = "zemax"
    if isinstance(telescope, Request):
        lengths = wavelengths.wavelengths if isinstance(wavelengths, Light) else wavelengths
        request = Request.of(telescope, fields, lengths, threads=threads)
        focal_plane = request.on(focal_plane).focal_plane
        telescope, fields, projection, threads = request.telescope, request.fields, request.projection, request.threads
        wavelengths = Light(request.wavelengths, request.weights if np.ptp(request.weights) else None)
    if fields is None or wavelengths is None:
        raise DomainError("fields, wavelengths: expected both beside a telescope; a Request would have them")
    light = wavelengths if isinstance(wavelengths, Light) else Light(wavelengths)
    angles = _finite_pairs(radians(fields, "fields"), "fields", None)
    telescope.check_field(angles[:, 0], angles[:, 1])
    waves = metres(light.wavelengths, "wavelengths").reshape(-1)
    if not waves.size or not (np.isfinite(waves) & (waves > 0.0)).all():
        raise DomainError(f"wavelengths = {light.wavelengths!r}: expected one or more positive lengths in metres")
    photons = None if light.weights is None else _relative_photons(light.weights, len(angles), len(waves))
    places = np.zeros((len(angles), 2))
    if stamps.offsets is not None:
        places = _finite_pairs(stamps.offsets, "offsets", len(angles))
        # Images are periodic: that of a star beside its stamp would come in from the other side.
        if (far := np.abs(places) > 0.5 * stamps.size).any():
            raise DomainError(
                f"offsets = {places[far][0]:g}: expected a place on the stamp, at most {0.5 * stamps.size:g} pixels "
                "from the centre of its middle pixel"
            )
    shifts = None
    if light.dispersion is not None:
        shifts = _finite_pairs(radians(light.dispersion, "dispersion"), "dispersion", len(waves))
    inputs = PsfInputs(
        telescope,
        waves,
        stamps.image_plane(center_focal_length(telescope, waves) if stamps.jitter else 0.0),
        dispersion=shifts,
        focal_plane=focal_plane,
        atmosphere=atmosphere,
        aberration=aberration,
        silicon=stamps.silicon,
        projection=projection,
        threads=threads,
        has_spectra=photons is not None,
    )
    return inputs, Stars(angles, places, photons)


def _render_stars(
    renderer: PsfRenderer,
    inputs: PsfInputs,
    stars: Stars,
    recenter: Callable[[np.ndarray, float], np.ndarray] | None,
    progress: Callable[[int], None] | None,
) -> Psfs:
    """Return the images of stars, rendered batch by batch."""
    n_star, size = len(stars), inputs.plane.size
    pixel_scale = inputs.plane.pixel_size / renderer.focal_length
    centroids: Recenter | None = None if recenter is None else lambda images: recenter(images, pixel_scale)
    image = np.empty((n_star, size, size), dtype=np.float32)
    lit_fraction = np.empty((n_star, len(inputs.wavelengths)))
    first = None if recenter is None else np.empty_like(image)
    reference_point, offset, inside = np.empty((n_star, 3)), np.empty((n_star, 2)), np.empty(n_star)
    renderer.prepare(stars.fields)
    for batch in renderer.batches(stars.fields):
        batch_stars = stars[batch]
        rendered = renderer.render(batch_stars.fields, batch_stars.offsets, centroids, batch_stars.photons)
        image[batch], inside[batch] = _of_unit_sum(rendered.image)
        if first is not None:
            assert rendered.first is not None
            first[batch], _ = _of_unit_sum(rendered.first)
        lit_fraction[batch], reference_point[batch] = rendered.lit_fraction, rendered.reference_point
        offset[batch] = rendered.offset
        if progress is not None:
            progress(len(batch))
    return Psfs(
        image=image,
        pixel_scale=pixel_scale,
        fields=stars.fields,
        wavelengths=inputs.wavelengths,
        reference_point=reference_point,
        offset=offset,
        lit_fraction=lit_fraction,
        inside=inside,
        flags=np.where(lit_fraction.any(axis=1), 0, DARK),
        first=first,
    )


def _of_unit_sum(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return images over their sums, those of no light as they are, and the sums."""
    light = images.sum(axis=(1, 2))
    return images / np.where(light > 0.0, light, 1.0)[:, None, None], light


def _relative_photons(values: Any, n_star: int, n_wave: int) -> np.ndarray:
    """Return relative numbers of photons, of mean 1 for each star, shape [n_star, n_wave]."""
    table = pure_numbers(values, "weights")
    if table.shape not in ((n_wave,), (n_star, n_wave)):
        raise DomainError(f"weights of shape {list(table.shape)}: expected [{n_wave}] or [{n_star}, {n_wave}]")
    table = np.array(np.broadcast_to(table, (n_star, n_wave)))
    if not (np.isfinite(table) & (table >= 0.0)).all() or not table.any(axis=1).all():
        raise DomainError("weights: expected numbers of photons from 0, some of each star above it")
    return np.asarray(table / table.mean(axis=1, keepdims=True))


def _finite_pairs(values: Any, name: str, count: int | None) -> np.ndarray:
    """Return pairs of finite numbers as a float64 array of shape [count, 2]."""
    table = pure_numbers(values, name)
    if count is None:
        table = np.atleast_2d(table) if table.size else table.reshape(0, 2)
    if table.ndim != 2 or table.shape[1] != 2 or (count is not None and len(table) != count):
        expected = f"[{'n' if count is None else count}, 2]"
        raise DomainError(f"{name} of shape {table.shape}: expected {expected}")
    if not np.isfinite(table).all():
        raise DomainError(f"{name}: expected finite numbers only")
    return table
