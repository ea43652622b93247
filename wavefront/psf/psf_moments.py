"""Moments of point spread functions without images: ellipticities, sizes and centroids of many stars.

Under a Gaussian weight W the moments of an image are sums over its transfer function times that of the weight, which
leaves only the lowest frequencies: some 300 of them in place of the thousands of an image, whose pixels are not drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError
from ...core.launch import launch
from ...core.point_plots import draw_shapes
from ...core.result import Result
from ...core.units import ARCSEC, angle, field_label, require_within
from ...core.warp_arrays import warp_array
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ..aberration import ResidualWavefront
from ..atmosphere.atmosphere import Atmosphere
from ..atmosphere.turbulence import diffraction_otf, fried_parameter
from ..pupil_optics import PupilOptics
from ..request import Request
from .engine import ExposedStars, PsfEngine, PsfInputs, Stars
from .engines import psf_engine
from .light import Light
from .long_exposure import LongExposureEngine, LongExposureRenderer
from .moment_kernels import ELLIPSE, measure_spectra
from .psf import psf_inputs
from .sample_packets import samples
from .stamps import Stamps
from .statistical import StatisticalEngine, StatisticalRenderer, far_from_focus

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: FWHM of the weight with an atmosphere, and without one [rad] (Jee & Tyson 2011, sec. 3).
WEIGHT_FWHM = 0.7 * ARCSEC
WEIGHT_FWHM_ALONE = 0.3 * ARCSEC
#: Side of the periodic image over the rms width of the weight, with and without an atmosphere, and over the FWHM of the
#: seeing, at least.
_WEIGHTS = 12.0
_WEIGHTS_ALONE = 16.0
_SEEINGS = 6.0
#: Longest baseline of the integral over the mean image, in Fried parameters, and its nodes.
_FRIEDS = 5.0
_NODES = 100
#: Narrowest and widest FWHM of the weight [rad].
_WEIGHT_FWHMS = (0.02 * ARCSEC, 20.0 * ARCSEC)
#: Width of the narrowest weight over that of the first: it decides which frequencies count.
_NARROWEST = 0.5
# Pixels of a stamp that is wider than any star.
_WIDE_STAMP = 4096
# Most stars of one batch.
_BATCH = 4096
_MOST_STEPS = 60
# Of the centroid, and the square root of moments, as a part of the weight's width: sums are float32.
_TOLERANCE = 1e-5


@dataclass(frozen=True)
class PsfMoments(Result):
    """Moments of point spread functions of n stars, along the axes of the detector; NaN where flagged.

    Parameters
    ----------
    fields : array, shape [n, 2]
        Field angles [rad].
    e1, e2 : array
        Ellipticity (a - b)/(a + b) under the round weight, as :func:`~pachon.measure_shapes` has it.
    size : array
        ``(Q11 Q22 - Q12^2)^(1/4)`` of the moments under the round weight [rad].
    x, y : array
        Centroid under it, from the star's reference point [pixel].
    g1, g2 : array
        Ellipticity (a - b)/(a + b) of adaptive moments, as :func:`~pachon.adaptive_moments` has it; NaN without an
        atmosphere.
    sigma : array
        Determinant radius of the adaptive moments [rad]; NaN without an atmosphere.
    lit_fraction : array
        Lit fraction of the pupil, mean over wavelengths.
    flags : array of int
        1 where the iteration has not converged, 2 where moments are not positive, 8 where no light arrives.
    """

    _table = ("fields", "e1", "e2", "size", "x", "y", "g1", "g2", "sigma", "lit_fraction", "flags")

    fields: np.ndarray
    e1: np.ndarray
    e2: np.ndarray
    size: np.ndarray
    x: np.ndarray
    y: np.ndarray
    g1: np.ndarray
    g2: np.ndarray
    sigma: np.ndarray
    lit_fraction: np.ndarray
    flags: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the ellipticities in their plane, coloured by the size."""
        return draw_shapes(ax, self.e1, self.e2, self.size / ARCSEC, "weighted rms size [arcsec]")

    @property
    def T(self) -> np.ndarray:  # noqa: N802
        """Size Mxx + Myy of the adaptive moments [rad^2]."""
        square = self.g1**2 + self.g2**2
        return np.asarray(2.0 * self.sigma**2 * (1.0 + square) / (1.0 - square))

    @property
    def usable(self) -> np.ndarray:
        """Stars without a flag, [n] bool."""
        return self.flags == 0

    def __len__(self) -> int:
        """Return the number of stars."""
        return len(self.flags)


