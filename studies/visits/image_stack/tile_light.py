"""Light of the stacked images of a tile, over that on the axis: the mean vignetting of the visits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from ....pipeline.experiment import Experiment
from ....pipeline.resolved_values import resolved_value
from ....wavefront.psf.clear_pupil import lit_fractions
from ..plan import Visit
from ..psf_visit import StackFrame, middle_wavelength, visit_telescope
from .tiles import Tile

#: Nodes along a side, 3.4 arcmin apart on a tile of the LSST: between them light is linear to 3e-4.
_NODES = 5


@dataclass(frozen=True, eq=False)
class TileLight:
    """Lit fraction of the pupil over that on the axis, the mean of visits, on a tile.

    Attributes
    ----------
    pixels : ndarray, shape [n]
        Nodes along a side, counted from the first pixel of the tile.
    lit_fraction : ndarray, shape [n, n]
        At the nodes (y, x).
    """

    pixels: np.ndarray
    lit_fraction: np.ndarray

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        frame: StackFrame,
        tile: Tile,
        visits: Sequence[Visit],
        threads: int | None = None,
    ) -> TileLight:
        """Return the mean over the visits whose CCDs a node falls on; over all, where it falls on none."""
        camera, wavelength = experiment.camera, middle_wavelength(experiment)
        ccds = [camera.ccd_index(name) for name in resolved_value(experiment.config.ccds)]
        nodes = np.linspace(0.0, tile.side - 1.0, _NODES)
        places = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
        sky = (places + tile.first) @ np.linalg.inv(frame.matrix).T
        lit, on_ccd = np.empty((2, len(visits), len(sky)))
        for i, visit in enumerate(visits):
            telescope = visit_telescope(experiment, visit)
            at = visit.on_detector(telescope, sky, wavelength, threads)
            on_ccd[i] = np.any([camera.depth(ccd, *at.T) >= 0.0 for ccd in ccds], axis=0)
            lit[i] = lit_fractions(telescope, visit.directions(sky), wavelength, threads)
        weight = np.where(on_ccd.any(axis=0), on_ccd, 1.0)
        mean = (weight * lit).sum(axis=0) / weight.sum(axis=0) / experiment.lit_fraction_on_axis
        return cls(nodes, mean.reshape(_NODES, _NODES))

    @property
    def in_middle(self) -> float:
        """In the middle of the tile; 1, as on the axis, where it is dark."""
        middle = 0.5 * (self.pixels[0] + self.pixels[-1])
        return float(self.at(np.array([[middle, middle]]))[0]) or 1.0

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """Return the lit fractions at pixels (x, y) of the tile, shape [n, 2] to [n]."""
        interpolate = RegularGridInterpolator(
            (self.pixels, self.pixels), self.lit_fraction, bounds_error=False, fill_value=None
        )
        return np.asarray(interpolate(pixels[:, ::-1]))
