"""Stamps of real galaxies from a mosaic, planted over the sky, and their Fourier transforms on pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.launch import launch, start_warp
from ..core.memory import require_bytes
from ..core.point_plots import draw_points
from ..core.result import Result
from ..core.threads import one_blas_thread
from ..core.units import ARCMIN, ARCSEC, for_each, positive_angle, radians, require_positive
from ..core.warp_arrays import warp_array
from .cells import SIDE, Cell, Region, poisson_arrivals
from .cutouts import Cutouts, cut_galaxies, read_mosaic
from .galaxies import grid_arguments, reduced_shear
from .sersic import sersic_brightness
from .stamp_kernels import transform_stamps

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Steps of the tables: so many in the frequency that has one cycle over a stamp.
OVERSAMPLING = 8
# Frequencies beyond those of the finest pixel, for shear, rotation and distortion.
_MARGIN = 1.3


@dataclass(frozen=True, eq=False)
class GalaxyStamps(Result):
    """Galaxies cut out of a mosaic, as tables of their Fourier transforms.

    The PSF and the noise of the mosaic remain in them.

    Attributes
    ----------
    magnitude : ndarray, shape [n]
        AB magnitudes.
    radius : ndarray, shape [n]
        Half-light radii, blurred by the mosaic's PSF [rad].
    images : tuple of ndarray
        Square stamps of unit sum.
    center : ndarray, shape [n, 2]
        Centroids (x, y) from the middle pixels [pixel].
    scale : ndarray, shape [2, 2]
        d(xi, eta) / d(x, y) of the mosaic [rad/pixel].
    psf_radius : float
        Half-light radius of the mosaic's PSF [rad].
    surface_density : float
        Galaxies per rad^2 of the mosaic.
    finest_pixel : float
        Side of the smallest pixels that transforms are made for [rad].
    """

    _table = ("magnitude", "radius", "center")

    magnitude: np.ndarray
    radius: np.ndarray
    images: tuple[np.ndarray, ...]
    center: np.ndarray
    scale: np.ndarray
    psf_radius: float
    surface_density: float
    finest_pixel: float

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw half-light radius against magnitude."""
        return draw_points(ax, self.magnitude, self.radius / ARCSEC, ("magnitude", "half-light radius [arcsec]"))

    @classmethod
    @check_arguments
    def from_mosaic(
        cls,
        path: str | Path,
        *,
        zero_point: float | str | None = None,
        psf_radius: ArrayLike | None = None,
        side: float = 5.0,
        finest_pixel: ArrayLike = 0.2 * ARCSEC,
        seed: int = 0,
    ) -> GalaxyStamps:
        """Cut galaxies out of a FITS mosaic, as Jee & Tyson (2011, sec. 6.2) did with the Ultra Deep Field.

        Objects are 8 connected pixels above the rms of the sky. The squares about them have the side of five semi-major
        axes; pixels of neighbours are replaced by noise of the local sky. What is no larger than the PSF is left out.

        Parameters
        ----------
        path : str or Path
            FITS file with celestial coordinates; image in the primary or the first extension with one.
        zero_point : float or str, optional
            AB magnitude of one unit, or the header keyword that has it; by default from PHOTFLAM and PHOTPLAM, or one
            of the usual keywords.
        psf_radius : float or Quantity, optional
            Half-light radius of the mosaic's PSF [rad]; by default that of the stellar locus.
        side : float
            Side of the squares, in semi-major axes (rms along the major axis).
        finest_pixel : float or Quantity
            Side of the smallest pixels that transforms are made for [rad].
        seed : int
            Seed of the noise in place of neighbours.

        Returns
        -------
        GalaxyStamps

        Raises
        ------
        ProductError
            If the file cannot be read, has no image, coordinates, zero point, objects, or none larger than the PSF.
        """
        side = require_positive(side, "side")
        finest = positive_angle(finest_pixel, "finest_pixel")
        mosaic = read_mosaic(path, zero_point)
        pixel = float(np.sqrt(abs(np.linalg.det(mosaic.scale))))
        psf_pixels = None if psf_radius is None else positive_angle(psf_radius, "psf_radius") / pixel
        cut: Cutouts = cut_galaxies(mosaic, side=side, psf_radius=psf_pixels, seed=seed)
        return cls(
            magnitude=mosaic.zero_point - 2.5 * np.log10(cut.flux),
            radius=cut.radius * pixel,
            images=tuple(image / image.sum() for image in cut.images),
            center=cut.center,
            scale=mosaic.scale,
            psf_radius=cut.psf_radius * pixel,
            surface_density=len(cut.flux) / (mosaic.area * ARCMIN**2),
            finest_pixel=finest,
        )

    def __len__(self) -> int:
        return len(self.magnitude)

    @check_arguments
    def population(self, seed: int, *, density: float | None = None) -> StampPopulation:
        """Return these galaxies planted at random places and angles over the whole tangent plane.

        Parameters
        ----------
        seed : int
            Seed of places, angles and choice of stamps.
        density : float, optional
            Galaxies per square arcminute; by default that of the mosaic.

        Raises
        ------
        DomainError
            If the density is not positive, or would cover the sky with galaxies.
        """
        number = self.surface_density * ARCMIN**2 if density is None else require_positive(density, "density")
        covered = number * float(np.mean(np.pi * (2.0 * self.radius) ** 2)) / ARCMIN**2
        if covered > 1.0:
            text = (
                f"galaxies would cover the sky {covered:.1f} times within two half-light radii, expected less than once"
            )
            raise DomainError(f"density = {number:g} per square arcminute: {text}")
        if seed < 0:
            raise DomainError(f"seed = {seed}: expected a number that is not negative")
        return StampPopulation(self, seed, number)

    @cached_property
    def steps(self) -> np.ndarray:
        """Steps of each stamp's table in one cycle per pixel of the mosaic, [n]."""
        return OVERSAMPLING * np.array([len(image) for image in self.images])

    @property
    def reach(self) -> float:
        """Greatest frequency of the tables [cycles per pixel of the mosaic]; they end at the Nyquist frequency."""
        pixel = np.sqrt(abs(np.linalg.det(self.scale)))
        return float(min(0.5, _MARGIN * np.sqrt(0.5) * pixel / self.finest_pixel))

    @cached_property
    def tables(self) -> StampTables:
        """Transforms of all stamps about their centroids."""
        half = np.ceil(self.reach * self.steps).astype(np.int64) + 3
        start = np.concatenate([[0], np.cumsum((2 * half + 1) * (half + 2))])
        values = np.empty(start[-1], dtype=np.complex64)
        with one_blas_thread():
            for i, image in enumerate(self.images):
                place = np.arange(len(image)) - len(image) // 2 - self.center[i][:, None]
                rows, columns = np.arange(-half[i], half[i] + 1), np.arange(-1, half[i] + 1)
                turn = -2j * np.pi / self.steps[i]
                along_x, along_y = (np.exp(turn * np.outer(k, p)) for k, p in ((columns, place[0]), (rows, place[1])))
                values[start[i] : start[i + 1]] = (along_y @ image @ along_x.T).ravel()
        return StampTables(values, start[:-1], half)


