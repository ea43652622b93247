"""Prior of the optics of an exposure: heights of the CCDs and residual wavefront."""

from __future__ import annotations

from dataclasses import dataclass

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...models.camera.height_budget import BudgetName, HeightBudget


@check_arguments
@dataclass(frozen=True)
class OpticsPrior:
    """What is believed of an exposure's optics before its stars are fitted.

    Attributes
    ----------
    budget : str, HeightBudget or None
        Unknown heights of the CCDs: "simulated", "specification", a budget of one's own, or None for a weak prior of
        coefficients of 10 um.
    alignment_rms : float
        Prior rms of the residual wavefront [m]: annular Zernike terms 4 to 11, each constant and linear over the field.
        0 for an aligned telescope.

    Raises
    ------
    DomainError
        If the rms is negative or not finite.
    """

    budget: BudgetName | HeightBudget | None = "simulated"
    alignment_rms: float = 0.2e-6

    def __post_init__(self) -> None:
        if not 0.0 <= self.alignment_rms < float("inf"):
            raise DomainError(f"alignment_rms = {self.alignment_rms!r}: expected a length from 0")
