from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from scipy.integrate import quad

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.core.plotting import png_bytes
from pachon.design.metrics.field_zernikes import wavefront_zernikes
from pachon.design.metrics.spots import spots
from pachon.models.aperture import Circle
from pachon.models.shapes.shape import Conic
from pachon.wavefront.pupil_sampling import PupilSampling
from pachon.wavefront.request import RAYS_AT_ONCE, Request, field_points


def test_a_paraboloid_is_perfect_on_its_axis(paraboloid):
    result = spots(paraboloid(f_number=1.0), [[0.0, 0.0]])
    # Rounding of positions of metres.
    assert result.rms_radius[0] < 2e-15
    assert result.geometric_radius[0] < 5e-15
    assert result.lit_fraction[0] == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("obscuration", [0.0, 0.5])
def test_defocus_gives_a_disc_of_known_size(paraboloid, obscuration):
    shift, focal_length, f_number = 1e-4, 2.0, 1.5
    telescope = paraboloid(focal_length, f_number, obscuration=obscuration, shift=shift)
    result = spots(telescope, [[0.0, 0.0]])
    rim = 0.5 * focal_length / f_number

    def blur(h):
        # A ray at height h on z = h^2 / 4f goes through the focus.
        return shift * h / (focal_length - h**2 / (4 * focal_length))

    area = rim**2 * (1 - obscuration**2)
    square = quad(lambda h: blur(h) ** 2 * 2 * h, obscuration * rim, rim, epsabs=1e-20)[0] / area
    assert result.rms_radius[0] == pytest.approx(np.sqrt(square), rel=1e-10)
    # 80 % of the light lies within the height that holds 80 % of the area; 20 rings stand for it.
    held = np.sqrt(rim**2 * (obscuration**2 + 0.8 * (1 - obscuration**2)))
    assert result.radius_holding(0.8)[0] == pytest.approx(blur(held), rel=5e-3)
    assert blur(rim) * 0.98 < result.geometric_radius[0] <= blur(rim)
    many = spots(telescope, [[0.0, 0.0]], sampling="spiral")
    assert many.radius_holding(0.8)[0] == pytest.approx(blur(held), rel=1e-3)


def test_a_slow_defocused_disc_has_the_rule_of_thumb(paraboloid):
    shift = 1e-4
    result = spots(paraboloid(2.0, 20.0, shift=shift), [[0.0, 0.0]])
    # A uniform disc of diameter dz / N has an rms radius of dz / (2 N sqrt 2); at f/20, to (1/4N)^2.
    assert result.rms_radius[0] == pytest.approx(shift / 20 / 2**1.5, rel=3e-4)


def test_an_ellipsoid_images_one_focus_on_the_other(paraboloid):
    near, far = 1.0, 4.0
    mirror = Conic(2 * near * far / (near + far), -(((far - near) / (far + near)) ** 2))
    telescope = paraboloid(near, 2.0)
    surfaces = (replace(telescope.surfaces[0], shape=mirror), telescope.surfaces[1])
    telescope = replace(telescope, surfaces=surfaces, object_distance=far)
    angle = 1e-4
    result = spots(telescope, [[0.0, 0.0], [0.0, angle]], reference="chief")
    # Rounding; and the chief ray, reflected at the vertex, lands at the distance of the near focus times its slope.
    assert result.rms_radius[0] < 1e-14
    assert np.linalg.norm(result.reference_point[1]) == pytest.approx(near * np.tan(angle), rel=1e-12)
    assert result.airy_radius[0] == pytest.approx(1.22 * 5e-7 * 2.0, rel=0.02)
    # Every path from one focus to the other is as long, but for rounding of paths of metres.
    assert np.abs(wavefront_zernikes(telescope, [[0.0, 0.0]], jmax=11).coefficients).max() < 1e-14


