"""Free variables of an optimisation: shared by configurations, radii as curvatures, bounds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import ConfigError, DomainError, UnknownNameError, check_unique
from ...core.random_streams import stream
from ...models.parameters.links import followers, quantity_of
from ...models.parameters.parameters import Parameter, parse_parameters
from ...models.telescope import Telescope
from .geometry_operands import clear_radius

#: Largest slope of default bounds of curvatures: clear radius over radius of curvature.
_STEEPEST = 0.98
#: Default bounds of Abbe numbers and of refractive indices: those of glasses.
_GLASSES = {"abbe": (15.0, 110.0), "index": (1.3, 2.2)}


@dataclass(frozen=True)
class Variable:
    """A parameter of one or several configurations that is free.

    Attributes
    ----------
    address : str
        Address; with the name of a telescope and a colon in front, it belongs to that configuration alone.
    parameters : tuple of Parameter or None
        Parameter of each configuration, as the solver changes it: curvatures stand for radii. None where it has none.
    parameter : Parameter
        Parameter of the address.
    start : float
        Value of that parameter at the start.
    solver_start : float
        Value at the start as the solver has it, the curvature of a radius.
    """

    address: str
    parameters: tuple[Parameter | None, ...]
    parameter: Parameter
    start: float
    solver_start: float

    @property
    def inverse(self) -> bool:
        """Whether the solver has the reciprocal, as for a radius."""
        return next(p for p in self.parameters if p).name != self.parameter.name

    def change(self, solved: float) -> float:
        """Return the change of the parameter for a change as the solver has it."""
        if not self.inverse:
            return solved
        curvature = self.solver_start + solved
        return (1.0 / curvature if curvature else np.inf) - self.start

    def rate(self, solved: float) -> float:
        """Return the derivative of :meth:`change`."""
        if not self.inverse:
            return 1.0
        curvature = self.solver_start + solved
        return -1.0 / curvature**2 if curvature else np.inf


def free_variables(telescopes: Sequence[Telescope], variables: Iterable[str | Parameter]) -> tuple[Variable, ...]:
    """Return the variables at addresses, of all configurations that have them.

    Raises
    ------
    UnknownNameError, ConfigError, DomainError
        If no configuration has an address, one occurs twice, or there is none.
    """
    names = [t.name for t in telescopes]
    if len(telescopes) > 1:
        check_unique("configuration", names)
    free: list[Variable] = []
    for text in variables:
        free += _of_address(telescopes, names, text)
    if not free:
        raise ConfigError("variables = []: expected at least one, such as M2.dz")
    check_unique("variable", [v.address for v in free])
    return tuple(free)


def _of_address(telescopes: Sequence[Telescope], names: list[str], text: str | Parameter) -> list[Variable]:
    address = text.address if isinstance(text, Parameter) else text
    owner = next((n for n in names if len(names) > 1 and address.startswith(f"{n}:")), None)
    prefix = "" if owner is None else f"{owner}:"
    parameter_text = address.removeprefix(prefix) if isinstance(text, str) else text
    parsed: list[tuple[Parameter, ...]] = []
    problem: UnknownNameError | None = None
    for telescope in telescopes:
        parsed.append(())
        if owner in (None, telescope.name):
            try:
                parsed[-1] = parse_parameters([parameter_text], telescope)
            except UnknownNameError as error:
                problem = error
    longest = max(parsed, key=len)
    if not longest:
        assert problem is not None
        raise problem
    result = []
    for place, parameter in enumerate(longest):
        by_telescope = tuple(parameters[place] if parameters else None for parameters in parsed)
        first = next(i for i, p in enumerate(by_telescope) if p)
        solver = tuple(p if p is None else _for_solver(p, t) for p, t in zip(by_telescope, telescopes, strict=True))
        if quantity_of(parameter, telescopes[first]) in followers(telescopes[first]):
            raise ConfigError(f"variable {parameter.address} follows other values: expected one of those")
        start = parameter.value(telescopes[first])
        inside = solver[first]
        assert inside is not None
        result.append(Variable(prefix + parameter.address, solver, parameter, start, inside.value(telescopes[first])))
    return result


def _for_solver(parameter: Parameter, telescope: Telescope) -> Parameter:
    """Return the parameter as the solver changes it: the curvature of a radius, which may pass through a plane."""
    before, radius, behind = parameter.name.rpartition("radius")
    curvature = f"{before}curvature{behind}"
    if parameter.kind != "shape" or not radius or curvature not in telescope.surface(parameter.target).shape.parameters:
        return parameter
    return replace(parameter, name=curvature, unit="1/m")


def limits(
    telescopes: Sequence[Telescope], variables: Sequence[Variable], bounds: Mapping[str, tuple[float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits of the changes as the solver has them, shape [n_variable] each.

    Without bounds of its own a curvature is limited by the clear radius of its surface, a thickness to positive values,
    index and Abbe number to those of glasses; a start beyond such a limit is the limit itself.
    """
    addresses = [v.address for v in variables]
    for address in bounds:
        if address not in addresses:
            raise ConfigError(f"bounds of {address!r}: expected one of the variables, {', '.join(addresses)}")
    pairs = []
    for variable in variables:
        if variable.address in bounds:
            pairs.append(_given(variable, bounds[variable.address]))
        else:
            low, high = _usual(telescopes, variable)
            pairs.append((min(low, variable.solver_start), max(high, variable.solver_start)))
    low, high = np.array(pairs).T
    start = np.array([v.solver_start for v in variables])
    return low - start, high - start


