from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from pachon.models.camera.cameras import load_camera
from pachon.models.camera.focal_plane import FocalPlane
from pachon.models.camera.height_budget import SIMULATED
from pachon.reconstruction.focal_plane_psf.covariance import Places
from pachon.reconstruction.focal_plane_psf.heights import DEGREE, HeightPrior, legendre, powers, project_heights

NM = 1e-9


def at(camera, ccd, uv):
    return Places(camera.centers[ccd] + camera.half_sizes[ccd] * uv, np.asarray(ccd), uv)


def random_places(camera, n, seed):
    rng = np.random.default_rng(seed)
    return at(camera, rng.integers(0, len(camera), n), rng.uniform(-0.999, 0.999, (n, 2)))


@pytest.mark.parametrize("degree", [0, 1, 4, 6])
def test_legendre_terms_are_orthonormal_over_the_ccd(degree):
    # Midpoint sums of 400 x 400 are good to their second-order error, degree^2 (2 degree + 1) / 400^2.
    axis = (np.arange(400) + 0.5) / 200.0 - 1.0
    u, v = (a.ravel() for a in np.meshgrid(axis, axis))
    terms = legendre(np.stack([u, v], axis=1), degree)
    assert terms.shape[1] == (degree + 1) * (degree + 2) // 2 == len(powers(degree))
    np.testing.assert_allclose(terms.T @ terms / len(u), np.eye(terms.shape[1]), atol=3e-3)
    # Products of polynomials are what Gauss and Legendre's nodes are exact for, unlike the midpoints.
    nodes, weights = np.polynomial.legendre.leggauss(degree + 1)
    u, v = (a.ravel() for a in np.meshgrid(nodes, nodes))
    area = np.outer(weights, weights).ravel() / 4.0
    terms = legendre(np.stack([u, v], axis=1), degree)
    np.testing.assert_allclose(terms.T @ (area[:, None] * terms), np.eye(terms.shape[1]), atol=1e-12)


def test_legendre_terms_are_in_the_order_of_their_powers():
    u, v = uv = np.array([0.3, -0.7])
    found = legendre(uv[None], 2)[0]
    second = lambda t: np.sqrt(5.0) * 0.5 * (3 * t * t - 1)  # noqa: E731
    expected = [1.0, np.sqrt(3.0) * u, np.sqrt(3.0) * v, second(u), 3.0 * u * v, second(v)]
    np.testing.assert_allclose(found, expected, rtol=1e-14)


@pytest.mark.slow
def test_the_prior_of_rafts_and_ccds_has_the_covariance_of_drawn_focal_planes(part):
    camera = part("R23", "R33")
    prior = HeightPrior.from_budget(camera)
    # Places that share a CCD, a raft, or neither.
    uv = np.array([[0.0, 0.0], [0.7, 0.2], [-0.6, 0.5], [0.0, 0.0], [0.4, -0.8], [0.0, 0.0], [-0.5, -0.5]])
    places = at(camera, np.array([0, 0, 0, 4, 4, 9, 17]), uv)
    draws, terms = 250, ("raft", "ccd", "tilt", "potato_chip")
    heights = np.array([FocalPlane.from_budget(camera, seed=s, terms=terms).height(*places.xy.T) for s in range(draws)])
    sample = heights.T @ heights / draws
    found = replace(prior, global_covariance=np.zeros((5, 5))).covariance(places)
    # A variance of normal numbers is known to sqrt(2 / 250) = 9 % from these draws and to sqrt(2 / 144) = 12 % from the
    # 8 x 18 CCDs of the prior's own; uniform pistons, most of the variance, to six tenths of that: 3 sigma are 27 %.
    variance = np.diagonal(sample)
    np.testing.assert_allclose(np.diagonal(found), variance, rtol=0.27)
    np.testing.assert_allclose(found, sample, atol=0.27 * variance.max())
    # The pistons of rafts: uniform, so the square of the peak to valley over 12; of CCDs so, known to 22 % at 3 sigma.
    assert prior.raft == pytest.approx(SIMULATED.raft_height**2 / 12.0)
    assert prior.ccd[0, 0, 0] == pytest.approx(SIMULATED.ccd_height**2 / 12.0, rel=0.22)