def test_coma_of_a_slow_paraboloid_has_third_order_size(paraboloid):
    focal_length, f_number, angle = 2.0, 20.0, 1e-7
    result = spots(paraboloid(focal_length, f_number), [[0.0, angle]], reference="chief")
    # Sagittal coma C = f theta / (16 N^2): the rays of a zone lie on a circle of radius C rho^2 about 2 C rho^2, so
    # that the centroid is at C, and the mean square about it 2/3 C^2. Fifth order is (1/4N)^2, astigmatism 160 theta.
    size = focal_length * angle / (16 * f_number**2)
    assert result.rms_radius[0] == pytest.approx(size * np.sqrt(2 / 3), rel=1e-3)
    assert np.abs(result.centroid[0]) == pytest.approx([0.0, size], rel=1e-3, abs=1e-15)
    assert result.reference_point[0, 0] == pytest.approx(0.0, abs=1e-15)
    assert abs(result.reference_point[0, 1]) == pytest.approx(focal_length * angle, rel=1e-9)


def test_brute_force_moments_of_vignetted_polychromatic_spots(lsst_r):
    field, waves, shares = (0.012, 0.026), np.array([550e-9, 690e-9]), np.array([1.0, 3.0])
    sampling = PupilSampling(np.random.default_rng(4).uniform(-4.18, 4.18, (400, 2)), np.linspace(1, 2, 400))
    result = spots(lsst_r, [field], waves, wavelength_weights=shares, sampling=sampling)
    points, weights = [], []
    for wave, share in zip(waves, shares / 4, strict=True):
        end = pachon.trace(lsst_r, pachon.launch_rays(lsst_r, field, wave, sampling.points.T))
        for position, status, weight in zip(end.position, end.status, np.linspace(1, 2, 400) / 600, strict=True):
            if status == 0:
                points.append(position[:2])
                weights.append(share * weight)
    points, weights = np.array(points), np.array(weights)
    assert 100 < len(weights) < 800
    centroid = weights @ points / weights.sum()
    square = weights @ ((points - centroid) ** 2).sum(axis=1) / weights.sum()
    assert result.lit_fraction[0] == pytest.approx(weights.sum(), rel=1e-12)
    assert result.reference_point[0] == pytest.approx(centroid, abs=1e-15)
    assert result.rms_radius[0] == pytest.approx(np.sqrt(square), rel=1e-9)
    assert result.geometric_radius[0] == pytest.approx(np.linalg.norm(points - centroid, axis=1).max(), rel=1e-9)


def test_spots_are_those_of_batoid(lsst_r):
    batoid = pytest.importorskip("batoid")
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    fields = np.deg2rad([[0.0, 0.0], [0.7, -0.7], [1.0, 1.43]])
    result = spots(lsst_r, fields, 622e-9, sampling="square", reference="chief")
    for i, field in enumerate(fields):
        pupil = pachon.pupil_sampling(lsst_r, "square").points.T
        rays = batoid.RayVector.fromStop(*pupil, optic=optic, wavelength=622e-9, dirCos=None, theta_x=field[0],
                                         theta_y=field[1], projection="zemax")  # fmt: skip
        optic.trace(rays)
        lit = ~rays.vignetted
        assert np.array_equal(result.weight[i, 0] > 0, lit)
        x, y = rays.x[lit], rays.y[lit]
        # Rounding of 20 m of path.
        assert result.rms_radius[i] == pytest.approx(np.hypot(x.std(), y.std()), abs=1e-13)
        assert (result.reference_point + result.centroid)[i] == pytest.approx([x.mean(), y.mean()], abs=1e-13)


def test_the_lsst_is_as_sharp_as_designed(lsst_r):
    result = spots(lsst_r)
    assert np.rad2deg(result.fields[:, 1]) == pytest.approx([0, 0.5, 1.0, 1.5, 1.75])
    # Published: the design's 80 % energy stays below 0.2" in r over the whole field; geometry alone is a part of that.
    summary = result.summary()
    assert (np.array(summary["radius_80_percent_arcsec"]) < 0.1).all()
    assert summary["plate_scale_arcsec_per_um"][0] == pytest.approx(0.0200, abs=5e-5)
    # 1.22 * 624 nm * 1.233
    assert summary["airy_radius_um"][0] == pytest.approx(0.939, abs=1e-3)
    assert summary["lit_fraction"][-1] == pytest.approx(0.9, abs=0.01)


