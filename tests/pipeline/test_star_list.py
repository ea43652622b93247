"""Own star catalogues in runs: places by the tracer, magnitudes by hand, rows in any order."""

from functools import partial

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table

import pachon
from pachon.core.errors import PachonError
from pachon.core.long_work import Execution
from pachon.core.table_files import write_table
from pachon.pipeline.config import Configuration, load_configuration, to_yaml, with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.report.diagnostics import diagnose
from pachon.pipeline.run import run
from pachon.pipeline.run_folder import write_ccds
from pachon.pipeline.simulate.ccd_exposure import ccd_stars, expose_ccd, expose_positions
from pachon.pipeline.simulate.ccd_loop import simulate_ccds
from pachon.pipeline.star_list import RIM, place_stars
from pachon.studies.psf_choice.plan import make_plan
from pachon.studies.psf_choice.study import study_experiment
from pachon.wavefront.psf.fast import FastEngine
from pachon.wavefront.psf.psf import make_psfs
from pachon.wavefront.psf.stamps import Stamps

CAMERA = pachon.lsst_camera()
LIGHT = 620e-9
AIM = pachon.Pointing(np.deg2rad(53.1), np.deg2rad(-27.8), np.deg2rad(30.0))
POINTING = {"ra_deg": 53.1, "dec_deg": -27.8, "position_angle_deg": 30.0}
CCDS = ("R22_S11", "R24_S12", "R41_S20")


@pytest.fixture(scope="module")
def telescope(lsst_r):
    return lsst_r.with_rotator(0.2)


@pytest.fixture(scope="module")
def places():
    """Stars on three CCDs, [n, 2] [m], each CCD's own in turn."""
    rng = np.random.default_rng(3)
    centers = np.array([CAMERA.centers[CAMERA.ccd_index(name)] for name in CCDS])
    return (centers + rng.uniform(-0.0195, 0.0195, (30, 3, 2))).reshape(-1, 2)


@pytest.fixture(scope="module")
def magnitudes():
    return np.random.default_rng(4).uniform(18.0, 21.0, 90)


@pytest.fixture(scope="module")
def sky(telescope, places):
    """Right ascensions and declinations [deg] of the places, through traced chief rays."""
    slopes = pachon.fields_at(telescope, places, LIGHT, projection="gnomonic")
    return np.rad2deg(AIM.to_celestial(AIM.to_sky(slopes)))


def placed(path, telescope, **options):
    settings = {"brightest": 17.0, "faintest": 22.0, "pointing": AIM, "columns": {}, "band": "r"} | options
    ccds = settings.pop("ccds", CCDS)
    return place_stars(path, telescope, CAMERA, ccds, wavelength=LIGHT, **settings)


def expect(found, places, magnitudes):
    """Every star is on its CCD, at its place, with its magnitude; in the order of x."""
    for i, name in enumerate(CCDS):
        at, magnitude = found.on(name)
        order = np.argsort(places[i::3, 0])
        # The search for a chief ray ends within 1e-12 m; degrees in a table are good to 1e-14 of 10 m times a radian.
        assert np.allclose(at, places[i::3][order], rtol=0, atol=1e-11)
        assert np.array_equal(magnitude, magnitudes[i::3][order])
    assert found.counts["on_the_ccds"] == len(places)


@pytest.mark.parametrize("ending", ["ecsv", "csv", "fits", "parquet"])
def test_celestial_coordinates_land_where_the_tracer_has_them(tmp_path, telescope, places, magnitudes, sky, ending):
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    path = tmp_path / f"stars.{ending}"
    write_table(path, Table({"RA": sky[:, 0], "Dec": sky[:, 1], "mag": magnitudes}))
    expect(placed(path, telescope), places, magnitudes)


def test_field_angles_and_positions_are_places_too(tmp_path, telescope, places, magnitudes):
    fields = pachon.fields_at(telescope, places, LIGHT)
    path = tmp_path / "fields.ecsv"
    Table({"field_x_deg": np.rad2deg(fields[:, 0]), "field_y": fields[:, 1] * u.rad, "r": magnitudes}).write(path)
    expect(placed(path, telescope, pointing=None), places, magnitudes)
    path = tmp_path / "positions.ecsv"
    Table({"x_m": places[:, 0] * 1e3 * u.mm, "y_m": places[:, 1], "magnitude": magnitudes}).write(path)
    expect(placed(path, telescope, pointing=None), places, magnitudes)