@check_arguments
def psf_moments(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | Light | None = None,
    *,
    focal_plane: FocalPlane | None = None,
    atmosphere: Atmosphere | None = None,
    aberration: ResidualWavefront | None = None,
    stamps: Stamps | None = None,
    engine: Literal["long_exposure", "statistical"] | PsfEngine = "long_exposure",
    weight_fwhm: ArrayLike | None = None,
    threads: int | None = None,
) -> PsfMoments:
    """Compute moments of point spread functions without their images.

    They are those that :func:`~pachon.measure_shapes` and :func:`~pachon.adaptive_moments` measure on the images of
    :func:`~pachon.make_psfs`, but for what these images lack: sums over pixels stand for integrals there, and their
    stamps cut wings off. A star depends on no other.

    Parameters
    ----------
    telescope, fields, wavelengths, focal_plane, atmosphere, aberration, threads
        As in :func:`~pachon.make_psfs`; without an atmosphere the moments are those of the optics alone.
    stamps : Stamps, optional
        Pixels, charge diffusion, silicon and jitter; sizes and places do not matter.
    engine : LongExposureEngine, StatisticalEngine, or {"long_exposure", "statistical"}
        The mean over all turbulence, or an exposure drawn from its theory.
    weight_fwhm : float or Quantity, optional
        FWHM of the round Gaussian weight [rad]; 0.7 arcsec by default, and 0.3 without an atmosphere.

    Returns
    -------
    PsfMoments

    Raises
    ------
    ConfigError
        If the engine is another one, or fields or wavelengths are given beside a request.
    DomainError
        If an argument is outside its range or of the wrong shape, a star is far from focus or falls between the CCDs.
    """
    options = psf_engine(engine)
    if not isinstance(options, LongExposureEngine):
        raise ConfigError(
            f"engine = {options.name!r}: expected 'long_exposure' or 'statistical', whose moments are sums over "
            "transfer functions (make_psfs and measure_shapes have those of others)",
            key="engine",
        )
    default = WEIGHT_FWHM_ALONE if atmosphere is None else WEIGHT_FWHM
    fwhm = angle(default if weight_fwhm is None else weight_fwhm, "weight_fwhm")
    require_within(fwhm, "weight_fwhm", *_WEIGHT_FWHMS, "radians")
    inputs, stars = psf_inputs(
        telescope, fields, wavelengths, focal_plane, atmosphere, aberration, stamps or Stamps(), threads
    )
    renderer = _renderer(options, inputs, fwhm / math.sqrt(8.0 * math.log(2.0)))
    stars = replace(stars, offsets=np.zeros_like(stars.offsets))
    values, lit = np.empty((len(stars), _COLUMNS)), np.empty((len(stars), len(inputs.wavelengths)))
    renderer.prepare(stars.fields)
    for batch in renderer.batches(stars.fields):
        exposed = renderer.expose(stars[batch])
        values[batch], lit[batch] = exposed.draw(None), exposed.lit_fraction
    return _result(stars.fields, values, lit, inputs, renderer.focal_length)


#: Numbers of a star: ellipses and flags of both weights.
_COLUMNS = 2 * (ELLIPSE + 1)


