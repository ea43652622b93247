from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import ConfigError, DomainError, UnknownNameError
from pachon.design.analyses.coatings import Absorption, Coating, Coatings
from pachon.models.aperture import Annulus
from pachon.models.media.medium import ConstantIndex

FILE = """
coatings:
  silver: {wavelength_nm: [400, 800], efficiency: [0.9, 1.0]}
  ar: {file: ar.csv}
surfaces: {front: ar, detector: silver}
glasses:
  crown: {thickness_mm: 5, wavelength_nm: [400, 800], efficiency: [0.9, 0.9]}
"""


@pytest.fixture
def plate(afocal):
    telescope = afocal(fold=False)
    glass = ConstantIndex(1.5, "crown")
    return replace(telescope, surfaces=(replace(telescope.surfaces[0], medium_after=glass), *telescope.surfaces[1:]))


def test_a_plate_of_bare_glass(plate):
    result = pachon.design.throughput(plate, [(0.0, 0.0)], 5e-7, n_pupil=3)
    assert result.value[0, 0] == pytest.approx(0.96**2, abs=1e-15)
    assert result.surfaces == ("front", "back")
    # At Brewster's angle p is not reflected: s alone, by ((1 - n^2) / (1 + n^2))^2.
    s = (1.25 / 3.25) ** 2
    assert pachon.design.fresnel_transmission(np.cos(np.arctan(1.5)), 1.0, 1.5) == pytest.approx(
        1.0 - 0.5 * s, abs=1e-15
    )
    # No light enters what refracts without end.
    assert pachon.design.fresnel_transmission([1.0, 0.9], 1e300, 1.5).tolist() == [0.0, 0.0]
    with pytest.raises(DomainError, match="cosine"):
        pachon.design.fresnel_transmission([1.0] * u.kg, 1.0, 1.5)


def test_the_angle_of_incidence_is_that_of_the_ray(plate):
    angle = 0.03
    result = pachon.design.throughput(plate, [(0.0, angle)], 5e-7, n_pupil=3)
    inside = np.arcsin(np.sin(angle) / 1.5)
    # Fresnel's formulas by the angles: sines and tangents of their sum and difference.
    s = np.sin(angle - inside) ** 2 / np.sin(angle + inside) ** 2
    p = np.tan(angle - inside) ** 2 / np.tan(angle + inside) ** 2
    assert result.value[0, 0] == pytest.approx((1.0 - 0.5 * (s + p)) ** 2, rel=1e-12)


def test_the_way_back_is_the_same():
    angle = np.array([0.0, 0.3, 0.6])
    back = np.arcsin(1.5 * np.sin(angle))
    forth = pachon.design.fresnel_transmission(np.cos(angle), 1.5, 1.0)
    assert forth == pytest.approx(pachon.design.fresnel_transmission(np.cos(back), 1.0, 1.5), abs=1e-14)
    assert pachon.design.fresnel_transmission(np.cos(0.8), 1.5, 1.0) == 0.0


def test_coatings_and_absorption_of_a_file(plate, tmp_path):
    (tmp_path / "coatings.yaml").write_text(FILE)
    (tmp_path / "ar.csv").write_text("# nm, transmission\n400, 0.98\n800, 0.99\n")
    result = pachon.design.throughput(
        plate, [(0.0, 0.0)], [400e-9, 600e-9], coatings=tmp_path / "coatings.yaml", n_pupil=3
    )
    # The plate is 10 mm thick: twice the 5 mm of the table.
    expected = np.array([0.98 * 0.9, 0.985 * 0.95]) * 0.9**2 * 0.96
    assert result.value[0] == pytest.approx(expected, rel=1e-12)
    assert result.surfaces == ("front", "in crown before back", "back", "detector")
    assert result.efficiency.prod(axis=0) == pytest.approx(result.value, rel=1e-12)


