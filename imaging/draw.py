"""Noise-free images of galaxies and stars on a CCD, in electrons.

Galaxies are drawn in one of two ways. ``direct``: each by itself, the product of its own Fourier transform and that of
the PSF at its place. ``eigen``, as in Jee & Tyson 2011, sec. 5: one seeing-free image of all of them, multiplied by the
map of each amplitude of the PSF and convolved with the component of that amplitude.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, check_choice
from ..core.threads import one_blas_thread, thread_count
from .psf_field import PsfField

DrawingWay = Literal["direct", "eigen"]
#: Pixels along a side of the grid of a galaxy.
SIZES = (32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024, 1536, 2048)
#: Largest grid of which the transforms of all components of the PSF are held, for all galaxies [pixel].
_COMMON = 512
#: Largest light of a galaxy beyond its grid, where it wraps round, in rms of the noise of a pixel.
_WRAPPED = 0.01
#: Distance by which the PSF spreads the light of a galaxy [pixel]; its wings count by themselves.
_BLUR = 3
#: Numbers of a block of galaxies: 8 MB in single precision, so that it stays in the cache of a processor.
_BLOCK = 2**21
#: rms width of the Gaussian that the seeing-free image is convolved with, and the PSF deconvolved by [pixel]. Without
#: it, galaxies smaller than a pixel would ring through the whole image.
_SOFTENING = 0.6
#: Side of a tile of the seeing-free image [pixel].
_TILE = 480
#: Side of the grid that a tile is convolved on [pixel].
_TILE_GRID = 576
#: Points along a side of a tile at which amplitudes are evaluated: exact for polynomials up to the sixth order.
_NODES = 7


class Sources(Protocol):
    """Galaxies that can be drawn, such as :class:`pachon.sky.Galaxies`."""

    @property
    def xi(self) -> np.ndarray:
        """Position about the pointing, towards east [rad]."""

    @property
    def eta(self) -> np.ndarray:
        """Position about the pointing, towards north [rad]."""

    @property
    def magnitude(self) -> np.ndarray:
        """AB magnitudes."""

    @property
    def radius(self) -> np.ndarray:
        """Half-light radii [rad]."""

    def __len__(self) -> int: ...

    def take(self, indices: Any) -> Sources:
        """Return some of the galaxies."""

    def light_beyond(self, distance: np.ndarray) -> np.ndarray:
        """Return the largest light of galaxies of unit flux at a distance [rad] or beyond [1/rad^2]."""

    def on_cells(self, cells: int) -> Sources:
        """Return the same galaxies with transforms for pixels so many times finer."""

    def transform(
        self, indices: Any, jacobian: np.ndarray, offset: np.ndarray, size: int, *, threads: int | None = None
    ) -> np.ndarray:
        """Return the Fourier transforms of galaxies of unit flux, complex64 [k, size, size // 2 + 1]."""


class SkyPixels(Protocol):
    """World coordinates of a CCD, such as :class:`pachon.imaging.CcdWcs`."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the CCD."""

    def to_sky(self, pixels: ArrayLike) -> np.ndarray:
        """Return (xi, eta) [rad], shape [n, 2], of pixels (x, y), shape [n, 2]."""

    def to_pixel(self, sky: ArrayLike) -> np.ndarray:
        """Return pixels (x, y), shape [n, 2], of (xi, eta) [rad], shape [n, 2]."""

    def jacobians(self, pixels: ArrayLike) -> np.ndarray:
        """Return d(x, y)/d(xi, eta) [pixel/rad] at pixels, shape [n, 2, 2]."""


@check_arguments
@dataclass(frozen=True)
class Window:
    """Rectangle of pixels of a CCD; the first one is (x, y)."""

    x: int
    y: int
    width: int
    height: int

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of an image of it."""
        return self.height, self.width

    def contains(self, pixels: np.ndarray, margin: float | np.ndarray = 0.0) -> np.ndarray:
        """Return whether pixels [n, 2] lie in it, or at most a margin [pixel] outside."""
        low = np.array([self.x, self.y]) - 0.5 - margin
        high = low + (self.width, self.height) + 2.0 * margin
        return np.asarray(((pixels >= low) & (pixels < high)).all(axis=1))

    def grown(self, margin: int) -> Window:
        """Return the window larger by a margin on all sides."""
        return Window(self.x - margin, self.y - margin, self.width + 2 * margin, self.height + 2 * margin)


def draw_galaxies(
    galaxies: Sources,
    electrons: np.ndarray,
    psf: PsfField,
    wcs: SkyPixels,
    *,
    window: Window | None = None,
    noise: float | np.ndarray = 1.0,
    way: DrawingWay = "direct",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> np.ndarray:
    """Draw galaxies under the PSF of their places.

    Parameters
    ----------
    galaxies : Galaxies
        Galaxies about the pointing of `wcs`, on the CCD or near it.
    electrons : ndarray, shape [n]
        Electrons of each in the image.
    psf : PsfField
        PSF of the CCD.
    wcs : SkyPixels
        World coordinates of the CCD.
    window : Window, optional
        Part of the CCD to draw; all of it by default.
    noise : float or ndarray, shape [n]
        rms noise of a pixel [electron], a hundredth of which is the error allowed where a galaxy's light leaves its
        grid.
    way : {"direct", "eigen"}
        How galaxies are convolved; with a PSF on cells finer than pixels one by one.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    progress : callable, optional
        Called with the number of galaxies drawn since the last call.

    Returns
    -------
    ndarray of float32, shape [ny, nx]
        Electrons.

    Raises
    ------
    ConfigError
        If there is no such way, or not with this PSF.
    """
    check_choice("way", way, get_args(DrawingWay))
    if way == "eigen" and psf.cells > 1:
        raise ConfigError("way = eigen: expected direct, for a PSF that pixels do not sample", key="image.way")
    area = Window(0, 0, wcs.shape[1], wcs.shape[0]) if window is None else window
    if way == "direct":
        return _draw_direct(galaxies, electrons, psf, wcs, area, noise, threads, progress)
    margin = psf.stamp // 2 + 1
    wide = area.grown(margin)
    scene = _draw_direct(galaxies, electrons, None, wcs, wide, noise, threads, progress)
    return _convolve_with_psf(scene, psf, wide, threads)[margin:-margin, margin:-margin].copy()


def grid_sizes(
    galaxies: Sources, electrons: np.ndarray, scale: np.ndarray, profile: np.ndarray, noise: float | np.ndarray
) -> np.ndarray:
    """Return the size of the grid of each galaxy: the first of :data:`SIZES` that holds its light, [n].

    Light beyond the grid wraps around, so none is lost. A size is accepted where the galaxy and a star of the same
    electrons are together fainter at its rim than a hundredth of the noise.

    Parameters
    ----------
    galaxies : Galaxies
        The galaxies.
    electrons : ndarray, shape [n]
        Electrons of each.
    scale : ndarray, shape [n]
        Pixels in an angle [pixel/rad] where it is.
    profile : ndarray
        Largest value of the PSF beyond each number of pixels; zero after the last.
    noise : float or ndarray, shape [n]
        rms noise of a pixel [electron].
    """
    sizes, waiting = np.full(len(electrons), SIZES[-1]), np.arange(len(electrons))
    limit = np.broadcast_to(_WRAPPED * np.asarray(noise), sizes.shape)
    for size in SIZES[:-1]:
        # A pixel of margin for the place of the galaxy between pixels.
        edge = size // 2 - 1
        star = profile[edge] if edge < len(profile) else 0.0
        rim = galaxies.light_beyond((edge - _BLUR) / scale[waiting]) / scale[waiting] ** 2
        held = electrons[waiting] * (star + rim) < limit[waiting]
        sizes[waiting[held]] = size
        # The smallest grid holds nearly all.
        waiting, galaxies = waiting[~held], galaxies.take(~held)
    return sizes


def add_stamps(image: np.ndarray, stamps: np.ndarray, corners: np.ndarray) -> None:
    """Add stamps [n, size, size] to an image, clipped at its edges; the first pixel of each is at (x, y)."""
    low = np.maximum(corners, 0)
    high = np.minimum(corners + stamps.shape[1], image.shape[::-1])
    first, last = low - corners, high - corners
    for stamp, (x0, y0), (x1, y1), (a, b), (c, d) in zip(stamps, low, high, first, last, strict=True):
        if x0 < x1 and y0 < y1:
            image[y0:y1, x0:x1] += stamp[b:d, a:c]


def _draw_direct(
    galaxies: Sources,
    electrons: np.ndarray,
    psf: PsfField | None,
    wcs: SkyPixels,
    window: Window,
    noise: float | np.ndarray,
    threads: int | None,
    progress: Callable[[int], None] | None,
) -> np.ndarray:
    """Draw galaxies one by one under a PSF, or the softening Gaussian without one."""
    image = np.zeros(window.shape, dtype=np.float32)
    if not len(galaxies):
        return image
    pixels = wcs.to_pixel(np.stack([galaxies.xi, galaxies.eta], axis=1))
    jacobians = wcs.jacobians(pixels)
    scale = np.sqrt(np.abs(np.linalg.det(jacobians)))
    profile = np.zeros(1) if psf is None else psf.profile()
    sizes = grid_sizes(galaxies, electrons, scale, profile, noise)
    nearest = np.rint(pixels).astype(np.int64)
    cells = 1 if psf is None else psf.cells
    if cells > 1:
        galaxies = galaxies.on_cells(cells)
    amplitudes = np.ones((len(pixels), 1)) if psf is None else psf.amplitudes(pixels)
    amplitudes = (electrons[:, None] * amplitudes).astype(np.float32)

    def blocks() -> Iterator[tuple[np.ndarray, int, np.ndarray | None]]:
        for size in SIZES:
            # Those whose grid touches the window.
            galaxy_indices = np.flatnonzero((sizes == size) & window.contains(pixels, 0.5 * size))
            if len(galaxy_indices):
                flat = None
                if psf is None or cells * size <= _COMMON:
                    basis = _softening_transform(size)[None] if psf is None else psf.transforms(cells * size)
                    flat = np.ascontiguousarray(basis).view(np.float32).reshape(len(basis), -1)
                count = max(1, _BLOCK // (cells * size) ** 2)
                yield from ((galaxy_indices[i : i + count], size, flat) for i in range(0, len(galaxy_indices), count))

    def drawn(block: tuple[np.ndarray, int, np.ndarray | None]) -> tuple[np.ndarray, np.ndarray]:
        galaxy_indices, size, basis = block
        side = cells * size
        # The centre of a pixel is half a pixel from the rim of its first cell.
        offset = cells * (pixels[galaxy_indices] - nearest[galaxy_indices]) + 0.5 * (cells - 1)
        spectrum = galaxies.transform(galaxy_indices, cells * jacobians[galaxy_indices], offset, side, threads=1)
        if basis is None:
            assert psf is not None
            spectrum *= psf.transforms(side, amplitudes[galaxy_indices])
        else:
            with one_blas_thread():
                kernel = amplitudes[galaxy_indices] @ basis
            spectrum *= kernel.view(np.complex64).reshape(spectrum.shape)
        stamps = fft.irfft2(spectrum, s=(side, side), workers=1)
        if cells > 1:
            stamps = stamps.reshape(-1, size, cells, size, cells).sum(axis=(2, 4))
        return stamps, nearest[galaxy_indices] - size // 2 - (window.x, window.y)

    workers, waiting = thread_count(threads), blocks()
    with ThreadPoolExecutor(workers) as pool:
        # A few blocks at a time, so that memory stays small; added in their order, so that no byte depends on threads.
        while group := tuple(islice(waiting, 2 * workers)):
            for stamps, corners in pool.map(drawn, group):
                add_stamps(image, stamps, corners)
                if progress is not None:
                    progress(len(stamps))
    return image


def _softening_transform(size: int, centred: bool = True) -> np.ndarray:
    """Return the transform of the softening Gaussian, complex64 [size, size // 2 + 1], at pixel ``size // 2`` or 0."""
    fy, fx = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)
    gauss = np.exp(-2.0 * (np.pi * _SOFTENING) ** 2 * (fx**2 + fy**2))
    shift = np.exp(-2j * np.pi * (fx + fy) * (size // 2)) if centred else 1.0
    return (gauss * shift).astype(np.complex64)


def _convolve_with_psf(scene: np.ndarray, psf: PsfField, window: Window, threads: int | None) -> np.ndarray:
    """Return a softened scene convolved with the PSF of each place, by overlapping tiles."""
    basis = psf.transforms(_TILE_GRID) / _softening_transform(_TILE_GRID, centred=False)
    nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    # The grid is longer by what the PSF spreads, half of it on each side of the tile.
    shift = _TILE_GRID // 2
    image = np.zeros(scene.shape, dtype=np.float32)

    def convolved(corner: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        x, y = corner
        tile = scene[y : y + _TILE, x : x + _TILE]
        height, width = tile.shape
        places = [0.5 * n * (nodes + 1.0) - 0.5 for n in (width, height)]
        at = np.stack(np.meshgrid(places[0] + x + window.x, places[1] + y + window.y), axis=-1).reshape(-1, 2)
        amplitudes = psf.amplitudes(at).T.reshape(-1, _NODES, _NODES)
        along_x, along_y = (_lagrange_matrix(p, np.arange(n)) for p, n in zip(places, (width, height), strict=True))
        total = np.zeros((_TILE_GRID, _TILE_GRID // 2 + 1), dtype=np.complex64)
        with one_blas_thread():
            maps = (along_y @ amplitudes @ along_x.T).astype(np.float32)
        for field, component in zip(maps, basis, strict=True):
            total += fft.rfft2(tile * field, s=(_TILE_GRID, _TILE_GRID), workers=1) * component
        tile_light = fft.irfft2(total, s=(_TILE_GRID, _TILE_GRID), workers=1)
        # What lies more than half of the spread before the tile has come round the other end of the grid.
        spread = (_TILE_GRID - _TILE) // 2
        return np.roll(tile_light, (spread - shift, spread - shift), axis=(0, 1)), np.array([[x - spread, y - spread]])

    corners = [(x, y) for y in range(0, scene.shape[0], _TILE) for x in range(0, scene.shape[1], _TILE)]
    with ThreadPoolExecutor(thread_count(threads)) as pool:
        for tile_light, corner in pool.map(convolved, corners):
            add_stamps(image, tile_light[None], corner)
    return image


def _lagrange_matrix(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the matrix of the polynomial through values at nodes, evaluated at points (Lagrange)."""
    matrix = np.ones((len(points), len(nodes)))
    for j, node in enumerate(nodes):
        for other_node in np.delete(nodes, j):
            matrix[:, j] *= (points - other_node) / (node - other_node)
    return matrix
