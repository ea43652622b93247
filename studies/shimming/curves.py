"""Width and ellipticity of the long-exposure PSF at places of the focal plane, as functions of the CCD height."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev

from ...core.units import ARCSEC
from ...models.camera.focal_plane import FocalPlane
from ...pipeline.experiment import Experiment
from ...pipeline.focal_plane_psf.response import level_plane
from ...pipeline.measure.shapes import fwhm, measure_shapes
from ...pipeline.simulate.ccd_exposure import expose_positions

#: Chebyshev nodes of the height: the widths of the engine are met to 1e-4 over +-40 um.
_NODES = 9


@dataclass(frozen=True, eq=False)
class Places:
    """Places on CCDs, with shares of the area."""

    ccd: np.ndarray  #: index of the CCD, [n]
    offset: np.ndarray  #: x, y from its centre [m], [n, 2]
    position: np.ndarray  #: x, y on the focal plane [m], [n, 2]
    weight: np.ndarray  #: of a place, their sum 1, [n]

    @classmethod
    def gauss(cls, focal_plane: FocalPlane, names: tuple[str, ...], order: int) -> Places:
        """Return Gauss-Legendre nodes of an order along both sides of CCDs, those of their measured parts."""
        camera = focal_plane.camera
        nodes, weights = np.polynomial.legendre.leggauss(order)
        y, x = (camera.half_size * a.ravel() for a in np.meshgrid(nodes, nodes, indexing="ij"))
        index = np.array([camera.ccd_index(name) for name in names])
        ccd, offset = np.repeat(index, x.size), np.tile(np.stack([x, y], axis=1), (len(index), 1))
        weight = np.tile(np.outer(weights, weights).ravel(), len(index))
        known = focal_plane.surfaces.measured_at(ccd, *offset.T)
        ccd, offset, weight = ccd[known], offset[known], weight[known]
        return cls(ccd, offset, camera.centers[ccd] + offset, weight / weight.sum())

    def heights(self, focal_plane: FocalPlane) -> np.ndarray:
        """Return the heights of a focal plane at the places [m]."""
        return focal_plane.surfaces.height(self.ccd, *self.offset.T)

    def mean(self, values: np.ndarray) -> float:
        """Return the mean over the area."""
        return float(np.einsum("n,n->", self.weight, values))


@dataclass(frozen=True, eq=False)
class FocusCurves:
    """FWHM [arcsec], e1 and e2 at places as Chebyshev series of the height over +- `reach`."""

    coefficients: np.ndarray  #: [n_node, 3, n]
    reach: float  #: [m]

    @classmethod
    def of(cls, experiment: Experiment, places: Places, reach: float, threads: int | None = None) -> FocusCurves:
        """Evaluate the engine at the nodes, on level focal planes."""
        nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
        levels = [level_plane(experiment.focal_plane, reach * node) for node in nodes]
        values = np.stack([measured(experiment, level, places, threads) for level in levels])
        inverse = np.linalg.inv(chebyshev.chebvander(nodes, _NODES - 1))
        return cls(np.einsum("kj,jqn->kqn", inverse, values), reach)

    def chosen(self, rows: np.ndarray) -> FocusCurves:
        """Return the curves of some places."""
        return FocusCurves(self.coefficients[:, :, rows], self.reach)

    def at(self, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values at heights [m], shape [3, n], and their derivatives with respect to them [1/m]."""
        t = heights / self.reach
        slope = chebyshev.chebder(self.coefficients, axis=0) / self.reach
        terms = chebyshev.chebvander(t, _NODES - 1).T
        return np.einsum("kn,kqn->qn", terms, self.coefficients), np.einsum("kn,kqn->qn", terms[:-1], slope)


def measured(experiment: Experiment, focal_plane: FocalPlane, places: Places, threads: int | None = None) -> np.ndarray:
    """Return FWHM [arcsec], e1 and e2 of the PSFs at places of a focal plane, shape [3, n]."""
    stars = expose_positions(replace(experiment, focal_plane=focal_plane), places.position, threads)
    shapes = measure_shapes(stars.image, stars.pixel_scale, experiment.weight_fwhm)
    return np.stack([fwhm(stars.image, stars.pixel_scale) / ARCSEC, shapes.e1, shapes.e2])
