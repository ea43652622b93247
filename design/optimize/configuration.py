"""Configurations of an optimisation: telescopes with variables in common, such as bands or zoom positions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError
from ...models.telescope import Telescope
from .operand import Operand


@check_arguments
@dataclass(frozen=True, eq=False)
class DesignConfiguration:
    """One of several telescopes that are optimised together.

    Parameters
    ----------
    telescope : Telescope
        The telescope; its name is that of the configuration.
    fields, wavelengths, field_weights, wavelength_weights
        As in :func:`~.optimize.optimize`; those of the optimisation where not given.
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

    def __post_init__(self) -> None:
        if not (np.isfinite(self.weight) and self.weight > 0):
            raise DomainError(
                f"weight of {self.telescope.name} = {self.weight!r}: expected a positive number of a configuration"
            )


def configurations(
    given: Telescope | Sequence[Telescope | DesignConfiguration], **common: Any
) -> tuple[DesignConfiguration, ...]:
    """Return the configurations, with what they have in common where they state nothing themselves."""
    listed: Iterable[Telescope | DesignConfiguration] = [given] if isinstance(given, Telescope) else given
    found = []
    for one in listed:
        own = {} if isinstance(one, Telescope) else {k: v for k in common if (v := getattr(one, k)) is not None}
        if isinstance(one, Telescope):
            found.append(DesignConfiguration(one, **common))
        else:
            found.append(DesignConfiguration(one.telescope, **(common | own), weight=one.weight, operands=one.operands))
    if not found:
        raise ConfigError("telescope = []: expected at least one configuration")
    return tuple(found)
