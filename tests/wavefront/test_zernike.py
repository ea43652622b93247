"""Annular Zernikes against Noll's and Mahajan's closed forms, quadrature and GalSim."""

import math

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.zernike_polynomials import annular_zernike_gradients, annular_zernikes, noll_to_nm
from pachon.wavefront.zernike import fit_zernikes

EPS = 0.612


def test_noll_order():
    expected = [
        (0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3), (4, 0), (4, 2), (4, -2),
        (4, 4), (4, -4), (5, 1), (5, -1), (5, 3), (5, -3), (5, 5), (5, -5), (6, 0),
    ]  # fmt: skip
    assert [noll_to_nm(j) for j in range(1, 23)] == expected


def test_noll_closed_forms():
    rng = np.random.default_rng(0)
    r, t = np.sqrt(rng.uniform(0, 1, 50)), rng.uniform(0, 2 * np.pi, 50)
    z = annular_zernikes(11, r * np.cos(t), r * np.sin(t))
    closed = [
        np.ones(50),
        2 * r * np.cos(t),
        2 * r * np.sin(t),
        np.sqrt(3) * (2 * r**2 - 1),
        np.sqrt(6) * r**2 * np.sin(2 * t),
        np.sqrt(6) * r**2 * np.cos(2 * t),
        np.sqrt(8) * (3 * r**3 - 2 * r) * np.sin(t),
        np.sqrt(8) * (3 * r**3 - 2 * r) * np.cos(t),
        np.sqrt(8) * r**3 * np.sin(3 * t),
        np.sqrt(8) * r**3 * np.cos(3 * t),
        np.sqrt(5) * (6 * r**4 - 6 * r**2 + 1),
    ]
    assert np.allclose(z, closed, atol=1e-13)


def test_mahajan_closed_forms():
    r = np.linspace(EPS, 1, 20)
    z = annular_zernikes(11, r, 0 * r, EPS)
    e2 = EPS**2
    assert np.allclose(z[1], 2 * r / np.sqrt(1 + e2), atol=1e-13)
    assert np.allclose(z[3], np.sqrt(3) * (2 * r**2 - 1 - e2) / (1 - e2), atol=1e-13)
    spherical = np.sqrt(5) * (6 * r**4 - 6 * (1 + e2) * r**2 + 1 + 4 * e2 + e2**2) / (1 - e2) ** 2
    assert np.allclose(z[10], spherical, atol=1e-12)


@pytest.mark.parametrize("eps", [0.0, 0.3, EPS, 0.95])
def test_orthonormal_over_the_annulus(eps):
    nodes, weights = np.polynomial.legendre.leggauss(24)
    r2 = 0.5 * (1 - eps**2) * nodes + 0.5 * (1 + eps**2)
    angle = np.arange(48) * 2 * np.pi / 48
    x, y = np.sqrt(r2)[:, None] * np.cos(angle), np.sqrt(r2)[:, None] * np.sin(angle)
    z = annular_zernikes(45, x, y, eps)
    gram = np.einsum("iab,jab,a->ij", z, z, weights / 2) / 48
    # Quadrature exact for these degrees; a thin annulus costs some digits.
    assert np.abs(gram - np.eye(45)).max() < 1e-10


def test_galsim():
    galsim = pytest.importorskip("galsim")
    basis = galsim.zernike.zernikeBasis(28, np.array([0.8, -0.7]), np.array([0.1, 0.4]), R_outer=1.0, R_inner=EPS)
    ours = annular_zernikes(28, np.array([0.8, -0.7]), np.array([0.1, 0.4]), EPS)
    assert np.allclose(ours, basis[1:], atol=1e-11)


def test_gradients_of_closed_forms():
    x, y = np.array([0.0, 0.8, -0.7, 0.1]), np.array([0.0, 0.1, 0.4, -0.9])
    gradient = annular_zernike_gradients(8, x, y)
    zero, one = 0 * x, 1 + 0 * x
    closed = [
        (zero, zero),
        (2 * one, zero),
        (zero, 2 * one),
        (4 * np.sqrt(3) * x, 4 * np.sqrt(3) * y),
        (2 * np.sqrt(6) * y, 2 * np.sqrt(6) * x),
        (2 * np.sqrt(6) * x, -2 * np.sqrt(6) * y),
        (6 * np.sqrt(8) * x * y, np.sqrt(8) * (3 * x**2 + 9 * y**2 - 2)),
        (np.sqrt(8) * (9 * x**2 + 3 * y**2 - 2), 6 * np.sqrt(8) * x * y),
    ]
    assert np.allclose(gradient, closed, atol=1e-13)


