"""Optimisation of a telescope: least squares over chosen variables, with exact derivatives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, PachonError, shown
from ...core.plotting import BLUE, GREY, figure_at, plain_text, styled
from ...core.result import Result
from ...core.threads import one_blas_thread
from ...models.telescope import Telescope
from ...raytrace.rays import RayStatus
from ...wavefront.pupil_sampling import PupilSampling
from ..parameters.parameters import Parameter, apply, parse_parameters
from .jacobian import ParameterColumns
from .merit import Beams, Merit, SpotMerit, WavefrontMerit
from .targets import FocalLength, Target
from .wavefront_derivatives import FieldWavefronts, WavefrontBlock

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Fraction of the effects of single surfaces on single rays below which the effect of a variable is rounding.
NO_EFFECT = 1e-11
#: Effect of the longest first step, in units of the merit at the start.
_FIRST_STEP = 100.0
#: Singular value, relative to the largest, below which variables scaled to equal effects are collinear.
_COLLINEAR = 1e-6


@dataclass(frozen=True)
class Optimum(Result):
    """Result of an optimisation.

    Attributes
    ----------
    telescope : Telescope
        The optimised telescope.
    variables : tuple of Parameter
        Free parameters.
    changes : ndarray, shape [n_variable]
        Change of each, in its own unit.
    start_values, values : ndarray, shape [n_variable]
        Values before and after; those of motions are relative to the start.
    merit_name : str
        "spots" or "wavefront".
    history : ndarray, shape [n_step + 1]
        Rms of merit and targets [m] before the first step and after each.
    effect : ndarray, shape [n_variable]
        Rms change of the merit's residuals per unit of each variable [m], at the solution.
    covariance : ndarray, shape [n_variable, n_variable]
        Covariance of the variables, with the final residuals as noise, without combinations of no effect.
    collinear : tuple of str
        Combinations of variables without effect on the merit, such as "M1.radius - 0.998 M1.curvature".
    message : str
        Why the solver stopped.
    """

    _table = ("start_values", "values", "changes", "uncertainty", "effect")
    _row_type = Parameter

    telescope: Telescope
    variables: tuple[Parameter, ...]
    changes: np.ndarray
    start_values: np.ndarray
    values: np.ndarray
    merit_name: str
    history: np.ndarray
    effect: np.ndarray
    covariance: np.ndarray
    collinear: tuple[str, ...]
    message: str

    @property
    def uncertainty(self) -> np.ndarray:
        """Standard deviation of each variable, in its own unit, shape [n_variable]."""
        return np.sqrt(np.diag(self.covariance))

    def _label(self) -> str:
        start, end = self.history[0], self.history[-1]
        return f"{self.telescope.name}, {len(self.variables)} variables, rms {start:.4g} -> {end:.4g} m"

    def _columns(self) -> dict[str, Any]:
        names = {"address": [p.address for p in self.variables], "unit": [p.unit or "1" for p in self.variables]}
        return names | super()._columns()

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit."""
        return {
            "telescope": self.telescope.name,
            "merit": self.merit_name,
            "rms_start_m": self.history[0],
            "rms_end_m": self.history[-1],
            "steps": len(self.history) - 1,
            "variables": [p.address for p in self.variables],
            "units": [p.unit or "1" for p in self.variables],
            "start_values": self.start_values,
            "values": self.values,
            "changes": self.changes,
            "uncertainty": self.uncertainty,
            "effect_m_per_unit": self.effect,
            "collinear": list(self.collinear),
            "message": self.message,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the merit step by step, and the effect of the change of each variable."""
        from matplotlib.ticker import MaxNLocator

        with styled():
            names = [p.address for p in self.variables]
            figure = figure_at(ax, 8.4, max(3.2, 1.4 + 0.24 * len(names)))
            steps, bars = figure.subplots(1, 2)
            steps.semilogy(range(len(self.history)), self.history * 1e6, "o-", color=BLUE, markersize=4)
            steps.xaxis.set_major_locator(MaxNLocator(integer=True))
            steps.grid(True, which="major", linewidth=0.3)
            steps.set(xlabel="step", ylabel=f"rms of {self.merit_name} [µm]", title=plain_text(self.telescope.name))
            places = np.arange(len(names))
            bars.barh(places, np.abs(self.changes) * self.effect * 1e6, color=GREY, height=0.7)
            bars.set_yticks(places, [plain_text(name) for name in names])
            bars.invert_yaxis()
            bars.set_xlabel("change of each times its effect, rms [µm]")
            return figure


@check_arguments
@one_blas_thread()
def optimize(
    telescope: Telescope,
    variables: Iterable[str | Parameter],
    merit: str | Merit = "spots",
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    targets: Sequence[FocalLength | Target] = (),
    field_weights: ArrayLike | None = None,
    wavelength_weights: ArrayLike | None = None,
    reference: str = "centroid",
    goal: ArrayLike | None = None,
    sampling: str | PupilSampling = "gauss",
    n_pupil: int | None = None,
    projection: str = "zemax",
    tolerance: float = 1e-10,
    max_steps: int = 200,
    threads: int | None = None,
) -> Optimum:
    """Minimise spots or wavefronts over chosen variables.

    A trust-region least-squares solver with exact derivatives of every ray. Variables are scaled by their effects, so
    that a conic constant and a coefficient of r^8 are comparable. Compensators (focus, tilt of the camera) are
    variables like all others.

    Parameters
    ----------
    telescope, fields, wavelengths, wavelength_weights, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`, but for 6 rings of pupil points by default.
    variables : iterable of str or Parameter
        Free parameters, see :mod:`~pachon.design.parameters.parameters`.
    merit : {"spots", "wavefront"} or Merit
        Merit function: rms spot radius, or rms wavefront without piston and tilt.
    bounds : mapping of str to (low, high), optional
        Limits of variables: of the value itself for a shape or index, of the change for a motion.
    targets : sequence of FocalLength and Target
        Further numbers to be reached.
    field_weights : array_like, shape [n_field], optional
        Weights in the mean square; equal by default.
    reference : {"centroid", "chief"}
        Origin of the landing points.
    goal : array_like, shape [n_field, n_wave, n_pupil], optional
        Target wavefronts [m], such as those of :func:`wavefronts`; zero by default.
    tolerance : float
        Relative change of the sum of squares, or of the variables, at which the solver stops.
    max_steps : int
        Largest number of evaluations of the merit.

    Raises
    ------
    DomainError
        If a variable has no effect, a bound excludes the start, or no ray reaches the image.
    ConfigError, UnknownNameError
        If a merit or variable does not exist.
    """
    chosen = parse_parameters(variables, telescope)
    rays = Beams.of(
        telescope,
        fields,
        wavelengths,
        field_weights=field_weights,
        wavelength_weights=wavelength_weights,
        sampling=sampling,
        n_pupil=n_pupil,
        projection=projection,
        threads=threads,
    )
    if not isinstance(merit, str) and not hasattr(merit, "derivatives"):
        raise ConfigError(f"merit = {shown(merit)}: expected 'spots', 'wavefront' or a Merit")
    wanted = merit if not isinstance(merit, str) else _merit(merit, telescope, rays, reference, goal)
    problem = _Problem(telescope, chosen, wanted, tuple(targets))
    low, high = _bounds(telescope, chosen, bounds or {})
    start, slopes = problem.linear(np.zeros(len(chosen)))
    effect = np.linalg.norm(slopes, axis=0)
    rounding = NO_EFFECT * wanted.size_of_terms(ParameterColumns.at(telescope, chosen))
    idle = [p.address for p, value, least in zip(chosen, effect, rounding, strict=True) if not value > least]
    if idle:
        raise DomainError(f"variable {idle[0]} has no effect on the merit: leave it out")
    scale = 1.0 / effect
    history = [float(np.linalg.norm(start))]

    def jacobian(scaled: np.ndarray) -> np.ndarray:
        # Called at the start and after each step.
        values, change = problem.linear(scaled * scale)
        if scaled.any():
            history.append(float(np.linalg.norm(values)))
        return change * scale

    done = least_squares(
        lambda scaled: problem.residuals(scaled * scale),
        np.zeros(len(chosen)),
        jac=jacobian,
        bounds=(low / scale, high / scale),
        method="trf",
        # Generous first steps: variables that compensate each other move far for little effect.
        x_scale=float(max(_FIRST_STEP * history[0], np.finfo(float).tiny)),
        ftol=tolerance,
        xtol=tolerance,
        gtol=1e-15,
        max_nfev=max_steps,
    )
    changes = done.x * scale
    values, slopes = problem.linear(changes)
    end = float(np.linalg.norm(values))
    if end != history[-1]:
        history.append(end)
    covariance, collinear = _covariance(values, slopes, chosen)
    begun = np.array([p.value(telescope) for p in chosen])
    return Optimum(
        telescope=apply(telescope, dict(zip(chosen, changes, strict=True))),
        variables=chosen,
        changes=changes,
        start_values=begun,
        values=begun + changes,
        merit_name=merit if isinstance(merit, str) else type(merit).__name__,
        history=np.array(history),
        effect=np.linalg.norm(slopes, axis=0),
        covariance=covariance,
        collinear=collinear,
        message=str(done.message),
    )


def wavefronts(telescope: Telescope, rays: Beams) -> np.ndarray:
    """Return the wavefronts of a telescope [m], shape [n_field, n_wave, n_pupil], NaN where not lit.

    Rays are those of :meth:`Beams.of` for the arguments of :func:`optimize`.
    """
    columns = ParameterColumns.at(telescope, ())

    def lit(block: WavefrontBlock) -> np.ndarray:
        return np.where(block.status == RayStatus.OK, block.value, np.nan)

    request = rays.request
    return np.stack(
        [np.concatenate(FieldWavefronts(columns, request, float(w)).map(lit)) for w in request.wavelengths], axis=1
    )


@dataclass
class _Problem:
    """Merit and targets as functions of the changes of all variables."""

    telescope: Telescope
    variables: tuple[Parameter, ...]
    merit: Merit
    targets: tuple[FocalLength | Target, ...]
    size: int = 0  #: number of residuals, once they are known

    def _at(self, changes: np.ndarray) -> Telescope:
        return apply(self.telescope, dict(zip(self.variables, changes, strict=True)))

    def residuals(self, changes: np.ndarray) -> np.ndarray:
        """Return all residuals [m]; NaN, for a shorter step, where the telescope is not valid."""
        try:
            telescope = self._at(changes)
            return np.concatenate([self.merit.residuals(telescope), *(t.residuals(telescope) for t in self.targets)])
        except PachonError:
            if not self.size:
                raise
            return np.full(self.size, np.nan)

    def linear(self, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return all residuals [m] and their derivatives, shape [n, n_variable]."""
        columns = ParameterColumns.at(self.telescope, self.variables, changes)
        values, slopes = self.merit.derivatives(columns)
        found, rates = [values], [slopes]
        for target in self.targets:
            if isinstance(target, Target):
                found.append(target.residuals(columns.telescope))
                rates.append(self._differences(target, changes, np.linalg.norm(slopes, axis=0)))
            else:
                value, rate = target.derivatives(columns)
                found.append(value)
                rates.append(rate)
        whole = np.concatenate(found)
        self.size = len(whole)
        return whole, np.concatenate(rates)

    def _differences(self, target: Target, changes: np.ndarray, effect: np.ndarray) -> np.ndarray:
        rates = np.zeros((1, len(changes)))
        for i, size in enumerate(effect):
            step = np.zeros(len(changes))
            step[i] = target.step / size if size > 0 else target.step
            there, here = (target.residuals(self._at(changes + sign * step)) for sign in (1.0, -1.0))
            rates[:, i] = (there - here) / (2.0 * step[i])
        return rates


def _merit(name: str, telescope: Telescope, rays: Beams, reference: str, goal: Any) -> Merit:
    if reference not in ("centroid", "chief"):
        raise ConfigError(f"reference = {reference!r}: expected 'centroid' or 'chief'")
    if name == "wavefront":
        return WavefrontMerit(telescope, rays, goal)
    if name != "spots":
        raise ConfigError(f"merit = {name!r}: expected 'spots' or 'wavefront'")
    if goal is not None:
        raise ConfigError("goal is given: expected merit = 'wavefront' with it")
    return SpotMerit(telescope, rays, reference)


def _bounds(
    telescope: Telescope, variables: tuple[Parameter, ...], bounds: Mapping[str, tuple[float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits of the changes."""
    limits = np.array([[-np.inf, np.inf]] * len(variables))
    addresses = [p.address for p in variables]
    for address, pair in bounds.items():
        if address not in addresses:
            raise ConfigError(f"bounds of {address!r}: expected one of the variables, {', '.join(addresses)}")
        i = addresses.index(address)
        now = variables[i].value(telescope)
        low, high = (float(v) for v in pair)
        if not low < high or not low <= now <= high:
            raise DomainError(f"bounds of {address} = ({low:g}, {high:g}): expected rising ones about its {now:.6g}")
        limits[i] = low - now, high - now
    return limits[:, 0], limits[:, 1]


def _covariance(
    values: np.ndarray, slopes: np.ndarray, variables: tuple[Parameter, ...]
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the covariance of the variables, and the combinations without effect."""
    norm = np.linalg.norm(slopes, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    _, sizes, modes = np.linalg.svd(slopes / norm, full_matrices=False)
    flat = sizes < _COLLINEAR * sizes[0]
    inverse = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, sizes))
    spread = (modes.T * inverse) / norm[:, None]
    noise = float(values @ values) / max(1, len(values) - len(variables))
    combinations = []
    for mode in modes[flat]:
        # In natural units, the largest part 1.
        parts = mode / norm
        main = np.flatnonzero(np.abs(mode) > 0.05)
        parts = parts / parts[main[np.argmax(np.abs(mode[main]))]]
        combinations.append(" ".join(f"{parts[i]:+.4g} {variables[i].address}" for i in main))
    return noise * spread @ spread.T, tuple(combinations)