def test_columns_of_other_names_are_mapped(tmp_path, telescope, places, magnitudes, sky):
    path = tmp_path / "other.fits"
    table = Table({"alpha": np.deg2rad(sky[:, 0]) * u.rad, "dec": sky[:, 1], "r": magnitudes, "g_psf": magnitudes + 1})
    table.write(path)
    found = placed(path, telescope, columns={"ra": "ALPHA", "mag": "g_psf"})
    expect(found, places, magnitudes + 1)
    # SIMBAD has Johnson's R beside Sloan's r.
    path = tmp_path / "capitals.ecsv"
    Table({"ra": sky[:, 0], "dec": sky[:, 1], "R": magnitudes, "r": magnitudes + 1}).write(path)
    expect(placed(path, telescope, columns={"mag": "R"}), places, magnitudes)
    expect(placed(path, telescope), places, magnitudes + 1)


def test_stars_that_are_left_out_are_counted(tmp_path, telescope):
    # 4004 pixels of 10 um along x.
    center, half = CAMERA.centers[CAMERA.ccd_index("R22_S11")], 20.02e-3
    rim = half - (RIM - 0.5) * CAMERA.pixel_size
    inside = half - (RIM + 0.5) * CAMERA.pixel_size
    offsets = np.array([[0, 0], [0, 0], [0, 0], [np.nan, 0], [rim, 0], [inside, 0], [0.0211, 0], [0, 0]])
    places = center + offsets
    magnitudes = np.ma.masked_invalid([18.0, 16.9, 22.1, 18.0, 18.0, 19.0, 18.0, np.nan])
    Table({"x_m": places[:, 0], "y_m": places[:, 1], "mag": magnitudes, "colour": magnitudes}).write(
        tmp_path / "a.ecsv"
    )
    found = placed(tmp_path / "a.ecsv", telescope)
    assert found.counts == {
        "stars": 8,
        "without_place_or_magnitude": 2,
        "too_bright": 1,
        "too_faint": 1,
        "off_the_ccds": 1,
        "at_the_rim_of_a_ccd": 1,
        "on_other_ccds": 0,
        "on_the_ccds": 2,
    }
    assert placed(tmp_path / "a.ecsv", telescope, ccds=CCDS[1:]).counts["on_other_ccds"] == 2
    note = "column colour is not used: name its bands (teff, bp_rp, g_r, g_i, r_i)"
    assert found.text.endswith(f"1 off the ccds, 1 at the rim of a ccd, 2 on the ccds; {note}")
    # The other side of the sky, and 3 degrees from the axis, where the design ends at 2.5.
    Table({"ra": [233.1, 53.1], "dec": [27.8, -24.8], "mag": [18.0, 18.0]}).write(tmp_path / "b.ecsv")
    assert placed(tmp_path / "b.ecsv", telescope).counts["outside_the_field"] == 2


