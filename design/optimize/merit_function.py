"""Merit functions of an optimisation, apart from telescope and rays: spot size, wavefront error, or any merit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, shown
from ...core.units import metres
from ...models.telescope import Telescope
from ..metrics.spots import SpotReference, spot_diagram
from .merit import Beams, Merit, SpotMerit, WavefrontMerit

MeritName = Literal["spots", "wavefront"]
#: Most rays of a goal: beyond, an array shows one number very often.
_MOST_RAYS = 10**9


@runtime_checkable
class MeritFunction(Protocol):
    """Merit function that becomes a merit with telescope and rays."""

    @property
    def name(self) -> str:
        """Name in results."""

    @property
    def of_one_telescope(self) -> bool:
        """Whether it holds for one telescope only."""

    def of(self, telescope: Telescope, beams: Beams) -> Merit:
        """Return the merit of rays that are lit in a telescope."""

    def rms(self, telescope: Telescope, beams: Beams) -> float:
        """Return the rms of a telescope as it stands [m], of the light that arrives."""


@check_arguments
@dataclass(frozen=True)
class SpotSize:
    """Merit function: rms spot radius.

    Parameters
    ----------
    reference : {"centroid", "chief"}
        Origin of the landing points.
    """

    name: ClassVar[str] = "spots"
    of_one_telescope: ClassVar[bool] = False

    reference: SpotReference = "centroid"

    def of(self, telescope: Telescope, beams: Beams) -> Merit:
        """Return the merit of rays that are lit in a telescope."""
        return SpotMerit(telescope, beams, self.reference)

    def rms(self, telescope: Telescope, beams: Beams) -> float:
        """Return the rms radius [m]; about the centroid that of :func:`~pachon.design.metrics.spots.spots`."""
        if self.reference != "centroid":
            return float(np.linalg.norm(self.of(telescope, beams).residuals(telescope)))
        radii = spot_diagram(beams.request).rms_radius
        counted = beams.field_weights > 0.0
        return float(np.sqrt(beams.field_weights[counted] @ radii[counted] ** 2))


@check_arguments
@dataclass(frozen=True, eq=False)
class WavefrontError:
    """Merit function: rms wavefront without piston and tilt.

    Parameters
    ----------
    goal : array_like or Quantity, shape [n_field, n_wave, n_pupil], optional
        Target wavefronts [m] of one telescope, such as those of :func:`~.optimize.wavefronts`: NaN where no light
        passes; zero by default.
    """

    name: ClassVar[str] = "wavefront"

    goal: ArrayLike | None = None

    def __post_init__(self) -> None:
        if self.goal is None:
            return
        goal = metres(self.goal, "goal")
        if goal.ndim != 3 or goal.size > _MOST_RAYS:
            raise DomainError(
                f"goal has shape {goal.shape}: expected [n_field, n_wave, n_pupil], at most {_MOST_RAYS} rays",
                key="goal",
            )
        object.__setattr__(self, "goal", goal)

    @property
    def of_one_telescope(self) -> bool:
        """Whether it holds for one telescope only."""
        return self.goal is not None

    def of(self, telescope: Telescope, beams: Beams) -> Merit:
        """Return the merit of rays that are lit in a telescope."""
        return WavefrontMerit(telescope, beams, self.goal)

    def rms(self, telescope: Telescope, beams: Beams) -> float:
        """Return the rms wavefront [m], less the goal."""
        return float(np.linalg.norm(self.of(telescope, beams).residuals(telescope)))


@dataclass(frozen=True, eq=False)
class _BoundMerit:
    """Merit of one telescope with rays of its own."""

    of_one_telescope: ClassVar[bool] = True

    merit: Merit

    @property
    def name(self) -> str:
        return type(self.merit).__name__

    def of(self, telescope: Telescope, beams: Beams) -> Merit:
        del telescope, beams
        return self.merit

    def rms(self, telescope: Telescope, beams: Beams) -> float:
        del beams
        return float(np.linalg.norm(self.merit.residuals(telescope)))


def merit_function(merit: MeritName | MeritFunction | Merit) -> MeritFunction:
    """Return the merit function of a name or an object; ConfigError for another."""
    if isinstance(merit, str):
        for function in (SpotSize(), WavefrontError()):
            if merit == function.name:
                return function
    elif not isinstance(merit, type):
        if isinstance(merit, MeritFunction):
            return merit
        if hasattr(merit, "derivatives"):
            return _BoundMerit(merit)
    raise ConfigError(
        f"merit = {shown(merit)}: expected 'spots', 'wavefront', a SpotSize, a WavefrontError or a Merit", key="merit"
    )
