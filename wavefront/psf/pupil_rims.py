r"""Diffraction at the rims of the pupil, for images far from focus.

The transfer function of the optics at a baseline b (:mod:`.long_exposure`) is an integral over the points of the pupil
about which both :math:`p \pm b/2` are clear: the clear pupil less a strip along its rims, of width
:math:`|b \cdot n| / 2` at a rim of normal n. Far from focus the strips land at the rims of the image, so that
diffraction changes these and leaves what lies between them as rays have it. For pieces of rim of length l, with strips
of width :math:`w = |b \cdot n| / 2`,

.. math:: -\frac{1}{A} \sum l \, e^{-i (\kappa \cdot x + h)} \left[w S + c \left(\frac{b^2}{8} - \frac{w^2}{2}\right)
   e^{-i h} - \frac{c w^2}{2} (S + i S')\right], \qquad h = \frac{w}{2} \kappa \cdot m, \quad S = \frac{\sin h}{h}

is added to the transform of the rays' image: :math:`\kappa` is the wave vector of the image, x the place where the
light of the rim lands, and m the change of this place per metre towards the lit side. The phase is that of the middle
of the strip, and S the mean over the strip, which matters on a small pupil of long focal length: without it strips of
AuxTel are wrong by as much as they are. A rim of curvature c, positive where the lit side is convex, has strips that
are wider, at their inner ends, and shorter the further in than those of a straight one.

A vane of width t has its shadow at both ends of the baseline, and where it stands itself, between them, light is not
lost: :math:`w` and the sinc give way to :math:`(2 \cos 2h' - 1)\, t - \max(t - 2w, 0)` with :math:`2h' = w\, \kappa
\cdot m` of its middle, which is :math:`2w` for a wide one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import warp as wp

from ...core.launch import launch
from ...core.warp_arrays import warp_array
from ...models.telescope import Telescope
from ..atmosphere.turbulence import diffraction_otf
from ..pupil_polynomials import PupilPolynomials
from .clear_pupil import clear_edges, has_only_annuli
from .pupil_rim_kernels import PIECE_NUMBERS, sum_strips
from .pupil_scan import no_vanes, points_of_plane, scanned_edges, scanned_vanes
from .sample_packets import LANES

#: Pieces of each rim: two pixels of a donut of 120.
PIECES = 192
# Curvature of a rim, over that of the pupil's own, up to which it is no corner.
_MOST_CURVED = 5.0
# Frequencies at a time: their strips take some 30 MB.
_CHUNK = 4096


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
        return self._sums(baseline, wave, self._packets(landing, inward), slopes=False)[0]

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
        count, pieces = response.shape[2], self._packets(landing, inward)
        values, out = (np.empty((len(wave), *shape), dtype=np.complex64) for shape in ((), (count,)))
        # Those of the places, then of their changes: [2 * piece, axis, unknown].
        moved = np.zeros((2, pieces.shape[1], 2, count), dtype=np.float32)
        moved[:, self._place] = np.stack([response, inward_response]).swapaxes(1, 2)
        by_unknowns = moved.reshape(-1, 2 * count)
        for first in range(0, len(wave), _CHUNK):
            piece = slice(first, first + _CHUNK)
            values[piece], parts = self._sums(baseline[piece], wave[piece], pieces, slopes=True)
            along = (parts.reshape(2 * len(parts), -1) @ by_unknowns).reshape(-1, 2, 2, count)
            along *= wave[piece, None, :, None].astype(np.float32)
            out[piece].real, out[piece].imag = (along[:, part, 0] + along[:, part, 1] for part in (0, 1))
        return values, out

    @cached_property
    def _place(self) -> np.ndarray:
        """Places of the pieces in whole packets of rims, then of vanes, shape [n]."""
        rims, vanes = len(self.points) - len(self.vane_widths), len(self.vane_widths)
        return np.concatenate([np.arange(rims), _whole_packets(rims) + np.arange(vanes)])

    def _packets(self, landing: np.ndarray, inward: np.ndarray) -> np.ndarray:
        """Return the numbers of the pieces for :func:`.pupil_rim_kernels.sum_strips`, [PIECE_NUMBERS, n_packet]."""
        vanes = len(self.vane_widths)
        count = _whole_packets(len(self.points) - vanes) + _whole_packets(vanes)
        pieces = np.zeros((PIECE_NUMBERS, count), dtype=np.float32)
        widths = np.concatenate([np.zeros(len(self.points) - vanes), self.vane_widths])
        own = (*(0.5 * self.normals.T), *landing.T, *(0.5 * inward.T), self.parts, self.curvatures, widths)
        pieces[:, self._place] = np.stack(own)
        return pieces

    def _sums(
        self, baseline: np.ndarray, wave: np.ndarray, pieces: np.ndarray, *, slopes: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return :meth:`transfer` from packets of pieces, and with slopes the parts of its derivatives."""
        n_rim = _whole_packets(len(self.points) - len(self.vane_widths))
        values = np.empty(len(wave), dtype=np.complex64)
        parts = np.empty((len(wave) if slopes else 0, 2, 2 * pieces.shape[1]), dtype=np.float32)
        frequencies = (warp_array(v, wp.float32) for v in (baseline, wave, pieces))
        results = warp_array(values, wp.float32), warp_array(parts, wp.float32)
        launch(sum_strips, len(wave), [*frequencies, n_rim, *results], threads=1)
        return values, parts


def _whole_packets(count: int) -> int:
    """Return the least number of pieces that are whole packets and as many or more."""
    return -(-count // LANES) * LANES


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
        curved = -sign * (along[:, 0] * bend[:, 1] - along[:, 1] * bend[:, 0])[shining] / length[shining] ** 3
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
