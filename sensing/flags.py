"""Flags of donuts: reasons why a fit has no result, and remarks on those that have one."""

from __future__ import annotations

from enum import IntFlag


class DonutFlag(IntFlag):
    """Outcome of the fit of one donut; zero for a clean one.

    ``BLENDED`` (a second star was fitted too), ``CLIPPED`` (pixels far off the model, cosmic rays for example, were
    left out) and ``POOR_FIT`` (chi-square is far above the number of pixels, so that errors are larger than claimed)
    are remarks: there are results. With any other flag the results of the donut are NaN.

    So is ``AMBIGUOUS_SIDE``: the image fits as well on the other side of focus, with another wavefront. Results are
    those of the side that is given.

    ``NO_DONUT``: nothing like a donut stands on the stamp. ``CUT_OFF``: more than a twentieth of the light falls beside
    the stamp. ``SATURATED``: too many pixels are saturated. ``DEFOCUS_SIGN``: the image fits the other side of focus
    better. ``OUTSIDE_FIELD``: the telescope does not cover the field. ``NO_LIGHT``: no light passes the telescope
    there, or the chief ray does not reach a CCD. ``TOO_FEW_PHOTONS``: fewer photons than unknowns.
    ``NOT_FINITE``: an unmasked pixel is not a finite number. ``NOT_CONVERGED``: the fit did not converge.
    """

    OK = 0
    BLENDED = 1
    CLIPPED = 2
    NO_DONUT = 4
    CUT_OFF = 8
    SATURATED = 16
    DEFOCUS_SIGN = 32
    OUTSIDE_FIELD = 64
    NO_LIGHT = 128
    TOO_FEW_PHOTONS = 256
    NOT_FINITE = 512
    NOT_CONVERGED = 1024
    POOR_FIT = 2048
    AMBIGUOUS_SIDE = 16384

    @property
    def usable(self) -> bool:
        """Whether the donut has results."""
        return not self & ~(DonutFlag.BLENDED | DonutFlag.CLIPPED | DonutFlag.POOR_FIT | DonutFlag.AMBIGUOUS_SIDE)

    @property
    def reasons(self) -> str:
        """Names of the flags, lower case, with commas between them."""
        return ", ".join((flag.name or "").lower().replace("_", " ") for flag in type(self) if flag and flag in self)
