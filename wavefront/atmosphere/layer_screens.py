"""The phase screens of the layers of an atmosphere, each made once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import DomainError, unknown_name
from ...core.memory import require_bytes
from ...core.random_streams import stream
from ...core.units import plane_points
from .layers import Layers
from .screen_store import ScreenStore
from .screens import draw_modes, phase_screen, slope_screen, working_bytes
from .spline import evaluate
from .turbulence import slope_variance

#: Baseline of the slopes of the low screens [m]: a local gradient would deflect rays by modes of a metre more than the
#: image moves, which forms by interference over baselines of some tenths of a metre.
SLOPE_LAG = 0.2
# Larger screens, of 17 GB and more, would fill the memory.
_LARGEST_SIZE = 65536


@dataclass(frozen=True, eq=False, kw_only=True)
class LayerScreens(Layers):
    """Layers with their low and high screens; attributes as in :class:`.Atmosphere`."""

    r0: float
    outer_scale: float
    cutoff: float
    screen_size: int
    screen_length: float
    fine_size: int
    fine_pixel: float
    seed: int
    epoch: int
    fixed_modulus: bool = False
    store: ScreenStore = field(default_factory=ScreenStore, repr=False)

    @property
    def screen_pixel(self) -> float:
        """Distance of the samples of a low screen [m]."""
        return self.screen_length / self.screen_size

    @property
    def fine_length(self) -> float:
        """Side of a high screen [m]."""
        return self.fine_size * self.fine_pixel

    def __post_init__(self) -> None:
        grids = {
            "low": (self.screen_length, math.pi / self.screen_pixel),
            "high": (self.fine_length, math.pi / self.fine_pixel),
        }
        for scale, (length, nyquist) in grids.items():
            lowest = 2.0 * math.pi / length
            if not lowest < self.cutoff < nyquist:
                raise DomainError(
                    f"cutoff = {self.cutoff:.6g} rad/m: expected between the lowest mode and the Nyquist limit of the"
                    f" {scale} screens, {lowest:.4g} to {nyquist:.4g} rad/m"
                )
        # A store of other screens, as that of an atmosphere with another Fried parameter, is not shared.
        names = [name for name in LayerScreens.__annotations__ if name != "store"]
        key = (type(self), tuple(self.weights.tolist()), *(getattr(self, name) for name in names))
        if self.store.key != key:
            object.__setattr__(self, "store", ScreenStore(key))

    def _band(self, scale: str) -> tuple[int, float, tuple[float, float]]:
        """Return samples, side [m] and range of wavenumbers [rad/m] of the low or the high screens."""
        if scale == "high":
            return self.fine_size, self.fine_length, (self.cutoff, math.inf)
        return self.screen_size, self.screen_length, (0.0, self.cutoff)

    def screen_bytes(self, scales: Iterable[str], rows: np.ndarray | None = None) -> int:
        """Return the memory of the screens of some scales, and the working memory for the last of them [bytes].

        Of slopes only the ``rows`` count, bool [n_layer, screen_size], where they are given.
        """
        scales = tuple(scales)
        grids = [self._band(scale) for scale in scales]
        stored = sum(4 * self.layer_count * size * size for size, _, _ in grids)
        if rows is not None and "slopes" in scales:
            stored -= 4 * int((~rows).sum()) * self.screen_size
        return stored + max((working_bytes(*grid) for grid in grids), default=0)

    def low_screen(
        self, layer: int, stencil: str = "spline", *, threads: int | None = None, out: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the low screen of a layer: the modes at and below the cut-off.

        Parameters
        ----------
        layer : int
            Index of the layer.
        stencil : str
            Interpolation that the samples are made for, one of :data:`.STENCILS`; the modes are the same for all.
        threads : int, optional
            Number of threads; all processors by default. No byte depends on it.
        out : ndarray, optional
            Array for the screen.

        Returns
        -------
        ndarray of float32, shape [screen_size, screen_size]
            Path [m], ``[y, x]``.
        """
        return phase_screen(self._modes(layer, "low", stencil, threads), self.screen_size, threads=threads, out=out)

    def high_screen(
        self, layer: int, stencil: str = "spline", *, threads: int | None = None, out: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the high screen of a layer: the modes above the cut-off.

        Arguments are those of :meth:`low_screen`; the screen has shape [fine_size, fine_size].
        """
        return phase_screen(self._modes(layer, "high", stencil, threads), self.fine_size, threads=threads, out=out)

    def slope_unit(self, layer: int) -> float:
        """Return the slope of one count of :meth:`slope_screen` [rad]: eight standard deviations fill 15 bits."""
        variance = slope_variance(self.r0, self.outer_scale, self.cutoff, SLOPE_LAG) * float(self.weights[layer])
        return max(8.0 * math.sqrt(variance) / 32767.0, 1e-30)

    def slope_screen(
        self,
        layer: int,
        *,
        threads: int | None = None,
        out: np.ndarray | None = None,
        rows: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the slopes of the low screen of a layer over :data:`SLOPE_LAG`, in counts of :meth:`slope_unit`.

        The result is an int32 array of shape [screen_size, screen_size], packed as
        :func:`~pachon.wavefront.atmosphere.screens.slope_screen` does; the arguments are those of
        :meth:`low_screen`, and the rows to compute at least, bool [screen_size], all by default.
        """
        modes, size, length = self._modes(layer, "low", "samples", threads), self.screen_size, self.screen_length
        return slope_screen(
            modes, size, length, self.slope_unit(layer), lag=SLOPE_LAG, threads=threads, out=out, rows=rows
        )

    def _modes(self, layer: int, scale: str, stencil: str, threads: int | None = None) -> np.ndarray:
        """Draw the modes of one screen."""
        if not 0 <= layer < self.layer_count:
            raise DomainError(f"layer = {layer!r}: expected 0 to {self.layer_count - 1}")
        size, length, band = self._band(scale)
        return draw_modes(
            stream(self.seed, "atmosphere", self.epoch, layer, scale),
            size=size,
            length=length,
            r0=self.r0,
            outer_scale=self.outer_scale,
            band=band,
            weight=float(self.weights[layer]),
            stencil=stencil,
            fixed_modulus=self.fixed_modulus,
            threads=threads,
        )

    def screens(self, kind: str, threads: int | None = None, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the screens of all layers, not writable; made at the first call.

        Parameters
        ----------
        kind : {"slopes", "low", "high"}
            Packed slopes of the low screens, for rays; the low or the high screens as spline coefficients, for waves.
        threads : int, optional
            Number of threads; all processors by default. No byte depends on it.
        rows : ndarray of bool, shape [n_layer, screen_size], optional
            Rows of the slopes that are needed, all by default; the others may be unset. They are made when they are
            asked for first: a second call that lacks some makes all of them.

        Returns
        -------
        ndarray, shape [n_layer, size, size]

        Raises
        ------
        UnknownNameError
            If there is no such kind.
        DomainError
            If they need more memory than there is.
        """
        kinds: dict[str, tuple[Callable[..., np.ndarray], Any]] = {
            "slopes": (self.slope_screen, np.int32),
            "low": (self.low_screen, np.float32),
            "high": (self.high_screen, np.float32),
        }
        if kind not in kinds:
            raise unknown_name("kind", kind, tuple(kinds))
        make, dtype = kinds[kind]
        size = self._band(kind)[0]
        name = "fine_size" if kind == "high" else "screen_size"

        def allocate() -> np.ndarray:
            require_bytes(self.screen_bytes([kind], rows), f"{name} = {size} in {self.layer_count} layers")
            # Memory of rows that are never made is never touched.
            return np.empty((self.layer_count, size, size), dtype=dtype)

        return self.store.screens(
            self, kind, allocate, partial(make, threads=threads), rows if kind == "slopes" else None
        )

    def release(self) -> None:
        """Free the screens where no other atmosphere uses them; the next call makes the same ones again."""
        self.store.release(self)

    def path(self, x: ArrayLike, y: ArrayLike, layer: int, *, scale: str = "low") -> np.ndarray:
        """Return the path [m] through one screen at screen coordinates x, y [m], by plain NumPy; float64.

        The screen, ``"low"`` or ``"high"``, is made anew at every call: a reference for the engines, slow.
        """
        scales = {"low": (self.low_screen, self.screen_pixel), "high": (self.high_screen, self.fine_pixel)}
        if scale not in scales:
            raise unknown_name("scale", scale, tuple(scales))
        make, pixel = scales[scale]
        x, y = plane_points(x, y)
        return evaluate(make(layer), pixel, x, y)


def screen_samples(value: int, name: str) -> int:
    """Return the samples on a side of a screen, checked."""
    if not (isinstance(value, int | np.integer) and 4 <= value <= _LARGEST_SIZE):
        raise DomainError(f"{name} = {value!r}: expected a whole number of samples from 4 to {_LARGEST_SIZE}")
    return int(value)
