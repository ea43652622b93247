"""Diffraction of donuts at the rims of the pupil, against the autocorrelation of the pupil's waves."""

import numpy as np
import pytest
import scipy.fft

import pachon
from pachon.raytrace.rays import RayStatus, field_direction
from pachon.wavefront.atmosphere.turbulence import coherence, structure_function
from pachon.wavefront.psf.psf import make_psfs
from pachon.wavefront.psf.pupil_rims import PupilRims, pupil_rims
from pachon.wavefront.psf.stamps import Stamps

LSST = pachon.load_telescope("lsst_v3.3_r")
WAVE, PIXEL, SIDE = 620e-9, 10e-6, 81
R0, OUTER_SCALE = 0.12, 25.0
AIR = pachon.Atmosphere.from_site("cerro_pachon", 1, r0=R0, outer_scale=OUTER_SCALE)


@pytest.fixture(scope="module")
def defocused():
    return LSST.perturbed("Detector", shift=(0.0, 0.0, 0.6e-3))


@pytest.fixture(scope="module")
def donut(defocused):
    """Donut on the axis from the autocorrelation of the waves in its pupil, times the mean of turbulence, unit sum."""
    step, reach = 4e-3, 150  # of the pupil: twice the stamp; baselines up to 0.6 m
    size = scipy.fft.next_fast_len(2092 + reach)
    place = (np.arange(size) - size // 2) * step
    x, y = np.meshgrid(place, place)
    radius, outer = np.hypot(x, y), 0.5 * LSST.pupil_diameter
    inner = LSST.pupil_obscuration * outer
    light = np.clip((outer - radius) / step + 0.5, 0, 1) * np.clip((radius - inner) / step + 0.5, 0, 1)
    # The path is that of a rotationally symmetric telescope: a polynomial of the square of the radius.
    along = np.linspace(1.004 * inner, 0.998 * outer, 60)
    path = pachon.wavefront_opd(defocused, (0.0, 0.0), WAVE, pupil=(along, 0.0 * along)).value
    fitted = np.polynomial.Polynomial.fit(along**2, path, 10)
    waves = light * np.exp(2j * np.pi / WAVE * fitted(radius**2))
    correlated = scipy.fft.ifft2(np.abs(scipy.fft.fft2(waves)) ** 2)
    lag = np.arange(-reach, reach + 1)
    transfer = correlated[np.ix_(lag, lag)] / correlated[0, 0].real
    baseline = step * np.hypot(lag, lag[:, None])
    transfer = transfer * coherence(structure_function(baseline, R0, OUTER_SCALE), WAVE)
    focal_length = float(pachon.make_psfs(LSST, [(0, 0)], [WAVE]).pixel_scale)
    wave = 2.0 * np.pi * step * lag / WAVE * focal_length / PIXEL  # rad/m on the detector
    pixel = np.sinc(wave * PIXEL / (2.0 * np.pi))
    turns = np.exp(1j * np.outer((np.arange(SIDE) - SIDE // 2) * PIXEL, wave))
    image = ((turns * pixel) @ transfer @ (turns * pixel).T).real
    return image / image.sum()


def difference(image, expected):
    return np.sqrt(((image - expected) ** 2).sum() / (expected**2).sum())


@pytest.mark.long
def test_long_exposure_donuts_are_diffracted_at_their_rims(defocused, donut):
    image = make_psfs(
        defocused, [(0.0, 0.0)], [WAVE], atmosphere=AIR, engine="long_exposure", stamps=Stamps(SIDE, diffusion=0.0)
    ).image[0]
    # Without diffraction, or with one filter for all rays, 4 %: what is left is the third order of the strips' width.
    assert difference(image / image.sum(), donut) < 0.003


@pytest.mark.slow
def test_fits_with_diffraction_find_no_wavefront_in_it(defocused, donut):
    air = pachon.DonutAir(outer_scale=OUTER_SCALE)
    plain, right = (
        pachon.fit_donuts(defocused, [1e8 * donut], [(0.0, 0.0)], WAVE, sky_variance=1e4, model=model)
        for model in (pachon.DonutModel(air=air, diffraction=d, n_pupil=80) for d in (False, True))
    )
    # Rays and a wider seeing do not make strips along the rims: 24 nm of Z11, at 0.6 mm.
    assert np.linalg.norm(plain.zernikes[0]) > 15e-9
    assert np.linalg.norm(right.zernikes[0]) < 2e-9
    assert right.chi2[0] < 0.03 * plain.chi2[0]


@pytest.mark.slow
def test_donuts_of_the_wave_engine_have_the_hole_of_the_mirror():
    """At 1.64 degrees it stands 8 mm aside from the hole of the pupil: 34 nm of Z5 where light ends at that one."""
    telescope = LSST.perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))
    fields, options = np.deg2rad([[1.19, 1.13]]), {"diffusion": 15e-6}
    donut = make_psfs(telescope, fields, [WAVE], engine="wave", stamps=Stamps(141, **options)).image
    model = pachon.DonutModel(air=pachon.DonutAir(fwhm=0.0), detector=pachon.DonutDetector(**options), diffraction=True)
    fit = pachon.fit_donuts(telescope, 1e7 * donut, fields, WAVE, sky_variance=1e4, model=model)
    astigmatism, error = fit.zernikes[0, 1:3], np.linalg.norm(fit.zernikes[0])
    np.testing.assert_allclose(astigmatism, 0.0, atol=2e-9)
    # Fresnel fringes at the rims, without air; coma, which terms that are not asked for are like, is known least.
    assert error < min(25e-9, 0.5 * np.sqrt(np.trace(fit.covariance[0])))


def test_strips_of_a_ring_are_its_transfer_function_to_first_order():
    rims = pupil_rims(LSST, np.array([0.0, 0.0, -1.0]), WAVE)
    outer = 0.5 * LSST.pupil_diameter
    inner = LSST.pupil_obscuration * outer
    area = np.pi * (outer**2 - inner**2)
    assert rims.parts.sum() * area == pytest.approx(2.0 * np.pi * (outer + inner), rel=1e-3)
    # Both circumferences, times the mean of |cos| / 2, over the area: O'Neill's slope at zero.
    baseline = 0.01 * np.array([[1.0, 0.0], [0.6, 0.8]])
    nothing = np.zeros((len(rims.points), 2))
    found = rims.transfer(baseline, np.zeros((2, 2)), nothing, nothing)
    assert found == pytest.approx(-0.01 * 2.0 * (outer + inner) / area, rel=1e-3)
    hole = slice(len(rims.points) // 2)
    assert (rims.normals * rims.points).sum(axis=1)[hole].min() > 0.0
    np.testing.assert_allclose(rims.curvatures[hole], -1.0 / inner, rtol=1e-3)
    np.testing.assert_allclose(rims.curvatures[hole.stop :], 1.0 / outer, rtol=1e-3)


def test_a_straight_strip_is_the_integral_of_its_waves():
    rims = PupilRims(np.array([[4.0, 0.0]]), np.array([[-1.0, 0.0]]), np.array([0.3]), np.zeros(1))
    wave, landing, inward = np.array([[2e4, 1e4]]), np.array([[6e-4, 1e-4]]), np.array([[-3e-3, 1e-3]])
    found = rims.transfer(np.array([[0.2, 0.1]]), wave, landing, inward)[0]
    # Half the baseline across the rim; the light lands 5 rad apart at its ends.
    across = 0.1 * (np.arange(2000) + 0.5) / 2000
    places = landing[0] + across[:, None] * inward[0]
    assert found == pytest.approx(-0.3 * 0.1 * np.exp(-1j * places @ wave[0]).mean(), rel=1e-5)


def test_strips_of_a_disc_are_what_its_shifted_copies_lack():
    """Against quadrature along radii of a disc like AuxTel's, whose light turns by radians across a strip."""
    angle, radius, slope = 2.0 * np.pi * (np.arange(512) + 0.5) / 512, 0.6, 7.5e-5
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    piece = np.full(512, 2.0 * np.pi / (512 * np.pi * radius))
    rims = PupilRims(radius * unit, -unit, piece, np.full(512, 1.0 / radius))
    for width in (0.05, 0.1, 0.15):
        baseline, wave = np.array([[width, 0.0]]), np.array([[2.0 * np.pi / WAVE * width, 0.0]])
        found = rims.transfer(baseline, wave, slope * rims.points, -slope * unit)[0]
        end = np.sqrt(radius**2 - (0.5 * width * unit[:, 1]) ** 2) - 0.5 * width * np.abs(unit[:, 0])
        along = end[:, None] + (radius - end)[:, None] * (np.arange(400) + 0.5) / 400
        waves = along * np.cos(slope * wave[0, 0] * along * unit[:, :1])
        lost = (waves.mean(axis=1) * (radius - end)).mean() * 2.0 * np.pi
        # What is left is of third order in the width.
        assert found == pytest.approx(-lost / (np.pi * radius**2), abs=4e-5)


@pytest.mark.parametrize(
    ("name", "field_deg", "slope", "left"),
    [
        ("auxtel", (0.0, 0.0), 7.5e-5, 4e-3),
        ("lsst_v3.3_r", (0.0, 0.0), 1.45e-5, 3e-4),
        # Vanes narrower than the baselines, and a plate; without them, 0.05.
        ("decam", (0.5, 0.4), 1.2e-5, 1.5e-3),
    ],
)
def test_strips_are_what_a_pupil_out_of_focus_lacks(name, field_deg, slope, left):
    """Against sums over the pupil where both ends of a baseline are clear; light is turned by a slope times its place.

    Without the mean over the strips, those of AuxTel miss the sums by 0.1.
    """
    telescope = pachon.load_telescope(name)
    direction = field_direction(*np.deg2rad(field_deg))
    half = 0.5 * telescope.pupil_diameter
    count = 840
    step = 2.2 * half / count
    x, y = np.meshgrid(*[step * (np.arange(count) - 0.5 * (count - 1))] * 2)
    rays = pachon.launch_rays(telescope, np.deg2rad(field_deg), WAVE, (x.ravel(), y.ravel()))
    lit = (pachon.trace(telescope, rays).status == RayStatus.OK).reshape(x.shape).astype(float)
    rims = pupil_rims(telescope, direction, WAVE)
    # Whole steps of the lattice to both sides, up to baselines of 0.2 m.
    steps = np.rint(0.1 / step * np.array([(0.4, 0.0), (0.5, -0.6), (0.1, 0.9), (0.95, 0.25), (0.3, 0.3)])).astype(int)
    baseline = 2.0 * step * steps
    wave = 2.0 * np.pi / WAVE * baseline
    found = rims.transfer(baseline, wave, slope * rims.points, slope * rims.normals)
    for (m, n), k, transfer in zip(steps, wave, found, strict=True):
        both = np.roll(lit, (n, m), axis=(0, 1)) * np.roll(lit, (-n, -m), axis=(0, 1))
        expected = ((both - lit) * np.exp(-1j * slope * (k[0] * x + k[1] * y))).sum() / lit.sum()
        # Points of the lattice beside the rims, the third order of the width of the strips, and ends of vanes.
        assert abs(transfer - expected) < left


@pytest.mark.parametrize(("name", "small"), [("lsst_v3.3_r", 0.0), ("auxtel", 1.0), ("decam", 0.3)])
def test_slopes_of_the_transfer_are_central_differences(name, small):
    rims = pupil_rims(pachon.load_telescope(name), np.array([0.0, 0.0, -1.0]), WAVE)
    rng = np.random.default_rng(4)
    count, step = len(rims.points), 3e-7
    baseline, wave = rng.uniform(-0.3, 0.3, (30, 2)), rng.uniform(-1e5, 1e5, (30, 2))
    landing, inward = 1.5e-4 * rims.points, 1.5e-4 * rims.normals
    response, leaning = rng.standard_normal((2, 2, count, 3))
    leaning *= small
    values, found = rims.transfer_slopes(baseline, wave, landing, inward, response, leaning)
    np.testing.assert_allclose(values, rims.transfer(baseline, wave, landing, inward), atol=1e-6)
    for k in range(3):
        by_step = [[sign * step * v[:, :, k].T for v in (response, leaning)] for sign in (1.0, -1.0)]
        ends = [rims.transfer(baseline, wave, landing + place, inward + lean) for place, lean in by_step]
        expected = (ends[0] - ends[1]) / (2.0 * step)
        # Single precision, and the third order of the differences: (0.1 rad)^2 / 6 at three sigma.
        np.testing.assert_allclose(found[:, k], expected, atol=5e-3 * np.abs(expected).max())
