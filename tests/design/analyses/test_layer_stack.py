"""Thin films and tables of angles: closed forms, and sums of the waves between two interfaces."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import ConfigError, DomainError, PachonError
from pachon.design.analyses.coatings import Coating, Coatings
from pachon.models.layer_stack import CoatingTable, LayerStack

LIGHT, GLASS = 550e-9, 1.5168
QUARTER = LayerStack((1.38,), (LIGHT / 4 / 1.38,), "mgf2")


def amplitudes(n1, n2, sine):
    """Fresnel's reflection of s and of p from one medium to another, for n sin(angle) = sine."""
    c1, c2 = (np.sqrt(1.0 - (sine / n) ** 2 + 0j) for n in (n1, n2))
    return np.array([(n1 * c1 - n2 * c2) / (n1 * c1 + n2 * c2), (n2 * c1 - n1 * c2) / (n2 * c1 + n1 * c2)])


def rouard(media, thicknesses, sine):
    """Reflected power of a stack, mean of s and p: waves summed film by film from the glass outwards (Rouard)."""
    r = amplitudes(media[-2], media[-1], sine)
    for j in range(len(thicknesses) - 1, -1, -1):
        delay = np.exp(4j * np.pi / LIGHT * thicknesses[j] * np.sqrt(media[j + 1] ** 2 - sine**2 + 0j))
        before = amplitudes(media[j], media[j + 1], sine)
        r = (before + r * delay) / (1.0 + before * r * delay)
    return float((np.abs(r) ** 2).mean())


def test_closed_forms_at_normal_incidence():
    quarter = ((GLASS - 1.38**2) / (GLASS + 1.38**2)) ** 2
    assert 1.0 - QUARTER.efficiency(LIGHT, 1.0, 1.0, GLASS) == pytest.approx(quarter, rel=1e-12)
    assert quarter == pytest.approx(0.0128, abs=1e-4)  # MgF2 on crown: 1.3 %
    # A film of half a wave is absent; quarter waves of square-root index, and of two matched ones, reflect nothing.
    half = LayerStack((2.1,), (LIGHT / 2 / 2.1,))
    assert half.efficiency(LIGHT, 1.0, 1.0, GLASS) == pytest.approx(4 * GLASS / (1 + GLASS) ** 2, rel=1e-12)
    perfect = LayerStack((np.sqrt(GLASS),), (LIGHT / 4 / np.sqrt(GLASS),))
    assert perfect.efficiency(LIGHT, 1.0, 1.0, GLASS) == pytest.approx(1.0, abs=1e-14)
    matched = (1.38, 1.38 * np.sqrt(GLASS))
    two = LayerStack(matched, tuple(LIGHT / 4 / n for n in matched))
    assert two.efficiency(LIGHT, 1.0, 1.0, GLASS) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("angle", [0.0, 0.4, 0.9, 1.4])
def test_films_at_an_angle_are_the_sum_of_their_waves(angle):
    stack = LayerStack((1.38, 2.1, 1.63), (100e-9, 60e-9, 140e-9))
    expected = rouard((1.0, *stack.indices, GLASS), stack.thicknesses, np.sin(angle))
    assert stack.efficiency(LIGHT, np.cos(angle), 1.0, GLASS) == pytest.approx(1.0 - expected, rel=1e-12)
    # The way back is the same, and no film is bare glass.
    inside = np.cos(np.arcsin(np.sin(angle) / GLASS))
    assert stack.efficiency(LIGHT, inside, GLASS, 1.0) == pytest.approx(1.0 - expected, rel=1e-12)
    bare = pachon.design.fresnel_transmission(np.cos(angle), 1.0, GLASS)
    assert LayerStack((), ()).efficiency(LIGHT, np.cos(angle), 1.0, GLASS) == pytest.approx(bare, rel=1e-12)


