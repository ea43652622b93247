"""The pointing of a telescope: slopes of light, tangent plane and celestial coordinates.

The tangent plane is the gnomonic one about the pointing, xi towards east and eta towards north. The source of light of
slopes (tx, ty) lies the opposite way, at X = -tx, Y = -ty along the axes of the telescope. With the position angle rho
of the telescope's +y, from north through east,

    xi = X cos(rho) + Y sin(rho),    eta = -X sin(rho) + Y cos(rho).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError, shown
from ..core.units import angle, broadcast_together, radians


@dataclass(frozen=True)
class Pointing:
    """Direction of the optical axis, and orientation of the telescope on the sky.

    Attributes
    ----------
    ra, dec : float or Quantity
        Right ascension and declination of the optical axis, ICRS [rad].
    position_angle : float or Quantity
        Angle of the telescope's +y from north through east [rad].

    Raises
    ------
    DomainError
        If an angle is not finite, or the declination beyond a pole.
    """

    ra: float
    dec: float
    position_angle: float = 0.0

    def __post_init__(self) -> None:
        for name in ("ra", "dec", "position_angle"):
            object.__setattr__(self, name, angle(getattr(self, name), name))
        angles = (self.ra, self.dec, self.position_angle)
        if not np.isfinite(angles).all() or abs(self.dec) > 0.5 * np.pi:
            raise DomainError(
                f"pointing: ra, dec = {angles[:2]}, position_angle = {self.position_angle}: "
                "expected finite angles [rad], declinations from -90 to 90 deg"
            )

    @classmethod
    def of(cls, pointing: Any, position_angle: Any = 0.0) -> Pointing:
        """Return a pointing as it is, or that of a SkyCoord, or of right ascension and declination [rad]."""
        if isinstance(pointing, Pointing):
            if np.any(angle(position_angle, "position_angle")):
                raise DomainError("position_angle: given beside a Pointing, which has its own")
            return pointing
        # A SkyCoord: astropy.coordinates takes long to import, and who has one has done so.
        if hasattr(pointing, "icrs"):
            if not pointing.isscalar:
                raise DomainError(f"pointing has shape {pointing.shape}: expected one position")
            pointing = (pointing.icrs.ra, pointing.icrs.dec)
        center = radians(pointing, "pointing")
        if center.shape != (2,):
            raise DomainError(f"pointing = {shown(pointing)}: expected right ascension and declination, finite angles")
        return cls(float(center[0]), float(center[1]), position_angle)

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors along the telescope's +x, +y and +z (towards the sky) in equatorial coordinates, as rows."""
        east, north, outwards = _sky_axes(self.ra, self.dec)
        sine, cosine = np.sin(self.position_angle), np.cos(self.position_angle)
        return np.stack([cosine * east - sine * north, sine * east + cosine * north, outwards])

    @check_arguments
    def to_sky(self, slopes: ArrayLike) -> np.ndarray:
        """Return (xi, eta) [rad] of the sources of light of gnomonic slopes (tx, ty), both shape [n, 2]; NaN of NaN."""
        x, y = -_angle_pairs(slopes, "slopes").T
        cosine, sine = np.cos(self.position_angle), np.sin(self.position_angle)
        return np.stack([x * cosine + y * sine, y * cosine - x * sine], axis=1)

    @check_arguments
    def to_slopes(self, sky: ArrayLike) -> np.ndarray:
        """Return the gnomonic slopes (tx, ty) of the light of sources at (xi, eta) [rad], both [n, 2]; NaN of NaN."""
        xi, eta = _angle_pairs(sky, "sky").T
        cosine, sine = np.cos(self.position_angle), np.sin(self.position_angle)
        return np.stack([eta * sine - xi * cosine, -xi * sine - eta * cosine], axis=1)

    @check_arguments
    def to_celestial(self, sky: ArrayLike) -> np.ndarray:
        """Return right ascension, from 0 to 2 pi, and declination [rad] of (xi, eta) [rad], both [n, 2]; NaN of NaN."""
        xi, eta = _angle_pairs(sky, "sky").T
        along = np.cos(self.dec) - eta * np.sin(self.dec)
        alpha = self.ra + np.arctan2(xi, along)
        delta = np.arctan2(np.sin(self.dec) + eta * np.cos(self.dec), np.hypot(xi, along))
        return np.stack([alpha % (2.0 * np.pi), delta], axis=1)

    @check_arguments
    def from_celestial(self, ra: ArrayLike, dec: ArrayLike) -> np.ndarray:
        """Return (xi, eta) [rad], shape [n, 2], of right ascensions and declinations [rad] (gnomonic projection).

        The formula is that of Calabretta & Greisen 2002 (A&A 395, 1077, sec. 5.1.3). Positions 90 degrees or more from
        the pointing are NaN.
        """
        alpha, delta = broadcast_together({"ra": radians(ra, "ra"), "dec": radians(dec, "dec")})
        turn = alpha - self.ra
        sine, cosine = np.sin(self.dec), np.cos(self.dec)
        depth = sine * np.sin(delta) + cosine * np.cos(delta) * np.cos(turn)
        depth = np.where(depth > 0.0, depth, np.nan)
        east = np.cos(delta) * np.sin(turn)
        north = cosine * np.sin(delta) - sine * np.cos(delta) * np.cos(turn)
        return np.stack([east / depth, north / depth], axis=-1)

    def jacobians(self, ra: np.ndarray, dec: np.ndarray) -> np.ndarray:
        """Return d(xi, eta)/d(east, north) at right ascensions and declinations [n] in rad, shape [n, 2, 2].

        Away from the equator north is not along eta: meridians meet at the poles.
        """
        vectors = _sky_axes(ra, dec) @ _sky_axes(self.ra, self.dec).T
        plane, ahead = vectors[:, 2, :2, None] / vectors[:, 2, 2, None, None], vectors[:, 2, 2, None, None]
        return np.asarray((vectors[:, :2, :2].transpose(0, 2, 1) - plane * vectors[:, None, :2, 2]) / ahead)


