"""Stamps that cover the same angle on the sky with pixels finer than those of the LSST."""

from __future__ import annotations

import math
from dataclasses import replace

from ..models.camera.photometry import PIXEL_SCALE
from .config import Configuration, with_options
from .experiment import Experiment


def stamp_side(pixels: int, pixel_scale: float) -> int:
    """Return the pixels on a side of stamps as wide on the sky as so many pixels of the LSST, and at least as many.

    Parameters
    ----------
    pixels : int
        Pixels of the LSST, an odd number.
    pixel_scale : float
        Angle of a pixel [rad].
    """
    # An odd number, of which no rounding of an angle makes the next.
    return max(pixels, 2 * math.ceil(0.5 * (pixels * PIXEL_SCALE / pixel_scale - 1.0) - 1e-3) + 1)


def with_stamps(experiment: Experiment, run: Configuration, pixels: int) -> Experiment:
    """Return an experiment whose stamps have so many pixels or more, and on finer ones the angle of those of the LSST.

    The experiment itself where the configuration of the run has a stamp.
    """
    if run.psf.stamp is not None:
        return experiment
    side = max(stamp_side(pixels, experiment.band.pixel_scale), experiment.stamp_size)
    return replace(experiment, config=with_options(experiment.config, psf__stamp=side))
