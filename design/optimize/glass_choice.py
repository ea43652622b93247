"""Choice of glasses: index and Abbe number as variables first, then glasses of a catalogue in their place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, PachonError, check_unique, unknown_name
from ...core.result import Result
from ...core.units import require_count
from ...models.io.glass_catalogue import GlassCatalogue
from ...models.media.medium import LINE_D, Medium, abbe_number
from ...models.parameters.parameters import Parameter
from ...models.telescope import VACUUM, Telescope
from .configuration import DesignConfiguration, configurations
from .merit_function import MeritFunction, MeritName
from .operand import Operand
from .optimize import optimize
from .optimum import Optimum
from .solver import LeastSquares

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: End of the name of a glass while its index and Abbe number are variables.
_MODEL = " (model)"


@dataclass(frozen=True)
class GlassTrial:
    """A glass of the catalogue that was tried.

    Attributes
    ----------
    glass : str
        Glass of the telescope in whose place it was.
    name : str
        Glass of the catalogue.
    rms : float
        Rms of merit and operands with it [m]; infinite where no light arrives.
    """

    glass: str
    name: str
    rms: float


@dataclass(frozen=True)
class GlassChoice(Result):
    """Telescope with glasses from a catalogue.

    Attributes
    ----------
    optimum : Optimum
        The optimum with the chosen glasses, from the telescope as it was.
    model : Optimum
        The optimum over indices and Abbe numbers, a limit for the glasses.
    glasses : dict of str to str
        Chosen glass of the catalogue for each glass.
    trials : tuple of GlassTrial
        All glasses that were tried.
    """

    _row_type = GlassTrial

    optimum: Optimum
    model: Optimum
    glasses: dict[str, str]
    trials: tuple[GlassTrial, ...]

    def _columns(self) -> dict[str, Any]:
        return {name: [getattr(t, name) for t in self.trials] for name in ("glass", "name", "rms")}

    def _label(self) -> str:
        replacements = ", ".join(f"{model_name} -> {glass_name}" for model_name, glass_name in self.glasses.items())
        return f"{replacements or 'no glasses'}; {len(self.trials)} tried"

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the optimum; see :meth:`Optimum.plot`."""
        return self.optimum.plot(ax)

    def _summary(self) -> dict[str, Any]:
        trials = [{"glass": t.glass, "name": t.name, "rms_m": t.rms} for t in self.trials]
        model = {"rms_of_model_glasses_m": self.model.history[-1]}
        return {**self.optimum.summary(), "glasses": self.glasses, **model, "glass_trials": trials}


class GlassOptions(TypedDict, total=False):
    """Further arguments of :func:`choose_glasses`, those of :func:`~.optimize.optimize`."""

    fields: ArrayLike | None
    wavelengths: ArrayLike | None
    bounds: Mapping[str, tuple[float, float]] | None
    targets: Sequence[Operand]
    n_pupil: int | None
    solver: LeastSquares | None
    threads: int | None


