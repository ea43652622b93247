"""Configurations of an optimisation: telescopes with variables in common, such as bands or zoom positions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError
from ...models.parameters.parameters import resolved
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ...wavefront.pupil_sampling import DEFAULT_N_PUPIL, PupilSampling, SamplingName
from .merit import Beams
from .operand import Operand


@check_arguments
@dataclass(frozen=True, eq=False)
class DesignConfiguration:
    """One of several telescopes that are optimised together.

    Parameters
    ----------
    telescope : Telescope
        The telescope; its name is that of the configuration.
    fields, wavelengths, n_pupil
        As in :func:`~.optimize.optimize`; those of the optimisation where not given.
    field_weights : array_like, shape [n_field], optional
        Weights in the mean square; by default those of the design data with their fields, else equal.
    wavelength_weights, sampling, projection
        As in :meth:`pachon.Request.of`.
    weight : float
        Relative weight in the mean square.
    operands : sequence of Operand
        Operands of this configuration alone.
    """

    telescope: Telescope
    fields: ArrayLike | None = None
    wavelengths: ArrayLike | None = None
    field_weights: ArrayLike | None = None
    wavelength_weights: ArrayLike | None = None
    weight: float = 1.0
    operands: Sequence[Operand] = ()
    sampling: SamplingName | PupilSampling = "gauss"
    n_pupil: int | None = None
    projection: Projection = "zemax"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.weight) and self.weight > 0):
            raise DomainError(
                f"weight of {self.telescope.name} = {self.weight!r}: expected a positive number of a configuration"
            )

    def beams(self, telescope: Telescope, threads: int | None, *, dense: bool = False) -> Beams:
        """Return the rays of the configuration through a telescope.

        Where their number is not stated, `dense` ones are those of analyses: the few rings that suffice for a solver
        have the light at cut edges of the pupil to some per cent.
        """
        count = self.n_pupil
        if dense and count is None and self.sampling == "gauss":
            count = DEFAULT_N_PUPIL[self.sampling]
        return Beams.of(
            telescope,
            self.fields,
            self.wavelengths,
            field_weights=self.field_weights,
            wavelength_weights=self.wavelength_weights,
            sampling=self.sampling,
            n_pupil=count,
            projection=self.projection,
            threads=threads,
        )


def configurations(
    telescope: Telescope | DesignConfiguration | Sequence[Telescope | DesignConfiguration],
    fields: ArrayLike | None,
    wavelengths: ArrayLike | None,
    n_pupil: int | None,
) -> tuple[DesignConfiguration, ...]:
    """Return the configurations, with what they have in common where they state nothing themselves."""
    listed: Iterable[Telescope | DesignConfiguration]
    listed = [telescope] if isinstance(telescope, (Telescope, DesignConfiguration)) else telescope
    common = {"fields": fields, "wavelengths": wavelengths, "n_pupil": n_pupil}
    states = []
    for item in listed:
        state = DesignConfiguration(item) if isinstance(item, Telescope) else item
        changes: dict[str, Any] = {k: v for k, v in common.items() if getattr(state, k) is None}
        states.append(replace(state, telescope=resolved(state.telescope), **changes))
    if not states:
        raise ConfigError("telescope = []: expected at least one configuration")
    return tuple(states)
