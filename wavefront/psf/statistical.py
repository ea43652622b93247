r"""The statistical PSF engine: exposures through turbulence drawn from its theory, without screens.

An image is that of the long exposure, of optics with the air's mean wavefront added, convolved with a Gaussian kernel

.. math:: \mathrm{d}M - \langle \nabla w \, \nabla w^T \rangle .

dM is what the second moments of turbulence in this exposure have beyond their mean over all exposures; it is drawn,
with the mean wavefront w, from Gaussian fields over the field of view (:mod:`.exposure_fields`). The long exposure
contains the moments of all turbulence, w included, so those of w itself are taken away again: what is left of w are its
products with the aberrations of the optics, which moments of the air alone lack.

A kernel of negative variance makes images sharper than the long exposure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.launch import launch
from ...core.units import ARCSEC, field_label
from ...core.warp_arrays import warp_array
from ...models.zernike_polynomials import annular_zernike_gradients
from ..aberration import ResidualWavefront
from ..atmosphere.exposure_fields import NOLL, ExposureFields, draw_exposure
from ..atmosphere.moment_covariance import LEAST_EXPOSURE, ExposedAir
from ..atmosphere.screen_sampling import DEFAULT_CUTOFF, largest_cutoff
from ..pupil_optics import PupilOptics, trace_pupils
from .clear_pupil import SpokePupil
from .engine import ExposedStars, PsfInputs, Stars
from .far_from_focus import blur_radii, check_stamp
from .field_optics import FieldOptics, field_optics
from .lattice_pupil import RINGS_POINTS
from .long_exposure import LongExposureEngine, LongExposureRenderer
from .mean_rays import FAR_ANGLE
from .moment_response import moment_response
from .pupil_means import PupilMeans
from .sample_packets import samples
from .spectral_rule import spectral_rule
from .statistical_kernels import blur_spectra

#: FWHM of the weight under which moments of the fourth order have the same effect as the kernel [rad].
MATCHED_FWHM = 0.7 * ARCSEC
# Points along the radius and the angle of means over the pupil: exact for the gradients of Z4 to Z15.
_RADII = 16
_ANGLES = 16


@check_arguments
@dataclass(frozen=True)
class StatisticalEngine(LongExposureEngine):
    """Exposures of 5 s and more through turbulence drawn from its theory, without screens.

    Ellipticities and sizes have the variances and correlations over the field that an exposure has, by layers, winds,
    Fried parameter, outer scale and time of the atmosphere; its screens are not made. Not in its images: motion of
    stars by the air, moments of the third order and speckles, exposures under 5 s, consecutive exposures through the
    same air, and stars far from focus.

    Attributes
    ----------
    n_pupil : int, optional
        As in :class:`LongExposureEngine`, but 60 points on spokes and 7500 of a lattice by default.

    Raises
    ------
    DomainError
        If there are too few points.
    """

    name = "statistical"
    has_turbulence = True
    # 12 spokes of 5 rings: with 0.2 um of aberration e of the LSST is wrong by 2e-5 (rms), its size by 3e-5.
    spoke_points = 60
    # e of DECam and HSC is wrong by 1e-4 (rms), sizes by 2e-4; with 15 000, which take twice as long, by 4e-5 and 7e-5.
    lattice_points = RINGS_POINTS

    n_pupil: int | None = None

    def _renderer(self, inputs: PsfInputs) -> StatisticalRenderer:
        return StatisticalRenderer(inputs, self)


def check_exposure(exposure: float, start: float = 0.0, key: str = "exposure") -> None:
    """Raise a DomainError for an exposure [s] that the engine cannot draw: a short one, or one that starts later."""
    if exposure < LEAST_EXPOSURE:
        raise DomainError(
            f"{key} = {exposure:g} s: expected at least {LEAST_EXPOSURE:g} s with engine = 'statistical', whose "
            "shapes are Gaussian ('fast' makes shorter exposures)",
            key=key,
        )
    if abs(start) > 1e-6 * exposure:
        raise DomainError(
            f"times: the exposure starts at {start:g} s; expected 0 with engine = 'statistical', whose exposures do "
            "not share the air of another ('fast' makes consecutive snaps)",
            key="times",
        )


class StatisticalRenderer(LongExposureRenderer):
    """Renderer of :class:`StatisticalEngine`."""

    # What is left out moves e by 1e-6 and pixels by 3e-5 of the peak, a hundredth of what third moments would.
    negligible = 1e-4
    # With 0.1 um of aberration e of the LSST is wrong by 5e-4 (rms of both components) along 12 spokes at 0.75 to 0.85.
    least_lit = 0.85
    # By 2.6e-4 along 24 at 0.7 to 0.85. With M2 10 um out of focus by 3e-4 along 64 spokes at 0.55, its size by 1e-4;
    # by 4e-4 and 3e-4 along 128 at 0.38, by 6e-4 and 3e-4 at 0.2 to 0.3, where the lattice, which takes four times as
    # long, has 5e-4 and 2e-4.
    dense = ((0.7, 24, 5), (0.5, 64, 5), (0.2, 128, 6))

    def __init__(self, inputs: PsfInputs, options: StatisticalEngine) -> None:
        air = inputs.atmosphere
        assert air is not None, "the engine needs one"
        check_exposure(air.exposure, float(air.times[0]) - 0.5 * air.exposure / len(air.times))
        telescope = inputs.telescope
        self._base = inputs.aberration
        exposed_air = ExposedAir.of(air, telescope.pupil_diameter, telescope.pupil_obscuration)
        if air.cutoff == largest_cutoff(air.screen_size, air.screen_length):
            # Coarse screens would limit slopes, but there are none.
            exposed_air = exposed_air._replace(cutoff=DEFAULT_CUTOFF / air.r0)
        self._exposed_air = exposed_air
        # Whichever wavelengths stand for those of the light, the exposure drawn is one.
        self._asked = inputs
        self._rule = None if inputs.has_spectra else spectral_rule(inputs, self.depths)
        super().__init__(inputs if self._rule is None else self._rule.inputs(inputs), options)
        self._pupil_means = PupilMeans.of(inputs)
        with_air = _WithAir.of(self._base, self._exposed_air, self.drawn)
        self._inputs = replace(self._inputs, aberration=with_air)

    @cached_property
    def drawn(self) -> ExposureFields:
        """Fields of the exposure."""
        air = self._inputs.atmosphere
        assert air is not None
        response = moment_response(self._asked, self._pupil_means, self.focal_length, MATCHED_FWHM)
        return draw_exposure(self._exposed_air, response, self._inputs.telescope.field_radius, air.seed, air.epoch)

    def kernels(self, optics: PupilOptics, lit: np.ndarray) -> np.ndarray:
        """Return the Gaussian kernels on the sky, xx, yy, xy [rad^2], [n_star, 3], of stars of lit fractions [n]."""
        direction = self._direction(optics.fields)
        slopes = direction[:, :2] / -direction[:, 2:]
        p, q, s = self.drawn.moments_at(slopes, self._pupil_means.relative_square(slopes), lit).T
        wavefront = self.drawn.wavefronts_at(slopes)
        of_mean = np.einsum("ni,kij,nj->nk", wavefront, self._mean_moments, wavefront)
        return np.stack([0.5 * (s + p), 0.5 * (s - p), 0.5 * q], axis=1) - of_mean

    @cached_property
    def _mean_moments(self) -> np.ndarray:
        """Moments xx, yy, xy of the slopes of two Zernikes of the mean wavefront [1/m^2], [3, n_noll, n_noll]."""
        return _gradient_moments(self._diameter, self._obscuration)

    def _expose(self, stars: Stars) -> ExposedStars:
        if self._rule is None:
            return super()._expose(stars)
        photons = np.broadcast_to(self._rule.photons, (len(stars), len(self._rule.photons)))
        exposed = super()._expose(replace(stars, photons=photons))
        # Apertures cut all wavelengths alike.
        lit = np.repeat(exposed.lit_fraction[:, :1], len(self._asked.wavelengths), axis=1)
        return exposed._replace(lit_fraction=lit)

    def _exposed_spectra(self, spectrum: np.ndarray, optics: PupilOptics, lit: np.ndarray) -> np.ndarray:
        xx, yy, xy = self.kernels(optics, lit).T
        on_sky = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
        on_detector = optics.jacobian @ on_sky @ np.swapaxes(optics.jacobian, 1, 2)
        moments = on_detector.reshape(-1, 4)[:, [0, 3, 1]] * (0.5 * (2.0 * math.pi / self.period) ** 2)
        launch(
            blur_spectra,
            len(spectrum),
            [warp_array(moments, wp.float32), warp_array(self._rows, wp.int32), warp_array(spectrum, samples)],
            threads=self._threads,
        )
        return spectrum

    def _near_optics(self, stars: Stars, pupil: SpokePupil) -> tuple[PupilOptics, np.ndarray]:
        optics = self._field_optics(pupil)
        if optics is None:
            return super()._near_optics(stars, pupil)
        direction = self._direction(stars.fields)
        slopes = direction[:, :2] / -direction[:, 2:]
        covered = optics.covers(slopes)
        if not covered.all():
            return self._partly_covered(stars, covered, pupil)
        inputs = self._inputs
        interpolated, edges = optics.at(stars.fields, slopes, inputs.focal_plane, inputs.aberration, self._threads)
        check_stamp(interpolated, inputs.plane)
        return interpolated, edges

    def _partly_covered(self, stars: Stars, covered: np.ndarray, pupil: SpokePupil) -> tuple[PupilOptics, np.ndarray]:
        """Return optics and edges of stars of which some lie beyond the polynomials, and are traced."""
        groups = [np.flatnonzero(covered), np.flatnonzero(~covered)]
        parts = [self._near_optics(stars[groups[0]], pupil)] if covered.any() else []
        parts.append(super()._near_optics(stars[groups[1]], pupil))
        order = np.argsort(np.concatenate(groups))
        optics = PupilOptics.together([part for part, _ in parts])
        return optics.stars(order), np.concatenate([edges for _, edges in parts])[order]

    def _field_optics(self, pupil: SpokePupil) -> FieldOptics | None:
        """Optics interpolated over the field; None where rays are not those of the telescope, or not smooth."""
        inputs = self._inputs
        if inputs.trace is not trace_pupils:
            return None
        return field_optics(inputs.telescope, tuple(self._wavelengths.tolist()), pupil)

    def _ray_counts(self, optics: PupilOptics) -> np.ndarray:
        return far_from_focus(optics, self.focal_length)

    def _expose_rays(self, rays: int, stars: Stars) -> ExposedStars:
        raise DomainError(
            f"{field_label(stars.fields[0])}: the star is far from focus; expected stars near it with engine = "
            "'statistical' ('fast' and 'long_exposure' draw others)"
        )


def far_from_focus(optics: PupilOptics, focal_length: float) -> np.ndarray:
    """Return which stars are too far from focus for sums over few points of the pupil, shape [n_star] int."""
    return (blur_radii(optics) > FAR_ANGLE * focal_length).astype(np.int64)


@lru_cache(maxsize=8)
def _gradient_moments(diameter: float, obscuration: float) -> np.ndarray:
    """Return the covariances over the pupil of the gradients of Zernikes, xx, yy, xy [1/m^2], [3, n_noll, n_noll]."""
    node, weight = np.polynomial.legendre.leggauss(_RADII)
    inner = obscuration**2
    radius = np.sqrt(inner + 0.5 * (1.0 - inner) * (node + 1.0))
    angle = 2.0 * np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES
    x, y = (np.outer(radius, around).ravel() for around in (np.cos(angle), np.sin(angle)))
    share = np.repeat(0.5 * weight / _ANGLES, _ANGLES)
    gradient = annular_zernike_gradients(NOLL[-1], x, y, obscuration)[NOLL[0] - 1 :] / (0.5 * diameter)
    gradient = gradient - (gradient @ share)[..., None]
    along_x, along_y = gradient[:, 0], gradient[:, 1]
    mixed = (along_x * share) @ along_y.T
    return np.stack([(along_x * share) @ along_x.T, (along_y * share) @ along_y.T, 0.5 * (mixed + mixed.T)])


@dataclass(frozen=True, eq=False)
class _WithAir(ResidualWavefront):
    """The air's mean wavefront, beside the aberration that the telescope has anyway."""

    drawn: ExposureFields | None = None
    base: ResidualWavefront | None = None

    @classmethod
    def of(cls, base: ResidualWavefront | None, air: ExposedAir, drawn: ExposureFields) -> _WithAir:
        return cls(np.zeros(len(NOLL)), air.diameter, air.obscuration, drawn=drawn, base=base)

    def at(self, slopes: ArrayLike) -> np.ndarray:
        """Return the air's coefficients [m] at field slopes [..., 2], shape [..., n_term]."""
        assert self.drawn is not None
        places = np.asarray(slopes, dtype=np.float64)
        # The wavefront leads where the path is short.
        return -self.drawn.wavefronts_at(places.reshape(-1, 2)).reshape(*places.shape[:-1], -1)

    def opd(self, x: ArrayLike, y: ArrayLike, slopes: ArrayLike = (0.0, 0.0)) -> np.ndarray:
        total = super().opd(x, y, slopes)
        return total if self.base is None else total + self.base.opd(x, y, slopes)

    def gradient(self, x: ArrayLike, y: ArrayLike, slopes: ArrayLike = (0.0, 0.0)) -> np.ndarray:
        total = super().gradient(x, y, slopes)
        return total if self.base is None else total + self.base.gradient(x, y, slopes)
