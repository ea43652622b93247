"""Flags of donuts: reasons why a fit has no result, and remarks on those that have one."""

from __future__ import annotations

from enum import IntFlag


class DonutFlag(IntFlag):
    """Outcome of the fit of one donut; zero for a clean one.

    Eight flags are remarks: the results hold. ``BLENDED``: neighbours were fitted too. ``CLIPPED``: pixels far off the
    model, not finite or saturated were left out, cosmic rays for example. ``CUT_OFF``: a twentieth of the light or more
    falls beside the stamp or on regions of it that are not used; errors are those of what remains. ``POOR_FIT``:
    chi-square is far above the number of pixels, and errors have what the residuals say. ``OTHER_SIZE``: the donut is
    larger or smaller than that of the telescope by more than 8 %, as with another defocus or pixel size. ``RIM_MOVED``:
    a rim or a spider stands elsewhere than the prescription has it, and was fitted too. ``ORIENTATION``: stamps of the
    exposure fit better as mirror images, or turned by quarters (set by the command). ``AMPLIFIER_STEP``: sky or gain
    change along a column or row, as where two amplifiers meet, and were fitted too.

    So is ``AMBIGUOUS_SIDE``: the image fits as well on the other side of focus, with another wavefront; results are
    those of the side that is given.

    With any other flag the results of the donut are NaN. ``NO_DONUT``: nothing like a donut stands on the stamp.
    ``MOSTLY_LOST``: more than 55 % of the light falls beside the stamp or on pixels that are not used. ``SATURATED``,
    ``NOT_FINITE``: pixels that are saturated or not finite are the reason why the remaining ones have no result.
    ``DEFOCUS_SIGN``: the image fits the other side of focus better. ``OUTSIDE_FIELD``: the telescope does not cover the
    field. ``NO_LIGHT``: no light passes the telescope there, or the chief ray does not reach a CCD.
    ``TOO_FEW_PHOTONS``: the donut stands out from the noise by less than 9 times the root of the number of Zernikes.
    ``UNDETERMINED``: those of a donut have errors above 1 um rms, as where most of the pupil is dark.
    ``NOT_CONVERGED``: the fit did not converge. ``INTERRUPTED``: Ctrl-C came before the fit.
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
    RIM_MOVED = 4096
    OTHER_SIZE = 8192
    AMBIGUOUS_SIDE = 16384
    MOSTLY_LOST = 32768
    ORIENTATION = 65536
    AMPLIFIER_STEP = 131072
    INTERRUPTED = 262144
    UNDETERMINED = 524288

    @property
    def usable(self) -> bool:
        """Whether the donut has results."""
        return not self & ~_REMARKS

    @property
    def reasons(self) -> str:
        """Names of the flags, lower case, with commas between them."""
        return ", ".join((flag.name or "").lower().replace("_", " ") for flag in type(self) if flag and flag in self)


#: Flags with which the results hold.
_REMARKS = (
    DonutFlag.BLENDED
    | DonutFlag.CLIPPED
    | DonutFlag.CUT_OFF
    | DonutFlag.POOR_FIT
    | DonutFlag.OTHER_SIZE
    | DonutFlag.RIM_MOVED
    | DonutFlag.AMBIGUOUS_SIDE
    | DonutFlag.ORIENTATION
    | DonutFlag.AMPLIFIER_STEP
)
