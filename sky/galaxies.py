"""Galaxies made of elliptical Sersic components: arrays, shear, Fourier transforms on pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError, shown
from ..core.launch import launch, start_warp
from ..core.point_plots import draw_points
from ..core.result import Result
from ..core.units import ARCMIN, broadcast_together, for_each, pure_numbers, radians
from ..core.warp_arrays import warp_array
from .galaxy_kernels import transform_galaxies
from .sersic import GREATEST_INDEX, INDICES, LEAST_INDEX, sersic_brightness, sersic_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PER_GALAXY = ("xi", "eta", "magnitude", "radius")
_PER_COMPONENT = ("dx", "dy", "fraction", "component_radius", "e1", "e2", "sersic")


@check_arguments
@dataclass(frozen=True, eq=False)
class Galaxies(Result):
    """Galaxies made of elliptical Sersic components.

    Positions are gnomonic: xi towards east, eta towards north, on the plane that touches the sky at the pointing.
    Ellipticities are (a - b)/(a + b), e1 > 0 along xi, e2 > 0 along xi = eta.

    Attributes
    ----------
    xi, eta : ndarray, shape [n]
        Positions [rad].
    magnitude : ndarray, shape [n]
        Total AB magnitudes.
    radius : ndarray, shape [n]
        Half-light radii of the whole galaxies [rad].
    first : ndarray of int, shape [n + 1]
        The components of galaxy i are ``first[i]:first[i + 1]``.
    dx, dy : ndarray, shape [m]
        Positions of the components from that of their galaxy [rad].
    fraction : ndarray, shape [m]
        Fraction of the galaxy's light, of sum 1 in every galaxy.
    component_radius : ndarray, shape [m]
        Half-light radii sqrt(a b) [rad].
    e1, e2 : ndarray, shape [m]
        Ellipticities.
    sersic : ndarray, shape [m]
        Sersic indices, 0.3 to 6.2.

    Raises
    ------
    DomainError
        If arrays differ in length or hold values that no galaxy has.
    """

    _table = ("xi", "eta", "magnitude", "radius")

    xi: np.ndarray
    eta: np.ndarray
    magnitude: np.ndarray
    radius: np.ndarray
    first: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    fraction: np.ndarray
    component_radius: np.ndarray
    e1: np.ndarray
    e2: np.ndarray
    sersic: np.ndarray

    def __post_init__(self) -> None:
        for name in (*_PER_GALAXY, *_PER_COMPONENT):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        object.__setattr__(self, "first", np.asarray(self.first, dtype=np.int64))
        n, m = len(self.xi), len(self.dx)
        for names, count in ((_PER_GALAXY, n), (_PER_COMPONENT, m)):
            for name in names:
                values = getattr(self, name)
                if values.shape != (count,):
                    raise DomainError(f"{name}: shape {values.shape}, expected ({count},)")
                if not np.all(np.isfinite(values)):
                    raise DomainError(f"{name}: expected finite numbers")
        if self.first.shape != (n + 1,) or self.first[0] != 0 or self.first[-1] != m or np.any(np.diff(self.first) < 1):
            raise DomainError(f"first: expected {n + 1} rising indices from 0 to {m}, the number of components")
        ellipticity, index = np.hypot(self.e1, self.e2), self.sersic
        for name, values, good, expectation in (
            ("radius", self.radius, self.radius > 0.0, "a positive radius in radians"),
            ("component_radius", self.component_radius, self.component_radius > 0.0, "a positive radius in radians"),
            ("e1, e2", ellipticity, ellipticity < 1.0, "an ellipticity below 1"),
            ("sersic", index, (index >= LEAST_INDEX) & (index <= GREATEST_INDEX), INDICES),
        ):
            if not good.all():
                at = int(np.argmin(good))
                raise DomainError(f"{name} [{at}] = {values[at]:g}: expected {expectation}")
        if n and np.any(np.abs(np.add.reduceat(self.fraction, self.first[:-1]) - 1.0) > 1e-6):
            raise DomainError("fraction: expected the sum 1 in every galaxy")

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the places, east to the right, coloured by magnitude."""
        labels, xi, eta = ("xi [arcmin]", "eta [arcmin]"), self.xi / ARCMIN, self.eta / ARCMIN
        return draw_points(ax, xi, eta, labels, color=self.magnitude, color_label="magnitude", equal=True)

    @classmethod
    def single(
        cls,
        xi: ArrayLike,
        eta: ArrayLike,
        magnitude: ArrayLike,
        radius: ArrayLike,
        *,
        e1: ArrayLike = 0.0,
        e2: ArrayLike = 0.0,
        sersic: ArrayLike = 1.0,
    ) -> Galaxies:
        """Return galaxies of one component each, from arrays of one shape [n] or scalars; units as in the class."""
        angles = {"xi": xi, "eta": eta, "radius": radius}
        numbers = {"magnitude": magnitude, "e1": e1, "e2": e2, "sersic": sersic}
        arrays = {name: radians(v, name) for name, v in angles.items()}
        arrays |= {name: pure_numbers(v, name) for name, v in numbers.items()}
        for name, values in arrays.items():
            if values.ndim > 1:
                raise DomainError(f"{name} has shape {values.shape}: expected one number or [n]")
        columns = broadcast_together({name: np.atleast_1d(values) for name, values in arrays.items()})
        named = dict(zip(arrays, columns, strict=True))
        count = len(named["xi"])
        zero = np.zeros(count)
        first = np.arange(count + 1)
        return cls(first=first, dx=zero, dy=zero, fraction=np.ones(count), component_radius=named["radius"], **named)

    @classmethod
    def concatenate(cls, parts: Sequence[Galaxies]) -> Galaxies:
        """Join galaxies in order; none at all give an empty object."""
        joined = {
            name: np.concatenate([np.zeros(0), *(getattr(galaxies, name) for galaxies in parts)])
            for name in (*_PER_GALAXY, *_PER_COMPONENT)
        }
        counts = np.concatenate([np.zeros(1, dtype=np.int64), *(np.diff(galaxies.first) for galaxies in parts)])
        return cls(first=np.cumsum(counts), **joined)

    def __len__(self) -> int:
        return len(self.xi)

    @property
    def owner(self) -> np.ndarray:
        """Galaxy of each component, [m]."""
        return np.repeat(np.arange(len(self)), np.diff(self.first))

    def take(self, indices: Any) -> Galaxies:
        """Return some of the galaxies: indices, which may repeat, a boolean mask or a slice."""
        try:
            selection = np.atleast_1d(np.arange(len(self))[indices])
        except (IndexError, ValueError):
            selection = np.empty((0, 0))
        if selection.ndim != 1:
            raise DomainError(f"indices = {shown(indices)}: expected integers below {len(self)}, a mask or a slice")
        counts = np.diff(self.first)[selection]
        first = np.concatenate([[0], np.cumsum(counts)])
        component = np.arange(first[-1]) + np.repeat(self.first[selection] - first[:-1], counts)
        parts = {name: getattr(self, name)[selection] for name in _PER_GALAXY}
        parts |= {name: getattr(self, name)[component] for name in _PER_COMPONENT}
        return Galaxies(first=first, **parts)

    def sheared(self, g1: ArrayLike, g2: ArrayLike, *, positions: bool = False) -> Galaxies:
        """Return the galaxies under a reduced shear that conserves areas.

        A source at theta is seen at S theta, S = [[1 + g1, g2], [g2, 1 - g1]] / sqrt(1 - g^2). An ellipticity e
        becomes (e + g) / (1 + conj(g) e) (Seitz & Schneider 1997). The half-light radius of a whole galaxy is
        kept, which holds to first order in g.

        Parameters
        ----------
        g1, g2 : float or ndarray, shape [n]
            Reduced shear of each galaxy, of modulus below 1.
        positions : bool
            Whether the positions of the galaxies are sheared too, about the pointing.
        """
        g = reduced_shear(g1, g2, len(self))
        scale = 1.0 / np.sqrt(1.0 - np.abs(g) ** 2)
        inner = g[self.owner]
        e = self.e1 + 1j * self.e2
        e = (e + inner) / (1.0 + np.conj(inner) * e)
        d = self.dx + 1j * self.dy
        d = scale[self.owner] * (d + inner * np.conj(d))
        z = self.xi + 1j * self.eta
        if positions:
            z = scale * (z + g * np.conj(z))
        return replace(self, xi=z.real, eta=z.imag, dx=d.real, dy=d.imag, e1=e.real, e2=e.imag)

    def rotated(self, angle: ArrayLike, *, positions: bool = False) -> Galaxies:
        """Return the galaxies rotated from xi towards eta by an angle [rad], scalar or [n].

        Each is rotated about its own position; with `positions`, about the pointing.
        """
        turn = np.exp(1j * for_each(radians(angle, "angle"), len(self), "angle"))
        inner = turn[self.owner]
        e = (self.e1 + 1j * self.e2) * inner**2
        d = (self.dx + 1j * self.dy) * inner
        z = (self.xi + 1j * self.eta) * (turn if positions else 1.0)
        return replace(self, xi=z.real, eta=z.imag, dx=d.real, dy=d.imag, e1=e.real, e2=e.imag)

    def light_beyond(self, distance: np.ndarray) -> np.ndarray:
        """Return the largest light of galaxies of unit flux at distances from their centres [rad] or beyond [1/rad^2].

        Both [n]; that of the components on their major axes.
        """
        e, radius = np.hypot(self.e1, self.e2), self.component_radius
        major = radius * np.sqrt((1.0 + e) / (1.0 - e))
        from_component = np.maximum(np.asarray(distance)[self.owner] - np.hypot(self.dx, self.dy), 0.0)
        light = self.fraction * sersic_brightness(self.sersic, from_component / major) / radius**2
        return np.add.reduceat(light, self.first[:-1]) if len(self) else np.zeros(0)

    def on_cells(self, cells: int) -> Galaxies:
        """Return the galaxies, whose transforms are exact on pixels of any size."""
        return self

    def transform(
        self, indices: Any, jacobian: np.ndarray, offset: np.ndarray, size: int, *, threads: int | None = None
    ) -> np.ndarray:
        """Compute the Fourier transforms of galaxies of unit flux on a pixel grid.

        With the galaxy's light I of unit flux on the sky, its transform at a frequency k [cycles/pixel] is

            FT(k) = I_sky(J^T k) exp(-2 pi i k . offset),  I_sky(q) = int I(theta) exp(-2 pi i q . theta) d^2 theta

        the exact transform, without pixels: those belong to the PSF. Multiply it by ``numpy.fft.rfft2`` of a PSF stamp
        centred on pixel ``size // 2`` along both axes: ``irfft2`` of the product is the image, with the galaxy at pixel
        ``size // 2 + offset``. Without PSF, ``fftshift`` of ``irfft2`` has it there.

        Parameters
        ----------
        indices : array of int, shape [k]
            Galaxies to transform; one may occur several times.
        jacobian : ndarray, shape [k, 2, 2]
            d(pixel x, y) / d(xi, eta) at each galaxy [pixel/rad].
        offset : ndarray, shape [k, 2]
            Position (x, y) of its centre from the middle pixel [pixel].
        size : int
            Pixels of a side of the grid.
        threads : int, optional
            Number of threads; the result does not depend on it.

        Returns
        -------
        ndarray of complex64, shape [k, size, size // 2 + 1]
            Frequencies (ky, kx) in the order of ``numpy.fft.rfft2``.

        Raises
        ------
        DomainError
            If an index is outside the galaxies, or shapes do not match.
        """
        selection, jacobian, offset = grid_arguments(len(self), indices, jacobian, offset, size)
        start_warp()
        table = sersic_table()
        drawn = self.take(selection)
        result = np.zeros((len(selection), size, size // 2 + 1), dtype=np.complex64)
        launch(
            transform_galaxies,
            len(selection),
            [
                warp_array(drawn.first, wp.int32),
                warp_array(np.stack([getattr(drawn, name) for name in _PER_COMPONENT], axis=1)),
                warp_array(jacobian, wp.mat22d),
                warp_array(offset, wp.vec2d),
                warp_array(table.values, wp.float32),
                wp.vec4(*table.log_index, *table.log_wave_number),
                size,
                wp.empty((len(selection), table.values.shape[1]), dtype=wp.float32, device="cpu"),
                warp_array(result, wp.vec2),
            ],
            threads=threads,
        )
        return result


def reduced_shear(g1: Any, g2: Any, count: int) -> np.ndarray:
    """Return g1 + i g2 of each galaxy, or raise DomainError for a modulus of 1 and more."""
    first, second = (for_each(pure_numbers(v, name), count, name) for name, v in (("g1", g1), ("g2", g2)))
    g = first + 1j * second
    if not np.all(np.abs(g) < 1.0):
        raise DomainError("g1, g2: expected a reduced shear below 1")
    return g


def grid_arguments(
    count: int, indices: Any, jacobian: Any, offset: Any, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the arguments of a transform as arrays, or raise DomainError where they do not belong together."""
    selection = np.asarray(indices)
    jacobian = np.asarray(jacobian, dtype=np.float64)
    offset = np.asarray(offset, dtype=np.float64)
    n = selection.size
    if selection.shape != (n,) or (
        n and not (selection.dtype.kind in "iu" and 0 <= selection.min() <= selection.max() < count)
    ):
        raise DomainError(f"indices: expected a list of integers from 0 to {count - 1}")
    if jacobian.shape != (n, 2, 2) or not np.all(np.isfinite(jacobian)):
        raise DomainError(f"jacobian: shape {jacobian.shape}, expected finite numbers of shape ({n}, 2, 2)")
    if offset.shape != (n, 2) or not np.all(np.isfinite(offset)):
        raise DomainError(f"offset: shape {offset.shape}, expected finite numbers of shape ({n}, 2)")
    if not (isinstance(size, int | np.integer) and size >= 1):
        raise DomainError(f"size = {size!r}: expected a positive number of pixels")
    # An empty list has no type.
    return selection.astype(np.int64), jacobian, offset
