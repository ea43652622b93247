"""The index of air against the tables of Ciddor's paper, an independent index of the NIST page, and batoid."""

import numpy as np
import pytest

from pachon.core.errors import DomainError, PrescriptionError
from pachon.models.media.air import Air, saturation_pressure

# Ciddor (1996), Table 1: dry air, 450 ppm of CO2, 633 nm; degrees Celsius, kPa, (n - 1) 1e8.
DRY = [(20, 80, 21458.0), (20, 100, 26824.4), (20, 120, 32191.6), (10, 100, 27774.7), (30, 100, 25937.2)]
# Table 2, 633 nm: degrees Celsius, Pa, water vapour [Pa], ppm of CO2, (n - 1) 1e8. The second row of the paper is left
# out: 27394.0 at 0.009 deg and 2 Pa from the first cannot be, each of the two changes n by more than what is printed.
MOIST = [
    (19.526, 102094.8, 1065, 510, 27392.9),
    (19.173, 102993.0, 641, 450, 27682.4),
    (19.173, 103006.0, 642, 440, 27685.8),
    (19.188, 102918.8, 706, 450, 27658.7),
    (19.189, 102927.8, 708, 440, 27660.8),
    (19.532, 103603.2, 986, 600, 27802.0),
    (19.534, 103596.2, 962, 600, 27800.8),
    (19.534, 103599.2, 951, 610, 27802.2),
]
# Table 3, 450 ppm, 633 nm: degrees Celsius, kPa, relative humidity, (n - 1) 1e8. (40 C, 80 kPa has a misprint.)
EXTREME = [
    (20, 80, 0.75, 21394.0),
    (20, 120, 0.75, 32127.8),
    (40, 120, 0.75, 29941.8),
    (50, 80, 1.0, 19058.4),
    (50, 120, 1.0, 28792.4),
]
# The NIST engineering metrology toolbox (Stone and Zimmerman), Ciddor's equation: degrees Celsius, kPa, nm, dry, n.
NIST = [
    (20, 101.325, 633, 1.000271800),
    (20, 60, 633, 1.000160924),
    (50, 100, 633, 1.000243285),
    (5, 100, 633, 1.000282756),
    (-40, 100, 633, 1.000337580),
    (20, 101.325, 1700, 1.000268479),
    (20, 101.325, 300, 1.000286581),
]


@pytest.mark.parametrize(("celsius", "kilopascal", "expected"), DRY)
def test_dry_air_is_ciddors_table_1(celsius, kilopascal, expected):
    air = Air(kilopascal * 1e3, celsius + 273.15)
    # One decimal is printed.
    assert float(air.refractivity(633e-9)) * 1e8 == pytest.approx(expected, abs=0.06)


@pytest.mark.parametrize(("celsius", "pascal", "vapour", "co2", "expected"), MOIST)
def test_moist_air_is_ciddors_table_2(celsius, pascal, vapour, co2, expected):
    air = Air(pascal, celsius + 273.15, vapour, co2)
    # The temperature is rounded to 0.001 deg, which is 0.05 of these units, and the figure to 0.1.
    assert float(air.refractivity(633e-9)) * 1e8 == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(("celsius", "kilopascal", "humidity", "expected"), EXTREME)
def test_humid_air_is_ciddors_table_3(celsius, kilopascal, humidity, expected):
    air = Air.at_humidity(humidity, pressure=kilopascal * 1e3, temperature=celsius + 273.15)
    assert float(air.refractivity(633e-9)) * 1e8 == pytest.approx(expected, abs=0.06)


@pytest.mark.parametrize(("celsius", "kilopascal", "nanometres", "expected"), NIST)
def test_dry_air_is_that_of_nist_at_other_wavelengths_and_temperatures(celsius, kilopascal, nanometres, expected):
    # NIST's calculator differs from the paper in the temperature scale and the compressibility's rounding: 1e-8.
    assert float(Air(kilopascal * 1e3, celsius + 273.15).index(nanometres * 1e-9)) == pytest.approx(expected, abs=1e-8)


def test_filippenko_is_batoids():
    batoid = pytest.importorskip("batoid")
    w = np.linspace(0.3e-6, 1.2e-6, 31)
    peer = batoid.Air(69.328, 293.15, 1.067)
    ours = Air(69328.0, 293.15, 1067.0, formula="filippenko").index(w)
    # Same formula; batoid's millimetres of mercury have nine digits, and n - 1 is 2e-4.
    assert np.allclose(ours, [peer.getN(v) for v in w], rtol=0, atol=1e-12)


def test_the_two_formulas_agree_at_a_mountain():
    w = np.linspace(0.4e-6, 1.0e-6, 13)
    old = Air(74500.0, 283.0, 500.0, formula="filippenko").refractivity(w)
    new = Air(74500.0, 283.0, 500.0).refractivity(w)
    # Edlen's constants of 1953 and another carbon dioxide: some 1e-3 of n - 1.
    assert np.allclose(old, new, rtol=2e-3)


def test_no_air_has_index_one():
    assert float(Air(pressure=0.0).index(5e-7)) == 1.0


def test_saturation_pressure_at_20_degrees():
    # 2339 Pa in every steam table (2338.8 to 2339.3 by formula).
    assert saturation_pressure(293.15) == pytest.approx(2339.0, abs=1.0)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"pressure": -1.0}, "pressure"),
        ({"temperature": 0.0}, "temperature"),
        ({"water_vapour": 2e5}, "water_vapour"),
        ({"co2_ppm": -1.0}, "co2_ppm"),
        ({"formula": "edlen"}, "expected one of ciddor, filippenko"),
    ],
)
def test_impossible_air_is_refused(keys, expected):
    with pytest.raises(PrescriptionError, match=expected):
        Air(**keys)
    with pytest.raises(PrescriptionError, match="humidity"):
        Air.at_humidity(1.5)


def test_a_wavelength_that_the_formula_does_not_cover_is_refused():
    with pytest.raises(DomainError, match="expected 230 to 1700 nm for air"):
        Air().index(2e-6)