@check_arguments
def choose_glasses(
    telescope: Telescope | DesignConfiguration,
    variables: Iterable[str | Parameter],
    glasses: Iterable[str],
    merit: MeritName | MeritFunction = "spots",
    *,
    catalogue: GlassCatalogue | None = None,
    nearest: int = 4,
    **options: Unpack[GlassOptions],
) -> GlassChoice:
    """Optimise a telescope together with its glasses.

    Index and Abbe number of each glass are variables first. Then, glass by glass, the nearest of the catalogue take its
    place, all variables are optimised again with each, and the best one stays. Near means a small change of the power
    ``n - 1`` and of the dispersion ``1 / V``, both relative. The telescope's own glasses, if the catalogue has them,
    stay where none of the others is better.

    Parameters
    ----------
    telescope, merit, options
        As in :func:`~.optimize.optimize`, for one telescope.
    variables : iterable of str or Parameter
        Free parameters beside the glasses.
    glasses : iterable of str
        Names of the media to choose.
    catalogue : GlassCatalogue, optional
        Glasses to choose from; the bundled ones by default. In a telescope whose space has index 1, indices are those
        relative to air; else those against vacuum.
    nearest : int
        Number of glasses that are tried for each.

    Raises
    ------
    UnknownNameError
        If the telescope has no medium of a name.
    ConfigError
        If no glass is named, or one twice, or there is one wavelength alone.
    PachonError
        As :func:`~.optimize.optimize`.
    """
    state = DesignConfiguration(telescope) if isinstance(telescope, Telescope) else telescope
    telescope = state.telescope
    names, fixed = list(glasses), list(variables)
    source = GlassCatalogue.bundled() if catalogue is None else catalogue
    require_count(nearest, "nearest", 1)
    check_unique("glass", names)
    if not names:
        raise ConfigError("glasses = []: expected at least one medium of the telescope")
    medium_names = {s.medium_after.name for s in telescope.surfaces if s.medium_after.name}
    for name in names:
        if name not in medium_names:
            raise unknown_name(f"medium of {telescope.name}", name, sorted(medium_names))
    (configuration,) = configurations(state, options.get("fields"), options.get("wavelengths"), options.get("n_pupil"))
    if len(configuration.beams(telescope, options.get("threads")).request.wavelengths) < 2:
        raise ConfigError("wavelengths: expected several, as glasses are chosen by their dispersion too")
    free = telescope
    for name in names:
        free = _with_medium(free, name, _medium_of(free, name), name + _MODEL)

    bounds = options.get("bounds") or {}

    def optimum(start: Telescope, model_names: list[str], moved: Mapping[str, float]) -> Optimum:
        of_glasses = [f"{name}{_MODEL}.{quantity}" for name in model_names for quantity in ("n", "abbe")]
        # Limits of a motion are those of its change from the telescope as it was.
        shifts = {address: moved[address] for address in bounds if address in moved}
        remaining = {a: (min(bounds[a][0] - m, 0.0), max(bounds[a][1] - m, 0.0)) for a, m in shifts.items()}
        moved_options: GlassOptions = {**options, "bounds": {**bounds, **remaining}}
        return optimize(replace(state, telescope=start), [*fixed, *of_glasses], merit, **moved_options)

    model = best = optimum(free, names, {})
    count, trials, glass_by_medium = len(best.changes) - 2 * len(names), [], {}
    motion = np.array([parameter.kind == "motion" for parameter in best.variables[:count]])
    moves = np.where(motion, best.changes[:count], 0.0)
    for i, name in enumerate(names):
        moved = {a: float(m) for a, m, is_motion in zip(model.addresses, moves, motion, strict=False) if is_motion}
        optima: list[tuple[float, str, Optimum]] = []
        for glass in _nearest(source, _medium_of(best.telescope, name + _MODEL), nearest):
            medium = source[glass] if telescope.medium_before == VACUUM else source.in_vacuum(glass)
            try:
                start = _with_medium(best.telescope, name + _MODEL, medium, glass)
                end = optimum(start, names[i + 1 :], moved)
            except PachonError:
                trials.append(GlassTrial(name, glass, np.inf))
                continue
            trials.append(GlassTrial(name, glass, float(end.history[-1])))
            optima.append((float(end.history[-1]), glass, end))
        if not optima:
            raise ConfigError(f"glass {name!r}: no glass of {source.source} near it lets light through")
        _, glass_by_medium[name], best = min(optima, key=lambda one: one[:2])
        moves = moves + np.where(motion, best.changes[:count], 0.0)
    start_values, values = model.start_values[:count], np.where(motion, moves, best.values)
    final = replace(
        best,
        start_telescopes=(telescope,),
        start_values=start_values,
        values=values,
        changes=values - start_values,
        merits=np.array([model.merits[0], best.merits[1]]),
        remeasured=np.stack([model.remeasured[0], best.remeasured[1]]),
        history=np.concatenate([model.history, best.history[1:]]),
        operands=tuple(replace(b, start=m.start) for b, m in zip(best.operands, model.operands, strict=True)),
    )
    if all(name in source for name in names):
        # The glasses of the catalogue near the model's may all be worse than those that the telescope has.
        kept = optimum(telescope, [], {})
        trials += [GlassTrial(name, name, float(kept.history[-1])) for name in names]
        if kept.history[-1] <= best.history[-1]:
            final, glass_by_medium = kept, {name: name for name in names}
    return GlassChoice(final, model, glass_by_medium, tuple(trials))


def _medium_of(telescope: Telescope, name: str) -> Medium:
    return next(s.medium_after for s in telescope.surfaces if s.medium_after.name == name)


def _with_medium(telescope: Telescope, old: str, medium: Medium, name: str) -> Telescope:
    """Return the telescope with another medium, under a name, in place of one."""
    named: Medium = replace(medium, name=name)  # type: ignore[type-var]
    surfaces = tuple(replace(s, medium_after=named) if s.medium_after.name == old else s for s in telescope.surfaces)
    return replace(telescope, surfaces=surfaces)


def _nearest(catalogue: GlassCatalogue, medium: Medium, count: int) -> list[str]:
    """Return the names of the glasses nearest to a medium, the nearest first."""
    power, number = float(medium.index(LINE_D * 1e-6)) - 1.0, abbe_number(medium)
    distances = []
    for name in catalogue:
        glass = catalogue[name]
        try:
            change = float(glass.index(LINE_D * 1e-6)) - 1.0 - power, number / abbe_number(glass) - 1.0
        except PachonError:
            continue
        distances.append((float(np.hypot(change[0] / power, change[1])), name))
    return [name for _, name in sorted(distances)[:count]]
