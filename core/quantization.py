"""Values in steps, such as whole numbers: their step, and a dither that makes medians and modes of them unbiased."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Values by which a step is found: as many tell steps of a thousandth of the noise.
_MOST_VALUES = 1 << 16
# Values in steps are equal to so many others in the mean, those of photons and amplifiers to hardly any.
_LEAST_EQUAL = 4
# Largest deviation from whole steps, by rounding to single precision.
_ROUNDING = 0.02
# Part of the values at either end that does not count: bright stars are far apart.
_TAIL = 0.01
# Fractions of its multiples are spread evenly, also over parts of a row.
_GOLDEN_RATIO = 0.5 * (np.sqrt(5.0) - 1.0)


class Dithered(NamedTuple):
    """Values with a dither, and the step that it fills evenly; 0 of values that are in no steps, which are the same."""

    values: np.ndarray
    step: float

    def noise(self, rms: np.ndarray) -> np.ndarray:
        """Return the rms noise of the values before the dither, from that after it; at least that of their rounding."""
        of_rounding = self.step**2 / 12.0
        return np.sqrt(np.maximum(rms**2 - of_rounding, of_rounding)) if self.step else rms


def dithered(values: np.ndarray, unfit: NDArray[np.bool_]) -> Dithered:
    """Return values with an even dither of one step, where they are in steps.

    The median of whole numbers is one of them, up to half a step off, and modes by it are 2.5 times as far off. The
    dither is the same in every call.

    Parameters
    ----------
    values : array
        Pixels of any shape.
    unfit : array of bool
        Those that do not count, of the same shape.
    """
    every = values.size // _MOST_VALUES | 1  # odd: columns of an image are an even number
    step = _step_of(values.ravel()[::every][~unfit.ravel()[::every]])
    if not step:
        return Dithered(values, 0.0)
    fraction = np.arange(values.size) * _GOLDEN_RATIO % 1.0 - 0.5
    return Dithered(values + step * fraction.reshape(values.shape), step)


def _step_of(values: np.ndarray) -> float:
    """Return the step of values [n] that are whole multiples of it, but for an offset; 0 of others."""
    rising = np.sort(values)
    tail = int(_TAIL * len(rising))
    rising = rising[tail : len(rising) - tail]
    levels = rising[np.append(True, np.diff(rising) > 0.0)[: len(rising)]]
    if len(levels) < 2 or _LEAST_EQUAL * len(levels) > len(rising):
        return 0.0
    step = float(np.median(np.diff(levels)))
    steps = (levels - levels[0]) / step
    return step if float(np.abs(steps - np.rint(steps)).max()) < _ROUNDING else 0.0
