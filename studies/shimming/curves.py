"""Width and ellipticity of the long-exposure PSF at places of the focal plane, as functions of the CCD height."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.units import ARCSEC
from ...measure.adaptive_moments import adaptive_moments
from ...measure.shapes import fwhm, measure_shapes
from ...models.camera.focal_plane import FocalPlane
from ...pipeline.experiment import Experiment
from ...pipeline.simulate.ccd_exposure import expose_positions
from ...reconstruction.focal_plane_psf.height_series import HeightSeries

#: Chebyshev nodes of the height: the widths of the engine are met to 1e-4 over +-40 um.
_NODES = 9
#: Columns of :func:`measured`: g1 and g2 of the adaptive moments.
G = slice(1, 3)
#: Column of the size T of the adaptive moments.
T = 3
#: Columns of the weighted e1 and e2.
E = slice(4, 6)


@dataclass(frozen=True, eq=False)
class Places:
    """Positions on CCDs, with fractions of the area."""

    ccd: np.ndarray  #: index of the CCD, [n]
    offset: np.ndarray  #: x, y from its centre along its own axes [m], [n, 2]
    position: np.ndarray  #: x, y on the focal plane [m], [n, 2]
    weight: np.ndarray  #: of a place, their sum 1, [n]

    @classmethod
    def gauss(cls, focal_plane: FocalPlane, names: tuple[str, ...], order: int) -> Places:
        """Return Gauss-Legendre nodes of an order along both sides of CCDs, those of their measured parts."""
        camera = focal_plane.camera
        nodes, weights = np.polynomial.legendre.leggauss(order)
        v, u = (a.ravel() for a in np.meshgrid(nodes, nodes, indexing="ij"))
        index = np.array([camera.ccd_index(name) for name in names])
        ccd, uv = np.repeat(index, u.size), np.tile(np.stack([u, v], axis=1), (len(index), 1))
        offset, area = camera.half_sizes[ccd] * uv, camera.pixels[ccd].prod(axis=1)
        weight = np.tile(np.outer(weights, weights).ravel(), len(index)) * (area / area.max())
        is_measured = focal_plane.surfaces.measured_at(ccd, *offset.T)
        ccd, offset, weight = ccd[is_measured], offset[is_measured], weight[is_measured]
        position = np.stack(camera.from_local(ccd, offset[:, 0], offset[:, 1]), axis=1)
        return cls(ccd, offset, position, weight / weight.sum())

    def heights(self, focal_plane: FocalPlane) -> np.ndarray:
        """Return the heights of a focal plane at the places [m]."""
        return focal_plane.surfaces.height(self.ccd, *self.offset.T)

    def mean(self, values: np.ndarray) -> float:
        """Return the mean over the area."""
        return float(np.einsum("n,n->", self.weight, values))


def focus_curves(experiment: Experiment, places: Places, reach: float, threads: int | None = None) -> HeightSeries:
    """Return the quantities of :func:`measured` as series of the height within `reach` [m] of zero."""
    return HeightSeries.of(
        lambda level: measured(experiment, level, places, threads), experiment.focal_plane, reach, _NODES
    )


def measured(experiment: Experiment, focal_plane: FocalPlane, places: Places, threads: int | None = None) -> np.ndarray:
    """Measure the PSFs at places of a focal plane, shape [n, 6].

    FWHM [arcsec]; g1, g2 and T [arcsec^2] of adaptive moments; e1 and e2 of weighted ones.
    """
    stars = expose_positions(replace(experiment, focal_plane=focal_plane), places.position, threads)
    moments = adaptive_moments(stars.image, stars.pixel_scale, threads=threads)
    shapes = measure_shapes(stars.image, stars.pixel_scale, experiment.weight_fwhm)
    width = fwhm(stars.image, stars.pixel_scale) / ARCSEC
    return np.stack([width, moments.g1, moments.g2, moments.T / ARCSEC**2, shapes.e1, shapes.e2], axis=1)
