"""Point spread functions of many stars, by any of the engines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError, check_choice
from ...core.plotting import draw_stamps
from ...core.result import Result
from ...core.units import ARCSEC, angle, length, metres, pure_numbers, radians
from ...models.camera.focal_plane import FocalPlane
from ...models.camera.silicon import Silicon
from ...models.telescope import Telescope
from ..aberration import ResidualWavefront
from ..atmosphere.atmosphere import Atmosphere
from .engine import PsfInputs, Recenter, center_focal_length
from .engines import ENGINES
from .image_plane import ImagePlane

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
        Fraction of the light that falls on the stamp and, in silicon, turns into charge.
    flags : ndarray of int, shape [n_star]
        0, or :data:`DARK`.
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

    def _label(self) -> str:
        waves = [f"{1e9 * w:.6g}" for w in self.wavelengths[:3]] + ["..."] * (len(self.wavelengths) > 3)
        pixel = f"pixels of {self.pixel_scale / ARCSEC:.4g} arcsec"
        return f"images {list(self.image.shape)}, {pixel}, {', '.join(waves)} nm"

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the first six images, each with a square root stretch."""
        titles = [f"({x:.3g}, {y:.3g})°" for x, y in np.rad2deg(self.fields)]
        return draw_stamps(ax, self.image, self.pixel_scale / ARCSEC, titles)


