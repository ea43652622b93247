"""The points of a sweep, and views of them; nothing here draws."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from ..core.errors import ConfigError, DomainError, ProductError, error_context, unknown_name
from ..models.parameters.changes import parse_change
from ..models.parameters.degrees_of_freedom import unit_size
from ..pipeline.config import Configuration
from ..studies.sweep.analysis import curves, rank_correlations
from ..studies.sweep.point import point_configuration
from ..studies.sweep.store import SweepPoint, SweepStore
from ..studies.sweep.table import described_metric, described_parameter, read_table
from ..studies.sweep.telescope_point import has_no_camera, point_telescope, telescope_path
from .bench import Bench
from .state import DeskState

#: First bytes of a store.
_SQLITE = b"SQLite format 3\0"
#: Parameters of a point that a state has in other ways than as motions.
_OF_THE_MODEL = ("telescope", "band", "wavelengths_nm", "seed")


@dataclass(frozen=True)
class TornadoView:
    """Effects of the parameters on a metric, the largest last; arrays have shape [n]."""

    parameters: tuple[str, ...]
    low: np.ndarray  #: changes at values below nominal; NaN without one, or where `high` is a correlation
    high: np.ndarray  #: changes at values above nominal, or rank correlations
    ranges: tuple[str, ...]  #: of values, in words
    axis: str  #: what is drawn, with its unit


class PointsBench(ABC):
    """Points with parameters and metrics.

    Parameters
    ----------
    name : str
        Name of the study.
    number : ndarray of int, shape [n]
        Number of each point.
    parameters, metrics : dict of str to ndarray, shape [n]
        What varies, and what depends on it; NaN where there is none.
    """

    #: What the points are of, in titles.
    what: ClassVar[str]
    #: Whether points open as telescopes.
    opens = True

    def __init__(
        self, name: str, number: np.ndarray, parameters: dict[str, np.ndarray], metrics: dict[str, np.ndarray]
    ) -> None:
        self.name, self.number = name, number
        self.parameters, self.metrics = parameters, metrics

    @abstractmethod
    def label(self, name: str) -> str:
        """Return the name of a parameter or metric with its unit."""

    @abstractmethod
    def unit(self, metric: str) -> str:
        """Return the unit of a metric."""

    @abstractmethod
    def tornado(self, metric: str) -> TornadoView:
        """Return the effects of the parameters on a metric."""

    @abstractmethod
    def opened(self, number: int) -> tuple[Bench, DeskState]:
        """Return the telescope of a point and its state; PachonError where there is none."""

    def in_slice(self, parameter: str, low: float, high: float) -> list[int]:
        """Return the rows of the points whose parameter is within a range, both ends included."""
        values = self.parameters[parameter]
        rows: list[int] = np.flatnonzero((values >= low) & (values <= high)).tolist()
        return rows

    def numbers(self, metric: str, selected: Sequence[int]) -> dict[str, tuple[float, str]]:
        """Return the number of selected points, all where there are none, and the range of the metric."""
        rows = list(selected) or list(range(len(self.number)))
        values, unit = self.metrics[metric][rows], self.unit(metric)
        values = values[np.isfinite(values)]
        table = {"points selected" if selected else "points": (float(len(rows)), "")}
        if len(values):
            for name, reduce in (("least", np.min), ("median", np.median), ("largest", np.max)):
                table[f"{metric}, {name}"] = (float(reduce(values)), unit)
        return table


class SweepBench(PointsBench):
    """The computed points of a sweep."""

    what = "a sweep"

    def __init__(self, path: Path) -> None:
        self.path = path
        with SweepStore(path) as store:
            try:
                self.sweep = store.sweep
            except ConfigError:
                # Studies of tolerances keep theirs in the same place.
                raise ProductError("expected the store of a sweep, such as pachon sweep makes", file=path) from None
            self.table = read_table(store)
            # From which relative paths of telescopes start.
            self._folder = Path(store.about.get("folder", ""))
            self._points = {point.number: point for point in store.points()}
        if not len(self.table):
            raise ProductError("no point has been computed yet", file=path)
        metrics = {name: values for name, values in self.table.metrics.items() if np.isfinite(values).any()}
        if not metrics:
            raise ProductError("no metric: expected one point that could be computed", file=path)
        # Those that are numbers and vary.
        parameters: dict[str, np.ndarray] = {}
        for name, values in self.table.parameters.items():
            if all(v is None or (isinstance(v, int | float | np.number) and not isinstance(v, bool)) for v in values):
                numbers = np.array([np.nan if v is None else float(v) for v in values])
                if len(np.unique(numbers[np.isfinite(numbers)])) > 1:
                    parameters[name] = numbers
        super().__init__(self.table.name, self.table.number, parameters, metrics)

    def label(self, name: str) -> str:
        """Return the name of a parameter or metric with its unit."""
        if name in self.table.metrics:
            unit, ending = described_metric(name).unit, ""
        else:
            unit = described_parameter(name).unit
            ending = f"_{unit}"
        return f"{name.removesuffix(ending) if unit else name}" + (f" [{unit}]" if unit else "")

    def unit(self, metric: str) -> str:
        """Return the unit of a metric."""
        return str(described_metric(metric).unit or "")

    def tornado(self, metric: str) -> TornadoView:
        """Return the change of a metric by each parameter alone; rank correlations for other designs."""
        if metric not in self.metrics:
            raise unknown_name("metric", metric, self.metrics)
        alone = curves(self.table, self.sweep, metric) if self.sweep.design.kind == "one_at_a_time" else []
        if not alone:
            signs = {name: rho for name, (rho, _) in rank_correlations(self.table, metric).items()}
            names = sorted(signs, key=lambda name: abs(signs[name]))
            values = np.array([signs[name] for name in names])
            ranges = tuple(f"{np.nanmin(v):g} to {np.nanmax(v):g}" for v in (self.parameters[name] for name in names))
            return TornadoView(tuple(names), np.full(len(names), np.nan), values, ranges, "rank correlation")
        alone.sort(key=lambda curve: float(np.nanmax(np.abs(curve.change))))
        low, high = (
            np.array([_farthest(curve.change[sign * (curve.value - curve.nominal) > 0]) for curve in alone])
            for sign in (-1, 1)
        )
        ranges = tuple(f"{curve.value.min():g} to {curve.value.max():g}" for curve in alone)
        unit = self.unit(metric)
        axis = f"change of {metric} from nominal" + (f" [{unit}]" if unit else "")
        return TornadoView(tuple(curve.parameter for curve in alone), low, high, ranges, axis)

    def opened(self, number: int) -> tuple[Bench, DeskState]:
        """Return the telescope of a point and its state.

        DomainError where a parameter is none that the desk has: heights, stars or turbulence, or another quantity.
        """
        if number not in self._points:
            raise DomainError(f"point {number}: expected one of the sweep, 0 to {max(self._points)}")
        point = self._points[number]
        with error_context(subject=f"point {number}"):
            config = self._configuration(point)
            name = config.telescope or f"lsst_v3.3_{config.band or 'r'}"
            bench = Bench(telescope_path(name, self._folder))
            for parameter in point.parameters:
                if parameter not in _OF_THE_MODEL and parameter not in config.changes:
                    raise DomainError(f"{parameter}: expected parameters of the telescope alone")
            optics = dict(_control(bench, change, float(value)) for change, value in config.changes.items())
            state = replace(bench.start, optics=optics)
            if config.wavelengths_nm:
                state = replace(state, wavelength_nm=float(np.median(config.wavelengths_nm)))
            return bench, bench.check(state)

    def _configuration(self, point: SweepPoint) -> Configuration:
        if has_no_camera(self.sweep, point.parameters, self._folder):
            return point_telescope(self.sweep, point.parameters, self._folder)[1]
        return point_configuration(self.sweep, point.parameters, point.seed, self._folder)


def is_store(path: Path) -> bool:
    """Return whether a file begins like the store of a study."""
    try:
        with path.open("rb") as file:
            return file.read(len(_SQLITE)) == _SQLITE
    except OSError:
        return False


def _control(bench: Bench, name: str, value: float) -> tuple[str, float]:
    """Return the degree of freedom that a change is, and its value."""
    parameter, size = parse_change(bench.nominal, name)
    for member in bench.freedoms.members:
        if dict(member.of) == {parameter.address: 1.0}:
            return member.name, value * size / unit_size(member.unit)
    raise DomainError(f"{name}: expected a motion, radius or thickness that has a slider")


def _farthest(changes: np.ndarray) -> float:
    finite = changes[np.isfinite(changes)]
    return float(finite[np.argmax(np.abs(finite))]) if len(finite) else np.nan
