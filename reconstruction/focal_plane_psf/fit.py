r"""Joint fit of heights, alignment, seeing and the covariance of turbulence to the stars of one exposure.

Shapes y (e1, e2, ln size) of the stars are those of the optics at the height of the CCD, a Gaussian random field and
noise. About the last solution the optics are linear in the parameters, and the most probable change minimises

.. math:: \sum_k (r_k - A_k \delta)^T (K_k + N_k)^{-1} (r_k - A_k \delta) + (\beta + \delta)^T P^{-1} (\beta + \delta),

which is Gauss-Newton with the prior covariance P. Blocks of neighbouring stars are taken as independent, so that work
grows in proportion to the number of stars. Covariances of turbulence are fitted to the same residuals, with the
uncertain parameters marginalised.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg

from ...core.progress import Reporter
from ...core.threads import one_blas_thread
from ...models.camera.focal_plane import FocalPlane
from ...wavefront.aberration import ResidualWavefront
from ...wavefront.atmosphere.moment_covariance import ExposedAir
from ..gaussian_field import inverse_from_cholesky
from .covariance import Covariance, Places
from .heights import HeightPrior
from .kriging import map_on_threads
from .layer_covariance import LayerCovariance, in_order, shape_groups
from .layer_fit import LayerFit, LayerTheory, mean_products
from .likelihood import CovarianceFit, blocks_of, fit_covariance, log_likelihood
from .response import (
    LARGEST_HEIGHT,
    N_EXPOSURE,
    NOLL,
    ExposureResponse,
    Instrument,
    exposure_sigma,
    height_response,
    wavefront,
)

#: Covariances of turbulence: fitted exponentials of each shape; theory of layers with fitted winds, all shapes
#: together; the same with winds near those of the instrument's atmosphere.
Turbulence = Literal["exponential", "layers", "forecast"]
#: Names of the shape parameters.
SHAPES = ("e1", "e2", "ln size")
# Standard deviation of the wavefront coefficients of an aligned telescope [m].
_NO_WAVEFRONT = 1e-15
# Standard deviations of the part of the shapes that turbulence has in common for all stars. The mean size is the
# seeing, which is fitted.
_MEAN = (0.02, 0.02, 0.01)
# Stars of a block of the linear fit.
_BLOCK = 750
# Steps of Gauss-Newton and of the covariances, before the optics are evaluated again about the alignment found.
_STEPS = 2
# Rounds after these.
_ROUNDS = 3
# ... as long as a coefficient of the wavefront moved by more [m] since the optics were evaluated.
_MOVED = 50e-9
# Most times that a step is halved.
_HALVINGS = 6


@dataclass(frozen=True, eq=False)
class ShapeData:
    """Measured shapes of the stars of one exposure."""

    places: Places
    values: np.ndarray  #: e1, e2 and the logarithm of the size [rad], [n, 3]
    noise: np.ndarray  #: variances of their noise, [n, 3]

    def __len__(self) -> int:
        return len(self.values)

    def chosen(self, which: np.ndarray) -> ShapeData:
        """Return the shapes of some stars."""
        return ShapeData(self.places[which], self.values[which], self.noise[which])


@dataclass(frozen=True, eq=False)
class OpticsFit:
    """Optics of one exposure.

    Attributes
    ----------
    heights : ndarray, shape [n_height]
        Height parameters (:class:`.HeightPrior`).
    exposure : ndarray, shape [25]
        Wavefront coefficients [m] on the axis, along x and along y, and ln(r0 / r0 assumed).
    covariance : ndarray, shape [n_height + 25, n_height + 25]
        Covariance of all of these.
    plane : FocalPlane
        The heights.
    aberration : ResidualWavefront
        The residual wavefront.
    """

    heights: np.ndarray
    exposure: np.ndarray
    covariance: np.ndarray
    plane: FocalPlane
    aberration: ResidualWavefront

    @property
    def seeing(self) -> float:
        """Logarithm of the Fried parameter over the assumed one."""
        return float(self.exposure[-1])


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Quadratic approximation of an exposure's likelihood about parameters: ``matrix @ change = vector``."""

    matrix: np.ndarray
    vector: np.ndarray


