"""Piff's model beside ours at the same stars: residuals of stars whose PSF is known, and the command."""

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import pachon
from pachon.commands.cli import main
from pachon.core.errors import DomainError
from pachon.core.units import ARCSEC
from pachon.measure.rho_statistics import trace_of_moments
from pachon.measure.shapes import measure_shapes

DATA = Path(__file__).parents[2] / "data" / "piff"


@pytest.fixture(scope="module")
def psf():
    return pachon.load_piff(DATA / "gaussian.piff")


@pytest.fixture(scope="module")
def stars(psf):
    """Stars of another PSF than Piff's, smaller by a tenth: 14 where Piff's stars are, 11 elsewhere; their image."""
    rng = np.random.default_rng(5)
    own = np.stack([psf.stars["x"], psf.stars["y"]], axis=1)[psf.stars["used"]]
    places = np.concatenate([own, rng.uniform(2300.0, 4000.0, (11, 2))])
    chip = psf.chips[0]
    parameters = chip.interpolant.coefficients[:, 0] * np.array([0.0, 0.0, 0.9, 1.0, 1.0])
    image = chip.profile.draw(parameters, chip.world.at(places[:1])[1][0], 25)
    stamps = 1e6 * image + rng.normal(0.0, 1.0, (len(places), 25, 25))
    return stamps, places, image


@pytest.fixture(scope="module")
def found(psf, stars):
    return pachon.reconstruction.compare_with_piff(psf, *stars[:2], size=21, bins=4)


@pytest.mark.long
def test_residuals_are_those_of_the_two_psfs(psf, stars, found):
    assert list(found.models["model"]) == [
        "pachon, star held out",
        "Piff, stars of its fit",
        "pachon, other stars",
        "Piff, other stars",
    ]
    assert list(found.models["stars"]) == [25, 14, 11, 11]
    scale = psf.pixel_scale((100.0, 100.0))
    # |det J| of the affine WCS of the file.
    weight = found.stars.meta["weight_fwhm_arcsec"] * ARCSEC
    assert scale == pytest.approx(np.sqrt(0.26 * 0.25 + 0.01 * 0.02) * ARCSEC, rel=1e-9)
    star, theirs = (
        measure_shapes(image[None], scale, weight) for image in (stars[2][2:23, 2:23], psf.draw(1.0, 1.0, size=21))
    )
    growth = 1.0 - trace_of_moments(theirs.size, theirs.e1, theirs.e2) / trace_of_moments(star.size, star.e1, star.e2)
    for row in found.models:
        piff = row["model"].startswith("Piff")
        # Stars have S/N of 5e4; the centring of single stars is good to 1e-4 of a pixel.
        assert row["mean_dt"] == pytest.approx(growth[0] if piff else 0.0, abs=3e-4)
        assert row["mean_e1"] == pytest.approx((star.e1 - theirs.e1)[0] if piff else 0.0, abs=1e-4)
        assert row["rms_dt"] == pytest.approx(abs(growth[0]) if piff else 0.0, abs=1e-3)
    assert abs(growth[0]) > 0.1
    # A constant residual correlates with itself at all separations.
    for name, rho in found.rho.items():
        level = (star.e1 - theirs.e1)[0] ** 2 + (star.e2 - theirs.e2)[0] ** 2 if name.startswith("Piff") else 0.0
        pairs = rho.rho1.n_pairs > 0
        assert np.allclose(rho.rho1.xi_plus[pairs], level, rtol=0.05, atol=1e-7)


@pytest.mark.long
def test_the_table_of_stars_tells_which_piff_used(found, stars, psf):
    assert list(found.stars["in_piff_fit"]) == [True] * 14 + [False] * 11
    assert np.array_equal(found.stars["x"], stars[1][:, 0])
    scale = psf.pixel_scale((100.0, 100.0))
    weight = found.stars.meta["weight_fwhm_arcsec"] * ARCSEC
    theirs = measure_shapes(psf.draw(1.0, 1.0, size=21)[None], scale, weight)
    assert np.allclose(found.stars["piff_e1"], theirs.e1[0], rtol=0, atol=1e-12)
    assert np.allclose(found.stars["piff_size"], theirs.size[0] / ARCSEC, rtol=1e-12)