def test_colours_are_temperatures(tmp_path, telescope, places):
    colors = np.ma.masked_invalid(np.linspace(-0.3, 1.5, len(places)))
    colors[4] = np.ma.masked
    colors[7], colors[8] = -99.0, -999.0  # as catalogues have missing ones, which counted as the hottest stars
    table = Table({"x_m": places[:, 0], "y_m": places[:, 1], "mag": np.full(len(places), 19.0), "G_R": colors})
    table.write(tmp_path / "a.ecsv")
    found = placed(tmp_path / "a.ecsv", telescope)
    assert found.counts["without_colour"] == 3
    assert found.text.endswith("90 on the ccds, 3 without colour; spectra from column g_r")
    colors[7:9] = np.ma.masked
    for i, name in enumerate(CCDS):
        order = np.argsort(places[i::3, 0])
        expected = pachon.models.color_temperature(np.ma.filled(colors[i::3], np.nan)[order], "g_r")
        np.testing.assert_array_equal(found.temperatures(name), expected)
    # A temperature counts before a colour; a column may be mapped, and must be there then.
    table["teff"] = np.linspace(3000.0, 9000.0, len(places))
    table["mine"] = table["G_R"] + 0.2
    table.write(tmp_path / "b.ecsv")
    assert placed(tmp_path / "b.ecsv", telescope).spectrum == "teff"
    del table["teff"]
    table.write(tmp_path / "c.ecsv")
    mapped = placed(tmp_path / "c.ecsv", telescope, columns={"g_r": "mine"})
    assert (mapped.temperatures(CCDS[0])[-5:] < found.temperatures(CCDS[0])[-5:]).any()
    with pytest.raises(PachonError, match=r"c.ecsv: no column nothing \(bp_rp\); columns are"):
        placed(tmp_path / "c.ecsv", telescope, columns={"bp_rp": "nothing"})
    # Without a colour there are no temperatures.
    Table({"x_m": [0.0], "y_m": [0.0], "mag": [19.0]}).write(tmp_path / "d.ecsv")
    assert placed(tmp_path / "d.ecsv", telescope).temperatures("R22_S11") is None


@pytest.mark.long
@pytest.mark.parametrize("telescope", ["lsst_v3.3_r", "decam"])
def test_colours_of_a_catalogue_are_spectra_in_a_run(tmp_path, telescope):
    """Observed stars are direct sums over the wavelengths with the star's blackbody; holdout stars stay as they are."""
    ccd = {"decam": "N4", "lsst_v3.3_r": "R22_S11"}[telescope]
    camera = pachon.load_camera(pachon.load_telescope(telescope).camera)
    center = camera.centers[camera.ccd_index(ccd)]
    x, y = center[:, None] + np.random.default_rng(5).uniform(-0.008, 0.008, (2, 3))
    Table({"x_m": x, "y_m": y, "mag": np.full(3, 19.0), "teff": [3000.0, np.nan, 15000.0]}).write(tmp_path / "s.ecsv")
    given = {
        "telescope": telescope,
        "ccds": [ccd],
        "stars": {"catalogue": "s.ecsv", "truth": 15, "brightest": 10, "faintest": 25},
        "atmosphere": {
            "exposure_s": 1, "time_step_s": 0.5, "screen_size": 1024, "screen_length_m": 500, "zenith_angle_deg": 45
        },
        "psf": {"engine": "fast"},
    }  # fmt: skip
    experiment = Experiment.from_config(Configuration.model_validate(given), tmp_path)
    stars = ccd_stars(experiment, ccd, 3e-6)
    with experiment.screens(1):
        found = expose_ccd(experiment, ccd, stars)
        waves, room = experiment.wavelengths, found.observed.image.shape[1] - experiment.stamp_size
        plain = expose_positions(experiment, stars.observed, offsets=found.observed.offset, room=room)
        stamps = Stamps(
            found.observed.image.shape[1], experiment.pixel_size, experiment.diffusion, offsets=found.observed.offset
        )
        one_by_one = [
            make_psfs(
                experiment.telescope,
                found.observed.fields,
                pachon.Light(waves, weights, experiment.dispersion),
                focal_plane=experiment.focal_plane,
                atmosphere=experiment.atmosphere,
                engine=FastEngine(n_pupil=experiment.config.psf.n_pupil),
                stamps=stamps,
            )
            for weights in np.eye(len(waves))
        ]
    kelvin = stars.temperature
    photons = pachon.blackbody_photons(kelvin, waves)
    light = np.stack([p.inside * p.lit_fraction[:, w] for w, p in enumerate(one_by_one)], axis=1) * photons
    light /= light.sum(axis=1, keepdims=True)
    expected = sum(light[:, w, None, None] * p.image for w, p in enumerate(one_by_one))
    np.testing.assert_allclose(found.observed.image, expected, atol=3e-5 * expected.max())
    flat = np.isnan(kelvin)
    np.testing.assert_allclose(found.observed.image[flat], plain.image[flat], atol=1e-6 * expected.max())
    # In air at 45 degrees a red and a blue star are apart, by 0.02" and more from the flat one's place.
    assert np.abs(found.observed.image[~flat] - plain.image[~flat]).max() > 0.01 * expected.max()


