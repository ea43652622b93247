import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.models.first_order import first_order

LINES = np.array([486.1327e-9, 587.5618e-9, 656.2725e-9])


def test_a_thin_lens_shifts_its_focus_by_f_over_v(singlet):
    telescope = singlet()
    result = pachon.design.chromatic_focus(telescope, LINES)
    # By the definition of V, to the dispersion of the focal length, 1/V.
    assert result.focus[2, 0] - result.focus[0, 0] == pytest.approx(0.1 / 64.17, rel=0.02)
    paraxial = [first_order(telescope, w).focus_z for w in LINES]
    # Close rays are 1e-3 of the pupil from the axis: spherical aberration, 1 mm at the rim, by a millionth.
    assert result.shift[:, 0] == pytest.approx(paraxial[1] - np.array(paraxial), abs=2e-9)
    assert result.depth == pytest.approx(2 * LINES[1] * 10.0**2, rel=0.01)


def test_zones_by_brute_force(singlet, meridional):
    telescope = singlet(3e-3)
    index = float(telescope.surfaces[0].medium_after.index(LINES[0]))
    result = pachon.design.chromatic_focus(telescope, LINES[:1], zones=[0.5, 1.0])
    for k, zone in enumerate((0.5, 1.0), 1):
        height, slope = meridional(index, 3e-3, zone * 5e-3, 0.0)
        assert result.focus[0, k] == pytest.approx(-height / slope - 0.1, abs=1e-12)


def test_lateral_colour_by_brute_force(singlet, meridional):
    telescope, angle = singlet(3e-3, stop_z=0.02), 0.05
    result = pachon.design.lateral_color(telescope, [(0.0, 0.0), (0.0, angle)], LINES)
    landing = []
    for w in LINES:
        index = float(telescope.surfaces[0].medium_after.index(w))
        height, slope = meridional(index, 3e-3, 0.02 * np.tan(angle), np.tan(angle))
        landing.append(height + 0.1 * slope)
    assert result.shift[1] == pytest.approx(np.array(landing) - landing[1], abs=1e-13)
    assert result.shift[0] == pytest.approx(0.0, abs=1e-15)
    assert result.spread[1] == pytest.approx(abs(landing[2] - landing[0]), abs=1e-13)


def test_mirrors_have_no_colour(paraboloid):
    telescope = paraboloid(2.0, 10.0)
    assert len(pachon.design.lateral_color(telescope, [(0.0, 0.01)]).wavelengths) == 5
    assert pachon.design.lateral_color(telescope, [(0.0, 0.01)]).shift == pytest.approx(0.0, abs=1e-14)
    assert pachon.design.chromatic_focus(telescope).focus == pytest.approx(0.0, abs=1e-12)


def test_bad_zones(paraboloid, afocal):
    with pytest.raises(DomainError, match="zones = "):
        pachon.design.chromatic_focus(paraboloid(), zones=[0.0, 1.0])
    with pytest.raises(DomainError, match="expected one with a focus"):
        pachon.design.chromatic_focus(afocal(fold=False))


def test_a_request_has_telescope_and_wavelengths(paraboloid):
    telescope = paraboloid()
    request = pachon.Request.of(telescope, wavelengths=LINES)
    np.testing.assert_array_equal(
        pachon.design.chromatic_focus(request).focus, pachon.design.chromatic_focus(telescope, LINES).focus
    )
    one = pachon.Request.of(telescope, wavelengths=LINES[0])
    expected = pachon.design.seidel_diagram(telescope, LINES[0]).coefficients
    np.testing.assert_array_equal(pachon.design.seidel_diagram(one).coefficients, expected)
    with pytest.raises(ConfigError, match=r"wavelengths = .*: given beside a Request"):
        pachon.design.chromatic_focus(request, LINES)
