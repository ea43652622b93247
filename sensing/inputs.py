"""Arguments of the fit of donuts, checked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import DomainError, shown
from ..core.units import length, pure_numbers, radians, require_positive
from ..raytrace.rays import Projection, field_direction

#: Largest spread or wavefront [m].
_MOST_LENGTH = 1e-3
#: Light of a pixel from which on it is no number that a detector counts [electron].
MOST_ELECTRONS = 1e20
#: Least side of a stamp [pixels].
SMALLEST_STAMP = 8


@dataclass(frozen=True)
class ObservedStar:
    """Stamp of one star: image and variance of the sky, masked pixels, field angles [2], direction of the light [3].

    Without a known noise the variance is zero, and to be measured.
    """

    image: np.ndarray
    variance: np.ndarray
    masked: np.ndarray
    field: np.ndarray
    direction: np.ndarray
    known_noise: bool


@dataclass(frozen=True)
class ObservedStars:
    """Stamps of stars and their places in the field.

    Attributes
    ----------
    images : ndarray, shape [n, ny, nx]
        Electrons, sky subtracted; NaN beside smaller stamps.
    variance : ndarray, shape [n, ny, nx]
        Variance of sky and readout [electron^2].
    masked : ndarray of bool, shape [n, ny, nx]
        Pixels to leave out.
    shapes : list of tuple of int
        Pixels (ny, nx) of each stamp.
    fields : ndarray, shape [n, 2]
        Field angles [rad].
    directions : ndarray, shape [n, 3]
        Unit vectors along which the light travels.
    projection : str
        Meaning of the field angles.
    known_noise : bool
        Whether the variance of sky and readout is given, and images are electrons.
    """

    images: np.ndarray
    variance: np.ndarray
    masked: np.ndarray
    shapes: list[tuple[int, int]]
    fields: np.ndarray
    directions: np.ndarray
    projection: Projection
    known_noise: bool

    @classmethod
    def of(
        cls,
        images: ArrayLike | Sequence[ArrayLike],
        fields: ArrayLike,
        sky_variance: ArrayLike | None,
        mask: NDArray[np.bool_] | Sequence[NDArray[np.bool_]] | None,
        projection: Projection,
    ) -> ObservedStars:
        """Return the arguments of a fit as arrays, or raise DomainError for one that is malformed."""
        stack, shapes = padded(images, "images", np.float64, np.nan)
        angles = np.atleast_2d(radians(fields, "fields"))
        if angles.shape != (len(stack), 2) or not np.isfinite(angles).all():
            expected = f"finite angles of {len(stack)} images, shape [{len(stack)}, 2]"
            raise DomainError(f"fields of shape {angles.shape}: expected {expected}")
        directions = field_direction(angles[:, 0], angles[:, 1], projection)
        masked = np.zeros(stack.shape, dtype=bool)
        if mask is not None:
            masked, mask_shapes = padded(mask, "mask", bool, True)
            if mask_shapes != shapes:
                expected = f"those of the images, {stack.shape}"
                raise DomainError(f"mask of shape {masked.shape}: expected {expected}", key="mask")
        variance = sky_variances(0.0 if sky_variance is None else sky_variance, stack.shape)
        return cls(stack, variance, masked, shapes, angles, directions, projection, sky_variance is not None)

    def __len__(self) -> int:
        return len(self.images)

    def star(self, index: int) -> ObservedStar:
        """Return one star, without what stands beside its stamp."""
        ny, nx = self.shapes[index]
        image, variance, masked = (v[index, :ny, :nx] for v in (self.images, self.variance, self.masked))
        return ObservedStar(image, variance, masked, self.fields[index], self.directions[index], self.known_noise)


def padded(
    values: ArrayLike | Sequence[ArrayLike], name: str, kind: type, fill: float | bool
) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Return images as one stack, smaller ones filled up at the end, and their shapes."""
    try:
        sequence: Any = values
        read = _numbers if kind is np.float64 else lambda stamp, _: np.asarray(stamp, dtype=kind)
        listed: list[np.ndarray] = [read(stamp, name) for stamp in sequence]
    except DomainError:
        raise
    except (TypeError, ValueError):
        raise DomainError(f"{name}: expected an array of shape [n, ny, nx], or n arrays of two dimensions") from None
    if not listed or any(v.ndim != 2 or min(v.shape) < SMALLEST_STAMP for v in listed):
        shape = [v.shape for v in listed][:1]
        raise DomainError(
            f"{name} of shape {shape}: expected [n, ny, nx], stamps of at least {SMALLEST_STAMP} pixels a side"
        )
    shapes = [(int(v.shape[0]), int(v.shape[1])) for v in listed]
    stack: np.ndarray = np.full((len(listed), max(s[0] for s in shapes), max(s[1] for s in shapes)), fill, dtype=kind)
    for row, stamp in zip(stack, listed, strict=True):
        row[: stamp.shape[0], : stamp.shape[1]] = stamp
    return stack, shapes


def _numbers(values: ArrayLike, name: str) -> np.ndarray:
    """Return numbers without a unit; those that no detector counts are not finite."""
    numbers = pure_numbers(values, name)
    return np.where(np.abs(numbers) < MOST_ELECTRONS, numbers, np.nan)


def noll_indices(values: Iterable[int], name: str, least: int) -> np.ndarray:
    """Return Noll indices as an array, or raise DomainError."""
    listed = list(values)
    if not listed or any(int(j) != j or j < least for j in listed) or len(set(listed)) != len(listed):
        raise DomainError(f"{name} = {listed}: expected different Noll indices from {least}")
    return np.array(listed, dtype=np.int64)


def one_for_each(values: np.ndarray, count: int, name: str) -> np.ndarray:
    """Return one finite number for each image."""
    if values.shape not in ((), (count,)) or not np.isfinite(values).all():
        raise DomainError(f"{name} of shape {values.shape}: expected one finite number, or {count}")
    return np.broadcast_to(values, (count,))


def sky_variances(values: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Return the variance of sky and readout of every pixel."""
    variance = pure_numbers(values, "sky_variance")
    variance = variance[:, None, None] if variance.ndim == 1 else variance
    try:
        variance = np.broadcast_to(variance, shape)
    except ValueError:
        raise DomainError(f"sky_variance of shape {np.shape(values)}: expected a number, [n] or {shape}") from None
    if not (np.isfinite(variance) & (variance >= 0.0)).all():
        raise DomainError("sky_variance: expected finite numbers from 0 [electron^2]")
    return variance


def small_length(value: ArrayLike, name: str) -> float:
    """Return a length [m] of zero or more, and less than would leave the detector."""
    size = length(value, name)
    if not 0.0 <= size <= _MOST_LENGTH:
        raise DomainError(f"{name} = {shown(value)}: expected a length from 0 to {_MOST_LENGTH:g} m")
    return size


def outer_scale_of(value: float) -> float:
    """Return an outer scale [m] above 0, which may be infinite."""
    return float("inf") if value == float("inf") else require_positive(value, "outer_scale", "metres")
