"""The statistical engine and moments without images: against images, Fourier kernels restated here and refusals."""

import math

import numpy as np
import pytest
import warp as wp

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.core.launch import launch
from pachon.core.units import ARCSEC
from pachon.core.warp_arrays import warp_array
from pachon.models.ideal_telescope import ideal_telescope
from pachon.models.starting_designs.schmidt import schmidt
from pachon.wavefront.atmosphere.screen_sampling import ScreenSampling
from pachon.wavefront.psf import psf_moments
from pachon.wavefront.psf.engines import psf_engine
from pachon.wavefront.psf.psf import psf_inputs
from pachon.wavefront.psf.sample_packets import LANES, samples
from pachon.wavefront.psf.stamps import Stamps
from pachon.wavefront.psf.statistical import StatisticalRenderer
from pachon.wavefront.psf.statistical_kernels import blur_spectra

WAVE = [620e-9]
FIELDS = np.deg2rad([[0.0, 0.0], [0.5, -0.3], [-1.2, 0.8], [0.51, -0.3]])


@pytest.fixture(scope="module")
def air():
    return pachon.Atmosphere.from_site("cerro_pachon", 4, exposure=10.0)


@pytest.fixture(scope="module")
def drawn(lsst, air):
    return pachon.make_psfs(lsst, FIELDS, WAVE, atmosphere=air, engine="statistical", threads=1)


@pytest.fixture(scope="module")
def lsst():
    return pachon.load_telescope("lsst_v3.3_r")


@pytest.mark.long
def test_bytes_do_not_depend_on_threads_and_other_stars(lsst, air, drawn):
    again = pachon.make_psfs(lsst, FIELDS[[3, 1]], WAVE, atmosphere=air, engine="statistical", threads=2)
    assert again.image.tobytes() == drawn.image[[3, 1]].tobytes()


def test_screens_that_are_not_made_do_not_matter(lsst, air, drawn):
    """Coarse ones, as 1024 samples on a side, took 12 % from the scatter of sizes."""
    coarse = pachon.Atmosphere.from_site("cerro_pachon", 4, exposure=10.0, screens=ScreenSampling(1024, 1000.0))
    images = pachon.make_psfs(lsst, FIELDS, WAVE, atmosphere=coarse, engine="statistical", threads=1).image
    assert images.tobytes() == drawn.image.tobytes()


@pytest.mark.long
def test_an_exposure_of_ideal_optics_is_the_long_one_under_its_kernel(lsst):
    """Without aberrations nothing is left of the mean wavefront but its own moments, which are taken away again.

    The long exposure is convolved here by a Fourier transform of its stamp, with the moments drawn.
    """
    ideal, air = ideal_telescope(lsst, 1e5), pachon.Atmosphere.from_site("cerro_pachon", 4, exposure=40.0)
    scale = 0.2 * ARCSEC
    stamps = Stamps(61, scale * ideal.reference_sphere_radius, 0.0)
    images = [
        pachon.make_psfs(ideal, FIELDS, WAVE, atmosphere=air, stamps=stamps, engine=e, threads=1).image
        for e in (pachon.LongExposureEngine(80), "statistical")
    ]
    inputs, _ = psf_inputs(ideal, FIELDS, WAVE, None, air, None, stamps, 1)
    renderer = psf_engine("statistical").renderer(inputs)
    slopes = np.tan(FIELDS)
    p, q, s = renderer.drawn.moments_at(slopes, *np.ones((2, len(slopes)))).T
    k = 2 * np.pi * np.fft.fftfreq(61, scale)
    kx, ky = np.meshgrid(k, k)
    left = []
    for star in range(len(FIELDS)):
        square = 0.5 * ((s + p)[star] * kx**2 + (s - p)[star] * ky**2) + q[star] * kx * ky
        blurred = np.fft.ifft2(np.fft.fft2(images[0][star].astype(float)) * np.exp(-0.5 * square)).real
        shapes = pachon.measure_shapes(np.stack([images[0][star], blurred, images[1][star]]), scale, 0.7 * ARCSEC)
        assert np.hypot(shapes.e1[2] - shapes.e1[0], shapes.e2[2] - shapes.e2[0]) > 5e-4
        left.append([shapes.e1[2] - shapes.e1[1], shapes.e2[2] - shapes.e2[1], np.log(shapes.size[2] / shapes.size[1])])
    # The mean wavefront's own third and fourth moments: 0.7, 0.9 and 1.2e-4 (rms of 144 stars) in 10 s, less in 40 s.
    # The kernel moves e by some 1e-3.
    assert np.abs(left).max() < 6e-5


