"""Altitude, azimuth and position angle of the zenith of pointings, by astropy without the network."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from ...core.errors import unknown_name

# Distance from the pointing at which the direction of the horizon is taken [arcsec]: small against the sky's
# curvature, large against the rounding of degrees.
_STEP = 10.0


class Location(NamedTuple):
    """Place of a telescope on the Earth (WGS 84)."""

    longitude_deg: float  #: towards east [deg]
    latitude_deg: float  #: [deg]
    elevation: float  #: above the ellipsoid [m]


#: Telescopes at the bundled sites: Rubin (rubin_scheduler), the Blanco (astropy, "CTIO"), Subaru (astropy).
LOCATIONS = {
    "cerro_pachon": Location(-70.749417, -30.244639, 2663.0),
    "cerro_tololo": Location(-70.806525, -30.169661, 2207.0),
    "maunakea": Location(-155.476111, 19.825556, 4139.0),
}


class SkyAngles(NamedTuple):
    """Directions of pointings at the time of their exposures [rad], each shape [n]; without refraction."""

    altitude: np.ndarray
    azimuth: np.ndarray  #: from north towards east
    zenith_position_angle: np.ndarray  #: of the zenith, from north (ICRS) towards east, -pi to pi


def location_of(site: str) -> Location:
    """Return the place of a bundled site, or raise UnknownNameError."""
    if site not in LOCATIONS:
        raise unknown_name("site of a visit list", site, LOCATIONS)
    return LOCATIONS[site]


def sky_angles(ra: np.ndarray, dec: np.ndarray, mjd_tai: np.ndarray, location: Location) -> SkyAngles:
    """Return altitudes, azimuths and position angles of the zenith of ICRS positions [rad] at times [MJD, TAI].

    The position angle has precession, nutation and aberration in it. The Earth's rotation is that of the tables that
    come with astropy; beyond them, that of their last day.
    """
    from astropy import units as u
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord
    from astropy.coordinates.erfa_astrom import ErfaAstrom, erfa_astrom
    from astropy.time import Time
    from astropy.utils import iers

    place = EarthLocation.from_geodetic(
        location.longitude_deg * u.deg, location.latitude_deg * u.deg, location.elevation * u.m
    )
    with (
        warnings.catch_warnings(),
        iers.conf.set_temp("auto_download", False),
        iers.conf.set_temp("auto_max_age", None),
        iers.conf.set_temp("iers_degraded_accuracy", "ignore"),
    ):
        warnings.simplefilter("ignore")
        frame = AltAz(obstime=Time(mjd_tai, format="mjd", scale="tai"), location=place)
        pointing = SkyCoord(ra * u.rad, dec * u.rad)
        of_earth = ErfaAstrom.apco(frame)

        class EarthOfFrame(ErfaAstrom):
            """Where the Earth is takes most of the time of a long list, and is the same for both ways."""

            def apco(self, frame_or_coord: Any) -> Any:
                return of_earth

        with erfa_astrom.set(EarthOfFrame()):
            horizontal = pointing.transform_to(frame)
            # Downwards: upwards would leave the sphere where the pointing is at the zenith.
            below = SkyCoord(alt=horizontal.alt - _STEP * u.arcsec, az=horizontal.az, frame=frame).icrs
        towards_horizon = pointing.position_angle(below).rad
    zenith = (towards_horizon + 2.0 * np.pi) % (2.0 * np.pi) - np.pi
    return SkyAngles(horizontal.alt.rad, horizontal.az.rad, zenith)