@pytest.mark.parametrize(
    "whole",
    [True, False],
)
@pytest.mark.slow
def test_the_prior_of_the_whole_plane_has_the_covariance_of_drawn_ones(part, whole):
    camera = load_camera("lsst") if whole else part("R23", "R33")
    prior = HeightPrior.from_budget(camera)
    scale = np.hypot(*camera.centers.T).max()

    def quadratic(xy):
        x, y = xy.T / scale
        return np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])

    corners = np.argsort(camera.centers @ [1.0, 0.3])[[0, len(camera) // 3, -1]]
    tops = np.argsort(camera.centers @ [-0.2, 1.0])[[0, len(camera) // 2, -1]]
    places = camera.centers[np.r_[corners, tops]]
    planes = [FocalPlane.from_budget(camera, seed=s, terms=("global",)) for s in range(400)]
    # The terms fit a quadratic exactly; its constant belongs to the focus of an exposure.
    own = np.linalg.pinv(quadratic(camera.centers))
    drawn = np.array([own @ p.height(*camera.centers.T) for p in planes])[:, 1:]
    heights = drawn @ quadratic(places)[:, 1:].T
    sample = heights.T @ heights / len(planes)
    terms = quadratic(places)[:, 1:]
    found = terms @ prior.global_covariance @ terms.T
    # The prior is of 128 draws, sqrt(2 / 128) = 12.5 % a variance these 400 add 7 %: 3 sigma are 43 %.
    variance = np.diagonal(sample)
    np.testing.assert_allclose(np.diagonal(found), variance, rtol=0.43)
    np.testing.assert_allclose(found, sample, atol=0.43 * variance.max())


def test_the_prior_of_a_budget_without_a_term_is_nothing_of_it(part):
    camera = part("R22")
    still = HeightPrior.from_budget(camera, replace(SIMULATED, raft_height=0.0, ccd_tilt=0.0, potato_chip=0.0), 2)
    assert still.raft <= NM**2 * 1.0001
    # Pistons of CCDs alone: what is left of the other terms is the nanometre that keeps the matrix invertible.
    np.testing.assert_allclose(still.ccd[3][1:, 1:], NM**2 * np.eye(5), rtol=1e-3, atol=1e-22)
    assert still.ccd[3][0, 0] > (1e-6) ** 2


@pytest.mark.parametrize("degree", [4, 6])
def test_projected_coefficients_are_a_polynomial_focal_plane(part, degree):
    camera = part("R22", "R34")
    rng = np.random.default_rng(3)
    coefficients = rng.normal(0.0, 3e-6, (len(camera), 10))
    powers_of = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
    flat = FocalPlane.flat(camera)
    plane = replace(flat, surfaces=replace(flat.surfaces, polynomial=coefficients.copy()))
    prior = HeightPrior.uninformative(camera, degree=degree)
    parameters = np.concatenate([np.zeros(prior.n_common), project_heights(plane, degree).ravel()])
    assert len(parameters) == prior.n_parameter
    places = random_places(camera, 300, 4)
    u, v = places.uv.T
    truth = sum(coefficients[places.ccd, i] * u**p * v**q for i, (p, q) in enumerate(powers_of))
    # A cubic is within the terms: the nodes stand 1e-12 of a half inside, heights of 10 um change by 1e-17 m.
    np.testing.assert_allclose(prior.heights(parameters, places), truth, atol=1e-6 * NM)


def test_common_parameters_are_a_quadratic_and_pistons_of_rafts(part):
    camera = part("R22", "R34")
    prior = HeightPrior.uninformative(camera)
    rng = np.random.default_rng(5)
    parameters = np.zeros(prior.n_parameter)
    parameters[: prior.n_common] = rng.normal(0.0, 3e-6, prior.n_common)
    a, b, c, d, e, *rafts = parameters[: prior.n_common]
    places = random_places(camera, 100, 6)
    x, y = places.xy.T / np.hypot(*camera.centers.T).max()
    raft = np.array([camera.ccd_names[k][:3] for k in places.ccd])
    truth = a * x + b * y + c * x * x + d * x * y + e * y * y
    truth = truth + np.where(raft == "R22", rafts[0], rafts[1])
    np.testing.assert_allclose(prior.heights(parameters, places), truth, atol=1e-9 * NM)
    # Heights of a mean come on top.
    mean = FocalPlane.from_budget(camera, seed=1)
    shifted = HeightPrior.known(mean)
    np.testing.assert_allclose(shifted.heights(parameters, places) - truth, mean.height(*places.xy.T), atol=1e-9 * NM)


def test_per_ccd_is_the_scatter_of_the_heights_of_each_ccd(part):
    camera = part("R22", "R34")
    prior = HeightPrior.uninformative(camera, degree=3)
    root = np.random.default_rng(7).normal(0.0, 1e-6, (prior.n_parameter, prior.n_parameter + 5))
    covariance = root @ root.T
    found = prior.per_ccd(covariance)
    nodes = np.linspace(-0.95, 0.95, 5)
    uv = np.stack([a.ravel() for a in np.meshgrid(nodes, nodes)], axis=1)
    assert found.shape == (len(camera), 10, 10)
    for ccd in (0, 8, 13):
        places = at(camera, np.full(len(uv), ccd), uv)
        # Each column of the root is a set of parameters; the heights of all of them are the transformation.
        heights = np.stack([prior.heights(column, places) for column in root.T], axis=1)
        terms = legendre(uv, 3)
        # Variances of 1e-9 m^2 at most: 1e-12 of them.
        expected = heights @ heights.T
        np.testing.assert_allclose(terms @ found[ccd] @ terms.T, expected, atol=1e-11 * np.abs(expected).max())


def test_a_normal_matrix_gets_the_precision_of_the_prior(part):
    camera = part("R22")
    prior = HeightPrior.from_budget(camera, degree=2)
    normal = np.zeros((prior.n_parameter + 2, prior.n_parameter + 2))
    prior.add_to(normal)
    assert not normal[prior.n_parameter :].any()
    places = random_places(camera, 30, 8)
    terms = np.zeros((30, prior.n_parameter))
    terms[:, : prior.n_common] = prior.common_terms(places)
    for row, ccd in enumerate(places.ccd):
        terms[row, prior.columns_of(ccd)] = prior.ccd_polynomials(places)[row]
    inverse = np.linalg.inv(normal[: prior.n_parameter, : prior.n_parameter])
    expected = terms @ inverse @ terms.T
    # Variances of 1e-18 to 1e-11 m^2 side by side: a condition of 1e7.
    np.testing.assert_allclose(prior.covariance(places), expected, atol=1e-8 * expected.max())


@pytest.mark.parametrize("mean", [False, True])
def test_the_focal_plane_has_the_heights_to_a_nanometre(part, mean):
    camera = part("R22", "R34")
    prior = HeightPrior.from_budget(camera)
    if mean:
        x, y = random_places(camera, 2000, 9).xy.T
        slope = Table({"x": x, "y": y, "z": 1e-6 + 1e-5 * x - 2e-5 * y})
        prior = replace(prior, mean=FocalPlane.from_heights(slope, camera))
    rng = np.random.default_rng(10)
    common = rng.normal(0.0, 1e-6, prior.n_common)
    own = rng.standard_normal((len(camera), prior.ccd.shape[1]))
    own = np.einsum("cij,cj->ci", np.linalg.cholesky(prior.ccd), own)
    parameters = np.concatenate([common, own.ravel()])
    places = random_places(camera, 500, 11)
    plane = prior.focal_plane(parameters)
    # A spline of fewer coefficients than nodes, held a little against bending: a nanometre of 10 um.
    np.testing.assert_allclose(plane.height(*places.xy.T), prior.heights(parameters, places), atol=3 * NM)
    assert plane.measured.all()


def test_degree_and_columns():
    camera = load_camera("lsst")
    prior = HeightPrior.uninformative(camera)
    assert prior.degree == DEGREE == 4
    assert prior.n_common == 5 + 21
    assert prior.columns_of(0) == slice(26, 41)
    assert prior.columns_of(188) == slice(prior.n_parameter - 15, prior.n_parameter)


def test_the_prior_of_one_ccd_has_no_terms_without_draws(part):
    """Of one CCD, such as AuxTel's, eight were drawn for its 28 terms: 20 combinations were held to a nanometre."""
    prior = HeightPrior.from_budget(part("R22", count=1), degree=6)
    assert np.linalg.eigvalsh(prior.ccd[0])[0] > 100.0 * 1e-18