def test_the_order_of_the_rows_does_not_matter(tmp_path, telescope, places, magnitudes):
    twice = np.concatenate([places, places[:5]]), np.concatenate([magnitudes, magnitudes[:5] + 0.5])
    table = Table({"x_m": twice[0][:, 0], "y_m": twice[0][:, 1], "mag": twice[1]})
    table.write(tmp_path / "a.fits")
    table[np.random.default_rng(1).permutation(len(table))].write(tmp_path / "b.fits")
    a, b = (placed(tmp_path / name, telescope) for name in ("a.fits", "b.fits"))
    assert all(np.array_equal(a.stars[name], b.stars[name]) for name in CCDS)
    assert a.counts == b.counts


@pytest.mark.parametrize(
    ("columns", "options", "parts"),
    [
        ({"x_m": [0.0], "y_m": [0.0]}, {}, ["stars.ecsv: no column mag (mag: mag, r, mag_r,", "columns are x_m, y_m"]),
        ({"ra": [0.0], "mag": [0.0]}, {}, ["no column dec (dec: dec, dec_deg,"]),
        (
            {"ra": [0.0], "dec": [0.0], "mag": [1.0]},
            {"pointing": None},
            ["stars.ecsv: right ascension and declination: expected pointing = {ra_deg, dec_deg}"],
        ),
        ({"ra": [0.0] * u.kg, "dec": [0.0], "mag": [1.0]}, {}, ["column ra", "expected a unit that converts to rad"]),
        ({"ra": [0.0], "dec": [0.0], "mag": ["bright"]}, {}, ["column mag", "expected real numbers"]),
        ({"ra": [[0.0, 1.0]], "dec": [0.0], "mag": [1.0]}, {}, ["column 'ra': expected one number in every row"]),
        ({"ra": [0.0], "dec": [0.0], "mag": [1.0]}, {"columns": {"mag": "i_psf"}}, ["no column mag (mag: i_psf)"]),
    ],
)
def test_a_table_that_cannot_be_used_says_why(tmp_path, telescope, columns, options, parts):
    Table(columns).write(tmp_path / "stars.ecsv")
    with pytest.raises(PachonError) as error:
        placed(tmp_path / "stars.ecsv", telescope, **options)
    assert all(part in str(error.value) for part in parts), str(error.value)


def test_a_missing_or_strange_file_is_named(tmp_path, telescope):
    with pytest.raises(PachonError, match=r"nothing\.csv: no such file"):
        placed(tmp_path / "nothing.csv", telescope)
    (tmp_path / "a.fits").write_text("no fits")
    with pytest.raises(PachonError, match=r"a\.fits: damaged or no FITS table"):
        placed(tmp_path / "a.fits", telescope)
    with pytest.raises(PachonError, match=r"ending '\.txt': expected one of \.ecsv, \.csv"):
        placed(tmp_path / "a.txt", telescope)


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory, telescope, places, magnitudes, sky):
    """A file of the stars of three CCDs, those of the last one but three left out."""
    path = tmp_path_factory.mktemp("catalogue") / "stars.csv"
    some = np.ones(90, dtype=bool)
    some[11::3] = False
    Table({"ra": sky[some, 0], "dec": sky[some, 1], "mag": magnitudes[some]}).write(path)
    return path


@pytest.fixture(scope="module")
def config(tiny, catalogue):
    return with_options(
        tiny(ccds=CCDS, wavelengths_nm=(LIGHT * 1e9,), psf__engine="long_exposure", psf__n_pupil=200),
        stars__catalogue=str(catalogue),
        stars__brightest=17.0,
        stars__faintest=22.0,
        pointing=POINTING,
        rotator_deg=np.rad2deg(0.2),
    )


