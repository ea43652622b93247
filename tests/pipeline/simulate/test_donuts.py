"""Simulated donuts: electrons, noise, defects and streams."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.pipeline.simulate.donut_file import DonutScene, SimulatedDonuts, simulate_donuts, write_donuts
from pachon.sensing.model import DonutModel
from pachon.sensing.stamp_headers import header_values

LSST = pachon.load_telescope("lsst_v3.3_r").perturbed("Detector", shift=(0.0, 0.0, 0.3e-3))
FIELDS = np.deg2rad([(0.2, 0.1), (-0.7, 0.9), (1.0, 1.2)])
OPTIONS = {"atmosphere": pachon.Atmosphere.from_site("cerro_pachon", seed=1), "stamps": pachon.Stamps(61)}


def draw(**options):
    return pachon.draw_donuts(LSST, options.pop("fields", FIELDS), [620e-9], **OPTIONS, **options)


def test_pixels_scatter_by_photon_sky_and_read_noise():
    light = np.array([1e5, 2e5, 4e5])
    donuts = draw(electrons=light, sky=300.0, read_noise=9.0, seed=4)
    assert donuts.sky_variance == 381.0
    expected = light[:, None, None] * donuts.psf.inside[:, None, None] * donuts.psf.image
    pulls = (donuts.images - expected) / np.sqrt(expected + donuts.sky_variance)
    # 3721 pixels a star: means scatter by 0.016, mean squares by 0.023.
    assert pulls.mean(axis=(1, 2)) == pytest.approx(0.0, abs=0.06)
    assert (pulls**2).mean(axis=(1, 2)) == pytest.approx(1.0, abs=0.09)
    assert np.abs(donuts.psf.offset).max() <= 0.5
    assert np.unique(donuts.psf.offset).size == 6


def test_the_same_seed_draws_the_same_stars_whatever_follows():
    few, more, other = draw(fields=FIELDS[:2], seed=4), draw(seed=4), draw(seed=5)
    assert few.images.tobytes() == more.images[:2].tobytes()
    assert not np.array_equal(other.images, more.images)


def test_second_stars_and_cosmic_rays_are_flagged_and_bright():
    clean = draw(electrons=1e6, seed=2, read_noise=0.0)
    blended = draw(electrons=1e6, seed=2, read_noise=0.0, defects=pachon.pipeline.StarDefects(second_stars=1.0))
    struck = draw(electrons=1e6, seed=2, read_noise=0.0, defects=pachon.pipeline.StarDefects(cosmic_rays=1.0))
    assert (blended.defects == pachon.measure.StarFlag.NEIGHBOUR).all()
    assert (struck.defects == pachon.measure.StarFlag.COSMIC_RAY).all()
    added = (blended.images - clean.images).sum(axis=(1, 2))
    assert (added > 0.03e6).all()  # of 0.1e6 and more, a part may fall beside the stamp
    assert ((struck.images - clean.images).max(axis=(1, 2)) >= 500.0).all()
    assert clean.images.sum(axis=(1, 2)) == pytest.approx(1e6 * clean.psf.inside, rel=0.005)


@pytest.mark.parametrize("name", ["second_stars", "cosmic_rays"])
def test_defects_are_fractions_of_the_stars(name):
    with pytest.raises(DomainError, match=f"{name} = 1.5: expected a fraction from 0 to 1"):
        pachon.pipeline.StarDefects(**{name: 1.5})
    with pytest.raises(
        ConfigError, match=rf"{name}: no argument of draw_donuts; expected defects=StarDefects\({name}="
    ):
        pachon.draw_donuts(LSST, FIELDS, **{name: 0.1})


def test_stamps_too_small_for_the_donuts_are_refused():
    with pytest.raises(DomainError, match=r"size = 21 .*: .* expected at least 3[0-9] pixels, or a telescope in focus"):
        pachon.draw_donuts(LSST, FIELDS, [620e-9], atmosphere=OPTIONS["atmosphere"], stamps=pachon.Stamps(21))


@pytest.mark.long
def test_one_model_draws_and_fits():
    """Nothing but noise is left where a fit takes images to be made of what they are: seeing, defocus, diffraction."""
    seeing = pachon.DonutAir(fwhm=0.8 / 206265.0)
    model = pachon.DonutModel(
        light=pachon.Light([600e-9, 640e-9], weights=[1.0, 3.0]),
        air=seeing,
        detector=pachon.DonutDetector(pixel_size=20e-6, diffusion=8e-6, defocus=-1.2e-3, saturation=1e5),
        diffraction=True,
    )
    telescope = pachon.load_telescope("lsst_v3.3_r")
    drawn = pachon.draw_donuts(
        telescope, FIELDS[:2], model=model, stamps=pachon.Stamps(81), electrons=5e6, sky=300.0, seed=3
    )
    fit = pachon.fit_donuts(
        telescope,
        drawn.images,
        FIELDS[:2],
        sky_variance=drawn.sky_variance,
        noll=range(4, 12),
        model=replace(model, air=pachon.DonutAir()),
    )
    # The nearer one to the axis fits both sides of focus.
    assert fit.reasons == ["ambiguous side", ""]
    # Of eight terms a star: 16 squares scatter by 35 %.
    chi2 = np.einsum("ni,nij,nj->", fit.zernikes, np.linalg.inv(fit.covariance), fit.zernikes) / fit.zernikes.size
    assert chi2 < 2.4
    assert fit.fwhm == pytest.approx(seeing.fwhm, rel=0.01)
    assert fit.flux == pytest.approx(5e6, rel=0.005)
    low = pachon.draw_donuts(
        telescope,
        FIELDS[:1],
        model=replace(model, detector=replace(model.detector, saturation=2000.0)),
        stamps=pachon.Stamps(81),
        electrons=5e6,
    )
    assert low.images.max() == 2000.0


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"detector": pachon.DonutDetector(defocus=[1e-3, -1e-3])}, "defocus has shape .*: expected one length"),
        ({"air": pachon.DonutAir(fwhm=[1e-6, 2e-6])}, "fwhm has shape .*: expected one angle"),
        ({"light": pachon.Light(622e-9)}, "wavelength and the light of the model are both given"),
    ],
)
def test_models_of_several_exposures_are_refused(changes, text):
    with pytest.raises((DomainError, ConfigError), match=text):
        pachon.draw_donuts(LSST, FIELDS[:2], 620e-9, model=pachon.DonutModel(**changes))


def test_a_file_of_donuts_has_the_telescope_of_any_name(tmp_path):
    """Names beyond ASCII ended in a traceback when all donuts were drawn."""
    path, name, bodies = tmp_path / "donuts.fits", "C:\\télescope/Ωμέγα_望遠鏡.yaml", "Caméra"
    numbers = np.zeros((2, 2)), np.full(2, 1.5e-3), np.zeros((2, 19))
    donuts = SimulatedDonuts(np.ones((2, 5, 5), dtype=np.float32), *numbers, 620e-9)
    model = DonutModel(detector=pachon.DonutDetector(defocus=1.5e-3, moved=bodies))
    write_donuts(path, donuts, DonutScene(), model, name)
    with fits.open(path) as hdus:
        assert header_values([hdus[0].header], path).telescope == name


@pytest.mark.parametrize(
    ("scene", "field", "text"),
    [
        ({"stars": 3}, None, "stars = 3: expected none with layout = corners"),
        ({"sides": 2}, None, "sides = 2: expected none with layout = corners"),
        ({}, np.zeros(2), "layout = corners: expected no field of all stars"),
    ],
)
def test_corners_have_stars_of_their_own(scene, field, text):
    """Other numbers and places were ignored."""
    with pytest.raises(ConfigError, match=f"^{text}"):
        simulate_donuts(LSST, LSST, DonutScene(layout="corners", **scene), DonutModel(), field)