@pytest.mark.long
def test_quantities_threads_and_blocks_change_nothing(lsst_r):
    plain = spots(lsst_r, np.deg2rad([[0.3, 1.0], [0.0, 1.7]]), [600e-9], threads=1)
    same = spots(lsst_r, [[0.3, 1.0], [0.0, 1.7]] * u.deg, [600] * u.nm, threads=2)
    # Quantities convert degrees by their own factor: an ulp.
    assert same.displacement == pytest.approx(plain.displacement, abs=1e-13, nan_ok=True)
    again = spots(lsst_r, plain.fields, plain.wavelengths, threads=2)
    assert np.array_equal(again.displacement, plain.displacement, equal_nan=True)
    pupil = np.zeros((RAYS_AT_ONCE // 2 - 1, 2))
    fields = np.deg2rad([[0.0, 0.1 * i] for i in range(5)])
    request = Request.of(lsst_r, fields, 600e-9, sampling=PupilSampling(pupil, np.ones(len(pupil))))
    parts = list(request.parts())
    assert [part for part, _ in parts] == [slice(0, 2), slice(2, 4), slice(4, 5)]
    whole = request.bundles(600e-9, pupil[:3])
    pieces = np.concatenate([some.bundles(600e-9).position[:, :3] for _, some in parts])
    assert np.array_equal(pieces, whole.position)


def test_a_field_without_light_says_so(paraboloid):
    dark = paraboloid(baffle=(4.0, 0.01), aperture=Circle(0.05))
    result = spots(dark, np.deg2rad([[0.0, 0.0], [0.0, 1.9]]))
    assert result.lit_fraction[1] == 0
    for values in (result.rms_radius, result.geometric_radius, result.radius_holding()):
        assert np.isfinite(values[0])
        assert np.isnan(values[1])
    assert png_bytes(result.plot()).startswith(b"\x89PNG")


@pytest.mark.long
@pytest.mark.parametrize("fields", [[[0.0, 0.0]], np.deg2rad([[0.0, 0.1 * i] for i in range(14)])])
def test_pictures_of_one_and_many_fields(lsst_r, fields):
    result = spots(lsst_r, fields, np.linspace(*lsst_r.band, 3), n_pupil=8)
    png = png_bytes(result.plot())
    assert png.startswith(b"\x89PNG")
    assert png == png_bytes(result.plot())


def test_bad_input_is_refused(lsst_r):
    with pytest.raises(ConfigError, match="reference = 'middle'"):
        spots(lsst_r, reference="middle")
    with pytest.raises(DomainError, match=r"fields of shape \(1, 3\): expected field angles x, y"):
        spots(lsst_r, [[0.0, 0.0, 0.0]])
    with pytest.raises(DomainError, match=r"field = \(0, 3\) deg: expected within 2.5 deg"):
        spots(lsst_r, [0.0, 3.0] * u.deg)
    with pytest.raises(DomainError, match="expected 2 numbers, none negative"):
        spots(lsst_r, None, [5e-7, 6e-7], wavelength_weights=[1.0])
    with pytest.raises(DomainError, match="wavelength = 2000 nm"):
        spots(lsst_r, None, [2e-6])
    with pytest.raises(DomainError, match="fraction = 1"):
        spots(lsst_r).radius_holding(1)
    assert field_points(lsst_r, (0.0, 0.01)).shape == (1, 2)


@pytest.mark.parametrize("fold", [False, True], ids=["plate", "fold mirror"])
def test_parallel_light_has_spots_as_large_as_the_pupil_and_no_airy_disc(afocal, fold):
    diagram = pachon.spots(afocal(fold), [[0.0, 0.0], [0.0, 0.004]])
    # The rms radius of a disc; off the axis the light comes to the detector no larger across.
    assert diagram.rms_radius == pytest.approx(0.01 * np.sqrt(0.5), rel=1e-4)
    assert np.isnan(diagram.airy_radius).all()
    assert diagram.plot().axes
