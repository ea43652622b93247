"""Frames of observatories: pupils, stamps, fields and motions, and the conventions of ts_wep and of DECam's Donut."""

from types import SimpleNamespace

import numpy as np
import pytest
from donut_images import donut, noisy

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.models.zernike_polynomials import annular_zernikes
from pachon.sensing.frames import FRAMES, along_camera, stamp_matrix, zernike_matrix
from pachon.sensing.observatory_zernikes import observatory_zernikes, reexpansion
from pachon.sensing.stamp_headers import parallactic_angle

ALL = ("x,y", "y,x", "-x,y", "x,-y", "-y,x", "y,-x", "-x,-y", "-y,-x")
FRAMES_AT = pachon.sensing.DonutFrames(rotator=0.4, parallactic_angle=-2.0)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_wavefront_map_is_the_same_along_the_axes_of_a_frame(frame):
    rng = np.random.default_rng(1)
    noll, coefficients = np.arange(4, 29), rng.normal(size=25)
    axes = FRAMES_AT.axes(frame)[:2, :2]
    point = rng.uniform(-0.7, 0.7, (50, 2))
    there = point @ axes.T
    telescope = coefficients @ annular_zernikes(28, *point.T, 0.6)[3:]
    turned = (zernike_matrix(noll, axes) @ coefficients) @ annular_zernikes(28, *there.T, 0.6)[3:]
    np.testing.assert_allclose(turned, telescope, atol=1e-12)


