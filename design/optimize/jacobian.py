"""From what surfaces answer for to what parameters do: every parameter is linear in the columns of a sweep back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...models.shapes.polar_polynomial import PolarPolynomial
from ...models.telescope import Telescope
from ...raytrace.adjoint.adjoint_matrix import AdjointMatrix, column_table, polynomial_terms
from ...raytrace.adjoint.backward_pass import OutputGradient, backward_pass
from ...raytrace.adjoint.forward_pass import ForwardPass
from ...raytrace.adjoint.sphere_adjoint import SPHERE_COLUMNS, SphereAdjoint
from ...wavefront.reference_sphere import sphere_distance_derivatives
from ..parameters.parameters import Parameter, apply, figured_shapes, index_surfaces, twists
from ..parameters.surface_deformation import figure_polynomial


@dataclass(frozen=True)
class ParameterColumns:
    """Which columns a set of parameters needs, and with which weights.

    Attributes
    ----------
    telescope : Telescope
        The telescope with all changes applied, whose derivatives these are.
    parameters : tuple of Parameter
        The parameters.
    rows : ndarray of int, shape [n_surface + 1, 13]
        Table of the columns, for :func:`~pachon.raytrace.adjoint.backward_pass.backward_pass`.
    polynomials : tuple of (surface, scale, degree, rows)
        Surfaces with figures that are polynomials, for the same.
    figures : tuple of (surface, name)
        Figures that are not; each has a row of its own behind all others.
    helpers : int
        So many rows come first that others are made of; those of a sphere follow, and then all that have weights.
    weights : ndarray, shape [n_row, n_parameter]
        Derivative of an output with respect to a parameter, per unit of each of these.
    """

    telescope: Telescope
    parameters: tuple[Parameter, ...]
    rows: np.ndarray
    polynomials: tuple[tuple[int, float, int, np.ndarray], ...]
    figures: tuple[tuple[int, str], ...]
    helpers: int
    weights: np.ndarray

    @classmethod
    def at(
        cls, telescope: Telescope, parameters: tuple[Parameter, ...], values: np.ndarray | None = None
    ) -> ParameterColumns:
        """Return the columns for derivatives at given changes of the parameters; at none by default."""
        values = np.zeros(len(parameters)) if values is None else values
        moved = apply(telescope, dict(zip(parameters, values, strict=True)))
        names = telescope.surface_names
        figured = [(p, names.index(one.target), one) for p, one in enumerate(parameters) if one.kind == "figure"]
        wanted = {(s, name) for _, s, _ in figured for name in ("sag", "intersection")}
        helpers = column_table(telescope, wanted)
        count = int(helpers.max()) + 1
        first = count + SPHERE_COLUMNS

        # Across a gap a motion counts by what the bodies on both sides do differently.
        ends = np.zeros((len(parameters), 1, 6))
        motion = -np.diff(twists(telescope, parameters, values), axis=1, prepend=ends, append=ends)
        runs = {p: index_surfaces(telescope, one.target) for p, one in enumerate(parameters) if one.kind == "index"}
        behind = {(s, "index") for run in runs.values() for s in run}
        before = {(s + 1, "index") for run in runs.values() for s in run if s + 1 < len(names)}
        gaps = {(int(g), "gap") for g in np.flatnonzero(motion.any(axis=(0, 2)))}
        own = column_table(telescope, behind | before | gaps, first)
        rows = np.maximum(helpers, own)

        # Where rays go, a shape has the figures that are not zero; to be differentiated by, all that are named.
        shapes = figured_shapes(moved, parameters)
        used = max(first, int(own.max()) + 1)
        terms: dict[int, dict[int, PolarPolynomial]] = {}
        figures: list[tuple[int, int, str]] = []
        for p, s, parameter in figured:
            polynomial = figure_polynomial(shapes[parameter.target], parameter.name)
            if polynomial is None:
                figures.append((p, s, parameter.name))
            else:
                terms.setdefault(s, {})[p] = polynomial
        blocks = []
        for s, found in terms.items():
            scale = _scale(telescope, s)
            degree, weights = _polynomial_weights(found, len(parameters), scale)
            present = weights.any(axis=1)
            places = np.where(present, used + np.cumsum(present) - 1, -1).astype(np.int32)
            blocks.append((s, scale, degree, places, weights[present]))
            used += int(present.sum())

        total = np.zeros((used + len(figures), len(parameters)))
        for g in np.flatnonzero(motion.any(axis=(0, 2))):
            total[rows[g, 7:]] = motion[:, g].T
        for p, run in runs.items():
            total[rows[run, 4], p] = 1.0
            total[[rows[s + 1, 3] for s in run if s + 1 < len(names)], p] = 1.0
        for *_, places, weights in blocks:
            total[places[places >= 0]] = weights
        for i, (p, _, _) in enumerate(figures):
            total[used + i, p] = 1.0
        listed = tuple(block[:4] for block in blocks)
        return cls(moved, parameters, rows, listed, tuple((s, name) for _, s, name in figures), count, total[first:])

    def responses(self, forward: ForwardPass, gradient: OutputGradient, *, threads: int | None = None) -> np.ndarray:
        """Return all rows of every output and ray, shape [n_output, n_row, n]; times the weights they are derivatives.

        Parameters
        ----------
        forward : ForwardPass
            Rays through ``self.telescope``.
        gradient : OutputGradient
            The outputs.
        threads : int, optional
            Number of threads.
        """
        response = backward_pass(forward, gradient, self.rows, polynomials=self.polynomials, threads=threads)
        return self._with_figures(response, self.helpers + SPHERE_COLUMNS)

    def to_spheres(
        self,
        directions: np.ndarray,
        indices: np.ndarray,
        pupil: np.ndarray,
        center: np.ndarray,
        path: np.ndarray,
        *,
        lit_only: bool = False,
    ) -> SphereAdjoint:
        """Return the sweep of the rays of field points to their reference spheres, whose rows :meth:`of_path` takes.

        Parameters are those of :class:`~pachon.raytrace.adjoint.sphere_adjoint.SphereAdjoint`.
        """
        return SphereAdjoint(
            self.telescope,
            directions,
            indices,
            pupil,
            center,
            path,
            self.telescope.reference_sphere_radius,
            self.rows,
            self.helpers,
            self.polynomials,
            lit_only=lit_only,
        )

    def of_path(self, response: AdjointMatrix) -> np.ndarray:
        """Return the rows [n_row, n_field, n_pupil] of optical paths to reference spheres.

        The first four are the path and its derivatives with respect to the landing point; all others have weights.
        """
        return self._with_figures(response, self.helpers)[0]

    def _with_figures(self, response: AdjointMatrix, first: int) -> np.ndarray:
        """Return the rows from a first one on, those of figures that are no polynomials added."""
        values = response.values[:, first:]
        if not self.figures:
            return values
        shapes, names = figured_shapes(self.telescope, self.parameters), self.telescope.surface_names
        extra = np.empty((len(values), len(self.figures), *values.shape[2:]))
        for i, (s, name) in enumerate(self.figures):
            f, fx, fy = shapes[names[s]].sag_derivative(name, *response.intersection(s))
            sag = response.sag(s)
            extra[:, i] = sag[:, 0] * f + sag[:, 1] * fx + sag[:, 2] * fy
        return np.concatenate([values, extra], axis=1)

    def size_of_terms(
        self, forward: ForwardPass, gradient: OutputGradient, *, threads: int | None = None
    ) -> np.ndarray:
        """Return how large the terms are that a derivative sums up, rms over rays and outputs, shape [n_parameter].

        A derivative far below them is rounding: the terms cancel.
        """
        terms = np.abs(self.responses(forward, gradient, threads=threads)).transpose(0, 2, 1) @ np.abs(self.weights)
        return np.sqrt(np.mean(terms**2, axis=(0, 1)))

    def derivatives(self, forward: ForwardPass, gradient: OutputGradient, *, threads: int | None = None) -> np.ndarray:
        """Return the derivatives of every output and ray with respect to each parameter, [n_output, n, n_parameter]."""
        return np.matmul(self.responses(forward, gradient, threads=threads).transpose(0, 2, 1), self.weights)


def _scale(telescope: Telescope, surface: int) -> float:
    """Return a length [m] in whose units a polynomial over a surface is of order 1: that of the pupil, near enough."""
    aperture = telescope.surfaces[surface].aperture
    outer = getattr(aperture, "outer", getattr(aperture, "radius", None))
    return float(outer) if outer else 0.5 * telescope.pupil_diameter


def _polynomial_weights(found: dict[int, PolarPolynomial], n: int, scale: float) -> tuple[int, np.ndarray]:
    """Return the highest degree of the polynomials of some of ``n`` parameters, and their terms, [n_term, n]."""
    highest = max(len(p.terms) + 2 * p.terms.shape[1] for p in found.values())
    terms = np.zeros((n, highest, highest), dtype=np.complex128)
    for row, polynomial in found.items():
        orders, powers = polynomial.terms.shape
        terms[row, :orders, :powers] = polynomial.terms
    degree = PolarPolynomial(np.abs(terms).max(axis=0)).degree
    m, k, imaginary = np.array(polynomial_terms(degree)).T
    term = terms[:, m, k].T * (scale ** (m + 2 * k))[:, None]
    weights = np.where(imaginary[:, None], -term.imag, term.real)
    return degree, weights


def sphere_gradient(forward: ForwardPass, center: np.ndarray, radius: float) -> tuple[OutputGradient, np.ndarray]:
    """Return the gradient of the optical path to reference spheres, one output, and that path.

    Parameters
    ----------
    forward : ForwardPass
        Rays traced to the image.
    center : ndarray, shape [3, n]
        Centre of the sphere of each ray [m], telescope frame. The derivative of the path with respect to it is the
        opposite of that with respect to the position.
    radius : float
        Radius of the spheres [m].

    Returns
    -------
    gradient : OutputGradient
        One output.
    path : ndarray, shape [n]
        Optical path to the sphere [m].
    """
    n = forward.indices[-2]
    distance, by_position, by_direction = sphere_distance_derivatives(
        forward.position, forward.direction, center, radius
    )
    gradient = OutputGradient(n * by_position[None], n * by_direction[None], np.ones(1), index=distance[None])
    return gradient, forward.path_length + n * distance
