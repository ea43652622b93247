r"""Shapes of the long-exposure PSF of a telescope, as functions of CCD height, residual wavefront and seeing.

The shape of the PSF of the optics under the mean of all turbulence changes with the height of the CCD, with the
residual aberration of the exposure and with the Fried parameter. Heights enter through a polynomial between Chebyshev
nodes, whose derivative is exact: five nodes over +-25 um reproduce the shapes of the engine to 5e-5 at any height.
The other parameters are linear about the last solution, with derivatives that are functions of field and height.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.units import ARCSEC, metres, positive_angle, pure_numbers, radians
from ...measure.shapes import measure_shapes
from ...models.camera.camera import Camera
from ...models.camera.cameras import load_camera
from ...models.camera.focal_plane import FocalPlane
from ...models.io.yaml.writer import telescope_to_yaml
from ...models.telescope import Telescope
from ...models.zernike_polynomials import noll_to_nm
from ...raytrace.rays import field_direction
from ...wavefront.aberration import LINEAR_FRACTION, ResidualWavefront
from ...wavefront.atmosphere.atmosphere import Atmosphere
from ...wavefront.atmosphere.exposure_fields import amplitudes_by_light
from ...wavefront.atmosphere.moment_covariance import ExposedAir, MomentResponse
from ...wavefront.chief_rays import fields_at, image_jacobians
from ...wavefront.psf.clear_pupil import has_only_annuli, lit_fractions
from ...wavefront.psf.engine import center_focal_length
from ...wavefront.psf.light import Light
from ...wavefront.psf.long_exposure import LongExposureEngine
from ...wavefront.psf.moment_response import moment_response
from ...wavefront.psf.psf import make_psfs, psf_inputs
from ...wavefront.psf.pupil_means import PupilMeans
from ...wavefront.psf.stamps import Stamps
from .covariance import Places
from .height_series import HeightSeries, level_plane
from .stars import SAME_ROTATOR

#: Noll terms of the residual wavefront of an exposure, each constant and linear over the field.
NOLL = tuple(range(4, 12))
#: Number of parameters of an exposure: Noll terms on the axis and along x and y, and the Fried parameter.
N_EXPOSURE = 3 * len(NOLL) + 1
# Standard deviation of the logarithm of the Fried parameter.
_SEEING = 0.3
#: Height range of the polynomial about its centre [m].
LARGEST_HEIGHT = 25e-6
_NODES = 5
# Step of the differences of the wavefront [m].
_WAVEFRONT_STEP = 0.05e-6
# ... and of the logarithm of the Fried parameter.
_SEEING_STEP = 0.05
# Rays of a star that tell the lit part of its pupil to three thousandths (100: to a hundredth).
_LIT_RAYS = 400
# Stars at which derivatives are computed.
_SAMPLES = 300
# ... fewer where they are costly.
_SAMPLES_LATTICE = 120
# Degree of their dependence on the field.
_FIELD_DEGREE = 6
# Heights about the centre [m] between which these derivatives are linear.
_LEVEL = 8e-6
_BATCH = 2048
# Points of a pupil with vanes or plates: e is good to 2e-4, a tenth of what turbulence adds, in a third of the time.
_LATTICE_POINTS = 6000
# For changes fewer do: the same points are lit before and after.
_LATTICE_POINTS_CHANGES = 3000


@dataclass(frozen=True, eq=False)
class Instrument:
    """Parameters of the long-exposure PSF of a star at a position and height.

    Attributes
    ----------
    telescope : Telescope
        The telescope.
    light : Light
        Wavelengths, their weights, and their shifts by the air.
    atmosphere : Atmosphere
        Fried parameter and outer scale.
    stamps : Stamps
        Pixels of the stamps, charge diffusion, jitter and silicon.
    weight_fwhm : float
        Weight of the moments [rad].
    """

    telescope: Telescope
    light: Light
    atmosphere: Atmosphere
    stamps: Stamps
    weight_fwhm: float

    @classmethod
    @check_arguments
    def of(
        cls,
        telescope: Telescope,
        wavelengths: ArrayLike | Light | None = None,
        atmosphere: Atmosphere | None = None,
        *,
        camera: str | Camera | None = None,
        stamps: Stamps | None = None,
        weight_fwhm: ArrayLike = 0.7 * ARCSEC,
    ) -> Instrument:
        """Return an instrument of numbers in SI or quantities.

        Parameters
        ----------
        telescope : Telescope
            The telescope.
        wavelengths : array_like or Quantity, shape [n_wave], or Light, optional
            Wavelengths [m], or :class:`~pachon.Light` of one spectrum, which has weights and the shifts by the air too;
            by default five over the telescope's band.
        atmosphere : Atmosphere, optional
            Fried parameter and outer scale; by default those of the telescope's site, or of Cerro Pachon.
        camera : str or Camera, optional
            Camera of the default stamps; by default the telescope's.
        stamps : Stamps, optional
            Pixels, charge diffusion, jitter and silicon; by default those of :meth:`pachon.Stamps.of_camera`.
        weight_fwhm : float or Quantity, optional
            Weight of the moments [rad].

        Raises
        ------
        DomainError
            If an array has the wrong shape, or stamps have places of stars.
        """
        if wavelengths is None:
            low, high = telescope.band or telescope.wavelength_range
            wavelengths = np.linspace(low, high, 5)
        if stamps is None:
            camera_or_name = telescope.camera if camera is None else camera
            stamps = Stamps() if camera_or_name is None else Stamps.of_camera(load_camera(camera_or_name))
        if stamps.offsets is not None or stamps.recenter is not None:
            raise DomainError("stamps: expected no offsets and no recenter, images of a model are centred")
        return cls(
            telescope,
            _one_spectrum(telescope, wavelengths if isinstance(wavelengths, Light) else Light(wavelengths)),
            Atmosphere.from_site(telescope.site or "cerro_pachon", seed=0) if atmosphere is None else atmosphere,
            stamps,
            positive_angle(weight_fwhm, "weight_fwhm"),
        )

    def with_rotator(self, angle: float | None) -> Instrument:
        """Return the instrument with its camera rotated by an angle [rad], if it is known and the camera is not yet."""
        if not angle or abs(self.telescope.rotator) > SAME_ROTATOR:
            return self
        return replace(self, telescope=self.telescope.with_rotator(angle))

    @property
    def wavelengths(self) -> np.ndarray:
        """Wavelengths [m], shape [n_wave]."""
        return np.asarray(self.light.wavelengths)

    @property
    def pixel_scale(self) -> float:
        """Angle of a pixel of the stamps [rad]."""
        return self.stamps.pixel_size / center_focal_length(self.telescope, self.wavelengths)

    @property
    def key(self) -> str:
        """SHA-256 of all parameters."""
        air, stamps, light = self.atmosphere, self.stamps, self.light
        numbers = (air.r0, air.outer_scale, stamps.pixel_size, stamps.diffusion, stamps.jitter, self.weight_fwhm)
        arrays = [np.zeros(0) if a is None else np.asarray(a) for a in (light.wavelengths, light.dispersion)]
        text = telescope_to_yaml(self.telescope) + repr((*numbers, stamps.size)) + repr([a.tolist() for a in arrays])
        text += "" if stamps.silicon is None else repr(stamps.silicon)
        text += "" if light.weights is None else repr(np.asarray(light.weights).tolist())
        return hashlib.sha256(text.encode()).hexdigest()

    def fields(self, xy: np.ndarray, threads: int | None = None) -> np.ndarray:
        """Return the field angles of positions on the detector [rad], shape [n, 2]."""
        return fields_at(self.telescope, xy, self.wavelengths[len(self.wavelengths) // 2], threads=threads)

    def at_amplitudes(self, places: Places, threads: int | None = None) -> Places:
        """Return places with the amplitudes of turbulence there: it is larger where less of the pupil is lit."""
        directions = field_direction(*self.fields(places.xy, threads).T)
        wavelength = float(self.wavelengths[len(self.wavelengths) // 2])
        lit = lit_fractions(self.telescope, directions, wavelength, threads, rays=_LIT_RAYS)
        return replace(places, amplitude=np.interp(lit, *self._amplitudes_by_light))

    @cached_property
    def _amplitudes_by_light(self) -> tuple[np.ndarray, np.ndarray]:
        """Lit fractions of the pupil, rising, and amplitudes there, the mean of those of three moments."""
        telescope, stated = self.telescope, self.atmosphere
        # In winds of any exposure: they hardly matter, and are not known.
        air = Atmosphere.from_site("cerro_pachon", seed=0, r0=stated.r0, outer_scale=stated.outer_scale)
        exposed = ExposedAir.of(air, telescope.pupil_diameter, telescope.pupil_obscuration)
        response, _ = self.moment_response(None)
        lit, amplitudes = amplitudes_by_light(exposed, response, telescope.field_radius)
        return lit, amplitudes.mean(axis=1)

    def images(
        self,
        fields: np.ndarray,
        plane: FocalPlane,
        aberration: ResidualWavefront | None,
        seeing: float = 0.0,
        threads: int | None = None,
        points: int = _LATTICE_POINTS,
    ) -> tuple[np.ndarray, float]:
        """Return the PSFs of stars at field angles, of unit sum [n, ny, nx], and the angle of a pixel [rad].

        ``points`` are those of a pupil with vanes or plates.
        """
        atmosphere = self.atmosphere
        if seeing:
            atmosphere = replace(atmosphere, r0=atmosphere.r0 * float(np.exp(seeing)))
        psfs = make_psfs(
            self.telescope,
            fields,
            self.light,
            focal_plane=plane,
            atmosphere=atmosphere,
            aberration=aberration,
            stamps=self.stamps,
            engine=LongExposureEngine(None if has_only_annuli(self.telescope) else points),
            threads=threads,
        )
        return psfs.image, psfs.pixel_scale

    def moment_response(
        self, aberration: ResidualWavefront | None, seeing: float = 0.0, threads: int | None = None
    ) -> tuple[MomentResponse, np.ndarray]:
        """Return the response of the shapes to the moments of turbulence, on the mean over the field.

        The second result are the positions on the detector by field slopes in the middle of the field [m], [2, 2].
        """
        atmosphere = replace(self.atmosphere, r0=self.atmosphere.r0 * float(np.exp(seeing)))
        inputs, _ = psf_inputs(
            self.telescope, np.zeros((1, 2)), self.light, None, atmosphere, aberration, self.stamps, threads
        )
        focal_length = center_focal_length(self.telescope, self.wavelengths, threads)
        response = moment_response(inputs, PupilMeans.of(inputs), focal_length, self.weight_fwhm)
        wavelength = self.wavelengths[len(self.wavelengths) // 2]
        jacobian = image_jacobians(self.telescope, np.array([[0.0, 0.0, -1.0]]), wavelength, threads)[0]
        return response, jacobian

    def shapes(
        self,
        fields: np.ndarray,
        plane: FocalPlane,
        aberration: ResidualWavefront | None,
        seeing: float = 0.0,
        threads: int | None = None,
        progress: Callable[[int], None] | None = None,
        points: int = _LATTICE_POINTS,
    ) -> np.ndarray:
        """Return e1, e2 and the logarithm of the size [rad] of PSFs at field angles, shape [n, 3]."""
        values = np.empty((len(fields), 3))
        for first in range(0, len(fields), _BATCH):
            batch = slice(first, first + _BATCH)
            images, scale = self.images(fields[batch], plane, aberration, seeing, threads, points)
            shapes = measure_shapes(images, scale, self.weight_fwhm)
            values[batch] = np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)
            if progress is not None:
                progress(len(images))
        return values


def _one_spectrum(telescope: Telescope, light: Light) -> Light:
    """Return light as arrays in SI; DomainError where it is not one spectrum, or not of the telescope."""
    waves = np.atleast_1d(metres(light.wavelengths, "wavelengths"))
    if waves.ndim != 1 or not len(waves):
        raise DomainError(f"wavelengths of shape {list(waves.shape)}: expected [n_wave]")
    telescope.check_wavelength(waves)
    weights = None if light.weights is None else pure_numbers(light.weights, "weights")
    if weights is not None and weights.shape != waves.shape:
        raise DomainError(f"weights of shape {weights.shape}: expected one spectrum of {len(waves)} wavelengths")
    return Light(waves, weights, None if light.dispersion is None else radians(light.dispersion, "dispersion"))


def height_response(
    instrument: Instrument,
    fields: np.ndarray,
    plane: FocalPlane,
    aberration: ResidualWavefront | None,
    seeing: float = 0.0,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    center: float = 0.0,
) -> HeightSeries:
    """Return the shapes of stars as series of the height of the CCD; `plane` gives the camera alone."""

    def shapes(level: FocalPlane) -> np.ndarray:
        return instrument.shapes(fields, level, aberration, seeing, threads, progress)

    series = HeightSeries.of(shapes, plane, LARGEST_HEIGHT, _NODES, center=center)
    lost = int((~np.isfinite(series.coefficients).all(axis=(0, 2))).sum())
    if lost:
        raise DomainError(
            f"{instrument.telescope.name}: the PSF at {lost} of {len(fields)} stars has no shape within"
            f" {1e6 * LARGEST_HEIGHT:g} um of the heights: expected the telescope that they were taken with"
        )
    return series


@dataclass(frozen=True, eq=False)
class ExposureResponse:
    """Derivatives of the shapes with respect to the parameters of an exposure.

    Parameters: coefficients [m] of the Noll terms on the axis, their slopes along x and y of the field [m per field
    radius], and the logarithm of the Fried parameter.
    """

    polynomial: np.ndarray  #: [n_term + 1, level, field term, 3]
    radius: float  #: of the field [rad]
    center: float  #: height about which they are linear in the height [m]

    @classmethod
    def of(
        cls,
        instrument: Instrument,
        fields: np.ndarray,
        plane: FocalPlane,
        aberration: ResidualWavefront | None,
        seeing: float,
        threads: int | None = None,
        progress: Callable[[int], None] | None = None,
        *,
        center: float = 0.0,
    ) -> ExposureResponse:
        """Compute central differences at some of the stars, and fit them over the field."""
        radius = float(np.hypot(*fields.T).max()) or instrument.telescope.field_radius
        sample_limit = _SAMPLES if has_only_annuli(instrument.telescope) else _SAMPLES_LATTICE
        sampled_fields = fields[np.unique(np.linspace(0, len(fields) - 1, min(sample_limit, len(fields))).astype(int))]
        degree = min(_FIELD_DEGREE, max(0, int((np.sqrt(8 * len(sampled_fields) / 3 + 1) - 3) / 2)))
        terms = field_terms(sampled_fields / radius, degree)
        responses = []
        for parameter in range(len(NOLL) + 1):
            levels = []
            for level in (center - _LEVEL, center + _LEVEL):
                flat, ends = level_plane(plane, level), []
                for sign in (1.0, -1.0):
                    changed, air = aberration, seeing
                    if parameter < len(NOLL):
                        step = np.zeros((3, len(NOLL)))
                        step[0, parameter] = sign * _WAVEFRONT_STEP
                        changed = wavefront(instrument.telescope, step, radius, aberration)
                    else:
                        air = seeing + sign * _SEEING_STEP
                    ends.append(
                        instrument.shapes(
                            sampled_fields, flat, changed, air, threads, progress, _LATTICE_POINTS_CHANGES
                        )
                    )
                width = 2.0 * (_WAVEFRONT_STEP if parameter < len(NOLL) else _SEEING_STEP)
                change = (ends[0] - ends[1]) / width
                levels.append(np.linalg.lstsq(terms, change, rcond=None)[0])
            responses.append(levels)
        polynomial: np.ndarray = np.array(responses)
        if not np.isfinite(polynomial).all():
            raise DomainError(
                f"{instrument.telescope.name}: the PSF has no shape where alignment or seeing change a little: expected"
                " stamps and a weight that hold it, and the telescope that the stars were taken with"
            )
        return cls(polynomial, radius, center)

    def columns(self, fields: np.ndarray, heights: np.ndarray) -> np.ndarray:
        """Return the derivatives at field angles [rad] and heights [m], shape [n, n_parameter, 3]."""
        first, second = self._at_levels(fields)
        upper = 0.5 + (heights - self.center) / (2.0 * _LEVEL)
        return self._expanded_over_field(fields, first + upper[:, None, None] * (second - first))

    def height_slopes(self, fields: np.ndarray) -> np.ndarray:
        """Return the derivatives of :meth:`columns` with respect to the height [1/m], shape [n, n_parameter, 3]."""
        first, second = self._at_levels(fields)
        return self._expanded_over_field(fields, (second - first) / (2.0 * _LEVEL))

    def _at_levels(self, fields: np.ndarray) -> np.ndarray:
        """Return the derivatives at the two heights, parameters on the axis alone: [level, n, n_term + 1, 3]."""
        degree = round((np.sqrt(8 * self.polynomial.shape[2] + 1) - 3) / 2)
        terms = field_terms(fields / self.radius, degree)
        return np.einsum("nt,pltf->lnpf", terms, self.polynomial)

    def _expanded_over_field(self, fields: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Add the parameters along x and y of the field, whose derivatives are those on the axis times x and y."""
        along, waves = fields / self.radius, own[:, :-1]
        return np.concatenate(
            [waves, along[:, 0, None, None] * waves, along[:, 1, None, None] * waves, own[:, -1:]], axis=1
        )


