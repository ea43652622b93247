"""Visits of a list: where the telescope pointed, how it was turned, through what air, and for how long."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.point_plots import draw_points
from ...core.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Rubin's day begins at noon of UTC-12: half a day before midnight [d].
DAY_START = 0.5


def night_dates(mjd: np.ndarray) -> np.ndarray:
    """Return the dates of the nights of times [MJD, TAI], as NumPy has dates."""
    return np.asarray(np.datetime64("1858-11-17") + np.floor(mjd - DAY_START).astype("timedelta64[D]"))


@dataclass(frozen=True)
class ListedVisit:
    """One visit of a list; NaN where the list leaves a number open.

    Attributes
    ----------
    visit : int
        Number of the visit.
    band : str
        Band, u to y.
    ra, dec : float
        Pointing, ICRS [rad].
    roll : float
        Position angle of the telescope's +y, from north through east [rad].
    zenith_position_angle : float
        Position angle of the zenith [rad].
    rotator : float
        Angle of the camera, from +x towards +y of the telescope [rad].
    altitude, azimuth : float
        Direction of the pointing [rad].
    midpoint : float
        Middle of the exposure [MJD, TAI].
    exposure : float
        Time of all snaps together [s].
    snaps : int
        Exposures that the time is divided into.
    r0, outer_scale : float
        Fried parameter at 500 nm at the zenith and outer scale [m].
    wind_speed, wind_azimuth : float
        Wind on the ground [m/s], and the azimuth that it blows from [rad].
    sky : float
        Sky [AB mag/arcsec^2].
    epoch : int
        Epoch of turbulence, residual aberration and noise.
    weight : float
        Weight in stacks, an inverse variance.
    """

    visit: int
    band: str
    ra: float
    dec: float
    roll: float
    zenith_position_angle: float
    rotator: float
    altitude: float
    azimuth: float
    midpoint: float
    exposure: float
    snaps: int
    r0: float
    outer_scale: float
    wind_speed: float
    wind_azimuth: float
    sky: float
    epoch: int
    weight: float

    @property
    def label(self) -> str:
        """Name in messages."""
        return f"visit {self.visit}"

    @property
    def zenith_angle(self) -> float:
        """Angle of the pointing from the zenith [rad]."""
        return 0.5 * np.pi - self.altitude


@dataclass(frozen=True, eq=False)
class VisitList(Result):
    """Visits of a list, of :func:`read_visit_list`; NaN where the list leaves a number open.

    Attributes
    ----------
    visit : ndarray of int
        Number of the visit.
    band : ndarray of str
        Band, u to y.
    ra, dec : ndarray
        Pointing, ICRS [rad].
    roll : ndarray
        Position angle of the telescope's +y, from north through east [rad]: that of the zenith on an alt-azimuth mount.
    zenith_position_angle : ndarray
        Position angle of the zenith at mid-exposure, from north (ICRS) through east [rad].
    rotator : ndarray
        Angle of the camera, from +x towards +y of the telescope [rad]: rotTelPos.
    altitude, azimuth : ndarray
        Direction of the pointing, without refraction [rad].
    midpoint : ndarray
        Middle of the exposure, TAI [d].
    exposure : ndarray
        Time of all snaps together [s].
    snaps : ndarray of int
        Exposures that the time is divided into.
    r0 : ndarray
        Fried parameter at 500 nm at the zenith [m].
    outer_scale : ndarray
        Outer scale [m].
    wind_speed : ndarray
        Speed of the wind on the ground [m/s].
    wind_azimuth : ndarray
        Azimuth that the wind on the ground blows from, from north towards east [rad].
    sky : ndarray
        Sky [mag]: AB mag/arcsec^2.
    epoch : ndarray of int
        Epoch of turbulence, residual aberration and noise.
    weight : ndarray
        Weight in stacks, an inverse variance.
    source : str
        Name of the file.
    remarks : tuple of str
        What was assumed or does not fit, a line each.
    """

    _table = ("visit", "band", "ra", "dec", "roll", "zenith_position_angle", "rotator", "altitude", "azimuth",
              "midpoint", "exposure", "snaps", "r0", "outer_scale", "wind_speed", "wind_azimuth", "sky", "epoch",
              "weight")  # fmt: skip

    visit: np.ndarray
    band: np.ndarray
    ra: np.ndarray
    dec: np.ndarray
    roll: np.ndarray
    zenith_position_angle: np.ndarray
    rotator: np.ndarray
    altitude: np.ndarray
    azimuth: np.ndarray
    midpoint: np.ndarray
    exposure: np.ndarray
    snaps: np.ndarray
    r0: np.ndarray
    outer_scale: np.ndarray
    wind_speed: np.ndarray
    wind_azimuth: np.ndarray
    sky: np.ndarray
    epoch: np.ndarray
    weight: np.ndarray
    source: str = ""
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.visit)

    def __getitem__(self, index: int) -> ListedVisit:
        """Return one visit."""
        values = {field.name: getattr(self, field.name)[index].item() for field in fields(ListedVisit)}
        return ListedVisit(**values)

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw right ascensions and declinations, coloured by the Fried parameter."""
        ra, dec = np.rad2deg(self.ra), np.rad2deg(self.dec)
        return draw_points(ax, ra, dec, ("ra [deg]", "dec [deg]"), color=self.r0 * 100.0, color_label="r0 [cm]")

    def rows(self, mask: np.ndarray) -> VisitList:
        """Return the visits of a mask [n], in their order."""
        return replace(self, **{name: getattr(self, name)[mask] for name in self._table})

    def of_visit(self, number: int) -> ListedVisit:
        """Return the visit of a number, or raise DomainError."""
        matches = np.flatnonzero(self.visit == number)
        if not len(matches):
            visits = counted(len(self), "visit")
            raise DomainError(f"visit = {number}: not in the list of {visits}", file=self.source or None)
        return self[int(matches[0])]

    @property
    def day_obs(self) -> np.ndarray:
        """Night of each visit, as a number YYYYMMDD: the date of TAI less twelve hours."""
        return np.array([int(str(date).replace("-", "")) for date in night_dates(self.midpoint)], dtype=np.int64)

    @property
    def digest(self) -> str:
        """SHA-256 of all numbers of all visits."""
        content = hashlib.sha256()
        for name in self._table:
            values = getattr(self, name)
            content.update(name.encode())
            content.update("\n".join(values).encode() if values.dtype.kind == "U" else values.tobytes())
        return content.hexdigest()
