"""Quality of a telescope over its field: wavefront, width and ellipticity, against the telescope as designed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...core.units import ARCSEC
from ...measure.adaptive_moments import adaptive_moments
from ...measure.shapes import fwhm, measure_shapes
from ...models.telescope import Telescope
from ...wavefront.atmosphere.atmosphere import Atmosphere
from ...wavefront.opd import wavefront_opds
from ...wavefront.psf.psf import make_psfs
from ...wavefront.psf.stamps import Stamps
from ...wavefront.pupil_sampling import gauss_annulus, spiral_annulus

#: Points of the field, at equal areas.
FIELDS = 30
#: Rings of the pupil, which with the spokes integrate squares of polynomials up to the 13th degree.
RINGS = 7
#: Spokes of the pupil.
SPOKES = 28
#: FWHM of the round weight of the paper's moments [rad].
_WEIGHT = 0.7 * ARCSEC


@dataclass(frozen=True)
class FieldMeans:
    """Means over the field of view."""

    wavefront: float  #: rms of the wavefront over pupil and field, without piston and tilt [m]
    added: float  #: rms of what it has beyond the telescope as designed [m]
    fwhm: float  #: mean FWHM under the mean of turbulence [arcsec]
    rms_g: float  #: rms of g of adaptive moments, both components together
    size: float  #: mean T of adaptive moments [arcsec^2]
    rms_e: float  #: rms of the weighted e, both components together


@dataclass(frozen=True, eq=False)
class FieldQuality:
    """The measure of telescopes that differ from a nominal one."""

    nominal: Telescope
    wavelengths: np.ndarray  #: [n_wave] m
    atmosphere: Atmosphere

    @cached_property
    def fields(self) -> np.ndarray:
        """Points of the field of view [rad], shape [n, 2]."""
        return spiral_annulus(self.nominal.field_radius, 0.0, FIELDS).points

    @property
    def _middle(self) -> float:
        return float(self.wavelengths[len(self.wavelengths) // 2])

    @cached_property
    def _designed(self) -> np.ndarray:
        return self._wavefronts(self.nominal, None)

    def _wavefronts(self, telescope: Telescope, threads: int | None) -> np.ndarray:
        """Return wavefronts without piston and tilt times roots of the weights [m], [n_field, n_pupil]; dark 0."""
        pupil = gauss_annulus(0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, RINGS, SPOKES)
        maps = wavefront_opds(telescope, self.fields, self._middle, tuple(pupil.points.T), threads=threads)
        out = np.zeros(maps.value.shape)
        for i, (value, lit) in enumerate(zip(maps.value, maps.lit, strict=True)):
            weight = pupil.weights[lit] / pupil.weights[lit].sum()
            plane = np.column_stack([np.ones(lit.sum()), pupil.points[lit]]) * np.sqrt(weight)[:, None]
            bare = value[lit] * np.sqrt(weight)
            out[i, lit] = bare - plane @ np.linalg.lstsq(plane, bare, rcond=None)[0]
        return out

    def means(self, telescope: Telescope, threads: int | None = None) -> FieldMeans:
        """Return the means over the field of a telescope."""
        wavefront = self._wavefronts(telescope, threads)
        stars = make_psfs(
            telescope,
            self.fields,
            self.wavelengths,
            atmosphere=self.atmosphere,
            engine="long_exposure",
            stamps=Stamps(41),
            threads=threads,
        )
        moments = adaptive_moments(stars.image, stars.pixel_scale, threads=threads)
        shapes = measure_shapes(stars.image, stars.pixel_scale, _WEIGHT)
        return FieldMeans(
            wavefront=_rms(wavefront),
            added=_rms(wavefront - self._designed),
            fwhm=float(np.mean(fwhm(stars.image, stars.pixel_scale))) / ARCSEC,
            rms_g=float(np.sqrt(np.mean(moments.g1**2 + moments.g2**2))),
            size=float(np.mean(moments.T)) / ARCSEC**2,
            rms_e=float(np.sqrt(np.mean(shapes.e1**2 + shapes.e2**2))),
        )


def _rms(wavefronts: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(wavefronts**2, axis=1))))
