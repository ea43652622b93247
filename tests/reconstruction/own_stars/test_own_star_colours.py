"""Colours of the stars of a catalogue: their column, the model that knows them, and the command."""

import json

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from pachon import PsfModel, fit_own_stars, load_stars
from pachon.commands.cli import main
from pachon.core.errors import DomainError, ProductError
from pachon.models import color_temperature
from pachon.models.star_spectrum import psf_colours

PIXEL = np.deg2rad(0.2 / 3600.0)
SIZE, COUNT = 25, 40


def profiles(colour, dx, dy):
    """Moffat profiles of unit sum whose ellipticity and size change with the colour, at places within a pixel."""
    y, x = np.indices((SIZE, SIZE)) - SIZE // 2
    change, dx, dy = (np.asarray(v)[:, None, None] for v in (0.03 * (colour - 1.0), dx, dy))
    square = (x - dx) ** 2 * (1 - 2 * change) + (y - dy) ** 2 * (1 + 2 * change)
    images = (1.0 + square / (2.8 * (1.0 - 0.5 * change)) ** 2) ** -3
    return images / images.sum(axis=(1, 2), keepdims=True)


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory):
    """Table of stars in electrons, two of them without a colour."""
    rng = np.random.default_rng(2)
    colour, places = rng.uniform(0.0, 2.2, COUNT), rng.uniform(0.0, 4000.0, (COUNT, 2))
    light = (3e4 * 10.0 ** rng.uniform(0.0, 1.0, COUNT))[:, None, None] * profiles(
        colour, *rng.uniform(-0.5, 0.5, (2, COUNT))
    )
    stamps = light + rng.normal(size=light.shape) * np.sqrt(22.0**2 + light)
    colour[[4, 11]] = np.nan
    path = tmp_path_factory.mktemp("stars") / "stars.fits"
    columns = {"x": places[:, 0], "y": places[:, 1], "stamp": stamps, "G_I": colour}
    Table(columns | {"teff": color_temperature(colour, "g_i"), "name": ["a"] * COUNT}).write(path)
    return path


def test_a_column_of_colours_is_read_beside_the_stars(catalogue):
    stars = load_stars(catalogue, colour="g_i")
    stamps, places = stars
    table = fits.getdata(catalogue)
    np.testing.assert_array_equal(stars.colour, table["G_I"])
    np.testing.assert_array_equal(stamps, table["stamp"])
    np.testing.assert_array_equal(places[:, 0], table["x"])
    assert load_stars(catalogue).colour is None
    with pytest.raises(ProductError, match=r"no column 'r_i'; its columns are x, y, stamp, G_I, teff, name"):
        load_stars(catalogue, colour="r_i")
    with pytest.raises(ProductError, match=r"column 'name' has shape .*, expected one number in every row"):
        load_stars(catalogue, colour="name")
    # Temperatures become the g - i of blackbodies, as good as the table behind them.
    np.testing.assert_allclose(psf_colours(table["teff"], "Teff"), table["G_I"], atol=2e-4)
    np.testing.assert_array_equal(psf_colours(table["G_I"], "g_i"), table["G_I"])
    strange = psf_colours(np.array([0.3, -99.0, np.inf, -9999.0, -0.4]), "r_i")
    np.testing.assert_array_equal(strange, [0.3, np.nan, np.nan, np.nan, -0.4])


@pytest.mark.parametrize(
    "options", [{"recipe": "paper", "basis": "pixels", "order": 0}, pytest.param({}, marks=pytest.mark.slow)]
)
def test_held_out_stars_are_predicted_for_their_colours(catalogue, options):
    stars = load_stars(catalogue, colour="g_i")
    plain = fit_own_stars(*stars, PIXEL, **options)
    own = fit_own_stars(*stars, PIXEL, colour=stars.colour, **options)
    metrics, without = own.summary(), plain.summary()
    assert metrics["colour_probability"] > 0.99
    assert metrics["without_colour"] == 2
    assert "colour_probability" not in without
    # Stars of bright ones: what the colour does, 0.02 in e, is three times their noise.
    assert metrics["rms_e_held_out"] < 0.5 * without["rms_e_held_out"]
    assert metrics["rms_size_held_out"] < 0.8 * without["rms_size_held_out"]
    with pytest.raises(DomainError, match=r"colour has shape \(3,\): expected one number, or one for each of 40"):
        fit_own_stars(*stars, PIXEL, colour=[1.0, 2.0, 3.0])


@pytest.mark.slow
def test_the_command_takes_a_column_of_colours(catalogue, tmp_path, capsys):
    out = tmp_path / "psf.fits"
    arguments = ["model", str(catalogue), "-o", str(out), "--recipe", "paper", "--basis", "pixels", "--order", "0"]
    assert main([*arguments, "--colour-column", "g_i"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "dependence on colour" in printed
    assert "g_i: probability 1, 2 without count as the mean" in printed
    model = PsfModel.read(out)
    assert model.colour.stars.n_unknown == 2
    red, blue = (model.draw(2000.0, 2000.0, colour=colour) for colour in (2.0, 0.0))
    assert np.abs(red - blue).max() > 0.01 * red.max()
    assert main([*arguments, "--colour-column", "teff", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["colour_probability"] > 0.99
    assert PsfModel.read(out).colour.mean == pytest.approx(model.colour.mean, abs=2e-4)


def test_a_column_that_is_missing_is_named_in_one_line(catalogue, capsys):
    assert main(["model", str(catalogue), "--colour-column", "r_i"]) == 2
    problem = " ".join(capsys.readouterr().err.split())
    assert "stars.fits: no column 'r_i'; its columns are" in problem
    assert "Traceback" not in problem
