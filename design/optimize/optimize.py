"""Optimisation of a telescope: least squares over chosen variables, with exact derivatives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import ConfigError, DomainError, PachonError
from ...core.threads import one_blas_thread
from ...models.parameters.parameters import Parameter
from ...models.paraxial import following_stop, stop_makes_pupil, with_moved_pupil, with_true_aperture
from ...models.telescope import Telescope
from ...raytrace.rays import RayStatus
from .configuration import DesignConfiguration, configurations
from .jacobian import ParameterColumns
from .merit import Beams, Merit
from .merit_function import MeritFunction, merit_function
from .operand import Operand, check_operands
from .optimum import OperandChange, Optimum
from .problem import DesignProblem, DesignState
from .solver import LeastSquares
from .variables import Variable, free_variables, limits
from .wavefront_derivatives import FieldWavefronts, WavefrontBlock

#: Fraction of the effects of single surfaces on single rays below which the effect of a variable is rounding.
NO_EFFECT = 1e-11
#: Singular value, relative to the largest, below which variables scaled to equal effects are collinear.
_COLLINEAR = 1e-6
#: What replaces arguments of earlier versions.
_REPLACED = {
    **dict.fromkeys(("field_weights", "wavelength_weights", "sampling", "projection"), "it in a DesignConfiguration"),
    "reference": "merit=SpotSize(reference)",
    "goal": "merit=WavefrontError(goal)",
    **dict.fromkeys(("tolerance", "max_steps", "restarts", "spread", "seed"), "it in solver=LeastSquares(...)"),
}


@removed_arguments(**_REPLACED)
@check_arguments
@one_blas_thread()
def optimize(
    telescope: Telescope | DesignConfiguration | Sequence[Telescope | DesignConfiguration],
    variables: Iterable[str | Parameter],
    merit: str | MeritFunction | Merit = "spots",
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    targets: Sequence[Operand] = (),
    n_pupil: int | None = None,
    solver: LeastSquares | None = None,
    threads: int | None = None,
) -> Optimum:
    """Minimise spots or wavefronts over chosen variables.

    A trust-region least-squares solver with exact derivatives of every ray. Variables are scaled by their effects, so
    that a conic constant and a coefficient of r^8 are comparable; radii are solved for as curvatures. Compensators
    (focus, tilt of the camera) are variables like all others. Where the stop has mirrors or lenses in front of it, rays
    fill it throughout, aimed as `aiming` "real" where the design data state none; the result has the aiming that is
    stated, and its entrance pupil where the stop is imaged at the end.

    Parameters
    ----------
    telescope : Telescope, DesignConfiguration, or sequence of them
        The telescope; with weights, operands and rays of its own a configuration; or several that are optimised
        together: bands, zoom positions. Each has a name of its own.
    fields, wavelengths, n_pupil, threads
        As in :meth:`pachon.Request.of`, but for 6 rings of pupil points by default.
    variables : iterable of str or Parameter
        Free parameters, see :mod:`~pachon.models.parameters.parameters`. Configurations that have an address share
        it; after the name of a telescope and a colon it is that of one of them: ``zoom_2:L2.thickness``.
    merit : {"spots", "wavefront"}, SpotSize, WavefrontError or Merit
        Merit function: rms spot radius, or rms wavefront without piston and tilt, with options in an object; or a merit
        of one telescope.
    bounds : mapping of str to (low, high), optional
        Limits of variables: of the change for a motion, else of the value itself. By default curvatures are limited by
        the clear radii of their surfaces, thicknesses to positive values, indices and Abbe numbers to those of glasses.
    targets : sequence of Operand
        Further numbers to be reached or held within limits, of each configuration.
    solver : LeastSquares, optional
        Solver, with its tolerance, largest number of steps and random starts.

    Raises
    ------
    DomainError
        If a variable has no effect, a bound excludes the start, or no ray reaches the image.
    ConfigError, UnknownNameError
        If a merit or variable does not exist, or an operand is given twice.
    """
    function = merit_function(merit)
    configured = configurations(telescope, fields, wavelengths, n_pupil)
    states, beams = _states(configured, function, tuple(targets), threads)
    telescopes = [state.telescope for state in states]
    problem = DesignProblem(states, free_variables(telescopes, variables))
    box = limits(telescopes, problem.variables, bounds or {})
    start, slopes = problem.linear(np.zeros(len(problem.variables)))
    effect = np.linalg.norm(slopes, axis=0)
    _check_effects(problem, effect)
    solution = (solver or LeastSquares()).solve(problem, box, bounds or {}, start, effect)
    values, slopes = problem.linear(solution.changes)
    if (end := float(np.linalg.norm(values))) != solution.history[-1]:
        solution.history.append(end)
    rate = np.array([v.rate(x) for v, x in zip(problem.variables, solution.changes, strict=True)])
    covariance, collinear = _covariance(values, slopes, problem.variables, rate)
    changes = np.array([v.change(x) for v, x in zip(problem.variables, solution.changes, strict=True)])
    start_values = np.array([v.start for v in problem.variables])
    started, solved = tuple(state.telescope for state in configured), problem.telescopes(solution.changes)
    ended = tuple(
        final_telescope(after, stated.design_data.aiming) for after, stated in zip(solved, started, strict=True)
    )
    return Optimum(
        telescopes=ended,
        start_telescopes=started,
        fields=tuple(b.request.fields for b in beams),
        wavelengths=tuple(b.request.wavelengths for b in beams),
        variables=tuple(v.parameter for v in problem.variables),
        addresses=tuple(v.address for v in problem.variables),
        changes=changes,
        start_values=start_values,
        values=start_values + changes,
        merit_name=function.name,
        merits=np.array([np.linalg.norm(problem.merit_part(residuals)) for residuals in (start, values)]),
        remeasured=np.array([remeasured(configured, lenses, function, threads) for lenses in (started, ended)]),
        history=np.array(solution.history),
        operands=_operand_changes(states, solved),
        effect=np.linalg.norm(slopes, axis=0) / np.abs(rate),
        covariance=covariance,
        collinear=collinear,
        message=solution.message,
        vignetting=tuple(b.request.vignetting for b in beams),
    )


def _check_effects(problem: DesignProblem, effect: np.ndarray) -> None:
    """Raise a DomainError for a variable whose effect on the merit is rounding."""
    rounding = NO_EFFECT * problem.rounding()
    for variable, value, least in zip(problem.variables, effect, rounding, strict=True):
        if not value > least:
            raise DomainError(f"variable {variable.address} has no effect on the merit: leave it out")


def _operand_changes(states: Sequence[DesignState], solved: Sequence[Telescope]) -> tuple[OperandChange, ...]:
    return tuple(
        OperandChange(operand, state.telescope.name, operand.measure(state.telescope), operand.measure(after))
        for state, after in zip(states, solved, strict=True)
        for operand in state.operands
    )


def wavefronts(telescope: Telescope, rays: Beams) -> np.ndarray:
    """Return the wavefronts of a telescope [m], shape [n_field, n_wave, n_pupil], NaN where not lit.

    Rays are those of :meth:`Beams.of` for the arguments of :func:`optimize`.
    """
    columns = ParameterColumns.at(following_stop(telescope), ())

    def lit(block: WavefrontBlock) -> np.ndarray:
        return np.where(block.status == RayStatus.OK, block.value, np.nan)

    request = rays.request
    return np.stack(
        [np.concatenate(FieldWavefronts(columns, request, float(w)).map(lit)) for w in request.wavelengths], axis=1
    )


def _states(
    given: tuple[DesignConfiguration, ...], function: MeritFunction, targets: tuple[Operand, ...], threads: int | None
) -> tuple[tuple[DesignState, ...], tuple[Beams, ...]]:
    """Return merit and operands of each configuration, and their rays."""
    if len(given) > 1 and function.of_one_telescope:
        raise ConfigError(f"{len(given)} configurations: expected no goal, and the merit 'spots' or 'wavefront'")
    total, states, beams = sum(configuration.weight for configuration in given), [], []
    for configuration in given:
        telescope = following_stop(configuration.telescope)
        rays = configuration.beams(telescope, threads)
        operands = (*targets, *configuration.operands)
        check_operands(operands)
        bound = []
        for operand in operands:
            # An operand that the telescope does not have is an error of the input, not a step that goes too far.
            bound.append(operand.bound(telescope))
            _check_start(bound[-1], telescope)
        states.append(DesignState(telescope, function.of(telescope, rays), tuple(bound), configuration.weight / total))
        beams.append(rays)
    return tuple(states), tuple(beams)


def _check_start(operand: Operand, telescope: Telescope) -> None:
    try:
        number = operand.measure(telescope)
    except PachonError as error:
        raise error.within(subject=f"operand {operand.label} of {telescope.name}") from None
    if not np.isfinite(number):
        raise DomainError(f"operand {operand.label} of {telescope.name} = {number!r}: expected a finite number")


def _covariance(
    values: np.ndarray, slopes: np.ndarray, variables: Sequence[Variable], rate: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the covariance of the variables, and the combinations without effect."""
    norm = np.linalg.norm(slopes, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    _, sizes, modes = np.linalg.svd(slopes / norm, full_matrices=False)
    flat = sizes < _COLLINEAR * sizes[0]
    inverse = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, sizes))
    spread = (modes.T * inverse) / norm[:, None] * rate[:, None]
    noise = float(values @ values) / max(1, len(values) - len(variables))
    combinations = []
    for mode in modes[flat]:
        # In natural units, the largest part 1.
        parts = mode / norm * rate
        main = np.flatnonzero(np.abs(mode) > 0.05).tolist()
        parts = parts / parts[main[np.argmax(np.abs(mode[main]))]]
        combinations.append(" ".join(f"{parts[i]:+.4g} {variables[i].address}" for i in main))
    return noise * spread @ spread.T, tuple(combinations)


