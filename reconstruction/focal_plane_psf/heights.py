"""Heights of the CCDs as linear parameters with a prior: the whole focal plane, rafts, and each CCD's own shape.

The height at a place is the sum of a quadratic over the focal plane (five terms; its mean belongs to the focus of an
exposure), a piston of each raft, and products of Legendre polynomials in u and v of each CCD up to a total degree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from astropy.table import Table
from numpy.polynomial.legendre import legvander

from ...models.camera.camera import Camera
from ...models.camera.focal_plane import FocalPlane
from ...models.camera.height_budget import BudgetName, HeightBudget, load_budget
from .covariance import Places

#: Largest total degree within a CCD, for one exposure.
DEGREE = 4
#: ... and for many: of a potato chip of 1 to 2 cycles 6 leaves 0.3 um.
STATIC_DEGREE = 6
# Focal planes of a budget that are drawn at least to find the covariance of its terms.
_DRAWS = 8
# CCDs that are drawn at least: a camera of few needs more focal planes, or its 28 terms would have fewer draws.
_DRAWN_CCDS = 300
# Nodes along the side of a CCD at which drawn heights are projected and fitted heights are tabulated.
_NODES = 20
# Variance of a coefficient without a budget term [m^2], to keep the prior invertible: 1 nm.
_LEAST = 1e-18


@dataclass(frozen=True, eq=False)
class HeightPrior:
    """Prior of the height parameters, of mean `mean`.

    Parameters are ordered: five of the focal plane, one of each raft, then those of each CCD.

    Attributes
    ----------
    camera : Camera
        The camera.
    global_covariance : ndarray, shape [5, 5]
        Covariance of the coefficients [m] of x, y, x^2, xy, y^2, in units of the radius of the focal plane.
    raft : float
        Variance of the raft pistons [m^2].
    ccd : ndarray, shape [n_ccd, n_term, n_term]
        Covariance of the coefficients of each CCD [m^2].
    mean : FocalPlane or None
        Mean heights of the prior; None for zero, as of most cameras.
    """

    camera: Camera
    global_covariance: np.ndarray
    raft: float
    ccd: np.ndarray
    mean: FocalPlane | None = None

    @classmethod
    def from_budget(
        cls, camera: Camera, budget: BudgetName | HeightBudget = "simulated", degree: int = DEGREE
    ) -> HeightPrior:
        """Return the prior with the covariance of focal planes drawn from a budget of heights."""
        budget = load_budget(budget) if isinstance(budget, str) else budget
        unplaced = replace(camera, placement=None)
        # Seeds far from those that people choose, so that no run is fitted with its own heights.
        seeds = range(2**31, 2**31 + max(_DRAWS, -(-_DRAWN_CCDS // len(camera))))
        ccd = np.zeros((len(powers(degree)), len(powers(degree))))
        for term in ("ccd", "tilt", "potato_chip"):
            drawn = [FocalPlane.from_budget(unplaced, seed=s, terms=(term,), budget=budget) for s in seeds]
            rows = np.concatenate([project_heights(plane, degree) for plane in drawn])
            ccd += rows.T @ rows / len(rows)
        # The quadratic's coefficients are normal but for a scale; many more draws are needed than of CCDs.
        planes = [
            _quadratic_coefficients(FocalPlane.from_budget(unplaced, seed=s, terms=("global",), budget=budget))
            for s in range(2**31, 2**31 + 16 * _DRAWS)
        ]
        rows = np.array(planes)
        quadratic = rows.T @ rows / len(rows) + _LEAST * np.eye(5)
        ccd_covariances = np.broadcast_to(ccd + _LEAST * np.eye(len(ccd)), (len(camera), *ccd.shape))
        return cls(
            camera, quadratic, max(budget.raft_height**2 / 12.0, _LEAST), ccd_covariances, _nominal_heights(camera)
        )

    @classmethod
    def uninformative(cls, camera: Camera, size: float = 10e-6, degree: int = DEGREE) -> HeightPrior:
        """Return a weak prior of heights [m]: independent coefficients that decrease with the degree."""
        total = np.array([i + j for i, j in powers(degree)])
        ccd = np.diag((size / (1.0 + total) ** 2) ** 2)
        ccd_covariances = np.broadcast_to(ccd, (len(camera), *ccd.shape))
        return cls(camera, size**2 * np.eye(5), size**2, ccd_covariances, _nominal_heights(camera))

    @classmethod
    def known(cls, plane: FocalPlane, covariance: np.ndarray | None = None) -> HeightPrior:
        """Return the prior of known heights, with the covariance of each CCD's coefficients [n_ccd, n_term, n_term]."""
        k = len(powers(DEGREE)) if covariance is None else covariance.shape[1]
        ccd_covariances = np.zeros((len(plane.camera), k, k)) if covariance is None else covariance
        return cls(plane.camera, _LEAST * np.eye(5), _LEAST, ccd_covariances + _LEAST * np.eye(k), plane)

    @cached_property
    def precision(self) -> np.ndarray:
        """Inverse of the covariance of each CCD's coefficients [1/m^2], shape [n_ccd, n_term, n_term]."""
        return np.linalg.inv(self.ccd)

    @property
    def degree(self) -> int:
        """Largest total degree of the terms of a CCD."""
        return round((np.sqrt(8 * self.ccd.shape[1] + 1) - 3) / 2)

    def ccd_polynomials(self, places: Places) -> np.ndarray:
        """Return the polynomial terms of each position within its CCD, shape [n, n_term]."""
        return legendre(places.uv, self.degree)

    @property
    def n_common(self) -> int:
        """Number of parameters of the focal plane and the rafts."""
        return 5 + len(self.camera.raft_names)

    @property
    def n_parameter(self) -> int:
        """Number of parameters."""
        return self.n_common + len(self.camera) * self.ccd.shape[1]

    def columns_of(self, ccd: int) -> slice:
        """Return the columns of a CCD's own parameters."""
        first = self.n_common + ccd * self.ccd.shape[1]
        return slice(first, first + self.ccd.shape[1])

    def add_to(self, normal: np.ndarray) -> None:
        """Add the precision of the prior to a normal matrix whose first columns are the height parameters."""
        normal[:5, :5] += np.linalg.inv(self.global_covariance)
        for i in range(5, self.n_common):
            normal[i, i] += 1.0 / self.raft
        for ccd in range(len(self.camera)):
            columns = self.columns_of(ccd)
            normal[columns, columns] += self.precision[ccd]

    def common_terms(self, places: Places) -> np.ndarray:
        """Return the terms of the focal plane and the rafts at places, shape [n, n_common]."""
        rafts = (self.camera.raft_index[places.ccd][:, None] == np.arange(len(self.camera.raft_names))).astype(float)
        return np.concatenate([_quadratic_terms(self.camera, places.xy), rafts], axis=1)

    def covariance(self, places: Places) -> np.ndarray:
        """Return the prior covariance of the heights at places [m^2], shape [n, n]."""
        common, ccd_terms = self.common_terms(places), self.ccd_polynomials(places)
        total = common[:, :5] @ self.global_covariance @ common[:, :5].T
        total += self.raft * (common[:, 5:] @ common[:, 5:].T)
        for ccd in np.unique(places.ccd):
            rows = np.flatnonzero(places.ccd == ccd)
            total[np.ix_(rows, rows)] += ccd_terms[rows] @ self.ccd[ccd] @ ccd_terms[rows].T
        return total

    def per_ccd(self, covariance: np.ndarray) -> np.ndarray:
        """Return the covariance of each CCD's height in its own terms, of a covariance of all parameters.

        Quadratics over the focal plane and pistons of rafts are polynomials of a CCD too. Covariances between CCDs are
        left out.
        """
        nodes, weights = np.polynomial.legendre.leggauss(self.degree + 1)
        v, u = (a.ravel() for a in np.meshgrid(nodes, nodes, indexing="ij"))
        uv = np.stack([u, v], axis=1)
        terms = legendre(uv, self.degree)
        projection = terms.T * (np.outer(weights, weights).ravel() / 4.0)
        result = np.empty((len(self.camera), terms.shape[1], terms.shape[1]))
        for ccd in range(len(self.camera)):
            places = Places(self.camera.from_uv(ccd, uv), np.full(len(uv), ccd), uv)
            change = np.concatenate([projection @ self.common_terms(places), np.eye(terms.shape[1])], axis=1)
            columns = np.r_[: self.n_common, self.columns_of(ccd)]
            result[ccd] = change @ covariance[np.ix_(columns, columns)] @ change.T
        return result

    def heights(self, parameters: np.ndarray, places: Places) -> np.ndarray:
        """Return the heights at places [m], shape [n], mean of the prior included."""
        ccd_parameters = parameters[self.n_common :].reshape(len(self.camera), -1)
        change = self.common_terms(places) @ parameters[: self.n_common]
        change += np.einsum("nk,nk->n", self.ccd_polynomials(places), ccd_parameters[places.ccd])
        return change if self.mean is None else change + self.mean.height(*places.xy.T)

    def focal_plane(self, parameters: np.ndarray) -> FocalPlane:
        """Return the heights as a focal plane."""
        camera = self.camera
        axis = np.linspace(-1.0, 1.0, _NODES + 1) * (1.0 - 1e-9)
        v, u = np.meshgrid(axis, axis, indexing="ij")
        uv = np.stack([u.ravel(), v.ravel()], axis=1)
        ccd = np.repeat(np.arange(len(camera)), len(uv))
        tiled = np.tile(uv, (len(camera), 1))
        places = Places(camera.from_uv(ccd, tiled), ccd, tiled)
        x, y = places.xy.T
        return FocalPlane.from_heights(Table({"x": x, "y": y, "z": self.heights(parameters, places)}), camera)


