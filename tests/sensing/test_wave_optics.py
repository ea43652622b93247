"""Donuts of waves: squared Fourier transforms of the pupil under a long exposure, fitted with diffraction."""

import donut_images
import numpy as np
import pytest
from donut_images import donut, noisy
from scipy import fft
from scipy.ndimage import map_coordinates

import pachon
from pachon.core.errors import ConfigError
from pachon.core.units import ARCSEC
from pachon.models.zernike_polynomials import annular_zernikes
from pachon.pipeline.simulate import donut_file
from pachon.pipeline.simulate.donut_file import DonutScene, simulate_donuts
from pachon.raytrace.rays import RayStatus
from pachon.wavefront.atmosphere.turbulence import coherence, long_exposure_fwhm, structure_function
from pachon.wavefront.chief_rays import image_jacobians

WAVELENGTH, PIXEL, SIZE, OUTER_SCALE = 620e-9, 10e-6, 161, 25.0
#: Fields of donuts drawn by other means, and the wavelength of those of rays.
FIELDS, RAYS_WAVELENGTH = np.deg2rad([(0.6, 0.9), (1.0, -0.7)]), donut_images.WAVELENGTH
#: Points of the field along a side, and their distance on the pupil [m].
COUNT, STEP = 4096, 4e-3


@pytest.fixture(scope="module")
def on_axis(behind_focus):
    """Transform of the donut on the axis without air, wavenumbers [rad/m], cell [m] and landing over direction [m]."""
    outer = 0.5 * behind_focus.pupil_diameter
    inner = behind_focus.pupil_obscuration * outer
    radius = np.linspace(0.0, outer, 2001)
    end = pachon.trace(behind_focus, pachon.launch_rays(behind_focus, (0.0, 0.0), WAVELENGTH, (radius, 0.0 * radius)))
    lit = end.status == RayStatus.OK
    odd = np.polynomial.polynomial.polyfit(radius[lit] / outer, end.position[lit, 0], range(1, 15, 2))
    length = float(image_jacobians(behind_focus, np.array([[0.0, 0.0, -1.0]]), WAVELENGTH)[0, 0, 0])
    # Light lands where the gradient of the wavefront sends it; on the axis all of it is along the radius.
    path = np.polynomial.polynomial.polyint(odd) * outer / length
    along = (np.arange(COUNT) - COUNT // 2) * STEP
    r = np.hypot(along, along[:, None])
    amplitude = np.clip((outer - r) / STEP + 0.5, 0.0, 1.0) * np.clip((r - inner) / STEP + 0.5, 0.0, 1.0)
    phase = 2.0 * np.pi / WAVELENGTH * np.polynomial.polynomial.polyval(np.minimum(r, 1.01 * outer) / outer, path)
    light = np.abs(fft.fft2(fft.ifftshift(amplitude * np.exp(1j * phase)))) ** 2
    cell = WAVELENGTH * length / (COUNT * STEP)
    kx, ky = 2.0 * np.pi * fft.rfftfreq(COUNT, cell), 2.0 * np.pi * fft.fftfreq(COUNT, cell)[:, None]
    return fft.rfft2(light / light.sum()), kx, ky, cell, length


@pytest.mark.slow
@pytest.mark.parametrize(("r0", "left", "of_rays"), [(0.1045, 4e-9, 30e-9), (0.16, 8e-9, 30e-9)])
def test_diffraction_is_not_taken_for_wavefront(behind_focus, on_axis, r0, left, of_rays):
    spectrum, kx, ky, cell, length = on_axis
    air = coherence(
        structure_function(np.hypot(kx, ky) * length * WAVELENGTH / (2.0 * np.pi), r0, OUTER_SCALE), WAVELENGTH
    )
    pixel = np.sinc(0.5 * kx * PIXEL / np.pi) * np.sinc(0.5 * ky * PIXEL / np.pi)
    fine = fft.fftshift(fft.irfft2(spectrum * air * pixel, s=(COUNT, COUNT)))
    at = COUNT // 2 + (np.arange(SIZE) - SIZE // 2) * PIXEL / cell
    image = 5e6 * (PIXEL / cell) ** 2 * map_coordinates(fine, np.meshgrid(at, at, indexing="ij"), order=5)
    assert image.sum() == pytest.approx(5e6, rel=2e-4)
    found = {
        diffraction: pachon.fit_donuts(
            behind_focus,
            image[None],
            [(0.0, 0.0)],
            WAVELENGTH,
            sky_variance=1000.0,
            pixel_size=PIXEL,
            model=pachon.DonutModel(air=pachon.DonutAir(outer_scale=OUTER_SCALE), diffraction=diffraction),
            threads=1,
        )
        for diffraction in (False, True, None)
    }
    rss = {key: float(np.linalg.norm(fit.zernikes[0])) for key, fit in found.items()}
    assert rss[True] < left
    assert rss[False] > of_rays
    seeing = long_exposure_fwhm(WAVELENGTH, r0, OUTER_SCALE)
    assert abs(found[True].fwhm[0] - seeing) < abs(found[False].fwhm[0] - seeing)
    # Told from the image itself, and the same then.
    assert (found[False].diffraction, found[True].diffraction, found[None].diffraction) == (False, True, True)
    np.testing.assert_array_equal(found[None].zernikes, found[True].zernikes)


@pytest.mark.long
@pytest.mark.parametrize(
    "blur", [pytest.param(0.0, marks=pytest.mark.slow), 0.7, pytest.param(1.5, marks=pytest.mark.slow)]
)
def test_images_of_rays_are_told_from_those_of_waves(behind_focus, blur):
    """Of dense rays, under a blur that is no Kolmogorov's either."""
    images = np.stack([noisy(donut(behind_focus, field, blur=blur), 500.0, 2) for field in FIELDS])
    fit = pachon.fit_donuts(
        behind_focus, images, FIELDS, RAYS_WAVELENGTH, sky_variance=500.0, pixel_size=20e-6, threads=1
    )
    assert fit.diffraction is False
    assert fit.usable.all()
    assert fit.summary()["diffraction"] is False


@pytest.mark.long
@pytest.mark.parametrize("known", [pytest.param(True, marks=pytest.mark.slow), False])
def test_donuts_of_a_small_telescope_fit_what_they_are_drawn_with(known):
    """Strips along the rims of AuxTel are wider than where their light is in phase: such fits did not converge."""
    focused = pachon.load_telescope("auxtel")
    detector = pachon.DonutDetector(defocus=0.8e-3, moved="M2")
    air = pachon.DonutAir(fwhm=np.deg2rad(0.55 / 3600))
    drawn = pachon.draw_donuts(
        focused, [(0.0, 0.0)], model=pachon.DonutModel(air=air, detector=detector), stamps=pachon.Stamps(251)
    )
    model = pachon.DonutModel(air=air if known else pachon.DonutAir(), detector=detector, diffraction=True)
    fit = pachon.fit_donuts(focused, 1e7 * drawn.psf.image, [(0.0, 0.0)], sky_variance=500.0, model=model, threads=1)
    assert fit.usable.all()
    # 50 nm where the donut had another scale than its rays; cells, and a last step that is not made, leave 5 nm.
    assert np.linalg.norm(fit.zernikes[0]) < 8e-9
    assert np.linalg.norm(fit.zernikes[0]) < np.sqrt(np.trace(fit.covariance[0]))
    assert fit.fwhm[0] == pytest.approx(air.fwhm, rel=0.05)


@pytest.mark.long
def test_shadows_of_vanes_are_not_taken_for_wavefront():
    """By strips along discs and rings alone 23 nm of Z4, "rim moved", and a seeing of 0.88 arcsec."""
    focused, field = pachon.load_telescope("decam"), np.deg2rad([(0.5, 0.4)])
    detector = pachon.DonutDetector(15e-6, defocus=1.5e-3)
    air = pachon.DonutAir(fwhm=np.deg2rad(0.8 / 3600))
    drawn = pachon.draw_donuts(
        focused, field, model=pachon.DonutModel(air=air, detector=detector), stamps=pachon.Stamps(75)
    )
    model = pachon.DonutModel(detector=detector, diffraction=True)
    fit = pachon.fit_donuts(focused, 1e7 * drawn.psf.image, field, sky_variance=500.0, model=model, threads=1)
    assert fit.reasons == [""]
    assert np.linalg.norm(fit.zernikes[0]) < 6e-9
    assert fit.fwhm[0] == pytest.approx(air.fwhm, rel=0.02)


@pytest.mark.slow
def test_donuts_of_waves_are_told_from_those_of_rays(behind_focus):
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=1)
    images = 5e6 * pachon.draw_donuts(behind_focus, FIELDS, [WAVELENGTH], atmosphere=air).psf.image
    images = np.random.default_rng(1).poisson(images + 500.0) - 500.0
    seen = []
    fit = pachon.fit_donuts(
        behind_focus, images, FIELDS, WAVELENGTH, sky_variance=500.0, threads=1, progress=seen.append
    )
    assert fit.diffraction is True
    assert seen == [1] * len(FIELDS)
    # By rays alone 50 nm, and a chi-square of 1.13.
    assert (fit.chi2 / fit.n_pixels).max() < 1.03
    assert np.linalg.norm(fit.zernikes, axis=1).max() < 50e-9