@pytest.mark.long
@pytest.mark.parametrize("engine", ["long_exposure", "statistical"])
def test_moments_are_those_of_images(lsst, air, engine):
    """Under a round weight and adaptive; images repeat at 1.25 times the side of their stamps, moments do not."""
    plane = pachon.FocalPlane.from_budget("lsst", seed=1)
    fields = pachon.fields_at(lsst, [[0.001, 0.002], [0.12, -0.13], [-0.21, 0.08]])
    psfs = pachon.make_psfs(lsst, fields, WAVE, focal_plane=plane, atmosphere=air, engine=engine, threads=1)
    shapes = pachon.measure_shapes(psfs.image, psfs.pixel_scale, 0.7 * ARCSEC)
    adaptive = pachon.adaptive_moments(psfs.image, psfs.pixel_scale)
    moments = pachon.psf_moments(lsst, fields, WAVE, focal_plane=plane, atmosphere=air, engine=engine, threads=1)
    assert not moments.flags.any()
    # Pixels sample the image: 1e-5 of e and 1e-4 of adaptive moments.
    for name in ("e1", "e2"):
        assert getattr(moments, name) == pytest.approx(getattr(shapes, name), abs=3e-5)
    for name in ("g1", "g2"):
        assert getattr(moments, name) == pytest.approx(getattr(adaptive, name), abs=2e-4)
    assert moments.size == pytest.approx(shapes.size, rel=1e-4)
    assert moments.sigma == pytest.approx(adaptive.sigma, rel=3e-4)
    assert np.allclose(moments.T, adaptive.T, rtol=6e-4)
    assert moments.x == pytest.approx(shapes.x, abs=2e-4)
    assert moments.y == pytest.approx(shapes.y, abs=2e-4)


@pytest.mark.long
def test_wings_of_periodic_images_do_not_matter(lsst, air, monkeypatch):
    """Against a periodic image four times as wide: 5e-5 in size, of the wings' change over the weight.

    With even light left in, sizes would be wrong by 6e-4; without the wings of diffraction by 2e-4.
    """

    def moments():
        return pachon.psf_moments(lsst, FIELDS, WAVE, atmosphere=air, engine="statistical", threads=1)

    narrow = moments()
    for name in ("_SEEINGS", "_WEIGHTS"):
        monkeypatch.setattr(psf_moments, name, 4.0 * getattr(psf_moments, name))
    wide = moments()
    assert narrow.e1 == pytest.approx(wide.e1, abs=3e-5)
    assert narrow.e2 == pytest.approx(wide.e2, abs=3e-5)
    assert narrow.size == pytest.approx(wide.size, rel=1e-4)
    assert narrow.sigma == pytest.approx(wide.sigma, rel=2e-4)


@pytest.mark.long
def test_partly_lit_stars_have_enough_spokes(lsst, air, monkeypatch):
    """Against 172 spokes of 12 rings; along 12 e of stars lit 0.7 to 0.85 would be wrong by 5e-4."""
    aberration = pachon.wavefront.ResidualWavefront.draw(lsst, 0.1e-6, 1, 0)
    radius, angle = np.deg2rad(np.linspace(1.74, 1.86, 60)), 2.4 * np.arange(60)
    fields = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def moments(engine):
        return pachon.psf_moments(lsst, fields, WAVE, atmosphere=air, aberration=aberration, engine=engine, threads=1)

    default = moments("statistical")
    monkeypatch.setattr(StatisticalRenderer, "least_lit", 0.0)
    monkeypatch.setattr(StatisticalRenderer, "dense", ())
    fine = moments(pachon.StatisticalEngine(2064))
    partly_lit = (fine.lit_fraction > 0.7) & (fine.lit_fraction < 0.85)
    assert partly_lit.sum() > 20
    errors = np.stack([default.e1 - fine.e1, default.e2 - fine.e2])[:, partly_lit]
    assert np.sqrt((errors**2).sum(axis=0).mean()) < 3e-4
    assert np.abs(np.log(default.size / fine.size))[partly_lit].max() < 1e-3


@pytest.mark.long
def test_moments_of_optics_alone(lsst):
    """Against images of the wave engine on fine pixels, without diffusion."""
    defocused = lsst.perturbed("Detector", shift=(0.0, 0.0, 12e-6))
    stamps = Stamps(61, 2.5e-6, 0.0)
    fields = np.deg2rad([[0.0, 0.0], [1.1, 0.6]])
    psfs = pachon.make_psfs(defocused, fields, WAVE, stamps=stamps, engine="wave", threads=1)
    shapes = pachon.measure_shapes(psfs.image, psfs.pixel_scale, 0.3 * ARCSEC)
    moments = pachon.psf_moments(defocused, fields, WAVE, stamps=stamps, threads=1)
    # Strips along the rims, and what fine stamps of 3 arcsec lack.
    assert moments.e1 == pytest.approx(shapes.e1, abs=2e-3)
    assert moments.e2 == pytest.approx(shapes.e2, abs=2e-3)
    assert moments.size == pytest.approx(shapes.size, rel=0.01)
    assert np.isnan(moments.g1).all()


