"""The telescopes drawn within tolerances, and views of them; nothing here draws."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import DomainError, ProductError
from ..core.files import parsing, read_bytes
from ..core.table_files import read_columns
from ..design.tolerancing.monte_carlo import MonteCarlo
from ..studies.tolerance.drawn import drawn_telescope
from ..studies.tolerance.product import STORE_FILE
from ..studies.tolerance.result import ToleranceStudy
from .bench import Bench
from .state import DeskState
from .sweep_views import PointsBench, TornadoView

#: Files of the folder that ``pachon tolerance`` writes.
_DRAWS, _SENSITIVITY, _SUMMARY = "draws.ecsv", "sensitivity.ecsv", "summary.json"
_COMPENSATOR = " (compensator)"


class ToleranceBench(PointsBench):
    """Drawn telescopes: the merit against each deviation, the costliest first, and the tolerances alone.

    Parameters
    ----------
    name : str
        Name of the telescope.
    columns : dict of str to ndarray, shape [n]
        Merit, deviations and compensators of the draws by their names.
    units : dict of str to str
        Their units.
    ends : dict of str to (float, float)
        Changes of the merit by each tolerance alone at minus and plus its size, the costliest first; without a
        sensitivity study, NaN and the rms contribution.
    folder : Path, optional
        Folder of the study, whose draws open as telescopes; a result alone holds no telescope.
    """

    what = "tolerances"

    def __init__(
        self,
        name: str,
        merit: str,
        columns: dict[str, np.ndarray],
        units: dict[str, str],
        ends: dict[str, tuple[float, float]],
        sizes: dict[str, str],
        axis: str,
        folder: Path | None = None,
    ) -> None:
        compensators = [key for key in columns if key.endswith(_COMPENSATOR)]
        super().__init__(
            name,
            np.arange(len(columns[merit])),
            {key: columns[key] for key in (*ends, *compensators)},
            {key: columns[key] for key in (merit, *compensators)},
        )
        self._units, self._ends, self._sizes, self._axis = units, ends, sizes, axis
        self._folder, self.opens = folder, folder is not None

    @classmethod
    def of(cls, drawn: MonteCarlo) -> ToleranceBench:
        """Return the bench of a result."""
        criterion = drawn.criterion
        scale, merit = criterion.scale, criterion.name
        columns = {merit: scale * drawn.merit}
        units = {merit: criterion.unit}
        for i, compensator in enumerate(drawn.compensators):
            columns[compensator + _COMPENSATOR] = drawn.moves[:, i]
            units[compensator + _COMPENSATOR] = drawn.compensator_units[i]
        for i, tolerance in enumerate(drawn.tolerances):
            columns[tolerance.name], units[tolerance.name] = drawn.deviations[:, i], drawn.units[i]
        names = [tolerance.name for tolerance in drawn.tolerances]
        if isinstance(drawn, ToleranceStudy):
            pairs = scale * (np.stack([drawn.lower, drawn.upper], axis=-1) - drawn.nominal)
            axis = f"change of {merit}, the tolerance alone"
            order = drawn.offenders
        else:
            pairs = scale * np.stack([np.full(len(names), np.nan), drawn.contribution], axis=-1)
            axis = f"rms contribution to {merit}"
            order = np.argsort(-drawn.contribution, kind="stable")
        ends = {names[i]: (float(pairs[i, 0]), float(pairs[i, 1])) for i in order}
        sizes = {t.name: _text(t.size, unit) for t, unit in zip(drawn.tolerances, drawn.units, strict=True)}
        return cls(drawn.telescope, merit, columns, units, ends, sizes, _with_unit(axis, criterion.unit))

    @classmethod
    def read(cls, folder: Path) -> ToleranceBench:
        """Read the folder that ``pachon tolerance`` wrote; ProductError where it is none, or not whole."""
        draws, sensitivity = (read_columns(folder / name) for name in (_DRAWS, _SENSITIVITY))
        path = folder / _SUMMARY
        with parsing(path, "damaged or no summary of tolerances", ProductError):
            summary: dict[str, Any] = json.loads(read_bytes(path, ProductError))
            merit, unit, nominal = str(summary["merit"]), str(summary["unit"]), float(summary["nominal"])
            name = str(summary["telescope"])
            # The reader makes all names of columns small.
            names = {str(key).lower(): str(key) for key in sensitivity["name"]}
            names |= {f"{key}{_COMPENSATOR}".lower(): f"{key}{_COMPENSATOR}" for key in summary["compensators"]}
            names["merit"] = merit
            columns = {names[key]: np.asarray(values, dtype=float) for key, values in draws.items()}
            units = {names[key]: str(getattr(values, "unit", None) or "") for key, values in draws.items()}
            order = np.argsort(-np.asarray(sensitivity["cost"], dtype=float), kind="stable")
            rows = [np.asarray(sensitivity[key])[order] for key in ("name", "lower_end", "upper_end", "size", "unit")]
            ends, sizes = {}, {}
            for key, low, high, size, size_unit in zip(*rows, strict=True):
                ends[str(key)] = (float(low) - nominal, float(high) - nominal)
                sizes[str(key)] = _text(float(size), str(size_unit))
        axis = _with_unit(f"change of {merit}, the tolerance alone", unit)
        return cls(name, merit, columns, units, ends, sizes, axis, folder)

    def opened(self, number: int) -> tuple[Bench, DeskState]:
        """Return the telescope of a draw, compensators set, and its state; sliders begin at zero there."""
        count = len(self.number)
        if self._folder is None or not 0 <= number < count:
            raise DomainError(f"draw {number}: expected one of the study, 0 to {count - 1}")
        values = {key.removesuffix(_COMPENSATOR): float(column[number]) for key, column in self.parameters.items()}
        name = f"{self.name}_draw_{number}"
        telescope, file = drawn_telescope(self._folder / STORE_FILE, values, name)
        bench = Bench(telescope)
        state = bench.start
        if file.wavelengths_nm:
            state = replace(state, wavelength_nm=float(np.median(file.wavelengths_nm)))
        return bench, bench.check(state)

    def unit(self, metric: str) -> str:
        """Return the unit of a number."""
        unit = self._units[metric]
        return "" if unit == "1" else unit

    def label(self, name: str) -> str:
        """Return the name of a number with its unit."""
        return _with_unit(name, self.unit(name))

    def tornado(self, metric: str) -> TornadoView:
        """Return what each tolerance alone does to the merit, the costliest last; the same for all numbers."""
        names = [*reversed(self._ends)]
        low, high = np.array([self._ends[key] for key in names]).reshape(-1, 2).T
        return TornadoView(tuple(names), low, high, tuple(self._sizes[key] for key in names), self._axis)


def is_tolerance_folder(folder: Path) -> bool:
    """Return whether a folder has the tables of ``pachon tolerance``."""
    return all((folder / name).is_file() for name in (_DRAWS, _SENSITIVITY))


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit and unit != "1" else name


def _text(size: float, unit: str) -> str:
    return f"± {size:.4g}" + (f" {unit}" if unit and unit != "1" else "")