@pytest.mark.long
def test_the_command_writes_tables_and_prints_json(stars, found, tmp_path, capsys, monkeypatch):
    # Pictures of rho statistics have a test of their own, and take seconds.
    monkeypatch.setattr("pachon.reconstruction.piff.comparison.rho_plot", lambda rho: b"a picture")
    path = tmp_path / "stars.fits"
    Table({"x": stars[1][:, 0], "y": stars[1][:, 1], "stamp": stars[0]}).write(path)
    arguments = ["diagnose", str(path), "--piff", str(DATA / "gaussian.piff"), "--json", "--quiet"]
    assert main(arguments) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["models"]["Piff, other stars"]["rms_dt"] == pytest.approx(found.models["rms_dt"][3], rel=0.05)
    names = {"stars.ecsv", "models.ecsv", "rho.ecsv", "rho.png", "comparison.json"}
    assert {p.name for p in (tmp_path / "stars_piff").iterdir()} == names
    assert len(Table.read(tmp_path / "stars_piff" / "models.ecsv")) == 4
    assert main([*arguments[:3], str(tmp_path / "none.piff")]) == 2
    assert capsys.readouterr().err.strip().endswith("none.piff: no such file")


def test_stars_that_sextractor_flags_are_left_out_as_of_a_model(stars, tmp_path, monkeypatch):
    monkeypatch.setattr("pachon.reconstruction.piff.comparison.rho_plot", lambda rho: b"a picture")
    path, (x, y) = tmp_path / "stars.fits", stars[1].T
    Table({"x": x, "y": y, "stamp": stars[0], "FLAGS": np.arange(len(x)) % 3}).write(path)
    assert main(["diagnose", str(path), "--piff", str(DATA / "gaussian.piff"), "--quiet"]) == 0
    # 1, with neighbours, is none of the bits; 2 is blended.
    assert set(Table.read(tmp_path / "stars_piff" / "stars.ecsv")["x"]) <= set(x[np.arange(len(x)) % 3 < 2])


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--x", "X"], "--x: expected --piff with it"),
        (["--min-snr", "50"], "--min-snr: expected --piff with it"),
        (["--strict", "--piff", str(DATA / "gaussian.piff")], "--strict with --piff: expected none"),
    ],
)
def test_options_of_the_other_comparison_are_refused(options, text, capsys):
    """They were ignored."""
    assert main(["diagnose", "none", *options]) == 2
    assert text in capsys.readouterr().err


@pytest.mark.long
def test_stars_have_their_colours_in_every_model(psf, stars):
    """Colours of all stars came to the model of those of Piff's fit alone, which refused them."""
    stamps, places, image = stars
    colour = np.random.default_rng(3).uniform(0.0, 1.0, len(places))
    y, x = np.mgrid[:25, :25] - 12
    # Wider by 2 % of its variance in a unit of the colour.
    change = image * (x**2 + y**2 - (image * (x**2 + y**2)).sum() / image.sum())
    stamps = stamps + 1e6 * 0.02 * (colour - colour.mean())[:, None, None] * change
    found = pachon.reconstruction.compare_with_piff(psf, stamps, places, size=21, bins=4, colour=colour)
    plain = pachon.reconstruction.compare_with_piff(psf, stamps, places, size=21, bins=4)
    assert list(found.models["model"]) == list(plain.models["model"])
    ours = list(found.models["model"]).index("pachon, other stars")
    assert found.models["rms_dt"][ours] < 0.3 * plain.models["rms_dt"][ours]


def test_a_missing_chip_is_named(stars):
    with pytest.raises(DomainError, match="chip = None: expected one of 1, 2"):
        pachon.reconstruction.compare_with_piff(pachon.load_piff(DATA / "grid_chips.piff"), *stars[:2])


def test_wings_that_go_with_the_sky_of_stars_go_from_images_of_piff_too():
    psf = pachon.load_piff(DATA / "moffat.piff")
    places = np.stack([psf.stars["x"], psf.stars["y"]], axis=1)
    stamps = 1e5 * psf.at(places, size=15) + np.random.default_rng(1).normal(0.0, 1.0, (len(places), 15, 15))
    for background in (True, False):
        found = pachon.reconstruction.compare_with_piff(psf, stamps, places, background=background, bins=2)
        # Kept in Piff's images alone, the wings made T of stars 1 % smaller.
        assert abs(found.summary()["Piff, stars of its fit"]["mean_dt"]) < 2e-4