def final_telescope(telescope: Telescope, aiming: str) -> Telescope:
    """Return an optimised telescope with a stated aiming and its stop in its place.

    Its entrance pupil is where the stop is imaged now. Without such a pupil rays stay aimed at the stop.
    """
    if telescope.design_data.aiming == aiming:
        return with_true_aperture(telescope)
    stated = with_moved_pupil(telescope).with_design(aiming=aiming)
    return stated if stop_makes_pupil(stated) else with_true_aperture(telescope)


def remeasured(
    states: Sequence[DesignConfiguration], telescopes: Sequence[Telescope], function: MeritFunction, threads: int | None
) -> tuple[float, float]:
    """Return the rms merit [m] of telescopes as they stand, of the light that arrives in each.

    With rays that fill the stop, and with rays as the design data of the telescopes state them; NaN without light. The
    spots are those of :func:`~pachon.design.metrics.spots.spots`.
    """

    def rms(state: DesignConfiguration, telescope: Telescope) -> float:
        try:
            return function.rms(telescope, state.beams(telescope, threads))
        except PachonError:
            return np.nan

    total = sum(state.weight for state in states)
    squares = np.zeros(2)
    for state, telescope in zip(states, telescopes, strict=True):
        filled = rms(state, following_stop(telescope))
        stated = filled if following_stop(telescope) is telescope else rms(state, telescope)
        squares += state.weight / total * np.array([filled, stated]) ** 2
    filled, stated = np.sqrt(squares)
    return float(filled), float(stated)