def test_total_reflection_lets_nothing_through():
    assert QUARTER.efficiency(LIGHT, np.cos(0.8), GLASS, 1.0) == pytest.approx(0.0, abs=1e-14)


FILE = """
coatings:
  mgf2: {layers: [{index: 1.38, thickness_nm: 99.6377}]}
  slanted: {wavelength_nm: [400, 800], angle_deg: [0, 10, 20], efficiency: [[1.0, 0.9, 0.7], [0.8, 0.7, 0.5]]}
surfaces: {front: mgf2, back: slanted}
"""


def test_a_file_of_films_and_angles(afocal, tmp_path):
    path, plate, angle = tmp_path / "coatings.yaml", afocal(fold=False), np.deg2rad(5.0)
    path.write_text(FILE)
    plate = replace(plate, field_limit=0.5)
    found = pachon.design.throughput(plate, [(0.0, angle)], 600e-9, coatings=path, n_pupil=3)
    front = LayerStack((1.38,), (99.6377e-9,)).efficiency(600e-9, np.cos(angle), 1.0, 1.5)
    # Half-way between the wavelengths and between the first two angles, those of the side of air.
    assert found.value[0, 0] == pytest.approx(front * (0.9 - 0.05), rel=1e-12)
    with pytest.raises(DomainError, match=r"coating of back: rays of 1\d\.\d+ deg: expected a table that reaches them"):
        pachon.design.throughput(plate, [(0.0, np.deg2rad(25.0))], 600e-9, coatings=path, n_pupil=3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{layers: [{index: -1, thickness_nm: 5}]}", "index"),
        ("{layers: [{index: 1.4, thickness_nm: 5}], file: ar.csv}", "expected layers alone"),
        ("{wavelength_nm: [400, 800], angle_deg: [0, 10], efficiency: [0.9, 0.9]}", "one an angle"),
        ("{wavelength_nm: [400, 800], angle_deg: [5, 10], efficiency: [[1, 1], [1, 1]]}", "from 0"),
        ("{wavelength_nm: [400, 800], efficiency: [[1, 1], [1, 1]]}", "rows of them go with angle_deg"),
    ],
)
def test_bad_coatings_are_said(tmp_path, text, said):
    path = tmp_path / "coatings.yaml"
    path.write_text(f"coatings:\n  one: {text}\nsurfaces: {{}}\n")
    with pytest.raises(ConfigError, match=said):
        Coatings.read(path)


def test_films_stand_on_lens_surfaces(afocal):
    with pytest.raises(ConfigError, match="coating of fold: layers are those of lens surfaces; expected a table"):
        pachon.design.throughput(afocal(fold=True), coatings=Coatings({"fold": QUARTER}))
    table = CoatingTable((4e-7, 8e-7), (0.0, 1.0), ((0.9, 0.5), (0.9, 0.5)))
    found = pachon.design.throughput(
        afocal(fold=True), [(0.0, 0.0)], 5e-7, coatings=Coatings({"fold": table}), n_pupil=3
    )
    assert found.value[0, 0] == pytest.approx(0.9, rel=1e-12)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [({"n2": 0.0}, "n2 = 0.0: expected a refractive index"), ({"n1": 1e300}, r"n1 = 1e\+300: expected a refractive"),
     ({"cosine": 0.9 * u.m}, "cosine = .*: expected real numbers without a unit"),
     ({"wavelength": 0.0}, "wavelength|expected")],
)  # fmt: skip
def test_wrong_arguments_of_an_efficiency(wrong, text):
    coatings = (
        Coating((400e-9, 700e-9), (0.9, 0.9)),
        CoatingTable((400e-9, 700e-9), (0.0, 1.0), ((0.9, 0.8), (0.9, 0.8))),
        LayerStack((1.38,), (1e-7,)),
    )
    for coating in coatings:
        with pytest.raises(PachonError, match=text):
            coating.efficiency(**{"wavelength": 500e-9, "cosine": 0.9, "n1": 1.0, "n2": 1.5} | wrong)
