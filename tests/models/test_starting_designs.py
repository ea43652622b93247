import math
from functools import cache

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.models.first_order import chromatic_sums, first_order, seidel_sums
from pachon.models.starting_designs.new import KINDS, new_prescription

#: Kinds whose sums of third order vanish: spherical aberration, coma, astigmatism, Petzval sum, distortion, in order.
VANISHING = {
    "ritchey-chretien": [0, 1],
    "gregorian": [0, 1],
    "cassegrain": [0],
    "dall-kirkham": [0],
    "newtonian": [0],
    "schmidt": [0],
    "three-mirror": [0, 1, 2, 3],
    "singlet": [1],
    "doublet": [0],
    "triplet": [0, 1, 2, 4],
}
#: A telescope of each kind: its sums, and contributions, against the largest of both of all of them.
ZERO = 1e-10


@cache
def design(kind):
    return pachon.new_telescope(kind)


@pytest.mark.parametrize("kind", KINDS)
def test_sums_that_should_vanish_vanish(kind):
    sums = seidel_sums(design(kind))
    largest = np.abs(sums.contributions).max()
    assert np.abs(sums.total[VANISHING[kind]]).max() < ZERO * largest
    # The others do not: what vanishes is no accident of small numbers.
    others = sorted(set(range(5)) - set(VANISHING[kind]))
    assert np.abs(sums.total[others]).max() > 1e-4 * largest


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scale", [1.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_focal_length_focus_and_light(kind, scale):
    f_number = 10.0
    diameter = scale * {"singlet": 0.02, "doublet": 0.05, "triplet": 0.01}.get(kind, 1.0)
    telescope = pachon.new_telescope(kind, diameter=diameter, f_number=f_number, field_radius=0.002)
    optics = first_order(telescope)
    # A Schmidt plate has a weak power of its own.
    tolerance = 0.01 if kind == "schmidt" else 1e-9
    assert abs(optics.focal_length) == pytest.approx(f_number * diameter, rel=tolerance)
    assert optics.focus_z == pytest.approx(telescope.surfaces[-1].vertex[2], abs=1e-9 * diameter)
    spots = pachon.spots(telescope, [(0.0, 0.0), (0.0, 0.002)], sampling="rings", n_pupil=6)
    assert spots.lit_fraction == pytest.approx(1.0, abs=0.03)
    assert (spots.rms_radius < 2e-4 * f_number * diameter).all()


def test_achromats_have_no_colour():
    for kind, columns in (("doublet", [0]), ("triplet", [0, 1])):
        sums = chromatic_sums(design(kind))
        assert np.abs(sums.total[columns]).max() < 1e-9 * np.abs(sums.contributions).max()


def test_the_petzval_sum_of_the_triplet():
    telescope = design("triplet")
    lagrange = 0.005 * math.tan(telescope.field_radius)
    # Welford: S4 = H^2 times the Petzval sum.
    petzval = seidel_sums(telescope).total[3] / lagrange**2
    assert petzval * 0.05 == pytest.approx(0.35, rel=1e-9)


def test_hubble():
    # 2.4 m, f/24, primary f/2.3, focus 1.4998 m behind it. Its numbers as in hubble.len of OSLO's user guide
    # (Sinclair Optics 1997).
    telescope = pachon.models.two_mirror("ritchey-chretien", 2.4, 24.0, primary_f_number=2.3, back_focus=1.4998)
    m1, m2, _ = telescope.surfaces
    assert (m1.shape.radius, m2.shape.radius) == pytest.approx((11.04, 1.358), rel=1e-3)
    assert (m1.shape.conic, m2.shape.conic) == pytest.approx((-1.002299, -1.4960), rel=1e-3)
    assert m2.vertex[2] == pytest.approx(4.9061, rel=1e-3)


def test_the_schmidt_is_best_on_its_sphere():
    telescope = pachon.models.schmidt(0.5, 2.5)
    on_sphere = pachon.spots(telescope, sampling="rings", n_pupil=8)
    # The same spots over the field, but for the obliquity of the plate.
    assert on_sphere.rms_radius == pytest.approx(on_sphere.rms_radius[0], rel=0.1)
    assert telescope.surfaces[-1].shape.radius == pytest.approx(1.25, rel=0.01)


@pytest.mark.parametrize("kind", [*KINDS][::3])
def test_files_have_comments_and_load_back(kind, tmp_path):
    telescope, text = new_prescription(kind)
    path = tmp_path / "new.yaml"
    path.write_text(text)
    assert pachon.load_telescope(path) == telescope
    assert text.startswith("# ")
    assert "# in the order of the light" in text


@pytest.mark.parametrize(
    ("kind", "options", "problem"),
    [
        ("refractor", {}, "kind = 'refractor'"),
        ("triplet", {"back_focus": 0.1}, "back_focus = 0.1"),
        ("cassegrain", {"f_number": 2.0}, "primary_f_number = 2.5"),
        ("newtonian", {"field_radius": 0.1}, "the flat covers the primary"),
        ("ritchey-chretien", {"field_radius": 0.3}, "the secondary needs"),
        ("schmidt", {"diameter": -1.0}, "diameter = -1.0"),
        ("gregorian", {"back_focus": -10.0}, "back_focus = -10.0"),
    ],
)
def test_impossible_telescopes(kind, options, problem):
    with pytest.raises((ConfigError, DomainError), match=problem):
        pachon.new_telescope(kind, **options)