def test_vignetting_is_in_it(paraboloid):
    telescope = paraboloid(2.0, 10.0, baffle=(1.0, 0.05))
    result = pachon.design.throughput(telescope, [(0.0, 0.0)], 5e-7, sampling="spiral", n_pupil=4000)
    assert result.value == pytest.approx(result.lit_fraction)
    assert result.value[0, 0] == pytest.approx(0.25, abs=5e-3)
    assert result.surfaces == ()


def test_rims_across_the_pupil_are_sampled_by_default(paraboloid):
    # The middle of the mirror is dark to 0.3 of its radius of 0.1 m, 0.09 of the light.
    hidden = paraboloid(2.0, 10.0, aperture=Annulus(0.03, 0.2))
    result = pachon.design.throughput(hidden, [(0.0, 0.0)], 5e-7)
    assert result.value[0, 0] == pytest.approx(0.91, abs=5e-4)
    coarse = pachon.design.throughput(hidden, [(0.0, 0.0)], 5e-7, sampling="gauss")
    assert abs(coarse.value[0, 0] - 0.91) > 5e-3


def test_vignetting_factors_take_their_part_of_the_entrance_pupil(paraboloid):
    factors, fields = ((0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.1, 0.2, 0.5, 0.3)), ((0.0, 0.0), (0.0, 5e-3))
    telescope = paraboloid(2.0, 10.0).with_design(field_type="angle", fields=fields, vignetting=factors)
    result = pachon.design.throughput(telescope, wavelengths=5e-7)
    assert result.value[:, 0] == pytest.approx([1.0, 0.8 * 0.5], rel=1e-12)
    assert result.lit_fraction == pytest.approx(result.value)
    request = pachon.Request.of(telescope, one_wavelength=True)
    light = pachon.design.relative_illumination(request)
    assert light.lit_fraction == pytest.approx([1.0, 0.8 * 0.5], rel=1e-12)


def test_lit_fractions_of_one_request_are_the_same_everywhere(paraboloid):
    factors, fields = ((0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.1, 0.2, 0.5, 0.3)), ((0.0, 0.0), (0.0, 5e-3))
    telescope = paraboloid(2.0, 10.0).with_design(field_type="angle", fields=fields, vignetting=factors)
    request, size = pachon.Request.of(telescope, one_wavelength=True), {"pixels": 9, "pixel": 20e-6}
    for result, tolerance in (
        (pachon.spots(request), 1e-12),
        (pachon.vignetting(request, n_pupil=64), 1e-12),
        (pachon.fft_psf(request, n_pupil=64, **size), 0.02),  # by parts of cells on the rim
        (pachon.huygens_psf(request, sampling="gauss", **size), 1e-12),
    ):
        assert result.lit_fraction == pytest.approx([1.0, 0.8 * 0.5], rel=tolerance), type(result).__name__


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("coatings: {a: {efficiency: [0.9, 1.0]}}", "coatings.a.wavelength_nm"),
        ("coatings: {a: {wavelength_nm: [5, 4], efficiency: [1, 1]}}", "ascending"),
        ("coatings: {a: {wavelength_nm: [4, 5], efficiency: [1, 1.2]}}", "from 0 to 1"),
        ("surfaces: {M1: gold}", "surfaces.M1 = 'gold'"),
        ("coatings: {a: {file: none.csv}}", "none.csv"),
        ("coating: {}", "unknown key coating"),
    ],
)
def test_malformed_files(plate, tmp_path, text, problem):
    path = tmp_path / "coatings.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=problem):
        pachon.design.throughput(plate, coatings=path)


def test_names_and_wavelengths_that_do_not_fit(plate):
    flat = Coating((4e-7, 8e-7), (0.9, 0.9))
    with pytest.raises(UnknownNameError, match="M1"):
        pachon.design.throughput(plate, coatings=Coatings({"M1": flat}))
    with pytest.raises(UnknownNameError, match="flint"):
        pachon.design.throughput(plate, coatings=Coatings({}, {"flint": Absorption(flat, 0.01)}))
    with pytest.raises(DomainError, match="900 nm"):
        pachon.design.throughput(plate, [(0.0, 0.0)], 900e-9, coatings=Coatings({"front": flat}))
