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

A vane of width t has its shadow at both ends of the baseline, and where it stands itself, between them, light is not
lost: :math:`w` and the sinc give way to :math:`(2 \cos 2h' - 1)\, t - \max(t - 2w, 0)` with :math:`2h' = w\, \kappa
\cdot m` of its middle, which is :math:`2w` for a wide one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ...models.telescope import Telescope
from ..atmosphere.turbulence import diffraction_otf
from ..pupil_polynomials import PupilPolynomials
from .clear_pupil import clear_edges, has_only_annuli
from .pupil_scan import no_vanes, points_of_plane, scanned_edges, scanned_vanes

#: Pieces of each rim: two pixels of a donut of 120.
PIECES = 192
# Curvature of a rim, over that of the pupil's own, up to which it is no corner.
_MOST_CURVED = 5.0
# Coefficients of the series of the sinc by the square of the lean of strips, and leans [rad] up to which so many of
# them are the sinc to 1e-4.
_SINC = tuple(np.float32(1.0 / v) for v in (-6.0, 120.0, -5040.0, 362880.0))
_SERIES = (0.3, 0.85, 1.6, 2.4)
# Lean of a strip [rad] below which the sinc is a parabola.
_SMALL_LEAN = 0.05
# Width of strips over the radius of the pupil up to which the rim is straight along them and all wavefronts lean alike.
_NARROW = 0.05
# Frequencies at a time: their strips stay in the processor's cache.
_CHUNK = 128


