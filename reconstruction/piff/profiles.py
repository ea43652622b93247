"""Models of Piff: surface brightness of a PSF from its parameters, as images of pixels."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.special import j0, j1

from .tables import PiffTables

#: Nodes of Gauss-Legendre quadrature along a side of a pixel.
_NODES = 7
#: Harmonics by which GalSim keeps a constant constant under Lanczos interpolation.
_HARMONICS = 5
#: Radius from which on a Kolmogorov profile is its power law [half-light radii].
_TAIL = 30.0
#: Most lobes of a Lanczos function.
_MOST_LOBES = 50
#: Most pixels along a side of a grid.
_MOST_PIXELS = 1000


class Profile(Protocol):
    """A model of Piff."""

    @property
    def n_parameters(self) -> int:
        """Number of parameters."""

    def draw(self, parameters: np.ndarray, jacobian: np.ndarray, size: int) -> np.ndarray:
        """Return an image [size, size] of unit flux at infinity, centred on the middle pixel ``[size//2, size//2]``.

        `jacobian` is d(u, v)/d(x, y) [arcsec/pixel], shape [2, 2].
        """


@dataclass(frozen=True)
class PixelGrid:
    """Pixels of a grid in u and v, between which a Lanczos function interpolates; they hold the pixel's response."""

    scale: float  #: side of a pixel of the grid [arcsec]
    size: int  #: pixels along a side of the grid
    lobes: int  #: n of Lanczos(n)
    conserve: bool  #: whether a constant stays one
    with_flux: bool  #: whether the sum of the pixels is the flux

    @property
    def n_parameters(self) -> int:
        """Number of parameters."""
        return self.size**2

    def draw(self, parameters: np.ndarray, jacobian: np.ndarray, size: int) -> np.ndarray:
        """Return the image of a PSF, as of :class:`Profile`."""
        grid = parameters.reshape(self.size, self.size)
        if not self.with_flux:
            grid = grid / grid.sum()
        y, x = np.indices((size, size)).reshape(2, -1) - size // 2
        u, v = (jacobian @ np.stack([x, y])) / self.scale
        nodes = np.arange(self.size) - self.size // 2
        weights_u, weights_v = (
            lanczos(values[:, None] - nodes, self.lobes, conserve=self.conserve) for values in (u, v)
        )
        values = np.einsum("pi,ij,pj->p", weights_v, grid, weights_u, optimize=True)
        return (abs(np.linalg.det(jacobian)) / self.scale**2 * values).reshape(size, size)


@dataclass(frozen=True)
class Gaussian:
    """An elliptical Gaussian; the first parameter is its sigma [arcsec]."""

    centered: bool
    with_flux: bool
    with_pixel: bool  #: whether the pixel's response is still to come

    @property
    def n_parameters(self) -> int:
        """Number of parameters."""
        return 3 + 2 * (not self.centered) + self.with_flux

    def brightness(self, square: np.ndarray) -> np.ndarray:
        """Return the surface brightness of unit flux and size by the square of the radius."""
        return np.exp(-0.5 * square) / (2.0 * math.pi)

    def draw(self, parameters: np.ndarray, jacobian: np.ndarray, size: int) -> np.ndarray:
        """Return the image of a PSF, as of :class:`Profile`."""
        flux = parameters[0] if self.with_flux else 1.0
        center = np.zeros(2) if self.centered else parameters[self.with_flux :][:2]
        radius, g1, g2 = parameters[-3:]
        # A shear of GalSim: distance along and across its axes grow and shrink by the same factor.
        shear = np.array([[1.0 + g1, g2], [g2, 1.0 - g1]]) / math.sqrt(1.0 - g1**2 - g2**2)
        inverse = np.linalg.inv(radius * shear)
        nodes, weights = np.polynomial.legendre.leggauss(_NODES) if self.with_pixel else (np.zeros(1), np.full(1, 2.0))
        line = (np.arange(size) - size // 2)[:, None] + 0.5 * nodes
        x, y = line.reshape(1, -1), line.reshape(-1, 1)
        u, v = (jacobian[k, 0] * x + jacobian[k, 1] * y - center[k] for k in range(2))
        square = (inverse[0, 0] * u + inverse[0, 1] * v) ** 2 + (inverse[1, 0] * u + inverse[1, 1] * v) ** 2
        values = self.brightness(square).reshape(size, len(nodes), size, len(nodes))
        image = np.einsum("ambn,m,n->ab", values, 0.5 * weights, 0.5 * weights)
        return flux * abs(np.linalg.det(jacobian)) / radius**2 * image


@dataclass(frozen=True)
class Moffat(Gaussian):
    """An elliptical Moffat function; the first parameter is its half-light radius [arcsec]."""

    beta: float = 3.0

    def brightness(self, square: np.ndarray) -> np.ndarray:
        """Return the surface brightness of unit flux and half-light radius by the square of the radius."""
        # Half of the light is within r where 1 - (1 + r^2/a^2)^(1 - beta) = 1/2.
        a2 = 1.0 / (2.0 ** (1.0 / (self.beta - 1.0)) - 1.0)
        return (self.beta - 1.0) / (math.pi * a2) * (1.0 + square / a2) ** -self.beta


@dataclass(frozen=True)
class Kolmogorov(Gaussian):
    """An elliptical Kolmogorov profile, of the transform exp(-(k/k0)^(5/3)); the first parameter is as of Moffat."""

    def brightness(self, square: np.ndarray) -> np.ndarray:
        """Return the surface brightness of unit flux and half-light radius by the square of the radius."""
        radius = np.sqrt(square)
        spline, tail = _kolmogorov_profile()
        # Far out it falls as the power of a kink of the transform at zero (Roddier 1981, Progress in Optics 19, 281).
        far = tail * np.maximum(radius, _TAIL) ** (-11.0 / 3.0)
        return np.where(radius < _TAIL, spline(np.minimum(radius, _TAIL)), far)


def read_profile(tables: PiffTables) -> Profile:
    """Read the model of a file; ProductError names one that is unknown, or what of it is."""
    settings = tables.settings("model")
    kind = settings.get("type")
    flux = bool(settings.get("fit_flux", 0))
    if kind == "PixelGrid":
        text = settings.get("interp", "Lanczos(3)")
        lanczos = re.match(r"(?:galsim\.)?Lanczos\((?:n=)?(\d+)(?:, *(?:conserve_dc=)?(True|False))?[,)]", str(text))
        if lanczos is None:
            raise tables.error(f"model interp = {str(text)[:40]}: expected Lanczos(n)")
        lobes = tables.whole("model interp", "Lanczos", int(lanczos[1]), 1, _MOST_LOBES)
        size = tables.whole("model", "size", settings.get("size"), 1, _MOST_PIXELS)
        scale = tables.positive("model", "scale", settings.get("scale"))
        return PixelGrid(scale, size, lobes, lanczos[2] != "False", flux)
    shape = (bool(settings.get("centered", 1)), flux, bool(settings.get("include_pixel", 1)))
    if kind == "Gaussian":
        return Gaussian(*shape)
    if kind == "Kolmogorov":
        return Kolmogorov(*shape)
    if kind == "Moffat":
        if settings.get("trunc"):
            raise tables.error(f"model trunc = {settings['trunc']}: expected a Moffat function without truncation")
        beta = tables.positive("model", "beta", settings.get("beta"))
        if beta <= 1.0:
            raise tables.error(f"model beta = {beta:g}: expected more than 1")
        return Moffat(*shape, beta=beta)
    raise tables.error(f"model = {kind}: expected one of PixelGrid, Gaussian, Moffat, Kolmogorov")


def lanczos(x: np.ndarray, n: int, *, conserve: bool) -> np.ndarray:
    """Return the Lanczos function sinc(x) sinc(x/n), |x| < n, of GalSim.

    With `conserve` it is divided by the first harmonics of the sum of the functions at all integers, so that a constant
    is interpolated as one (documentation of ``galsim.Lanczos``, ``conserve_dc``).
    """
    value = np.where(np.abs(x) < n, np.sinc(x) * np.sinc(x / n), 0.0)
    if not conserve:
        return value
    harmonics = sum(k * (np.cos(2.0 * np.pi * j * x) - 1.0) for j, k in enumerate(_lanczos_spectrum(n), start=1))
    return value / (1.0 + 2.0 * harmonics)


@lru_cache
def _lanczos_spectrum(n: int) -> tuple[float, ...]:
    """Return the Fourier transform of the Lanczos function at the first whole frequencies, by quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    # The integrand is smooth between whole numbers; both halves are alike.
    x = (np.arange(n)[:, None] + 0.5 * (nodes + 1.0)).ravel()
    w = np.tile(weights, n)
    value = np.sinc(x) * np.sinc(x / n)
    return tuple(float((w * value * np.cos(2.0 * np.pi * j * x)).sum()) for j in range(1, _HARMONICS + 1))


@lru_cache
def _kolmogorov_profile() -> tuple[CubicSpline, float]:
    """Return the surface brightness of unit flux over the radius in half-light radii, and the factor of its tail."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    # Panels that are finest at the kink at zero. Beyond 12 k0 the transform is below 1e-27.
    edges = 12.0 * np.linspace(0.0, 1.0, 121) ** 2
    half_widths = 0.5 * np.diff(edges)[:, None]
    k = (edges[:-1, None] + half_widths * (nodes + 1.0)).ravel()
    w = (half_widths * weights).ravel()
    transform = np.exp(-(k ** (5.0 / 3.0)))
    # Flux within r is r times the integral of the transform and J1(k r).
    half = brentq(lambda r: float(r * (w * transform * j1(k * r)).sum()) - 0.5, 0.5, 5.0, xtol=1e-14)
    # Close to each other where the profile is steep.
    r = _TAIL * np.linspace(0.0, 1.0, 1500) ** 2
    value = half**2 / (2.0 * math.pi) * np.array([(w * transform * k * j0(k * half * radius)).sum() for radius in r])
    return CubicSpline(r, value), float(value[-1] * _TAIL ** (11.0 / 3.0))
