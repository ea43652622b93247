import numpy as np
import pytest
from scipy.special import j1

import pachon
from pachon.core.errors import DomainError
from pachon.models.aperture import Circle


def test_contrast_of_a_wave_through_a_blur_disc(paraboloid):
    f, f_number, period, shift = 2.0, 20.0, 16, 8e-4
    telescope = paraboloid(f, f_number, shift=shift)
    n, side = 48, 4e-6
    x = np.arange(n)
    target = np.tile(1.0 + np.cos(2.0 * np.pi * x / period), (n, 1))
    image = pachon.design.target_image(telescope, target, width=n * side / f, n_rays=100, pixel=side, pixels=n)
    inside = image.image[8:40, 8:40]
    wave = np.exp(2j * np.pi * np.arange(32) / period)
    contrast = 2.0 * abs((inside * wave).sum()) / inside.sum()
    # Disc of radius shift / 2N, and the boxes of both pixels.
    argument = np.pi * (shift / f_number) / (period * side)
    expected = abs(2.0 * j1(argument) / argument) * np.sinc(1.0 / period) ** 2
    assert 0.3 < expected < 0.8
    # 100 quasi-random rays a pixel.
    assert contrast == pytest.approx(expected, abs=0.01)


def test_the_image_lies_where_the_rays_land_and_keeps_the_light(paraboloid):
    telescope = paraboloid(2.0, 20.0)
    target = np.zeros((9, 9))
    target[6, 1] = 3.0  # up and left on the sky of field angles
    result = pachon.design.target_image(telescope, target, width=9e-5, n_rays=50)
    row, column = np.unravel_index(np.argmax(result.image), result.image.shape)
    rays = pachon.launch_rays(telescope, (-3e-5, 2e-5), 5e-7, ([0.0], [0.0]))
    landing = pachon.trace(telescope, rays).position[0, :2]
    middle = (len(result.image) - 1) / 2
    assert (column - middle, row - middle) == pytest.approx(landing / result.pixel, abs=0.51)
    assert result.image.sum() == pytest.approx(3.0, rel=1e-12)
    assert result.light_inside == pytest.approx(1.0, rel=1e-12)


def test_vignetting_factors_narrow_the_blur(paraboloid):
    factors, fields = ((0.0, 0.0, 0.0, 0.5, 0.0),), ((0.0, 0.0),)
    telescope = paraboloid(2.0, 10.0, shift=1e-3).with_design(field_type="angle", fields=fields, vignetting=factors)
    request, target = pachon.Request.of(telescope, one_wavelength=True), np.pad([[1.0]], 2)
    image = pachon.design.target_image(request, target, width=5e-7, n_rays=1000, pixel=1e-6, pixels=121).image
    place = np.arange(121) - 60.0
    along_x, along_y = (np.sqrt(image.sum(axis=axis) @ place**2 / image.sum()) for axis in (0, 1))
    assert along_x == pytest.approx(25.0, rel=0.01)
    assert along_y == pytest.approx(12.5, rel=0.01)
    # Half of the pupil is lit, as in spots.
    assert image.sum() == pytest.approx(pachon.spots(request).lit_fraction[0], rel=1e-12)


def test_bars_are_as_wide_as_their_gaps():
    target = pachon.design.bar_target(100, bars=3)
    row = target[50]
    edges = np.flatnonzero(np.diff(row))
    assert set(row) == {0.0, 1.0}
    assert np.diff(edges[:6]) == pytest.approx(8, abs=1)
    assert target[:, 75].sum() == pytest.approx(3 * 8, abs=3)


def test_bad_targets(paraboloid):
    for target, problem in ((np.zeros((4, 4)), "some light"), (np.ones(4), "shape"), (-np.ones((3, 3)), "negative")):
        with pytest.raises(DomainError, match=problem):
            pachon.design.target_image(paraboloid(), target)
    with pytest.raises(DomainError, match=r"^field: 2 fields are given; expected one$"):
        pachon.design.target_image(pachon.Request.of(paraboloid(), [[0.0, 0.0], [0.0, 1e-3]]))
    with pytest.raises(DomainError, match=r"field = .*: no light passes"):
        pachon.design.target_image(paraboloid(aperture=Circle(0.001, x=1.0)))
    with pytest.raises(DomainError, match="bars = 9"):
        pachon.design.bar_target(64, bars=9)