class StampTables(NamedTuple):
    """Fourier transforms of stamps: rows from -half to half steps of frequency along y, columns from -1 to half."""

    values: np.ndarray  #: of all stamps one after another, complex64
    start: np.ndarray  #: first value of each stamp, [n]
    half: np.ndarray  #: [n]


@dataclass(frozen=True, eq=False)
class PlantedGalaxies:
    """Stamps of galaxies at positions on the sky, with the interface of :class:`~pachon.sky.galaxies.Galaxies`.

    Attributes
    ----------
    stamps : GalaxyStamps
        The stamps.
    index : ndarray of int, shape [n]
        Stamp of each galaxy.
    xi, eta : ndarray, shape [n]
        Positions of the centroids on the tangent plane [rad].
    distortion : ndarray, shape [n, 2, 2]
        Rotation and shear: a point of the stamp's sky at theta from the centroid is planted at distortion @ theta.
    """

    stamps: GalaxyStamps
    index: np.ndarray
    xi: np.ndarray
    eta: np.ndarray
    distortion: np.ndarray

    @classmethod
    def concatenate(cls, parts: Sequence[PlantedGalaxies]) -> PlantedGalaxies:
        """Join galaxies of the same stamps, at least one part."""
        joined = {
            name: np.concatenate([getattr(galaxies, name) for galaxies in parts])
            for name in ("index", "xi", "eta", "distortion")
        }
        return cls(parts[0].stamps, **joined)

    def __len__(self) -> int:
        return len(self.index)

    @property
    def magnitude(self) -> np.ndarray:
        """AB magnitudes, [n]."""
        return self.stamps.magnitude[self.index]

    @property
    def radius(self) -> np.ndarray:
        """Half-light radii [rad], [n]."""
        return self.stamps.radius[self.index]

    def take(self, indices: Any) -> PlantedGalaxies:
        """Return some of the galaxies: indices, which may repeat, a boolean mask or a slice."""
        return replace(
            self,
            index=self.index[indices],
            xi=self.xi[indices],
            eta=self.eta[indices],
            distortion=self.distortion[indices],
        )

    def light_beyond(self, distance: np.ndarray) -> np.ndarray:
        """Return the largest light as :meth:`Galaxies.light_beyond`, of the law of de Vaucouleurs."""
        return sersic_brightness(4.0, distance / self.radius) / self.radius**2

    def on_cells(self, cells: int) -> PlantedGalaxies:
        """Return the same galaxies with transforms for pixels so many times finer."""
        return replace(self, stamps=replace(self.stamps, finest_pixel=self.stamps.finest_pixel / cells))

    def sheared(self, g1: Any, g2: Any, *, positions: bool = False) -> PlantedGalaxies:
        """Return the galaxies under a reduced shear that conserves areas, as :meth:`Galaxies.sheared`."""
        g = reduced_shear(g1, g2, len(self))
        rows = [np.stack([1.0 + g.real, g.imag], axis=-1), np.stack([g.imag, 1.0 - g.real], axis=-1)]
        return self._distorted(np.stack(rows, axis=-2) / np.sqrt(1.0 - np.abs(g) ** 2)[:, None, None], positions)

    def rotated(self, angle: Any, *, positions: bool = False) -> PlantedGalaxies:
        """Return the galaxies rotated from xi towards eta by an angle [rad], as :meth:`Galaxies.rotated`."""
        return self._distorted(_rotation_matrices(for_each(radians(angle, "angle"), len(self), "angle")), positions)

    def _distorted(self, matrix: np.ndarray, positions: bool) -> PlantedGalaxies:
        place = np.stack([self.xi, self.eta], axis=-1)
        if positions:
            place = np.einsum("nij,nj->ni", matrix, place)
        return replace(self, xi=place[:, 0], eta=place[:, 1], distortion=matrix @ self.distortion)

    def transform(
        self, indices: Any, jacobian: np.ndarray, offset: np.ndarray, size: int, *, threads: int | None = None
    ) -> np.ndarray:
        """Compute the Fourier transforms of galaxies of unit flux on a pixel grid.

        Arguments, result and conventions are those of :meth:`pachon.sky.galaxies.Galaxies.transform`. A stamp is the
        sum of its pixels' values times delta functions, without frequencies beyond the mosaic's Nyquist frequency.

        Raises
        ------
        DomainError
            If an index is outside the galaxies, shapes do not match, or pixels are finer than the stamps are made for.
        """
        selection, jacobian, offset = grid_arguments(len(self), indices, jacobian, offset, size)
        start_warp()
        stamp, tables = self.index[selection], self.stamps.tables
        # Frequencies on the grid [cycles/pixel] to those of the mosaic.
        frequency = np.swapaxes(jacobian @ self.distortion[selection] @ self.stamps.scale, 1, 2)
        corners = np.abs(frequency @ np.array([[0.5, 0.5], [0.5, -0.5]])).max(initial=0.0)
        if corners > self.stamps.reach < 0.5:
            text = f"expected {self.stamps.finest_pixel / ARCSEC:.3g} arcsec or more (finest_pixel=)"
            raise DomainError(f"jacobian: pixels finer than the stamps are made for, {text}")
        result = np.empty((len(selection), size, size // 2 + 1), dtype=np.complex64)
        launch(
            transform_stamps,
            len(selection),
            [
                warp_array(stamp, wp.int32),
                warp_array(frequency * (self.stamps.steps[stamp] / size)[:, None, None], wp.mat22d),
                warp_array(offset, wp.vec2d),
                warp_array(tables.values, wp.vec2),
                warp_array(tables.start, wp.int32),
                warp_array(tables.half, wp.int32),
                size,
                warp_array(result, wp.vec2),
            ],
            threads=threads,
        )
        return result


@dataclass(frozen=True, eq=False)
class StampPopulation:
    """Stamps planted over the whole tangent plane, the same in every region that is drawn.

    Attributes
    ----------
    stamps : GalaxyStamps
        The stamps.
    seed : int
        Seed of places, angles and choice of stamps.
    density : float
        Galaxies per square arcminute.
    """

    stamps: GalaxyStamps
    seed: int
    density: float

    def galaxies_in(self, xi: Any, eta: Any) -> PlantedGalaxies:
        """Return the galaxies whose centroids lie in a rectangle of the tangent plane [rad], cell by cell."""
        region = Region.between(xi, eta)
        require_bytes(int(120 * region.area / ARCMIN**2 * self.density), "galaxies of this region")
        return PlantedGalaxies.concatenate([self._galaxies_of(cell, region) for cell in region.cells()])

    def _galaxies_of(self, cell: Cell, region: Region) -> PlantedGalaxies:
        n = len(poisson_arrivals(cell.stream(self.seed, "mosaic", "number"), self.density * (SIDE / ARCMIN) ** 2))
        x, y, stamp_uniform, angle = cell.stream(self.seed, "mosaic", "traits").random((n, 4)).T
        xi, eta = cell.place(x, y)
        index = (stamp_uniform * len(self.stamps)).astype(np.int64)
        planted = PlantedGalaxies(self.stamps, index, xi, eta, _rotation_matrices(2.0 * np.pi * angle))
        return planted.take(region.contains(xi, eta))


def _rotation_matrices(angle: np.ndarray) -> np.ndarray:
    """Return matrices that rotate from xi towards eta, [n, 2, 2]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
