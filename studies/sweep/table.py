"""Table of a sweep, a row a point, and its export."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import Table

from ...core.arguments import check_arguments
from ...core.docstrings import Description
from ...core.errors import DomainError, ProductError, unknown_name
from ...core.number_text import counted
from ...core.plotting import BLUE, figure_at, plain_text, styled
from ...core.products import Columns, described_table
from ...core.result import Result
from ...core.schema import key_description
from ...core.table_files import write_table
from ...models.parameters.changes import ANGLES, LENGTHS
from ...pipeline.config import Configuration
from ..metrics.stars import STARS
from ..metrics.telescope import TELESCOPE_METRICS
from .store import SweepStore, readable_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Panels of a picture, at most.
_PANELS = 6
#: Motions in names of parameters.
_CHANGES = {
    **{f"d{axis}": f"shift along {axis}" for axis in "xyz"},
    **{f"r{axis}": f"tilt about {axis}" for axis in "xyz"},
}
_UNITS = (*LENGTHS, *ANGLES, "s")


@dataclass(frozen=True)
class SweepTable(Result):
    """Parameters and metrics of the computed points.

    Attributes
    ----------
    name : str
        Name of the sweep.
    number, seed : ndarray of int, shape [n]
        Number of each point and the seed of its random numbers.
    parameters : dict of str to ndarray, shape [n]
        Values of each parameter.
    metrics : dict of str to ndarray, shape [n]
        Metrics; NaN where a point could not be computed.
    problem : ndarray of str, shape [n]
        Reason why a point could not be computed; else empty.
    seconds : ndarray, shape [n]
        Time of each computation.
    """

    name: str
    number: np.ndarray
    seed: np.ndarray
    parameters: dict[str, np.ndarray]
    metrics: dict[str, np.ndarray]
    problem: np.ndarray
    seconds: np.ndarray

    def plot(self, metric: str | None = None, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw a metric, the first by default, against each of the first six parameters."""
        if metric is None:
            metric = next(iter(self.metrics), None)
        if metric not in self.metrics:
            raise DomainError("no metric") if metric is None else unknown_name("metric", metric, self.metrics)
        names = list(self.parameters)[:_PANELS]
        with styled():
            figure = figure_at(ax, 2.8 * max(len(names), 1) + 0.6, 3.0)
            panels = figure.subplots(1, max(len(names), 1), sharey=True, squeeze=False)[0]
            for axes, name in zip(panels, names, strict=False):
                axes.plot(self.parameters[name], self.metrics[metric], ".", color=BLUE, markersize=4)
                axes.set_xlabel(plain_text(name))
            panels[0].set_ylabel(plain_text(metric))
            return figure

    def __len__(self) -> int:
        return len(self.number)

    def _label(self) -> str:
        counts = {"point": len(self), "parameter": len(self.parameters), "metric": len(self.metrics)}
        return ", ".join([self.name, *(counted(number, noun) for noun, number in counts.items())])

    def _columns(self) -> dict[str, Any]:
        return {name: values for name, (values, _, _) in _columns(self).items()}

    def _described(self, name: str) -> Description:
        return Description(*_columns(self)[name][1:])


@check_arguments
def load_sweep_table(path: str | os.PathLike[str]) -> SweepTable:
    """Read the results of a sweep from the file that ``pachon sweep`` or :func:`~pachon.run_sweep` wrote.

    Raises
    ------
    ProductError
        If it is no store of a sweep, or damaged.
    """
    with SweepStore(Path(path)) as store:
        return read_table(store)


