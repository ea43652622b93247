"""Visits to one patch of sky: pointing, roll, rotator and epoch of each, and where the sky falls on the detector.

Positions on the sky are gnomonic: xi towards east and eta towards north of the common pointing, tangents of angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.random_streams import stream
from ...models.telescope import Telescope
from ...sky.pointing import Pointing
from ...sky.visit_list.visit_list import ListedVisit, VisitList
from ...wavefront.chief_rays import chief_rays, image_jacobians


@dataclass(frozen=True)
class Visit:
    """One visit.

    Attributes
    ----------
    number : int
        Number of the visit, from 0.
    epoch : int
        Epoch of turbulence, residual aberration and noise.
    roll : float
        Position angle of the telescope's +y, from north through east [rad].
    pointing : tuple of float
        xi, eta of the pointing.
    rotator_deg : float or None
        Angle of the camera against the telescope [deg], as `rotator_deg` of a run has it; that of the run if None.
    listed : ListedVisit or None
        Visit of a list, with its own air, time and sky; None of one of the run's.
    star_limits : (float, float) or None
        Magnitude limits of the stars, bright and faint, of a visit of a list: those of the run, which all visits share.
    """

    number: int
    epoch: int
    roll: float = 0.0
    pointing: tuple[float, float] = (0.0, 0.0)
    rotator_deg: float | None = None
    listed: ListedVisit | None = None
    star_limits: tuple[float, float] | None = None

    def __str__(self) -> str:
        rotator = "" if self.rotator_deg is None else f", rotator {self.rotator_deg:.0f} deg"
        return f"roll {np.rad2deg(self.roll):.0f} deg{rotator}"

    @property
    def label(self) -> str:
        """Name in messages, with the number that ``visits.ecsv`` has."""
        return f"visit {self.number}"

    @property
    def matrix(self) -> np.ndarray:
        """Rotation of vectors (east, north, towards the common pointing) into (X, Y, towards the visit's), [3, 3].

        X and Y are the axes of the telescope.
        """
        ahead = np.array([*self.pointing, 1.0])
        ahead /= np.linalg.norm(ahead)
        # The shortest rotation that carries the pointing to the axis turns no field about itself.
        x, y, z = ahead
        to_axis = np.array(
            [[1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], ahead]
        )
        c, s = np.cos(self.roll), np.sin(self.roll)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ to_axis

    def directions(self, sky: np.ndarray) -> np.ndarray:
        """Return the unit vectors along which light of sky positions [n, 2] enters the telescope, shape [n, 3]."""
        source = np.column_stack([sky, np.ones(len(sky))]) @ self.matrix.T
        return -source / np.linalg.norm(source, axis=1)[:, None]

    def on_detector(
        self, telescope: Telescope, sky: np.ndarray, wavelength: float, threads: int | None = None
    ) -> np.ndarray:
        """Return where the chief rays of sky positions [n, 2] meet the nominal detector [m], shape [n, 2].

        NaN where they do not.
        """
        end = chief_rays(telescope, self.directions(sky), wavelength, threads=threads)
        return telescope.surfaces[-1].to_local(end.position)[:, :2]

    def jacobians(
        self, telescope: Telescope, sky: np.ndarray, wavelength: float, threads: int | None = None
    ) -> np.ndarray:
        """Return d(position on the detector [m])/d(xi, eta), shape [n, 2, 2]."""
        source = np.column_stack([sky, np.ones(len(sky))]) @ self.matrix.T
        norm = np.linalg.norm(source, axis=1)[:, None, None]
        along = (source / norm[:, 0])[:, :, None]
        # The derivative of a unit vector is that of the vector across it.
        change = self.matrix[None, :, :2]
        cosines = -(change - along * (along.transpose(0, 2, 1) @ change)) / norm
        return image_jacobians(telescope, self.directions(sky), wavelength, threads) @ cosines[:, :2]


def listed_plan(visits: VisitList, center: Pointing) -> tuple[Visit, ...]:
    """Return the visits of a list about a common pointing, numbered from 0 in their order.

    DomainError if one lies 90 degrees or more from it.
    """
    plan = []
    common = replace(center, position_angle=0.0)
    sky = common.from_celestial(visits.ra, visits.dec)
    for number in range(len(visits)):
        listed = visits[number]
        if not np.isfinite(sky[number]).all():
            raise DomainError(f"{listed.label}: expected a pointing within 90 deg of the common one")
        xi, eta = sky[number].tolist()
        axes = Pointing(listed.ra, listed.dec, listed.roll).axes @ common.axes.T
        # Without a roll the matrix carries the pointing to the axis; what is left of the axes is the roll.
        turn = axes @ Visit(number, 0, 0.0, (xi, eta)).matrix.T
        roll = float(np.arctan2(turn[1, 0], turn[0, 0]))
        plan.append(Visit(number, listed.epoch, roll, (xi, eta), float(np.rad2deg(listed.rotator)), listed))
    return tuple(plan)


def plan_visits(
    count: int,
    seed: int,
    *,
    dither: float = 0.0,
    first_epoch: int = 0,
    rolls_deg: str | Sequence[float] = "random",
    rotators_deg: str | Sequence[float] | None = None,
    rotator_limit_deg: float = 90.0,
) -> tuple[Visit, ...]:
    """Return visits about a common pointing, by default with random rolls, the first without.

    Parameters
    ----------
    count : int
        Number of visits.
    seed : int
        Seed; a visit does not depend on the number of visits.
    dither : float
        Radius of the disc over which the pointings of all but the first visit are spread [rad].
    first_epoch : int
        Epoch of the first visit; those of the others follow.
    rolls_deg : "random" or sequence of float
        Rolls [deg]; drawn for all but the first visit, or one for each visit.
    rotators_deg : "random", sequence of float or None
        Angles of the camera against the telescope [deg]; drawn evenly for all but the first visit, which has that of
        the run, or one for each visit, or that of the run for all.
    rotator_limit_deg : float
        Largest angle of either sense that is drawn [deg].

    Raises
    ------
    DomainError
        If there is no visit, the radius is negative or beyond 5 degrees, or angles are given for fewer visits.
    """
    if count < 1:
        raise DomainError(f"visits = {count}: expected at least 1")
    if not 0.0 <= dither <= np.deg2rad(5.0):
        raise DomainError(f"dither = {np.rad2deg(dither):g} deg: expected 0 to 5")
    for name, angles_deg in (("roll_deg", rolls_deg), ("rotator_deg", rotators_deg)):
        if angles_deg is not None and not isinstance(angles_deg, str) and len(angles_deg) < count:
            raise DomainError(f"{name}: {len(angles_deg)} angles for {counted(count, 'visit')}, expected one for each")
    visits = []
    for number in range(count):
        rng = stream(seed, "visit", number)
        roll = rng.uniform(0.0, 2.0 * np.pi)
        radius, angle = dither * np.sqrt(rng.random()), rng.uniform(0.0, 2.0 * np.pi)
        pointing = (float(radius * np.cos(angle)), float(radius * np.sin(angle)))
        if not number:
            roll, pointing = 0.0, (0.0, 0.0)
        if not isinstance(rolls_deg, str):
            roll = np.deg2rad(rolls_deg[number])
        rotator: float | None = None
        if rotators_deg == "random" and number:
            limit = rotator_limit_deg
            rotator = float(stream(seed, "visit", number, "rotator").uniform(-limit, limit))
        elif rotators_deg is not None and not isinstance(rotators_deg, str):
            rotator = float(rotators_deg[number])
        visits.append(Visit(number, first_epoch + number, float(roll), pointing, rotator))
    return tuple(visits)
