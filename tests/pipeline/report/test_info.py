"""Description of telescopes that are not centred, and of apertures that are not discs."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

import pachon
from pachon.models.first_order import first_order
from pachon.models.io.bundled import BUNDLED
from pachon.models.io.prescription import load_telescope
from pachon.pipeline.report.info import FIRST_ORDER_KEYS, coefficient_lines, describe, figure_rows, surface_rows


@pytest.mark.parametrize("name", BUNDLED)
def test_every_bundled_telescope_can_be_described(name):
    telescope = load_telescope(name)
    description = describe(telescope)
    json.dumps(description)
    assert len(surface_rows(description)) == len(telescope.surfaces)
    assert all(value for _, value in figure_rows(description))
    # As built or folded, a telescope has no axis to have first-order figures about.
    centred = not name.startswith(("rubin", "auxtel"))
    # None of them is afocal.
    assert description["angular_magnification"] is None
    near = {"image_z_m", "magnification", "working_f_number"}
    assert not any(description[key] for key in near)
    others = [key for key in FIRST_ORDER_KEYS if key not in near | {"angular_magnification"}]
    assert all((description[key] is not None) == centred for key in others)
    if centred:
        assert description["focal_length_m"] == first_order(telescope).focal_length


def test_a_near_object_has_an_image_and_a_magnification():
    lens = load_telescope(Path(__file__).parents[2] / "data" / "zmx" / "lens1.zmx")
    near = replace(lens, object_distance=lens.stop_z + 0.3)
    optics, description = first_order(near), describe(near)
    assert description["magnification"] == optics.magnification < 0.0
    rows = dict(figure_rows(description))
    assert rows["magnification"] == f"{optics.magnification:.7g}"
    assert rows["paraxial image"] == f"z = {optics.image_z * 1e3:.7g} mm"
    assert rows["working focal ratio"] == f"f/{optics.working_f_number:.4f}"
    # Of an object at infinity there are a plate scale and a focus instead.
    assert not {"plate scale", "paraxial focus", "focal ratio"} & set(rows)
    assert {"plate scale", "paraxial focus", "focal ratio"} < set(dict(figure_rows(describe(lens))))


def test_apertures_of_every_kind_are_named():
    description = describe(load_telescope("decam"))
    rows = {row["name"]: (row["type"], row["clear_m"], row["aperture"]) for row in description["surfaces"]}
    assert rows["PM"] == ("mirror", [0.6684, 2.005], "annulus: [0.6684, 2.005]")
    assert rows["CAGE_MID"] == ("baffle", [0.7896, None], "obscuration: {circle: 0.7896}")
    assert rows["SPIDER"][1] is None
    assert rows["SPIDER"][2].startswith("obscuration: {union: [{rectangle: [0.019, 5], angle: -45}")
    text = {row[0]: row[-1] for row in surface_rows(description)}
    assert text["PM"] == "0.6684 to 2.005"
    assert text["CAGE_MID"] == "from 0.7896"
    assert text["SPIDER"] == "another region"


def test_what_follows_other_values_is_shown():
    lens = load_telescope(Path(__file__).parents[2] / "data" / "zmx" / "lens1.zmx")
    lens = lens.with_design(
        pickups=(
            pachon.models.Pickup("S7", "radius", "S1", -1.0),
            pachon.models.Pickup("S6", "thickness", "S1", 2.0, -1e-3),
            pachon.models.Pickup("S6", "conic", "S1", offset=0.5),
            pachon.models.Pickup("S6", "glass", "S1"),
        ),
        solves=(
            pachon.models.Solve("S7", "marginal_height"),
            pachon.models.Solve("S3", "edge_thickness", 1e-3, radius=4e-3),
        ),
    )
    assert [text for name, text in figure_rows(describe(lens)) if name == "follows"] == [
        "S7 radius: -1 times that of S1",
        "S6 thickness: 2 times that of S1 - 1",
        "S6 conic: that of S1 + 0.5",
        "S6 glass: that of S1",
        "S7 thickness: marginal height 0 mm",
        "S3 thickness: edge thickness 1 mm at 4 mm",
    ]


def test_terms_of_every_shape_are_shown():
    """Terms of shapes beside conics and even aspheres are named as in optimisations, lengths in the file's unit."""
    lens = load_telescope(Path(__file__).parents[2] / "data" / "zmx" / "lens1.zmx")
    odd = pachon.models.OddAsphere(0.05, -1.5, (0.0, 0.0, -2.0, 0.0, 3e4))
    bent = pachon.Conic(0.1, 0.5), pachon.models.XYPolynomial(((1, 2, 7.0),))
    shapes = {lens.surface_names[0]: odd, lens.surface_names[1]: pachon.models.Sum(bent)}
    for name, shape in shapes.items():
        lens = lens.with_shape(name, shape)
    description = describe(lens)
    json.dumps(description)
    # A coefficient of r^3 is in 1/mm^2 = 1e6/m^2, of r^5 in 1/mm^4.
    assert coefficient_lines(description)[:2] == [
        f"{lens.surface_names[0]}: radius 50, conic -1.5, a3 -2e-06, a5 3e-08",
        f"{lens.surface_names[1]}: radius 100, conic 0.5, x1y2 7e-06",
    ]