@dataclass(frozen=True)
class PupilRims:
    """Pieces of the rims of the clear pupil of one star, those of vanes last.

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
    vane_widths : ndarray, shape [n_vane]
        Widths of the last pieces, which are middles of vanes [m].
    pieces : int
        Pieces that each rim was divided into, dark ones among them.
    """

    points: np.ndarray
    normals: np.ndarray
    parts: np.ndarray
    curvatures: np.ndarray
    vane_widths: np.ndarray = field(default_factory=lambda: np.zeros(0))
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
        for strips in self._strips(baseline, wave, landing, inward):
            light = strips.amplitude()
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
            light, cosine, sine = strips.amplitude(), np.cos(strips.phase), np.sin(strips.phase)
            real, imaginary = light * cosine, -light * sine
            values[strips.piece].real, values[strips.piece].imag = real.sum(axis=1), imaginary.sum(axis=1)
            slopes = [(imaginary @ v, -(real @ v)) for v in moved]
            if strips.wide:
                # What the phase changes across a strip goes with that of its middle, and changes the mean.
                half, change = 0.5 * strips.width, 0.5 * strips.width * strips.amplitude_slope()
                by_lean = change * cosine, -change * sine
                rims = np.s_[:, : strips.rims]
                by_lean[0][rims] += half[rims] * imaginary[rims]
                by_lean[1][rims] -= half[rims] * real[rims]
                for along, v in zip(slopes, leant, strict=True):
                    for slope, lean in zip(along, by_lean, strict=True):
                        slope += lean @ v
            out[strips.piece].real, out[strips.piece].imag = (
                sum(strips.wave[:, i, None] * slopes[i][part] for i in (0, 1)) for part in (0, 1)
            )
        return values, out

    def _strips(
        self, baseline: np.ndarray, wave: np.ndarray, landing: np.ndarray, inward: np.ndarray
    ) -> Iterator[_Strips]:
        """Yield the strips at some frequencies after the other."""
        across, places, steps = (v.T.astype(np.float32) for v in (0.5 * self.normals, landing, 0.5 * inward))
        straight, bent = (v.astype(np.float32) for v in (-self.parts, self.parts * self.curvatures))
        narrow = _NARROW * float(np.abs(self.points).max(initial=0.0))
        rims, thick = len(self.points) - len(self.vane_widths), self.vane_widths.astype(np.float32)
        steepest = math.sqrt(float((steps**2).sum(axis=0).max(initial=0.0)))
        for first in range(0, len(wave), _CHUNK):
            piece = slice(first, first + _CHUNK)
            b, k = (v[piece].astype(np.float32) for v in (baseline, wave))
            width = b @ across
            np.abs(width, out=width)
            lean = k @ steps
            lean *= width
            square = (b * b).sum(axis=1)
            widest = 0.5 * math.sqrt(float(square.max()))
            most = widest * math.sqrt(float((k * k).sum(axis=1).max())) * steepest
            wide, light = widest > narrow, straight * width
            if wide:
                light += bent * width * width - np.outer(np.float32(0.125) * square, bent)
            phase = k @ places
            phase[:, :rims] += lean[:, :rims]
            light[:, rims:] = straight[rims:]
            yield _Strips(piece, k, light, width, lean, phase, most, wide, rims, thick)


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
        Fractions of the light in the strips, negative; of vanes over their width.
    width, lean, phase : ndarray, shape [n_frequency, n]
        Widths of the strips [m], phase of their middles against the rim, and phase there [rad].
    most : float
        A bound of the lean [rad].
    wide : bool
        Whether strips are so wide that the curvature of the rim, and changes of the lean, matter.
    rims : int
        Number of the pieces before those of vanes.
    vane_widths : ndarray, shape [n - rims]
        Widths of these [m].
    """

    piece: slice
    wave: np.ndarray
    light: np.ndarray
    width: np.ndarray
    lean: np.ndarray
    phase: np.ndarray
    most: float
    wide: bool
    rims: int
    vane_widths: np.ndarray

    def amplitude(self) -> np.ndarray:
        """Return the light of the strips by the mean of its waves, those of vanes together, [n_frequency, n].

        Shadows of a vane at both ends of the baseline take light, but the vane none where it is between them.
        """
        light = self.light * self.mean()
        if len(self.vane_widths):
            lean, width = (v[:, self.rims :] for v in (self.lean, self.width))
            shadows = (2.0 * np.cos(2.0 * lean) - np.float32(1.0)) * self.vane_widths
            shadows -= np.maximum(self.vane_widths - 2.0 * width, 0.0)
            light[:, self.rims :] = self.light[:, self.rims :] * shadows
        return light

    def amplitude_slope(self) -> np.ndarray:
        """Return the derivatives of these by the lean."""
        slope = self.light * self.mean_slope()
        if len(self.vane_widths):
            vanes = np.s_[:, self.rims :]
            slope[vanes] = np.float32(-4.0) * self.light[vanes] * np.sin(2.0 * self.lean[vanes]) * self.vane_widths
        return slope

    def mean(self) -> np.ndarray:
        """Return the means of the waves over the strips, over those at their middles."""
        terms = next((n for n, most in enumerate(_SERIES, 1) if self.most < most), 0)
        if not terms:
            return np.sinc(self.lean / np.float32(math.pi))
        square = self.lean * self.lean
        mean = square * _SINC[terms - 1]
        for coefficient in _SINC[: terms - 1][::-1]:
            mean += coefficient
            mean *= square
        mean += np.float32(1.0)
        return mean

    def mean_slope(self) -> np.ndarray:
        """Return the derivatives of these by the lean."""
        small = np.abs(self.lean) < _SMALL_LEAN
        lean = np.where(small, np.float32(1.0), self.lean)
        return np.where(small, self.lean / np.float32(-3.0), (np.cos(lean) - np.sin(lean) / lean) / lean)


def strip_overlap(baseline: np.ndarray, diameter: float, obscuration: float) -> np.ndarray:
    """Return the transfer function of an annulus over that of its strips at baselines [m]: 1 but for their overlap.

    Strips as wide as half the baseline overlap a little: to third order in the baseline, less than 1e-3.
    """
    width = 0.5 * diameter * (1.0 - obscuration)
    ring = np.minimum(baseline, width)
    return np.asarray(diffraction_otf(ring, diameter, obscuration) / (1.0 - 2.0 * ring / (math.pi * width)))


def pupil_rims(telescope: Telescope, direction: np.ndarray, wavelength: float, pieces: int = PIECES) -> PupilRims:
    """Return the rims of the clear pupil for light of one direction [3], each in so many pieces, and its vanes."""
    angle = 2.0 * math.pi * (np.arange(pieces) + 0.5) / pieces
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    vanes = no_vanes()
    if has_only_annuli(telescope):
        edges = clear_edges(telescope, direction[None], unit, wavelength, threads=1)[0]
    else:
        edges = scanned_edges(telescope, direction, unit, wavelength)
        vanes = scanned_vanes(telescope, direction, edges, wavelength)
    reach = 0.5 * telescope.pupil_diameter
    area, pieces_of_rims = 0.0, []
    for side, sign in ((0, 1.0), (1, -1.0)):
        rim = edges[:, side, None] * unit
        rim = points_of_plane(telescope, direction, wavelength, rim)
        before, after = np.roll(rim, 1, axis=0), np.roll(rim, -1, axis=0)
        along, bend = 0.5 * (after - before), after - 2.0 * rim + before
        area -= 0.5 * sign * float((rim[:, 0] * along[:, 1] - rim[:, 1] * along[:, 0]).sum())
        length = np.hypot(*along.T)
        # Where a spoke is dark its two ends are one point, and no light passes between them.
        shining = (edges[:, 1] > edges[:, 0]) & (length > 0.0)
        across = np.stack([along[:, 1], -along[:, 0]], axis=-1)[shining] / length[shining, None]
        curved = sign * (along[:, 0] * bend[:, 1] - along[:, 1] * bend[:, 0])[shining] / length[shining] ** 3
        # Corners, where one rim begins to vignette, count as what curves most.
        curved = np.clip(curved, -_MOST_CURVED / reach, _MOST_CURVED / reach)
        pieces_of_rims.append((rim[shining], sign * across, length[shining], curved))
    points, normals, lengths, curvatures = (np.concatenate(v) for v in zip(*pieces_of_rims, strict=True))
    area = max(area - float((vanes.lengths * vanes.widths).sum()), 1e-300)
    return PupilRims(
        np.concatenate([points, vanes.points]),
        np.concatenate([normals, vanes.normals]),
        np.concatenate([lengths, vanes.lengths]) / area,
        np.concatenate([curvatures, np.zeros(len(vanes.points))]),
        vanes.widths,
        pieces,
    )
