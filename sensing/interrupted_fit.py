"""Ctrl-C during a fit of donuts."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .result import DonutFit


class InterruptedFitError(KeyboardInterrupt):
    """Ctrl-C during a fit of donuts, with the results of those that were finished.

    Parameters
    ----------
    fit : DonutFit
        Results; the other donuts are flagged ``INTERRUPTED``.
    """

    def __init__(self, fit: DonutFit) -> None:
        super().__init__()
        self.fit = fit
