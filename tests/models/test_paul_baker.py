import math

import numpy as np
import pytest
from conic_trace import fan_coefficients, land

from pachon.core.errors import DomainError
from pachon.models.aperture import Circle
from pachon.models.first_order import first_order, seidel_sums
from pachon.models.io.prescription import load_telescope
from pachon.models.paul_baker import COPLANAR, paul_baker
from pachon.models.shapes.shape import Conic, Sphere

DESIGN = paul_baker()
COMPRESSIONS = [0.2, COPLANAR, 0.3, (3 - math.sqrt(5)) / 2, 0.45]
# A sum counts as zero against the largest contribution of a surface: rounding only.
ZERO = 1e-12


def rows(telescope):
    """Return the mirrors as (vertex z, radius, conic, None)."""
    return [(s.vertex[2], s.shape.radius, s.shape.conic, None) for s in telescope.surfaces[:-1]]


def relative_sums(telescope):
    sums = seidel_sums(telescope)
    return sums.total / np.abs(sums.contributions).max(axis=0)


def coefficients(telescope, degrees, *, mirrors=None):
    """Return Taylor coefficients of both fans at a field, against the paraxial focus."""
    focus = first_order(telescope).focus_z
    tangent = math.tan(math.radians(degrees))
    return fan_coefficients(
        mirrors or rows(telescope), focus, telescope.stop_z, telescope.pupil_diameter / 2, tangent, degree=11
    )


def test_the_bundled_file_holds_the_functions_figures():
    bundled = load_telescope("paul_baker")
    for ours, theirs in zip(bundled.surfaces, DESIGN.surfaces, strict=True):
        assert type(ours.shape) is type(theirs.shape)
        assert np.allclose(ours.vertex, theirs.vertex, rtol=1e-12, atol=1e-12)
        for figure in ("curvature", "conic"):
            assert getattr(ours.shape, figure) == pytest.approx(getattr(theirs.shape, figure), rel=1e-12)
    assert bundled == DESIGN


@pytest.mark.parametrize("m", COMPRESSIONS)
@pytest.mark.parametrize("focal_ratio", [1.25, 4.0])
def test_four_seidel_sums_vanish(m, focal_ratio):
    telescope = paul_baker(focal_ratio=focal_ratio, beam_compression=m, field_radius=1e-3)
    assert np.abs(relative_sums(telescope)[:4]).max() < ZERO
    # Distortion is left.
    assert abs(relative_sums(telescope)[4]) > 0.1


def test_sums_vanish_wherever_the_stop_is():
    fields = {f: getattr(DESIGN, f) for f in DESIGN.__dataclass_fields__}
    for stop_z in (-20.0, 0.0, 18.0, 40.0):
        assert np.abs(relative_sums(type(DESIGN)(**(fields | {"stop_z": stop_z})))[:4]).max() < ZERO


@pytest.mark.parametrize("m", COMPRESSIONS)
def test_layout_is_the_classical_one(m):
    telescope = paul_baker(beam_compression=m, field_radius=1e-3)
    (z1, r1, k1, _), (z2, r2, k2, _), (z3, r3, k3, _) = rows(telescope)
    # Paraboloid; M2's focus at M1's (so light is parallel after it); sphere about M2's vertex; Petzval; M2's conic.
    assert (z1, k1, k3) == (0.0, -1.0, 0.0)
    assert isinstance(telescope.surface("M3").shape, Sphere)
    assert z2 + r2 / 2 == pytest.approx(r1 / 2, rel=1e-13)
    assert z3 + r3 == pytest.approx(z2, rel=1e-13)
    assert 1 / r1 - 1 / r2 + 1 / r3 == pytest.approx(0.0, abs=1e-15)
    assert k2 == pytest.approx(-1 + (r2 / r3) ** 3, rel=1e-13)
    assert r2 / r1 == pytest.approx(m, rel=1e-13)
    figures = first_order(telescope)
    assert figures.f_number == pytest.approx(4.0, rel=1e-12)
    assert telescope.surface("Detector").vertex[2] == pytest.approx(figures.focus_z, abs=1e-12)


def test_the_default_is_8_4_m_with_primary_and_tertiary_on_one_vertex():
    assert DESIGN.pupil_diameter == 8.4
    assert DESIGN.surface("M3").vertex[2] == 0.0
    # The shortcut to zero hides no more than rounding.
    (_, _, _, _), (z2, _, _, _), (_, r3, _, _) = rows(DESIGN)
    assert z2 - r3 == pytest.approx(0.0, abs=1e-13)
    # With the golden section squared the focus lies on the primary's vertex (Willstrop 1985).
    golden = paul_baker(beam_compression=(3 - math.sqrt(5)) / 2, field_radius=1e-3)
    assert golden.surface("Detector").vertex[2] == pytest.approx(0.0, abs=1e-13)


def test_on_axis_aberration_falls_with_the_fifth_power_of_the_pupil():
    focus, radius = first_order(DESIGN).focus_z, 4.2

    def aberration(share, mirrors):
        return land(mirrors, focus, DESIGN.stop_z, 0.0, share * radius, 0.0)[0][0, 1]

    ratio = aberration(0.5, rows(DESIGN)) / aberration(0.25, rows(DESIGN))
    # 2^5 but for the seventh order, which at f/8 is down by (1/16)^2 times a number of order one.
    assert ratio == pytest.approx(32.0, rel=0.02)
    # What the test would see otherwise: a conic off by 0.01 leaves the third order, 2^3.
    spoilt = [(z, r, k + 0.01 * (i == 1), n) for i, (z, r, k, n) in enumerate(rows(DESIGN))]
    assert aberration(0.5, spoilt) / aberration(0.25, spoilt) == pytest.approx(8.0, rel=0.25)


