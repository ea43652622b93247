"""Prescriptions in mm: exact to the last bit, in the unit of the lens, with the digits that mean something."""

import re
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.yaml_reader import WrittenFloat, read_mapping
from pachon.models.aperture import Annulus, Circle, Complement, Polygon, Rectangle, Union, Vane
from pachon.models.digits import with_few_digits, with_optimised_digits
from pachon.models.io.yaml.values import Metres, length_text, scaled
from pachon.models.io.yaml.writer import telescope_to_yaml
from pachon.models.shapes.freeform import OddAsphere
from pachon.models.shapes.polynomial import XYPolynomial
from pachon.models.shapes.shape import EvenAsphere
from pachon.models.starting_designs.new import new_prescription

LENSES = Path(__file__).parents[2] / "data" / "zmx"


def test_every_float_comes_back_equal(tmp_path):
    """Decimals move their point: no float of metres is lost in mm, and powers of lengths neither."""
    random = np.random.default_rng(5)
    values = random.standard_normal(300) * 10.0 ** random.uniform(-12, 4, 300)
    for power in (1, -3, -9):
        texts = [length_text(Metres(v, power), "mm") for v in values]
        path = tmp_path / f"{power}.yaml"
        path.write_text("\n".join(f"k{i}: {text}" for i, text in enumerate(texts)))
        read = [scaled(v, -3 * power) for v in read_mapping(path, exact=True).values()]
        assert read == values.tolist()


def test_more_digits_than_a_float_has_are_kept(tmp_path):
    (tmp_path / "a.yaml").write_text("long: 12.3456789012345678901\nshort: 0.1\nsixty: 1:30.5\n")
    read = read_mapping(tmp_path / "a.yaml", exact=True)
    assert type(read_mapping(tmp_path / "a.yaml")["long"]) is float
    assert isinstance(read["long"], WrittenFloat)
    assert read["long"].decimal == Decimal("12.3456789012345678901")
    assert type(read["short"]) is float
    assert read["sixty"] == 90.5


def test_lenses_in_mm_are_written_in_mm(tmp_path):
    lens = pachon.load_telescope(LENSES / "lens1.zmx")
    front = lens.surfaces[0]
    shapes = (
        EvenAsphere(-0.0123, -0.3, (1.1e5, -2.2e9 / 3.0)),
        OddAsphere(-0.0123, 0.1, (1e-3, -2.0 / 3.0, 7.7)),
        XYPolynomial(((2, 0, 0.1 / 3.0), (1, 3, -7.0 / 3.0))),
    )
    for shape in shapes:
        changed = replace(lens, surfaces=(replace(front, shape=shape), *lens.surfaces[1:]))
        text = telescope_to_yaml(changed)
        assert "units: {length: mm," in text
        assert "diameter: 8.333333969116211" in text
        (tmp_path / "lens.yaml").write_text(text)
        assert pachon.load_telescope(tmp_path / "lens.yaml") == changed
    assert "units: {length: m," in telescope_to_yaml(pachon.load_telescope("paul_baker"))


def test_regions_are_in_the_unit_of_the_lens(tmp_path):
    lens = pachon.load_telescope(LENSES / "lens1.zmx")
    corners = ((0.0, 0.001), (0.0011 / 3.0, 0.0), (0.0, -0.0007))
    regions = Union((Polygon(corners), Circle(0.001 / 3.0, x=1e-4), Vane(1e-4, x=2e-4), Rectangle(1e-3, 2e-3)))
    for aperture in (regions, Complement(regions), Annulus(1e-4 / 3.0, 2e-3)):
        front = replace(lens.surfaces[0], aperture=aperture, semi_diameter=0.002 / 3.0)
        changed = replace(lens, surfaces=(front, *lens.surfaces[1:]))
        text = telescope_to_yaml(changed)
        assert "units: {length: mm," in text
        (tmp_path / "lens.yaml").write_text(text)
        assert pachon.load_telescope(tmp_path / "lens.yaml") == changed


def test_what_would_not_come_back_in_mm_is_written_in_metres(monkeypatch):
    lens = pachon.load_telescope(LENSES / "lens1.zmx")
    # As if the lengths of a shape were not marked as such.
    monkeypatch.setattr("pachon.models.io.yaml.writer.shape_items", lambda shape: {"shape": "sphere", "radius": 0.05})
    assert "units: {length: m," in telescope_to_yaml(lens)


def test_new_lenses_have_few_digits():
    _, text = new_prescription("triplet")
    assert "units: {length: mm," in text
    numbers = re.findall(r"(?:z|radius|circle): (-?[\d.]+)", text.partition("surfaces:")[2])
    assert len(numbers) >= 19
    # Nanometres: six decimals of a millimetre.
    assert max(len(number.partition(".")[2]) for number in numbers) <= 6


@pytest.mark.long
@pytest.mark.parametrize("kind", ["triplet", "ritchey-chretien", "schmidt"])
def test_few_digits_change_nothing_that_is_measured(kind):
    from pachon.models.starting_designs.new import new_telescope

    exact = new_telescope(kind)
    few = with_few_digits(exact)
    before, after = (pachon.spots(t, [(0.0, 0.5 * t.field_radius)]).rms_radius[0] for t in (exact, few))
    # Lengths to half a nanometre, at focal ratios of 2.5 and more.
    assert after == pytest.approx(before, rel=1e-4, abs=1e-9)
    for surface, rounded in zip(exact.surfaces, few.surfaces, strict=True):
        outer = [getattr(s.aperture, "radius", None) or s.aperture.outer for s in (surface, rounded)]
        assert 0.0 <= outer[1] - outer[0] <= 1.001e-6


def test_optimised_digits_keep_the_stop():
    lens = pachon.load_telescope(LENSES / "lens1.zmx")
    noisy = replace(
        lens, surfaces=tuple(replace(s, vertex=(0.0, 0.0, s.vertex[2] * (1 + 1e-13))) for s in lens.surfaces)
    )
    rounded = with_optimised_digits(noisy)
    assert rounded.surface("S6").vertex[2] == round(noisy.surface("S6").vertex[2], 12)
    assert rounded.design_data == noisy.design_data
    assert rounded.stop_z == pytest.approx(noisy.stop_z, abs=1e-11)
