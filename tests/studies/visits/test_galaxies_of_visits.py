"""Galaxies of a catalogue and of a mosaic in visits: where and how they are, depth, bad input."""

import pickle

import numpy as np
import pytest
import yaml
from astropy.io import fits
from astropy.table import Table

from pachon.commands.cli import main
from pachon.core.long_work import Execution
from pachon.core.units import ARCMIN
from pachon.pipeline.config import digest
from pachon.pipeline.run_folder import CONFIG_NAME
from pachon.studies.visits.config import load_visits_configuration
from pachon.studies.visits.image_stack.config import ImageStackConfig
from pachon.studies.visits.image_stack.image_stack import ImageStack
from pachon.studies.visits.null_test import ellipticity_along, null_test
from pachon.studies.visits.psf_visit import StackFrame
from pachon.studies.visits.visits import stack_visits

POINTING = {"ra_deg": 150.0, "dec_deg": 2.0}


@pytest.fixture(scope="module")
def folder(visits_config, tmp_path_factory, undrawn):
    """Folder of one visit, about a place on the sky."""
    place = tmp_path_factory.mktemp("visits")
    config = visits_config(count=1, places=12)
    run = config.run.model_validate(config.run.model_dump(by_alias=True) | {"pointing": POINTING})
    with undrawn():
        stack_visits(config.model_copy(update={"run": run}), place, execution=Execution(threads=1))
    return place


def with_galaxies(folder, **galaxies):
    """Write other galaxies into the configuration of a folder."""
    content = yaml.safe_load((folder / CONFIG_NAME).read_text()) | {"galaxies": galaxies}
    (folder / CONFIG_NAME).write_text(yaml.safe_dump(content))


def write_catalogue(path, xi, eta, **columns):
    """Write galaxies at gnomonic offsets [rad] from the pointing, by celestial coordinates."""
    # Inverse of the gnomonic projection (Calabretta & Greisen 2002, sec. 5.1.3), by vectors.
    ra, dec = np.deg2rad([POINTING["ra_deg"], POINTING["dec_deg"]])
    axis = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east, north = np.array([-np.sin(ra), np.cos(ra), 0.0]), np.cross(axis, [-np.sin(ra), np.cos(ra), 0.0])
    x, y, z = (axis + np.outer(xi, east) + np.outer(eta, north)).T
    table = Table({"ra": np.rad2deg(np.arctan2(y, x)) % 360.0, "dec": np.rad2deg(np.arctan2(z, np.hypot(x, y)))})
    for name, values in columns.items():
        table[name] = values
    table.write(path, format="ascii.ecsv", overwrite=True)


