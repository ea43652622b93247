"""Optimisation of a telescope: least squares over chosen variables, with exact derivatives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import DomainError
from ...core.threads import one_blas_thread
from ...models.parameters.parameters import Parameter
from ...models.paraxial import following_stop
from ...models.telescope import Telescope
from ...raytrace.rays import RayStatus
from .configuration import DesignConfiguration, configurations
from .design_task import DesignTask
from .held_operands import held_operands, with_operands
from .jacobian import ParameterColumns
from .merit import Beams, Merit
from .merit_function import MeritFunction, MeritName, merit_function
from .operand import Operand
from .optimum import Optimum
from .problem import DesignProblem
from .settled import settle
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
    merit: MeritName | MeritFunction | Merit = "spots",
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
    DomainError
        If the lens that the solver ends with loses the light of a field, or has another merit, measured as it is saved,
        than that of the solver, though its apertures cut the same rays.
    """
    task = DesignTask(
        configurations(telescope, fields, wavelengths, n_pupil), merit_function(merit), tuple(targets), threads
    )
    solver = solver or LeastSquares()
    states = task.states()
    telescopes = [state.telescope for state in states]
    held = held_operands(task.operands, exactly=np.isfinite(solver.constraint_tolerance))
    states = with_operands(states, held, telescopes)
    problem = DesignProblem(states, free_variables(telescopes, variables))
    box = limits(telescopes, problem.variables, bounds or {})
    start, slopes = problem.linear(np.zeros(len(problem.variables)))
    effect = np.linalg.norm(slopes, axis=0)
    _check_effects(problem, effect)

    def resume(changed: DesignProblem, changes: np.ndarray) -> np.ndarray:
        return solver.resume(changed, box, changes, effect)

    # On the telescope's own reference spheres wavefronts have a second least, where the focus lies on the sphere.
    first = problem.on_far_spheres()
    if first is not problem:
        start, _ = first.linear(np.zeros(len(effect)))
    solution = solver.solve(first, box, bounds or {}, start, effect)
    solved = solution.changes if first is problem else resume(problem, solution.changes)
    end = settle(task, problem, held, solved, resume, solver.constraint_tolerance)
    values, slopes = end.problem.linear(end.changes)
    history = np.array([*solution.history, np.linalg.norm(values)])
    rate = np.array([v.rate(x) for v, x in zip(problem.variables, end.changes, strict=True)])
    covariance, collinear = _covariance(values, slopes, problem.variables, rate)
    changes = np.array([v.change(x) for v, x in zip(problem.variables, end.changes, strict=True)])
    start_values = np.array([v.start for v in problem.variables])
    beams = [state.beams for state in end.problem.states]
    started = tuple(configuration.telescope for configuration in task.configured)
    remeasured = np.array(
        [
            [task.measured(lenses, filled=filled, dense=True) for filled in (True, False)]
            for lenses in (started, end.telescopes)
        ]
    )
    return Optimum(
        telescopes=end.telescopes,
        start_telescopes=started,
        fields=tuple(b.request.fields for b in beams),
        wavelengths=tuple(b.request.wavelengths for b in beams),
        variables=tuple(v.parameter for v in problem.variables),
        addresses=tuple(v.address for v in problem.variables),
        changes=changes,
        start_values=start_values,
        values=start_values + changes,
        merit_name=task.function.name,
        merits=remeasured[:, 0],
        remeasured=remeasured,
        history=history if history[-1] != history[-2] else history[:-1],
        operands=end.operands,
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


@check_arguments
def wavefronts(telescope: Telescope, rays: Beams) -> np.ndarray:
    """Return the wavefronts of a telescope along the rays of a merit.

    Parameters
    ----------
    telescope : Telescope
        Telescope that the rays are traced through, such as a misaligned one.
    rays : Beams
        Rays of :meth:`Beams.of` for the arguments of :func:`optimize`.

    Returns
    -------
    ndarray, shape [n_field, n_wave, n_pupil]
        Wavefronts [m] as a goal of :class:`WavefrontError`; NaN where not lit.
    """
    columns = ParameterColumns.at(following_stop(telescope), ())

    def lit(block: WavefrontBlock) -> np.ndarray:
        return np.where(block.status == RayStatus.OK, block.value, np.nan)

    request = rays.request
    return np.stack(
        [np.concatenate(FieldWavefronts(columns, request, float(w)).map(lit)) for w in request.wavelengths], axis=1
    )


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
