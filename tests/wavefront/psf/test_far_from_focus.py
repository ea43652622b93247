"""Donuts by the PSF engines: against a histogram of random rays, against each other, and stamps that are too small."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.fft

import pachon
from pachon.core.errors import DomainError
from pachon.models.io.site_file import load_site
from pachon.raytrace.rays import RayStatus
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.screen_sampling import ScreenSampling
from pachon.wavefront.atmosphere.turbulence import coherence, diffraction_otf, structure_function
from pachon.wavefront.psf.psf import make_psfs
from pachon.wavefront.psf.stamps import Stamps

LSST = pachon.load_telescope("lsst_v3.3_r")
WAVE = 620e-9
CORNER = np.deg2rad([1.19, 1.125])  # vignetted
FOCAL_LENGTH = 10.31
PIXEL, DIFFUSION = 10e-6, 4e-6


def defocused(height, telescope=LSST):
    return telescope.perturbed("Detector", shift=(0.0, 0.0, height))


def air(r0=0.16, **options):
    return Atmosphere.from_site(**{"site": "cerro_pachon", "seed": 1, "r0": r0, "outer_scale": 25.0} | options)


def brute_force(telescope, field, side, n_ray, otf_at):
    """Donut of random rays, binned four cells to a pixel, times a transfer function of wavenumbers [rad/m]."""
    rng = np.random.default_rng(8)
    radius = 0.5 * telescope.pupil_diameter * np.sqrt(rng.uniform(telescope.pupil_obscuration**2, 1.0, n_ray))
    angle = rng.uniform(0.0, 2.0 * np.pi, n_ray)

    def landed(x, y):
        rays = pachon.launch_rays(telescope, field=tuple(field), wavelength=WAVE, pupil=(x, y), projection="zemax")
        return pachon.trace(telescope, rays)

    end = landed(radius * np.cos(angle), radius * np.sin(angle))
    chief = landed(np.zeros(1), np.zeros(1)).position[0, :2]
    x, y = (end.position[end.status == RayStatus.OK, :2] - chief).T
    cell, count = PIXEL / 4, 8 * side
    # The cell count // 2 is centred on the chief ray.
    edges = (np.arange(count + 1) - count // 2 - 0.5) * cell
    cells = np.histogram2d(y, x, bins=[edges, edges])[0]
    k = 2.0 * np.pi * scipy.fft.fftfreq(count, cell)
    kx, ky = k, k[:, None]
    pixel = np.sinc(kx * PIXEL / 2 / np.pi) * np.sinc(ky * PIXEL / 2 / np.pi)
    pixel = pixel / (np.sinc(kx * cell / 2 / np.pi) * np.sinc(ky * cell / 2 / np.pi))
    image = scipy.fft.ifft2(scipy.fft.fft2(cells) * pixel * otf_at(np.hypot(kx, ky))).real
    first = count // 2 - 4 * (side // 2)
    image = image[first : first + 4 * side : 4, first : first + 4 * side : 4]
    return image / image.sum()


def difference(a, b):
    """Rms difference of images over the rms of the second."""
    return np.sqrt(((a - b) ** 2).sum() / (b**2).sum())


#: So wide a seeing that diffraction at the rims, which these rays lack, is next to nothing.
WIDE = 0.065


def blur(k, r0=WIDE):
    baseline = k * FOCAL_LENGTH * WAVE / (2.0 * np.pi)
    return coherence(structure_function(baseline, r0, 25.0), WAVE) * np.exp(-0.5 * (DIFFUSION * k) ** 2)


@pytest.mark.long
def test_long_exposure_donuts_are_random_rays_under_the_mean_atmosphere():
    n_ray = 500_000
    telescope = defocused(0.6e-3)
    expected = brute_force(telescope, CORNER, 81, n_ray, blur)
    psf = make_psfs(telescope, [CORNER], [WAVE], atmosphere=air(WIDE), engine="long_exposure", stamps=Stamps(81))
    # Noise: 5e5 rays on 1300 pixels, averaged over the 28 pixels of the blur, make 1 %.
    assert difference(psf.image[0], expected) < 0.014
    assert psf.inside[0] > 0.99


@pytest.mark.long
def test_a_short_camera_of_strong_aberrations_is_its_waves():
    """The aberrations of a Schmidt camera of f/2.5 blur stars by 1.9 arcsec and 28 um."""
    schmidt = pachon.new_telescope("schmidt", diameter=1.2, f_number=2.5)
    opd = pachon.wavefront_opd(schmidt, (0.0, 0.0), WAVE, grid=512)
    wave = np.where(opd.lit, np.exp(2j * np.pi * np.where(opd.lit, opd.value, 0.0) / WAVE), 0.0)
    count = 2 * len(wave)
    transfer = scipy.fft.fftshift(scipy.fft.ifft2(np.abs(scipy.fft.fft2(wave, (count, count))) ** 2).real)
    baseline = (np.arange(count) - count // 2) * (opd.x[0, 1] - opd.x[0, 0])
    transfer *= coherence(structure_function(np.hypot(baseline, baseline[:, None]), 0.16, 25.0), WAVE)
    k = 2.0 * np.pi * baseline / (WAVE * pachon.first_order(schmidt, WAVE).focal_length)
    detector = np.sinc(0.5 * k * PIXEL / np.pi) * np.exp(-0.5 * (DIFFUSION * k) ** 2)
    waves = detector * np.exp(1j * np.outer((np.arange(41) - 20) * PIXEL, k))
    expected = (waves @ transfer @ waves.T).real
    expected /= expected.sum()
    psf = make_psfs(schmidt, [(0.0, 0.0)], [WAVE], atmosphere=air(), engine="long_exposure", stamps=Stamps(41))
    # By rays and strips along the rims, across which waves bend: 1.1 % of the peak. The grid here leaves 0.1.
    assert np.abs(psf.image[0] - expected).max() < 0.002 * expected.max()


@pytest.mark.long
def test_fast_donuts_without_air_are_random_rays():
    telescope = defocused(0.6e-3)
    charge = 15e-6

    def smooth(k):
        baseline = k * FOCAL_LENGTH * WAVE / (2.0 * np.pi)
        return diffraction_otf(baseline, LSST.pupil_diameter, LSST.pupil_obscuration) * np.exp(-0.5 * (charge * k) ** 2)

    expected = brute_force(telescope, CORNER, 81, 500_000, smooth)
    psf = make_psfs(telescope, [CORNER], [WAVE], stamps=Stamps(81, diffusion=charge))
    # The noise of the random rays is 1 % as above.
    assert difference(psf.image[0], expected) < 0.014


@pytest.mark.long
def test_geometric_donuts_are_those_of_wave_optics_within_the_fringes_of_the_rims():
    telescope = defocused(0.3e-3)
    common = {"stamps": Stamps(41, diffusion=15e-6)}
    fast = make_psfs(telescope, [CORNER], [WAVE], **common).image[0]
    wave = make_psfs(telescope, [CORNER], [WAVE], engine="wave", **common).image[0]
    # Fresnel fringes at the rims, sqrt(wavelength x defocus) = 14 um wide, are what is left: a mirrored or moved donut
    # differs by ten times as much.
    assert difference(fast, wave) < 0.03
    assert difference(fast[::-1], wave) > 0.1
    assert difference(np.roll(fast, 1, axis=1), wave) > 0.08


@pytest.mark.long
def test_fast_donuts_average_to_the_long_exposure():
    telescope = defocused(0.5e-3)
    long = make_psfs(telescope, [CORNER], [WAVE], atmosphere=air(), engine="long_exposure", stamps=Stamps(71)).image[0]
    mean = np.zeros_like(long)
    slow = load_site("cerro_pachon").with_layers(wind_speeds=[5.0] * 6)
    screens = ScreenSampling(screen_size=1024, screen_length=162.5)
    for epoch in range(2):
        exposure = air(site=slow, epoch=epoch, time_step=0.1, exposure=15.0, screens=screens)
        mean += make_psfs(telescope, [CORNER], [WAVE], atmosphere=exposure, stamps=Stamps(71)).image[0] / 2
    # Each exposure differs by some 5 %; with dots in place of a donut it were 40.
    assert difference(mean, long) < 0.07


@pytest.mark.long
@pytest.mark.parametrize("engine", ["fast", "long_exposure"])
def test_stars_do_not_depend_on_donuts_beside_them(engine):
    heights = pachon.FocalPlane.flat("lsst").with_moved("R22_S11", dz=0.4e-3)
    fields = pachon.fields_at(LSST, [(0.0, 0.0), (0.05, 0.0)])
    stamps = Stamps(61, pixel_size=PIXEL)
    options = {"focal_plane": heights, "stamps": stamps, "engine": engine}
    options |= {"engine": pachon.FastEngine(oversampling=2)} if engine == "fast" else {"atmosphere": air()}
    together = make_psfs(LSST, fields, [WAVE], **options)
    for i, field in enumerate(fields):
        alone = make_psfs(LSST, [field], [WAVE], **options)
        assert alone.image[0].tobytes() == together.image[i].tobytes()
        assert alone.reference_point[0].tobytes() == together.reference_point[i].tobytes()
    peaks = together.image.max(axis=(1, 2))
    assert peaks[1] > 5.0 * peaks[0]
    options["stamps"] = replace(stamps, recenter=lambda im, scale: np.full((len(im), 2), 2.0))
    recentred = make_psfs(LSST, fields, [WAVE], **options)
    # Moved by two whole pixels; what leaves the stamp or comes in at its rim is faint.
    assert recentred.image[:, 5:-5, 5:-5] == pytest.approx(together.image[:, 7:-3, 7:-3], abs=2e-3 * float(peaks.min()))


@pytest.mark.long
def test_spiders_shade_and_diffract_long_exposure_donuts():
    """Against wave optics under the mean atmosphere; without diffraction at the spiders they differ by 0.013."""
    side, r0 = 61, 0.1
    obstructed = defocused(0.4e-3, pachon.load_telescope("lsst_v3.3_r_obstructed"))
    waves = make_psfs(obstructed, [CORNER], [WAVE], engine="wave", stamps=Stamps(side, diffusion=0.0)).image[0]
    k = 2.0 * np.pi * scipy.fft.fftfreq(2 * side, PIXEL)
    spectrum = scipy.fft.fft2(waves, (2 * side, 2 * side)) * blur(np.hypot(k, k[:, None]), r0)
    expected = scipy.fft.ifft2(spectrum).real[:side, :side]
    options = {"atmosphere": air(r0), "engine": "long_exposure", "stamps": Stamps(side)}
    image = make_psfs(obstructed, [CORNER], [WAVE], **options).image[0]
    without = make_psfs(defocused(0.4e-3), [CORNER], [WAVE], **options).image[0]
    assert difference(image, expected / expected.sum()) < 0.004
    assert difference(without, expected / expected.sum()) > 0.04


@pytest.mark.parametrize("engine", ["fast", "wave", "long_exposure"])
def test_stamps_that_cut_the_light_off_are_refused(engine):
    options = {"atmosphere": air()} if engine == "long_exposure" else {}
    with pytest.raises(DomainError, match=r"size = 31 .*: .* of the light of the star at field .* at least 15[13] p"):
        make_psfs(defocused(1.5e-3), [(0.0, 0.01)], [WAVE], engine=engine, **options)
