"""Silicon of a CCD: the distribution of conversion depths, the equivalent defocus, diffusion."""

import math

import numpy as np
import pytest
from astropy import units as u
from scipy.integrate import quad

from pachon.core.errors import DomainError
from pachon.models.camera.silicon import Silicon
from pachon.models.io.prescription import load_telescope
from pachon.wavefront.silicon_focus import focus_height

#: Nearly all light is absorbed, about half, next to none.
WAVELENGTHS = (400e-9, 754e-9, 940e-9, 1090e-9)


@pytest.mark.parametrize("wavelength", WAVELENGTHS)
@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_paths_integrate_polynomials_over_the_truncated_exponential(wavelength, count):
    silicon = Silicon()
    length, end = silicon.absorption_length(wavelength), silicon.thickness
    paths = silicon.paths(wavelength, count)
    assert (paths.weight > 0.0).all()
    assert ((paths.length > 0.0) & (paths.length < end)).all()
    for power in range(2 * count):
        scale = min(length, end)

        def moment(x, power=power, scale=scale):
            return x**power * math.exp(-x * scale / length) * scale / length

        exact, _ = quad(moment, 0.0, end / scale, points=[1.0, 5.0, 20.0] if end > 50 * scale else None, epsabs=1e-12)
        assert paths.weight @ (paths.length / scale) ** power == pytest.approx(exact, rel=1e-8)
    assert paths.weight.sum() == pytest.approx(silicon.absorbed(wavelength), rel=1e-12)


@pytest.mark.parametrize("wavelength", WAVELENGTHS)
def test_defocus_is_that_of_the_closed_form(wavelength):
    silicon = Silicon(thickness=80e-6, temperature=200.0)
    length, thickness, index = silicon.absorption_length(wavelength), 80e-6, silicon.index(wavelength)
    ratio = thickness / length
    lost = 1.0 / math.expm1(ratio)
    mean = length - thickness * lost
    variance = length**2 - thickness**2 * lost * (1.0 + lost)
    # Where silicon is nearly transparent the variance is a difference of numbers 1e6 times larger.
    assert silicon.defocus(wavelength) == pytest.approx((mean / index, math.sqrt(variance) / index), rel=1e-6)


def test_quantities_are_lengths():
    silicon = Silicon(thickness=100 * u.um)
    assert silicon == Silicon(100 * 1e-6)
    assert silicon.defocus(870 * u.nm) == pytest.approx(silicon.defocus(870e-9), rel=1e-12)
    telescope = load_telescope("lsst_v3.3_z")
    assert focus_height(telescope, silicon, 870 * u.nm) == pytest.approx(
        focus_height(telescope, silicon, 870e-9), rel=1e-9
    )


def test_the_surface_stands_in_front_of_the_focus_behind_a_fold():
    # AuxTel's detector looks sideways: the sign was that of the light along z of the telescope, which it has by chance.
    silicon = Silicon()
    cosine = math.cos(0.5 / 18.0)
    assert focus_height(load_telescope("auxtel"), silicon, 970e-9) == pytest.approx(
        -silicon.defocus(970e-9)[0] * cosine, rel=1e-3
    )


def test_charge_spreads_with_the_root_of_the_distance_drifted():
    silicon = Silicon(thickness=100e-6)
    spread = silicon.diffusion(np.array([0.0, 36e-6, 75e-6, 100e-6]), 4e-6)
    np.testing.assert_allclose(spread, [4e-6, 3.2e-6, 2e-6, 0.0], atol=1e-20)


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({"thickness": 100.0}, ["thickness = 100.0", "expected 1e-06 to 0.001 m"]),
        ({"thickness": math.nan}, ["thickness = nan"]),
        ({"temperature": 20.0}, ["temperature = 20.0", "expected 100 to 350 K"]),
    ],
)
def test_impossible_silicon_is_one_clear_line(options, parts):
    with pytest.raises(DomainError) as caught:
        Silicon(**options)
    for part in parts:
        assert part in str(caught.value)
