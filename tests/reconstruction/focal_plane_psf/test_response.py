import math

import numpy as np
import pytest
from numpy.polynomial.chebyshev import chebvander
from numpy.polynomial.polynomial import polyvander2d

from pachon.core.errors import DomainError
from pachon.design.metrics.vignetting import vignetting
from pachon.models.camera.focal_plane import FocalPlane
from pachon.models.camera.silicon import Silicon
from pachon.models.io.prescription import load_telescope
from pachon.reconstruction.focal_plane_psf import response
from pachon.reconstruction.focal_plane_psf.covariance import Places
from pachon.reconstruction.focal_plane_psf.height_series import HeightSeries, level_plane
from pachon.reconstruction.focal_plane_psf.response import (
    NOLL,
    ExposureResponse,
    Instrument,
    field_terms,
    height_response,
    wavefront,
)
from pachon.wavefront.aberration import ResidualWavefront
from pachon.wavefront.psf.light import Light
from pachon.wavefront.psf.psf import make_psfs
from pachon.wavefront.psf.stamps import Stamps

UM = 1e-6


@pytest.fixture(scope="module")
def instrument(lsst_r):
    return Instrument.of(lsst_r, [620e-9])


@pytest.fixture(scope="module")
def plane(part):
    return FocalPlane.flat(part("R22", "R23"))


def stars(plane, n, seed):
    rng = np.random.default_rng(seed)
    ccd = rng.integers(0, len(plane.camera), n)
    return plane.camera.centers[ccd] + (0.5 * plane.camera.shortest_side) * rng.uniform(-0.95, 0.95, (n, 2))


def test_turbulence_is_larger_where_vignetting_takes_light(instrument):
    xy = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.335], [-0.25, 0.25]])
    places = Places(xy, np.zeros(4, dtype=int), np.zeros((4, 2)))
    amplitude = instrument.at_amplitudes(places).amplitude
    lit = vignetting(instrument.telescope, instrument.fields(xy), 620e-9, n_pupil=20000).relative
    # Half-variograms through screens at 2', mean of five exposures: 1.08 times as large at 0.318 m, 1.36 at 0.335 m.
    assert (np.diff(amplitude[np.argsort(lit)]) < 0.0).all()
    assert amplitude[[0, 1]] == pytest.approx([1.0, 1.01], abs=0.01)
    assert amplitude[2] == pytest.approx(math.sqrt(1.36), abs=0.04)


@pytest.mark.long
def test_shapes_at_heights_are_those_of_the_engine(instrument, plane):
    fields = instrument.fields(stars(plane, 16, 1))
    found = height_response(instrument, fields, plane, None)
    worst = np.zeros((16, 3))
    for height in np.random.default_rng(2).uniform(-20.0, 20.0, 5) * UM:
        truth = instrument.shapes(fields, level_plane(plane, height), None)
        worst = np.maximum(worst, np.abs(found.at(np.full(16, height)) - truth))
    # A polynomial of degree 4 between Chebyshev nodes leaves at most twice the sum of the higher coefficients of the
    # function itself, here those of twelve nodes.
    nodes = np.cos(np.pi * (np.arange(12) + 0.5) / 12)
    values = [instrument.shapes(fields, level_plane(plane, 25 * UM * n), None) for n in nodes]
    series = np.linalg.solve(chebvander(nodes, 11), np.stack(values).reshape(12, -1)).reshape(12, 16, 3)
    bound = 2.0 * np.abs(series[5:]).sum(axis=0)
    assert (worst < bound + 1e-8).all()
    # At one wavelength this is 5e-5 at some stars, a twentieth of the noise of a star of a signal to noise of 500.
    assert bound.max() < 1e-4
    # An own height for each star.
    heights = np.random.default_rng(3).uniform(-20.0, 20.0, 16) * UM
    each = np.concatenate([found.at(np.full(16, h))[i : i + 1] for i, h in enumerate(heights)])
    np.testing.assert_allclose(found.at(heights), each, atol=1e-14)


