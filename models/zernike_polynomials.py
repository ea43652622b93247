"""Annular Zernike polynomials in Noll order, orthonormal over an annulus.

Mahajan (1981), J. Opt. Soc. Am. 71, 75: the radial polynomials for azimuthal order m are those of degree m, m + 2, ...
made orthogonal over eps <= rho <= 1. They are built here by a QR factorisation on Gauss-Legendre nodes, which is exact
for polynomials and needs no recursion; for eps = 0 they are Noll's (1976, J. Opt. Soc. Am. 66, 207).
"""

from __future__ import annotations

from functools import lru_cache
from math import comb

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.units import plane_points, require_count

#: Names of the first terms, as optical shops call them.
NOLL_NAMES = {
    1: "piston",
    2: "tilt x",
    3: "tilt y",
    4: "defocus",
    5: "astigmatism 45",
    6: "astigmatism 0",
    7: "coma y",
    8: "coma x",
    9: "trefoil y",
    10: "trefoil x",
    11: "spherical",
}


#: Largest Noll index of terms that are summed by monomials: of the eleventh radial degree.
_MOST_BY_MONOMIALS = 78
#: Largest Noll index.
MOST_TERMS = 10_000


def noll_to_nm(j: int) -> tuple[int, int]:
    """Return radial degree n and signed azimuthal order m of Noll index j (m < 0: sine)."""
    require_count(j, "Noll index", 1, MOST_TERMS)
    n = int((np.sqrt(8 * j - 7) - 1) / 2)
    k = j - n * (n + 1) // 2
    m = 2 * (k // 2) if n % 2 == 0 else 2 * ((k + 1) // 2) - 1
    return n, m if j % 2 == 0 else -m


@lru_cache(maxsize=64)
def _radial_coefficients(m: int, count: int, obscuration: float) -> np.ndarray:
    """Coefficients [count, count] of rho^m times powers of rho^2, unit mean square over the annulus (m = 0)."""
    # In s = rho^2 the annulus has the constant weight ds / (1 - eps^2); degree 2(count - 1) + m is exact.
    nodes, weights = np.polynomial.legendre.leggauss(count + m + 1)
    low = obscuration**2
    s = 0.5 * (1 - low) * nodes + 0.5 * (1 + low)
    root = np.sqrt(0.5 * weights)
    # Legendre polynomials over the interval keep the factorisation well conditioned for thin annuli.
    basis = np.polynomial.legendre.legvander(nodes, count - 1) * (s ** (m / 2))[:, None] * root[:, None]
    _, upper = np.linalg.qr(basis)
    signs = np.sign(np.diag(upper))
    return np.linalg.inv(upper * signs[:, None])


@check_arguments
def annular_zernikes(jmax: int, x: np.ndarray, y: np.ndarray, obscuration: float = 0.0) -> np.ndarray:
    """Evaluate annular Zernike polynomials 1 ... jmax, orthonormal over the annulus (mean square one).

    Parameters
    ----------
    jmax : int
        Highest Noll index.
    x, y : ndarray
        Pupil coordinates in units of the outer radius, one shape.
    obscuration : float
        Inner over outer radius, 0 <= obscuration < 1.

    Returns
    -------
    ndarray, shape [jmax, ...]
        NaN where a coordinate is NaN, or so large that its powers are.

    Raises
    ------
    DomainError
        If the obscuration or the index is out of range.
    """
    require_count(jmax, "jmax", 1, MOST_TERMS)
    x, y, s, nodes = _annulus(x, y, obscuration)
    theta = np.arctan2(y, x)
    orders = [noll_to_nm(j) for j in range(1, jmax + 1)]
    radial: dict[int, np.ndarray] = {}
    for m, top in _radial_degrees(orders).items():
        powers = np.polynomial.legendre.legvander(nodes, top) * (s ** (m / 2))[..., None]
        radial[m] = powers @ _radial_coefficients(m, top + 1, float(obscuration))
    angular = {m: np.cos(m * theta) if m > 0 else np.sin(-m * theta) for m in {m for _, m in orders} - {0}}
    out = np.empty((jmax, *x.shape))
    for row, (n, m) in enumerate(orders):
        r = radial[abs(m)][..., (n - abs(m)) // 2]
        out[row] = np.sqrt(2.0) * r * angular[m] if m else r
    return out


def annular_zernike_gradients(jmax: int, x: np.ndarray, y: np.ndarray, obscuration: float = 0.0) -> np.ndarray:
    """Return the derivatives along x and y, per outer radius, shape [jmax, 2, ...]; as :func:`annular_zernikes`.

    A term is a polynomial in ``x^2 + y^2`` times the real or imaginary part of ``(x + iy)^m``, and is differentiated as
    such: the result is exact, at the centre too.
    """
    x, y, _, nodes = _annulus(x, y, obscuration)
    orders = [noll_to_nm(j) for j in range(1, jmax + 1)]
    columns: dict[int, np.ndarray] = {}
    for m, top in _radial_degrees(orders).items():
        columns[m] = _radial_coefficients(m, top + 1, float(obscuration))
    z, scale_s = x + 1j * y, 4.0 / (1 - obscuration**2)
    # (x + iy)^m and its derivative along x, for all terms of one m; the one along y is i times that.
    powers = {m: (z**m, m * z ** max(m - 1, 0)) for m in columns}
    out = np.empty((jmax, 2, *x.shape))
    radial: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
    for row, (n, signed) in enumerate(orders):
        m = abs(signed)
        power, change = powers[m]
        if (n, m) not in radial:
            series = columns[m][:, (n - m) // 2]
            value = np.polynomial.legendre.legval(nodes, series)
            # d/dx = 2x d/ds and d/dy = 2y d/ds of the radial part
            slope = np.polynomial.legendre.legval(nodes, np.polynomial.legendre.legder(series)) * scale_s
            radial[n, m] = value * change + slope * x * power, 1j * value * change + slope * y * power
        scale = 1.0 if m == 0 else np.sqrt(2.0)
        for axis, derivative in enumerate(radial[n, m]):
            out[row, axis] = scale * (derivative.imag if signed < 0 else derivative.real)
    return out


def low_zernike_gradients(noll: np.ndarray, x: np.ndarray, y: np.ndarray, obscuration: float = 0.0) -> np.ndarray:
    """Return rows of :func:`annular_zernike_gradients` at points [n], to 1e-9 of them, in a tenth of the time.

    By monomials, which cancel in high terms: those of more than the eleventh radial degree come from there.
    """
    last = int(noll.max())
    if last > _MOST_BY_MONOMIALS:
        return annular_zernike_gradients(last, x, y, obscuration)[noll - 1]
    along = _gradient_monomials(last, float(obscuration))
    count = along.shape[-1]
    powers_x, powers_y = (np.vander(v, count, increasing=True).T for v in (x, y))
    p, q = np.array([(a, b) for a in range(count) for b in range(count - a)]).T
    # One product of matrices: one for each term takes several times as long.
    rows = along[noll - 1][..., p, q]
    return np.asarray(rows.reshape(-1, len(p)) @ (powers_x[p] * powers_y[q])).reshape(*rows.shape[:2], -1)


@lru_cache(maxsize=16)
def _gradient_monomials(jmax: int, obscuration: float) -> np.ndarray:
    """Return derivatives of Zernikes along x and y by monomials, [j - 1, axis, p, q] the coefficient of x^p y^q."""
    terms = zernike_monomials(jmax, obscuration)
    count = max(terms.shape[-1] - 1, 1)
    degrees = np.arange(1.0, count + 1.0)
    along_x = degrees[:, None] * terms[:, 1 : count + 1, :count]
    along_y = degrees * terms[:, :count, 1 : count + 1]
    return np.stack([along_x, along_y], axis=1)


@lru_cache(maxsize=256)
def radial_series(m: int, count: int, obscuration: float = 0.0) -> np.ndarray:
    """Return the first ``count`` radial polynomials of azimuthal order m >= 0 as powers of rho^2, shape [count, count].

    Element [k, i] is the coefficient of ``rho^(m + 2 k)`` of the polynomial of degree ``m + 2 i``.
    """
    if not 0 <= obscuration < 1:
        raise DomainError(f"obscuration = {obscuration!r}: expected 0 <= obscuration < 1")
    low = obscuration**2
    # Legendre polynomials of (2 rho^2 - 1 - low) / (1 - low), one a column, by powers of rho^2.
    node = np.polynomial.Polynomial([-(1 + low) / (1 - low), 2 / (1 - low)])
    powers = np.zeros((count, count))
    for degree in range(count):
        series = np.polynomial.legendre.leg2poly([0.0] * degree + [1.0])
        expanded = np.polynomial.Polynomial(series)(node)
        powers[: degree + 1, degree] = expanded.coef
    coefficients: np.ndarray = powers @ _radial_coefficients(m, count, float(obscuration))
    coefficients.flags.writeable = False
    return coefficients


def zernike_monomials(jmax: int, obscuration: float = 0.0) -> np.ndarray:
    """Return Zernikes 1 ... jmax as polynomials, element [j - 1, p, q] the coefficient of x^p y^q."""
    orders = [noll_to_nm(j) for j in range(1, jmax + 1)]
    degree = orders[-1][0]
    out = np.zeros((jmax, degree + 1, degree + 1))
    radial = {m: radial_series(m, top + 1, obscuration) for m, top in _radial_degrees(orders).items()}
    for row, (n, signed) in enumerate(orders):
        m = abs(signed)
        i = (n - m) // 2
        scale = np.sqrt(2.0) if m else 1.0
        for k, coefficient in enumerate(radial[m][: i + 1, i]):
            # (x^2 + y^2)^k times the real or imaginary part of (x + iy)^m
            for a in range(k + 1):
                for b in range(m + 1):
                    phase_factor = (1j**b).imag if signed < 0 else (1j**b).real
                    term = scale * coefficient * comb(k, a) * comb(m, b) * phase_factor
                    out[row, m - b + 2 * (k - a), b + 2 * a] += term
    return out


def _annulus(x: np.ndarray, y: np.ndarray, obscuration: float) -> tuple[np.ndarray, ...]:
    """Return x and y as arrays of one shape, s = x^2 + y^2, and s scaled to -1 ... 1 between the rims."""
    if not 0 <= obscuration < 1:
        raise DomainError(f"obscuration = {obscuration!r}: expected 0 <= obscuration < 1")
    x, y = plane_points(x, y)
    s, low = x * x + y * y, obscuration**2
    return x, y, s, (2 * s - 1 - low) / (1 - low)


def _radial_degrees(orders: list[tuple[int, int]]) -> dict[int, int]:
    """Return how many radial polynomials, less one, each azimuthal order |m| needs."""
    degrees: dict[int, int] = {}
    for n, m in orders:
        degrees[abs(m)] = max(degrees.get(abs(m), 0), (n - abs(m)) // 2)
    return degrees
