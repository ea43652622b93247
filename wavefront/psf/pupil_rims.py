r"""Diffraction at the rims of the pupil, for images far from focus.

The transfer function of the optics at a baseline b (:mod:`.long_exposure`) is an integral over the points of the pupil
about which both :math:`p \pm b/2` are clear: the clear pupil less a strip along its rims, of width
:math:`|b \cdot n| / 2` at a rim of normal n. Far from focus the strips land at the rims of the image, so that
diffraction changes these and leaves what lies between them as rays have it. For pieces of rim of length l, with strips
of width :math:`w = |b \cdot n| / 2`,

.. math:: -\frac{1}{A} \sum \left[w + c \left(\frac{b^2}{8} - w^2\right)\right] l \,
   \frac{\sin h}{h} \, e^{-i (\kappa \cdot x + h)}, \qquad h = \frac{w}{2} \kappa \cdot m

is added to the transform of the rays' image: :math:`\kappa` is the wave vector of the image, x the place where the
light of the rim lands, and m the change of this place per metre towards the lit side. The phase is that of the middle
of the strip, and its sinc the mean over the strip, which matters on a small pupil of long focal length: without it
strips of AuxTel are wrong by as much as they are. A rim of curvature c, positive where the lit side is convex, has
strips that are wider and shorter than those of a straight one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...models.telescope import Telescope
from ...raytrace.launch import aimed_points
from ...raytrace.pack.surfaces import clear_annulus
from ..atmosphere.turbulence import diffraction_otf
from ..pupil_polynomials import PupilPolynomials
from .clear_pupil import clear_edges

#: Pieces of each rim: two pixels of a donut of 120.
PIECES = 192
# Curvature of a rim, over that of the pupil's own, up to which it is no corner.
_MOST_CURVED = 5.0
# Lean of a strip [rad] below which its mean is a parabola.
_STRAIGHT = 0.05
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
    curvatures : ndarray, shape [n]
        Curvatures of the rims [1/m], positive where the lit side is convex.
    pieces : int
        Pieces that each rim was divided into, dark ones among them.
    """

    points: np.ndarray
    normals: np.ndarray
    parts: np.ndarray
    curvatures: np.ndarray
    pieces: int = PIECES

    def landing(self, smooth: PupilPolynomials, landing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where light of the pieces lands [m], and the change of that per metre along the normals, both [n, 2].

        ``landing`` holds landing points of the points of the polynomials [m].
        """
        places, slopes = smooth.at(self.points, landing)
        return places, self.along_normals(slopes)

    def along_normals(self, slopes: np.ndarray) -> np.ndarray:
        """Return derivatives along the normals [n, k] from those along both axes of the pupil [n, k, 2]."""
        return np.einsum("nij,nj->ni", slopes, self.normals)

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
        for strips in self._strips(baseline, wave, landing, inward):
            light = strips.light * strips.mean
            out[strips.piece].real = np.einsum("fn,fn->f", light, np.cos(strips.phase))
            out[strips.piece].imag = -np.einsum("fn,fn->f", light, np.sin(strips.phase))
        return out

    def transfer_slopes(
        self,
        baseline: np.ndarray,
        wave: np.ndarray,
        landing: np.ndarray,
        inward: np.ndarray,
        response: np.ndarray,
        inward_response: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return :meth:`transfer` and its derivatives by unknowns [n_frequency, n_unknown], both complex64.

        ``response`` has those of the landing points [m], and ``inward_response`` those of ``inward``, both of shape
        [2, n, n_unknown].
        """
        values, out = (np.empty((len(wave), *shape), dtype=np.complex64) for shape in ((), response.shape[2:]))
        moved, leant = response.astype(np.float32), inward_response.astype(np.float32)
        for strips in self._strips(baseline, wave, landing, inward):
            piece, k, light = strips.piece, strips.wave, strips.light
            cosine, sine = np.cos(strips.phase), np.sin(strips.phase)
            mean, change = light * strips.mean, light * strips.half_width * strips.mean_slope
            values[piece].real, values[piece].imag = (mean * cosine).sum(axis=1), -(mean * sine).sum(axis=1)
            # By the place of the strip, and by what its phase changes across it.
            by_place = -mean * sine, -mean * cosine
            leaning = mean * strips.half_width
            by_lean = change * cosine - leaning * sine, -change * sine - leaning * cosine
            out[piece].real, out[piece].imag = (
                sum(k[:, i, None] * (place @ moved[i] + lean @ leant[i]) for i in (0, 1))
                for place, lean in zip(by_place, by_lean, strict=True)
            )
        return values, out

    def _strips(
        self, baseline: np.ndarray, wave: np.ndarray, landing: np.ndarray, inward: np.ndarray
    ) -> Iterator[_Strips]:
        """Yield the strips at some frequencies after the other."""
        across, places, steps = (v.T.astype(np.float32) for v in (self.normals, landing, inward))
        parts, curvatures = self.parts.astype(np.float32), self.curvatures.astype(np.float32)
        for first in range(0, len(wave), _CHUNK):
            piece = slice(first, first + _CHUNK)
            b, k = (v[piece].astype(np.float32) for v in (baseline, wave))
            half = np.float32(0.25) * np.abs(b @ across)
            lean = half * (k @ steps)
            eighth = np.float32(0.125) * (b * b).sum(axis=1, keepdims=True)
            light = -parts * (2.0 * half + curvatures * (eighth - 4.0 * half * half))
            yield _Strips(piece, k, light, half, lean, k @ places + lean)


@dataclass(frozen=True)
class _Strips:
    """Strips along rims at some frequencies.

    Attributes
    ----------
    piece : slice
        The frequencies.
    wave : ndarray, shape [n_frequency, 2]
        Their wave vectors [rad/m].
    light : ndarray, shape [n_frequency, n]
        Fractions of the light in the strips, negative.
    half_width, lean, phase : ndarray, shape [n_frequency, n]
        Half of the widths of the strips [m], phase of their middles against the rim, and phase there [rad].
    """

    piece: slice
    wave: np.ndarray
    light: np.ndarray
    half_width: np.ndarray
    lean: np.ndarray
    phase: np.ndarray

    @cached_property
    def mean(self) -> np.ndarray:
        """Means of the wave over the strips, over those at their middles."""
        return np.sinc(self.lean / np.float32(math.pi))

    @property
    def mean_slope(self) -> np.ndarray:
        """Derivatives of these by the lean."""
        lean = np.where(np.abs(self.lean) < _STRAIGHT, np.float32(_STRAIGHT), self.lean)
        slope = (np.cos(lean) - np.sinc(lean / np.float32(math.pi))) / lean
        return np.where(np.abs(self.lean) < _STRAIGHT, -self.lean / np.float32(3.0), slope)


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
    reach = 0.5 * telescope.pupil_diameter
    area, points, normals, parts, curvatures = 0.0, [], [], [], []
    for side, sign in ((0, 1.0), (1, -1.0)):
        rim = edges[:, side, None] * unit
        aimed = aimed_points(telescope, direction[None], wavelength, rim)
        rim = aimed[0] if aimed.ndim == 3 else rim
        before, after = np.roll(rim, 1, axis=0), np.roll(rim, -1, axis=0)
        along, bend = 0.5 * (after - before), after - 2.0 * rim + before
        area -= 0.5 * sign * float((rim[:, 0] * along[:, 1] - rim[:, 1] * along[:, 0]).sum())
        length = np.hypot(*along.T)
        # Where a spoke is dark its two ends are one point, and no light passes between them.
        shining = (edges[:, 1] > edges[:, 0]) & (length > 0.0)
        across = np.stack([along[:, 1], -along[:, 0]], axis=-1)[shining] / length[shining, None]
        points.append(rim[shining])
        normals.append(sign * across)
        parts.append(length[shining])
        curved = sign * (along[:, 0] * bend[:, 1] - along[:, 1] * bend[:, 0])[shining] / length[shining] ** 3
        # Corners, where one rim begins to vignette, count as what curves most.
        curvatures.append(np.clip(curved, -_MOST_CURVED / reach, _MOST_CURVED / reach))
    points, normals, curvatures = (np.concatenate(v) for v in (points, normals, curvatures))
    return PupilRims(points, normals, np.concatenate(parts) / max(area, 1e-300), curvatures, pieces)


def _annular_apertures_only(telescope: Telescope) -> Telescope:
    """Return the telescope without obstructions, and without apertures other than discs and rings."""
    surfaces = tuple(
        s if clear_annulus(s.aperture) is not None else replace(s, aperture=None) for s in telescope.surfaces
    )
    return replace(telescope, surfaces=surfaces, obstructions=())