def test_defaults_are_written_out_and_the_content_is_hashed(tmp_path, config, catalogue):
    path = tmp_path / "run.yaml"
    path.write_text(f"stars: {{catalogue: {catalogue.name}}}\npointing: {{ra_deg: 53.1, dec_deg: -27.8}}\n")
    with pytest.raises(PachonError, match=r"stars\.catalogue: .*stars\.csv: no such file"):
        Experiment.from_config(load_configuration(path), tmp_path)
    experiment = Experiment.from_config(load_configuration(path), catalogue.parent)
    stars = experiment.config.stars
    # Saturation, and S/N 30, of 0.6 arcsec stars in 15 s in r (SMTN-002).
    assert stars.catalogue == str(catalogue)
    assert (15.0 < stars.brightest < 18.0, 21.5 < stars.faintest < 23.5) == (True, True)
    path.write_text(to_yaml(experiment.config))
    again = Experiment.from_config(load_configuration(path))
    assert again.config == experiment.config
    changed = tmp_path / "stars.csv"
    changed.write_text(catalogue.read_text().replace("\n5", "\n 5"))
    other = Experiment.from_config(with_options(experiment.config, stars__catalogue=str(changed)))
    assert again.config_hash == experiment.config_hash != other.config_hash
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "other_name.csv").write_bytes(catalogue.read_bytes())
    copied = with_options(experiment.config, stars__catalogue=str(tmp_path / "copy" / "other_name.csv"))
    assert Experiment.from_config(copied).config_hash == experiment.config_hash


@pytest.mark.parametrize(
    ("stars", "parts"),
    [
        ({"faintest": 21.0}, "stars.faintest = 21.0: expected stars.catalogue"),
        ({"catalogue": "a.csv", "columns": {"flux": "f"}}, 'stars.columns.flux = "f": expected keys of ra, dec,'),
        ({"catalogue": "a.csv", "brightest": 24.0}, "stars.faintest = 22"),
    ],
)
def test_wrong_keys_of_a_catalogue(stars, parts):
    with pytest.raises(PachonError) as error:
        Experiment.from_config(Configuration(stars=stars))
    assert parts in str(error.value)


def test_without_a_catalogue_and_a_pointing_the_hash_stays(tiny):
    experiment = Experiment.from_config(tiny())
    assert Experiment.from_config(with_options(tiny(), pointing=POINTING)).config_hash != experiment.config_hash
    assert experiment.star_list is None
    assert experiment.pointing is None


def test_a_run_without_enough_stars_ends_before_it_begins(tmp_path, config):
    experiment = Experiment.from_config(with_options(config, ccds=("R41_S20",)))
    reason = r"CCD R41_S20: 3 stars of stars\.csv on it: expected at least 5"
    with pytest.raises(PachonError, match=reason):
        run(experiment, tmp_path / "few")
    assert not (tmp_path / "few").exists()
    with pytest.raises(PachonError, match=reason):
        run(config, tmp_path / "strict", strict=True)
    with pytest.raises(PachonError, match=reason):
        simulate_ccds(experiment, write_ccds)
    # A worker has one CCD at a time, and reports it.
    assert list(simulate_ccds(experiment, write_ccds, strict=False).not_modelled) == ["R41_S20"]


def test_electrons_are_those_of_the_magnitudes(config, magnitudes, places):
    stars = ccd_stars(Experiment.from_config(config), "R22_S11", 3e-6)
    order = np.argsort(places[::3, 0])
    # SMTN-002: 28.36 is the magnitude of an electron a second in r; two seconds of exposure.
    assert np.allclose(stars.electrons, 2.0 * 10 ** (0.4 * (28.36 - magnitudes[::3][order])), rtol=1e-12)


