import numpy as np
import pytest

from pachon.core.errors import ConfigError, DomainError
from pachon.reconstruction.psf_model.polynomial import as_positions, design_matrix, term_count

EXTENT = (-3.0, 5.0, 10.0, 11.0)


@pytest.mark.parametrize("order", range(6))
def test_terms_span_the_monomials(order):
    rng = np.random.default_rng(order)
    points = np.stack([rng.uniform(-3.0, 5.0, 60), rng.uniform(10.0, 11.0, 60)], axis=1)
    terms = design_matrix(points, EXTENT, order)
    assert terms.shape == (60, term_count(order))
    u, v = (points[:, 0] - 1.0) / 4.0, (points[:, 1] - 10.5) / 0.5
    for a in range(order + 1):
        for b in range(order + 1 - a):
            wanted = u**a * v**b
            solution = np.linalg.lstsq(terms, wanted, rcond=None)[0]
            np.testing.assert_allclose(terms @ solution, wanted, atol=1e-13)
    assert np.linalg.cond(terms) < 60.0  # monomials of order 5 come to 200


def test_terms_are_legendre_products_by_degree():
    terms = design_matrix([[5.0, 10.75]], EXTENT, 2)[0]  # u = 1, v = 1/2
    p2 = 0.5 * (3 * 0.25 - 1)
    np.testing.assert_allclose(terms, [1.0, 1.0, 0.5, 1.0, 0.5, p2], atol=1e-15)


def test_bad_arguments():
    with pytest.raises(ConfigError, match="order = -1"):
        design_matrix([[0.0, 0.0]], EXTENT, -1)
    assert as_positions([1.0, 2.0]).shape == (1, 2)
    for bad in ([1.0, 2.0, 3.0], [[1.0], [2.0]], "x"):
        with pytest.raises(DomainError, match="positions"):
            as_positions(bad)
    with pytest.raises(DomainError, match=r"positions\[1\] is not finite"):
        as_positions([[0.0, 0.0], [np.inf, 0.0]])
