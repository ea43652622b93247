r"""Wavelets: the plane waves, one for each ray, whose sum is the light on the detector.

Near the image a ray stands for a plane wave. At the point X of the detector, relative to a reference point C, their sum
is the field

.. math:: U(X) = \frac{1}{\lambda} \sum_k a_k \, e^{-i k w_k} \, e^{i k X \cdot c_k},

with the optical path difference :math:`w_k` at C (path of the chief ray minus path of the ray), and the direction
cosines :math:`c_k` of the ray along the detector, relative to the chief ray and times the refractive index. The sum is
exact as long as rays meet the detector within some millimetres of C. A ray that carries the fraction :math:`e_k` of the
light and fills the area :math:`\omega_k` of cosines has the amplitude :math:`a_k = \sqrt{e_k \omega_k}`; the integral
of :math:`|U|^2` over the detector is then the light that passes the pupil (Parseval).

Rays may pass through any points of the entrance pupil (Huygens), or be aimed so that their cosines lie on a square
lattice (Fourier). On the lattice the sampling of the cosines is exact: distortion, anamorphism and skew of the exit
pupil need no correction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...core.errors import DomainError
from ...core.units import field_label
from ...models.telescope import Telescope
from ...wavefront.bundles import Bundles
from ...wavefront.pupil_sampling import ring_annulus
from ...wavefront.request import Request
from ..metrics.principal_rays import PrincipalRays
from ..metrics.spots import SpotDiagram, holding_radius

#: Degree of the polynomials that start the search for aimed rays and give the Jacobian.
_DEGREE = 7
#: Rings of rays that those polynomials are fitted to.
_RINGS = 14
#: Largest deviation of vignetted rays from a linear map, in units of that of lit rays, for the fit to include them.
_ASTRAY = 2.0
#: Tolerance of the cosines in units of the lattice spacing; phases at the edge of the image are off by pi times that.
_AIM = 1e-4
_MOST_TRACES = 8
#: Parts of a cell along each axis where a rim crosses it, to find its lit fraction.
_PARTS = 6
#: Fraction of the light that images hold by default.
_HELD = 0.99
#: Reach of images by default, over the radius that holds that fraction.
_BEYOND = 1.1
#: Range of cosines along one axis over that along the other which is rounding.
_ROUNDING = 1e-9
#: Range of direction cosines below which there is no focus.
_PARALLEL = 1e-7
#: Step of the derivative of the cosines with respect to the pupil point, over the radius of the pupil.
_STEP = 1e-5


@dataclass(frozen=True)
class Wavelets:
    """Plane waves of the image of one field point at one wavelength, arrays of one shape."""

    cosine: np.ndarray  #: [..., 2] along the detector, relative to the chief ray, times the refractive index
    opd: np.ndarray  #: [...] path of the chief ray minus path of the ray at the reference point, m
    amplitude: np.ndarray  #: [...] a; zero where no light passes
    lit_fraction: float  #: of the entrance pupil
    wavelength: float  #: m, in vacuum

    @cached_property
    def field(self) -> np.ndarray:
        """Complex amplitude of each wavelet at the reference point, 1/wavelength included [1/m]."""
        return self.amplitude / self.wavelength * np.exp(-2j * np.pi / self.wavelength * self.opd)

    @property
    def perfect_peak(self) -> float:
        """Irradiance at the peak with all wavelets in phase, fraction of the entering light per area [1/m^2]."""
        return float((self.amplitude.sum() / self.wavelength) ** 2)


@dataclass(frozen=True)
class WaveletLattice:
    """Wavelets, shape [n, n], whose cosines lie on a square lattice: the second axis of the lattice first."""

    wavelets: Wavelets
    steps: np.ndarray  #: [n] cosines along either axis
    spacing: float


def traced_wavelets(request: Request, wavelength: float, center: np.ndarray) -> Wavelets:
    """Return the wavelets of the rays through the pupil points of a request for one field.

    The reference point `center` is x and y of the detector [m].
    """
    telescope, weights, points = request.telescope, request.pupil.weights, request.pupil.points
    step = _STEP * 0.5 * telescope.pupil_diameter
    beside = (points, points + np.array([step, 0.0]), points + np.array([0.0, step]))
    bundle = request.bundles(wavelength, np.concatenate(beside))
    opd, cosine = _at_reference(request, bundle, center)
    central, along_x, along_y = cosine.reshape(3, -1, 2)
    (xx, xy), (yx, yy) = (along_x - central).T, (along_y - central).T
    jacobian = np.abs(xx * yy - xy * yx) / step**2
    lit = bundle.lit[0, : len(points)] & np.isfinite(jacobian)
    annulus = 0.25 * np.pi * telescope.pupil_diameter**2 * (1.0 - telescope.pupil_obscuration**2)
    area = float(request.pupil_areas[0])
    amplitude = np.where(lit, weights * np.sqrt(area * annulus * jacobian), 0.0)
    return Wavelets(
        cosine=np.where(lit[:, None], central, 0.0),
        opd=np.where(lit, opd[: len(points)], 0.0),
        amplitude=amplitude,
        lit_fraction=area * float(weights[lit].sum()),
        wavelength=wavelength,
    )


def lattice_wavelets(
    request: Request, wavelength: float, center: np.ndarray, spacing: float, angle: float = 0.0
) -> WaveletLattice:
    """Return the wavelets of rays that are aimed at a square lattice of direction cosines on the detector.

    The request has one field. The reference point `center` is x and y of the detector [m]; the pattern repeats itself
    after wavelength / `spacing`; `angle` [rad] is that from the x axis of the detector to the first axis of the
    lattice. Cells that a rim crosses are traced with more rays, for their lit fraction; their amplitude is in
    proportion to it. A DomainError says that no light passes, or no ray has some of the directions: the map of the
    pupil to the image is not one to one.
    """
    telescope, radius = request.telescope, 0.5 * request.telescope.pupil_diameter
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    straight = angle == 0.0

    # Points of the plane of the entrance pupil: where rays are aimed, the stop has to be traced to, not to be hit.
    def rays(points: np.ndarray) -> tuple[Bundles, np.ndarray, np.ndarray]:
        bundle = request.bundles(wavelength, entrance=points)
        opd, cosine = _at_reference(request, bundle, center)
        return bundle, opd, cosine if straight else cosine @ rotation

    def lit_rays(bundle: Bundles, points: np.ndarray) -> np.ndarray:
        return bundle.lit[0] & _in_annulus(telescope, request.pupil_coordinates(wavelength, points))

    guess = _InverseMap(request, wavelength, rays)
    n = 2 * int(np.ceil(guess.reach / spacing)) + 3
    steps = (np.arange(n) - n // 2) * spacing
    targets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    start, slopes = guess.on_lattice(steps)
    start, slopes = start.reshape(-1, 4), slopes.reshape(-1, 4, 2)
    # A cell reaches half a spacing to all sides; beyond that the polynomials need not hold.
    margin = spacing * guess.metres_per_cosine
    near = np.flatnonzero(np.hypot(*start.T[2:]) <= radius + margin)
    targets, points = targets[near], start[near, :2]
    jacobian, by_cosine = slopes[near, :2], slopes[near, 2:]
    lit, opd = np.empty(len(points), dtype=bool), np.empty(len(points))
    pending = np.arange(len(points))
    for _ in range(_MOST_TRACES):
        bundle, opd[pending], cosine = rays(points[pending])
        lit[pending] = lit_rays(bundle, points[pending])
        off = targets[pending] - cosine
        finite = np.isfinite(off).all(axis=1)
        if not lit.any():
            raise DomainError(f"{field_label(request.fields[0])}: no light passes; expected a lit pupil")
        # Rays that are stopped need not be found, but may be lit where they should have been.
        away = finite & ~(np.abs(off) <= _AIM * spacing).all(axis=1)
        if not (away & lit[pending]).any():
            break
        pending, off = pending[away], off[away]
        points[pending] += np.einsum("nij,nj->ni", jacobian[pending], off)
    else:
        raise _not_one_to_one(request, "rays could not be aimed at all directions")
    cover = _coverage(lambda finer: lit_rays(rays(finer)[0], finer), points, jacobian, lit, near, n, spacing)
    cell = np.abs(np.linalg.det(by_cosine)) * spacing**2
    annulus = np.pi * radius**2 * (1.0 - telescope.pupil_obscuration**2)
    area = float(request.pupil_areas[0])
    energy = np.where(np.isfinite(opd), area * cell / annulus, 0.0)
    amplitude, path = np.zeros((2, n * n))
    amplitude[near] = cover * np.sqrt(energy) * spacing
    path[near] = np.where(np.isfinite(opd), opd, 0.0)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1) @ rotation.T
    # The lit fractions of cells on the rim are uncertain by a few per cent each; their sum may exceed the whole.
    lit_fraction = min(float((cover * energy).sum()), area)
    wavelets = Wavelets(grid, path.reshape(n, n), amplitude.reshape(n, n), lit_fraction, wavelength)
    return WaveletLattice(wavelets, steps, spacing)


def _not_one_to_one(request: Request, reason: str) -> DomainError:
    """Return the error of a field whose rays have not all directions around that of the chief ray."""
    return DomainError(
        f"{field_label(request.fields[0])}: {reason}; expected a pupil that the telescope maps one to one on its image "
        "(huygens_psf does without)"
    )


def range_of_cosines(principal: PrincipalRays) -> float:
    """Return the largest range of direction cosines across the pupil, 1 over the smallest focal ratio.

    DomainError where the light of a field is parallel.
    """
    ranges = (1.0 / principal.f_number).max(axis=1)
    largest_range = float(ranges.max())
    if not (ranges.min() > _PARALLEL and largest_range < np.inf):
        raise DomainError(
            f"{principal.telescope}: focal ratio above {1.0 / _PARALLEL:.0e}, the light is parallel; expected a focus"
        )
    return largest_range


def require_light(diagram: SpotDiagram) -> None:
    """Raise a DomainError where no light of a field passes."""
    lit = diagram.lit_fraction > 0
    if not lit.all():
        raise DomainError(f"{field_label(diagram.fields[~lit][0])}: no light passes; expected a lit pupil")


def spot_reach(diagram: SpotDiagram) -> float:
    """Return the radius that holds nearly all light of the largest of several spots [m]."""
    reach = 0.0
    for distance, weight in zip(np.linalg.norm(diagram.displacement, axis=-1), diagram.weight, strict=True):
        lit = weight > 0
        if lit.any():
            # A few stray rays may land anywhere; a lattice for all of them would have no end.
            reach = max(reach, holding_radius(distance[lit], weight[lit], _HELD))
    return _BEYOND * reach


#: Function that traces pupil points: bundles, path differences and cosines along the lattice.
_Trace = Callable[[np.ndarray], tuple[Bundles, np.ndarray, np.ndarray]]


class _InverseMap:
    """Polynomials for the point of the entrance pupil whose ray has given cosines: in its plane, and as aimed."""

    def __init__(self, request: Request, wavelength: float, rays: _Trace) -> None:
        telescope = request.telescope
        radius = 0.5 * telescope.pupil_diameter
        # The outermost ring stands a little beyond the rim, so that nothing has to be extrapolated.
        points = ring_annulus(1.05 * radius, 0.9 * telescope.pupil_obscuration, _RINGS).points
        entrance = request.entrance_points(wavelength, points).reshape(-1, 2)
        bundle, _, cosine = rays(entrance)
        lit = bundle.lit[0] & np.isfinite(cosine[:, 0])
        if lit.sum() < 3:
            raise DomainError(f"{telescope.name}: {int(lit.sum())} of {len(lit)} rays arrive; expected a lit pupil")
        # Vignetted rays may go astray and spoil the polynomials where light passes.
        linear = np.column_stack([np.ones(len(cosine)), cosine])
        slope = np.linalg.lstsq(linear[lit], points[lit], rcond=None)[0]
        off = np.linalg.norm(linear @ slope - points, axis=-1)
        usable = off <= max(_ASTRAY * float(off[lit].max()), 0.01 * radius)
        terms = (_DEGREE + 1) * (_DEGREE + 2) // 2
        if usable.sum() < 2 * terms:
            raise DomainError(
                f"{telescope.name}: {int(usable.sum())} of {len(usable)} rays arrive; expected most of them"
            )
        values, cosine = np.concatenate([entrance, points], axis=1)[usable], cosine[usable]
        # Behind a cylinder all directions lie in one plane, and no search would find others.
        largest, smallest = np.linalg.svd(cosine, compute_uv=False)
        if not smallest > _ROUNDING * largest:
            raise _not_one_to_one(request, "all rays have directions in one plane")
        self.reach = float(np.abs(cosine).max())
        first, second = (self._powers(cosine[:, axis]) for axis in (0, 1))
        i, j = np.nonzero(np.add.outer(np.arange(_DEGREE + 1), np.arange(_DEGREE + 1)) <= _DEGREE)
        self._coefficients = np.zeros((_DEGREE + 1, _DEGREE + 1, 4))
        self._coefficients[i, j] = np.linalg.lstsq(first[:, i] * second[:, j], values, rcond=None)[0]
        #: Change of the pupil point with the cosines, about [m].
        self.metres_per_cosine = float(np.linalg.norm(slope[1:], 2))

    def on_lattice(self, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points of the entrance pupil [m] for a lattice of cosines, and their derivatives by the cosines [m].

        Shapes are [n, n, 4] and [n, n, 4, 2], the second axis of the lattice first: points of the plane of the entrance
        pupil, and the pupil points that are aimed there.
        """
        plain, derived = self._powers(steps), self._powers(steps, derivative=True)
        slopes = [self._on_lattice(derived, plain), self._on_lattice(plain, derived)]
        return self._on_lattice(plain, plain), np.stack(slopes, axis=-1)

    def _on_lattice(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.stack([second @ self._coefficients[..., k].T @ first.T for k in range(4)], axis=-1)

    def _powers(self, cosine: np.ndarray, *, derivative: bool = False) -> np.ndarray:
        """Return powers of cosines over their reach, from the zeroth, or their derivatives by the cosines."""
        powers = np.vander(cosine / self.reach, _DEGREE + 1, increasing=True)
        if not derivative:
            return powers
        return np.arange(_DEGREE + 1) / self.reach * np.pad(powers, ((0, 0), (1, 0)))[:, :-1]


def _coverage(
    is_lit: Callable[[np.ndarray], np.ndarray],
    points: np.ndarray,
    jacobian: np.ndarray,
    lit: np.ndarray,
    near: np.ndarray,
    n: int,
    spacing: float,
) -> np.ndarray:
    """Return the lit fraction of each cell, from more rays where neighbours differ."""
    lit_cells = np.zeros(n * n, dtype=np.int8)
    lit_cells[near] = lit
    square = np.pad(lit_cells.reshape(n, n), 1)
    shifts = [square[1 + i : n + 1 + i, 1 + j : n + 1 + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    mixed = (np.minimum.reduce(shifts) != np.maximum.reduce(shifts)).ravel()[near]
    cover = lit.astype(np.float64)
    if not mixed.any():
        return cover
    parts = ((np.arange(_PARTS) + 0.5) / _PARTS - 0.5) * spacing
    inside = np.stack(np.meshgrid(parts, parts), axis=-1).reshape(-1, 2)
    finer = points[mixed][:, None] + np.einsum("nij,pj->npi", jacobian[mixed], inside)
    cover[mixed] = is_lit(finer.reshape(-1, 2)).reshape(-1, _PARTS**2).mean(axis=1)
    return cover


def _at_reference(request: Request, bundle: Bundles, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return path differences [m] at a point of the detector, shape [n], and cosines along it there, shape [n, 2]."""
    if bundle.afocal:
        return _far_away(bundle, center)
    shape, plane = request.telescope.surfaces[-1].shape, request.focal_plane
    height, slopes = shape.sag(*center), np.array(shape.gradient(*center), dtype=np.float64)
    if plane is not None and plane.ccd_at(*center) >= 0:
        height, slopes = plane.height(*center), plane.gradient(*center)
    point, n = np.array([*center, float(height)]), bundle.index

    def path(length: np.ndarray, position: np.ndarray, direction: np.ndarray) -> np.ndarray:
        return length + n * np.einsum("...i,...i", point - position, direction)

    def along(direction: np.ndarray) -> np.ndarray:
        return n * (direction[..., :2] + slopes * direction[..., 2:])

    chief = path(bundle.chief_path, bundle.chief_position, bundle.chief_direction)
    opd = chief[0] - path(bundle.path[0], bundle.position[0], bundle.direction[0])
    return opd, along(bundle.direction[0]) - along(bundle.chief_direction[0])


def _far_away(bundle: Bundles, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return path differences [m] in a direction of tangents `center`, and their derivatives by the tangents [m].

    They are those of Fraunhofer's diffraction at the plane of the detector, where rays of the optical path L stand at
    X: a plane across the unit vector a of the direction is at the path L - n X.a.
    """
    scale = 1.0 / np.sqrt(1.0 + center @ center)
    along = scale * np.array([*center, np.sign(bundle.chief_direction[0, 2])])
    reach, chief = bundle.position[0] @ along, bundle.chief_position[0] @ along
    opd = bundle.chief_path[0] - bundle.path[0] - bundle.index * (chief - reach)
    places = bundle.position[0, :, :2] - bundle.chief_position[0, :2]
    return opd, -bundle.index * (scale * places - scale**2 * np.multiply.outer(reach - chief, center))


def _in_annulus(telescope: Telescope, points: np.ndarray) -> np.ndarray:
    radius = 0.5 * telescope.pupil_diameter
    distance = np.hypot(points[:, 0], points[:, 1])
    return (distance <= radius) & (distance >= telescope.pupil_obscuration * radius)
