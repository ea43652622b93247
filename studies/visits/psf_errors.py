r"""Shear that errors of the PSF leave on galaxies, to first order, from the PSFs alone.

Galaxies f are drawn with the PSF P and measured with the model Q. The functionals are those of f P/Q, so that an error
changes them by the integral of f d W_j over the frequencies, with d = P/Q - 1 and the weights W_j. The mean of the
ellipticity e_i(M0, M1, M2) of galaxies changes by

    integral of d K_i,  K_i = sum over j of W_j <f de_i/dM_j>

and the shear by that over the mean response. The mean galaxy <f de_i/dM_j> has no direction but that of e_i, so that K
is nearly a function of the modulus of the frequency times the cosine and sine of twice its angle: the error counts by
its part of spin 2, at the frequencies that galaxies and weight leave. Moments of the PSF have other weights for the
same part: an error that is no shear of the PSF counts more or less than its g.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...core.random_streams import stream
from ...imaging.draw import Sources
from ...imaging.exposure import Exposure
from ...measure.shear.estimator import ShearEstimator
from ...measure.shear.functionals import (
    FUNCTIONALS,
    Frequencies,
    psf_frequencies,
    psf_transforms,
    weight_transforms,
)
from ...measure.shear.shear_shapes import shear_of_sums
from ...measure.shear.weight import weight_sigma
from .galaxy_shapes import SHEAR_MIN_SNR, GalaxyShapes, stamp_sides
from .stack import PsfStack

#: Galaxies, or PSFs, whose transforms are in memory at a time.
_BLOCK = 512
#: Steps of the functionals for derivatives of the ellipticity, in standard errors: it is smooth over several.
_STEP = 0.02


@dataclass(frozen=True, eq=False)
class PsfErrorResponse:
    """Response of the mean shear of galaxies to errors of their PSF.

    Attributes
    ----------
    sigma : float
        rms width of the weight [pixel].
    side : int
        Pixels of a side of the grid of the frequencies.
    kernel : ndarray of complex, shape [2, ny, nx]
        Change of g1 and g2 by P/Q - 1 at each frequency, of those of all pixels of the grid.
    """

    sigma: float
    side: int
    kernel: np.ndarray

    @classmethod
    def of(
        cls, stack: PsfStack, galaxies: Sources, axes: np.ndarray, exposure: Exposure, seed: int, *key: str | int
    ) -> PsfErrorResponse:
        """Return the response of galaxies of all directions under the mean PSF of a stack.

        Parameters
        ----------
        stack : PsfStack
            PSFs, whose noise and limit of the S/N the galaxies have.
        galaxies : Sources
            Galaxies at several orientations each.
        axes : ndarray, shape [2, 2]
            d(x, y of the stack [pixel])/d(xi, eta).
        exposure : Exposure
            Depth and noise of the stack.
        seed, *key
            Random stream of the noise.
        """
        true = stack.true[~stack.star].astype(np.float64)
        sigma = weight_sigma(None, true, exposure.pixel_scale) / exposure.pixel_scale
        mean_psf, side = true.mean(axis=0), stamp_sides(sigma)[1]
        estimator = ShearEstimator(
            mean_psf / mean_psf.sum(),
            exposure.pixel_scale,
            exposure.noise_rms,
            sigma=sigma * exposure.pixel_scale,
            side=side,
        )
        frequencies = Frequencies(side, (side - 1) // 2)
        weights = weight_transforms(frequencies, sigma) * frequencies.multiplicity / side**2
        error = np.sqrt(np.diag(estimator.covariance[0]))
        noise_factor = np.linalg.cholesky(estimator.covariance[0] / np.outer(error, error)) * error[:, None]
        kernel, sums = np.zeros((2, *weights.shape[1:]), dtype=np.complex128), np.zeros(5)
        for first in range(0, len(galaxies), _BLOCK):
            rows = np.arange(first, min(first + _BLOCK, len(galaxies)))
            spectra = _centred_spectra(galaxies, rows, axes, frequencies)
            spectra *= exposure.electrons(galaxies.magnitude[rows])[:, None, None]
            moments = np.einsum("nyx,jyx->nj", spectra, weights).real
            if exposure.noise:
                normal = stream(seed, *key, "pixels", first).standard_normal((len(rows), FUNCTIONALS))
                moments += normal @ noise_factor.T

            def shapes_at(values: np.ndarray, first: int = first) -> np.ndarray:
                """Return e1, e2 and responses of functionals under one noise, [n, 5]."""
                return estimator.ellipticity_and_response(
                    values,
                    seed=seed if exposure.noise else None,
                    key=(*key, "moments", first),
                    min_snr=SHEAR_MIN_SNR,
                ).sums

            sums += shapes_at(moments).sum(axis=0)
            for j in range(3):
                step = np.zeros(FUNCTIONALS)
                step[j] = _STEP * error[j]
                slopes = (shapes_at(moments + step) - shapes_at(moments - step))[:, :2] / (2.0 * step[j])
                kernel += np.einsum("ni,nyx->iyx", slopes, spectra) * weights[j]
        return cls(sigma, side, _shear_changes(kernel, sums))

    def shears(self, true: np.ndarray, model: np.ndarray) -> np.ndarray:
        """Return the mean shear of galaxies with a true PSF, measured with a model, g1 + i g2 [n].

        Parameters
        ----------
        true, model : ndarray, shape [n, m, m]
            PSFs of unit sum.
        """
        shears = np.zeros(len(true), dtype=np.complex128)
        middle = (self.side - 1) // 2
        for first in range(0, len(true), _BLOCK):
            block = slice(first, first + _BLOCK)
            frequencies, inverse = psf_frequencies(model[block].astype(np.float64), self.side, self.sigma)
            transforms = psf_transforms(frequencies, true[block].astype(np.float64))
            errors = np.where(inverse == 0.0, 0.0, transforms * inverse - 1.0)
            most = frequencies.most
            kernel = self.kernel[:, middle - most : middle + most + 1, : most + 1]
            g1, g2 = np.einsum("nyx,iyx->in", errors, kernel).real
            shears[block] = g1 + 1j * g2
        return shears


def _shear_changes(e_changes: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """Return changes of g1 and g2 of those of e1 and e2, complex [2, ny, nx], and sums of e1, e2, r11, r12, r22."""
    by_frequency = np.moveaxis(e_changes, 0, -1)
    responses = np.broadcast_to(sums[2:], (*by_frequency.shape[:2], 3))
    real, imaginary = (
        shear_of_sums(np.concatenate([part, responses], axis=-1)) for part in (by_frequency.real, by_frequency.imag)
    )
    return np.moveaxis(real + 1j * imaginary, -1, 0)


def _centred_spectra(galaxies: Sources, rows: np.ndarray, axes: np.ndarray, frequencies: Frequencies) -> np.ndarray:
    """Return transforms of galaxies of unit flux about their centres at frequencies, [n, ny, nx]."""
    side, most = frequencies.side, frequencies.most
    jacobians = np.broadcast_to(axes, (len(rows), 2, 2))
    transforms = galaxies.transform(rows, jacobians, np.zeros((len(rows), 2)), side)
    low = transforms[:, :, : most + 1]
    return np.concatenate([low[:, side - most :], low[:, : most + 1]], axis=1).astype(np.complex128)


@dataclass(frozen=True, eq=False)
class PsfAtGalaxies:
    """PSFs of the nearest place without a star of each galaxy.

    Attributes
    ----------
    true, model : ndarray of complex, shape [n]
        g1 + i g2 of adaptive moments of the true PSF and of the models.
    expected_shear : ndarray of complex, shape [n]
        Mean shear that the error of the model leaves on galaxies there.
    """

    true: np.ndarray
    model: np.ndarray
    expected_shear: np.ndarray

    @classmethod
    def of(cls, stack: PsfStack, galaxies: GalaxyShapes, response: PsfErrorResponse) -> PsfAtGalaxies:
        """Return the PSFs of a stack at galaxies."""
        places = np.flatnonzero(~stack.star)
        tree = cKDTree(np.stack([stack.x, stack.y], axis=1)[places])
        nearest = tree.query(np.stack([galaxies.x, galaxies.y], axis=1))[1]
        true, model = (moments.g1[places] + 1j * moments.g2[places] for moments in stack.adaptive)
        expected_shear = response.shears(stack.true[places], stack.model[places])
        return cls(true[nearest], model[nearest], expected_shear[nearest])
