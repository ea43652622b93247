r"""Mean transfer function of any pupil, by Fourier transform of a lattice of rays.

The transfer function of the optics is the autocorrelation of the field in the pupil, which the Fourier transform of a
square lattice of points gives, whatever cuts the light: vanes, plates, rims across the pupil, meshes. It is needed
between the baselines of the lattice as well, at those of the frequencies on the focal plane, :math:`(\lambda / 2 \pi)
J^T k`. Divided by the phase of the mean ray and by the exponential of the baseline that falls as steeply at first as
the rims of the lit points make it fall, it is smooth, and splines interpolate it.

The lattice is traced at the middle wavelength. Paths at the others differ from those by polynomials over the pupil.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
import scipy.ndimage

from ...core.threads import one_blas_thread
from ...core.units import require_count
from ..pupil_optics import PupilOptics
from .channels import Channels
from .pupil_lattice import PupilLattice

#: Points of the default lattice in a disc: 196 across, for vanes of a few centimetres.
LATTICE_POINTS = 30000
#: Points of the lattice in a disc where there are only rings.
RINGS_POINTS = 7500
#: Fewest points of a lattice.
FEWEST_POINTS = 500
#: Most points across the diameter: stars that need more are drawn by dense rays...
MOST_ACROSS = 1024
#: ... or refused, where rays do not suffice: with so many a star takes 20 s and 4 GB at five wavelengths.
MOST_ACROSS_ALONE = 2048
# Largest change of the phase of a ray from one point to the next, as the image of its star is wide (rms along an axis):
# splines then follow the transfer function to 1e-4.
_PHASE_STEP = 0.8
_ORDER = 3
# The lattice is turned so that vanes along the axes and the diagonals meet its rows at slopes of the golden mean and of
# sqrt(5) - 2: as evenly as lines can. Along its rows or diagonals they would hit too many points, or none.
_SLOPE = 0.5 * (math.sqrt(5.0) - 1.0)
_TURN = np.array([[1.0, -_SLOPE], [_SLOPE, 1.0]]) / math.hypot(1.0, _SLOPE)
# Baselines beyond the longest one that is wanted, for the splines.
_ROOM = 4
# Rays that determine the paths at other wavelengths.
_SPARSE = 400
# Degree of the polynomials through those that are lit.
_DEGREE = 6
# Fewest lit rays to a term of them.
_RAYS_A_TERM = 3
# Numbers of the terms of whole degrees, the largest first.
_TERMS = [(d + 1) * (d + 2) // 2 for d in range(_DEGREE, -1, -1)]


@dataclass(frozen=True)
class LatticeRays:
    """Rays of stars through a lattice at the middle wavelength, and the differences at the others."""

    optics: PupilOptics  #: of the middle wavelength
    path: np.ndarray  #: coefficients of the paths at each wavelength less those [m], [n_star, n_wave, n_term]
    shift: np.ndarray  #: mean landing points at each wavelength less those [m], [n_star, n_wave, 2]


@dataclass(frozen=True)
class LatticeTransfer:
    """The transfer functions of pupils on a square lattice."""

    lattice: PupilLattice
    diameter: float  #: of the pupil [m]
    obscuration: float  #: linear
    wavelengths: np.ndarray  #: [m]
    sparse: np.ndarray  #: points that are traced at every wavelength [m], [n, 2]

    @classmethod
    def fill(cls, diameter: float, obscuration: float, count: int, wavelengths: np.ndarray) -> LatticeTransfer:
        """Return the lattice of about ``count`` points in a disc."""
        require_count(count, "n_pupil", FEWEST_POINTS)
        spacing = diameter * math.sqrt(math.pi / (4.0 * count))
        lattice = PupilLattice.fill(diameter, obscuration, spacing)
        coarse = PupilLattice.fill(diameter, obscuration, diameter * math.sqrt(math.pi / (4.0 * _SPARSE)))
        return cls(lattice, diameter, obscuration, wavelengths, coarse.points)

    @property
    def points(self) -> np.ndarray:
        """Pupil coordinates [m], shape [n_pupil, 2]."""
        return self.lattice.points @ _TURN.T

    def refined(self, refinement: int) -> LatticeTransfer:
        """Return the lattice with its spacing divided by a factor."""
        spacing = self.lattice.spacing / refinement
        return replace(self, lattice=PupilLattice.fill(self.diameter, self.obscuration, spacing))

    def refinement(self, rays: LatticeRays) -> np.ndarray:
        """Return the factor by which each star needs a finer lattice, 1 near focus, [n_star] int."""
        optics = rays.optics
        lit = optics.lit[:, 0, :, None]
        landed = np.where(lit, optics.displacement[:, 0], np.float32(0.0))
        count = np.maximum(lit.sum(axis=1), 1)
        square = (landed**2).sum(axis=1) / count - (landed.sum(axis=1) / count) ** 2
        scale = np.sqrt(np.abs(np.linalg.det(optics.jacobian)))
        spread = np.sqrt(np.maximum(square, 0.0).max(axis=1)) / scale
        phase = 2.0 * math.pi * self.lattice.spacing * spread / self.wavelengths.min()
        return np.ceil(np.maximum(phase / _PHASE_STEP, 1.0)).astype(np.int64)

    def trace(self, trace: Callable[[np.ndarray, np.ndarray], PupilOptics]) -> LatticeRays:
        """Trace the rays of stars: ``trace`` takes wavelengths [m] and points of the pupil [m]."""
        middle = len(self.wavelengths) // 2
        optics = trace(self.wavelengths[[middle]], self.points)
        n_star, n_wave = len(optics.lit), len(self.wavelengths)
        if n_wave == 1:
            return LatticeRays(optics, np.zeros((n_star, 1, 1)), np.zeros((n_star, 1, 2)))
        sparse_optics = trace(self.wavelengths, self.sparse)
        terms = self._terms(self.sparse, _DEGREE)
        path, shift = np.zeros((n_star, n_wave, terms.shape[1])), np.zeros((n_star, n_wave, 2))
        with one_blas_thread():
            for star in range(n_star):
                # Dark rays may pass a lens far outside of what is ground.
                lit = sparse_optics.lit[star].all(axis=0)
                count = next((n for n in _TERMS if _RAYS_A_TERM * n <= lit.sum()), 0)
                if count:
                    change = sparse_optics.path[star][:, lit] - sparse_optics.path[star][middle, lit]
                    path[star, :, :count] = np.linalg.lstsq(terms[lit, :count], change.T, rcond=None)[0].T
                    landed = sparse_optics.displacement[star][:, lit]
                    shift[star] = (landed - landed[middle]).mean(axis=1, dtype=np.float64)
        return LatticeRays(optics, path, shift)

    def at(self, rays: LatticeRays, star: int, channels: Channels, k: np.ndarray) -> np.ndarray:
        """Return the transfer functions of a star at wavenumbers on the focal plane.

        Parameters
        ----------
        rays : LatticeRays
            Rays through the points of the lattice.
        star : int
            Number of the star.
        channels : Channels
            Wavelengths and depths.
        k : ndarray, shape [n, 2]
            Wavenumbers along x and y of the detector [rad/m].

        Returns
        -------
        ndarray of complex, shape [n_channel, n]
            1 at zero, 0 everywhere for a dark star.
        """
        star_optics = rays.optics.star(star)
        lit = np.flatnonzero(star_optics.lit[0, 0])
        out = np.zeros((len(channels.wave), len(k)), dtype=np.complex64)
        if not lit.size:
            return out
        pupil, displacement = star_optics.pupil[lit], star_optics.displacement[:, :, lit]
        star_optics = replace(star_optics, pupil=pupil, displacement=displacement)
        assert star_optics.exit_pupil_path is not None
        path = star_optics.exit_pupil_path[:, :, lit]
        if len(self.wavelengths) > 1:
            path = path + np.einsum("wt,pt->wp", rays.path[star], self._terms(pupil, _DEGREE))
        path = channels.path(replace(star_optics, exit_pupil_path=path))[0]
        mean = displacement[0, 0].mean(axis=0, dtype=np.float64) + rays.shift[star][channels.wave]
        if channels.shift.any():
            mean += channels.shift[:, None] * star_optics.exit_cosines[0].mean(axis=0)
        jacobian = star_optics.jacobian[0]
        tilts = 2.0 * math.pi / self.wavelengths[channels.wave, None] * np.linalg.solve(jacobian, mean.T).T
        # Baselines and tilts along the rows and columns of the lattice.
        tilts = tilts @ _TURN
        along = k @ jacobian @ _TURN / (2.0 * math.pi)
        wavelengths = self.wavelengths[channels.wave]
        turns = path / wavelengths[:, None]
        phase = ((2.0 * math.pi) * (turns - np.rint(turns))).astype(np.float32)
        spacing = self.lattice.spacing
        longest = math.ceil(math.sqrt((along**2).sum(axis=1).max()) * wavelengths.max() / spacing) + _ROOM
        samples = self._correlation(np.cos(phase) + np.complex64(1j) * np.sin(phase), lit, longest)
        fall = self._initial_fall(lit)
        x = spacing * np.arange(-longest, longest + 1)
        samples *= np.exp(np.hypot(fall[0] * x, fall[1] * x[:, None]))
        ramps = np.exp(-1j * tilts[..., None] * x)
        samples *= ramps[:, 0, None, :] * ramps[:, 1, :, None]
        for channel, wavelength in enumerate(wavelengths):
            # A wavenumber belongs to minus its baseline in the correlation: the conjugate of that at plus.
            baseline = along * wavelength
            where = baseline.T[::-1] / spacing + longest
            smooth = scipy.ndimage.map_coordinates(samples[channel], where, order=_ORDER, mode="mirror")
            out[channel] = np.conj(smooth * np.exp(1j * (baseline @ tilts[channel]) - np.hypot(*(fall * baseline).T)))
        return out

    def _correlation(self, field: np.ndarray, lit: np.ndarray, longest: int) -> np.ndarray:
        """Return the autocorrelations of fields at lit points, by number, out to a lag, [n, 2 longest + 1, same]."""
        size = self.lattice.size
        side = scipy.fft.next_fast_len(size + min(longest, size))
        grid = np.zeros((len(field), side, side), dtype=np.complex64)
        grid[:, self.lattice.row[lit], self.lattice.column[lit]] = field
        spectrum = scipy.fft.fft2(grid, overwrite_x=True)
        lags = scipy.fft.ifft2(spectrum.real**2 + spectrum.imag**2)
        reach = min(longest, size - 1)
        step = np.arange(-reach, reach + 1)
        correlations = np.zeros((len(field), 2 * longest + 1, 2 * longest + 1), dtype=np.complex128)
        inner = slice(longest - reach, longest + reach + 1)
        correlations[:, inner, inner] = lags[:, step[:, None], step] / len(lit)
        return correlations

    def _initial_fall(self, lit: np.ndarray) -> np.ndarray:
        """Return how steeply the autocorrelation of lit points, by number, falls at first along x and y [1/m], [2]."""
        grid = np.zeros((self.lattice.size,) * 2, dtype=bool)
        grid[self.lattice.row[lit], self.lattice.column[lit]] = True
        pairs = np.array([(grid[:, 1:] & grid[:, :-1]).sum(), (grid[1:] & grid[:-1]).sum()])
        return np.asarray(-np.log(np.maximum(pairs, 0.5 * len(lit)) / len(lit)) / self.lattice.spacing)

    def _terms(self, points: np.ndarray, degree: int) -> np.ndarray:
        """Return products of Legendre polynomials over the pupil up to a total degree, shape [n, n_term]."""
        x, y = (np.polynomial.legendre.legvander(u, degree) for u in points.T / (0.5 * self.diameter))
        return np.stack([x[:, t - j] * y[:, j] for t in range(degree + 1) for j in range(t + 1)], axis=1)


def laid_out(transfer: np.ndarray, row: np.ndarray, column: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return transfer functions at rows +n and then -n as kernels of spokes lay them out, [4, n_row, n_packet, lane].

    ``shape`` is [n_row, n_packet, lane]; columns are counted over all packets.
    """
    laid = np.zeros((4, shape[0], int(np.prod(shape[1:]))), dtype=np.float32)
    laid[0, row, column], laid[2, row, column] = transfer.real.reshape(2, -1)
    laid[1, row, column], laid[3, row, column] = transfer.imag.reshape(2, -1)
    return laid.reshape(4, *shape)
