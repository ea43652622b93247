"""Lenses of a file as groups."""

from pathlib import Path

import pytest

from pachon.models.element_groups import element_groups
from pachon.models.io.prescription import load_telescope
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.shape import Plane
from pachon.models.surface import Interaction, Surface

DATA = Path(__file__).parents[1] / "data" / "zmx"
AIR, CROWN, FLINT = ConstantIndex(1.0), ConstantIndex(1.5), ConstantIndex(1.7)


def surfaces(*steps):
    """Surfaces from names, interactions and the media behind them."""
    return [Surface(name, kind, Plane(), (0.0, 0.0, -float(i)), medium) for i, (name, kind, medium) in enumerate(steps)]


def test_cemented_elements_and_planes_within_a_lens_are_one_body():
    into, crossed, image = Interaction.REFRACT, Interaction.PASS, Interaction.DETECTOR
    rows = surfaces(
        ("front", crossed, AIR), ("a", into, CROWN), ("b", into, FLINT), ("stop", crossed, FLINT), ("c", into, AIR),
        ("L2", into, CROWN), ("e", into, AIR), ("image", image, AIR),
    )  # fmt: skip
    # A surface has the name of the second: it goes to the next that is free.
    assert element_groups(rows, AIR) == {"L1": ("a", "b", "stop", "c"), "L3": ("L2", "e")}


def test_mirrors_are_no_lenses_and_light_comes_back_through_glass():
    into, mirror = Interaction.REFRACT, Interaction.MIRROR
    rows = surfaces(("a", into, CROWN), ("back", mirror, CROWN), ("a again", into, AIR), ("m", mirror, AIR))
    assert element_groups(rows, AIR) == {"L1": ("a", "back", "a again")}
    assert element_groups(rows[3:], AIR) == {}


@pytest.mark.parametrize(
    ("name", "count"), [("lens1", 3), ("circular_aperture_example_with_aperture", 8), ("HoO-V2C18Ex03", 0)]
)
def test_lens_files_have_their_lenses(name, count):
    telescope = load_telescope(DATA / f"{name}.zmx")
    assert tuple(telescope.groups) == tuple(f"L{i}" for i in range(1, count + 1))