def _result(
    fields: np.ndarray, values: np.ndarray, lit: np.ndarray, inputs: PsfInputs, focal_length: float
) -> PsfMoments:
    """Return moments of ellipses [m] and flags on the detector."""
    weighted, adaptive = np.split(values, 2, axis=1)
    e1, e2, size, flags = _shapes(weighted)
    g1, g2, sigma, adaptive_flags = _shapes(adaptive)
    if inputs.atmosphere is None:
        g1, g2, sigma = (np.full(len(e1), np.nan) for _ in range(3))
    else:
        flags = flags | adaptive_flags
    good = flags == 0
    x, y = np.where(good, weighted[:, :2].T / inputs.plane.pixel_size, np.nan)
    e1, e2, size, g1, g2, sigma = (np.where(good, v, np.nan) for v in (e1, e2, size, g1, g2, sigma))
    return PsfMoments(fields, e1, e2, size / focal_length, x, y, g1, g2, sigma / focal_length, lit.mean(axis=1), flags)


def _shapes(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return both ellipticities, determinant radius and flags of ellipses."""
    _, _, xx, yy, xy, _, flag = values.T
    good = flag == 0.0
    root = np.sqrt(np.where(good, xx * yy - xy**2, np.nan))
    norm = xx + yy + 2.0 * root
    return (xx - yy) / norm, 2.0 * xy / norm, np.sqrt(root), flag.astype(np.int64)


def _renderer(options: LongExposureEngine, inputs: PsfInputs, weight_rms: float) -> _Moments:
    """Return the renderer of moments under a weight of an rms width [rad]."""
    if inputs.atmosphere is None:
        if isinstance(options, StatisticalEngine):
            options.renderer(inputs)  # says that it needs an atmosphere
        return _MomentsOfOptics(inputs, options, weight_rms)
    if isinstance(options, StatisticalEngine):
        return _MomentsOfExposure(inputs, options, weight_rms)
    return _Moments(inputs, options, weight_rms)


class _Moments(LongExposureRenderer):
    """Moments of the long exposure, in place of its stamps."""

    negligible = 1e-4

    def __init__(self, inputs: PsfInputs, options: Any, weight_rms: float) -> None:
        self._weight_angle = weight_rms
        super().__init__(inputs, options)
        self.batch = min(_BATCH, 4 * self.batch)
        # No light falls beside a stamp.
        self._inputs = replace(self._inputs, plane=replace(self._inputs.plane, size=_WIDE_STAMP))

    def expose(self, stars: Stars) -> ExposedStars:
        """Expose stars: their moments in place of stamps."""
        return self._expose(stars)

    @property
    def _weight(self) -> float:
        """Rms width of the weight on the detector [m]."""
        return self._weight_angle * self.focal_length

    def _period(self) -> float:
        air = self._inputs.atmosphere
        if air is None:
            width = _WEIGHTS_ALONE * self._weight_angle
        else:
            longest = float(self._wavelengths.max())
            seeing = longest / float(fried_parameter(air.r0, longest))
            width = max(_WEIGHTS * self._weight_angle, _SEEINGS * seeing)
        return max(width * self.focal_length, 8.0 * self._plane.pixel_size)

    @cached_property
    def _background(self) -> float:
        """Light a pixel of the wings of all periodic images but one, in its middle.

        It is what the sum over frequencies has beyond the integral, of the mean image of ideal optics.
        """
        air = self._inputs.atmosphere
        if air is None:
            return 0.0
        # Evenly in the root of the baseline: structure functions go as its power of 5/3.
        root, beyond = np.linspace(0.0, 1.0, _NODES + 1), []
        for wave, step in enumerate(self._step):
            longest = min(self._diameter, _FRIEDS * float(fried_parameter(air.r0, self._wavelengths[wave])))
            count = np.arange(-math.ceil(longest / step), math.ceil(longest / step) + 1)
            squares, places = np.unique(np.add.outer(count**2, count**2), return_counts=True)
            baseline = np.concatenate([step * np.sqrt(squares), longest * root**2])
            transfer = self._turbulence(baseline)[wave] * diffraction_otf(baseline, self._diameter, self._obscuration)
            integral = 4.0 * math.pi * (longest / step) ** 2 / _NODES * root**3 @ transfer[len(squares) :]
            beyond.append(places @ np.where(baseline <= longest, transfer, 0.0)[: len(squares)] - integral)
        return float(np.mean(beyond)) * (self._plane.pixel_size / self.period) ** 2

    def _transfer_bounds(self, longest: float) -> np.ndarray:
        bounds = super()._transfer_bounds(longest)
        k = 2.0 * math.pi / self.period * np.arange(1, bounds.shape[1] + 1)
        return np.asarray(bounds * np.exp(-0.5 * (_NARROWEST * self._weight * k) ** 2))

    def _ray_counts(self, optics: PupilOptics) -> np.ndarray:
        return far_from_focus(optics, self.focal_length)

    def _expose_rays(self, rays: int, stars: Stars) -> ExposedStars:
        raise DomainError(
            f"{field_label(stars.fields[0])}: the star is far from focus; expected stars near it for moments without "
            "images"
        )

    def _sampled(self, spectrum: np.ndarray, offsets: np.ndarray, lit: np.ndarray, points: np.ndarray) -> ExposedStars:
        square = self._weight**2
        weighted = self._measure(spectrum, np.tile([0.0, 0.0, square, square, 0.0], (len(spectrum), 1)), False)
        adaptive = weighted
        if self._inputs.atmosphere is not None:
            adaptive = self._measure(spectrum, _without_weight(weighted, square), True)
        values = np.concatenate([weighted, adaptive], axis=1)
        return ExposedStars(lambda shift: values, lit, points)

    def _measure(self, spectrum: np.ndarray, start: np.ndarray, adaptive: bool) -> np.ndarray:
        """Return ellipses [m] and flags of transfer functions, [n_star, ELLIPSE + 1].

        The first weight has the centroid [m] and the moments [m^2] of ``start`` [n_star, 5].
        """
        unit = self.period / (2.0 * math.pi)
        scale = np.array([unit, unit, unit**2, unit**2, unit**2, 1.0])
        ellipse, flags = np.zeros((len(spectrum), ELLIPSE)), np.zeros(len(spectrum), dtype=np.int32)
        launch(
            measure_spectra,
            len(spectrum),
            [
                warp_array(spectrum, samples),
                warp_array(self._detector, samples),
                warp_array(self._rows, wp.int32),
                warp_array(start / scale[:5]),
                self._background,
                adaptive,
                _MOST_STEPS,
                _TOLERANCE,
                warp_array(ellipse),
                warp_array(flags, wp.int32),
            ],
            threads=self._threads,
        )
        return np.concatenate([ellipse * scale, flags[:, None]], axis=1)


def _without_weight(weighted: np.ndarray, square: float) -> np.ndarray:
    """Return centroids and moments [n, 5] of Gaussian images with ellipses under a round weight of a variance [m^2].

    Where an ellipse is flagged, or no Gaussian has it, the weight's own moments take its place.
    """
    x, y, xx, yy, xy, _, flags = weighted.T
    good = (flags == 0.0) & (xx * yy > xy**2)
    determinant = np.where(good, xx * yy - xy**2, 1.0)
    along_x, along_y, across = yy / determinant - 1.0 / square, xx / determinant - 1.0 / square, -xy / determinant
    inverse = along_x * along_y - across**2
    good &= (along_x > 0.0) & (inverse > 0.0)
    inverse = np.where(good, inverse, 1.0)
    image = np.stack([x, y, along_y / inverse, along_x / inverse, -across / inverse], axis=1)
    return np.where(good[:, None], image, [0.0, 0.0, square, square, 0.0])


class _MomentsOfExposure(_Moments, StatisticalRenderer):
    """Moments of an exposure of the statistical engine."""


class _MomentsOfOptics(_Moments):
    """Moments of the optics alone, under a weight that is wide enough."""

    def _turbulence(self, baseline: np.ndarray) -> np.ndarray:
        return np.ones((len(self._wavelengths), np.shape(baseline)[-1]))
