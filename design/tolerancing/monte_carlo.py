"""Monte Carlo of tolerances: merits of many drawn telescopes, traced or from exact derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import ConfigError
from ...core.number_text import counted
from ...core.plotting import BLUE, GREY, RED, figure_at, plain_text, styled
from ...core.result import Result, Values
from ...models.parameters.degrees_of_freedom import DegreesOfFreedom
from ...models.parameters.tolerances import Tolerance, draw
from ...models.telescope import Telescope
from ...wavefront.request import Request
from ..optimize.merit import Beams, filling_stop
from ..optimize.sensitivity import field_rings
from .criterion import Criterion
from .toleranced_merit import TolerancedMerit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TracedMerit = Literal["wavefront", "spots"]
MonteCarloMethod = Literal["linear", "quadratic", "traced"]
_PERCENTILES = (50, 80, 90, 95)
_REQUEST = "a Request in place of the telescope, Request.of(telescope, fields, wavelengths, ...)"
#: Arguments of :func:`monte_carlo` that a request holds.
_REPLACED = dict.fromkeys(("wavelengths", "sampling", "n_pupil", "projection", "threads"), _REQUEST)
#: Largest contributions in the plot.
_BARS = 20


@dataclass(frozen=True)
class MonteCarlo(Result):
    """The merit of telescopes drawn within tolerances.

    Attributes
    ----------
    telescope : str
        Name of the telescope.
    criterion : Criterion
        The number that is kept good; merits are in SI.
    method : str
        "linear", "quadratic" or "traced".
    tolerances : tuple of Tolerance
        The tolerances.
    compensators : tuple of str
        Degrees of freedom that follow the deviations of each draw.
    units, compensator_units : tuple of str
        Units of the deviations and of the compensators.
    deviations : ndarray, shape [n, n_tolerance]
        Drawn deviations.
    moves : ndarray, shape [n, n_compensator]
        Values of the compensators.
    merit : ndarray, shape [n]
        Merit of each draw [m]; NaN where a traced telescope loses its light.
    nominal : float
        Merit of the telescope without deviations, compensated [m].
    contribution : ndarray, shape [n_tolerance]
        Rms contribution of each tolerance alone to the merit that compensators minimise, compensated, in quadrature,
        to first order [m].
    """

    _table: ClassVar[tuple[str, ...]] = ("merit", "deviations", "moves")

    telescope: str
    criterion: Criterion
    method: MonteCarloMethod
    tolerances: tuple[Tolerance, ...]
    compensators: tuple[str, ...]
    units: tuple[str, ...]
    compensator_units: tuple[str, ...]
    deviations: np.ndarray
    moves: np.ndarray
    merit: np.ndarray
    nominal: float
    contribution: np.ndarray

    @classmethod
    def of(
        cls,
        toleranced: TolerancedMerit,
        method: MonteCarloMethod,
        deviations: np.ndarray,
        traced: tuple[np.ndarray, np.ndarray] | None,
        nominal: float,
        **fields: Any,
    ) -> Self:
        """Return the result for deviations: their `traced` merits and compensators, or those that the method computes.

        Further `fields` are those of a subclass.
        """
        count, units = len(toleranced.tolerances), toleranced.degrees_of_freedom.units
        if traced is not None:
            merit, moves = traced
        elif method == "linear":
            merit, moves = toleranced.linear(deviations), toleranced.moves(deviations)
        else:
            merit, moves = toleranced.quadratic(deviations), toleranced.quadratic_moves(deviations)
        return cls(
            telescope=toleranced.telescope.name,
            criterion=toleranced.criterion,
            method=method,
            tolerances=toleranced.tolerances,
            compensators=toleranced.compensators,
            units=units[:count],
            compensator_units=units[count:],
            deviations=deviations,
            moves=moves,
            merit=merit,
            nominal=nominal,
            contribution=toleranced.contribution,
            **fields,
        )

    @property
    def merit_name(self) -> str:
        """Name of the criterion, such as "wavefront" or "spots"."""
        return self.criterion.name

    @check_arguments
    def at_most(self, fraction: float) -> float:
        """Return the merit that at least a fraction (0 to 1) of the telescopes reaches, in SI; lost ones are worst.

        It is that of a telescope: of ten, nine are at most at the merit of 0.9.
        """
        sign = -1.0 if self.criterion.larger else 1.0
        merit = np.where(np.isnan(self.merit), np.inf, sign * self.merit)
        return sign * float(np.quantile(merit, fraction, method="inverted_cdf"))

    @check_arguments
    def yield_at(self, requirement: float) -> Yield:
        """Return the fraction of the telescopes that meet a requirement on the merit, with its binomial error."""
        return Yield.of(self.merit, requirement, larger=self.criterion.larger)

    def _meta(self) -> dict[str, Any]:
        names = ("telescope", "merit_name", "method", "nominal")
        return {name: getattr(self, name) for name in names}

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit."""
        return {
            "telescope": self.telescope,
            "merit": self.merit_name,
            "method": self.method,
            "draws": len(self.merit),
            "lost": int(np.isnan(self.merit).sum()),
            "nominal_m": self.nominal,
            **{f"at_most_{percent}_percent_m": self.at_most(percent / 100.0) for percent in _PERCENTILES},
            "tolerances": [t.name for t in self.tolerances],
            "units": list(self.units),
            "contribution_m": self.contribution,
            "compensators": list(self.compensators),
            "compensator_units": list(self.compensator_units),
            "compensator_rms": np.sqrt((self.moves**2).mean(axis=0)),
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the distribution of the merit and the contributions of the tolerances."""
        finite = np.sort(self.merit[np.isfinite(self.merit)])
        highest = float(finite.max(initial=self.nominal))
        unit, scale = ("nm", 1e9) if highest < 1e-6 else ("µm", 1e6)
        shown = np.argsort(self.contribution)[::-1][:_BARS]
        with styled():
            figure = figure_at(ax, 9.0, max(3.4, 1.2 + 0.19 * len(shown)))
            merit_axes, contribution_axes = figure.subplots(1, 2)
            percent_below = 100.0 * np.arange(1, len(finite) + 1) / len(self.merit)
            merit_axes.step(finite * scale, percent_below, where="post", color=BLUE)
            merit_axes.axvline(
                self.nominal * scale, color=GREY, linestyle=(0, (4, 2)), linewidth=0.9, label="as designed"
            )
            for percent in (50, 95):
                value = self.at_most(percent / 100.0) * scale
                if np.isfinite(value):
                    merit_axes.plot(value, percent, "o", color=RED, markersize=4.0)
                    merit_axes.annotate(
                        f"{percent} %: {value:.4g}", (value, percent), (6, -3), textcoords="offset points", va="top"
                    )
            merit_axes.set(
                xlabel=f"{self.criterion.title} [{unit}]", ylabel="telescopes at most there [%]", ylim=(0, 103)
            )
            merit_axes.margins(x=0.12)
            merit_axes.legend(loc="lower right")
            merit_axes.set_title(f"{counted(len(self.merit), 'draw')}, {self.method}")
            contribution_axes.barh(np.arange(len(shown)), self.contribution[shown] * scale, color=BLUE, height=0.7)
            contribution_axes.set_yticks(np.arange(len(shown)), [plain_text(self.tolerances[i].name) for i in shown])
            contribution_axes.invert_yaxis()
            contribution_axes.set_xlabel(f"contribution, added in squares [{unit}]")
            compensated = f", compensated by {', '.join(self.compensators)}" if self.compensators else ""
            largest_note = f" (largest {_BARS} of {len(self.contribution)})" if len(self.contribution) > _BARS else ""
            contribution_axes.set_title(f"each tolerance alone{largest_note}")
            figure.suptitle(f"{plain_text(self.telescope)}: within tolerances{compensated}", fontsize=11)
            return figure


@removed_arguments(**_REPLACED)
@check_arguments
def monte_carlo(
    telescope: Telescope | Request,
    tolerances: Iterable[Tolerance],
    merit: TracedMerit = "wavefront",
    n: int = 100,
    seed: int = 0,
    *,
    degrees_of_freedom: DegreesOfFreedom | None = None,
    compensators: Iterable[str] = (),
    method: MonteCarloMethod = "linear",
    fields: ArrayLike | None = None,
    progress: Callable[[int], None] | None = None,
) -> MonteCarlo:
    """Return the merits of telescopes drawn within tolerances.

    In the linear method the residuals of the merit are linear in the deviations, with their exact derivatives: a
    thousand draws cost little more than one. The merit itself, the root of a sum of squares, is not linearised. In
    the quadratic method the least sum of squares over the compensators has its second derivatives, from differences
    of exact gradients. The traced method traces each telescope. Compensators follow from linear least squares, in
    the traced method from as many steps as each telescope needs; those of the quadratic one are linear between
    telescopes in which they are settled like that. Rays fill the stop of each telescope as in
    :func:`~pachon.design.optimize.optimize.optimize`.

    Parameters
    ----------
    telescope : Telescope or Request
        The telescope as designed, with 6 rings of pupil points; or a request with the rays that are traced.
    tolerances : iterable of Tolerance
        Tolerances of degrees of freedom by name, or of parameters by address if there are none.
    merit : {"wavefront", "spots"}
        Merit function: rms without piston and tilt, or rms radius, over all fields and wavelengths.
    n, seed : int
        Number of draws, and their seed.
    degrees_of_freedom : DegreesOfFreedom, optional
        Degrees of freedom of the names.
    compensators : iterable of str
        Names of degrees of freedom that are optimised for each draw, such as the focus of the camera.
    method : {"linear", "quadratic", "traced"}
        Method, see above.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad], of a telescope; by default 31 over the field of view, see :func:`~.field_rings`.
    progress : callable, optional
        Called with the number of draws done since the last call (traced method).

    Raises
    ------
    ConfigError
        If a merit or method is unknown, a name is both tolerance and compensator, or fields are given beside a request.
    UnknownNameError, DomainError
        If a name does not exist, a number is out of range, or no light arrives.
    """
    tolerances, compensators = tuple(tolerances), tuple(compensators)
    deviations = draw(tolerances, seed, n)
    names = [t.name for t in tolerances] + list(compensators)
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{name!r} occurs more than once: expected either a tolerance or a compensator")
    if not isinstance(telescope, Request) and fields is None:
        fields = field_rings(telescope)
    beams = Beams.of(filling_stop(telescope), fields)
    filled = beams.request.telescope
    dof = (degrees_of_freedom or DegreesOfFreedom.of_parameters(filled, names)).select(names)
    criterion = Criterion.of(merit, filled, beams)
    toleranced = TolerancedMerit.of(filled, tolerances, compensators, dof, criterion)
    if method != "traced":
        return MonteCarlo.of(toleranced, method, deviations, None, toleranced.nominal)
    merits, values = np.empty(len(deviations)), toleranced.compensated(deviations)
    for i, linear in enumerate(values):
        values[i], merits[i] = toleranced.settled(linear)
        if progress is not None:
            progress(1)
    traced = merits, values[:, len(tolerances) :]
    return MonteCarlo.of(toleranced, method, deviations, traced, toleranced.traced_nominal)


@dataclass(frozen=True)
class Yield(Values):
    """Fraction of telescopes that meet a requirement.

    Attributes
    ----------
    requirement : float
        Requirement, in the unit of the merit.
    fraction : float
        Fraction that meets it.
    low, high : float
        Limits of the fraction at one standard deviation, Wilson's score interval: E. B. Wilson, J. Am. Stat. Assoc. 22,
        209 (1927).
    """

    requirement: float
    fraction: float
    low: float
    high: float

    @classmethod
    def of(cls, merits: np.ndarray, requirement: float, *, larger: bool = False) -> Yield:
        """Return the yield of merits, NaN for lost telescopes; with `larger`, at least the requirement is wanted."""
        met = merits >= requirement if larger else merits <= requirement
        n, p = len(merits), float(met.mean())
        middle = (p + 0.5 / n) / (1.0 + 1.0 / n)
        half = np.sqrt(p * (1.0 - p) / n + 0.25 / n**2) / (1.0 + 1.0 / n)
        return cls(requirement, p, float(middle - half), float(middle + half))