def exposure_sigma(alignment_rms: float) -> np.ndarray:
    """Return the prior standard deviations of the parameters of an exposure, those of :class:`.ResidualWavefront`."""
    degree = np.array([float(noll_to_nm(j)[0]) for j in NOLL])
    variance = degree ** (-11.0 / 3.0)
    sigma = alignment_rms * np.sqrt(variance / variance.sum())
    along = np.sqrt(2.0 * LINEAR_FRACTION) * sigma
    return np.concatenate([np.sqrt(1.0 - LINEAR_FRACTION) * sigma, along, along, [_SEEING]])


def wavefront(
    telescope: Telescope, coefficients: np.ndarray, radius: float, base: ResidualWavefront | None = None
) -> ResidualWavefront:
    """Return a residual wavefront of coefficients [3, n_term] (on the axis, along x, along y), added to another."""
    values = np.zeros((3, NOLL[-1] - 3))
    values[:, np.array(NOLL) - 4] = coefficients
    constant, gradient = values[0], values[1:].T / radius
    if base is not None:
        constant, gradient = constant + base.coefficients, gradient + base.field_gradient
    return ResidualWavefront(constant, telescope.pupil_diameter, telescope.pupil_obscuration, gradient)


def field_terms(slopes: np.ndarray, degree: int) -> np.ndarray:
    """Return products of Legendre polynomials over the field up to a total degree, shape [n, n_term]."""
    x, y = (np.polynomial.legendre.legvander(slopes[:, axis], degree) for axis in range(2))
    return np.stack([x[:, i] * y[:, t - i] for t in range(degree + 1) for i in range(t + 1)], axis=1)