def test_slopes_are_those_of_differences():
    # Any coefficients will do: the derivative of the polynomial is exact.
    found = HeightSeries(np.random.default_rng(4).normal(0.0, 0.01, (5, 9, 3)), 25 * UM, 7 * UM)
    heights = np.random.default_rng(5).uniform(-13.0, 27.0, 9) * UM
    step = 0.01 * UM
    near, far = ((found.at(heights + k * step) - found.at(heights - k * step)) / (2 * k * step) for k in (1, 2))
    # Richardson leaves (step / 25 um)^4; rounding is 1e-16 / 1e-8 m of slopes of 1e3 / m.
    expected = (4 * near - far) / 3
    np.testing.assert_allclose(found.slope(heights), expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.long
def test_heights_far_from_zero_have_a_range_of_their_own(instrument, plane):
    fields = instrument.fields(stars(plane, 8, 9))
    found = height_response(instrument, fields, plane, None, center=30 * UM)
    truth = instrument.shapes(fields, level_plane(plane, 41 * UM), None)
    # 16 um beyond the range about zero; the bound is that of the nodes, as above.
    np.testing.assert_allclose(found.at(np.full(8, 41 * UM)), truth, atol=2e-4)
    about_zero = height_response(instrument, fields, plane, None)
    assert np.abs(about_zero.at(np.full(8, 41 * UM)) - truth).max() > 2e-3


@pytest.mark.long
@pytest.mark.parametrize("center", [pytest.param(0.0, marks=pytest.mark.slow), 11 * UM])
def test_columns_are_differences_of_the_engine(instrument, plane, center):
    xy = stars(plane, 60, 6)
    fields = instrument.fields(xy)
    found = ExposureResponse.of(instrument, fields, plane, None, 0.0, center=center)
    radius = np.hypot(*fields.T).max()
    assert found.radius == radius
    height = center + 8 * UM
    columns = found.columns(fields, np.full(60, height))
    assert columns.shape == (60, 3 * len(NOLL) + 1, 3)
    level = level_plane(plane, height)

    def engine(coefficients, seeing=0.0):
        aberration = wavefront(instrument.telescope, coefficients, radius)
        return instrument.shapes(fields, level, aberration, seeing)

    # Steps of 0.05 um and 0.02 um differ by their squares: a relative 0.5 % (0.05 um is a tenth of the wavelength over
    # 2 pi, and its square 0.25 % in phase). The field is smooth here, but not where the pupil is cut off, beyond 0.27 m
    # from the axis.
    for parameter, row in ((0, 0), (2, 0), (2, 1)):
        step = np.zeros((3, len(NOLL)))
        step[row, parameter] = 0.02 * UM
        expected = (engine(step) - engine(-step)) / (2 * 0.02 * UM)
        got = columns[:, row * len(NOLL) + parameter]
        np.testing.assert_allclose(got, expected, atol=0.01 * np.abs(expected).max())
    expected = (engine(np.zeros((3, len(NOLL))), 0.02) - engine(np.zeros((3, len(NOLL))), -0.02)) / 0.04
    np.testing.assert_allclose(columns[:, -1], expected, atol=0.01 * np.abs(expected).max())
    # A better seeing makes smaller stars: FWHM goes as r0^-1, a good part of the size.
    assert (columns[:, -1, 2] < -0.2).all()


def test_columns_are_linear_between_the_levels_and_along_the_field():
    rng = np.random.default_rng(7)
    found = ExposureResponse(rng.normal(0.0, 1.0, (len(NOLL) + 1, 2, 10, 3)), 0.03, 5 * UM)
    fields = rng.uniform(-0.02, 0.02, (11, 2))
    low, middle, high = (found.columns(fields, np.full(11, h * UM)) for h in (-3.0, 7.0, 13.0))
    np.testing.assert_allclose(middle, low + (10.0 / 16.0) * (high - low), atol=1e-12)
    np.testing.assert_allclose(found.height_slopes(fields), (high - low) / (16.0 * UM), rtol=1e-10, atol=1e-6)
    n = len(NOLL)
    # Slopes along the field are the terms on the axis times the field.
    np.testing.assert_allclose(low[:, n : 2 * n], low[:, :n] * (fields[:, 0] / 0.03)[:, None, None], atol=1e-13)
    np.testing.assert_allclose(low[:, 2 * n : -1], low[:, :n] * (fields[:, 1] / 0.03)[:, None, None], atol=1e-13)


def test_wavefronts_are_coefficients_on_the_axis_and_along_the_field(lsst_r):
    rng = np.random.default_rng(8)
    values, radius = rng.normal(0.0, 1e-7, (3, len(NOLL))), 0.03
    found = wavefront(lsst_r, values, radius)
    for slopes in rng.uniform(-0.03, 0.03, (4, 2)):
        # NOLL starts at Noll's j = 4, as ResidualWavefront does.
        expected = values[0] + values[1] * slopes[0] / radius + values[2] * slopes[1] / radius
        np.testing.assert_allclose(found.at(slopes).ravel(), expected, atol=1e-20)
    base = ResidualWavefront(np.full(8, 1e-7), lsst_r.pupil_diameter, lsst_r.pupil_obscuration, np.full((8, 2), 1e-6))
    both = wavefront(lsst_r, values, radius, base)
    np.testing.assert_allclose(both.coefficients, values[0] + 1e-7, atol=1e-20)
    np.testing.assert_allclose(both.field_gradient, values[1:].T / radius + 1e-6, atol=1e-18)


@pytest.mark.parametrize("degree", [0, 3, 6])
def test_terms_of_the_field_span_all_polynomials(degree):
    xy = np.random.default_rng(9).uniform(-0.7, 0.7, (200, 2))
    terms = field_terms(xy, degree)
    wanted = polyvander2d(*xy.T, (degree, degree)).reshape(200, degree + 1, degree + 1)
    i, j = np.triu_indices(degree + 1)
    wanted = np.stack([wanted[:, a, b - a] for a, b in zip(i, j, strict=True)], axis=1)
    assert terms.shape == wanted.shape
    left = wanted - terms @ np.linalg.lstsq(terms, wanted, rcond=None)[0]
    np.testing.assert_allclose(left, 0.0, atol=1e-11)


def test_a_level_plane_is_level(plane):
    x, y = stars(plane, 20, 10).T
    np.testing.assert_array_equal(level_plane(plane, 3 * UM).height(x, y), 3 * UM)


def test_batches_change_nothing(instrument, plane, monkeypatch):
    fields = instrument.fields(stars(plane, 7, 11))
    whole = instrument.shapes(fields, plane, None)
    counted = []
    monkeypatch.setattr(response, "_BATCH", 3)
    np.testing.assert_allclose(
        instrument.shapes(fields, plane, None, progress=counted.append), whole, atol=1e-12
    )  # the batches of a transform
    assert counted == [3, 3, 1]


def test_silicon_is_part_of_the_instrument(lsst_r, plane):
    y = load_telescope("lsst_v3.3_y")
    without, thick, thin = (
        Instrument.of(y, [970e-9], stamps=Stamps(silicon=s)) for s in (None, Silicon(), Silicon(50e-6))
    )
    assert len({without.key, thick.key, thin.key}) == 3
    fields = thick.fields(stars(plane, 4, 5))
    images, _ = thick.images(fields, plane, None)
    exact = make_psfs(
        y,
        fields,
        [970e-9],
        focal_plane=plane,
        atmosphere=thick.atmosphere,
        engine="long_exposure",
        stamps=Stamps(silicon=Silicon()),
    ).image
    np.testing.assert_array_equal(images, exact)
    assert (thick.shapes(fields, plane, None) != without.shapes(fields, plane, None)).all()


def test_stamps_of_a_camera_have_its_pixels():
    # Pixels of the instruments' manuals: 10 um of the LSST, 15 um of HSC; 0.4 of them diffuse.
    for camera, pixel in (("lsst", 10.0), ("hsc", 15.0)):
        stamps = Stamps.of_camera(camera, jitter=1e-7)
        np.testing.assert_allclose((stamps.pixel_size, stamps.diffusion), (pixel * UM, 0.4 * pixel * UM))
        assert (stamps.size, stamps.jitter, stamps.silicon) == (31, 1e-7, None)


def test_light_of_an_instrument_is_one_spectrum(lsst_r):
    waves = [600e-9, 640e-9]
    plain, weighted, shifted = (
        Instrument.of(lsst_r, light)
        for light in (waves, Light(waves, [1.0, 3.0]), Light(waves, dispersion=[[0.0, 0.0], [0.0, 1e-7]]))
    )
    assert len({plain.key, weighted.key, shifted.key}) == 3
    with pytest.raises(DomainError, match=r"weights of shape \(1, 2\): expected one spectrum of 2 wavelengths"):
        Instrument.of(lsst_r, Light(waves, [[1.0, 3.0]]))
    with pytest.raises(DomainError, match="expected no offsets"):
        Instrument.of(lsst_r, waves, stamps=Stamps(offsets=[(0.0, 0.0)]))


@pytest.mark.long
def test_shapes_at_heights_in_silicon(plane):
    # Silicon puts the focus 12 um to one side, so the polynomial of the heights reaches farther out of it.
    instrument = Instrument.of(load_telescope("lsst_v3.3_y"), [970e-9], stamps=Stamps(silicon=Silicon()))
    fields = instrument.fields(stars(plane, 16, 1))
    found = height_response(instrument, fields, plane, None)
    for height in np.array([-18.0, -7.0, 3.0, 16.0]) * UM:
        truth = instrument.shapes(fields, level_plane(plane, height), None)
        np.testing.assert_allclose(found.at(np.full(16, height)), truth, atol=2e-4)


@pytest.mark.parametrize(
    ("wavelengths", "message"),
    [(622.0, "wavelength"), (np.zeros((2, 3)), "wavelengths of shape"), ([], "wavelengths of shape")],
)
def test_wavelengths_that_the_telescope_does_not_have(lsst_r, wavelengths, message):
    """Nanometres as plain numbers, of which a fit failed much later."""
    with pytest.raises(DomainError, match=message):
        Instrument.of(lsst_r, wavelengths)
