"""Diffraction images against closed forms, a plain FFT, each other and the rays."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.design.images.diffraction import fft_psf, huygens_psf, lattice_sum, wavelet_sum
from pachon.design.images.wavelets import lattice_wavelets, traced_wavelets
from pachon.design.metrics.spots import spots
from pachon.models.aperture import Circle
from pachon.wavefront.opd import wavefront_opd
from pachon.wavefront.pupil_sampling import gauss_annulus
from pachon.wavefront.request import Request

WAVE = 500e-9


def annulus_pattern(radius, scale, obscuration):
    """Irradiance of a perfect annular pupil over that of its peak (Born & Wolf, sec. 8.6.2); scale is lambda N."""
    v = np.maximum(np.pi * radius / scale, 1e-9)
    e = obscuration
    amplitude = 2.0 * j1(v) / v
    if e:
        amplitude = (amplitude - e**2 * 2.0 * j1(e * v) / (e * v)) / (1.0 - e**2)
    return amplitude**2


@pytest.mark.long
@pytest.mark.parametrize("obscuration", [0.0, 0.6])
@pytest.mark.parametrize("method", [fft_psf, huygens_psf])
def test_a_perfect_pupil_makes_the_pattern_of_airy(paraboloid, obscuration, method):
    telescope = paraboloid(f_number=50.0, obscuration=obscuration)
    extra = {"sampling": gauss_annulus(0.02, obscuration, 30, 150)} if method is huygens_psf else {"n_pupil": 400}
    psf = method(telescope, [[0.0, 0.0]], WAVE, pixels=65, **extra)
    radius = np.hypot.outer(psf.axis, psf.axis)
    expected = annulus_pattern(radius, 50.0 * WAVE, obscuration)
    # Peak of all the light: pi / 4 (1 - e^2) / (lambda N)^2, and so in a pixel.
    peak = 0.25 * math.pi * (1.0 - obscuration**2) / (50.0 * WAVE) ** 2 * psf.pixel**2
    # The rim of the lattice is known to 1/6 of a cell (1e-3 of the peak); quadrature has no such error, but at f/50
    # the cosines are 1e-4 off those of a lens.
    tolerance = 3e-4 if method is huygens_psf else 1.5e-3
    assert psf.image[0] / peak == pytest.approx(expected, abs=tolerance)
    assert psf.strehl[0] == pytest.approx(1.0, abs=1e-4)
    assert psf.lit_fraction[0] == pytest.approx(1.0, abs=2e-3)
    assert psf.airy_radius[0] == pytest.approx(1.22 * 50.0 * WAVE, rel=1e-3)


@pytest.mark.parametrize("per_airy", [2.7, 3.3, 5.0, 20.0])
def test_the_fwhm_does_not_depend_on_the_pixels(paraboloid, per_airy):
    scale = 50.0 * WAVE
    psf = fft_psf(paraboloid(f_number=50.0), [[0.0, 0.0]], WAVE, pixel=scale / per_airy, pixels=64)
    # Of a clear disc 1.02899 wavelengths times the focal ratio; the lattice's rim adds 1e-3.
    assert psf.fwhm[0] == pytest.approx(1.02899 * scale, rel=2e-3)


def test_a_defocused_disc_has_the_strehl_ratio_of_theory(paraboloid):
    # Defocus dz puts dz / (8 N^2) waves of lambda over the pupil, and Strehl = sinc^2 of them.
    shift = 5.0 * WAVE * 50.0**2
    psf = fft_psf(paraboloid(f_number=50.0, shift=shift), [[0.0, 0.0]], WAVE, pixels=33, pixel=6e-6, n_pupil=300)
    waves = shift / (8.0 * 50.0**2) / WAVE
    assert waves == pytest.approx(0.625)
    # The brightest point is the middle for less than a wave of defocus.
    assert psf.strehl[0] == pytest.approx(np.sinc(waves) ** 2, abs=2e-3)


@pytest.mark.long
def test_the_lattice_sum_is_the_fast_fourier_transform(lsst_r):
    field = np.deg2rad([0.3, -0.8])
    center = spots(lsst_r, field).reference_point[0]
    lattice = lattice_wavelets(Request.of(lsst_r, field), 620e-9, center, 0.81 / 96)
    n = 256
    pupil = np.zeros((n, n), dtype=complex)
    half = len(lattice.steps) // 2
    place = slice(n // 2 - half, n // 2 + half + 1)
    pupil[place, place] = lattice.wavelets.field
    # A positive exponent: numpy's inverse transform times the number of points.
    amplitude = np.fft.fftshift(np.fft.ifft2(np.fft.ifftshift(pupil))) * n * n
    axis = (np.arange(n) - n // 2) * 620e-9 / (n * lattice.spacing)
    expected = np.abs(amplitude) ** 2
    assert lattice_sum(lattice, axis, axis) == pytest.approx(expected, rel=1e-9, abs=1e-9 * expected.max())


def test_wavelets_are_summed_at_every_pixel(lsst_r):
    request = Request.of(lsst_r, np.deg2rad([0.3, -0.8]), sampling=gauss_annulus(4.18, 0.612, 5, 16))
    wavelets = traced_wavelets(request, 620e-9, np.array([0.0539, -0.1440]))
    x, y = np.array([-1e-6, 0.0, 2.5e-6]), np.array([0.7e-6, 3e-6])
    k = 2.0 * np.pi / 620e-9
    for i, b in enumerate(y):
        for j, a in enumerate(x):
            phase = k * (wavelets.cosine @ [a, b] - wavelets.opd)
            field = (wavelets.amplitude * np.exp(1j * phase)).sum() / 620e-9
            assert wavelet_sum(wavelets, x, y)[i, j] == pytest.approx(abs(field) ** 2, rel=1e-9)


@pytest.mark.parametrize("field", [(0.0, 0.0), (0.01, -0.02)])
def test_path_differences_are_those_of_the_reference_sphere(lsst_r, field):
    sampling = gauss_annulus(4.1, 0.65, 6, 24)
    opd = wavefront_opd(lsst_r, field, 620e-9, tuple(sampling.points.T))
    wavelets = traced_wavelets(Request.of(lsst_r, field, sampling=sampling), 620e-9, opd.center[:2])
    lit = opd.lit & (wavelets.amplitude > 0)
    assert lit.sum() > 100
    # Sphere and plane waves differ by q^2 / 2R: 1e-11 m for rays 10 um from the centre.
    assert wavelets.opd[lit] == pytest.approx(opd.value[lit], abs=3e-11)


@pytest.mark.long
@pytest.mark.parametrize(
    "angle",
    [pytest.param((0.0, 0.0), marks=pytest.mark.slow), (0.9, -1.1), pytest.param((0.0, 1.75), marks=pytest.mark.slow)],
)
def test_fourier_sum_and_huygens_wavelets_agree(angle):
    telescope = pachon.load_telescope("lsst_v3.3_i")
    field = np.deg2rad([angle])
    both = [
        fft_psf(telescope, field, [700e-9, 800e-9], pixels=64, n_pupil=192),
        huygens_psf(telescope, field, [700e-9, 800e-9], pixels=64, pixel=None),
    ]
    peak = both[0].image.max()
    # Both know the rim of the pupil to a part of a cell: 192 and 160 cells across.
    assert np.abs(both[0].image - both[1].image).max() < 4e-3 * peak
    assert both[0].strehl == pytest.approx(both[1].strehl, rel=5e-3)
    assert both[0].lit_fraction == pytest.approx(both[1].lit_fraction, abs=3e-3)
    assert both[0].centroid == pytest.approx(both[1].centroid, abs=3e-8)


@pytest.mark.long
def test_huygens_wavelets_do_not_repeat_themselves_within_the_image(paraboloid):
    """As many rays as the image needs by default; too few would add up to more light than there is."""
    telescope, options = paraboloid(obscuration=0.5), {"pixel": 100e-6, "pixels": 20}
    image = huygens_psf(telescope, [[0.0, 0.0]], WAVE, **options)
    # The side of the image over wavelength times focal ratio, 10 um.
    assert image.n_pupil == 200
    assert image.inside[0] == pytest.approx(fft_psf(telescope, [[0.0, 0.0]], WAVE, **options).inside[0], abs=5e-3)
    assert huygens_psf(telescope, [[0.0, 0.0]], WAVE, pixels=8).n_pupil == 160
    with pytest.raises(DomainError, match=r"n_pupil = 100: the pattern repeats after 1000 um; .* 2000 um"):
        huygens_psf(telescope, [[0.0, 0.0]], WAVE, n_pupil=100, **options)
    with pytest.raises(DomainError, match="need 1000 points across the pupil; expected at most 512"):
        huygens_psf(telescope, [[0.0, 0.0]], WAVE, pixel=500e-6, pixels=20)


@pytest.mark.long
def test_without_a_cut_rim_they_agree_to_a_thousandth():
    telescope = pachon.load_telescope("paul_baker")
    field = [[0.0, np.deg2rad(0.4)]]
    gauss = gauss_annulus(0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, 40, 160)
    one = fft_psf(telescope, field, pixels=64, n_pupil=384)
    other = huygens_psf(telescope, field, pixels=64, sampling=gauss)
    assert np.abs(one.image - other.image).max() < 1.5e-3 * one.image.max()


@pytest.mark.long
def test_the_image_points_the_same_way_as_the_spot(lsst_r):
    # Coma and astigmatism of a decentred secondary, and defocus: some ten Airy discs of aberration.
    telescope = lsst_r.perturbed("M2", shift=(1e-3, 4e-4, 0.0), tilt=(0.0, 1e-4, 0.0))
    telescope = telescope.perturbed("Detector", shift=(0.0, 0.0, 20e-6))
    field = np.deg2rad([[0.4, 0.3]])
    psf = fft_psf(telescope, field, 620e-9, pixels=192, reference="chief")
    spot = spots(telescope, field, 620e-9, reference="chief")
    place = spot.displacement[0, 0] - spot.centroid[0]
    weight = spot.weight[0, 0] / spot.weight.sum()
    radius = 3.0 * spot.rms_radius[0]
    x, y = np.meshgrid(psf.axis - spot.centroid[0, 0], psf.axis - spot.centroid[0, 1])
    light = np.where(np.hypot(x, y) < radius, psf.image[0], 0.0)
    light /= light.sum()

    def moments(u, v, w):
        inside = np.hypot(u, v) < radius
        u, v, w = u[inside], v[inside], w[inside] / w[inside].sum()
        second = [(w * (u * u - v * v)).sum(), 2.0 * (w * u * v).sum()]
        third = [(w * (u**2 + v**2) * u).sum(), (w * (u**2 + v**2) * v).sum()]
        return np.array(second), np.array(third)

    geometric, diffracted = moments(*place.T, weight), moments(x.ravel(), y.ravel(), light.ravel())
    assert np.linalg.norm(spot.centroid[0]) > 2e-6
    # The wings that the circle leaves out are not the same on all sides; a mirrored image would be off by 200 %.
    off = np.array([(light * x).sum(), (light * y).sum()])
    assert np.linalg.norm(off) < 0.15 * np.linalg.norm(spot.centroid[0])
    for a, b in zip(geometric, diffracted, strict=True):
        # Diffraction adds its own size but no direction; a mirrored or turned image would be off by the whole.
        assert np.linalg.norm(a - b) < 0.15 * np.linalg.norm(a)


@pytest.mark.long
def test_all_the_light_lands(paraboloid):
    telescope = paraboloid(f_number=20.0, obscuration=0.3)
    psf = fft_psf(telescope, [[0.0, 0.0]], WAVE, pixels=600, pixel=20.0 * WAVE / 4, n_pupil=512)
    # Beyond a radius of r Airy units the wings hold 2 / (pi^2 (1 - e) r) of the light: 0.4 % at 75 of them.
    assert psf.inside[0] == pytest.approx(1.0 - 2.0 / (math.pi**2 * (1.0 - 0.3) * 75.0), abs=2e-3)


@pytest.mark.long
def test_several_wavelengths_add_up(lsst_r):
    field = np.deg2rad([[0.0, 1.6]])
    common = dict(pixels=32, pixel=0.4e-6, reference="chief", n_pupil=128)
    both = fft_psf(Request.of(lsst_r, field, [560e-9, 690e-9], wavelength_weights=[1.0, 3.0]), **common)
    # The middle wavelength's chief ray is the place of both.
    red = fft_psf(lsst_r, field, [690e-9], **common)
    alone = fft_psf(Request.of(lsst_r, field, [560e-9, 690e-9], wavelength_weights=[1.0, 0.0]), **common)
    light = 0.25 * alone.lit_fraction + 0.75 * red.lit_fraction
    total = (0.25 * alone.lit_fraction * alone.image + 0.75 * red.lit_fraction * red.image) / light
    assert both.lit_fraction == pytest.approx(light, rel=2e-3)
    assert both.image == pytest.approx(total, abs=2e-3 * total.max())


def test_the_number_of_threads_changes_nothing(lsst_r):
    one, two = (fft_psf(lsst_r, [[0.0, 0.02]], pixels=32, threads=n) for n in (1, 2))
    assert np.array_equal(one.image, two.image)


def test_summary_and_picture(lsst_r):
    psf = fft_psf(lsst_r, np.deg2rad([[0.0, 0.0], [0.0, 1.0]]), pixels=48)
    summary = psf.summary()
    assert summary["fwhm_um"] == pytest.approx(psf.fwhm * 1e6)
    # A perfect annulus of this obscuration has 0.87 wavelengths times the focal ratio; pixels here are a third of that.
    assert summary["fwhm_um"][0] == pytest.approx(0.87 * 0.624 * 1.234, rel=0.15)
    assert psf.plot().get_size_inches()[0] > 5


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"pixels": 2}, "pixels = 2"),
        ({"pixel": -1e-6}, "pixel = -1e-06"),
        ({"n_pupil": 4}, "n_pupil = 4"),
        ({"n_pupil": 16}, "repeats"),
        ({"pixel": 1e-4}, "points across the pupil"),
    ],
)
def test_what_cannot_be_had_is_an_error(lsst_r, options, text):
    with pytest.raises(DomainError, match=text):
        fft_psf(lsst_r, [[0.0, 0.0]], **options)


def test_other_errors(lsst_r, paraboloid):
    with pytest.raises(ConfigError, match="reference = 'middle'"):
        huygens_psf(lsst_r, reference="middle")
    telescope = paraboloid()
    dark = replace(telescope.surfaces[0], aperture=Circle(0.001, x=1.0))
    for image in (fft_psf, huygens_psf, pachon.mtf):
        with pytest.raises(DomainError, match="no light passes"):
            image(replace(telescope, surfaces=(dark, telescope.surfaces[1])), [[0.0, 0.0]])