@pytest.mark.parametrize("eps", [0.0, EPS])
def test_gradients_of_galsim(eps):
    galsim = pytest.importorskip("galsim")
    x, y = np.random.default_rng(1).uniform(-0.7, 0.7, (2, 30))
    gradient = annular_zernike_gradients(37, x, y, eps)
    for j in range(1, 38):
        term = galsim.zernike.Zernike([0.0] * j + [1.0], R_outer=1.0, R_inner=eps)
        # Rounding in both, of slopes up to 100.
        assert np.allclose(gradient[j - 1], term.evalCartesianGrad(x, y), atol=1e-11)


def test_fit_recovers_planted_coefficients(lsst_r):
    opd = pachon.wavefront_opd(lsst_r, (0.0, 0.0), 620e-9, grid=40)
    planted = np.random.default_rng(3).normal(0, 1e-7, 22)
    value = np.where(opd.lit, np.tensordot(planted, annular_zernikes(22, opd.x / 4.18, opd.y / 4.18, EPS), 1), np.nan)
    fit = fit_zernikes(type(opd)(**(vars(opd) | {"value": value})), 4.18, EPS, jmax=22)
    assert np.allclose(fit.coefficients, planted, atol=1e-18)
    assert fit.residual_rms < 1e-18


def test_on_axis_the_lsst_has_rotational_terms_only(lsst_r):
    opd = pachon.wavefront_opd(lsst_r, (0.0, 0.0), 620e-9, grid=64)
    fit = fit_zernikes(opd, 4.18, EPS, jmax=28)
    # The grid is square: what the 28 terms leave over leaks into terms of four-fold symmetry, and no others.
    for j in range(1, 29):
        m = abs(noll_to_nm(j)[1])
        assert m == 0 or abs(fit.coefficients[j - 1]) < (fit.residual_rms if m == 4 else 1e-15)
    assert fit.residual_rms < 2e-9


@pytest.mark.parametrize("eps", [-0.1, 1.0])
def test_bad_obscuration(eps):
    for function in (annular_zernikes, annular_zernike_gradients):
        with pytest.raises(DomainError, match="obscuration"):
            function(4, 0.5, 0.5, eps)


def test_too_few_points(lsst_r):
    opd = pachon.wavefront_opd(lsst_r, (0.0, 0.0), 620e-9, grid=4)
    with pytest.raises(DomainError, match="jmax"):
        fit_zernikes(opd, 4.18, EPS, jmax=28)


def test_terms_that_vignetted_light_cannot_tell_apart_are_refused(lsst_r):
    """78 terms of a third of the pupil had coefficients of 2 mm."""
    opd = pachon.wavefront_opd(lsst_r, np.deg2rad([0.0, 2.0]), 620e-9, grid=64)
    with pytest.raises(DomainError, match=r"jmax = 78: terms cannot be told apart at the \d+ lit points"):
        fit_zernikes(opd, 4.18, EPS, jmax=78)


def test_fits_of_a_map_are_those_of_galsim(lsst_r):
    galsim = pytest.importorskip("galsim")
    opd = pachon.wavefront_opd(lsst_r, np.deg2rad([0.7, 0.9]), 620e-9, grid=64)
    fit = fit_zernikes(opd, 4.18, 0.612, jmax=28)
    basis = galsim.zernike.zernikeBasis(28, opd.x[opd.lit], opd.y[opd.lit], R_outer=4.18, R_inner=4.18 * 0.612)
    theirs = np.linalg.lstsq(basis.T, opd.waves[opd.lit], rcond=None)[0]
    # Both are least squares on the same points; GalSim's recursions for annuli keep some ten digits.
    assert np.abs(fit.coefficients / 620e-9 - theirs[1:]).max() < 1e-8


@pytest.mark.parametrize("radius", [0.0, -4.18, math.nan, math.inf, "wide", 4180.0, 4.18e-3])
def test_a_radius_that_is_not_the_pupils_is_refused_in_one_line(radius, capfd):
    opd = pachon.wavefront_opd(pachon.load_telescope("paul_baker"), field=(0.0, 0.0), wavelength=620e-9, grid=16)
    own = pachon.load_telescope("paul_baker").pupil_diameter / 2.0
    fit_zernikes(opd, own, 0.5, jmax=6)
    wrong = radius * own / 4.18 if isinstance(radius, float) else radius
    with pytest.raises(DomainError, match=r"^pupil_radius = ") as caught:
        fit_zernikes(opd, wrong, 0.5, jmax=6)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().out == ""
