"""Designs of sweeps: one parameter at a time, grids, random points, or a table."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from scipy.stats import norm, qmc

from ...core.errors import ConfigError
from ...core.files import parsing, read_bytes, text_lines
from ...core.random_streams import stream
from .file import ODD_KEYS, Design, Point, SweepFile, SweptParameter, whole_keys

# Half the width of a normal distribution on a grid, in standard deviations.
_SIGMAS = 2.0


def design_points(sweep: SweepFile) -> list[Point]:
    """Return the points of a sweep in the order of their numbers.

    One at a time, the first point is nominal, and each other point differs from it in one parameter. Marks are among
    the values of a parameter; for each mark one more point has all parameters at their values of it. A random design
    covers the unit cube, mapped through the distribution of each parameter: uniform over a range or a list, or by
    quantiles of a normal distribution. Latin hypercube and Sobol points are SciPy's (``scipy.stats.qmc``), scrambled by
    the seed. Keys of whole numbers, such as psf.stamp, have these only.
    """
    return [_with_whole_numbers(point) for point in _points_of_design(sweep)]


def _points_of_design(sweep: SweepFile) -> list[Point]:
    design = sweep.design
    if design.kind == "table":
        return _from_table(Path(design.file or ""))
    names = list(sweep.parameters)
    if design.kind == "one_at_a_time":
        return _one_at_a_time(sweep)
    if design.kind == "grid":
        levels = [_parameter_values(name, p, design) for name, p in sweep.parameters.items()]
        return [dict(zip(names, values, strict=True)) for values in itertools.product(*levels)]
    cube = _unit_cube(design, len(names))
    columns = [_quantiles(name, p, u) for (name, p), u in zip(sweep.parameters.items(), cube.T, strict=True)]
    return [dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)]


def point_count(sweep: SweepFile) -> int:
    """Return the number of points of a sweep without making them: a grid can exceed the memory."""
    design = sweep.design
    if design.kind == "grid":
        count = 1
        for name, parameter in sweep.parameters.items():
            if parameter.values is not None:
                count *= len(parameter.values)
            else:
                count *= int(min(parameter.points or design.points, _whole_count(name, *_ends(parameter))))
        return count
    if design.kind in ("one_at_a_time", "table"):
        return len(design_points(sweep))
    return design.points


def _one_at_a_time(sweep: SweepFile) -> list[Point]:
    parameters = sweep.parameters
    nominal = {name: p.nominal for name, p in parameters.items()}
    points = [nominal]
    for name, parameter in parameters.items():
        levels = _parameter_values(name, parameter, sweep.design)
        extra = [v for v in parameter.marks.values() if v not in levels]
        values = [*levels, *dict.fromkeys(extra)]
        if extra:
            values.sort()
        points += [{**nominal, name: value} for value in values if value != parameter.nominal]
    for mark in dict.fromkeys(mark for p in parameters.values() for mark in p.marks):
        marked = {name: p.marks[mark] for name, p in parameters.items() if mark in p.marks}
        if len(marked) > 1:
            points.append({**nominal, **marked})
    return points


def _with_whole_numbers(point: Point) -> Point:
    """Return a point with whole numbers as such: a table, a mark or a nominal value may have 3.0."""
    numbers = {name: v for name, v in point.items() if name in whole_keys() and isinstance(v, float) and v % 1 == 0}
    return {**point, **{name: int(v) for name, v in numbers.items()}}


def _parameter_values(name: str, parameter: SweptParameter, design: Design) -> list[Any]:
    """Return the values of one parameter on a grid or one at a time."""
    count = parameter.points or design.points
    if parameter.values is not None:
        return list(parameter.values)
    low, high = _ends(parameter)
    if count == 1 and parameter.range is not None:
        return [high]
    if count >= _whole_count(name, low, high):
        return list(range(_rounded(name, low), _rounded(name, high) + 1, _step(name)))
    levels = [float(v) for v in np.linspace(low, high, count)]
    return levels if name not in whole_keys() else list(dict.fromkeys(_rounded(name, v) for v in levels))


def _ends(parameter: SweptParameter) -> tuple[float, float]:
    """Return the lowest and the highest value of a range, or of a normal distribution on a grid."""
    if parameter.range is not None:
        return parameter.range
    mean, sigma = parameter.normal or (0.0, 0.0)
    return mean - _SIGMAS * sigma, mean + _SIGMAS * sigma


def _whole_count(name: str, low: float, high: float) -> float:
    """Return how many whole numbers a parameter of them has between two values; of others without end."""
    if name not in whole_keys():
        return math.inf
    return (_rounded(name, high) - _rounded(name, low)) // _step(name) + 1


def _rounded(name: str, value: float) -> int:
    """Return the nearest value of a key of whole numbers; between two the one above, so that equal steps stay equal."""
    return 2 * math.floor(0.5 * value) + 1 if name in ODD_KEYS else math.floor(value + 0.5)


def _step(name: str) -> int:
    """Return the distance of two values of a key of whole numbers."""
    return 2 if name in ODD_KEYS else 1


def _unit_cube(design: Design, dimensions: int) -> np.ndarray:
    """Return points of the open unit cube, [points, dimensions]."""
    rng = stream(design.seed, "sweep", design.kind)
    if design.kind == "monte_carlo":
        # One row for each point: more points do not change the first ones.
        cube = rng.random((design.points, dimensions))
    elif design.kind == "latin_hypercube":
        cube = qmc.LatinHypercube(dimensions, rng=rng).random(design.points)
    else:
        # Sobol sets are balanced in powers of two; these are the first points of one.
        power = int(np.ceil(np.log2(max(design.points, 1))))
        cube = qmc.Sobol(dimensions, rng=rng).random_base2(power)[: design.points]
    return np.clip(cube, 1e-12, 1.0 - 1e-12)


def _quantiles(name: str, parameter: SweptParameter, u: np.ndarray) -> list[Any]:
    """Return the values of one parameter at points of the unit interval."""
    if parameter.values is not None:
        return [parameter.values[int(v * len(parameter.values))] for v in u]
    if parameter.range is not None:
        low, high = parameter.range
        if name in whole_keys():
            # Both ends are as likely as the others.
            count, step = _whole_count(name, low, high), _step(name)
            return [min(int(low) + step * math.floor(count * v), int(high)) for v in u]
        return [float(v) for v in low + (high - low) * u]
    mean, sigma = parameter.normal or (0.0, 0.0)
    values = [float(v) for v in mean + sigma * norm.ppf(u)]
    return values if name not in whole_keys() else [_rounded(name, v) for v in values]


def _from_table(path: Path) -> list[Point]:
    """Return the rows of an ECSV table as points."""
    data = read_bytes(path, ConfigError)
    with parsing(path, "no ECSV table", ConfigError):
        table = Table.read(text_lines(data.decode()), format="ascii.ecsv")
    if not len(table):
        raise ConfigError("no rows; expected at least one point", file=path)
    points = []
    for number, row in enumerate(table):
        point = {name: row[name].item() if hasattr(row[name], "item") else row[name] for name in table.colnames}
        for name, value in point.items():
            if np.ma.is_masked(row[name]) or (isinstance(value, float) and not np.isfinite(value)):
                raise ConfigError(f"row {number}, {name} = {row[name]}: expected a value", file=path)
        points.append(point)
    return points
