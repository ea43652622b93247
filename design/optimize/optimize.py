"""Optimisation of a telescope: least squares over chosen variables, with exact derivatives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import OptimizeResult, least_squares

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, PachonError, shown
from ...core.threads import one_blas_thread
from ...core.units import require_count
from ...models.parameters.parameters import Parameter, resolved
from ...models.paraxial import following_stop
from ...models.telescope import Telescope
from ...raytrace.rays import RayStatus
from ...wavefront.pupil_sampling import PupilSampling
from .configuration import DesignConfiguration, configurations
from .jacobian import ParameterColumns
from .merit import Beams, Merit
from .operand import Operand, check_operands
from .optimum import OperandChange, Optimum
from .problem import DesignProblem, DesignState
from .remeasured import MeritOptions, final_telescope, remeasured
from .variables import Variable, free_variables, limits, random_starts
from .wavefront_derivatives import FieldWavefronts, WavefrontBlock

#: Fraction of the effects of single surfaces on single rays below which the effect of a variable is rounding.
NO_EFFECT = 1e-11
#: Effect of the longest first step, in units of the merit at the start.
_FIRST_STEP = 100.0
#: Singular value, relative to the largest, below which variables scaled to equal effects are collinear.
_COLLINEAR = 1e-6


@check_arguments
@one_blas_thread()
def optimize(
    telescope: Telescope | Sequence[Telescope | DesignConfiguration],
    variables: Iterable[str | Parameter],
    merit: str | Merit = "spots",
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    targets: Sequence[Operand] = (),
    field_weights: ArrayLike | None = None,
    wavelength_weights: ArrayLike | None = None,
    reference: str = "centroid",
    goal: ArrayLike | None = None,
    sampling: str | PupilSampling = "gauss",
    n_pupil: int | None = None,
    projection: str = "zemax",
    tolerance: float = 1e-10,
    max_steps: int = 200,
    restarts: int = 0,
    spread: float = 0.3,
    seed: int = 0,
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
    telescope : Telescope or sequence of Telescope and DesignConfiguration
        The telescope, or configurations that are optimised together: bands, zoom positions. Each has a name of its own.
    fields, wavelengths, wavelength_weights, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`, but for 6 rings of pupil points by default.
    variables : iterable of str or Parameter
        Free parameters, see :mod:`~pachon.models.parameters.parameters`. Configurations that have an address share
        it; after the name of a telescope and a colon it is that of one of them: ``zoom_2:L2.thickness``.
    merit : {"spots", "wavefront"} or Merit
        Merit function: rms spot radius, or rms wavefront without piston and tilt; an object for one telescope.
    bounds : mapping of str to (low, high), optional
        Limits of variables: of the change for a motion, else of the value itself. By default curvatures are limited by
        the clear radii of their surfaces, thicknesses to positive values, indices and Abbe numbers to those of glasses.
    targets : sequence of Operand
        Further numbers to be reached or held within limits, of each configuration.
    field_weights : array_like, shape [n_field], optional
        Weights in the mean square; by default those of the design data with their fields, else equal.
    reference : {"centroid", "chief"}
        Origin of the landing points.
    goal : array_like, shape [n_field, n_wave, n_pupil], optional
        Target wavefronts [m], such as those of :func:`wavefronts`; zero by default.
    tolerance : float
        Relative change of the sum of squares, or of the variables, at which the solver stops.
    max_steps : int
        Largest number of evaluations of the merit, from each start.
    restarts : int
        Number of random starts beside the telescope as it is; the best end is returned.
    spread : float
        Width of the random starts, relative to the values of the variables; those with two bounds are drawn evenly
        between them.
    seed : int
        Seed of the random starts.

    Raises
    ------
    DomainError
        If a variable has no effect, a bound excludes the start, or no ray reaches the image.
    ConfigError, UnknownNameError
        If a merit or variable does not exist, or an operand is given twice.
    """
    require_count(restarts, "restarts", 0)
    given = tuple(
        replace(one, telescope=resolved(one.telescope))
        for one in configurations(
            telescope,
            fields=fields,
            wavelengths=wavelengths,
            field_weights=field_weights,
            wavelength_weights=wavelength_weights,
        )
    )
    options = MeritOptions(
        merit, reference, goal, dict(sampling=sampling, n_pupil=n_pupil, projection=projection, threads=threads)
    )
    states, beams = _states(given, options, tuple(targets))
    telescopes = [state.telescope for state in states]
    chosen = free_variables(telescopes, variables)
    problem = DesignProblem(states, chosen)
    box = limits(telescopes, chosen, bounds or {})
    still = np.zeros(len(chosen))
    start, slopes = problem.linear(still)
    effect = np.linalg.norm(slopes, axis=0)
    scale = np.divide(1.0, effect, out=np.ones_like(effect), where=effect > 0)
    rounding = NO_EFFECT * problem.rounding()
    idle = [v.address for v, value, least in zip(chosen, effect, rounding, strict=True) if not value > least]
    if idle:
        raise DomainError(f"variable {idle[0]} has no effect on the merit: leave it out")
    begun = problem.merit_part(start)
    done, history = _solve(problem, box, still, start, scale, tolerance, max_steps)
    for other in random_starts(chosen, bounds or {}, box, spread, seed, restarts):
        residuals = problem.residuals(other)
        if np.isfinite(residuals).all():
            found, course = _solve(problem, box, other, residuals, scale, tolerance, max_steps)
            if found.cost < done.cost:
                done, history = found, course
    solved = done.x * scale
    values, slopes = problem.linear(solved)
    end = float(np.linalg.norm(values))
    if end != history[-1]:
        history.append(end)
    rate = np.array([v.rate(x) for v, x in zip(chosen, solved, strict=True)])
    covariance, collinear = _covariance(values, slopes, chosen, rate)
    changes = np.array([v.change(x) for v, x in zip(chosen, solved, strict=True)])
    start_values = np.array([v.start for v in chosen])
    started, solutions = tuple(one.telescope for one in given), problem.telescopes(solved)
    ended = tuple(
        final_telescope(after, stated.design_data.aiming) for after, stated in zip(solutions, started, strict=True)
    )
    return Optimum(
        telescopes=ended,
        start_telescopes=started,
        fields=tuple(b.request.fields for b in beams),
        wavelengths=tuple(b.request.wavelengths for b in beams),
        variables=tuple(v.parameter for v in chosen),
        addresses=tuple(v.address for v in chosen),
        changes=changes,
        start_values=start_values,
        values=start_values + changes,
        merit_name=merit if isinstance(merit, str) else type(merit).__name__,
        merits=np.array([np.linalg.norm(begun), np.linalg.norm(problem.merit_part(values))]),
        remeasured=np.array([remeasured(given, lenses, options) for lenses in (started, ended)]),
        history=np.array(history),
        operands=tuple(
            OperandChange(operand, state.telescope.name, operand.measure(state.telescope), operand.measure(after))
            for state, after in zip(states, solutions, strict=True)
            for operand in state.operands
        ),
        effect=np.linalg.norm(slopes, axis=0) / np.abs(rate),
        covariance=covariance,
        collinear=collinear,
        message=str(done.message),
        vignetting=tuple(b.request.vignetting for b in beams),
    )