def test_moments_of_optics_alone_on_wide_pixels(lsst, monkeypatch):
    """Under pixels of 10 um strips along the rims suffice: against the lattice of the pupil."""
    waves = [560e-9, 620e-9, 680e-9]
    by_strips = pachon.psf_moments(lsst, FIELDS[:2], waves, threads=1)
    monkeypatch.setattr(StatisticalRenderer.__bases__[0], "_strips_suffice", lambda renderer: False)
    by_lattice = pachon.psf_moments(lsst, FIELDS[:2], waves, threads=1)
    assert by_strips.e1 == pytest.approx(by_lattice.e1, abs=2e-3)
    assert by_strips.e2 == pytest.approx(by_lattice.e2, abs=2e-3)
    assert by_strips.size == pytest.approx(by_lattice.size, rel=0.01)


def test_kernels_of_stars_are_gaussians():
    """Against exponentials in double precision, held at e; powers up to 400 of factors rounded to 6e-8: 2.4e-5."""
    random, reach = np.random.default_rng(1), 20
    columns, lines = np.arange(2 * LANES), np.arange(reach + 1)[:, None]
    rows = (np.sqrt(np.maximum(reach**2 - columns[::LANES] ** 2, 0)).astype(int) + 1).astype(np.int32)
    before = random.normal(size=(3, 4, reach + 1, 2, LANES)).astype(np.float32)
    moments = np.array([[1e-3, 2e-3, -5e-4], [-2e-4, -1e-3, 3e-4], [-0.01, 0.004, -0.004]], dtype=np.float32)
    after = before.copy()
    arrays = [warp_array(moments, wp.float32), warp_array(rows, wp.int32), warp_array(after, samples)]
    launch(blur_spectra, 3, arrays, threads=1)
    inside = np.arange(reach + 1)[:, None] < np.repeat(rows, LANES)
    for star, (xx, yy, xy) in enumerate(moments.astype(float)):
        for part, sign in enumerate((1.0, 1.0, -1.0, -1.0)):
            kernel = np.exp(-xx * columns**2 - yy * lines**2 - sign * 2.0 * xy * columns * lines)
            factor = np.where(inside, np.minimum(kernel, np.e), 1.0)
            expected = before[star, part].reshape(reach + 1, -1) * factor
            assert after[star, part].reshape(reach + 1, -1) == pytest.approx(expected, rel=3e-5)


def test_what_it_cannot_do_is_refused(lsst, air):
    short = pachon.Atmosphere.from_site("cerro_pachon", 4, exposure=3.0)
    later = air.at_times(air.times + 10.0)
    for exposure, words in ((short, "at least 5 s"), (later, "starts at 10 s")):
        for function in (pachon.make_psfs, pachon.psf_moments):
            with pytest.raises(DomainError, match=words):
                function(lsst, FIELDS[:1], WAVE, atmosphere=exposure, engine="statistical")
    with pytest.raises(ConfigError, match="expected an atmosphere"):
        pachon.make_psfs(lsst, FIELDS[:1], WAVE, engine="statistical")
    with pytest.raises(ConfigError, match="expected an atmosphere"):
        pachon.psf_moments(lsst, FIELDS[:1], WAVE, engine="statistical")
    with pytest.raises(ConfigError, match="expected one of long_exposure, statistical"):
        pachon.psf_moments(lsst, FIELDS[:1], WAVE, atmosphere=air, engine="fast")


def test_fields_too_wide_are_refused_in_pupils(air):
    """Two degrees, in pupils of 0.9 m at 15.46 km."""
    wide = schmidt(0.9, 2.5, field_radius=math.radians(1.0))
    with pytest.raises(DomainError, match="600 pupils wide; expected at most 303"):
        pachon.make_psfs(wide, [(0.0, 0.0)], WAVE, atmosphere=air, engine="statistical")


@pytest.mark.long
def test_stars_far_from_focus_are_refused(lsst, air):
    donut = lsst.perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))
    with pytest.raises(DomainError, match="far from focus"):
        pachon.make_psfs(donut, FIELDS[:1], WAVE, atmosphere=air, engine="statistical", stamps=Stamps(181))
    with pytest.raises(DomainError, match="far from focus"):
        pachon.psf_moments(donut, FIELDS[:1], WAVE, atmosphere=air)