@pytest.mark.long
def test_diffraction_of_bright_donuts_is_not_taken_for_rims_elsewhere(monkeypatch):
    telescope = pachon.load_telescope("decam")
    detector = pachon.DonutDetector(15e-6, defocus=1.5e-3, moved="DECam")
    model = pachon.DonutModel(detector=detector).with_light(None)
    scene = DonutScene(stars=1, stamp=64, electrons=4e6)
    donuts = simulate_donuts(telescope, telescope, scene, model, np.deg2rad([-0.03, -0.17]))

    def searched(*_):
        raise AssertionError("a search for rims, which takes seconds")

    # By rays alone coarse pixels leave twice the misfit from which on rims are searched for.
    monkeypatch.setattr("pachon.sensing.rim_search._each_freed", searched)
    fit = pachon.fit_donuts(telescope, donuts.images, donuts.fields, donuts.wavelength, sky_variance=381.0, model=model)
    assert fit.diffraction
    assert np.linalg.norm(fit.zernikes[0]) < 3.0 * np.sqrt(np.trace(fit.covariance[0]))


def test_stamps_hold_the_light_not_rays_that_are_stopped():
    """Rays that the apertures of HSC stop land up to 50 mm off: stamps had 3739 pixels a side, and took minutes."""
    hsc = pachon.load_telescope("hsc").perturbed("Detector", shift=(0.0, 0.0, 0.8e-3))
    fields = np.deg2rad([(0.58, 0.01), (-0.41, -0.35), (0.0, 0.7)])
    model = pachon.DonutModel(air=pachon.DonutAir(fwhm=0.8 * np.pi / 648000))
    assert donut_file._stamp_size(hsc, fields, model) == 181