@pytest.mark.long
def test_the_stars_of_the_catalogue_are_observed(tmp_path, config, sky, magnitudes, places):
    experiment = Experiment.from_config(config)
    for name in "ab":
        (tmp_path / name).mkdir()
        with experiment.screens():
            simulated = simulate_ccds(experiment, partial(write_ccds, experiment, tmp_path / name), strict=False)
    assert simulated.not_modelled == {"R41_S20": "3 stars of stars.csv on it: expected at least 5"}
    path = tmp_path / "a" / "ccd_R22_S11.fits"
    assert path.read_bytes() == (tmp_path / "b" / "ccd_R22_S11.fits").read_bytes()
    table = fits.getdata(path, "STARS")
    order = np.argsort(places[::3, 0])
    assert np.allclose(np.stack([table["RA"], table["DEC"]], axis=1), sky[::3][order], rtol=0, atol=1e-10)
    assert np.array_equal(table["MAG"], magnitudes[::3][order])
    truth = fits.getdata(path, "TRUTH")
    there = world_coordinates(experiment).all_pix2world(pixels(truth), 0)
    assert np.abs(there - np.stack([truth["RA"], truth["DEC"]], axis=1)).max() * 3600.0 < 1e-3


def world_coordinates(experiment):
    aim = experiment.pointing
    return pachon.wcs(experiment.telescope, "R22_S11", (aim.ra, aim.dec), aim.position_angle, wavelength=LIGHT)


def pixels(table):
    """Pixels of the central CCD."""
    # They run along y and x of the detector: 4096 and 4004 of 10 um about the axis.
    return np.stack([table["Y"], table["X"]], axis=1) * 1e-3 / 10e-6 + [2047.5, 2001.5]


@pytest.mark.slow
def test_a_whole_run_of_a_catalogue_goes_on_and_has_a_model_of_the_focal_plane(tmp_path, config, catalogue):
    path = tmp_path / "stars.csv"
    path.write_bytes(catalogue.read_bytes())
    config = with_options(config, reconstruction__model="focal_plane", stars__catalogue=str(path))
    result = run(config, tmp_path / "a")
    assert list(result.not_modelled) == ["R41_S20"]
    assert (result.summary["catalogue"]["on_the_ccds"], result.report.is_file()) == (63, True)
    table = fits.getdata(tmp_path / "a" / "ccd_R24_S12.fits", "STARS")
    assert {"RA", "DEC", "CCD_E1"} <= set(table.names)
    kept = run(config, tmp_path / "a", execution=Execution(resume=True))
    assert (kept.kept, kept.computed) == (CCDS[:2], ())
    found = diagnose(tmp_path / "a", tmp_path / "residuals")
    assert found.overall["ccds"] == 2
    # Without its last star, the catalogue is another: no CCD of the old one is kept.
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")
    other = run(config, tmp_path / "a", execution=Execution(resume=True))
    assert (other.kept, other.computed) == ((), CCDS[:2])
    assert other.summary["catalogue"]["stars"] == 62


@pytest.mark.long
def test_images_have_the_stars_of_the_catalogue(catalogue, sky, places):
    images = pachon.imaging.ImagesConfig(
        run=Configuration(
            ccds=("R22_S11",),
            rotator_deg=np.rad2deg(0.2),
            wavelengths_nm=(LIGHT * 1e9,),
            stars={"truth": 24, "catalogue": str(catalogue)},
            psf={"engine": "long_exposure", "n_pupil": 200},
        ),
        pointing=POINTING,
    )
    experiment = images.experiment()
    with experiment.screens():
        scene = pachon.draw_ccd(
            experiment,
            "R22_S11",
            pachon.sky.Galaxies.single([], [], [], []),
            pointing=AIM,
            window=pachon.Window(1500, 1500, 1200, 1200),
        )
    found = np.stack([scene.objects["RA"], scene.objects["DEC"]], axis=1)
    assert 0 < len(found) < 30
    distance = np.abs(found[:, None] - sky[None, ::3]).max(axis=2).min(axis=1)
    # The WCS is good to 3e-4 arcsec.
    assert distance.max() * 3600.0 < 3e-4
    with pytest.raises(PachonError, match=r"run\.pointing: expected none"):
        pachon.imaging.ImagesConfig(run=Configuration(pointing=POINTING)).experiment()


def test_studies_that_draw_their_stars_take_no_catalogue(config):
    with pytest.raises(PachonError, match=r"stars\.catalogue = .*: expected none, these stars are drawn"):
        study_experiment(config, make_plan(config))
    with pytest.raises(PachonError, match=r"run\.stars\.catalogue = .*: expected none"):
        pachon.studies.VisitsConfig(run=config).experiment()
