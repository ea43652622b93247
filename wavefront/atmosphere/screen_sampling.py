"""Sampling of the phase screens of an atmosphere: grids of the low and high modes, and the wavenumber between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...core.arguments import check_arguments
from ...core.units import require_positive
from .layer_screens import screen_samples

#: Default cut-off in units of 1/r0 [rad/m]. Of 1.0, 1.2, 1.4 and 2.0 this brings the fast PSF engine's ellipticities
#: nearest to the wave engine's (docs/evidence/engines.md); beyond it geometric optics makes the image too wide.
DEFAULT_CUTOFF = 1.4


@check_arguments
@dataclass(frozen=True)
class ScreenSampling:
    """Sampling of the screens of an :class:`~pachon.Atmosphere`.

    Attributes
    ----------
    screen_size : int
        Samples on a side of a low screen.
    screen_length : float
        Side of a low screen [m]. No layer may drift farther in an exposure; modes longer than it are missing.
    fine_size : int
        Samples on a side of a high screen.
    fine_pixel : float
        Distance of the samples of a high screen [m].
    cutoff : float, optional
        Wavenumber that divides the low from the high modes [rad/m]; by default 1.4 over the Fried parameter, but at
        most half the Nyquist limit of the low screens.
    fixed_modulus : bool
        Whether modes have a fixed modulus and a random phase in place of a Gaussian amplitude (Jee & Tyson 2011,
        eq. 2); not a Gaussian field.

    Raises
    ------
    DomainError
        If a number is outside its range.
    """

    screen_size: int = 8192
    screen_length: float = 1300.0
    fine_size: int = 3072
    fine_pixel: float = 0.014
    cutoff: float | None = None
    fixed_modulus: bool = False

    def __post_init__(self) -> None:
        for name in ("screen_size", "fine_size"):
            screen_samples(getattr(self, name), name)
        require_positive(self.screen_length, "screen_length", "metres")
        require_positive(self.fine_pixel, "fine_pixel", "metres")
        if self.cutoff is not None:
            require_positive(self.cutoff, "cutoff", "radians per metre")

    def cutoff_at(self, r0: float) -> float:
        """Return the wavenumber between low and high modes [rad/m] for a Fried parameter [m]."""
        if self.cutoff is not None:
            return float(self.cutoff)
        return min(DEFAULT_CUTOFF / r0, largest_cutoff(self.screen_size, self.screen_length))


def largest_cutoff(screen_size: int, screen_length: float) -> float:
    """Return the largest default cut-off [rad/m] of low screens with samples on a side of a length [m].

    It is half the Nyquist limit: rays read slopes at the nearest sample, then at most an eighth of a wave away.
    """
    return 0.5 * math.pi * screen_size / screen_length
