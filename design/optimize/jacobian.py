"""Chain rule from surface adjoints to telescope parameters: derivatives are linear in the adjoint matrix."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...models.media.medium import LINE_D
from ...models.parameters.links import has_links, without_links
from ...models.parameters.parameters import (
    Parameter,
    apply,
    grating_of,
    index_surfaces,
    linked,
    shapes_with_terms,
    twists,
)
from ...models.parameters.shape_terms import term_polynomial
from ...models.shapes.polar_polynomial import PolarPolynomial
from ...models.telescope import Telescope
from ...raytrace.adjoint.adjoint_matrix import AdjointMatrix, column_table, polynomial_terms
from ...raytrace.adjoint.backward_pass import OutputGradient, backward_pass
from ...raytrace.adjoint.forward_pass import ForwardPass
from ...raytrace.adjoint.sphere_adjoint import SPHERE_COLUMNS
from ...wavefront.reference_sphere import plane_distance_derivatives, sphere_distance_derivatives

#: Kinds of parameters that change the index of a medium.
_MEDIA = ("index", "abbe")


@dataclass(frozen=True)
class ParameterColumns:
    """Columns of the adjoint matrix for a set of parameters, and their weights.

    Derivatives are taken at `telescope`, with all changes applied. `table` (numbers of the columns) and `polynomials`
    (surface, scale, degree and columns of polynomial shape terms) are arguments of
    :func:`~pachon.raytrace.adjoint.backward_pass.backward_pass`; each of `other_terms` (surface, name) has a column of
    its own behind all others. `intermediate` columns come first, then those of a sphere, then all with `weights`.
    """

    telescope: Telescope
    parameters: tuple[Parameter, ...]
    table: np.ndarray  #: [n_surface + 1, 13] int
    polynomials: tuple[tuple[int, float, int, np.ndarray], ...]
    other_terms: tuple[tuple[int, str], ...]
    intermediate: int
    #: [n_column, n_parameter] derivatives of the columns with respect to the parameters; see :meth:`weights_at`.
    weights: np.ndarray
    abbe_numbers: dict[int, float]  #: Abbe numbers by the places of their parameters
    #: [n_parameter, n] derivatives of the parameters, followers included, with respect to those that were given.
    chain: np.ndarray | None = None

    @classmethod
    def at(
        cls, telescope: Telescope, parameters: tuple[Parameter, ...], values: np.ndarray | None = None
    ) -> ParameterColumns:
        """Return the columns for derivatives at given changes of the parameters; at none by default."""
        values = np.zeros(len(parameters)) if values is None else values
        if has_links(telescope):
            links = linked(telescope, parameters, values)
            columns = cls._alone(telescope, links.parameters, links.values)
            return replace(columns, chain=links.chain)
        return cls._alone(telescope, parameters, values)

    @classmethod
    def _alone(cls, telescope: Telescope, parameters: tuple[Parameter, ...], values: np.ndarray) -> ParameterColumns:
        """Return the columns of parameters that nothing follows, or with all of their followers among them."""
        telescope = without_links(telescope)
        moved = apply(telescope, dict(zip(parameters, values, strict=True)))
        names = telescope.surface_names
        shaped = [(p, names.index(q.target), q) for p, q in enumerate(parameters) if q.kind == "shape"]
        derivative_kinds = {(s, name) for _, s, _ in shaped for name in ("sag", "intersection")}
        intermediate = column_table(telescope, derivative_kinds)
        count = int(intermediate.max()) + 1
        first = count + SPHERE_COLUMNS

        # The effect of motions is that of the difference between the bodies on both sides of a gap.
        ends = np.zeros((len(parameters), 1, 6))
        motion = -np.diff(twists(telescope, parameters, values), axis=1, prepend=ends, append=ends)
        runs = {p: index_surfaces(telescope, q.target) for p, q in enumerate(parameters) if q.kind in _MEDIA}
        behind = {(s, "index") for run in runs.values() for s in run}
        before = {(s + 1, "index") for run in runs.values() for s in run if s + 1 < len(names)}
        ruled = [(p, names.index(q.target), q) for p, q in enumerate(parameters) if q.kind == "grating"]
        grooves = {(s, "grooves") for _, s, _ in ruled}
        gaps = {(int(g), "gap") for g in np.flatnonzero(motion.any(axis=(0, 2)))}
        direct = column_table(telescope, behind | before | gaps | grooves, first)
        table = np.maximum(intermediate, direct)

        # Rays need only terms that are not zero; derivatives need all terms of the parameters.
        shapes = shapes_with_terms(moved, parameters)
        used = max(first, int(direct.max()) + 1)
        terms: dict[int, dict[int, PolarPolynomial]] = {}
        added_terms: list[tuple[int, int, str]] = []
        for p, s, parameter in shaped:
            polynomial = term_polynomial(shapes[parameter.target], parameter.name)
            if polynomial is None:
                added_terms.append((p, s, parameter.name))
            else:
                terms.setdefault(s, {})[p] = polynomial
        blocks = []
        for s, surface_terms in terms.items():
            # The length unit of the polynomials over a surface is its outer radius, or that of the pupil.
            aperture = telescope.surfaces[s].aperture
            outer = getattr(aperture, "outer", getattr(aperture, "radius", None))
            scale = float(outer) if outer else 0.5 * telescope.pupil_diameter
            degree, weights = _polynomial_weights(surface_terms, len(parameters), scale)
            present = weights.any(axis=1)
            columns = np.where(present, used + np.cumsum(present) - 1, -1).astype(np.int32)
            blocks.append((s, scale, degree, columns, weights[present]))
            used += int(present.sum())

        total = np.zeros((used + len(added_terms), len(parameters)))
        for g in np.flatnonzero(motion.any(axis=(0, 2))):
            total[table[g, 7:13]] = motion[:, g].T
        for p, run in runs.items():
            total[table[run, 4], p] = 1.0
            total[[table[s + 1, 3] for s in run if s + 1 < len(names)], p] = 1.0
        for p, s, parameter in ruled:
            total[table[s, 13:15], p] = grating_of(moved, parameter).path_derivative(parameter.name)
        for *_, columns, weights in blocks:
            total[columns[columns >= 0]] = weights
        for i, (p, _, _) in enumerate(added_terms):
            total[used + i, p] = 1.0
        listed = tuple(block[:4] for block in blocks)
        numbers = {p: q.value(telescope) + values[p] for p, q in enumerate(parameters) if q.kind == "abbe"}
        other_terms = tuple((s, name) for _, s, name in added_terms)
        return cls(moved, parameters, table, listed, other_terms, count, total[first:], numbers)

    def leading(self, front: Telescope, wavelength: float) -> ParameterColumns:
        """Return the columns of the first surfaces alone, those of a telescope `front`, for one wavelength [m].

        Derivatives are those of landing points in the frame of its last surface.
        """
        count, first = len(front.surfaces), self.intermediate + SPHERE_COLUMNS
        table = self.table[: count + 1].copy()
        table[count] = -1
        polynomials = [block for block in self.polynomials if block[0] < count]
        column_numbers = np.unique(np.concatenate([table.ravel(), *(columns for *_, columns in polynomials)]))
        early = column_numbers[(column_numbers >= 0) & (column_numbers < self.intermediate)]
        late = column_numbers[column_numbers >= first]
        # Numbers -1, for none, stand at the end.
        number = np.full(max(int(column_numbers[-1]), 0) + 2, -1, dtype=np.int32)
        number[early] = np.arange(len(early))
        number[late] = len(early) + SPHERE_COLUMNS + np.arange(len(late))
        front_terms = [i for i, (s, _) in enumerate(self.other_terms) if s < count]
        direct = len(self.weights) - len(self.other_terms)
        rows = [*(late - first), *(direct + i for i in front_terms)]
        shaped = tuple(p for p in self.parameters if p.kind == "shape" and p.target in front.surface_names)
        return ParameterColumns(
            front,
            shaped,
            number[table],
            tuple((s, scale, degree, number[columns]) for s, scale, degree, columns in polynomials),
            tuple(self.other_terms[i] for i in front_terms),
            len(early),
            self.weights_at(wavelength)[rows],
            {},
        )

    def weights_at(self, wavelength: float) -> np.ndarray:
        """Return the weights of the columns at a wavelength [m]; dispersion changes indices by amounts of its own."""
        weights = self._weights_at(wavelength)
        return weights if self.chain is None else weights @ self.chain

    def _weights_at(self, wavelength: float) -> np.ndarray:
        if not self.abbe_numbers:
            return self.weights
        factors = np.ones(len(self.parameters))
        for p, number in self.abbe_numbers.items():
            place = index_surfaces(self.telescope, self.parameters[p].target)[0]
            medium = self.telescope.surfaces[place].medium_after
            # n = n_d + V_0 / V (n_0 - n_d).
            factors[p] = -float(medium.index(wavelength) - medium.index(LINE_D * 1e-6)) / number
        return self.weights * factors

    def adjoints(self, forward: ForwardPass, gradient: OutputGradient, *, threads: int | None = None) -> np.ndarray:
        """Return the weighted columns of the adjoint matrix of a forward pass, shape [n_output, n_column, n]."""
        matrix = backward_pass(forward, gradient, self.table, polynomials=self.polynomials, threads=threads)
        return self._with_other_terms(matrix, self.intermediate + SPHERE_COLUMNS)

    def of_path(self, matrix: AdjointMatrix) -> np.ndarray:
        """Return the columns of optical paths to reference spheres, shape [n_column, n_field, n_pupil].

        The first four, without weights, are the path and its derivatives with respect to the landing point.
        """
        return self._with_other_terms(matrix, self.intermediate)[0]

    def _with_other_terms(self, matrix: AdjointMatrix, first: int) -> np.ndarray:
        """Return the columns from a first one on, and those of shape terms that are not polynomials."""
        values = matrix.values[:, first:]
        if not self.other_terms:
            return values
        shapes, names = shapes_with_terms(self.telescope, self.parameters), self.telescope.surface_names
        extra = np.empty((len(values), len(self.other_terms), *values.shape[2:]))
        for i, (s, name) in enumerate(self.other_terms):
            f, fx, fy = shapes[names[s]].sag_derivative(name, *matrix.intersection(s))
            sag = matrix.sag(s)
            extra[:, i] = sag[:, 0] * f + sag[:, 1] * fx + sag[:, 2] * fy
        return np.concatenate([values, extra], axis=1)

    def size_of_terms(
        self, forward: ForwardPass, gradient: OutputGradient, *, threads: int | None = None
    ) -> np.ndarray:
        """Return the size of the terms of the derivatives, rms over rays and outputs, shape [n_parameter].

        A derivative far below it is rounding, as the terms cancel. Rays that miss a surface do not count.
        """
        terms = np.abs(self.adjoints(forward, gradient, threads=threads)).transpose(0, 2, 1)
        terms = terms @ np.abs(self.weights_at(forward.wavelength))
        return np.sqrt(np.mean(terms[:, np.isfinite(terms).all(axis=(0, 2))] ** 2, axis=(0, 1)))

    def derivatives(self, forward: ForwardPass, gradient: OutputGradient, *, threads: int | None = None) -> np.ndarray:
        """Return the derivatives of every output and ray with respect to each parameter, [n_output, n, n_parameter]."""
        weights = self.weights_at(forward.wavelength)
        return np.matmul(self.adjoints(forward, gradient, threads=threads).transpose(0, 2, 1), weights)


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

    Centres of the spheres have shape [3, n] [m], telescope frame. The derivative of the path with respect to them is
    the opposite of that with respect to the position.
    """
    n = forward.indices[-2]
    distance, by_position, by_direction = sphere_distance_derivatives(
        forward.position, forward.direction, center, radius
    )
    gradient = OutputGradient(n * by_position[None], n * by_direction[None], np.ones(1), index=distance[None])
    return gradient, forward.path_length + n * distance


def plane_gradient(forward: ForwardPass, along: np.ndarray) -> tuple[OutputGradient, np.ndarray, np.ndarray]:
    """Return the gradient of the optical path to planes across directions, one output; the path; its derivatives.

    The planes go through the vertex of the last surface. The directions and the derivatives of the path with respect to
    them have shape [3, n], telescope frame.
    """
    n, vertex = forward.indices[-2], np.array(forward.telescope.surfaces[-1].vertex)[:, None]
    distance, by_position, by_direction, by_along = plane_distance_derivatives(
        forward.position - vertex, forward.direction, along
    )
    gradient = OutputGradient(n * by_position[None], n * by_direction[None], np.ones(1), index=distance[None])
    return gradient, forward.path_length + n * distance, n * by_along
