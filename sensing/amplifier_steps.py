"""Steps of the sky and of the gain across a donut, where two amplifiers of a CCD meet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from astropy import units as u
from astropy.table import QTable

_MEANINGS = {
    "donut": "number of the donut, from 0",
    "between": "columns or rows of the stamp",
    "first": "first column or row beyond the step, from 0",
    "sky": "light added from there on",
    "gain": "relative change of the light from there on",
}


@dataclass(frozen=True)
class AmplifierStep:
    """Step between two columns or two rows of a stamp.

    Attributes
    ----------
    axis : int
        Axis of the image across it: 1 between columns, 0 between rows.
    first : int
        First column or row beyond it, from 0.
    sizes, errors : tuple of float
        Light of the sky that is added from there on [units of the image], and relative change of the gain, with their
        standard deviations: zero for what is not fitted.
    """

    axis: int
    first: int
    sizes: tuple[float, float] = (0.0, 0.0)
    errors: tuple[float, float] = (0.0, 0.0)

    def changed(self, kind: int, amplitude: float, error: float) -> AmplifierStep:
        """Return the same with more of a kind, sky (0) or gain (1), and its standard deviation."""
        sizes, errors = list(self.sizes), list(self.errors)
        sizes[kind] += amplitude
        errors[kind] = error
        return replace(self, sizes=(sizes[0], sizes[1]), errors=(errors[0], errors[1]))

    def without_chance(self, limit: float) -> AmplifierStep:
        """Return the same without a kind of fewer standard deviations than a limit, but for the surer one."""
        ratios = [abs(size) / error if error else 0.0 for size, error in zip(self.sizes, self.errors, strict=True)]
        sky, gain = (float(ratio >= min(limit, max(ratios))) for ratio in ratios)
        sizes, errors = ((sky * of_sky, gain * of_gain) for of_sky, of_gain in (self.sizes, self.errors))
        return replace(self, sizes=sizes, errors=errors)

    def beyond(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return 1 at the columns or rows of a stamp from the step on, else 0, of its shape but across the step."""
        from_there = np.arange(shape[self.axis]) >= self.first
        return np.expand_dims(from_there.astype(np.float64), 1 - self.axis)

    def put_on(self, image: np.ndarray, level: float) -> np.ndarray:
        """Return an image with the step, whose gain multiplies light above a level."""
        sky, gain = self.sizes
        return np.asarray(image + self.beyond(image.shape) * (sky + gain * (image - level)))

    def taken_off(self, image: np.ndarray, level: float) -> np.ndarray:
        """Return an image without the step; see :meth:`put_on`."""
        sky, gain = self.sizes
        beyond = self.beyond(image.shape)
        return np.asarray(level + (image - level - beyond * sky) / (1.0 + beyond * gain))

    def within(self, middle: tuple[slice, slice], unit: float) -> AmplifierStep:
        """Return the same on the middle of the stamp, in an image over a unit."""
        sizes, errors = ((sky / unit, gain) for sky, gain in (self.sizes, self.errors))
        return AmplifierStep(self.axis, self.first - middle[self.axis].start, sizes, errors)

    def around(self, middle: tuple[slice, slice], unit: float) -> AmplifierStep:
        """Return the same on the stamp of which this one's is the middle; the reverse of :meth:`within`."""
        sizes, errors = ((unit * sky, gain) for sky, gain in (self.sizes, self.errors))
        return AmplifierStep(self.axis, self.first + middle[self.axis].start, sizes, errors)


@dataclass(frozen=True)
class StepFit:
    """Steps of a stamp and what their errors make.

    Attributes
    ----------
    steps : tuple of AmplifierStep
        The steps, in pixels and unit of the stamp that was fitted.
    change : float
        Largest change of an amplitude by the last fit, over its standard deviation.
    covariance : ndarray, shape [n, n]
        Covariance of the unknowns by the errors of the amplitudes.
    """

    steps: tuple[AmplifierStep, ...]
    change: float
    covariance: np.ndarray


def step_table(steps: Mapping[int, Sequence[AmplifierStep]]) -> QTable:
    """Return the table of the steps of donuts, by the number of the donut."""
    rows = [(donut, step) for donut, of_donut in steps.items() for step in of_donut]
    table = QTable()
    table["donut"] = np.array([donut for donut, _ in rows], dtype=np.int64)
    table["between"] = np.array(["columns" if step.axis else "rows" for _, step in rows], dtype=str)
    table["first"] = np.array([step.first for _, step in rows], dtype=np.int64)
    for kind, (name, unit) in enumerate((("sky", u.electron / u.pix), ("gain", u.dimensionless_unscaled))):
        table[name] = np.array([step.sizes[kind] for _, step in rows]) * unit
        table[f"{name}_err"] = np.array([step.errors[kind] for _, step in rows]) * unit
    for column in table.colnames:
        meaning = _MEANINGS[column.removesuffix("_err")]
        table[column].info.description = f"standard error of {column[:-4]}" if column.endswith("_err") else meaning
    return table


def step_words(table: QTable) -> list[str]:
    """Return what each row of a table of steps says, in words."""
    words = []
    for row in table:
        place = f"donut {row['donut']}, {row['between'][:-1]} {row['first']}"
        sizes = [
            f"{name} {row[name].to_value(unit):+.3g} +- {row[name + '_err'].to_value(unit):.2g} {symbol}"
            for name, unit, symbol in (("sky", u.electron / u.pix, "e"), ("gain", u.percent, "%"))
            if row[f"{name}_err"] > 0.0
        ]
        words.append(f"{place}: {', '.join(sizes)}")
    return words
