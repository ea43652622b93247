import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError


def test_fans_of_a_defocused_paraboloid_in_closed_form(paraboloid):
    f, shift = 2.0, 3e-4
    telescope = paraboloid(f, 4.0, shift=shift)
    fans = pachon.ray_fans(telescope, [[0.0, 0.0]], n_points=9)
    p = 0.25 * fans.pupil
    expected = -p * shift / (f - p**2 / (4 * f))
    for fan in fans.along[0, 0]:
        assert fan == pytest.approx(expected, abs=1e-15)
    # All rays are in phase at the focus; from there to the sphere about the detector by the theorem of cosines.
    opd = pachon.design.opd_fans(telescope, [[0.0, 0.0]], n_points=9, sphere_radius=1.5)
    cosine = (f - p**2 / (4 * f)) / (f + p**2 / (4 * f))
    path = shift * cosine + np.sqrt(1.5**2 - shift**2 * (1 - cosine**2))
    # Paths of some 10 m, rounded.
    assert opd.value[0, 0, 0] == pytest.approx(shift + 1.5 - path, abs=2e-14)
    before = pachon.design.opd_fans(telescope, [[0.0, 0.0]], n_points=9, sphere_radius=-1.5)
    path = shift * cosine - np.sqrt(1.5**2 - shift**2 * (1 - cosine**2))
    assert before.value[0, 0, 1] == pytest.approx(shift - 1.5 - path, abs=2e-14)


def test_a_lens_by_brute_force(singlet, meridional):
    telescope, slope = singlet(3e-3, glass=1.5), np.tan(0.05)
    fans = pachon.ray_fans(telescope, [(0.0, 0.05)], n_points=5)
    height, after = np.transpose([meridional(1.5, 3e-3, y, slope) for y in 5e-3 * fans.pupil])
    landing = height + 0.1 * after
    # The brute force finds the surface to rounding.
    assert fans.along[0, 0, 0] == pytest.approx(landing - landing[2], abs=1e-13)


def test_the_field_may_lie_anywhere_about_the_axis(paraboloid):
    telescope, turn = paraboloid(2.0, 5.0), 0.7
    tangent = 0.01
    at_y = pachon.ray_fans(telescope, [(0.0, tangent)], projection="gnomonic", n_points=5)
    elsewhere = [(-tangent * np.sin(turn), tangent * np.cos(turn))]
    assert pachon.ray_fans(telescope, elsewhere, projection="gnomonic", n_points=5).along == pytest.approx(
        at_y.along, abs=1e-14
    )


def test_blocked_rays_are_marked(paraboloid):
    telescope = paraboloid(2.0, 5.0, baffle=(1.0, 0.11))
    fans = pachon.ray_fans(telescope, [(0.0, 0.0)], n_points=9)
    assert fans.lit[0, 0, 0].tolist() == [False, False, *[True] * 5, False, False]
    table = fans.to_table()
    assert len(table) == 18
    assert str(table["along_field"].unit) == "um"
    assert fans.largest[0] == pytest.approx(0.0, abs=1e-12)


def test_opd_fans_are_those_of_the_map(lsst_r):
    field = np.deg2rad((0.4, 1.2))
    fans = pachon.design.opd_fans(lsst_r, [field], 622e-9, n_points=7)
    slopes = np.tan(field)
    axis = slopes / np.hypot(*slopes)
    points = 4.18 * fans.pupil[:, None] * axis
    opd = pachon.wavefront_opd(lsst_r, field, 622e-9, points.T)
    lit = fans.lit[0, 0, 0]
    # Vignetting alone decides which of them are lit; the map stops at the rim of the pupil too.
    assert fans.value[0, 0, 0][lit & opd.lit] == pytest.approx(opd.value[lit & opd.lit], abs=1e-14)
    assert opd.lit.sum() >= 2


def test_too_few_rays(paraboloid):
    with pytest.raises(DomainError, match="n_points = 2"):
        pachon.ray_fans(paraboloid(), n_points=2)


@pytest.mark.parametrize("angle", [0.7, 0.5 * np.pi, 2.0])
def test_fans_and_lateral_color_turn_with_the_detector(angle):
    """Along the image of the field and across it, whatever the axes of the detector are; but for the sign."""
    telescope = pachon.new_telescope("triplet")
    turned = telescope.perturbed("Detector", tilt=(0.0, 0.0, angle))
    fields, waves = np.deg2rad([[0.0, 10.0], [-6.0, 8.0]]), [480e-9, 550e-9, 650e-9]
    fans, other = (pachon.ray_fans(t, fields, waves, n_points=9).displacement for t in (telescope, turned))
    assert np.abs(fans).max() > 1e-5
    np.testing.assert_allclose(np.abs(other), np.abs(fans), rtol=0, atol=1e-11)
    shift, moved = (pachon.design.lateral_color(t, fields, waves).shift for t in (telescope, turned))
    assert np.abs(shift).max() > 1e-7
    np.testing.assert_allclose(np.abs(moved), np.abs(shift), rtol=0, atol=1e-11)