def _given(variable: Variable, pair: tuple[float, float]) -> tuple[float, float]:
    low, high = (float(v) for v in pair)
    unit = "" if variable.parameter.unit in ("", "1") else f" {variable.parameter.unit}"
    stated = f"bounds of {variable.address} = ({low:g}, {high:g}){unit}"
    if not low < high or not low <= variable.start <= high:
        raise DomainError(f"{stated}: expected rising ones about its {variable.start:.6g}{unit}")
    if not variable.inverse:
        return low, high
    if low < 0.0 < high:
        raise DomainError(f"{stated}: expected radii of one sign; a curvature can have both")
    ends = 1.0 / high if high else -np.inf, 1.0 / low if low else np.inf
    return min(ends), max(ends)


def _usual(telescopes: Sequence[Telescope], variable: Variable) -> tuple[float, float]:
    parameter = next(p for p in variable.parameters if p)
    if parameter.kind == "thickness" or parameter.name == "lines_per_mm":
        return 0.0, np.inf
    if parameter.kind in _GLASSES:
        return _GLASSES[parameter.kind]
    if parameter.kind == "shape" and parameter.name.rpartition(".")[2].startswith("curvature"):
        clear_radii = [clear_radius(t, p.target) for t, p in zip(telescopes, variable.parameters, strict=True) if p]
        steepest = _STEEPEST / max(clear_radii)
        return (-steepest, steepest) if steepest else (-np.inf, np.inf)
    return -np.inf, np.inf


def random_starts(
    variables: Sequence[Variable],
    bounded: Iterable[str],
    box: tuple[np.ndarray, np.ndarray],
    spread: float,
    seed: int,
    n: int,
) -> np.ndarray:
    """Return changes to start from, shape [n, n_variable].

    Variables at `bounded` addresses are drawn evenly between their limits, the `box`. Others follow a normal
    distribution as wide as `spread` times their value, or times the rms value of their kind where that is larger.
    """
    first = [next(p for p in v.parameters if p) for v in variables]
    kinds = [p.kind + p.name.rpartition(".")[2] for p in first]
    values, bounded_addresses = np.array([v.solver_start for v in variables]), set(bounded)
    starts = np.empty((n, len(values)))
    for i, variable in enumerate(variables):
        rng, (low, high) = stream(seed, "restart", variable.address), (box[0][i], box[1][i])
        if variable.address in bounded_addresses and np.isfinite(high - low):
            starts[:, i] = rng.uniform(low, high, n)
        else:
            alike = values[[kind == kinds[i] for kind in kinds]]
            size = max(abs(values[i]), float(np.sqrt(np.mean(alike**2))))
            starts[:, i] = np.clip(spread * size * rng.normal(size=n), low, high)
    return starts
