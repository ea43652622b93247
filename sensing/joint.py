"""Joint fit of all stars of an exposure: double Zernikes over the field, or degrees of freedom of the telescope."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from ..core.errors import DomainError
from ..design.metrics.field_zernikes import wavefront_zernikes
from ..design.optimize.sensitivity import sensitivity
from ..models.parameters.degrees_of_freedom import DegreesOfFreedom
from ..models.zernike_polynomials import annular_zernikes
from ..raytrace.launch import aimed_points
from ..wavefront.psf.pupil_rims import pupil_rims
from .degrees import FreedomRays
from .donut_rays import ZernikeRays
from .fit_star import StarFit
from .image_model import STRENGTH
from .light import Instrument
from .pupil_cells import PupilCells
from .solve import Group, Solution, solve
from .stamps import Pixels
from .vignetting import cells_with_rims, rim_shifts

#: Times that vignetting and response to the degrees of freedom are computed, steps with each, and squared change in
#: units of the errors, a degree of freedom, that is small enough.
_OUTER, _INNER, _SETTLED = 4, 6, 1e-3
#: Step of the differences by which rims follow degrees of freedom, in units of the prior.
_STEP = 1e-3
_MANY_TERMS = 37


@dataclass(frozen=True)
class JointFit:
    """Joint solution of the usable stars.

    Attributes
    ----------
    stars : tuple of StarFit
        The usable stars with their last stamps.
    solution : Solution
        Unknowns of all stars and the shared ones.
    zernikes : ndarray, shape [n_star, n_noll]
        Wavefront of each star [m].
    zernike_map : ndarray, shape [n_star, n_noll, n_shared]
        Derivatives of the wavefronts with respect to the shared unknowns.
    """

    stars: tuple[StarFit, ...]
    solution: Solution
    zernikes: np.ndarray
    zernike_map: np.ndarray


def field_terms(field_noll: np.ndarray, fields: np.ndarray, field_radius: float) -> np.ndarray:
    """Return Zernikes of the field at field angles [n, 2], shape [n, n_term]."""
    terms = annular_zernikes(int(field_noll.max()), *(fields.T / field_radius))
    return np.asarray(terms[field_noll - 1].T)


def fit_field(
    instrument: Instrument, stars: Sequence[StarFit], terms: np.ndarray, fixed: bool, pool: Executor | None
) -> JointFit:
    """Fit double Zernikes, field terms [n_star, n_term] times those of the pupil."""
    n_noll = len(instrument.noll)
    if len(stars) < terms.shape[1]:
        raise DomainError(f"field_noll: {terms.shape[1]} terms for {len(stars)} usable donuts; expected no more terms")
    maps = np.stack([np.kron(row, np.eye(n_noll)) for row in terms])
    precision = np.tile(instrument.precision, terms.shape[1])
    start = _start(stars, maps, precision)
    held = [_with_held_rims(star) for star in stars]
    group = Group(tuple(s.stamp for s in held if s.stamp), maps, precision, fixed)
    solution = solve(group, _star_unknowns(stars), start, pool=pool)
    return JointFit(tuple(held), solution, np.array(solution.waves), maps)


def _with_held_rims(star: StarFit) -> StarFit:
    """Return a star whose rims stand where its own fit has them."""
    stamp, solution = star.stamp, star.solution
    if stamp is None or solution is None or not isinstance(stamp.rays, ZernikeRays):
        return star
    return replace(star, stamp=replace(stamp, rays=stamp.rays.at_shifts(solution.waves[0])))


def fit_freedoms(
    instrument: Instrument,
    stars: Sequence[StarFit],
    freedoms: DegreesOfFreedom,
    prior: np.ndarray,
    fields: np.ndarray,
    projection: str,
    fixed: bool,
    pool: Executor | None,
) -> JointFit:
    """Fit degrees of freedom of the telescope with Gaussian priors of given standard deviations."""
    telescope, noll = instrument.telescope, instrument.noll
    jmax = int(noll.max())
    response = sensitivity(telescope, freedoms, fields, instrument.middle, n_zernike=jmax, projection=projection)
    maps = response.matrix[:, noll - 1]
    precision = prior**-2.0
    shifts = _shifts_by_freedoms(instrument, stars, freedoms, prior)
    every = [np.concatenate([np.eye(len(freedoms)), own]) for own in shifts]
    shared, unknowns = _start(stars, maps, precision), _star_unknowns(stars)
    for _ in range(_OUTER):
        moved = [
            _with_vignetting(instrument, star, freedoms, shared, own @ shared)
            for star, own in zip(stars, shifts, strict=True)
        ]
        group = Group(tuple(s.stamp for s in moved if s.stamp), every, precision, fixed, transient=True)
        joint = solve(group, unknowns, shared, steps=_INNER, pool=pool)
        change, shared, unknowns = joint.shared - shared, joint.shared, list(joint.stars)
        if float(change @ np.linalg.solve(joint.shared_covariance, change)) < _SETTLED * len(change):
            break
    # Over the whole annulus, vignetted or not: so many terms that no other shows up in those asked for.
    many = max(jmax, _MANY_TERMS)
    after = freedoms.apply(telescope, joint.shared)
    before, found = (
        wavefront_zernikes(t, fields, instrument.middle, jmax=jmax, projection=projection).coefficients[:, noll - 1]
        for t in (telescope, after)
    )
    response = sensitivity(after, freedoms, fields, instrument.middle, n_zernike=many, projection=projection)
    return JointFit(tuple(moved), joint, found - before, response.matrix[:, noll - 1])


def with_freedoms(instrument: Instrument, star: StarFit, freedoms: DegreesOfFreedom) -> StarFit:
    """Return a star whose light depends on degrees of freedom in place of its own Zernikes."""
    stamp = star.stamp
    if stamp is None or star.full is None or not isinstance(stamp.rays, ZernikeRays):
        return star
    return _with_cells(instrument, star, freedoms, stamp.rays.cells)


def _shifts_by_freedoms(
    instrument: Instrument, stars: Sequence[StarFit], freedoms: DegreesOfFreedom, prior: np.ndarray
) -> list[np.ndarray]:
    """Return the shifts of the rims of each star by the degrees of freedom, [n_shift, n_freedom]."""
    telescope, wavelength = instrument.telescope, instrument.middle
    lights = [star.light for star in stars if star.light]
    rims = [rim for light in lights for rim in light.rims]
    if not rims:
        return [np.zeros((0, len(freedoms)))] * len(stars)
    directions = np.array([light.direction for light in lights for _ in light.rims])
    points = np.array([rim.point for rim in rims])[:, None]
    aimed = aimed_points(telescope, directions, wavelength, points).reshape(-1, 2)
    aimed_rims = [replace(rim, point=point) for rim, point in zip(rims, aimed, strict=True)]
    steps = _STEP * prior
    moved = [(freedoms.apply(telescope, step), freedoms.apply(telescope, -step)) for step in np.diag(steps)]
    found = rim_shifts(moved, steps, directions, wavelength, aimed_rims)
    ends = np.cumsum([2 * len(light.rims) for light in lights])
    return np.split(found, ends[:-1])


def _with_vignetting(
    instrument: Instrument, star: StarFit, freedoms: DegreesOfFreedom, at: np.ndarray, shifts: np.ndarray
) -> StarFit:
    """Return a star with the vignetting of some values of the degrees of freedom, which shift its rims so far."""
    light, stamp, solution = star.light, star.stamp, star.solution
    if light is None or stamp is None or solution is None:
        return star
    fwhm = float(instrument.seeing.fwhm(solution.stars[0][STRENGTH]))
    pixels = Pixels(stamp.image, stamp.variance, stamp.used, round(stamp.grid.scale))
    across = instrument.sampling(light, pixels, fwhm).across
    changed = freedoms.apply(light.telescope, at)
    cells = cells_with_rims(changed, light.direction, instrument.middle, across, light.rims)
    if light.rims and light.pupil_rims is not None and star.full is not None:
        rims = pupil_rims(changed, light.direction, instrument.middle)
        both = [replace(each, grid=each.grid.with_rims(rims)) for each in (stamp, star.full)]
        star = replace(star, stamp=both[0], full=both[1])
    return _with_cells(instrument, star, freedoms, cells, shifts)


def _with_cells(
    instrument: Instrument,
    star: StarFit,
    freedoms: DegreesOfFreedom,
    cells: PupilCells,
    shifts: np.ndarray | None = None,
) -> StarFit:
    light, stamp, full = star.light, star.stamp, star.full
    if light is None or stamp is None or full is None:
        return star
    waves = (instrument.wavelengths, instrument.wavelength_weights)
    rays = FreedomRays(light.telescope, light.direction, *waves, cells, freedoms, stamp.grid.footprint, shifts)
    stamp, full = replace(stamp, rays=rays), replace(full, rays=rays)
    stamp.release()
    full.release()
    return replace(star, stamp=stamp, full=full)


def _star_unknowns(stars: Sequence[StarFit]) -> list[np.ndarray]:
    return [s.solution.stars[0] for s in stars if s.solution]


def _start(stars: Sequence[StarFit], maps: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Return the shared unknowns that fit the stars' own wavefronts best."""
    curvature, gradient = np.diag(precision), np.zeros(len(precision))
    for star, one in zip(stars, maps, strict=True):
        if star.solution is not None and len(star.solution.shared):
            # Shifts of rims of its own stand after the wavefront.
            n = len(one)
            information = np.linalg.pinv(star.solution.shared_covariance[:n, :n], hermitian=True)
            curvature = curvature + one.T @ information @ one
            gradient = gradient + one.T @ information @ star.solution.shared[:n]
    return np.linalg.lstsq(curvature, gradient, rcond=1e-14)[0]
