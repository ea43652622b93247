from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from pachon.core.errors import DomainError
from pachon.core.plotting import png_bytes
from pachon.design.metrics.principal_rays import MARGINAL, principal_rays
from pachon.models.first_order import first_order
from pachon.models.io.prescription import load_telescope
from pachon.wavefront.pupil_sampling import gauss_annulus

LENS = Path(__file__).parents[2] / "data" / "zmx" / "lens_thorlabs_iso_8859_1.zmx"


@pytest.mark.parametrize("name", ["lsst_v3.3_r", "paul_baker", "hsc", "decam", LENS], ids=str)
def test_on_the_axis_they_are_the_paraxial_figures(name):
    telescope = load_telescope(name)
    figures, rays = first_order(telescope), principal_rays(telescope, [[0.0, 0.0]])
    # Neighbours at 1e-4 rad: third order is 1e-8 of a length, and the pupil's own at 1 % of its radius 1e-4 or less.
    place = [0, 0, figures.exit_pupil_z]
    assert rays.exit_pupil[0] == pytest.approx(place, abs=3e-6 * abs(figures.exit_pupil_z - telescope.stop_z))
    assert rays.exit_pupil_diameter[0] == pytest.approx([figures.exit_pupil_diameter] * 2, rel=3e-5)
    # The detector stands some 0.1 mm from the paraxial focus, metres from the exit pupil.
    assert rays.plate_scale[0] == pytest.approx([abs(figures.plate_scale)] * 2, rel=7e-5)
    if name is not LENS:
        # Telescopes fulfil the sine condition; the lens, at f/0.9, by some per cent.
        assert rays.f_number[0] == pytest.approx([abs(figures.f_number)] * 2, rel=3e-5)
    assert rays.chief_angle[0] == pytest.approx(0.0, abs=1e-7)


def test_a_paraboloid_with_its_stop_in_front(paraboloid):
    focal_length, stop = 2.0, 0.5
    rays = principal_rays(paraboloid(focal_length, 20.0, stop_z=stop), [[0.0, 0.0], [0.0, 0.005]])
    # 1/s' = 1/f - 1/stop: the image of the stop is virtual, 2/3 m behind the mirror and 4/3 times as large.
    assert rays.exit_pupil[0, 2] == pytest.approx(-2 / 3, abs=1e-7)
    assert rays.exit_pupil_distance[0] == pytest.approx([-8 / 3] * 2, abs=1e-7)
    assert rays.exit_pupil_diameter[0] == pytest.approx([0.1 * 4 / 3] * 2, rel=1e-6)


def test_a_stop_at_the_focus_is_telecentric(paraboloid):
    rays = principal_rays(paraboloid(2.0, 20.0, stop_z=2.0), [[0.0, 0.0]])
    # Infinite but for rounding: 1e-16 of direction over the neighbours' 1e-4.
    assert (~np.isfinite(rays.exit_pupil_distance) | (np.abs(rays.exit_pupil_distance) > 1e8)).all()
    assert png_bytes(rays.plot()).startswith(b"\x89PNG")


def test_the_focal_ratio_of_a_fast_paraboloid(paraboloid):
    focal_length, f_number = 2.0, 1.0
    rays = principal_rays(paraboloid(focal_length, f_number), [[0.0, 0.0]])
    rim = 0.5 * focal_length / f_number

    def sine(h):
        # The ray from height h on z = h^2 / 4f to the focus.
        return h / focal_length / (1 + (h / (2 * focal_length)) ** 2)

    # The linear fit over the disc of direction cosines sine(h) (cos t, sin t) on h (cos t, sin t).
    slope = quad(lambda h: sine(h) * h * h, 0, rim)[0] / quad(lambda h: h**3, 0, rim)[0]
    assert rays.f_number[0] == pytest.approx([1 / (2 * rim * slope)] * 2, rel=1e-9)
    top = rays.marginal_direction[0, MARGINAL.index("tangential +")]
    assert abs(top[1]) == pytest.approx(sine(rim), rel=1e-12)
    assert rays.marginal_position[0] == pytest.approx(np.tile([0, 0, focal_length], (4, 1)), abs=1e-14)


def test_scales_and_focal_ratios_off_axis_are_those_of_batoid(lsst_r):
    batoid = pytest.importorskip("batoid")
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    field = np.deg2rad([0.0, 1.5])
    rays = principal_rays(lsst_r, field, 622e-9)
    jacobian = batoid.analysis.drdth(optic, *field, 622e-9, projection="gnomonic")
    # batoid follows the centroid of a polar grid, we the chief ray: coma differs across the field by 1e-5 of the scale.
    tilt = 1 + np.tan(field[1]) ** 2
    scale = 1 / (jacobian[1, 1] * tilt), 1 / (jacobian[0, 0] * np.sqrt(tilt))
    assert rays.plate_scale[0] == pytest.approx(np.abs(scale), rel=2e-4)
    pupil = gauss_annulus(4.18, 0.612, 6, 24)
    traced = batoid.RayVector.fromStop(
        *pupil.points.T, optic=optic, wavelength=622e-9, theta_x=field[0], theta_y=field[1], projection="zemax"
    )
    optic.trace(traced)
    lit = ~traced.vignetted
    assert 0.9 < lit.mean() < 1
    for direction, ratio in zip((traced.vy, traced.vx), rays.f_number[0], strict=True):
        terms = np.stack([np.ones(lit.sum()), *pupil.points[lit].T], axis=-1)
        fit, *_ = np.linalg.lstsq(
            terms * np.sqrt(pupil.weights[lit])[:, None], direction[lit] * np.sqrt(pupil.weights[lit]), rcond=None
        )
        # By symmetry the other component of the slope is zero.
        assert ratio == pytest.approx(1 / (8.36 * np.linalg.norm(fit[1:])), rel=1e-9)


def test_tangential_and_sagittal_turn_with_the_field(lsst_r):
    angle = np.deg2rad(1.6)
    turned = angle * np.stack([np.cos([0.3, 2.0]), np.sin([0.3, 2.0])], axis=-1)
    # The "postel" projection keeps the distance from the axis.
    one, two = (principal_rays(lsst_r, field, projection="postel") for field in turned)
    for key in ("f_number", "plate_scale", "exit_pupil_distance", "exit_pupil_diameter", "chief_angle"):
        assert getattr(one, key) == pytest.approx(getattr(two, key), rel=1e-6)
    assert np.linalg.norm(one.chief_landing) == pytest.approx(np.linalg.norm(two.chief_landing), rel=1e-12)
    assert one.f_number[0, 0] > one.f_number[0, 1] * 1.001


def test_a_chief_ray_that_does_not_arrive_is_one_line(lsst_r):
    # A concave mirror of 8 m radius that stands 20 m aside.
    lost = lsst_r.perturbed("M3", shift=(20.0, 0.0, 0.0))
    with pytest.raises(DomainError, match=r"field = \(0, 0\) deg: the chief ray does not reach the detector"):
        principal_rays(lost, [[0.0, 0.0]])


@pytest.mark.parametrize("fold", [False, True], ids=["plate", "fold mirror"])
def test_parallel_light_has_an_infinite_focal_ratio(afocal, fold):
    found = principal_rays(afocal(fold), np.deg2rad([[0.0, 0.0], [0.1, 0.3]]))
    assert np.isposinf(found.f_number).all()
    assert found.exit_pupil_diameter == pytest.approx(0.02, rel=1e-4)