def read_table(store: SweepStore) -> SweepTable:
    """Return the table of a store, in the order of the points."""
    with store.sqlite_errors():
        points = {p.number: p for p in store.points()}
        results = store.results()
        rows = [points[r.number] for r in results]
        names = list(dict.fromkeys(name for p in points.values() for name in p.parameters))
        measured = [r.metrics or {} for r in results]
        metrics = list(dict.fromkeys(name for m in measured for name in m))
        order = list(store.sweep.parameters) or names
        names.sort(key=lambda n: order.index(n) if n in order else len(order))
        return SweepTable(
            name=store.sweep.name,
            number=np.array([r.number for r in results], dtype=np.int64),
            seed=np.array([p.seed for p in rows], dtype=np.int64),
            parameters={n: np.array([p.parameters.get(n) for p in rows]) for n in names},
            metrics={
                n: np.array([(r.metrics or {}).get(n, np.nan) for r in results], dtype=np.float64) for n in metrics
            },
            problem=np.array([r.problem or "" for r in results], dtype=str),
            seconds=np.array([r.seconds for r in results], dtype=np.float64),
        )


def export_table(store: SweepStore, path: Path) -> int:
    """Write the points of a store as ECSV, CSV, FITS or Parquet (with ``pyarrow``), and return their number."""
    table = read_table(store)
    if not len(table):
        raise ProductError(f"{store.path}: no point has been computed yet")
    meta = {"what": f"sweep {table.name}", "pachon": store.about["pachon"], "digest": store.about["digest"]}
    write_table(path, described_table(_columns(table), meta))
    return len(table)


def salvage(path: Path, out: Path) -> int:
    """Write the readable points of a damaged store as a table, and return their number."""
    rows = [
        ({"number": number}, json.loads(parameters), json.loads(metrics or "{}"))
        for number, parameters, metrics in readable_rows(path)
    ]
    if not rows:
        raise ProductError("nothing can be read of it; was it a store of a sweep?", file=path)
    table = Table(meta={"what": f"saved from {path.name}"})
    for pass_number in range(3):
        for name in dict.fromkeys(name for row in rows for name in row[pass_number]):
            values = [row[pass_number].get(name) for row in rows]
            table[name] = [np.nan if v is None else v for v in values]
    write_table(out, table)
    return len(rows)


def _columns(table: SweepTable) -> Columns:
    columns: Columns = {
        "number": (table.number, "", "number of the point"),
        "seed": (table.seed, "", "seed of its random numbers"),
    }
    columns |= {name: (_plain_column(values), *described_parameter(name)) for name, values in table.parameters.items()}
    columns |= {name: (values, *described_metric(name)) for name, values in table.metrics.items()}
    columns["problem"] = (table.problem, "", "reason why it could not be computed")
    columns["seconds"] = (table.seconds, "s", "time of the computation")
    return columns


def described_metric(name: str) -> Description:
    """Return unit and definition of a metric of a sweep."""
    metric = STARS.metric(name) or TELESCOPE_METRICS.metric(name)
    if metric is not None:
        return Description(metric.unit, metric.meaning)
    text = "motion of the compensator" if is_compensator(name) else "metric of another version of pachon"
    return Description(_unit(name), text)


def is_compensator(metric: str) -> bool:
    """Return whether a metric of a sweep is the motion of a compensator."""
    return metric.startswith("solved ")


def described_parameter(name: str) -> Description:
    """Return unit and definition of a parameter of a sweep."""
    text = key_description(Configuration, name)
    if not text:
        # The address of a value of the prescription, or the motion of a part of the camera.
        body, _, quantity = name.rpartition(".")
        motion, unit = quantity.removesuffix(f"_{_unit(name)}"), _unit(name)
        text = f"change of {body}: {_CHANGES[motion]}" if motion in _CHANGES else f"change of {motion} of {body}"
        return Description(unit, text)
    return Description(_unit(name), text)


def _plain_column(values: np.ndarray) -> np.ndarray:
    """Return a column as numbers or as text; parameters without a value at a point become NaN or empty."""
    if values.dtype.kind != "O":
        return values
    if any(isinstance(v, str) for v in values):
        return np.array(["" if v is None else str(v) for v in values])
    return np.array([np.nan if v is None else float(v) for v in values])


def _unit(name: str) -> str:
    ending = name.rpartition("_")[2]
    return ending if "_" in name and ending in _UNITS else ""
