"""Colours of objects of an image: matched by place, in the PSF of each galaxy, and by the command."""

import json

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import pachon
from pachon.commands.cli import main
from pachon.core.errors import DomainError, ProductError
from pachon.imaging.object_colours import read_object_colours

SIDE, SKY, GAIN = 400, 400.0, 2.5
#: Variance of the PSF along each axis [pixel^2], and what it gains along x in a magnitude of colour.
PSF, RISE = 2.6, 0.25


def gaussian(x, y, variance_x, variance_y):
    """Gaussian of unit sum at a place of the image: the product of those of its columns and rows."""
    at = np.arange(SIDE)
    along_x, along_y = (np.exp(-0.5 * (at - c) ** 2 / v) for c, v in ((x, variance_x), (y, variance_y)))
    return along_y[:, None] * along_x / (2.0 * np.pi * np.sqrt(variance_x * variance_y))


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """Image of round galaxies of one colour and stars of many, whose PSF is longer along x the redder they are."""
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(*[np.arange(25.0, SIDE, 32.0)] * 2), axis=-1).reshape(-1, 2)
    places = grid[rng.permutation(len(grid))] + rng.uniform(-3.0, 3.0, grid.shape)
    star = np.arange(len(places)) < 60
    colour = np.where(star, rng.uniform(0.0, 2.0, len(places)), 2.5)
    light = np.zeros((SIDE, SIDE))
    for (x, y), is_star, c, f in zip(places, star, colour, 2e4 * rng.uniform(1.0, 3.0, len(places)), strict=True):
        size = 0.0 if is_star else 4.0
        light += f * gaussian(x, y, PSF + RISE * (c - 1.0) + size, PSF + size)
    folder = tmp_path_factory.mktemp("colours")
    header = fits.Header({"GAIN": GAIN, "MAGZERO": 30.0, "FILTER": "r", "EXPTIME": 90.0})
    for axis, kind in (("1", "RA---TAN"), ("2", "DEC--TAN")):
        header[f"CTYPE{axis}"], header[f"CUNIT{axis}"], header[f"CRPIX{axis}"] = kind, "deg", 200.0
    header.update({"CRVAL1": 150.0, "CRVAL2": 2.0, "CD1_1": -0.2 / 3600, "CD2_2": 0.2 / 3600})
    electrons = rng.poisson((light + SKY) * GAIN)
    fits.PrimaryHDU((electrons / GAIN).astype(np.float32), header).writeto(folder / "image.fits")
    image = pachon.load_image(folder / "image.fits")
    sky = image.celestial(places)
    known = np.ma.masked_array(colour, np.arange(len(colour)) == 5)
    Table({"RA": sky[:, 0], "DEC": sky[:, 1], "G_I": known, "name": ["a"] * len(colour)}).write(folder / "c.fits")
    Table({"x": places[star, 0], "y": places[star, 1], "G_I": colour[star]}).write(folder / "s.fits")
    return image, folder, places, star, known


def test_objects_have_the_colour_of_the_nearest_entry(field):
    image, folder, places, _, known = field
    colours = read_object_colours(folder / "c.fits", "g_i", image)
    found = colours.at(places + 2.0)
    np.testing.assert_array_equal(found, np.ma.filled(known, np.nan))
    assert np.isnan(colours.at(places + 2.5)).all()
    assert colours.at(np.empty((0, 2))).shape == (0,)
    assert colours.mean == pytest.approx(known.mean(), abs=1e-14)
    with pytest.raises(ProductError, match=r"c\.fits: no column 'r_i'; its columns are RA, DEC, G_I, name"):
        read_object_colours(folder / "c.fits", "r_i", image)
    with pytest.raises(ProductError, match=r"column 'name' has type .*: expected a number in every row"):
        read_object_colours(folder / "c.fits", "name", image)
    with pytest.raises(DomainError, match=r"positions have shape \(3, 2\), values \(2,\): expected \[k, 2\] and \[k\]"):
        pachon.imaging.ObjectColours(np.zeros((3, 2)), np.zeros(2))


@pytest.mark.long
def test_round_galaxies_are_round_under_the_psf_of_their_colour(field):
    image, folder, places, star, _ = field
    colours = read_object_colours(folder / "c.fits", "g_i", image)
    means = {}
    for name, known in (("colours", colours), ("none", None)):
        catalogue = pachon.measure_image(image, stars=places[star], colours=known, threads=1)
        good = catalogue.usable
        weight = catalogue.fits.ellipticity_error[good] ** -2.0
        means[name] = np.average(catalogue.fits.e1[good], weights=weight), weight.sum() ** -0.5
        if known is not None:
            assert catalogue.metrics()["colour_probability"] > 0.99
            assert catalogue.warnings == (
                f"1 of {len(catalogue.stars)} stars and 0 of {len(catalogue.galaxies)} galaxies have no colour and "
                "count as the mean",
            )
    mean, standard_error = means["colours"]
    assert abs(mean) < 3.5 * standard_error
    # Under the PSF of the mean star what the colour adds along x, 1.5 RISE over 4 T/2, stays in the galaxies.
    assert means["none"][0] == pytest.approx(1.5 * RISE / (4.0 * 4.0), abs=4.0 * standard_error)
    model = catalogue.psf
    again = pachon.measure_image(image, stars=places[star], psf=model, colours=colours, threads=1)
    assert again.warnings == ("colours change nothing: the PSF model has no dependence on them",)


@pytest.mark.slow
def test_the_command_takes_colours_from_a_table(field, tmp_path, capsys):
    _, folder, _, _, _ = field
    arguments = ["measure", str(folder / "image.fits"), "-o", str(tmp_path), "--recipe", "paper", "--basis", "pixels"]
    arguments += ["--order", "0", "--quiet"]
    table, stars = str(folder / "c.fits"), str(folder / "s.fits")
    usable = []
    for options in (["--colours", table, "--stars", stars, "--pictures"], ["--stars", stars]):
        assert main([*arguments, *options, "--colour-column", "g_i", "--json"]) == 0
        metrics = json.loads(capsys.readouterr().out)["images"]["image.fits"]
        assert metrics["colour_probability"] > 0.99
        usable.append(Table.read(tmp_path / "image_galaxies.fits"))
    assert (tmp_path / "image_measured.png").exists()
    # Without colours of galaxies these have the PSF of the mean star.
    assert "84 of 84 galaxies have no colour" in metrics["warnings"][0]
    e1 = [table["e1"][table["usable"]].mean() for table in usable]
    assert e1[1] > e1[0] + 0.01
    model = pachon.PsfModel.read(tmp_path / "image_psf.fits")
    red, blue = (model.draw(200.0, 200.0, colour=colour) for colour in (2.0, 0.0))
    assert np.abs(red - blue).max() > 0.02 * red.max()
    for options, match in (
        (["--colours", table], "--colours: expected --colour-column, the name of its column"),
        (["--colour-column", "g_i"], "--colour-column: expected --colours or --stars, the table that has it"),
        (["--colours", table, "--colour-column", "u_g"], "no column 'u_g'; its columns are RA, DEC, G_I, name"),
    ):
        assert main([*arguments, *options]) == 2
        problem = capsys.readouterr().err
        assert match in " ".join(problem.split())
        assert "Traceback" not in problem