def write_mosaic(path, e=0.0, count=20, **cards):
    """Write 400 x 400 pixels of 0.05 arcsec with equal elliptical Gaussians on a grid."""
    rng = np.random.default_rng(4)
    y, x = np.indices((400, 400))
    image = rng.normal(0.0, 0.01, (400, 400))
    a, b = 8.0 * np.sqrt((1 + e) / (1 - e)), 8.0 * np.sqrt((1 - e) / (1 + e))
    for k in range(count):
        cx, cy = 50.0 + 75.0 * (k % 5) + rng.uniform(-1, 1), 50.0 + 100.0 * (k // 5) + rng.uniform(-1, 1)
        image += 3.0 * np.exp(-0.5 * (((x - cx) / a) ** 2 + ((y - cy) / b) ** 2))
    header = {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CRVAL1": 0.0,
        "CRVAL2": 0.0,
        "CRPIX1": 200.0,
        "CRPIX2": 200.0,
    }
    header |= {"CD1_1": -0.05 / 3600, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.05 / 3600, "MAGZPT": 28.0} | cards
    header = {key: value for key, value in header.items() if value is not None}
    fits.PrimaryHDU(image.astype(np.float32), fits.Header(header)).writeto(path, overwrite=True)


@pytest.mark.slow
def test_galaxies_of_a_catalogue_are_measured_where_and_as_it_says(folder, backwards):
    rng = np.random.default_rng(6)
    n = 40
    xi, eta = rng.uniform(-5.0, 5.0, (2, n)) * ARCMIN
    e1, e2 = rng.uniform(-0.25, 0.25, (2, n))
    magnitude = np.full(n, 18.0)
    # Neither what is off the tile nor what is too faint for one visit is drawn.
    xi[0], magnitude[1] = 20.0 * ARCMIN, 30.0
    columns = {"mag": magnitude, "half_light_radius": 0.8, "e1": e1, "e2": e2, "n": 0.5}
    write_catalogue(folder / "own.ecsv", xi, eta, **columns)
    with_galaxies(folder, catalogue="own.ecsv", convention="tangent_plane")
    found = null_test(folder, tiles=1, rings=12, execution=Execution(threads=1))[1]
    galaxies = found.galaxies
    assert len(galaxies) == n - 2
    frame = StackFrame.of(load_visits_configuration(folder / CONFIG_NAME).experiment(), 31)
    scale = 1.0 / np.sqrt(abs(np.linalg.det(frame.matrix)))
    at = np.stack([xi, eta], axis=1)[2:] @ frame.matrix.T * scale
    np.testing.assert_allclose(np.stack([galaxies.x, galaxies.y], axis=1), at, atol=1e-9)
    # Gaussians are fitted without bias; with errors of 0.003 in e, of the light of one visit.
    e = ellipticity_along(frame.matrix, e1 + 1j * e2)[2:]
    np.testing.assert_allclose(galaxies.true_e1 + 1j * galaxies.true_e2, e, atol=0.015)
    # Equal noise under a shear and its opposite leaves errors of 0.001.
    assert abs(found.biases.gaussian["true"].m).max() < 0.005
    # Other galaxies leave the stacks of PSFs as they are; the same ones keep finished tiles.
    tile = next((folder / "galaxies").iterdir())
    before = tile.stat().st_mtime_ns
    null_test(folder, tiles=1, rings=12, execution=Execution(resume=True, threads=1))
    assert tile.stat().st_mtime_ns == before
    write_catalogue(
        folder / "own.ecsv", xi[:30], eta[:30], **{k: np.broadcast_to(v, n)[:30] for k, v in columns.items()}
    )
    assert (
        len(null_test(folder, tiles=1, rings=12, execution=Execution(resume=True, workers=backwards))[1].galaxies) == 28
    )


@pytest.mark.slow
def test_galaxies_of_a_mosaic_are_planted_and_measured(folder):
    write_mosaic(folder / "own.fits", e=0.3)
    with_galaxies(folder, mosaic="own.fits", mosaic_psf_arcsec=0.05, density=0.01)
    galaxies = null_test(folder, tiles=1, rings=12, execution=Execution(threads=1))[1].galaxies
    # 20 in 400 arcsec^2, 0.01 of that on a CCD: 335, and five standard deviations of a Poisson number.
    expected = 0.01 * 20 / (20.0 / 60.0) ** 2 * (4096 * 0.2 / 60.0) ** 2
    assert abs(len(galaxies) - expected) < 5.0 * np.sqrt(expected)
    # As workers are sent them.
    source = ImageStack.of(folder, ImageStackConfig(faintest=25.0)).sky
    sent, area = pickle.loads(pickle.dumps(source)), [(-ARCMIN, ARCMIN)] * 2
    np.testing.assert_array_equal(sent.galaxies(*area).xi, source.galaxies(*area).xi)
    assert len(sent.galaxies(*area).xi) > 0
    e = (galaxies.true_e1 + 1j * galaxies.true_e2)[galaxies.true_usable]
    # Random angles, of one ellipticity.
    assert np.median(np.abs(e)) == pytest.approx(0.3, abs=0.02)
    assert abs(e.mean()) < 5.0 * 0.3 / np.sqrt(2 * len(e))


def test_stamps_of_the_usual_galaxies_are_those_of_before(folder, tmp_path):
    config = load_visits_configuration(folder / CONFIG_NAME)
    experiment = config.experiment()
    usual = config.model_copy(update={"galaxies": type(config.galaxies)()})
    assert usual.digest(experiment) == config.digest(experiment)
    assert usual.galaxies_digest(experiment, stack=1) == digest({"visits": config.digest(experiment), "stack": 1})
    digests = []
    for name, text in (("a", "1"), ("b", "1"), ("b", "2")):
        path = tmp_path / f"{name}.ecsv"
        path.write_text(text)
        own = config.galaxies.model_copy(update={"catalogue": str(path), "mosaic": None})
        digests.append(config.model_copy(update={"galaxies": own}).galaxies_digest(experiment))
    # The content of a file counts, not its path.
    assert digests[0] == digests[1] != digests[2]


@pytest.mark.parametrize(
    ("galaxies", "text"),
    [
        ({"catalogue": "none.ecsv"}, "galaxies.catalogue = none.ecsv: no such file"),
        ({"mosaic": "none.fits"}, "galaxies.mosaic = none.fits: no such file"),
        ({"catalogue": "far.ecsv", "mosaic": "flat.fits"}, "expected one of them"),
        ({"catalogue": "bare.ecsv"}, "no column 'half_light_radius'"),
        ({"catalogue": "far.ecsv"}, "0 of 0 galaxies to magnitude"),
        ({"catalogue": "tiny.ecsv"}, "0 of 30 galaxies to magnitude"),
        ({"mosaic": "flat.fits"}, "flat.fits"),
        ({"mosaic": "nowhere.fits"}, "nowhere.fits"),
        ({"density": -1.0}, "galaxies.density = -1"),
        ({"density": 1e6}, "bury the sky"),
        ({"brightest": 29.0}, "brightest = 29.0"),
        ({"faintest": 27.0}, "unknown key galaxies.faintest"),
    ],
)
def test_bad_galaxies_are_one_line(folder, capsys, galaxies, text):
    rng = np.random.default_rng(6)
    near, far = rng.uniform(-5.0, 5.0, (2, 30)) * ARCMIN, np.full((2, 1), 0.1)
    write_catalogue(folder / "far.ecsv", *far, mag=20.0, half_light_radius=0.5)
    write_catalogue(folder / "tiny.ecsv", *near, mag=20.0, half_light_radius=0.01)
    write_catalogue(folder / "bare.ecsv", *near, mag=20.0)
    write_mosaic(folder / "flat.fits", count=0)
    write_mosaic(folder / "nowhere.fits", CTYPE1=None, CTYPE2=None)
    with_galaxies(folder, **galaxies)
    assert main(["null-test", str(folder), "--tiles", "1", "--rings", "10", "--quiet"]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert len(error.splitlines()) == 1


def test_celestial_coordinates_need_a_pointing(visits_config, tmp_path, capsys):
    config = visits_config()
    (tmp_path / CONFIG_NAME).write_text(config.resolved(config.experiment()).to_yaml())
    write_catalogue(tmp_path / "own.ecsv", [0.0], [0.0], mag=20.0, half_light_radius=0.5)
    with_galaxies(tmp_path, catalogue="own.ecsv")
    for command in ("null-test", "stack-images"):
        assert main([command, str(tmp_path), "--quiet"]) == 2
        error = capsys.readouterr().err
        assert "expected run.pointing" in error
        assert len(error.splitlines()) == 1
