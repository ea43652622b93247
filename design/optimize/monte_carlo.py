"""Monte Carlo of tolerances: merits of many drawn telescopes, traced or from exact derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, PachonError, check_choice
from ...core.plotting import BLUE, GREY, RED, figure_at, plain_text, styled
from ...core.result import Result
from ...models.telescope import Telescope
from ...wavefront.pupil_sampling import PupilSampling
from ..parameters.degrees_of_freedom import DegreesOfFreedom
from ..parameters.tolerances import Tolerance, draw
from .jacobian import ParameterColumns
from .merit import Beams, Merit, SpotMerit, WavefrontMerit
from .optimize import NO_EFFECT
from .sensitivity import field_rings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MERITS: dict[str, Callable[[Telescope, Beams], Merit]] = {"wavefront": WavefrontMerit, "spots": SpotMerit}
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
        "linear" or "traced".
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
    thousand draws cost little more than one. The merit itself, the root of a sum of squares, is not linearised. The
    traced method traces each telescope. Compensators follow from linear least squares in both.

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
    method : {"linear", "traced"}
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
    chosen, free = tuple(tolerances), tuple(compensators)
    check_choice("merit", merit, MERITS)
    if method not in ("linear", "traced"):
        raise ConfigError(f"method = {method!r}: expected 'linear' or 'traced'")
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
    judge: Merit = MERITS[merit](telescope, rays)
    prepared, parameters, matrix = dof.parameter_matrix(telescope)
    columns = ParameterColumns.at(prepared, parameters)
    residuals, slopes = judge.derivatives(columns)
    slopes = slopes @ matrix
    by_draw, by_free = slopes[:, : len(chosen)], slopes[:, len(chosen) :]
    # Rounding errors of the effects, a fraction of the terms that cancel.
    least = NO_EFFECT * (judge.size_of_terms(columns) @ np.abs(matrix))[len(chosen) :] if free else np.zeros(0)
    setting = _settings(by_free, free, least)
    # Residuals and their slopes after compensation.
    fixed = residuals - by_free @ (setting @ residuals)
    left = by_draw - by_free @ (setting @ by_draw)
    moves = -(deviations @ (setting @ by_draw).T + setting @ residuals)
    contribution = np.linalg.norm(left, axis=0) * np.array([t.spread for t in chosen])
    if method == "linear":
        # |r + J v|^2 through the small matrices J^T J and J^T r.
        square = fixed @ fixed + 2.0 * deviations @ (left.T @ fixed)
        square = square + np.einsum("ni,ij,nj->n", deviations, left.T @ left, deviations)
        found = np.sqrt(np.maximum(square, 0.0))
        nominal = float(np.linalg.norm(fixed))
    else:
        found = np.empty(len(deviations))
        for i, values in enumerate(np.concatenate([deviations, moves], axis=1)):
            found[i] = _merit(judge, dof.apply(telescope, values))
            if progress is not None:
                progress(1)
        still = np.concatenate([np.zeros(len(chosen)), -(setting @ residuals)])
        nominal = _merit(judge, dof.apply(telescope, still))
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
        contribution=contribution,
    )


def _merit(judge: Merit, telescope: Telescope) -> float:
    """Return the merit of a telescope [m]; NaN where its light is lost."""
    try:
        return float(np.linalg.norm(judge.residuals(telescope)))
    except PachonError:
        return np.nan


def _settings(slopes: np.ndarray, names: tuple[str, ...], least: np.ndarray) -> np.ndarray:
    """Return the matrix from residuals to minus the best setting of compensators, shape [n_free, n]."""
    size = np.linalg.norm(slopes, axis=0)
    for name, value, rounding in zip(names, size, least, strict=True):
        if not value > rounding:
            raise DomainError(f"compensator {name!r} has no effect on the merit: expected one that has")
    return np.linalg.pinv(slopes / size, rcond=1e-9) / size[:, None] if names else np.zeros((0, len(slopes)))