def _sky_axes(ra: ArrayLike, dec: ArrayLike) -> np.ndarray:
    """Return unit vectors towards east, north and outwards in equatorial coordinates, as rows, shape [..., 3, 3]."""
    (sa, ca), (sd, cd) = ((np.sin(angles), np.cos(angles)) for angles in (ra, dec))
    rows = (-sa, ca, 0.0 * sa), (-sd * ca, -sd * sa, cd), (cd * ca, cd * sa, sd)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _angle_pairs(values: ArrayLike, name: str) -> np.ndarray:
    """Return angles as [n, 2]; one pair may be given as [2]."""
    pairs = np.atleast_2d(radians(values, name))
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise DomainError(f"{name} has shape {np.shape(values)}: expected [n, 2]")
    return pairs


def tangent_plane(ra: Any, dec: Any, pointing: Any) -> tuple[np.ndarray, np.ndarray]:
    """Project positions on the plane that touches the sky at the pointing.

    Parameters
    ----------
    ra, dec : ndarray or Quantity
        Right ascensions and declinations [rad].
    pointing : (float, float) or Quantity, optional
        Those of the pointing [rad].

    Returns
    -------
    xi, eta : ndarray
        Gnomonic coordinates towards east and north [rad] (Calabretta & Greisen 2002, sec. 5.1.3).

    Raises
    ------
    DomainError
        If there is no pointing, a declination lies beyond a pole, or a position is 90 degrees or more from it.
    """
    if pointing is None:
        raise DomainError("ra, dec: expected pointing=(right ascension, declination)", key="pointing")
    declination = np.rad2deg(np.atleast_1d(radians(dec, "dec")))
    beyond = np.abs(declination) > 90.0 + 1e-9
    if beyond.any():
        at = int(np.argmax(beyond))
        raise DomainError(f"dec [{at}] = {declination[at]:g} deg: expected -90 to 90", key="dec")
    sky = Pointing.of(pointing).from_celestial(ra, dec)
    if not np.isfinite(sky).all():
        raise DomainError("ra, dec: expected positions within 90 deg of the pointing")
    return sky[..., 0], sky[..., 1]
