from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.models.aperture import Circle
from pachon.models.design_data import DesignData
from pachon.raytrace.launch import launch_bundles
from pachon.raytrace.rays import field_direction

DATA = Path(__file__).parents[2] / "data" / "zmx"


def test_a_small_stop_at_the_mirror_gives_the_fourth_power_of_the_cosine(paraboloid):
    # The image is f tan(theta), without distortion: cos^4. At f/100 to the square of the aperture.
    fields = np.stack([np.zeros(3), np.deg2rad([0.0, 1.0, 2.0])], axis=-1)
    result = pachon.design.relative_illumination(paraboloid(2.0, 100.0), fields, n_pupil=64)
    assert result.relative == pytest.approx(np.cos(fields[:, 1]) ** 4, abs=2e-5)
    assert result.f_number == pytest.approx(100.0, rel=1e-4)


def test_the_solid_angle_is_that_of_the_rays_that_meet_at_a_point(singlet):
    telescope, w = singlet(3e-3, stop_z=0.01), 587e-9
    turn = np.linspace(0.0, 2.0 * np.pi, 361)
    rim = 5e-3 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)[:, None]
    for angle in (0.0, 0.2):
        rays = pachon.launch_rays(telescope, (0.0, angle), w, ([0.0], [0.0]))
        aim = pachon.trace(telescope, rays).position[0, :2]
        # Newton's method: the field whose ray through each point of the rim meets the detector there.
        slopes = np.tile([0.0, np.tan(angle)], (361, 1))
        for _ in range(6):
            ends = [pachon.trace(telescope, launched(telescope, slopes + step, w, rim)) for step in STEPS]
            miss = ends[0].position[:, :2] - aim
            jacobian = np.stack([(e.position[:, :2] - ends[0].position[:, :2]) / 1e-6 for e in ends[1:]], axis=-1)
            slopes = slopes - np.linalg.solve(jacobian, miss[..., None])[..., 0]
        assert np.abs(miss).max() < 1e-9
        x, y = ends[0].direction[:, :2].T
        area = 0.5 * abs((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
        result = pachon.design.relative_illumination(telescope, [(0.0, angle)], w, n_pupil=500)
        # The polygon of 360 sides: 5e-5; 500 points at equal areas: 1e-4; at 0.2 rad the rays of one field land some
        # 0.1 mm apart, and over that the irradiance changes by 4e-4.
        assert result.solid_angle[0] == pytest.approx(area, rel=2e-4 if angle == 0.0 else 8e-4)


STEPS = np.array([[0.0, 0.0], [1e-6, 0.0], [0.0, 1e-6]])


def launched(telescope, slopes, wavelength, rim):
    return launch_bundles(telescope, field_direction(*slopes.T, "gnomonic"), wavelength, rim)


def test_parallel_chief_rays_of_a_near_object():
    # A lens for lithography, telecentric on both sides, whose rays meet to some micrometres: its cone of light itself.
    telescope = pachon.load_telescope(DATA / "US05831776-1.zmx")
    assert telescope.design_data.telecentric
    result = pachon.design.relative_illumination(telescope, n_pupil=2000)
    turn = np.linspace(0.0, 2.0 * np.pi, 721)
    rim = 0.5 * telescope.pupil_diameter * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    request = pachon.Request.of(telescope, result.fields, result.wavelength)
    directions = pachon.trace(telescope, request.launch(result.wavelength, rim)).direction
    x, y = directions.reshape(len(result.fields), 721, 3)[..., :2].transpose(2, 0, 1)
    area = 0.5 * np.abs((x[:, :-1] * y[:, 1:] - x[:, 1:] * y[:, :-1]).sum(axis=1))
    assert result.solid_angle == pytest.approx(area, rel=1e-3)
    assert result.relative == pytest.approx(1.0, abs=1e-3)


def test_vignetting_counts(paraboloid):
    telescope = paraboloid(2.0, 10.0, baffle=(1.0, 0.05))
    # A baffle of half the radius lets a quarter of the light through; on the axis relative to itself.
    result = pachon.design.relative_illumination(telescope, [(0.0, 0.0)], n_pupil=4000)
    assert result.lit_fraction[0] == pytest.approx(0.25, abs=5e-3)
    assert result.relative[0] == 1.0


def test_coatings_take_their_part_of_the_light(paraboloid, singlet):
    # The same efficiency for every ray is nothing relative to the axis, and a factor of the solid angle.
    telescope, fields = paraboloid(2.0, 10.0), [(0.0, 0.01)]
    silver = pachon.design.Coatings({telescope.surface_names[0]: pachon.models.Coating((3e-7, 2e-6), (0.9, 0.9))})
    plain = pachon.design.relative_illumination(telescope, fields, n_pupil=100)
    coated = pachon.design.relative_illumination(telescope, fields, coatings=silver, n_pupil=100)
    assert coated.solid_angle == pytest.approx(0.9 * plain.solid_angle, rel=1e-14)
    assert coated.relative == pytest.approx(plain.relative, rel=1e-14)
    # Bare surfaces: the throughput, each ray by the solid angle of its own; 3 mm wide they are alike to 1e-4.
    lens, w, fields = singlet(3e-3, stop_z=0.01), 587e-9, [(0.0, 0.0), (0.0, 0.2)]
    plain, bare = (
        pachon.design.relative_illumination(lens, fields, w, coatings=c, n_pupil=500)
        for c in (None, pachon.design.Coatings())
    )
    passed = pachon.design.throughput(lens, fields, w, sampling="spiral", n_pupil=500).value[:, 0]
    assert bare.solid_angle / plain.solid_angle == pytest.approx(passed, rel=1e-4)
    assert passed[0] > passed[1] + 1e-5


#: Negative meniscus in front of the stop: pupil aberration makes the entrance pupil larger off the axis.
RETROFOCUS = """\
VERS 140124 258 36214
MODE SEQ
UNIT MM X W X CM MR CPMM
FLOA
FTYP 0 0 1 1 0 0 0
XFLN 0
YFLN 40
WAVM 1 0.5875618 1
PWAV 1
SURF 0
  CURV 0.0
  DISZ INFINITY
SURF 1
  CURV 0.02
  DISZ 2
  GLAS N-BK7 0 0 1.5 40 0 0 0 0 0 0
SURF 2
  CURV 0.1
  DISZ 20
SURF 3
  STOP
  CURV 0.0
  DISZ 1
  DIAM 1 1
SURF 4
  CURV 0.02
  DISZ 3
  GLAS N-BK7 0 0 1.5 40 0 0 0 0 0 0
SURF 5
  CURV -0.06
  DISZ 25
SURF 6
  CURV 0.0
  DISZ 0
"""


@pytest.mark.long
def test_rays_aimed_at_the_stop_are_the_light_that_it_lets_through(tmp_path):
    (tmp_path / "lens.zmx").write_text(RETROFOCUS)
    lens, fields = pachon.load_telescope(tmp_path / "lens.zmx"), np.deg2rad([[0.0, 30.0]])
    aimed = pachon.design.relative_illumination(lens.with_design(aiming="real"), fields, n_pupil=1000)
    # Without aiming: a beam twice as wide, and the stop as an aperture.
    stop = tuple(replace(s, aperture=Circle(1e-3)) if s.name == "S3" else s for s in lens.surfaces)
    wide = replace(lens, surfaces=stop, pupil_diameter=3 * lens.pupil_diameter, design_data=DesignData())
    clipped = pachon.design.relative_illumination(wide, fields, n_pupil=40000)
    print(
        aimed,
        aimed.solid_angle,
        aimed.axis_solid_angle,
        clipped.solid_angle,
        clipped.axis_solid_angle,
        clipped.lit_fraction,
    )
    # Points of equal area at the rim of the clipped beam: 1e-3 of them.
    assert aimed.solid_angle == pytest.approx(clipped.solid_angle, rel=2e-3)
    assert aimed.axis_solid_angle == pytest.approx(clipped.axis_solid_angle, rel=2e-3)