@check_arguments
def make_psfs(
    telescope: Telescope,
    fields: ArrayLike,
    wavelengths: ArrayLike,
    *,
    wavelength_weights: ArrayLike | None = None,
    focal_plane: FocalPlane | None = None,
    atmosphere: Atmosphere | None = None,
    aberration: ResidualWavefront | None = None,
    silicon: Silicon | None = None,
    engine: str = "fast",
    stamp_size: int = 31,
    pixel_size: ArrayLike = 10e-6,
    diffusion: ArrayLike = 4e-6,
    jitter: ArrayLike = 0.0,
    offsets: ArrayLike | None = None,
    recenter: Callable[[np.ndarray, float], np.ndarray] | None = None,
    dispersion: ArrayLike | None = None,
    n_pupil: int | None = None,
    oversampling: int | None = None,
    padding: bool | None = None,
    pupil_spacing: float | None = None,
    projection: str = "zemax",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Psfs:
    """Make the point spread functions of stars.

    Each image is sampled by the pixels of the detector. It depends on the star and the exposure alone: not on the other
    stars of the call, the number of threads or the batches.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    fields : array_like or Quantity, shape [n_star, 2]
        Field angles [rad], of the light's own travel.
    wavelengths : array_like or Quantity, shape [n_wave]
        Vacuum wavelengths [m], of equal numbers of photons before the telescope unless weighted.
    wavelength_weights : array_like, shape [n_wave] or [n_star, n_wave], optional
        Relative numbers of photons of each wavelength before the telescope: the spectrum of all stars, or of each, such
        as :func:`blackbody_photons` gives.
    focal_plane : FocalPlane, optional
        CCD heights; the nominal flat plane by default.
    atmosphere : Atmosphere, optional
        The exposure; none outside the atmosphere.
    aberration : ResidualWavefront, optional
        Wavefront error that active optics leaves; none by default.
    silicon : Silicon, optional
        Silicon of the CCDs, in which light turns into charge below the surface, and some of it not at all; by default
        all of it does so at the surface.
    engine : {"fast", "wave", "long_exposure"}
        ``"fast"``: geometric optics with filters. ``"wave"``: Fourier optics, the slow reference engine.
        ``"long_exposure"``: mean over all turbulence, the quickest for many stars per call. It needs an atmosphere, of
        which it uses the Fried parameter and the outer scale only.
    stamp_size : int
        Pixels on a side of a stamp.
    pixel_size : float or Quantity
        Side of a pixel [m].
    diffusion : float or Quantity
        Root mean square of the charge diffusion along each axis [m]; in silicon that of charge from the surface, and
        less from deeper down.
    jitter : float or Quantity
        Root mean square of the telescope's pointing along each axis during the exposure [rad]: a Gaussian blur, the
        same for all stars.
    offsets : array_like, shape [n_star, 2], optional
        Place of each star (x, y) from the centre of the middle pixel [pixels]; 0 by default.
    recenter : callable, optional
        Centroids of stamps: given images [n, ny, nx] and the angle of a pixel [rad], it returns places (x, y) from the
        centre of the middle pixel [pixels], shape [n, 2]. Each star is then drawn once more, with its centroid at the
        centre. That is exact, unlike a shift of the pixels, and costs little.
    dispersion : array_like or Quantity, shape [n_wave, 2], optional
        Shift in field angle of each wavelength by the atmosphere [rad], such as
        :func:`~pachon.wavefront.atmosphere.refraction.dispersion_shift` gives.
    n_pupil : int, optional
        Approximate number of pupil points (fast and long_exposure).
    oversampling : int, optional
        Cells of the fine grid per pixel (fast).
    padding : bool, optional
        Whether all baselines are used, up to the diameter of the pupil (wave). By default they are where there is no
        atmosphere or next to no charge diffusion.
    pupil_spacing : float, optional
        Distance of the pupil points [m] (wave). By default the image repeats itself outside the stamp only, and the
        distance is at most 0.02 m, or 0.04 m without an atmosphere, and a 96th of the diameter.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
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
        If the engine or the projection is unknown, or the engine needs an atmosphere or does not take an option.
    DomainError
        If an argument is outside its range or of the wrong shape, silicon is transparent at a wavelength, or a star
        falls between the CCDs.
    """
    check_choice("engine", engine, ENGINES)
    angles = _finite_pairs(radians(fields, "fields"), "fields", None)
    telescope.check_field(angles[:, 0], angles[:, 1])
    lengths = metres(wavelengths, "wavelengths").reshape(-1)
    if not lengths.size or not (np.isfinite(lengths) & (lengths > 0.0)).all():
        raise DomainError(f"wavelengths = {wavelengths!r}: expected one or more positive lengths in metres")
    photons = None if wavelength_weights is None else _relative_photons(wavelength_weights, len(angles), len(lengths))
    places = np.zeros((len(angles), 2)) if offsets is None else _finite_pairs(offsets, "offsets", len(angles))
    shifts = (
        None if dispersion is None else _finite_pairs(radians(dispersion, "dispersion"), "dispersion", len(lengths))
    )
    plane = ImagePlane(
        stamp_size,
        length(pixel_size, "pixel_size"),
        length(diffusion, "diffusion"),
        _jitter_on_detector(jitter, telescope, lengths),
    )
    maker = ENGINES[engine](
        PsfInputs(
            telescope,
            lengths,
            plane,
            dispersion=shifts,
            focal_plane=focal_plane,
            atmosphere=atmosphere,
            aberration=aberration,
            silicon=silicon,
            projection=projection,
            threads=threads,
            n_pupil=n_pupil,
            oversampling=oversampling,
            padding=padding,
            pupil_spacing=pupil_spacing,
        )
    )
    pixel_scale = plane.pixel_size / maker.focal_length
    centroids: Recenter | None = None if recenter is None else lambda images: recenter(images, pixel_scale)
    image = np.empty((len(angles), plane.stamp_size, plane.stamp_size), dtype=np.float32)
    lit_fraction = np.empty((len(angles), len(lengths)))
    reference_point, offset, inside = np.empty((len(angles), 3)), np.empty((len(angles), 2)), np.empty(len(angles))
    maker.prepare(angles)
    for first in range(0, len(angles), maker.batch):
        rows = slice(first, min(first + maker.batch, len(angles)))
        stars = maker.render(angles[rows], places[rows], centroids, None if photons is None else photons[rows])
        inside[rows] = stars.image.sum(axis=(1, 2))
        image[rows] = stars.image / np.where(inside[rows] > 0.0, inside[rows], 1.0)[:, None, None]
        lit_fraction[rows], reference_point[rows] = stars.lit_fraction, stars.reference_point
        offset[rows] = stars.offset
        if progress is not None:
            progress(rows.stop - first)
    return Psfs(
        image=image,
        pixel_scale=pixel_scale,
        fields=angles,
        wavelengths=lengths,
        reference_point=reference_point,
        offset=offset,
        lit_fraction=lit_fraction,
        inside=inside,
        flags=np.where(lit_fraction.any(axis=1), 0, DARK),
    )


def _jitter_on_detector(jitter: ArrayLike, telescope: Telescope, wavelengths: np.ndarray) -> float:
    """Return the displacement on the detector [m] of a jitter [rad], at the centre of the field."""
    spread = angle(jitter, "jitter")
    if not spread >= 0.0:
        raise DomainError(f"jitter = {spread:g}: expected an angle in radians from 0")
    return spread * center_focal_length(telescope, wavelengths) if spread else 0.0


def _relative_photons(values: ArrayLike, n_star: int, n_wave: int) -> np.ndarray:
    """Return relative numbers of photons, of mean 1 for each star, shape [n_star, n_wave]."""
    table = pure_numbers(values, "wavelength_weights")
    if table.shape not in ((n_wave,), (n_star, n_wave)):
        raise DomainError(
            f"wavelength_weights of shape {list(table.shape)}: expected [{n_wave}] or [{n_star}, {n_wave}]"
        )
    table = np.array(np.broadcast_to(table, (n_star, n_wave)))
    if not (np.isfinite(table) & (table >= 0.0)).all() or not table.any(axis=1).all():
        raise DomainError("wavelength_weights: expected numbers of photons from 0, some of each star above it")
    return np.asarray(table / table.mean(axis=1, keepdims=True))


def _finite_pairs(values: ArrayLike, name: str, count: int | None) -> np.ndarray:
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
