import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import ConfigError, DomainError


def test_defaults_are_five_fields_one_wavelength_and_gauss_points(lsst_r):
    request = pachon.Request.of(lsst_r)
    np.testing.assert_allclose(np.rad2deg(request.fields[:, 1]), [0.0, 0.5, 1.0, 1.5, 1.75], atol=1e-12)
    assert not request.fields[:, 0].any()
    assert request.wavelengths.tolist() == [lsst_r.default_wavelength]
    assert request.weights.tolist() == [1.0]
    np.testing.assert_array_equal(request.pupil.points, pachon.pupil_sampling(lsst_r, "gauss").points)
    assert np.hypot(*request.unit_pupil.T).max() <= 1.0


def test_quantities_one_point_and_one_wavelength_are_taken(lsst_r):
    request = pachon.Request.of(lsst_r, [0.5, 1.0] * u.deg, 620 * u.nm, sampling="rings", n_pupil=3)
    np.testing.assert_allclose(request.fields, np.deg2rad([[0.5, 1.0]]), rtol=1e-15)
    assert request.wavelength == pytest.approx(620e-9, rel=1e-15)
    assert len(request.pupil) == len(pachon.pupil_sampling(lsst_r, "rings", 3))


def test_weights_sum_to_one_and_the_middle_wavelength_is_in_the_list(lsst_r):
    request = pachon.Request.of(lsst_r, None, [600e-9, 620e-9, 650e-9], wavelength_weights=[1, 2, 1])
    assert request.weights.tolist() == [0.25, 0.5, 0.25]
    assert request.middle == 620e-9
    with pytest.raises(DomainError, match="3 wavelengths are given; expected one"):
        _ = request.wavelength


@pytest.mark.parametrize(
    ("projection", "slopes"),
    [("zemax", np.tan([0.01, 0.02])), ("gnomonic", [0.01, 0.02])],
)
def test_slopes_are_those_of_the_light_in_the_projection(lsst_r, projection, slopes):
    request = pachon.Request.of(lsst_r, [0.01, 0.02], projection=projection)
    np.testing.assert_allclose(np.linalg.norm(request.directions, axis=-1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(request.slopes, [slopes], rtol=1e-14)


def test_rays_and_bundles_are_those_of_its_points(lsst_r):
    request = pachon.Request.of(lsst_r, [[0.0, 0.0], [0.0, 0.01]], n_pupil=4)
    bundles = request.bundles(request.wavelength)
    end = pachon.trace(lsst_r, request.launch(request.wavelength))
    np.testing.assert_array_equal(bundles.status, end.status.reshape(2, -1))
    np.testing.assert_allclose(
        bundles.landing(), lsst_r.surfaces[-1].to_local(end.position)[:, :2].reshape(2, -1, 2), atol=1e-15
    )
    for part, some in request.parts():
        np.testing.assert_array_equal(some.bundles(request.wavelength).path, bundles.path[part])


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"fields": [[0.0, 0.0, 0.0]]}, DomainError, "expected field angles x, y"),
        ({"fields": [[0.0, 1.0]]}, DomainError, "field = "),
        ({"wavelengths": 1e-5}, DomainError, "wavelength"),
        ({"wavelengths": [[6e-7]]}, DomainError, "expected one wavelength or a list"),
        ({"wavelength_weights": [1.0, 1.0]}, DomainError, "wavelength_weights = .*expected 1 numbers"),
        ({"wavelength_weights": [-1.0]}, DomainError, "none negative"),
        ({"sampling": "hexagonal"}, ConfigError, "expected one of gauss, rings"),
        ({"n_pupil": 0}, DomainError, "expected a whole number"),
        ({"projection": "tan"}, ConfigError, "expected one of zemax, gnomonic, postel"),
    ],
)
def test_bad_input_is_refused_when_the_request_is_made(lsst_r, change, error, words):
    with pytest.raises(error, match=words):
        pachon.Request.of(lsst_r, **change)