@pytest.mark.long
def test_zernikes_of_simulated_donuts_are_those_of_the_light():
    """At 0.54 degrees the apertures of HSC stop 29 % of the rays, which aspheres would bend far beyond the light."""
    hsc = pachon.load_telescope("hsc")
    moved, field = hsc.perturbed("HSC", shift=(200e-6, 0.0, 0.0)), np.deg2rad([-0.4087, -0.3526])
    model = pachon.DonutModel(
        air=pachon.DonutAir(fwhm=0.8 * np.pi / 648000), detector=pachon.DonutDetector(defocus=1e-3)
    )
    donuts = simulate_donuts(hsc, moved, DonutScene(stars=1), model, field)
    before, after = (pachon.wavefront_opd(t, field, hsc.default_wavelength, grid=96) for t in (hsc, moved))
    lit = before.lit & after.lit
    points = np.stack([before.x, before.y])[:, lit] / (0.5 * hsc.pupil_diameter)
    terms = annular_zernikes(22, *points, hsc.pupil_obscuration).T
    left = (after.value - before.value)[lit] - terms[:, 3:] @ donuts.zernikes[0]
    left -= terms[:, :3] @ np.linalg.lstsq(terms[:, :3], left, rcond=None)[0]
    # Of a change of 120 nm; terms beyond Z22 leave the rest.
    assert np.std(left) < 1.5e-9


def test_corner_sensors_are_those_of_the_lsst_alone():
    hsc = pachon.load_telescope("hsc")
    with pytest.raises(ConfigError, match="layout = corners: hsc has the camera hsc; expected the LSST's, or random"):
        simulate_donuts(hsc, hsc, DonutScene(layout="corners"), pachon.DonutModel(detector=pachon.DonutDetector(1e-3)))


@pytest.mark.long
def test_an_amount_of_diffracted_light_that_is_neither_of_rays_nor_of_waves_does_not_decide():
    """With 60 nm in each term up to Z22 a fit by rays, 60 nm wrong, told a third of the diffracted light."""
    auxtel = pachon.load_telescope("auxtel")
    z = 60e-9 * np.random.default_rng(3).standard_normal(19)
    aberration = pachon.wavefront.ResidualWavefront(z, auxtel.pupil_diameter, auxtel.pupil_obscuration)
    detector = pachon.DonutDetector(defocus=0.8e-3, moved="M2")
    axis, wavelength = np.zeros((1, 2)), auxtel.default_wavelength
    air = pachon.DonutAir(fwhm=1.0 * ARCSEC)
    donuts = pachon.draw_donuts(
        auxtel,
        axis,
        wavelength,
        model=pachon.DonutModel(air=air, detector=detector),
        electrons=3e6,
        sky=36.0,
        seed=3,
        stamps=pachon.Stamps(221),
        aberration=aberration,
    )
    fit = pachon.fit_donuts(
        auxtel,
        donuts.images,
        axis,
        wavelength,
        sky_variance=donuts.sky_variance,
        model=pachon.DonutModel(detector=detector),
    )
    assert fit.diffraction
    assert np.linalg.norm(fit.zernikes[0] - z) < 25e-9


def test_caustics_of_waves_are_not_taken_for_rays():
    # By rays Z4 of this doublet of 300 mm was 111 nm off, with 30 claimed.
    lens = pachon.new_telescope("doublet", diameter=0.3)
    detector = pachon.DonutDetector(defocus=4e-3, pixel_size=10e-6)
    model = pachon.DonutModel(air=pachon.DonutAir(fwhm=0.8 * ARCSEC), detector=detector)
    field = np.deg2rad([[-0.545, -0.470]])
    drawn = pachon.draw_donuts(lens, field, model=model, electrons=2e6, sky=377.0, seed=1, stamps=pachon.Stamps(95))
    free = pachon.DonutModel(detector=detector)
    fit = pachon.fit_donuts(lens, drawn.images, field, model=free, sky_variance=377.0, threads=1)
    assert fit.diffraction
    assert abs(fit.zernikes[0, 0]) < 2.0 * fit.errors[0, 0] < 60e-9