class BlockEquations(NamedTuple):
    """Contribution of one block of stars to the normal equations."""

    used: np.ndarray  #: parameters that act on its stars, [m]
    matrix: np.ndarray  #: [m, m]
    vector: np.ndarray  #: [m]


def columns_acting_on(prior: HeightPrior, ccds: np.ndarray) -> np.ndarray:
    """Return the columns of the parameters that act on some CCDs: the common ones, those of each, the exposure's."""
    columns = np.arange(prior.n_parameter + N_EXPOSURE)
    ccd_columns = [columns[prior.columns_of(ccd)] for ccd in ccds]
    return np.concatenate([columns[: prior.n_common], *ccd_columns, columns[prior.n_parameter :]])


def _design_columns(terms: np.ndarray, slopes: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return derivatives of one shape: terms in the height times slopes [n], and the exposure's own columns [n, 25]."""
    design = terms * slopes[:, None]
    design[:, -N_EXPOSURE:] = columns
    return design


def _design_of_shapes(terms: np.ndarray, slopes: np.ndarray, columns: np.ndarray, shapes: slice) -> np.ndarray:
    """Return derivatives of some shapes, one after the other, of slopes [n, 3] and columns [n, 25, 3]."""
    return np.concatenate([_design_columns(terms, slopes[:, k], columns[..., k]) for k in range(3)[shapes]])


class ExposureFit:
    """Gauss-Newton fit of one exposure; :meth:`run` performs all steps."""

    def __init__(
        self,
        data: ShapeData,
        instrument: Instrument,
        prior: HeightPrior,
        alignment_rms: float,
        threads: int | None,
        reporter: Reporter,
    ) -> None:
        self.data = ShapeData(instrument.at_amplitudes(data.places, threads), data.values, data.noise)
        self.instrument, self.prior = instrument, prior
        self.threads, self.reporter = threads, reporter
        # A wavefront that is not to change keeps its place among the parameters.
        self.sigma = np.maximum(exposure_sigma(alignment_rms), _NO_WAVEFRONT)
        self.fields = instrument.fields(data.places.xy, threads)
        self.flat = FocalPlane.flat(prior.camera)
        self.common = prior.common_terms(data.places)
        self.own = prior.ccd_polynomials(data.places)
        self.blocks = blocks_of(data.places.xy, _BLOCK)
        self.heights = np.zeros(prior.n_parameter)
        self.exposure = np.zeros(N_EXPOSURE)
        self._center = float(np.mean(prior.heights(self.heights, data.places)))
        self.covariances: Sequence[Covariance | LayerCovariance] = []
        self.at_bounds: tuple[str, ...] = ()
        self.covariance: np.ndarray | None = None
        #: Covariance of the heights of each CCD in its own terms, in place of `covariance`, [n_ccd, n_term, n_term].
        self.ccd_covariance: np.ndarray | None = None
        self._exposure_covariance = np.zeros((N_EXPOSURE, N_EXPOSURE))
        self._log_determinant = 0.0
        self._response: ExposureResponse | None = None

    @property
    def response(self) -> ExposureResponse:
        """Derivatives with respect to the parameters of the exposure."""
        assert self._response is not None
        return self._response

    def derivatives(self) -> tuple[np.ndarray, np.ndarray]:
        """Return slopes with height [n, 3], and columns of the exposure's parameters [n, 25, 3], at the stars."""
        _, slopes, columns = self._columns()
        return slopes, columns

    def linearise(self) -> None:
        """Evaluate the optics about the parameters of the exposure."""
        aberration = self._aberration
        seeing = float(self.exposure[-1])
        repetition = ", again" if self._response is not None else ""
        with self.reporter.stage(f"optics at the stars{repetition}", total=5 * len(self.data)) as stage:
            self.optics = height_response(
                self.instrument,
                self.fields,
                self.flat,
                aberration,
                seeing,
                self.threads,
                stage.advance,
                center=self._center,
            )
        with self.reporter.stage(f"response to alignment and seeing{repetition}"):
            self._response = ExposureResponse.of(
                self.instrument, self.fields, self.flat, aberration, seeing, self.threads, center=self._center
            )
        self._central_columns = self._response.columns(self.fields, np.full(len(self.fields), self._center))
        self._column_slopes = self._response.height_slopes(self.fields)
        self._base = self.exposure.copy()

    def solve_exposure(self) -> list[BlockEquations]:
        """Take one step in the parameters of the exposure alone; return the equations of blocks about the result."""
        blocks = self.block_equations()
        matrix, vector = np.diag(self.sigma**-2), -(self.sigma**-2) * self.exposure
        # The parameters of the exposure act on every star, and are the last of every block.
        for block in blocks:
            matrix += block.matrix[-N_EXPOSURE:, -N_EXPOSURE:]
            vector += block.vector[-N_EXPOSURE:]
        scale = 1.0 / np.sqrt(np.diagonal(matrix))
        self._exposure_covariance = np.linalg.inv(matrix * scale[:, None] * scale) * scale[:, None] * scale
        change = self._exposure_covariance @ vector
        self.exposure = self.exposure + change
        # The model is linear in them.
        return [b._replace(vector=b.vector - b.matrix[:, -N_EXPOSURE:] @ change) for b in blocks]

    @property
    def _aberration(self) -> ResidualWavefront:
        return wavefront(self.instrument.telescope, self.exposure[:-1].reshape(3, -1), self._radius)

    @property
    def _radius(self) -> float:
        return float(np.hypot(*self.fields.T).max()) or self.instrument.telescope.field_radius

    def _columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals, slopes with height [n, 3] and columns of the exposure [n, 25, 3] at the parameters."""
        heights = self.prior.heights(self.heights, self.data.places)
        heights = np.clip(heights, self._center - LARGEST_HEIGHT, self._center + LARGEST_HEIGHT)
        columns = self._central_columns + (heights - self._center)[:, None, None] * self._column_slopes
        change = self.exposure - self._base
        shapes = self.optics.at(heights) + np.einsum("npf,p->nf", columns, change)
        slopes = self.optics.slope(heights) + np.einsum("npf,p->nf", self._column_slopes, change)
        return self.data.values - shapes, slopes, columns

    def fit_covariances(self, max_iterations: int = 8) -> None:
        """Fit the covariances of turbulence to the residuals of the optics, with their uncertainty (one step of EM)."""
        residuals, slopes, columns = self._columns()
        covariances = [c for c in self.covariances if isinstance(c, Covariance)]

        def fit(shape: int) -> CovarianceFit:
            def spread(index: np.ndarray) -> np.ndarray:
                used, terms = self._terms(index)
                design = _design_columns(terms, slopes[index, shape], columns[index, :, shape])
                return design @ self._covariance_of(used, index) @ design.T

            return fit_covariance(
                self.data.places,
                residuals[:, shape],
                self.data.noise[:, shape],
                spread=None if self.covariance is None and self.ccd_covariance is None else spread,
                start=covariances[shape] if covariances else None,
                constant=_MEAN[shape] ** 2,
                max_iterations=max_iterations,
            )

        covariance_fits: list[CovarianceFit] = map_on_threads(fit, range(3), self.threads)
        self.covariances = [f.covariance for f in covariance_fits]
        self.at_bounds = tuple(f"{n} of {SHAPES[i]}" for i, f in enumerate(covariance_fits) for n in f.at_bounds)

    def fit_layers(self, forecast: bool = False) -> None:
        """Take the covariance from the theory of layers in place of the fitted ones, and solve for all with it.

        Winds are searched in all directions, or with a forecast near those of the instrument's atmosphere.
        """
        instrument, telescope = self.instrument, self.instrument.telescope
        air = ExposedAir.of(instrument.atmosphere, telescope.pupil_diameter, telescope.pupil_obscuration)
        air = air._replace(r0=air.r0 * math.exp(float(self.exposure[-1])))
        response, jacobian = instrument.moment_response(self._aberration, float(self.exposure[-1]), self.threads)
        _, _, columns = self._columns()
        # The coefficients on the axis are those of a star.
        products = mean_products(columns[:, : len(NOLL)])
        theory = LayerTheory(response, jacobian, products, self.prior.camera, self.threads)
        layers = LayerFit(theory, air, self.data.places, np.square(_MEAN))
        with self.reporter.stage("winds of the layers", total=layers.evaluations(forecast)) as stage:
            self._observe(layers)
            covariance = layers.search(forecast, stage.advance)
        self.covariances = [covariance]
        # As large as those of one shape.
        self.blocks = blocks_of(self.data.places.xy, _BLOCK // 3)
        with self.reporter.stage("heights, alignment and layers"):
            self.solve(1)
            self._observe(layers)
            self.covariances = [layers.improve(covariance)]
            self.solve(1)

    def _observe(self, layers: LayerFit) -> None:
        """Give the residuals of the optics, with their uncertainty, to a fit of layers."""
        residuals, slopes, columns = self._columns()

        def spread(index: np.ndarray) -> np.ndarray:
            used, terms = self._terms(index)
            design = _design_of_shapes(terms, slopes[index], columns[index], slice(0, 3))
            assert self.covariance is not None
            covariance = self.covariance[np.ix_(used, used)]
            scale = np.sqrt(np.diagonal(covariance))
            values, vectors = np.linalg.eigh(covariance / scale[:, None] / scale)
            return design @ (scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))

        layers.observe(residuals, self.data.noise, spread)

    def _terms(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the parameters that act on some stars, and their terms in the height, zero for the exposure's own."""
        prior, star_places = self.prior, self.data.places[index]
        ccds, width = np.unique(star_places.ccd), self.own.shape[1]
        used = columns_acting_on(prior, ccds)
        terms = np.zeros((len(index), len(used)))
        terms[:, : prior.n_common] = self.common[index]
        for i, ccd in enumerate(ccds):
            rows = star_places.ccd == ccd
            first = prior.n_common + i * width
            terms[rows, first : first + width] = self.own[index][rows]
        return used, terms

    def _covariance_of(self, used: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Return the covariance of the parameters that act on some stars."""
        if self.covariance is not None:
            return self.covariance[np.ix_(used, used)]
        assert self.ccd_covariance is not None
        ccds = np.unique(self.data.places.ccd[index])
        common = np.zeros((self.prior.n_common,) * 2)
        return scipy.linalg.block_diag(common, *self.ccd_covariance[ccds], self._exposure_covariance)

    def block_equations(self) -> list[BlockEquations]:
        """Return the normal equations of each block of stars in a change of the parameters, without priors."""
        residuals, slopes, columns = self._columns()

        def contribution(index: np.ndarray) -> BlockEquations:
            block_places = self.data.places[index]
            used, terms = self._terms(index)
            matrix, vector = np.zeros((len(used), len(used))), np.zeros(len(used))
            for shapes, covariance in shape_groups(self.covariances):
                design = _design_of_shapes(terms, slopes[index], columns[index], shapes)
                root = covariance.root(block_places, in_order(self.data.noise[index][:, shapes]))
                design_and_residuals = np.column_stack([design, in_order(residuals[index][:, shapes])])
                white = scipy.linalg.solve_triangular(root, design_and_residuals, lower=True, check_finite=False)
                matrix += white[:, :-1].T @ white[:, :-1]
                vector += white[:, :-1].T @ white[:, -1]
            return BlockEquations(used, matrix, vector)

        return map_on_threads(contribution, self.blocks, self.threads)

    def normal_equations(self) -> NormalEquations:
        """Return the normal equations of a change of all parameters, without priors."""
        size = self.prior.n_parameter + N_EXPOSURE
        matrix, vector = np.zeros((size, size)), np.zeros(size)
        for block in self.block_equations():
            matrix[np.ix_(block.used, block.used)] += block.matrix
            vector[block.used] += block.vector
        return NormalEquations(matrix, vector)

    def solve(self, steps: int = 2) -> None:
        """Take Gauss-Newton steps, halved where the fit would get worse, and keep the covariance of the parameters."""
        n_height = self.prior.n_parameter
        precision = self._precision()
        # Heights of CCDs without stars stay where they are.
        ccds = np.unique(self.data.places.ccd)
        active = columns_acting_on(self.prior, ccds)
        within = np.ix_(active, active)
        parameters = np.concatenate([self.heights, self.exposure])
        before = self._objective(parameters, precision)
        for _ in range(steps):
            normal = self.normal_equations()
            right = (normal.vector - precision @ parameters)[active]
            matrix = (normal.matrix + precision)[within]
            # Parameters of metres and of pure numbers side by side: scale the matrix to a unit diagonal.
            scale = 1.0 / np.sqrt(np.diagonal(matrix))
            with one_blas_thread():
                root = scipy.linalg.cholesky(matrix * scale[:, None] * scale, lower=True, overwrite_a=True)
                step = np.zeros_like(parameters)
                step[active] = scale * scipy.linalg.cho_solve((root, True), scale * right)
            for halved in range(_HALVINGS):
                trial = parameters + 0.5**halved * step
                after = self._objective(trial, precision)
                if after <= before:
                    parameters, before = trial, after
                    break
            self.heights, self.exposure = parameters[:n_height], parameters[n_height:]
        self._log_determinant = 2.0 * float(np.log(np.diagonal(root)).sum() - np.log(scale).sum())
        with one_blas_thread():
            inverse = inverse_from_cholesky(root)
        self.covariance = np.zeros_like(precision)
        self.covariance[within] = inverse * scale[:, None] * scale
        silent = np.setdiff1d(np.arange(len(self.prior.camera)), ccds)
        for ccd in silent:
            columns = self.prior.columns_of(ccd)
            self.covariance[columns, columns] = self.prior.ccd[ccd]
        own_terms = [precision[c, c] for c in (self.prior.columns_of(ccd) for ccd in silent)]
        self._log_determinant += float(sum(np.linalg.slogdet(block)[1] for block in own_terms))

    def _objective(self, parameters: np.ndarray, precision: np.ndarray) -> float:
        """Return the objective function of the fit."""
        n = self.prior.n_parameter
        fitted_parameters = self.heights, self.exposure
        self.heights, self.exposure = parameters[:n], parameters[n:]
        residuals, _, _ = self._columns()
        self.heights, self.exposure = fitted_parameters

        def of_block(index: np.ndarray) -> float:
            block_places = self.data.places[index]
            total = 0.0
            for shapes, covariance in shape_groups(self.covariances):
                root = covariance.root(block_places, in_order(self.data.noise[index][:, shapes]))
                ordered = in_order(residuals[index][:, shapes])
                white = scipy.linalg.solve_triangular(root, ordered, lower=True, check_finite=False)
                total += float(white @ white)
            return total

        return sum(map_on_threads(of_block, self.blocks, self.threads)) + float(parameters @ precision @ parameters)

    def _precision(self) -> np.ndarray:
        n_height = self.prior.n_parameter
        precision = np.zeros((n_height + N_EXPOSURE,) * 2)
        self.prior.add_to(precision)
        exposure_terms = range(n_height, len(precision))
        precision[exposure_terms, exposure_terms] += self.sigma**-2
        return precision

    def log_evidence(self) -> float:
        """Return the logarithm of the likelihood of the stars, all parameters of the optics marginalised (Laplace)."""
        residuals, _, _ = self._columns()
        parameters = np.concatenate([self.heights, self.exposure])
        precision = self._precision()
        scale = 1.0 / np.sqrt(np.diagonal(precision))
        _, log_prior = np.linalg.slogdet(precision * scale[:, None] * scale)
        log_prior -= 2.0 * float(np.log(scale).sum())
        total = 0.5 * (log_prior - self._log_determinant - float(parameters @ precision @ parameters))
        for shapes, covariance in shape_groups(self.covariances):
            values, noise = residuals[:, shapes], self.data.noise[:, shapes]
            total += log_likelihood(covariance, self.data.places, values, noise, self.blocks)
        return total

    def run(self, turbulence: Turbulence = "exponential") -> OpticsFit:
        """Fit everything."""
        self.linearise()
        with self.reporter.stage("heights, alignment and turbulence"):
            self.fit_covariances(15)
            for _ in range(_STEPS):
                self.solve(1)
                self.fit_covariances()
        for number in range(_ROUNDS):
            moved = np.abs(self.exposure - self._base)[:-1].max() > _MOVED
            if number and not moved:
                break
            if moved:
                self.linearise()
            with self.reporter.stage("heights, alignment and turbulence, again"):
                self.solve(1)
                self.fit_covariances()
                self.solve(1)
        if turbulence != "exponential":
            self.fit_layers(turbulence == "forecast")
        assert self.covariance is not None
        return OpticsFit(
            self.heights,
            self.exposure,
            self.covariance,
            self.prior.focal_plane(self.heights),
            self._aberration,
        )
