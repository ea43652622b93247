"""Neighbours of a star: stars with its wavefront, and a flux and a place of their own, on a stamp or beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .image_model import FLUX, MOST_NEIGHBOURS, NEIGHBOUR, NUISANCES, RATIO, STRENGTH, X, Y, neighbours_of
from .likelihood import Stamp, linearized, model_image
from .solve import COARSE, STEPS, Solution
from .stamps import match_template, moved, plane_basis

#: Signal over noise of a template that is a star.
SIGNIFICANT = 8.0
#: Least gain of twice the logarithm of the likelihood by a neighbour or another focus.
_GAIN = 100.0
#: Largest fraction of the misfit that another focus may leave, and of a misfit that a neighbour may explain less than:
#: what turbulence and missing terms do to an image, neither explains.
_LEFT = 0.5
#: Least part of the misfit by which a further neighbour lowers it in a search.
_LOWERED = 0.1
#: Loss a coarse pixel from which on neighbours are searched for around the star; photons leave 0.1.
_MISFIT = 0.15
#: The same from which on they are tried without aberrations, too.
_POOR = 1.0
#: Loss a coarse pixel from which on stars are searched for without the wavefront of the first fit, too.
_MISTAKEN = 3.0
#: Distances of neighbours that overlap most of the star over the diameter of the donut, where they are tried.
_NEAR_RADII = (0.08, 0.2)
#: Distances and directions at which a score test looks for them, and the least part of the misfit that it promises: a
#: neighbour has 0.024 to 1, since two equal stars are far from one, and turbulence at most 0.012.
_SCORED_RADII = (0.05, 0.1, 0.2)
_SCORED_ANGLES = 6
_PROMISING = 0.015
#: Directions in which they are tried: two stars of one flux are the same from either end.
_NEAR_ANGLES = 3
#: Steps from each of these places.
_FIRST_STEPS = 4
#: Steps with each neighbour before the next one is searched for.
_BETWEEN_STEPS = 6
#: Number of the best of the solutions about a star that are finished.
_FINISHED = 2
#: Least flux of a neighbour over that of the star.
_LEAST_RATIO = 0.01
#: Least part of a neighbour's squared light on the stamp.
_ON_STAMP = 0.02


def explains_more(trial: Solution, other: Solution) -> bool:
    """Return whether a solution is better than another beyond what could be chance or a wavefront without its terms."""
    return other.loss - trial.loss > _GAIN and trial.loss < _LEFT * other.loss


@dataclass(frozen=True)
class NeighbourSearch:
    """Search for the neighbours of a star on a coarse stamp.

    Attributes
    ----------
    stamp : Stamp
        The stamp, with room for light beside it.
    solve : callable
        Solution from a start: stamp, unknowns of the star, those of the wavefront, tolerance, most steps, and the loss
        below which it has to be.
    first : ndarray
        Unknowns of the star where its template fits best.
    template : ndarray, shape [ny, nx]
        Image of a star of unit flux without aberrations in the middle of the stamp.
    diameter : float
        Diameter of the donut [pixels of the detector].
    """

    stamp: Stamp
    solve: Callable[..., Solution]
    first: np.ndarray
    template: np.ndarray
    diameter: float

    def from_single(self, single: Solution) -> Solution:
        """Return the best solution with neighbours if there are any, else that without.

        The star nearest to the centre of the stamp comes first, then its neighbours by their flux.
        """
        best = self._pruned(self._extended(single))
        if self._misfit(best) > _MISTAKEN:
            lower = (1.0 - _LOWERED) * best.loss
            templates = self._from_templates(np.zeros_like(single.shared), lower)
            if templates is not None and templates.loss < lower:
                trial = self._pruned(self._extended(templates))
                best = trial if trial.loss < best.loss else best
        if self._misfit(best) > _MISFIT:
            best = self._with_near_neighbour(best)
        if len(best.stars[0]) <= RATIO or not explains_more(best, single):
            return single
        return _central_first(best)

    def _misfit(self, solution: Solution) -> float:
        return solution.loss / max(int(self.stamp.used.sum()), 1)

    def _extended(self, solution: Solution) -> Solution:
        """Return a solution with the neighbours that its residuals show, one after the other."""
        stamp, grid = self.stamp, self.stamp.grid
        extended = solution
        while len(neighbours_of(extended.stars[0])) < MOST_NEIGHBOURS:
            star, wave = extended.stars[0], extended.waves[0]
            model = model_image(stamp, star, wave)
            unit = np.zeros(len(NUISANCES))
            unit[[FLUX, STRENGTH]], unit[[X, Y]] = (1.0, star[STRENGTH]), -grid.scale * grid.offset
            match = match_template(
                stamp.image - model,
                stamp.used,
                stamp.variance + np.maximum(model, 0.0),
                model_image(stamp, unit, wave),
                least_on_stamp=_ON_STAMP,
            )
            if not (match.significance >= SIGNIFICANT and match.flux > _LEAST_RATIO * star[FLUX]):
                break
            place = ([match.x, match.y] - grid.offset) * grid.scale - star[[X, Y]]
            trial = self.solve(
                stamp, np.array([*star, match.flux / star[FLUX], *place]), extended.shared, COARSE, _BETWEEN_STEPS
            )
            if not extended.loss - trial.loss > max(_GAIN, _LOWERED * extended.loss):
                break
            extended = trial
        return extended if extended is solution else self._finished(extended)

    def _finished(self, begun: Solution) -> Solution:
        return self.solve(self.stamp, begun.stars[0], begun.shared, COARSE, STEPS)

    def _pruned(self, solution: Solution) -> Solution:
        """Return a solution without the neighbours that explain less than what remains unexplained."""
        while len(solution.stars[0]) > RATIO:
            star, count = solution.stars[0], len(neighbours_of(solution.stars[0]))
            ratios = RATIO + len(NEIGHBOUR) * np.arange(count)
            variances = np.maximum(np.diag(solution.star_covariance(0))[ratios], 1e-30)
            # Without a neighbour the loss is larger by the square of its signal over noise.
            gains = np.where(star[ratios] > _LEAST_RATIO, star[ratios] ** 2 / variances, 0.0)
            weakest = int(np.argmin(gains))
            if gains[weakest] > max(_GAIN, solution.loss):
                break
            without = np.delete(star, np.s_[ratios[weakest] : ratios[weakest] + len(NEIGHBOUR)])
            solution = self.solve(self.stamp, without, solution.shared, COARSE, STEPS)
        return solution

    def _from_templates(self, nothing: np.ndarray, hopeless: float) -> Solution | None:
        """Return the solution from a start without aberrations, stars where their templates fit best together.

        None where there is one alone, from which the first fit began. A `hopeless` loss ends it.
        """
        stamp, grid = self.stamp, self.stamp.grid
        variance, weight = stamp.variance + np.maximum(stamp.image, 0.0), stamp.used.astype(np.float64)
        planes = [plane.ravel() for plane in plane_basis(stamp.used)]
        columns, places, fluxes = [], [], np.zeros(0)
        residual = stamp.image
        for _ in range(1 + MOST_NEIGHBOURS):
            match = match_template(residual, stamp.used, variance, self.template, least_on_stamp=_ON_STAMP)
            if not match.significance >= SIGNIFICANT:
                break
            columns.append((moved(self.template, int(match.y), int(match.x)) * weight).ravel())
            places.append(([match.x, match.y] - grid.offset) * grid.scale)
            matrix = np.stack([*columns, *planes], axis=-1)
            values = np.linalg.lstsq(matrix, (stamp.image * weight).ravel(), rcond=None)[0]
            fluxes = values[: len(columns)]
            residual = stamp.image - (matrix @ values).reshape(stamp.image.shape)
        bright = np.flatnonzero(fluxes > _LEAST_RATIO * fluxes.max(initial=0.0))
        if len(bright) < 2:
            return None
        star, main = self.first.copy(), bright[0]
        star[FLUX], star[[X, Y]] = max(fluxes[main], 1.0), places[main]
        companions = [(fluxes[k] / star[FLUX], *(places[k] - places[main])) for k in bright[1:]]
        star = np.concatenate([star, *companions])
        return self.solve(stamp, star, nothing, COARSE, STEPS, hopeless)

    def _with_near_neighbour(self, best: Solution) -> Solution:
        """Return the best solution with a neighbour that overlaps most of the star, if that explains much more.

        A fit of one star takes two for one that is larger and oddly shaped. If a score test says that there may be two,
        the second is tried where that puts it, and else around the first, both stars without aberrations.
        """
        if len(neighbours_of(best.stars[0])) == MOST_NEIGHBOURS:
            return best
        near = self._likeliest_near(best)
        if near is None:
            return best
        trial = self.solve(self.stamp, _divided(best.stars[0], *near), best.shared, COARSE, STEPS, best.loss)
        if _is_neighbour(trial, best):
            return trial
        if self._misfit(best) < _POOR:
            return best
        nothing, trials = np.zeros_like(best.shared), []
        # The template stands in the middle of the two.
        middle, companions = self.first, neighbours_of(best.stars[0])
        ratios = companions[:, :1] * best.stars[0][FLUX] / middle[FLUX]
        places = companions[:, 1:] + best.stars[0][[X, Y]] - middle[[X, Y]]
        middle = np.concatenate([middle, np.hstack([ratios, places]).ravel()])
        for radius in _NEAR_RADII:
            for angle in np.arange(_NEAR_ANGLES) * np.pi / _NEAR_ANGLES:
                offset = radius * self.diameter * np.array([np.cos(angle), np.sin(angle)])
                star = _divided(middle, 1.0, offset)
                trials.append(self.solve(self.stamp, star, nothing, COARSE, _FIRST_STEPS, best.loss))
        # After a few steps the places that lead nowhere are known.
        for begun in sorted(trials, key=lambda trial: trial.loss)[:_FINISHED]:
            trial = begun if begun.loss > best.loss else self._finished(begun)
            if _is_neighbour(trial, best):
                best = trial
        return best

    def _likeliest_near(self, best: Solution) -> tuple[float, np.ndarray] | None:
        """Return flux over that of the star and place from it of a second star nearby, by a score test.

        None where that promises no neighbour anywhere around. All else is free, the wavefront without its priors.
        """
        star = best.stars[0]
        angles = np.arange(_SCORED_ANGLES) * 2.0 * np.pi / _SCORED_ANGLES
        places = np.multiply.outer(_SCORED_RADII, np.stack([np.cos(angles), np.sin(angles)], axis=-1)).reshape(-1, 2)
        places *= self.diameter
        first, last = len(star), len(star) + len(NEIGHBOUR) * len(places)
        added = np.column_stack([np.zeros(len(places)), places]).ravel()
        point = linearized(self.stamp, np.concatenate([star, added]), best.waves[0])
        if point is None:
            return None
        columns = point.columns * point.scales
        ratios = columns[:, first : last : len(NEIGHBOUR)]
        free = np.concatenate([columns[:, :first], columns[:, last:]], axis=1)
        sizes = np.sqrt((free**2).sum(axis=0))
        free = free[:, sizes > 0.0] / sizes[sizes > 0.0]
        residuals = np.column_stack([ratios, point.pulls])
        residuals = residuals - free @ np.linalg.lstsq(free, residuals, rcond=1e-6)[0]
        slopes, curvatures = residuals[:, :-1].T @ residuals[:, -1], (residuals[:, :-1] ** 2).sum(axis=0)
        gains = np.where(slopes > 0.0, slopes, 0.0) ** 2 / np.maximum(curvatures, 1e-300)
        likeliest = int(np.argmax(gains))
        if not gains[likeliest] > max(_GAIN, _PROMISING * best.loss):
            return None
        return min(float(slopes[likeliest] / curvatures[likeliest]), 1.0), places[likeliest]


def _divided(star: np.ndarray, ratio: float, offset: np.ndarray) -> np.ndarray:
    """Return unknowns of two stars of a flux ratio, an offset apart, with the light of one; its neighbours stay."""
    divided, companions = star[:RATIO].copy(), neighbours_of(star).copy()
    divided[FLUX] /= 1.0 + ratio
    divided[[X, Y]] -= (shift := ratio / (1.0 + ratio) * offset)
    companions[:, 0] *= 1.0 + ratio
    companions[:, 1:] += shift
    return np.concatenate([divided, [ratio], offset, companions.ravel()])


def _is_neighbour(trial: Solution, best: Solution) -> bool:
    """Return whether a solution with one more neighbour, its first, explains much more."""
    return explains_more(trial, best) and bool(trial.stars[0][RATIO] > _LEAST_RATIO)


def _central_first(solution: Solution) -> Solution:
    """Return a solution whose first star is the one nearest to the centre of the stamp, its neighbours by flux."""
    star = solution.stars[0].copy()
    stars = np.vstack([[1.0, 0.0, 0.0], neighbours_of(star)])
    central = int(np.argmin(np.hypot(*(stars[:, 1:] + star[[X, Y]]).T)))
    ratio, offset = stars[central, 0], stars[central, 1:].copy()
    if ratio <= 0.0:
        return solution
    star[FLUX] *= ratio
    star[[X, Y]] += offset
    companions = np.delete(stars, central, axis=0)
    companions = np.column_stack([companions[:, 0] / ratio, companions[:, 1:] - offset])
    star[RATIO:] = companions[np.argsort(-companions[:, 0], kind="stable")].ravel()
    return replace(solution, stars=(star,))
