"""Shapes along the axes of the sky, from shapes along the axes of pixels and world coordinates.

The convention is that of TreeCorr, GalSim (``use_sky_coords``), DES and Rubin: x points west and y north, as the sky is
seen with north up and east to the left. g1 > 0 is elongated east to west, g2 > 0 north-west to south-east, and TreeCorr
on (ra, dec, g1, g2) gives a positive tangential shear for tangential galaxies.

A shape (a - b)/(a + b) is carried by the Jacobian J = d(west, north)/d(x, y) as shear is (Bernstein & Jarvis 2002, AJ
123, 583, sec. 2): with its polar decomposition into a symmetric matrix of shear h and an orthogonal one, which turns x
by an angle t, g becomes (g' + h)/(1 + conj(h) g'), where g' = exp(2 i t) g, or exp(2 i t) conj(g) where J mirrors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError, shown
from ..core.point_plots import draw_shapes
from ..core.result import Result
from ..core.units import pure_numbers
from .pointing import Pointing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Step of the central differences of world coordinates [pixel]: distortions of second order cancel, and the rounding
#: of degrees is 1e-9 of it.
STEP = 0.5


@dataclass(frozen=True, eq=False)
class SkyShapes(Result):
    """Shapes along the axes of the sky, x to the west and y to the north, where they are.

    Attributes
    ----------
    ra, dec : ndarray, shape [n]
        Right ascension and declination [rad].
    g1_sky, g2_sky : ndarray, shape [n]
        (a - b)/(a + b), > 0 along east to west, and along north-west to south-east; NaN where the shape is.
    """

    _table = ("ra", "dec", "g1_sky", "g2_sky")

    ra: np.ndarray
    dec: np.ndarray
    g1_sky: np.ndarray
    g2_sky: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the shapes in their plane, coloured by the declination."""
        return draw_shapes(ax, self.g1_sky, self.g2_sky, np.rad2deg(self.dec), "declination [deg]")

    def __len__(self) -> int:
        return len(self.ra)


@check_arguments
def to_sky(shapes: Any, wcs: Any, x: ArrayLike, y: ArrayLike) -> SkyShapes:
    """Return shapes along the pixels as shapes on the sky.

    Parameters
    ----------
    shapes : Shapes, GalaxyFits, array or any object with g1 and g2, or e1 and e2
        Shapes (a - b)/(a + b) along x and along the diagonal x = y of the pixels; an array has the shape [n, 2].
        Those without a weight, as of galaxies and adaptive moments, are carried exactly. The shear of the pixels
        themselves, below 1e-3 for the LSST, is that of a shape without a weight also for those with one.
    wcs : WCS or CcdWcs
        World coordinates: of astropy, with right ascension and declination, or of :func:`~pachon.ccd_wcs`.
    x, y : array, shape [n]
        Where the shapes are [pixel], the centre of the first pixel at (0, 0).

    Returns
    -------
    SkyShapes
        NaN where a shape is, or where the world coordinates have no sky, far outside the image. For TreeCorr:
        ``Catalog(ra=s.ra, dec=s.dec, g1=s.g1_sky, g2=s.g2_sky, ra_units="rad", dec_units="rad")``.

    Raises
    ------
    DomainError
        If lengths differ, or the world coordinates are not right ascension and declination.
    """
    first, second = _components(shapes)
    pixels = np.stack(np.broadcast_arrays(pure_numbers(x, "x"), pure_numbers(y, "y")), axis=-1).reshape(-1, 2)
    if not first.shape == second.shape == (len(pixels),):
        lengths = f"{first.size} and {second.size} components of shapes at {len(pixels)} places"
        raise DomainError(f"{lengths}: expected one length")
    celestial, jacobians = jacobians_on_sky(_celestial_of(wcs), pixels, STEP)
    g1, g2 = along_sky(first, second, jacobians)
    return SkyShapes(celestial[:, 0], celestial[:, 1], g1, g2)


