r"""Six linear functionals of a deconvolved image, and what they become under a shear.

With the Gaussian G of rms width s and peak 1, and the image f(x) before the PSF, they are the integrals of f times

    M0: G,  M1: (x^2 - y^2)/s^2 G,  M2: 2 x y/s^2 G

and of the derivatives of the last two weights along a shear. A sheared image is f(S^-1 x) with a determinant of 1, so
its functional of b(x) is that of b(S x) of the image without shear: with D1 = x d/dx - y d/dy, D2 = y d/dx + x d/dy,

    dM/dg1 = functional of D1 b,  dM/dg2 = functional of D2 b

which gives dM0/dg1 = -M1, dM0/dg2 = -M2, dM1/dg1 = M3, dM2/dg2 = M4, and dM1/dg2 = dM2/dg1 = M5. In Fourier space,
where D1 is -(kx d/dkx - ky d/dky), all six are polynomials of u = s kx and v = s ky times the transform of G, and real.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from ...core.errors import DomainError
from ...core.threads import one_blas_thread

#: Functionals of a galaxy.
FUNCTIONALS = 6
#: Transform of the weight over that of the PSF below which frequencies are left out: 1e-6 of the flux is less than the
#: rounding of single precision adds.
_LEAST_AMPLITUDE = 1e-6
#: Largest transform of the weight over that of the PSF, of a PSF of unit sum; from there on noise is all that is left.
MOST_AMPLIFICATION = 20.0


@dataclass(frozen=True, eq=False)
class Frequencies:
    """Frequencies of a square grid within a radius, those of kx >= 0 alone.

    Attributes
    ----------
    side : int
        Pixels of a side of the grid.
    most : int
        Largest index of a frequency: kx from 0 to it, ky from its negative to it.
    """

    side: int
    most: int

    @property
    def step(self) -> float:
        """Distance of frequencies [rad/pixel]."""
        return 2.0 * np.pi / self.side

    @property
    def kx(self) -> np.ndarray:
        """Along x [rad/pixel], shape [1, most + 1]."""
        return self.step * np.arange(self.most + 1)[None]

    @property
    def ky(self) -> np.ndarray:
        """Along y [rad/pixel], shape [2 most + 1, 1]."""
        return self.step * np.arange(-self.most, self.most + 1)[:, None]

    @property
    def multiplicity(self) -> np.ndarray:
        """How often each stands in the sum over all: once for kx = 0, else for the opposite one too, [1, most + 1]."""
        return np.where(self.kx == 0.0, 1.0, 2.0)

    def of(self, images: np.ndarray) -> np.ndarray:
        """Transform images [n, side, side] with the origin on pixel 0, [n, 2 most + 1, most + 1]."""
        along_x = fft.rfft(images, axis=2, workers=1)[:, :, : self.most + 1]
        both = fft.fft(along_x, axis=1, workers=1)
        return np.concatenate([both[:, self.side - self.most :], both[:, : self.most + 1]], axis=1)


def weight_transforms(frequencies: Frequencies, sigma: float) -> np.ndarray:
    """Return the transforms of the six weights of an rms width [pixel], [6, ny, nx]; all are real."""
    u, v = sigma * frequencies.kx, sigma * frequencies.ky
    square, plus, cross = u**2 + v**2, u**2 - v**2, 2.0 * u * v
    polynomials = np.stack(
        [np.ones_like(square), -plus, -cross, 2.0 * square - plus**2, 2.0 * square - cross**2, -plus * cross]
    )
    return 2.0 * np.pi * sigma**2 * polynomials * np.exp(-0.5 * square)


def psf_frequencies(psf_images: np.ndarray, side: int, sigma: float) -> tuple[Frequencies, np.ndarray]:
    """Return frequencies at which PSFs can be divided out, and the inverse transforms of PSFs there.

    Parameters
    ----------
    psf_images : ndarray, shape [n, m, m]
        PSFs of unit sum, centred on a pixel.
    side : int
        Pixels of a side of stamps.
    sigma : float
        rms width of the weight [pixel].

    Returns
    -------
    Frequencies
        Those that any PSF needs.
    ndarray of complex128, shape [n, ny, nx]
        Inverse transforms; zero beyond the radius from which the weight is less than 1e-6 of the PSF's transform.

    Raises
    ------
    DomainError
        If a PSF amplifies noise beyond reason: it is too wide for the weight.
    """
    full = Frequencies(side, (side - 1) // 2)
    transforms = psf_transforms(full, psf_images)
    k = np.hypot(full.kx, full.ky)
    with np.errstate(divide="ignore"):
        amplitude = np.exp(-0.5 * (sigma * k) ** 2) / np.abs(transforms)
    nyquist = np.pi * (side - 1) / side
    limit = np.array([np.min(k[low], initial=nyquist) for low in amplitude < _LEAST_AMPLITUDE])
    inside = k < limit[:, None, None]
    greatest = np.where(inside, amplitude, 0.0).max(axis=(1, 2))
    if not np.all(greatest <= MOST_AMPLIFICATION):
        worst = int(np.argmax(np.nan_to_num(greatest, nan=np.inf)))
        raise DomainError(
            f"psf_images[{worst}]: too wide for a weight of sigma = {sigma:.2f} pixels, dividing by its transform "
            f"amplifies noise {greatest[worst]:.3g} times; expected at most {MOST_AMPLIFICATION:g}: a larger sigma",
            key="sigma",
        )
    most = int(np.ceil(limit.max() / full.step)) - 1
    cut = np.s_[:, full.most - most : full.most + most + 1, : most + 1]
    inverse = np.where(inside, 1.0 / np.where(inside, transforms, 1.0), 0.0)
    return Frequencies(side, most), inverse[cut]


def psf_transforms(frequencies: Frequencies, psf_images: np.ndarray) -> np.ndarray:
    """Return the transforms of PSFs [n, m, m], m odd, about their middle pixel, [n, ny, nx]."""
    return frequencies.of(_wrapped(psf_images, frequencies.side))


def _wrapped(psf_images: np.ndarray, side: int) -> np.ndarray:
    """Return PSFs with their centre on pixel 0 of a periodic grid, on which their transforms stay exact."""
    width = psf_images.shape[1]
    fold = np.zeros((side, width))
    fold[(np.arange(width) - width // 2) % side, np.arange(width)] = 1.0
    with one_blas_thread():
        return fold @ psf_images @ fold.T


def noise_covariance(
    weights: np.ndarray, inverse: np.ndarray, noise_power: np.ndarray, frequencies: Frequencies
) -> np.ndarray:
    """Return the covariance of functionals under noise of a power spectrum, [n, m, m].

    Parameters
    ----------
    weights : ndarray of float or complex, shape [m, ny, nx]
        Transforms of the weights.
    inverse : ndarray of complex, shape [n, ny, nx]
        Inverse transforms of PSFs.
    noise_power : ndarray, shape [n, ny, nx] or [n, 1, 1]
        Power of the noise under each of the PSFs: of white noise the variance of a pixel.
    frequencies : Frequencies
        Those of the transforms.
    """
    products = (weights[:, None] * np.conj(weights[None])).real * frequencies.multiplicity
    power = np.abs(inverse) ** 2 * noise_power / frequencies.side**2
    return np.einsum("nyx,ijyx->nij", power, products)


def renoising(
    covariance: np.ndarray, measured: np.ndarray, derivatives: np.ndarray, quarter_turn: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return matrices that turn normal numbers z into noise of the functionals and of their derivatives.

    N = S L z, with C = L L^T of the functionals of which ellipticities are made, has the covariance of the noise of an
    image rotated by 90 degrees. The derivatives less X = C' S L^-T z, with the covariance C' of their noise with that
    of the functionals, are independent of the functionals plus N: C' - <X N^T> = 0.

    Parameters
    ----------
    covariance : ndarray, shape [n, m, m]
        Covariance of all functionals.
    measured, derivatives : ndarray of int
        Functionals of which ellipticities and weights are made, and those that are their derivatives.
    quarter_turn : ndarray
        S, by which a rotation of the image changes the former.

    Returns
    -------
    ndarray, ndarray
        Shapes [n, measured, measured] and [n, derivatives, measured].
    """
    square = covariance[:, measured[:, None], measured]
    scale = np.sqrt(np.diagonal(square, axis1=1, axis2=2))
    factor = np.linalg.cholesky(square / (scale[:, :, None] * scale[:, None]))
    identity = np.broadcast_to(np.eye(len(measured)), factor.shape)
    inverse = np.linalg.solve(np.moveaxis(factor, 1, 2), identity) / scale[:, :, None]
    cross = covariance[:, derivatives[:, None], measured]
    return quarter_turn @ (scale[:, :, None] * factor), cross @ quarter_turn @ inverse