def test_axes_are_those_that_the_table_of_frames_says():
    at = pachon.sensing.DonutFrames(rotator=np.deg2rad(30.0), parallactic_angle=np.deg2rad(10.0))
    c, s = np.cos(np.deg2rad(30.0)), 0.5
    np.testing.assert_allclose(at.axes("CCS"), [[c, s, 0], [-s, c, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(at.axes("DVCS")[:2], [[-s, c, 0], [c, s, 0]], atol=1e-15)
    np.testing.assert_array_equal(at.axes("ZCS"), np.diag([-1.0, 1.0, -1.0]))
    # xi = X cos rho + Y sin rho, eta = -X sin rho + Y cos rho (docs/explanation/conventions.md).
    x, y = 0.3, -0.2
    rho = np.deg2rad(10.0)
    xi, eta = x * np.cos(rho) + y * np.sin(rho), -x * np.sin(rho) + y * np.cos(rho)
    np.testing.assert_allclose(at.axes("sky")[:2, :2] @ (x, y), (xi, eta))


def test_turns_are_those_of_galsim_as_lsst_uses_them():
    zernike = pytest.importorskip("galsim.zernike")
    rtp = 0.7
    ccs = np.random.default_rng(2).normal(size=25)
    # donut_viz, aggregate_visit.py: zk_OCS = zk_CCS @ zernikeRotMatrix(jmax, -rtp)[4:, 4:].
    ocs = ccs @ zernike.zernikeRotMatrix(28, -rtp)[4:, 4:]
    matrix = zernike_matrix(np.arange(4, 29), pachon.sensing.DonutFrames(rotator=rtp).axes("CCS")[:2, :2])
    np.testing.assert_allclose(matrix @ ocs, ccs, atol=1e-12)


@pytest.mark.parametrize("axes", ALL)
def test_pixels_of_stamps_come_to_their_places_on_the_camera(axes):
    image = np.arange(12.0).reshape(3, 4)
    matrix = stamp_matrix(axes)
    result = along_camera(image, matrix)
    middle = 0.5 * (np.array(result.shape[::-1]) - 1)
    for (iy, ix), value in np.ndenumerate(image):
        x, y = matrix.T @ (ix - 1.5, iy - 1.0) + middle
        assert result[round(y), round(x)] == value


@pytest.mark.parametrize("projection", ["zemax", "gnomonic", "postel"])
def test_fields_come_back_and_dvcs_is_the_transpose(projection):
    fields = np.deg2rad([(0.6, 0.9), (-1.2, 0.1)])
    for frame in FRAMES:
        there = FRAMES_AT.fields_in(fields, frame, projection=projection)
        back = FRAMES_AT.fields_of_telescope(there, frame, projection=projection)
        np.testing.assert_allclose(back, fields, atol=1e-15)
    ccs, dvcs = (FRAMES_AT.fields_in(fields, f, projection=projection) for f in ("CCS", "DVCS"))
    np.testing.assert_allclose(dvcs, ccs[:, ::-1], atol=1e-15)


def test_fields_turn_with_the_positions_of_a_rotated_camera(focused):
    at = pachon.sensing.DonutFrames(rotator=0.5)
    positions = np.array([(0.2, 0.1), (-0.05, 0.28)])
    # A camera that is turned sees what one at rest sees along turned axes: the LSST is symmetric about its axis.
    found = at.fields_in(pachon.fields_at(at.telescope(focused), positions), "CCS")
    np.testing.assert_allclose(found, pachon.fields_at(focused, positions), atol=1e-9)


@pytest.mark.parametrize("azimuth", [10.0, 130.0, 250.0, 340.0])
def test_parallactic_angle_is_the_hour_angle_formula(azimuth):
    latitude, altitude, azimuth = np.deg2rad([-30.2446, 55.0, azimuth])
    # Hour angle and declination by vectors; then tan q = sin H / (tan phi cos d - sin d cos H).
    sine_d = np.sin(latitude) * np.sin(altitude) + np.cos(latitude) * np.cos(altitude) * np.cos(azimuth)
    declination = np.arcsin(sine_d)
    hour = np.arctan2(
        -np.sin(azimuth) * np.cos(altitude),
        np.sin(altitude) * np.cos(latitude) - np.cos(altitude) * np.sin(latitude) * np.cos(azimuth),
    )
    expected = np.arctan2(
        np.sin(hour) * np.cos(latitude),
        np.sin(latitude) * np.cos(declination) - np.cos(latitude) * np.sin(declination) * np.cos(hour),
    )
    assert parallactic_angle(azimuth, altitude, latitude) == pytest.approx(expected, abs=1e-12)


def test_circular_terms_make_the_same_map_but_for_tilts():
    noll = np.arange(4, 23)
    coefficients = np.random.default_rng(3).normal(size=19)
    x, y = np.random.default_rng(4).uniform(-0.7, 0.7, (2, 60))
    circular = reexpansion(noll, 0.612, 0.0) @ coefficients
    difference = coefficients @ annular_zernikes(22, x, y, 0.612)[3:] - circular @ annular_zernikes(22, x, y)[3:]
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    left_over = difference - plane @ np.linalg.lstsq(plane, difference, rcond=None)[0]
    np.testing.assert_allclose(left_over, 0.0, atol=1e-12)


def centroid(image):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] - 0.5 * (image.shape[0] - 1)
    return np.array([(x * image).sum(), (y * image).sum()]) / image.sum()


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("term", "axis"), [(8, 0), (7, 1)])
def test_coma_leans_as_ts_wep_maps_it(focused, side, term, axis):
    """ts_wep, imageMapper.py: u' = -side u + C dW/du, C = -4 N^2 / l, in units of the donut's radius l / 2N."""
    offset, pixel, amplitude = 1.5e-3, 20e-6, 0.5e-6
    tel = focused.perturbed("Detector", shift=(0.0, 0.0, side * offset))
    coefficients = np.zeros(term)
    coefficients[-1] = amplitude
    lean = np.subtract(*(centroid(donut(tel, (0.0, 0.0), zernikes=z, rays=150)) for z in (coefficients, np.zeros(1))))
    # Mean slope of the map over the annulus: by differences along the axis of coma.
    points = np.random.default_rng(5).uniform(-1.0, 1.0, (20000, 2))
    points = points[(np.hypot(*points.T) < 1.0) & (np.hypot(*points.T) > focused.pupil_obscuration)]
    step = np.zeros(2)
    step[axis] = 1e-4
    up, down = (annular_zernikes(term, *(points + s).T, focused.pupil_obscuration)[-1] for s in (step, -step))
    slope = amplitude * ((up - down) / 2e-4).mean()
    number = 10.31 / 8.36
    expected = -4.0 * number**2 / offset * slope * (offset / (2.0 * number)) / pixel
    # The sine condition makes the map of a fast telescope differ by a tenth; the samples by a hundredth.
    assert lean[axis] == pytest.approx(expected, rel=0.15)
    assert abs(lean[1 - axis]) < 0.05 * abs(expected)


def test_donut_of_decam_leans_as_the_inverse_transform_of_its_pupil():
    """Donut, DonutEngine.cc: the inverse FFT of exp(2 pi i W), W in waves, pupil and image along the same axes."""
    tel = pachon.load_telescope("decam").perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))
    wave, amplitude, number = 700e-9, 0.7, 2.979
    n, half = 512, 1.5
    x, y = np.meshgrid(*2 * [(np.arange(n) - n // 2) * (2.0 * half / n)])
    # Prime-focus cage, and the filter exchanger's box and arc.
    shadow = (np.hypot(x, y) < 0.419) | ((np.abs(x) < 0.233) & (np.abs(y) < 0.446 + 0.068 * (1.0 - (x / 0.233) ** 2)))
    pupil = (np.hypot(x, y) < 1.0) & ~shadow

    def image_of(coma):
        phase = coma * annular_zernikes(8, x, y)[7] + 8.7 * annular_zernikes(4, x, y)[3]
        field = np.where(pupil, np.exp(2j * np.pi * phase), 0.0)
        return np.abs(np.fft.fftshift(np.fft.ifft2(np.fft.ifftshift(field)))) ** 2

    # A sample of the image is wave / (2 half) of the angle per radius, times focal length over radius.
    scale = wave * 2.0 * number / (2.0 * half)
    fourier = (centroid(image_of(amplitude)) - centroid(image_of(0.0)))[0] * scale
    circular = np.zeros(8)
    circular[-1] = amplitude * wave
    annular = reexpansion(np.arange(1, 9), 0.0, tel.pupil_obscuration) @ circular
    traced = [
        centroid(donut(tel, (0.0, 0.0), zernikes=z, pixel=15e-6, rays=200, size=61)) for z in (annular, np.zeros(8))
    ]
    # Vanes and distances of the shadows are not in the transform's pupil.
    assert (traced[0] - traced[1])[0] * 15e-6 == pytest.approx(fourier, rel=0.1)


@pytest.fixture(scope="module")
def rotated_fit(focused, behind_focus):
    """A donut of a decentred M2, drawn with a turned camera and stored as LSST stores it, read back."""
    at = pachon.sensing.DonutFrames(rotator=np.deg2rad(25.0), stamp_axes="DVCS")
    believed = at.telescope(behind_focus)
    true = believed.perturbed("M2", shift=(3e-4, -1.5e-4, 0.0))
    field = np.deg2rad([(0.6, 0.8)])
    stored = noisy(donut(true, field[0], flux=2e6), 300.0, 1).T
    fields = at.fields_of_telescope(at.fields_in(field, "DVCS"), "DVCS")
    model = pachon.DonutModel(neighbours=False, detector=pachon.DonutDetector(pixel_size=20e-6))
    fit = pachon.fit_donuts(
        believed, at.stamps([stored]), fields, 622e-9, sky_variance=300.0, noll=range(4, 12), model=model, threads=1
    )
    designs = (behind_focus, behind_focus.perturbed("M2", shift=(3e-4, -1.5e-4, 0.0)))
    before, after = (pachon.wavefront_zernikes(t, field, 622e-9, jmax=22).coefficients[0] for t in designs)
    return at, fit, (after - before)[3:11]


@pytest.mark.long
def test_a_donut_of_a_turned_camera_is_read_back_from_dvcs(rotated_fit):
    _, fit, expected = rotated_fit
    # Errors claimed are 27 nm each; transposed, the two comas (96 and -191 nm) would change places.
    assert np.abs((fit.zernikes[0] - expected) / fit.errors[0]).max() < 4.0
    assert abs(expected[3] - expected[4]) > 7.0 * fit.errors[0, 3:5].max()


@pytest.mark.long
def test_results_in_conventions_keep_map_and_errors(rotated_fit, focused):
    at, fit, _ = rotated_fit
    lsst = fit.zernikes_in("ts_wep", "CCS", frames=at)
    assert (lsst.unit, lsst.frame) == ("um", "CCS")
    x, y = np.random.default_rng(6).uniform(-0.6, 0.6, (2, 30))
    cosine, sine = np.cos(np.deg2rad(25.0)), np.sin(np.deg2rad(25.0))
    along = annular_zernikes(11, cosine * x + sine * y, cosine * y - sine * x, fit.obscuration)[3:]
    telescope = fit.zernikes[0] @ annular_zernikes(11, x, y, fit.obscuration)[3:]
    np.testing.assert_allclose(lsst.values[0] @ along, telescope * 1e6, atol=1e-12)
    # A turn keeps the sum of squares of a pair, and of its variances.
    np.testing.assert_allclose((lsst.errors[0, 3:5] ** 2).sum(), (fit.errors[0, 3:5] ** 2).sum() * 1e12, rtol=1e-9)
    waves = fit.zernikes_in("donut", wave=622e-9)
    np.testing.assert_allclose(waves.values[0, 5] * 622e-9, fit.zernikes[0, 5] * waves.values[0, 5] * 622e-9
                               / fit.zernikes[0, 5])  # fmt: skip
    whole = fit.zernikes_in("pachon", design=focused)
    own = pachon.wavefront_zernikes(focused, fit.fields, 622e-9, jmax=11).coefficients[:, 3:]
    np.testing.assert_allclose(whole.values - fit.zernikes, own, atol=1e-15)
    table = lsst.in_table(fit.to_table())
    assert table["Z4"].unit == "um"
    assert table.meta["frame"] == "CCS"
    assert table["field_y"][0].value == pytest.approx(np.rad2deg(lsst.fields[0, 1]))


def test_the_design_is_added_where_there_are_results(lsst_r):
    """One donut outside the field ended the conversion of all in an error."""
    noll, zernikes = np.arange(4, 12), np.array([np.full(8, 1e-7), np.full(8, np.nan)])
    fields = np.deg2rad([[0.6, 0.3], [11.0, 0.0]])
    fit = SimpleNamespace(
        zernikes=zernikes,
        covariance=1e-16 * np.stack([np.eye(8)] * 2),
        noll=noll,
        fields=fields,
        wavelengths=np.array([622e-9]),
        obscuration=lsst_r.pupil_obscuration,
        projection="zemax",
    )
    whole = observatory_zernikes(fit, "pachon", "OCS", pachon.sensing.DonutFrames(), lsst_r, None)
    own = pachon.wavefront_zernikes(lsst_r, fields[:1], 622e-9, jmax=11).coefficients[:, 3:]
    np.testing.assert_allclose(whole.values[:1], own + 1e-7, atol=1e-15)
    assert np.isnan(whole.values[1]).all()
    assert np.array_equal(fit.zernikes[0], np.full(8, 1e-7))


def estimate(telescope, values):
    names = ["M2.dx", "M2.dy", "M2.dz", "M2.rx", "M2.ry", "Camera.dx", "Camera.rx"]
    freedoms = pachon.models.DegreesOfFreedom.of_parameters(telescope, names)
    n = len(names)
    return pachon.sensing.FreedomEstimate(
        freedoms, np.asarray(values), np.diag(np.arange(1.0, n + 1.0)) * 1e-14, np.ones(n)
    )


def test_corrections_undo_the_motions_in_every_frame(focused):
    values = np.array([1e-5, 2e-5, 3e-5, 1e-5, -2e-5, 4e-5, 5e-6])
    fitted = estimate(focused, values)
    ocs = pachon.sensing.hexapod_corrections(fitted)
    assert ocs.body.tolist() == ["M2", "Camera"]
    np.testing.assert_allclose(ocs.shift[0], [-10.0, -20.0, -30.0])
    np.testing.assert_allclose(ocs.tilt[0], -np.rad2deg([1e-5, -2e-5, 0.0]) * 3600.0)
    np.testing.assert_allclose(ocs.shift_error[0], np.sqrt([1.0, 2.0, 3.0]) * 0.1)
    zemax = pachon.sensing.hexapod_corrections(fitted, frame="ZCS")
    np.testing.assert_allclose(zemax.shift, ocs.shift * (-1.0, 1.0, -1.0))
    np.testing.assert_allclose(zemax.tilt, ocs.tilt * (-1.0, 1.0, -1.0))
    turned = pachon.sensing.hexapod_corrections(
        fitted, frame="CCS", frames=pachon.sensing.DonutFrames(rotator=0.5 * np.pi)
    )
    # Camera's x lies along the telescope's y, its y along -x.
    np.testing.assert_allclose(turned.shift[0], [-20.0, 10.0, -30.0], atol=1e-9)
    # What was not fitted has no error, nor one of rounding.
    assert turned.shift_error[1, 0] == turned.tilt_error[1, 0] == 0.0


@pytest.mark.parametrize(
    ("call", "error", "part"),
    [
        (
            lambda: pachon.sensing.DonutFrames(stamp_axes="x,x"),
            ConfigError,
            "stamp_axes = 'x,x': expected DVCS, CCS, or axes",
        ),
        (lambda: pachon.sensing.DonutFrames(stamp_axes="x"), ConfigError, "stamp_axes = 'x'"),
        (lambda: pachon.sensing.DonutFrames(rotator=np.nan), DomainError, "rotator = nan: expected one finite angle"),
        (lambda: pachon.sensing.DonutFrames().axes("XCS"), ConfigError, "OCS"),
        (lambda: pachon.sensing.DonutFrames().axes("sky"), ConfigError, "without a parallactic angle"),
        (lambda: zernike_matrix([4, 5], FRAMES_AT.axes("CCS")[:2, :2]), DomainError, "Z5 mixes with its partner"),
        (lambda: pachon.sensing.DonutFrames().fields_in([1.0, 2.0, 3.0], "OCS"), DomainError, "expected [n, 2]"),
    ],
)
def test_bad_frames_are_one_line(call, error, part):
    with pytest.raises(error, match=r"(?s).*") as raised:
        call()
    assert part in str(raised.value)
    assert "\n" not in str(raised.value)


def test_corrections_of_bad_frames_are_one_line(focused):
    with pytest.raises(ConfigError, match="DVCS is one of images"):
        pachon.sensing.hexapod_corrections(estimate(focused, np.zeros(7)), frame="DVCS")
    bending = pachon.models.DegreesOfFreedom.of_parameters(focused, ["M1.radius"])
    radius = pachon.sensing.FreedomEstimate(bending, np.zeros(1), np.eye(1), np.ones(1))
    with pytest.raises(DomainError, match="no degree of freedom moves a body"):
        pachon.sensing.hexapod_corrections(radius)
