"""Fit of one star with its light on the other side of focus than is given."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..models.zernike_polynomials import noll_to_nm
from .image_model import RATIO
from .likelihood import Stamp
from .neighbours import explains_more
from .sides import CONTRADICTED, BothSides, SideFit
from .solve import COARSE, Solution
from .star_fitter import StarFitter, Start

#: Loss a coarse pixel from which on the other side of focus is tried; photons leave 0.1, since smoothed noise is small.
MISFIT = 0.15
#: Loss a coarse pixel from which on what the model lacks may be a patch of the stamp that is no star, and something of
#: another size is no donut.
POOR = 1.0
#: Steps of the fit on the other side of focus.
_MIRRORED_STEPS = 8
#: Loss of the other side beyond that of the given one, over what contradicts it, with which it is not what was given.
_HOPELESS = 2.0


class OtherSide:
    """Light of the star of a search on the other side of focus.

    Parameters
    ----------
    fitter : StarFitter
        Pixels of the star, and its light on the side that is given.
    start : Start
        Where the search begins.
    """

    def __init__(self, fitter: StarFitter, start: Start) -> None:
        self._fitter, self._start = fitter, start

    @cached_property
    def stamp(self) -> Stamp:
        """The pixels of the search and this light."""
        light = self._fitter.instrument.mirrored(self._fitter.light)
        return self._fitter.stamp(light, self._start.pixels)

    def compared(self, solution: Solution) -> tuple[BothSides | None, Solution | None]:
        """Return the fits on the side of focus that is given and on the other one, and this; None for blends.

        About the axis a wavefront W of one side of focus and -W turned by 180 degrees of the other make one image: the
        search starts there.
        """
        star, fitter, start = solution.stars[0], self._fitter, self._start
        if len(star) > RATIO:
            return None, None
        noll, count = fitter.instrument.noll, start.stamp.used.sum()
        shared = np.zeros_like(solution.shared)
        even = np.array([noll_to_nm(int(j))[0] % 2 == 0 for j in noll])
        shared[: len(noll)] = np.where(even, -1.0, 1.0) * solution.shared[: len(noll)]
        # Far from both sides alike, it does not matter how far, nor that some other cells of the pupil are lit.
        hopeless = solution.loss + _HOPELESS * CONTRADICTED / _loss_scale(solution.loss / count)
        stamp = fitter.mirrored_stamp(fitter.instrument.mirrored(fitter.light, exact=False), start)
        mirrored = fitter.solve(stamp, star, shared, COARSE, _MIRRORED_STEPS, hopeless)
        if mirrored.loss < hopeless:
            mirrored = fitter.solve(self.stamp, mirrored.stars[0], mirrored.shared, COARSE, _MIRRORED_STEPS, hopeless)
        # What no side explains is in units of what is left.
        scale = _loss_scale(min(solution.loss, mirrored.loss) / count)
        n = len(fitter.instrument.terms.requested)
        believed_side, mirrored_side = (
            SideFit(scale * side.loss, side.shared[:n], side.shared_covariance[:n, :n] / scale)
            for side in (solution, mirrored)
        )
        return BothSides(believed_side, mirrored_side, fitter.light.depth), mirrored

    def is_better(self, solution: Solution, mirrored: Solution | None) -> bool:
        """Return whether the image fits a detector on this side of focus better, by a fit there or a new search."""
        misfit = misfit_of(self._start.stamp, solution)
        if misfit < MISFIT:
            return False
        if mirrored is None or misfit > POOR:
            # A search of its own: nothing of an earlier one is near.
            self.stamp.forget()
            begun = self._fitter.start_on(self._start.pixels, self.stamp)
            mirrored = self._fitter.solve(self.stamp, begun.unknowns, tolerance=COARSE, hopeless=solution.loss)
        return explains_more(mirrored, solution)


def _loss_scale(loss: float) -> float:
    """Return the factor by which losses count where the better fit leaves a loss a pixel."""
    return 1.0 / max(1.0, loss / MISFIT)


def misfit_of(stamp: Stamp, solution: Solution) -> float:
    """Return the loss a pixel."""
    return float(solution.loss) / max(int(stamp.used.sum()), 1)
