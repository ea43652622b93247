import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError

FIELDS = np.deg2rad([(0.0, 0.0), (0.6, 1.1)])


def test_columns_are_the_heights_of_through_focus(lsst_r):
    heights, waves = np.array([-2e-5, 0.0, 1e-5]), [600e-9, 650e-9]
    matrix = pachon.design.spot_matrix(lsst_r, FIELDS, waves, defocus=heights, sampling="gauss", n_pupil=6)
    other = pachon.through_focus(lsst_r, FIELDS, waves, heights, sampling="gauss", n_pupil=6)
    # The other is a parabola in the height: rounding of squares.
    assert matrix.rms_radius == pytest.approx(other.rms_radius, rel=1e-9)
    assert matrix.displacement.shape[:3] == (2, 3, 2)


def test_columns_are_the_spots_of_each_wavelength(lsst_r):
    waves = [560e-9, 620e-9, 690e-9]
    matrix = pachon.design.spot_matrix(lsst_r, FIELDS, waves, against="wavelength", n_pupil=4)
    for c, wave in enumerate(waves):
        one = pachon.spots(lsst_r, FIELDS, wave, sampling="rings", n_pupil=4)
        assert matrix.rms_radius[:, c] == pytest.approx(one.rms_radius, rel=1e-9)
    # About the centroid of all wavelengths together.
    together = np.einsum("fcwp,fcwpi->fi", matrix.weight, np.nan_to_num(matrix.displacement))
    assert together == pytest.approx(0.0, abs=1e-15)


def test_default_heights_are_depths_of_focus(paraboloid):
    matrix = pachon.design.spot_matrix(paraboloid(2.0, 20.0), [(0.0, 0.0)], 5e-7, n_pupil=3)
    assert matrix.columns == pytest.approx(4e-4 * np.linspace(-2.0, 2.0, 5), rel=1e-3)


def test_contradictions(paraboloid):
    with pytest.raises(DomainError, match="defocus"):
        pachon.design.spot_matrix(paraboloid(), against="wavelength", defocus=[0.0])
    with pytest.raises(ConfigError, match="against = 'colour'"):
        pachon.design.spot_matrix(paraboloid(), against="colour")
    with pytest.raises(DomainError, match="defocus = "):
        pachon.design.spot_matrix(paraboloid(), defocus=[np.nan])


@pytest.mark.parametrize("sampling", ["gauss", "rings", "spiral", "square"])
def test_any_sampling_has_as_many_rays_as_it_takes(paraboloid, sampling):
    """A disc of uniform light."""
    telescope = paraboloid(2.0, 20.0, shift=1e-3)
    matrix = pachon.design.spot_matrix(telescope, [[0.0, 0.0]], defocus=[0.0], sampling=sampling)
    assert matrix.weight.shape[-1] > 300
    assert matrix.rms_radius[0, 0] == pytest.approx(25e-6 / np.sqrt(2.0), rel=0.01)
    more = pachon.design.spot_matrix(telescope, [[0.0, 0.0]], defocus=[0.0], sampling="spiral", n_pupil=3000)
    assert more.weight.shape[-1] == 3000