def _solve(
    problem: DesignProblem,
    box: tuple[np.ndarray, np.ndarray],
    start: np.ndarray,
    residuals: np.ndarray,
    scale: np.ndarray,
    tolerance: float,
    max_steps: int,
) -> tuple[OptimizeResult, list[float]]:
    """Return the solution in variables over their scale, and the rms of all residuals before and after each step."""
    history: list[float] = []

    def jacobian(scaled: np.ndarray) -> np.ndarray:
        # Called at the start and after each step.
        values, change = problem.linear(scaled * scale)
        history.append(float(np.linalg.norm(values)))
        return change * scale

    done = least_squares(
        lambda scaled: problem.residuals(scaled * scale),
        start / scale,
        jac=jacobian,
        bounds=(box[0] / scale, box[1] / scale),
        method="trf",
        # Generous first steps: variables that compensate each other move far for little effect.
        x_scale=float(max(_FIRST_STEP * float(np.linalg.norm(residuals)), np.finfo(float).tiny)),
        ftol=tolerance,
        xtol=tolerance,
        gtol=1e-15,
        max_nfev=max_steps,
    )
    return done, history


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
    given: tuple[DesignConfiguration, ...], options: MeritOptions, targets: tuple[Operand, ...]
) -> tuple[tuple[DesignState, ...], tuple[Beams, ...]]:
    """Return merit and operands of each configuration, and their rays."""
    merit = options.merit
    if not isinstance(merit, str) and not hasattr(merit, "derivatives"):
        raise ConfigError(f"merit = {shown(merit)}: expected 'spots', 'wavefront' or a Merit")
    if len(given) > 1 and (options.goal is not None or not isinstance(merit, str)):
        raise ConfigError(f"{len(given)} configurations: expected no goal, and the merit 'spots' or 'wavefront'")
    total, states, beams = sum(one.weight for one in given), [], []
    for one in given:
        telescope = following_stop(one.telescope)
        rays = options.beams(telescope, one)
        operands = (*targets, *one.operands)
        check_operands(operands)
        bound = []
        for operand in operands:
            # An operand that the telescope does not have is an error of the input, not a step that goes too far.
            bound.append(operand.bound(telescope))
            _check_start(bound[-1], telescope)
        states.append(DesignState(telescope, options.of(telescope, rays), tuple(bound), one.weight / total))
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
