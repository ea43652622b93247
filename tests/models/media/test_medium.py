import numpy as np
import pytest
from astropy import units as u

from pachon.core.errors import DomainError, PrescriptionError
from pachon.models.media.medium import ConstantIndex, Sellmeier

# Malitson (1965), J. Opt. Soc. Am. 55, 1205: coefficients of fused silica at 20 C, and indices he tabulates.
MALITSON = Sellmeier(
    (0.6961663, 0.4079426, 0.8974794), (0.0684043**2, 0.1162414**2, 9.896161**2), wavelength_range=(0.21e-6, 3.71e-6)
)


# The helium d, mercury h, hydrogen F and C and mercury t lines [nm].
@pytest.mark.parametrize(
    ("nanometres", "index"),
    [(587.562, 1.45846), (404.656, 1.46962), (486.133, 1.46313), (656.273, 1.45637), (1013.98, 1.45024)],
)
def test_fused_silica_has_malitsons_indices(nanometres, index):
    # The tabulated figures have five decimals.
    assert MALITSON.index(nanometres * 1e-9) == pytest.approx(index, abs=6e-6)


def test_index_takes_arrays_and_quantities():
    plain = MALITSON.index(np.array([[4e-7, 5e-7], [6e-7, 7e-7]]))
    assert plain.shape == (2, 2)
    assert np.array_equal(MALITSON.index([400, 500] * u.nm), MALITSON.index([400e-9, 500e-9]))
    assert np.array_equal(ConstantIndex(1.5).index([1e-7, 1e-3]), [1.5, 1.5])


def test_the_lsst_glass_is_batoids():
    batoid = pytest.importorskip("batoid")
    b, c = (0.69618302, 0.407925877, 0.897464057), (0.00467926519, 0.0135122244, 97.9323636)
    w = np.linspace(0.3e-6, 1.2e-6, 31)
    peer = batoid.SellmeierMedium(*b, *c)
    # Same formula in float64: rounding only.
    assert np.allclose(Sellmeier(b, c).index(w), [peer.getN(v) for v in w], rtol=0, atol=1e-15 * 4)


@pytest.mark.parametrize("w", [0.2e-6, 4e-6, float("nan"), 550.0])
def test_a_wavelength_outside_the_glass_is_refused(w):
    with pytest.raises(DomainError, match=r"wavelength = .* nm: expected 210 to 3710 nm"):
        MALITSON.index([5e-7, w])


@pytest.mark.parametrize("n", [0.0, -1.5, float("nan"), float("inf")])
def test_an_impossible_index_is_refused(n):
    with pytest.raises(PrescriptionError, match="positive refractive index"):
        ConstantIndex(n)


def test_impossible_coefficients_are_refused():
    with pytest.raises(PrescriptionError, match="B = "):
        Sellmeier((1.0, 2.0), (1.0, 2.0, 3.0))
    with pytest.raises(PrescriptionError, match="wavelength_range"):
        Sellmeier((1.0, 0.0, 0.0), (0.01, 0.0, 0.0), wavelength_range=(1e-6, 1e-7))
