r"""Slope of the detector's response across donuts.

A response of :math:`1 + g \cdot (x - \bar x)` at place x makes the light that lands there as much stronger. Where the
response changes little across the blur, it is that of the landing points: light of a fraction w at x has the derivative
:math:`w (x - \bar x)` by g, with the mean :math:`\bar x` of all light.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..models.telescope import Telescope
from ..raytrace.rays import parallel_rays
from .donut_rays import landing_of
from .pupil_cells import PupilCells


def cells_with_response(
    telescope: Telescope, direction: np.ndarray, wavelength: float, cells: PupilCells, pixel: float, first: int
) -> PupilCells:
    """Return cells with rates of change of their light by slopes of the response along x and y [1/pixel].

    Parameters
    ----------
    telescope : Telescope
        Telescope with the detector where the light meets it.
    direction : ndarray, shape [3]
        Unit vector along which the light travels.
    wavelength : float
        Vacuum wavelength [m].
    cells : PupilCells
        Cells of the pupil.
    pixel : float
        Side of a pixel [m].
    first : int
        Number of the rates by rims before which these stand.
    """
    places = landing_of(telescope, parallel_rays(telescope, direction[None], wavelength, cells.points)) / pixel
    slopes = cells.weights[:, None] * (places - cells.weights @ places / cells.weights.sum())
    rates = np.zeros((len(cells), 0)) if cells.rates is None else cells.rates
    return replace(cells, rates=np.concatenate([rates[:, :first], slopes, rates[:, first:]], axis=1))
