"""Monte Carlo of tolerances: merits of many drawn telescopes, traced or from exact derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, check_choice
from ...core.plotting import BLUE, GREY, RED, figure_at, plain_text, styled
from ...core.result import Result
from ...models.parameters.degrees_of_freedom import DegreesOfFreedom
from ...models.parameters.tolerances import Tolerance, draw
from ...models.paraxial import following_stop
from ...models.telescope import Telescope
from ...wavefront.pupil_sampling import PupilSampling
from .merit import Beams, Merit, SpotMerit, WavefrontMerit
from .sensitivity import field_rings
from .toleranced_merit import TolerancedMerit
from .yields import Yield

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MERITS: dict[str, Callable[[Telescope, Beams], Merit]] = {"wavefront": WavefrontMerit, "spots": SpotMerit}
METHODS = ("linear", "quadratic", "traced")
_PERCENTILES = (50, 80, 90, 95)
#: Largest contributions in the plot.
_BARS = 20
_TITLES = {"wavefront": "rms wavefront", "spots": "rms spot radius"}


@dataclass(frozen=True)
class MonteCarlo(Result):
    """The merit of telescopes drawn within tolerances.

    Attributes
    ----------
    telescope : str
        Name of the telescope.
    merit_name : str
        "wavefront" (rms without piston and tilt) or "spots" (rms radius), over all fields and wavelengths.
    method : str
        "linear", "quadratic" or "traced".
    tolerances : tuple of Tolerance
        The tolerances.
    compensators : tuple of str
        Degrees of freedom that are optimised for each draw.
    units, compensator_units : tuple of str
        Units of the deviations and of the compensators.
    deviations : ndarray, shape [n, n_tolerance]
        Drawn deviations.
    moves : ndarray, shape [n, n_compensator]
        Values of the compensators.
    merit : ndarray, shape [n]
        Merit of each draw [m]; NaN where a traced telescope loses rays.
    nominal : float
        Merit of the telescope without deviations, compensated [m].
    contribution : ndarray, shape [n_tolerance]
        Rms contribution of each tolerance alone, compensated, in quadrature, to first order [m].
    """

    _table = ("merit", "deviations", "moves")

    telescope: str
    merit_name: str
    method: str
    tolerances: tuple[Tolerance, ...]
    compensators: tuple[str, ...]
    units: tuple[str, ...]
    compensator_units: tuple[str, ...]
    deviations: np.ndarray
    moves: np.ndarray
    merit: np.ndarray
    nominal: float
    contribution: np.ndarray

    @check_arguments
    def at_most(self, fraction: float) -> float:
        """Return the quantile of the merit [m] for a fraction (0 to 1) of the telescopes; lost ones count as worst."""
        return float(np.quantile(np.where(np.isnan(self.merit), np.inf, self.merit), fraction, method="higher"))

    @check_arguments
    def yield_at(self, requirement: float) -> Yield:
        """Return the fraction of the telescopes whose merit [m] is at most a requirement, with its binomial error."""
        return Yield.of(self.merit, requirement)

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
            left, right = figure.subplots(1, 2)
            percent_below = 100.0 * np.arange(1, len(finite) + 1) / len(self.merit)
            left.step(finite * scale, percent_below, where="post", color=BLUE)
            left.axvline(self.nominal * scale, color=GREY, linestyle=(0, (4, 2)), linewidth=0.9, label="as designed")
            for percent in (50, 95):
                value = self.at_most(percent / 100.0) * scale
                if np.isfinite(value):
                    left.plot(value, percent, "o", color=RED, markersize=4.0)
                    left.annotate(
                        f"{percent} %: {value:.4g}", (value, percent), (6, -3), textcoords="offset points", va="top"
                    )
            left.set(
                xlabel=f"{_TITLES[self.merit_name]} [{unit}]", ylabel="telescopes at most there [%]", ylim=(0, 103)
            )
            left.margins(x=0.12)
            left.legend(loc="lower right")
            left.set_title(f"{len(self.merit)} draws, {self.method}")
            right.barh(np.arange(len(shown)), self.contribution[shown] * scale, color=BLUE, height=0.7)
            right.set_yticks(np.arange(len(shown)), [plain_text(self.tolerances[i].name) for i in shown])
            right.invert_yaxis()
            right.set_xlabel(f"contribution, added in squares [{unit}]")
            compensated = f", compensated by {', '.join(self.compensators)}" if self.compensators else ""
            more = f" (largest {_BARS} of {len(self.contribution)})" if len(self.contribution) > _BARS else ""
            right.set_title(f"each tolerance alone{more}")
            figure.suptitle(f"{plain_text(self.telescope)}: within tolerances{compensated}", fontsize=11)
            return figure


@check_arguments
def monte_carlo(
    telescope: Telescope,
    tolerances: Iterable[Tolerance],
    merit: str = "wavefront",
    n: int = 100,
    seed: int = 0,
    *,
    degrees_of_freedom: DegreesOfFreedom | None = None,
    compensators: Iterable[str] = (),
    method: str = "linear",
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    sampling: str | PupilSampling = "gauss",
    n_pupil: int | None = None,
    projection: str = "zemax",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> MonteCarlo:
    """Return the merits of telescopes drawn within tolerances.

    In the linear method the residuals of the merit are linear in the deviations, with their exact derivatives: a
    thousand draws cost little more than one. The merit itself, the root of a sum of squares, is not linearised. In the
    quadratic method the sum of squares has its exact second derivatives, from differences of exact gradients. The
    traced method traces each telescope. Compensators follow from linear least squares, in the quadratic method from the
    quadratic itself. Rays fill the stop of each telescope as in :func:`~pachon.design.optimize.optimize.optimize`.

    Parameters
    ----------
    telescope, wavelengths, sampling, n_pupil, projection, threads
        As in :func:`~pachon.design.optimize.optimize.optimize`.
    tolerances : iterable of Tolerance
        Tolerances of degrees of freedom by name, or of parameters by address if there are none.
    merit : {"wavefront", "spots"}
        Merit function.
    n, seed : int
        Number of draws, and their seed.
    degrees_of_freedom : DegreesOfFreedom, optional
        Degrees of freedom of the names.
    compensators : iterable of str
        Names of degrees of freedom that are optimised for each draw, such as the focus of the camera.
    method : {"linear", "quadratic", "traced"}
        Method, see above.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; by default 31 over the field of view, see :func:`~.field_rings`.
    progress : callable, optional
        Called with the number of draws done since the last call (traced method).

    Raises
    ------
    ConfigError
        If a merit or method is unknown, or a name is both tolerance and compensator.
    UnknownNameError, DomainError
        If a name does not exist, a number is out of range, or no light arrives.
    """
    telescope, chosen, free = following_stop(telescope), tuple(tolerances), tuple(compensators)
    check_choice("merit", merit, MERITS)
    check_choice("method", method, METHODS)
    deviations = draw(chosen, seed, n)
    names = [t.name for t in chosen] + list(free)
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{name!r} occurs more than once: expected either a tolerance or a compensator")
    dof = (degrees_of_freedom or DegreesOfFreedom.of_parameters(telescope, names)).select(names)
    fields = field_rings(telescope) if fields is None else fields
    rays = Beams.of(
        telescope, fields, wavelengths, sampling=sampling, n_pupil=n_pupil, projection=projection, threads=threads
    )
    built = TolerancedMerit.of(telescope, chosen, free, dof, MERITS[merit](telescope, rays))
    moves = built.moves(deviations)
    if method == "traced":
        found = np.empty(len(deviations))
        for i, values in enumerate(np.concatenate([deviations, moves], axis=1)):
            found[i] = built.measure(built.telescope_at(values))
            if progress is not None:
                progress(1)
        nominal = built.measure(built.nominal_telescope)
    else:
        found = built.linear(deviations) if method == "linear" else built.quadratic(deviations)
        nominal = built.nominal
    return MonteCarlo(
        telescope=telescope.name,
        merit_name=merit,
        method=method,
        tolerances=chosen,
        compensators=free,
        units=dof.units[: len(chosen)],
        compensator_units=dof.units[len(chosen) :],
        deviations=deviations,
        moves=moves,
        merit=found,
        nominal=nominal,
        contribution=built.contribution,
    )