def along_sky(g1: np.ndarray, g2: np.ndarray, jacobians: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return shapes [n] in the axes that d(west, north)/d(x, y), [n, 2, 2], leads to; NaN where there are none."""
    finite = np.isfinite(g1) & np.isfinite(g2) & np.isfinite(jacobians).all(axis=(1, 2))
    finite[finite] = np.linalg.det(jacobians[finite]) != 0.0
    jacobians = np.where(finite[:, None, None], jacobians, np.eye(2))
    square = jacobians @ jacobians.transpose(0, 2, 1)
    determinant = np.linalg.det(jacobians)
    area = np.abs(determinant)
    trace = square[:, 0, 0] + square[:, 1, 1]
    # The shear of the symmetric factor, whose square is J J^T.
    pixel_shear = (square[:, 0, 0] - square[:, 1, 1] + 2j * square[:, 0, 1]) / (trace + 2.0 * area)
    symmetric = square + area[:, None, None] * np.eye(2)
    # The orthogonal factor, but for its norm: the first column is the direction of x.
    towards_x = np.linalg.solve(symmetric, jacobians[:, :, :1])[:, :, 0]
    direction = towards_x[:, 0] + 1j * towards_x[:, 1]
    shape = np.where(finite, g1, 0.0) + 1j * np.where(finite, g2, 0.0)
    turned = np.where(determinant > 0.0, shape, shape.conj()) * direction**2 / np.abs(direction) ** 2
    on_sky = np.where(finite, (turned + pixel_shear) / (1.0 + pixel_shear.conj() * turned), np.nan * (1.0 + 1.0j))
    return on_sky.real, on_sky.imag


def along_tangent_plane(
    e1: np.ndarray, e2: np.ndarray, ra: np.ndarray, dec: np.ndarray, pointing: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Return shapes along xi and eta about a pointing, from those along east and north at ra, dec [rad], all [n].

    Both have e2 > 0 along the diagonal between their axes.
    """
    return along_sky(e1, e2, Pointing.of(pointing).jacobians(ra, dec))


def jacobians_on_sky(
    celestial_of: Callable[[np.ndarray], np.ndarray], places: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return right ascension and declination [rad] of places [n, 2], and d(west, north)/d(place), [n, 2, 2].

    `celestial_of` returns right ascensions and declinations [rad], shape [m, 2], of places [m, 2]; `step` is the half
    of the central differences.
    """
    shifts = step * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    sky = celestial_of((places + shifts[:, None]).reshape(-1, 2)).reshape(5, -1, 2)
    ra, dec = sky[..., 0], sky[..., 1]
    vectors = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)
    sine, cosine = np.sin(ra[0]), np.cos(ra[0])
    west = np.stack([sine, -cosine, np.zeros_like(sine)], axis=-1)
    north = np.stack([-np.sin(dec[0]) * cosine, -np.sin(dec[0]) * sine, np.cos(dec[0])], axis=-1)
    change = np.stack([vectors[1] - vectors[2], vectors[3] - vectors[4]], axis=-1) / (2.0 * step)
    return sky[0], np.stack([west, north], axis=1) @ change


def _components(shapes: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the two components of shapes, each [n]."""
    for names in (("g1", "g2"), ("e1", "e2")):
        if all(hasattr(shapes, name) for name in names):
            return tuple(np.atleast_1d(pure_numbers(getattr(shapes, name), name)) for name in names)  # type: ignore[return-value]
    pairs = np.atleast_2d(pure_numbers(shapes, "shapes"))
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise DomainError(f"shapes = {shown(shapes)}: expected g1 and g2, e1 and e2, or an array of shape [n, 2]")
    return pairs[:, 0], pairs[:, 1]


def _celestial_of(wcs: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function from pixels [n, 2], from 0, to right ascension and declination [rad], [n, 2]."""
    astropy_wcs = wcs.astropy() if hasattr(wcs, "astropy") else wcs
    if not hasattr(astropy_wcs, "all_pix2world"):
        raise DomainError(f"wcs = {shown(wcs)}: expected a WCS of astropy, or one of pachon.ccd_wcs")
    types = getattr(getattr(astropy_wcs, "wcs", None), "ctype", ("RA", "DEC"))
    axes = [i for name in ("RA", "DEC") for i, kind in enumerate(types) if str(kind).startswith(name)]
    if len(axes) != 2 or astropy_wcs.naxis != 2:
        kinds = ", ".join(map(repr, map(str, types)))
        raise DomainError(f"wcs of axes {kinds}: expected two axes, right ascension and declination")
    return lambda pixels: np.deg2rad(np.asarray(astropy_wcs.all_pix2world(pixels, 0))[:, axes])