def _nominal_heights(camera: Camera) -> FocalPlane | None:
    """Return the nominal heights of a camera; None where all are zero."""
    return None if camera.placement is None else FocalPlane.flat(camera)


def powers(degree: int) -> list[tuple[int, int]]:
    """Return the degrees in u and v of the terms of a CCD, by total degree."""
    return [(total - j, j) for total in range(degree + 1) for j in range(total + 1)]


def legendre(uv: np.ndarray, degree: int) -> np.ndarray:
    """Return the terms of a CCD at places [n, 2] in halves of its side, each of unit rms over it: [n, n_term]."""
    along = [legvander(uv[:, axis], degree) * np.sqrt(2.0 * np.arange(degree + 1) + 1.0) for axis in range(2)]
    return np.stack([along[0][:, i] * along[1][:, j] for i, j in powers(degree)], axis=1)


def project_heights(plane: FocalPlane, degree: int) -> np.ndarray:
    """Return the coefficients of each CCD that fit its heights best [m], shape [n_ccd, n_term]."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    v, u = (a.ravel() for a in np.meshgrid(nodes, nodes, indexing="ij"))
    terms = legendre(np.stack([u, v], axis=1), degree) * (np.outer(weights, weights).ravel()[:, None] / 4.0)
    inner = plane.camera.half_sizes[:, None] * np.stack([u, v], axis=1) * (1.0 - 1e-12)
    x, y = plane.camera.from_local(np.arange(len(plane.camera))[:, None], inner[..., 0], inner[..., 1])
    return plane.height(x, y) @ terms


def _quadratic_terms(camera: Camera, xy: np.ndarray) -> np.ndarray:
    x, y = (xy / camera.radius).T
    return np.stack([x, y, x * x, x * y, y * y], axis=1)


def _quadratic_coefficients(plane: FocalPlane) -> np.ndarray:
    """Return the five coefficients of a quadratic over the focal plane [m], its mean left out."""
    camera = plane.camera
    design = np.column_stack([np.ones(len(camera)), _quadratic_terms(camera, camera.centers)])
    return np.linalg.lstsq(design, plane.height(*camera.centers.T), rcond=None)[0][1:]
