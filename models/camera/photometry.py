"""Zero points, sky and noise of cameras: the LSST's, those of camera files, and estimates for telescopes without any.

Zero points, dark sky, extinction and instrument noise of the LSST are those of SMTN-002 ("Calculating LSST limiting
magnitudes and SNR", throughputs v1.9, airmass 1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...core.errors import unknown_name
from ...core.units import ARCSEC

PIXEL_SCALE = 0.2 * ARCSEC
"""Angle of one LSST pixel [rad]."""
READ_NOISE = 8.8
"""Read noise of one exposure [e-/pixel]: the upper limit that SMTN-002 takes from the camera requirements (LSE-59)."""
DARK_CURRENT = 0.2
"""Dark current [e-/s/pixel]: the upper limit that SMTN-002 takes from the camera requirements (LSE-59)."""
FULL_WELL = 1.0e5
"""Largest signal of an unsaturated pixel [e-]: just under the lower of the two measured turn-offs of the photon
transfer curve, 103 000 (e2v) and 129 000 (ITL) (SITCOMTN-148, Table 6)."""
THROUGHPUT = 0.5
"""Throughput of air, telescope, filter and CCDs where none is known; the LSST's is 0.55 in the r band."""
#: Difference of collecting areas from which a telescope is another one than the camera's own.
_OTHER_TELESCOPE = 0.1
#: Photons a second, square metre and unit of ln(wavelength) at AB magnitude 0: 3631 Jy over Planck's constant.
_AB_PHOTONS = 3631e-26 / 6.62607015e-34


BandName = Literal["u", "g", "r", "i", "z", "y"]


@dataclass(frozen=True)
class Band:
    """One filter of a camera at the zenith under a dark sky, and the noise of its pixels; by default the LSST's."""

    name: BandName  #: ``u`` to ``y``
    zero_point: float  #: AB magnitude of one electron a second, atmosphere at airmass 1 included
    dark_sky: float  #: brightness [AB mag/arcsec^2]
    extinction: float  #: loss in the atmosphere, ``kAtm`` [mag/airmass]
    effective_wavelength: float  #: [m]
    wavelength_range: tuple[float, float]  #: [m] at half the maximum throughput (LSST throughputs v1.9, airmass 1.2)
    pixel_scale: float = PIXEL_SCALE  #: angle of a pixel [rad]
    read_noise: float = READ_NOISE  #: rms of one exposure [electron/pixel]
    dark_current: float = DARK_CURRENT  #: [electron/s/pixel]
    full_well: float = FULL_WELL  #: largest signal of an unsaturated pixel [electron]
    gain: float = 1.0  #: electrons of one ADU
    source: str = "SMTN-002"  #: where the numbers are from

    def at_airmass(self, airmass: float) -> Band:
        """Return the band away from the zenith: stars are dimmed by the extinction, the sky at the telescope is not."""
        dimmed = self.zero_point - self.extinction * (airmass - 1.0)
        return replace(self, zero_point=dimmed, extinction=self.extinction * airmass)


BANDS: dict[str, Band] = {
    band.name: band
    for band in (
        Band("u", 26.52, 23.05, 0.47, 366e-9, (349e-9, 396e-9)),
        Band("g", 28.51, 22.25, 0.21, 482e-9, (403e-9, 551e-9)),
        Band("r", 28.36, 21.20, 0.13, 622e-9, (550e-9, 690e-9)),
        Band("i", 28.17, 20.46, 0.10, 754e-9, (692e-9, 821e-9)),
        Band("z", 27.78, 19.61, 0.07, 869e-9, (818e-9, 922e-9)),
        Band("y", 26.82, 18.60, 0.17, 971e-9, (924e-9, 1015e-9)),
    )
}


def nearest_band(wavelengths: tuple[float, float]) -> str:
    """Return the name of the LSST's band whose middle is nearest to that of a range of wavelengths [m]."""
    middle = 0.5 * sum(wavelengths)
    return min(BANDS, key=lambda name: abs(BANDS[name].effective_wavelength - middle))


def estimated_band(name: str, area: float, wavelengths: tuple[float, float], throughput: float = THROUGHPUT) -> Band:
    """Estimate the zero point of a telescope without a measured one.

    The electrons are those of a constant throughput over the wavelengths. Sky, extinction and noise are the LSST's.

    Parameters
    ----------
    name : str
        Band, ``u`` to ``y``.
    area : float
        Collecting area [m^2].
    wavelengths : (float, float)
        Ends of the band [m].
    throughput : float
        Electrons of a photon above the atmosphere.
    """
    low, high = wavelengths
    rate = _AB_PHOTONS * throughput * area * np.log(high / low)
    light = f"{area:.3g} m2, throughput {throughput:g}, {low * 1e9:.0f} to {high * 1e9:.0f} nm"
    zero_point = round(2.5 * float(np.log10(rate)), 3)
    return replace(BANDS[name], zero_point=zero_point, source=f"estimated: {light}; sky and extinction of SMTN-002")


@dataclass(frozen=True)
class CameraPhotometry:
    """Photometry of a camera: measured bands, or none, and the noise of its pixels; by default the LSST's."""

    bands: tuple[Band, ...] = ()
    area: float = 0.0  #: collecting area of the telescope that the bands were measured with [m^2]
    throughput: float = THROUGHPUT  #: for zero points that are estimated
    read_noise: float = READ_NOISE
    dark_current: float = DARK_CURRENT
    full_well: float = FULL_WELL
    gain: float = 1.0

    def edges(self, name: str) -> tuple[float, float]:
        """Return the ends of a band [m], those of the LSST's where it is not measured."""
        return self._measured(name).wavelength_range

    def dark_sky(self, name: str) -> float:
        """Return the brightness of a dark sky in a band [AB mag/arcsec^2], the LSST's where it is not measured."""
        return self._measured(name).dark_sky

    def _measured(self, name: str) -> Band:
        """Return a measured band, or that of the LSST."""
        return next((band for band in self.bands if band.name == name), BANDS[name])

    def band(self, camera: str, name: str, area: float, wavelengths: tuple[float, float]) -> Band:
        """Return a band, estimated as of :func:`estimated_band` where none is measured.

        Zero points are scaled to the area of another telescope than the camera's own, if it differs by more than 10 %.
        UnknownNameError if the camera has measured bands, and not this one.
        """
        measured_bands: dict[str, Band] = {band.name: band for band in self.bands}
        if measured_bands and name not in measured_bands:
            raise unknown_name(f"band of {camera}", name, measured_bands)
        camera_band = measured_bands.get(name) or estimated_band(name, area, wavelengths, self.throughput)
        if measured_bands and abs(area / self.area - 1.0) > _OTHER_TELESCOPE:
            zero_point = round(camera_band.zero_point + 2.5 * float(np.log10(area / self.area)), 3)
            source = f"{camera_band.source}; scaled from {self.area:.3g} to {area:.3g} m2"
            camera_band = replace(camera_band, zero_point=zero_point, source=source)
        return replace(
            camera_band,
            read_noise=self.read_noise,
            dark_current=self.dark_current,
            full_well=self.full_well,
            gain=self.gain,
        )


#: Photometry of the LSST, and of ComCam in its place; SMTN-002 has the effective diameter.
LSST = CameraPhotometry(tuple(BANDS.values()), 0.25 * np.pi * 6.423**2)
