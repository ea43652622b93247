r"""Rims and spiders that stand elsewhere than the telescope's prescription has them.

Where the outline of an aperture moves by :math:`\delta q` in its own plane, its shadow on the pupil moves by
:math:`J^{-1} \delta q`, with J the derivative of the light's place on the surface by its place on the pupil. The
derivative of the image is a line of light along the shadow: a piece of length l and unit normal n towards the lit side
has :math:`-l\, n \cdot J^{-1} \delta q` of the pupil's area.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..models.aperture import Circle, enclosing_circle
from ..models.telescope import Telescope
from ..raytrace.rays import RayStatus, parallel_rays
from ..raytrace.trace import TraceResult, trace
from ..wavefront.pupil_polynomials import PupilPolynomials
from .pupil_cells import FEWEST, PupilCells, PupilSurvey, pupil_cells
from .rim_outlines import MOTIONS, RimMotion, Simple, is_vane, moved_aperture, outline, simple_regions, vane_width

#: Standard deviation of the shift and of the growth of a rim over its own size, and most of it over the diameter of the
#: beam: 5 pixels of a donut of 120.
_OF_RADIUS = 0.02
_OF_BEAM = 0.04
#: The same of the shift of a spider.
_SPIDER_SHIFT = 0.01
#: Standard deviation of the turn of a spider [rad]: two degrees.
_SPIDER_TURN = 0.035
#: Standard deviation of what a side of a vane is offset by, over its width: a fifth of the width in all.
_THICKNESS = 0.1
#: Most standard deviations that a rim is moved by at once.
_MOST = 3.0
#: Radii and centres that differ by less, over the radius, are of one body: both faces of a lens, a mirror's baffle.
_ALIKE = 5e-3
#: Points across the pupil for the places of the light on the surfaces.
_SURVEY = 32
#: Distance from the rays among them within which a rim may bound the light, in sides of their lattice.
_BETWEEN = 4.0
#: Side of their lattice over that of the cells.
_MARGIN = 1.04
#: Distance from a rim at which it is told whether light passes, in sides of a cell.
_BESIDE = 0.02
#: Steps by which places on the pupil are found.
_STEPS = 8
#: Step over the radius of the pupil after which they are found, to the square of it.
_CLOSE = 1e-4
#: Longest piece of a rim, in sides of a cell.
_LONGEST = 10.0
#: Fewest pieces of a rim that matter.
_FEWEST_PIECES = 3


@dataclass(frozen=True)
class RimBody:
    """Rims that move together.

    Attributes
    ----------
    members : tuple of (int, int)
        Number of the surface, and of the simple region of its aperture.
    spreads : tuple of float
        Standard deviations of the motions, in the order of :class:`~pachon.sensing.rim_outlines.RimMotion`; 0 for
        motions that do not matter.
    spider : bool
        Whether it is a spider.
    """

    members: tuple[tuple[int, int], ...]
    spreads: tuple[float, ...]
    spider: bool = False

    @property
    def free(self) -> np.ndarray:
        """Which motions are free, shape [4]."""
        return np.array(self.spreads) > 0.0

    @property
    def moved(self) -> bool:
        """Whether it may stand elsewhere, and does not only have another size."""
        return self.spreads[0] > 0.0


@dataclass(frozen=True, eq=False)
class FreeRims:
    """Rims that are free in a fit, and where they stand.

    Attributes
    ----------
    bodies : tuple of RimBody
        The rims.
    values : ndarray, shape [n_body, 4]
        Their motions from where the prescription has them.
    """

    bodies: tuple[RimBody, ...] = ()
    values: np.ndarray = field(default_factory=lambda: np.zeros((0, MOTIONS)))

    def __len__(self) -> int:
        """Return the number of free motions."""
        return int(self.free.sum())

    @property
    def free(self) -> np.ndarray:
        """Which motions are free, shape [n_body, 4]."""
        return np.array([body.free for body in self.bodies], dtype=bool).reshape(-1, MOTIONS)

    @property
    def spreads(self) -> np.ndarray:
        """Standard deviations of the free motions, shape [n]."""
        return np.array([body.spreads for body in self.bodies]).reshape(-1, MOTIONS)[self.free]

    @property
    def means(self) -> np.ndarray:
        """Means of the priors of further free motions, shape [n]: the rims are believed to be where prescribed."""
        return -self.values[self.free]

    @property
    def limits(self) -> np.ndarray:
        """Largest free motions from the prescription, shape [n]: residuals of other causes would move sizes far."""
        limits = [np.where(body.moved, np.inf, _MOST * np.array(body.spreads)) for body in self.bodies]
        return np.array(limits).reshape(-1, MOTIONS)[self.free]

    def surfaces(self, telescope: Telescope) -> set[str]:
        """Return the names of the surfaces whose rims are free."""
        return {telescope.surface_names[surface] for body in self.bodies for surface, _ in body.members}

    def with_body(self, body: RimBody) -> FreeRims:
        """Return these and one more, where the prescription has it; one that is among them takes its place."""
        same = np.array([free.members == body.members for free in self.bodies], dtype=bool)
        value = self.values[same] if same.any() else np.zeros((1, MOTIONS))
        bodies = tuple(itertools.compress(self.bodies, ~same))
        return FreeRims((*bodies, body), np.concatenate([self.values[~same], value]))

    def unmoved(self) -> FreeRims:
        """Return those of bodies that stand where they are prescribed, and may have another size."""
        held = np.array([not body.moved for body in self.bodies], dtype=bool)
        return FreeRims(tuple(itertools.compress(self.bodies, held)), self.values[held])

    def moved(self, steps: np.ndarray) -> FreeRims:
        """Return the rims moved by steps of the free motions [n], within a few standard deviations."""
        values, limit = self.values.copy(), _MOST * self.spreads
        values[self.free] += np.clip(steps, -limit, limit)
        return replace(self, values=values)

    def applied(self, telescope: Telescope) -> Telescope:
        """Return a telescope of the prescription with its rims where these stand."""
        motions: dict[int, dict[int, RimMotion]] = {}
        for body, values in zip(self.bodies, self.values, strict=True):
            for surface, region in body.members:
                motions.setdefault(surface, {})[region] = RimMotion(*(float(v) for v in values))
        surfaces = tuple(
            replace(s, aperture=moved_aperture(s.aperture, motions[i]))
            if i in motions and s.aperture is not None
            else s
            for i, s in enumerate(telescope.surfaces)
        )
        return replace(telescope, surfaces=surfaces)


@dataclass(frozen=True, eq=False)
class RimLines:
    """Shadows of rims on the pupil, in pieces.

    Attributes
    ----------
    points : ndarray, shape [n, 2]
        Middles of the pieces in the plane of the entrance pupil [m].
    along : ndarray, shape [n, 2]
        Their vectors from end to end [m].
    across : ndarray, shape [n, 4]
        Distance that each shadow moves away from the lit side by each motion of its body, on the pupil [m].
    outward : ndarray, shape [n, 4]
        The same of the rims on their own surfaces.
    body : ndarray of int, shape [n]
        Number of the body.
    """

    points: np.ndarray
    along: np.ndarray
    across: np.ndarray
    outward: np.ndarray
    body: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """Lengths of the pieces [m], shape [n]."""
        return np.hypot(*self.along.T)

    def rates(self, free: np.ndarray) -> np.ndarray:
        """Return the change of the lit area by the free motions [n_body, 4] of each body, [n, n_free]."""
        number, motion = np.nonzero(free)
        return np.where(self.body[:, None] == number, self.across[:, motion], 0.0) * self.lengths[:, None]


def rim_bodies(telescope: Telescope) -> list[RimBody]:
    """Return the rims of a telescope by the bodies that have them, without how far they may move.

    Discs of the same radius and centre are one body, as are all vanes.
    """
    groups: list[tuple[Simple, list[tuple[int, int]]]] = []
    # The rim of the detector is not one that vignettes.
    for i, surface in enumerate(telescope.surfaces[:-1]):
        for k, region in enumerate(simple_regions(surface.aperture)):
            members = next((members for first, members in groups if _alike(first, region)), None)
            if members is None:
                groups.append((region, [(i, k)]))
            else:
                members.append((i, k))
    return [RimBody(tuple(members), (0.0,) * MOTIONS, is_vane(region)) for region, members in groups]


def rim_of_surface(telescope: Telescope, name: str, spread: float) -> RimBody:
    """Return the rims of a surface as one body, which shifts by a standard deviation along each axis [m]."""
    surface = telescope.surface_names.index(name)
    count = len(simple_regions(telescope.surfaces[surface].aperture))
    return RimBody(tuple((surface, region) for region in range(count)), (spread, spread, 0.0, 0.0))


def _alike(first: Simple, second: Simple) -> bool:
    if is_vane(first) or is_vane(second):
        return is_vane(first) and is_vane(second)
    if isinstance(first, Circle) and isinstance(second, Circle):
        differences = first.radius - second.radius, first.x - second.x, first.y - second.y
        return max(abs(d) for d in differences) < _ALIKE * first.radius
    return first == second


class PupilShadows:
    """Shadows of the rims of a telescope on the pupil, for the light of one star.

    Parameters
    ----------
    telescope : Telescope
        The telescope, its rims where they stand.
    direction : ndarray, shape [3]
        Unit vector along which the light travels.
    wavelength : float
        Vacuum wavelength [m].
    cells : PupilCells
        Cells of the pupil.
    """

    def __init__(self, telescope: Telescope, direction: np.ndarray, wavelength: float, cells: PupilCells) -> None:
        self._telescope, self._cells = telescope, cells
        self._light = direction[None], wavelength
        half = 0.5 * float(np.ptp(cells.points, axis=0).max()) * _MARGIN
        along = half * np.linspace(-1.0, 1.0, _SURVEY)
        middle = 0.5 * (cells.points.min(axis=0) + cells.points.max(axis=0))
        lattice = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
        survey = middle + lattice[np.hypot(*lattice.T) <= 1.1 * half]
        self._middle, self._half = middle, half
        self._ends = self._traced(survey)
        self._survey = PupilSurvey(survey, self._ends[-1].status == RayStatus.OK, middle, half)

    def _traced(self, points: np.ndarray) -> list[TraceResult]:
        """Return rays through points of the pupil [n, 2] at all surfaces."""
        return trace(self._telescope, parallel_rays(self._telescope, *self._light, points), "all", threads=1)

    def _places(self, surface: int, ends: Sequence[TraceResult]) -> np.ndarray:
        """Return the places of rays in the plane of a surface [n, 2]; NaN where they miss it."""
        return self._telescope.surfaces[surface].to_local(ends[surface].position)[:, :2]

    def lines(self, bodies: Sequence[RimBody]) -> RimLines:
        """Return the shadows of bodies where they bound the light."""
        regions: dict[int, dict[int, int]] = {}
        for number, body in enumerate(bodies):
            for surface, region in body.members:
                regions.setdefault(surface, {})[region] = number
        shadows = [self._shadows(surface, numbers) for surface, numbers in regions.items()]
        points, along, shift, slope, numbers, surfaces = (np.concatenate(v) for v in zip(*shadows, strict=True))
        length = np.hypot(*along.T)
        normal = np.stack([along[:, 1], -along[:, 0]], axis=-1) / length[:, None]
        towards = self._lit_side(surfaces, points, normal)
        bounds = towards != 0.0
        dark = -normal[bounds] * towards[bounds, None]
        # Gradients on the surface go with the transpose of the inverse.
        on_surface = np.einsum("nji,nj->ni", slope[bounds], dark)
        on_surface /= np.hypot(*on_surface.T)[:, None]
        across = np.einsum("nij,nmj,ni->nm", slope[bounds], shift[bounds], dark)
        outward = np.einsum("nmi,ni->nm", shift[bounds], on_surface)
        return RimLines(points[bounds], along[bounds], across, outward, numbers[bounds])

    def _smooth(self, surface: int) -> tuple[PupilPolynomials, np.ndarray, np.ndarray] | None:
        """Return polynomials of the places of the light on a surface, their coefficients, and these places [n, 2].

        None where too little of the light meets it.
        """
        places = self._places(surface, self._ends)
        reached = self._survey.near_smooth_map(places)
        if reached.sum() < FEWEST:
            return None
        polynomials = self._survey.smooth(reached)
        return polynomials, polynomials.fitted(places[reached]), places[reached]

    def _shadows(self, surface: int, numbers: dict[int, int]) -> tuple[np.ndarray, ...]:
        """Return the outlines of some regions of a surface on the pupil, lit or not; each region has a number.

        Middles of their pieces [n, 2], vectors along them, shifts of the rim on its surface by each motion [n, 4, 2],
        derivatives of the place on the pupil by that on the surface [n, 2, 2], numbers, and that of the surface.
        """
        numberless = np.zeros((2, 0), dtype=np.int64)
        empty = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, MOTIONS, 2)), np.zeros((0, 2, 2)), *numberless
        regions = simple_regions(self._telescope.surfaces[surface].aperture)
        numbers = {region: number for region, number in numbers.items() if self._meets_light(surface, regions[region])}
        polynomials = self._smooth(surface) if numbers else None
        if polynomials is None:
            return empty
        smooth, coefficients, places = polynomials
        # A linear map from the surface to the pupil is where the search for the places there begins.
        center, linear = (values[0] for values in smooth.sums(self._middle[None], coefficients))
        reach = float(np.hypot(*places.T).max())
        spacing = max(self._cells.side * np.sqrt(abs(float(np.linalg.det(linear)))), 1e-6 * reach)
        rims = [outline(regions[region], spacing, reach) for region in numbers]
        middle, along, motion = (
            np.concatenate(v) for v in zip(*((r.middle, r.end - r.start, r.motion) for r in rims), strict=True)
        )
        number = np.repeat(list(numbers.values()), [len(rim.middle) for rim in rims])
        near = _near(middle, places, 2.0 * spacing)
        if not near.any():
            return empty
        begin = (middle[near] - center) @ np.linalg.pinv(linear).T + self._middle
        points = self._on_pupil(smooth, coefficients, begin, middle[near])
        reached = np.isfinite(points).all(axis=1)
        points, along, motion, number = points[reached], *(v[near][reached] for v in (along, motion, number))
        slope = np.linalg.inv(smooth.sums(points, coefficients)[1])
        along = np.einsum("nij,nj->ni", slope, along)
        length = np.hypot(*along.T)
        fine = (length > 0.0) & (length < _LONGEST * self._cells.side)
        return tuple(v[fine] for v in (points, along, motion, slope, number, np.full(len(points), surface)))

    def _meets_light(self, surface: int, region: Simple) -> bool:
        """Return whether a disc's rim is so near to the light on a surface that it may bound it; True for others."""
        if not isinstance(region, Circle):
            return True
        places = self._places(surface, self._ends)[self._ends[-1].status == RayStatus.OK]
        if not len(places):
            return True
        radii = np.hypot(*(places - [region.x, region.y]).T)
        # Light between the rays of the survey may be there, too.
        margin = _BETWEEN * float(np.ptp(places, axis=0).max()) / _SURVEY
        return bool(radii.min() - margin < region.radius < radii.max() + margin)

    def _on_pupil(
        self, smooth: PupilPolynomials, coefficients: np.ndarray, start: np.ndarray, target: np.ndarray
    ) -> np.ndarray:
        """Return the points of the pupil whose light meets places on a surface [n, 2], by Newton's steps."""
        points = start
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                values, jacobian = smooth.sums(points, coefficients)
                (xx, xy), (yx, yy) = np.moveaxis(jacobian, 0, -1)
                x, y = (target - values).T
                determinant = xx * yy - xy * yx
                regular = np.abs(determinant) > 1e-12 * np.nanmax(np.abs(determinant), initial=1e-300)
                solved = np.stack([yy * x - xy * y, xx * y - yx * x], axis=-1) / determinant[:, None]
                step = np.where(regular[:, None], solved, target - values)
                points = points + np.clip(step, -0.3 * self._half, 0.3 * self._half)
                # Beyond the survey polynomials say nothing.
                outside = np.hypot(*(points - self._middle).T) > 1.1 * self._half
                points = np.where(outside[:, None], np.nan, points)
                if not (np.abs(step) > _CLOSE * self._half).any(where=np.isfinite(points)):
                    break
        return points

    def _lit_side(self, surfaces: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Return on which side of rims light passes, 1 along the normals and -1 against them; 0 if not one alone.

        The dark side has to be that of the rim's own surface: of rims in one place, the first that the light meets.
        """
        if not len(points):
            return np.zeros(0)
        step = _BESIDE * self._cells.side * normal
        ends = self._traced(np.concatenate([points + step, points - step]))
        stopped = np.full(2 * len(points), -1)
        for number, end in reversed(list(enumerate(ends))):
            stopped[end.status == RayStatus.VIGNETTED] = number
        lit = ends[-1].status == RayStatus.OK
        first, second = np.split(lit, 2)
        dark_first, dark_second = np.split(stopped == np.tile(surfaces, 2), 2)
        return np.where(first & dark_second, 1.0, np.where(second & dark_first, -1.0, 0.0))

    def candidates(self) -> tuple[list[RimBody], RimLines]:
        """Return the bodies whose rims bound the light, with how far they may move, and their shadows."""
        bodies = rim_bodies(self._telescope)
        if not bodies:
            none, motionless = np.zeros((0, 2)), np.zeros((0, MOTIONS))
            return [], RimLines(none, none, motionless, motionless, np.zeros(0, dtype=np.int64))
        lines = self.lines(bodies)
        count = np.bincount(lines.body, minlength=len(bodies))
        bounding = np.flatnonzero(count >= _FEWEST_PIECES)
        place = np.full(len(bodies), -1)
        place[bounding] = np.arange(len(bounding))
        shadow = place[lines.body] >= 0
        values = (lines.points, lines.along, lines.across, lines.outward, place[lines.body])
        shadows = RimLines(*(v[shadow] for v in values))
        return [self._with_spreads(bodies[k]) for k in bounding], shadows

    def _with_spreads(self, body: RimBody) -> RimBody:
        """Return a body with the standard deviations of its motions."""
        surface, region = body.members[0]
        places = self._places(surface, self._ends)[self._ends[-1].status == RayStatus.OK]
        diameter = 2.0 * float(np.hypot(*(places - places.mean(axis=0)).T).max())
        aperture = self._telescope.surfaces[surface].aperture
        if not body.spider:
            radius = enclosing_circle(simple_regions(aperture)[region])[2]
            return replace(body, spreads=(min(_OF_RADIUS * radius, _OF_BEAM * diameter),) * 3 + (0.0,))
        shift, width = _SPIDER_SHIFT * diameter, vane_width(simple_regions(aperture)[region])
        return replace(body, spreads=(shift, shift, _THICKNESS * width, _SPIDER_TURN))


def _near(points: np.ndarray, places: np.ndarray, margin: float) -> np.ndarray:
    """Return which points lie in the box about places, with a margin [m]."""
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    return np.asarray(((points >= low) & (points <= high)).all(axis=1))


def cells_with_lines(cells: PupilCells, lines: RimLines, free: np.ndarray) -> PupilCells:
    """Return cells with the shadows of rims among them: no light of their own, but rates by the free motions."""
    shadows = line_cells(cells, lines, free)
    assert shadows.rates is not None
    # The light of all cells sums to 1 wherever the rims stand.
    rates = np.concatenate([-np.outer(cells.weights, shadows.rates.sum(axis=0)), shadows.rates])
    return replace(
        cells,
        points=np.concatenate([cells.points, shadows.points]),
        weights=np.concatenate([cells.weights, shadows.weights]),
        moments=np.concatenate([cells.moments, shadows.moments]),
        rates=rates,
    )


def rims_of_other_size(
    telescope: Telescope, direction: np.ndarray, wavelength: float, across: int, spread: float
) -> FreeRims:
    """Return the rims that bound the light, with a relative standard deviation of their sizes alone.

    The direction [3] is that of the light, of a wavelength [m]; so many cells stand across the pupil.
    """
    cells = pupil_cells(telescope, direction, wavelength, across)
    if not len(cells):
        return FreeRims()
    rims = FreeRims()
    for body in PupilShadows(telescope, direction, wavelength, cells).candidates()[0]:
        surface, region = body.members[0]
        if not body.spider:
            radius = enclosing_circle(simple_regions(telescope.surfaces[surface].aperture)[region])[2]
            rims = rims.with_body(replace(body, spreads=(0.0, 0.0, spread * radius, 0.0)))
    return rims


def line_cells(cells: PupilCells, lines: RimLines, free: np.ndarray) -> PupilCells:
    """Return the shadows of rims as cells without light, with rates of change by the free motions [n_body, 4]."""
    moments = lines.along[:, :, None] * lines.along[:, None, :] / 12.0
    rates = lines.rates(free) / (cells.side**2 * cells.area)
    return replace(cells, points=lines.points, weights=np.zeros(len(lines.points)), moments=moments, rates=rates)


def steps_of_bounding(rates: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return steps of free motions [n] of one star's rims, zero for rims that bound no light where they stand.

    Without an effect on light, by its rates [n_point, n], a fit has such rims where they are believed to be.
    """
    return np.where(rates.any(axis=0), steps, 0.0)
