"""Fit of degrees of freedom of the telescope to all donuts of an exposure together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from ..core.arguments import check_arguments
from ..design.metrics.field_zernikes import wavefront_zernikes
from ..models.parameters.degrees_of_freedom import DegreesOfFreedom
from ..models.parameters.tolerances import Tolerance
from ..raytrace.launch import aimed_points
from ..wavefront.psf.pupil_rims import pupil_rims
from .degrees import FreedomEstimate, FreedomRays, annulus_response, prior_spreads, stated_spreads
from .fit_star import StarFit
from .inputs import noll_indices
from .joint_errors import joint_errors
from .light import Instrument
from .moving_rims import FreeRims
from .pupil_cells import PupilCells
from .shared_rims import (
    JointFit,
    cells_across,
    group_with_rims,
    least_rims,
    light_with,
    moved_rims_of_all,
    shared_rims,
)
from .solve import DAMPING, solve
from .star_fitter import StarSolution
from .vignetting import cells_with_rims, rim_shifts
from .wavefront_fits import NOLL, FittedStars, UsableStars, WavefrontFit, joint_results

#: Times that vignetting and response to the degrees of freedom are computed.
_OUTER = 4
#: Steps with each of them.
_INNER = 6
#: Squared change in units of the errors, a degree of freedom, that is small enough.
_SETTLED = 1e-3
#: Step of the differences by which rims follow degrees of freedom, in units of the prior.
_STEP = 1e-3


@check_arguments
@dataclass(frozen=True, eq=False)
class TelescopeFreedoms(WavefrontFit):
    """Fit of degrees of freedom of the telescope to all donuts together; for :func:`~pachon.fit_donuts`.

    Attributes
    ----------
    freedoms : DegreesOfFreedom
        Degrees of freedom, in place of Zernikes of each donut.
    prior : array_like, mapping or tolerances, optional
        Standard deviations of the degrees of freedom, each in its unit, or one number for all; by default each makes
        1 um rms of wavefront over the field.
    noll : iterable of int
        Noll indices of the wavefront that they make at each donut, from 4.

    Raises
    ------
    ConfigError, DomainError
        If indices repeat or are below 4, or a standard deviation is missing or not positive.
    """

    freedoms: DegreesOfFreedom
    prior: ArrayLike | Mapping[str, Any] | Sequence[Tolerance] | None = None
    noll: Iterable[int] = NOLL

    def __post_init__(self) -> None:
        object.__setattr__(self, "noll", tuple(noll_indices(self.noll, "noll", 4)))
        if self.prior is not None:
            stated_spreads(self.freedoms, self.prior)

    def prepared(self, instrument: Instrument, star: StarFit) -> StarFit:
        """Return a star whose light depends on degrees of freedom in place of its own Zernikes."""
        star = super().prepared(instrument, star)
        if star.best is None:
            return star
        return replace(star, best=self._with_cells(instrument, star.best, star.best.stamp.rays.cells))

    def solved(self, usable: UsableStars, pool: Executor) -> FittedStars:
        """Return the results of a joint fit with Gaussian priors."""
        instrument, freedoms = usable.instrument, self.freedoms
        telescope, noll, wavelength = instrument.telescope, instrument.noll, instrument.middle
        spreads = prior_spreads(freedoms, self.prior, telescope, wavelength)
        fields, projection = usable.fields, usable.projection
        last = int(noll.max())
        response = annulus_response(telescope, freedoms, fields, wavelength, last, projection)[:, noll - 1]
        count, slopes = len(freedoms), instrument.slope_spreads
        first = count + len(slopes)
        shifts = self._rim_shifts(usable, spreads)
        maps = [block_diag(np.concatenate([np.eye(count), of_star]), np.eye(len(slopes))) for of_star in shifts]
        precision = np.concatenate([spreads, slopes]) ** -2.0
        shared, unknowns = usable.start(response, spreads**-2.0), usable.unknowns
        shared = np.append(shared, 0.0 * slopes)

        def fitted(rims: FreeRims) -> JointFit:
            at, of_stars, damping = shared, unknowns, DAMPING
            for _ in range(_OUTER):
                stars = [
                    self._with_vignetting(instrument, star, rims, at[:count], star_shifts @ at[:count])
                    for star, star_shifts in zip(usable.stars, shifts, strict=True)
                ]
                group = group_with_rims(instrument, stars, maps, precision, rims, transient=True)
                start = np.concatenate([at, np.zeros(len(rims))])
                solution = solve(group, of_stars, start, steps=_INNER, damping=damping, pool=pool)
                joint = JointFit(stars, group, solution, rims)
                change, at, of_stars = solution.shared - start, solution.shared[:first], list(solution.stars)
                damping = solution.damping
                if float(change @ np.linalg.solve(solution.shared_covariance, change)) < _SETTLED * len(change):
                    break
                rims = rims.moved(change[first:])
            return joint

        fit = least_rims(shared_rims(instrument, usable.stars), fitted)
        stars, group, joint, rims = fit
        errors = joint_errors(instrument, usable.stars, fields, response, stars, group, joint)
        values = joint.shared[:count]
        after = freedoms.apply(telescope, values)
        believed, estimated = (
            wavefront_zernikes(t, fields, wavelength, jmax=last, pupil="full", projection=projection).coefficients[
                :, noll - 1
            ]
            for t in (telescope, after)
        )
        response = annulus_response(after, freedoms, fields, wavelength, last, projection)[:, noll - 1]
        # Rims and slopes of the response are no part of the wavefront.
        zernike_maps = np.pad(response, ((0, 0), (0, 0), (0, len(slopes) + len(rims))))
        covariance = (joint.shared_covariance + errors.shared)[:count, :count]
        moved = moved_rims_of_all(instrument, fit, first)
        return FittedStars(
            joint_results(stars, joint, errors, estimated - believed, list(zernike_maps), moved, slice(count, first)),
            degrees_of_freedom=FreedomEstimate(freedoms, values, covariance, spreads),
        )

    def _rim_shifts(self, usable: UsableStars, spreads: np.ndarray) -> list[np.ndarray]:
        """Return the shifts of the rims of each star by the degrees of freedom, [n_shift, n_freedom]."""
        telescope, wavelength, freedoms = usable.instrument.telescope, usable.instrument.middle, self.freedoms
        lights = [star.light for star in usable.stars]
        rims = [rim for light in lights for rim in light.rims]
        if not rims:
            return [np.zeros((0, len(freedoms)))] * len(lights)
        directions = np.array([light.direction for light in lights for _ in light.rims])
        points = np.array([rim.point for rim in rims])[:, None]
        aimed = aimed_points(telescope, directions, wavelength, points).reshape(-1, 2)
        aimed_rims = [replace(rim, point=point) for rim, point in zip(rims, aimed, strict=True)]
        steps = _STEP * spreads
        moved = [(freedoms.apply(telescope, step), freedoms.apply(telescope, -step)) for step in np.diag(steps)]
        shifts = rim_shifts(moved, steps, directions, wavelength, aimed_rims)
        ends = np.cumsum([2 * len(light.rims) for light in lights])
        return np.split(shifts, ends[:-1])

    def _with_vignetting(
        self, instrument: Instrument, star: StarSolution, rims: FreeRims, at: np.ndarray, shifts: np.ndarray
    ) -> StarSolution:
        """Return a star with the vignetting of some values of the degrees of freedom, which shift its rims so far.

        Rims that are free stand where those of all stars do.
        """
        light = light_with(instrument, star, rims)
        changed = self.freedoms.apply(light.telescope, at)
        across = cells_across(instrument, star)
        cells = cells_with_rims(changed, light.direction, instrument.middle, across, light.rims, rims)
        if (light.rims or light is not star.light) and light.pupil_rims is not None:
            outlines = pupil_rims(changed, light.direction, instrument.middle)
            stamp, full = (replace(s, grid=s.grid.with_rims(outlines)) for s in (star.stamp, star.full))
            star = replace(star, stamp=stamp, full=full)
        cells = instrument.with_response(light, changed, cells)
        held = np.concatenate([shifts, np.zeros(len(light.slope_spreads) + len(rims))])
        return self._with_cells(instrument, replace(star, light=light), cells, held)

    def _with_cells(
        self, instrument: Instrument, star: StarSolution, cells: PupilCells, shifts: np.ndarray | None = None
    ) -> StarSolution:
        """Return a star with the light through cells of the pupil, by degrees of freedom."""
        light, footprint = star.light, star.stamp.grid.footprint
        waves = instrument.wavelengths, instrument.wavelength_weights
        rays = FreedomRays(light.telescope, light.direction, *waves, cells, self.freedoms, footprint, shifts)
        stamp, full = replace(star.stamp, rays=rays), replace(star.full, rays=rays)
        stamp.release()
        full.release()
        return replace(star, stamp=stamp, full=full)
