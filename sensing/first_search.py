"""First solution for a star, from a template: of small images from two seeings."""

from __future__ import annotations

import numpy as np

from .image_model import STRENGTH
from .solve import COARSE, FINE, Solution
from .star_fitter import StarFitter, Start

#: Width of an image without air over the FWHM of the seeing below which other wavefronts, in another seeing, explain it
#: nearly as well: of 48 donuts of the LSST, 100 to 300 um from focus, 16 were wrong by 0.1 to 2 um.
FEW_WIDTHS = 8.0
#: Seeing over that where a search starts up to which it is that of a donut.
_MUCH_WIDER = 2.0
#: Wavefront that telescopes have, Z4 on, root of the summed squares [m]: of two that explain an image alike the smaller
#: one is the likelier one.
_LIKELY = 0.3e-6


def first_solution(fitter: StarFitter, start: Start) -> Solution:
    """Return the best solution from a start; of a small image also from the seeing that it has without aberrations."""
    best = _by_low_terms(fitter, start, start.unknowns)
    if not _is_small(fitter, start, best):
        return best
    tolerance = COARSE if fitter.donut else FINE
    plain = fitter.of_first_terms(0).solve(start.stamp, start.unknowns, tolerance=tolerance)
    from_plain = _by_low_terms(fitter, start, plain.stars[0])

    def loss(fit: Solution) -> float:
        wave = fit.shared[: len(fitter.instrument.noll)]
        return fit.loss + float(wave @ wave) / _LIKELY**2

    return min(best, from_plain, key=loss)


def _by_low_terms(fitter: StarFitter, start: Start, unknowns: np.ndarray) -> Solution:
    """Return the best solution from unknowns of a star without aberrations, by low terms of these first.

    Beside what a template lacks the priors of further terms count for nothing, and these lead to other solutions.
    """
    tolerance = COARSE if fitter.donut else FINE
    count = fitter.instrument.terms.first_low
    if not (fitter.donut and fitter.fits_wavefront and count):
        return fitter.solve(start.stamp, unknowns, tolerance=tolerance)
    low = fitter.of_first_terms(count).solve(start.stamp, unknowns, tolerance=tolerance)
    shared = np.pad(low.shared, (0, len(fitter.precision) - count))
    return fitter.solve(start.stamp, low.stars[0], shared, tolerance)


def _is_small(fitter: StarFitter, start: Start, solution: Solution) -> bool:
    """Return whether an image with a wavefront is so small that another seeing may explain it."""
    instrument = fitter.instrument
    if instrument.known_seeing or not len(solution.shared):
        return False
    begun, at_end = (float(instrument.seeing.fwhm(values[STRENGTH])) for values in (start.unknowns, solution.stars[0]))
    fwhm = np.clip(at_end, begun, _MUCH_WIDER * begun)
    return bool(fitter.light.diameter < FEW_WIDTHS * fwhm * fitter.light.scale)