def test_coma_and_astigmatism_vanish_to_third_order():
    one, x_one = coefficients(DESIGN, 0.5)
    half, x_half = coefficients(DESIGN, 0.25)
    axis, _ = coefficients(DESIGN, 0.0)
    # The term in pupil^2 starts with field^1 if there is third-order coma, else with field^3: a ratio of 2 or 8.
    assert one[2] / half[2] == pytest.approx(8.0, rel=0.02)
    # The terms in pupil^1 start with field^2 (astigmatism, field curvature), else with field^4: 4 or 16.
    for off, near in ((one, half), (x_one, x_half)):
        assert (off[1] - axis[1]) / (near[1] - axis[1]) == pytest.approx(16.0, rel=0.02)
    # On a pupil of unit radius the pure third-order spherical term is nothing against what is left of fifth order.
    assert abs(axis[3]) < 1e-6 * abs(axis[5])


def test_the_scaling_test_sees_coma_and_field_curvature_where_there_are_some():
    # Tertiary moved along the axis, its centre off M2: third-order coma.
    moved = [(z + 0.2 * (i == 2), r, k, n) for i, (z, r, k, n) in enumerate(rows(DESIGN))]
    ratio = coefficients(DESIGN, 0.5, mirrors=moved)[0][2] / coefficients(DESIGN, 0.25, mirrors=moved)[0][2]
    assert ratio == pytest.approx(2.0, rel=0.05)
    # Paul's own: spherical M2 and M3 of one radius, a curved field. Sagittal and meridional focus agree.
    (_, r1, _, _), (z2, r2, _, _), _ = rows(DESIGN)
    paul = [(0.0, r1, -1.0, None), (z2, r2, 0.0, None), (z2 - r2, r2, 0.0, None)]
    focus = z2 - r2 / 2

    def linear(degrees):
        tangent = math.tan(math.radians(degrees))
        y, x = fan_coefficients(paul, focus, DESIGN.stop_z, 4.2, tangent, degree=11)
        return np.array([y[1], x[1]])

    at_axis = linear(0.0)
    one, half = linear(0.5) - at_axis, linear(0.25) - at_axis
    assert one / half == pytest.approx(4.0, rel=0.02)
    assert one[0] == pytest.approx(one[1], rel=0.05)


def test_fifth_order_spherical_goes_as_the_fifth_power_of_the_focal_ratio():
    def blur(focal_ratio):
        telescope = paul_baker(focal_ratio=focal_ratio, field_radius=1e-3)
        figures = first_order(telescope)
        rim = land(rows(telescope), figures.focus_z, telescope.stop_z, 0.0, 4.2, 0.0)[0][0, 1]
        return abs(rim) / figures.focal_length

    # Seventh order is down by (1 / 4 F)^2 with a factor of a few.
    assert blur(8.0) / blur(16.0) == pytest.approx(32.0, rel=0.03)


def test_mirrors_catch_all_light_of_the_field():
    angle = np.linspace(0, 2 * np.pi, 100)
    inner, outer = DESIGN.surface("M1").aperture.inner, DESIGN.surface("M1").aperture.outer
    x = np.concatenate([inner * np.cos(angle), outer * np.cos(angle)])
    y = np.concatenate([inner * np.sin(angle), outer * np.sin(angle)])
    landing, points = land(
        rows(DESIGN), DESIGN.surface("Detector").vertex[2], DESIGN.stop_z, x, y, math.tan(DESIGN.field_radius)
    )
    for surface, where in zip(DESIGN.surfaces[1:], [*points[1:], landing], strict=True):
        assert isinstance(surface.aperture, Circle)
        assert surface.aperture.contains(where[:, 0], where[:, 1]).all()
    # The primary's hole clears the tertiary and the secondary's shadow.
    assert inner >= max(DESIGN.surface(m).aperture.radius for m in ("M2", "M3"))
    assert DESIGN.pupil_obscuration == inner / outer


def test_images_are_an_eighth_of_an_arcsecond_over_the_field():
    # The figure that the page on this telescope states: rms radius about the centroid.
    radius = np.sqrt(np.linspace(DESIGN.surface("M1").aperture.inner ** 2, 4.2**2, 20))
    angle = np.arange(36) * np.pi / 18
    x, y = (radius[:, None] * np.cos(angle)).ravel(), (radius[:, None] * np.sin(angle)).ravel()
    for degrees in (0.0, 0.25, 0.5):
        where, _ = land(rows(DESIGN), first_order(DESIGN).focus_z, DESIGN.stop_z, x, y, math.tan(math.radians(degrees)))
        spread = where[:, :2] - where[:, :2].mean(axis=0)
        rms = np.sqrt(np.mean(np.sum(spread**2, axis=1))) / 33.6 * 206265
        assert 0.10 < rms < 0.14


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"diameter": 0.0}, "diameter = 0.0: expected a positive, finite number"),
        ({"focal_ratio": -1.0}, "focal_ratio = -1.0"),
        ({"field_radius": float("nan")}, "field_radius = nan"),
        ({"beam_compression": 0.5}, "beam_compression = 0.5: expected 0.001 to 0.5"),
        ({"field_radius": 0.05}, "field_radius = 0.05: the tertiary needs"),
    ],
)
def test_impossible_designs_are_refused(arguments, expected):
    with pytest.raises(DomainError, match=expected):
        paul_baker(**arguments)


def test_secondary_is_an_ellipsoid():
    conic = DESIGN.surface("M2").shape
    assert isinstance(conic, Conic)
    # Between a paraboloid (-1) and a sphere (0).
    assert -1 < conic.conic < 0
