r"""Diffraction at the rims of the pupil, for images far from focus.

The transfer function of the optics at a baseline b (:mod:`.long_exposure`) is an integral over the points of the pupil
about which both :math:`p \pm b/2` are clear: the clear pupil less a strip along its rims, of width
:math:`|b \cdot n| / 2` at a rim of normal n. Far from focus the strips land at the rims of the image, so that
diffraction changes these and leaves what lies between them as rays have it. For pieces of rim of length l,

.. math:: -\frac{1}{A} \sum \frac{|b \cdot n|}{2} \, l \, e^{-i \kappa \cdot (x + |b \cdot n| m / 4)}

is added to the transform of the rays' image: :math:`\kappa` is the wave vector of the image, x the place where the
light of the rim lands, and m the change of this place per metre towards the lit side, so that the phase is that of the
middle of the strip.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ...models.telescope import Telescope
from ...raytrace.launch import aimed_points
from ...raytrace.pack.surfaces import clear_annulus
from ..atmosphere.turbulence import diffraction_otf
from ..pupil_polynomials import PupilPolynomials
from .clear_pupil import clear_edges

#: Pieces of each rim: two pixels of a donut of 120.
PIECES = 192
# Frequencies at a time: their strips stay in the processor's cache.
_CHUNK = 256


@dataclass(frozen=True)
class PupilRims:
    """Pieces of the rims of the clear pupil of one star.

    Attributes
    ----------
    points : ndarray, shape [n, 2]
        Middles of the pieces in the plane of the entrance pupil [m].
    normals : ndarray, shape [n, 2]
        Unit vectors towards the lit side.
    parts : ndarray, shape [n]
        Lengths of the pieces over the area of the clear pupil [1/m].
    pieces : int
        Pieces that each rim was divided into, dark ones among them.
    """

    points: np.ndarray
    normals: np.ndarray
    parts: np.ndarray
    pieces: int = PIECES

    def landing(self, smooth: PupilPolynomials, landing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where light of the pieces lands [m], and the change of that per metre along the normals, both [n, 2].

        ``landing`` holds landing points of the points of the polynomials [m].
        """
        places, slopes = smooth.at(self.points, landing)
        return places, np.einsum("nij,nj->ni", slopes, self.normals)

    def transfer(self, baseline: np.ndarray, wave: np.ndarray, landing: np.ndarray, inward: np.ndarray) -> np.ndarray:
        """Return the transfer function of diffraction at the rims, shape [n_frequency], complex64.

        Parameters
        ----------
        baseline, wave : ndarray, shape [n_frequency, 2]
            Baselines in the pupil [m], and wave vectors of the image [rad/m].
        landing : ndarray, shape [n, 2]
            Where the light of the pieces lands [m].
        inward : ndarray, shape [n, 2]
            Change of these places per metre of the pupil along the normals.
        """
        out = np.empty(len(wave), dtype=np.complex64)
        for piece, _, width, phase in self._strips(baseline, wave, landing, inward):
            out[piece].real = np.einsum("fn,fn->f", width, np.cos(phase))
            out[piece].imag = -np.einsum("fn,fn->f", width, np.sin(phase))
        return out

    def transfer_slopes(
        self, baseline: np.ndarray, wave: np.ndarray, landing: np.ndarray, inward: np.ndarray, response: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return :meth:`transfer` and its derivatives by unknowns [n_frequency, n_unknown], both complex64.

        ``response`` has those of the landing points [m], shape [2, n, n_unknown]. Those of ``inward`` are left out.
        """
        values, out = (np.empty((len(wave), *shape), dtype=np.complex64) for shape in ((), response.shape[2:]))
        moved = response.astype(np.float32)
        for piece, k, width, phase in self._strips(baseline, wave, landing, inward):
            cosine, sine = width * np.cos(phase), width * np.sin(phase)
            values[piece].real, values[piece].imag = cosine.sum(axis=1), -sine.sum(axis=1)
            out[piece].real = sum(-k[:, i, None] * (sine @ moved[i]) for i in (0, 1))
            out[piece].imag = sum(-k[:, i, None] * (cosine @ moved[i]) for i in (0, 1))
        return values, out

    def _strips(
        self, baseline: np.ndarray, wave: np.ndarray, landing: np.ndarray, inward: np.ndarray
    ) -> Iterator[tuple[slice, np.ndarray, np.ndarray, np.ndarray]]:
        """Yield slices of the frequencies, their wave vectors, and the light and the phase of the strips at these."""
        across, places, steps = (v.T.astype(np.float32) for v in (self.normals, landing, 0.25 * inward))
        parts = (-0.5 * self.parts).astype(np.float32)
        for first in range(0, len(wave), _CHUNK):
            piece = slice(first, first + _CHUNK)
            b, k = (v[piece].astype(np.float32) for v in (baseline, wave))
            width = np.abs(b @ across)
            phase = k @ places + width * (k @ steps)
            width *= parts
            yield piece, k, width, phase


def strip_overlap(baseline: np.ndarray, diameter: float, obscuration: float) -> np.ndarray:
    """Return the transfer function of an annulus over that of its strips at baselines [m]: 1 but for their overlap.

    Strips as wide as half the baseline overlap a little: to third order in the baseline, less than 1e-3.
    """
    width = 0.5 * diameter * (1.0 - obscuration)
    ring = np.minimum(baseline, width)
    return np.asarray(diffraction_otf(ring, diameter, obscuration) / (1.0 - 2.0 * ring / (math.pi * width)))


def pupil_rims(telescope: Telescope, direction: np.ndarray, wavelength: float, pieces: int = PIECES) -> PupilRims:
    """Return the rims of the clear pupil for light of one direction [3]; discs and rings alone, in so many pieces.

    Spiders, and apertures of other shapes, are left out.
    """
    angle = 2.0 * math.pi * (np.arange(pieces) + 0.5) / pieces
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    edges = clear_edges(_annular_apertures_only(telescope), direction[None], unit, wavelength, threads=1)[0]
    area, points, normals, parts = 0.0, [], [], []
    for side, sign in ((0, 1.0), (1, -1.0)):
        rim = edges[:, side, None] * unit
        aimed = aimed_points(telescope, direction[None], wavelength, rim)
        rim = aimed[0] if aimed.ndim == 3 else rim
        along = 0.5 * (np.roll(rim, -1, axis=0) - np.roll(rim, 1, axis=0))
        area -= 0.5 * sign * float((rim[:, 0] * along[:, 1] - rim[:, 1] * along[:, 0]).sum())
        length = np.hypot(*along.T)
        # Where a spoke is dark its two ends are one point, and no light passes between them.
        shining = (edges[:, 1] > edges[:, 0]) & (length > 0.0)
        across = np.stack([along[:, 1], -along[:, 0]], axis=-1)[shining] / length[shining, None]
        points.append(rim[shining])
        normals.append(sign * across)
        parts.append(length[shining])
    return PupilRims(np.concatenate(points), np.concatenate(normals), np.concatenate(parts) / max(area, 1e-300), pieces)


def _annular_apertures_only(telescope: Telescope) -> Telescope:
    """Return the telescope without obstructions, and without apertures other than discs and rings."""
    surfaces = tuple(
        s if clear_annulus(s.aperture) is not None else replace(s, aperture=None) for s in telescope.surfaces
    )
    return replace(telescope, surfaces=surfaces, obstructions=())
