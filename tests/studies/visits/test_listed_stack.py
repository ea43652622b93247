"""Stacks of the visits of a list: pointings and rolls by spherical geometry, weights by sums restated."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from visit_rows import COLUMNS, ROWS

from pachon.commands.cli import main
from pachon.core.errors import ConfigError, ProductError
from pachon.core.long_work import Execution
from pachon.core.units import ARCSEC
from pachon.imaging.exposure import Exposure
from pachon.models.io.bundled import DATA
from pachon.models.io.site_file import load_site
from pachon.pipeline.config import Configuration
from pachon.sky.pointing import Pointing
from pachon.sky.visit_list.read_list import read_visit_list
from pachon.studies.night import config as night_config
from pachon.studies.night.config import ListSection, read_section
from pachon.studies.visits.plan import listed_plan
from pachon.studies.visits.psf_visit import VisitPsfs, stack_limit
from pachon.studies.visits.stack import PsfSums
from pachon.studies.visits.stack_exposure import faintest_galaxies, stack_exposure
from pachon.studies.visits.visit_figures import VisitFigures
from pachon.studies.visits.visits import SUMS_NAME, claim_visits, stack_visits


@pytest.fixture
def list_file(tmp_path):
    path = tmp_path / "visits.csv"
    path.write_text("\n".join([",".join(COLUMNS), *(",".join(map(str, row)) for row in ROWS)]) + "\n")
    return path


def test_directions_are_those_of_the_pointings(list_file):
    """The light of points of the sky enters as right ascensions, declinations and position angles say."""
    visits = read_visit_list(list_file)
    center = Pointing(*np.deg2rad([53.1, -27.8]))
    sky = np.array([[0.0, 0.0], [0.01, 0.004], [-0.006, 0.012]])
    for visit, ra, dec, roll in zip(listed_plan(visits, center), visits.ra, visits.dec, visits.roll, strict=True):
        aim = Pointing(float(ra), float(dec), float(roll))
        alpha, delta = center.to_celestial(sky).T
        source = np.stack([np.cos(delta) * np.cos(alpha), np.cos(delta) * np.sin(alpha), np.sin(delta)], axis=1)
        np.testing.assert_allclose(visit.directions(sky), -source @ aim.axes.T, atol=1e-12)


def test_sums_have_weights():
    rng = np.random.default_rng(3)
    images, weights = rng.random((3, 2, 5, 5)), [0.5, 2.0, 1.0]
    sums, figures = PsfSums.empty(2, 5), VisitFigures(0.01, 0.001, 0.002, 0.3)
    for image, weight in zip(images.astype(np.float32), weights, strict=True):
        sums.add(VisitPsfs(np.arange(2), image, image, {}, figures, weight))
    mean = np.average(images, axis=0, weights=weights)
    np.testing.assert_allclose(sums.true / sums.weight[:, None, None], mean, rtol=1e-6)


def test_the_noise_of_a_stack_is_that_of_its_visits(visits_config, tmp_path):
    """It was that of equal visits under the dark sky: under a sky of 19.1 it was 2.5 times too small."""
    scale = 0.2 * ARCSEC

    def exposures(visits):
        rows = [f"{i},53.1,-27.8,90,0,61001.15,{t},r,0,0.7,{sky},{w}" for i, (t, sky, w) in enumerate(visits)]
        names = (
            "visit,ra,dec,altitude,azimuth,observationStartMJD,visitExposureTime,band,rotTelPos,seeing,sky_mag,weight"
        )
        path = tmp_path / "own.csv"
        path.write_text("\n".join([names, *rows]) + "\n")
        config = visits_config(count=10).with_list(ListSection(list=str(path)))
        experiment, plan = config.experiment(), config.plan(1)
        return (
            stack_exposure(experiment, plan, scale),
            Exposure.of_run(experiment, len(visits), gain=1.0, pixel_scale=scale),
            lambda exposure: (
                faintest_galaxies(experiment, plan, exposure, 8.0) - stack_limit(experiment, 8.0, len(plan))
            ),
        )

    dark = 21.2
    measured, equal, deeper = exposures([(30.0, dark, 2.0)] * 3)
    assert measured.total_time == pytest.approx(equal.total_time, rel=1e-9)
    assert measured.noise_rms == pytest.approx(equal.noise_rms, rel=1e-9)
    assert abs(deeper(measured)) < 1e-9
    # Variances of a mean of weights 1 and 3, of electrons a second.
    measured, equal, deeper = exposures([(30.0, dark, 1.0), (60.0, dark - 2.0, 3.0)])
    sky = equal.background / equal.total_time - equal.dark_current
    first = (sky + equal.dark_current) / 30.0 + (equal.read_noise / 30.0) ** 2
    second = (sky * 10**0.8 + equal.dark_current) / 60.0 + (equal.read_noise / 60.0) ** 2
    assert (measured.noise_rms / measured.total_time) ** 2 == pytest.approx((first + 9.0 * second) / 16.0, rel=1e-9)
    assert measured.total_time == pytest.approx(16.0 / (1.0 / 30.0 + 9.0 / 60.0), rel=1e-9)
    assert -1.0 < deeper(measured) < -0.5


def test_lists_of_several_bands_or_fields_are_no_stack(visits_config, list_file, tmp_path):
    with pytest.raises(ConfigError, match="bands i, r, z: expected one for a stack"):
        visits_config(count=10).with_list(ListSection(list=str(list_file)))
    far = tmp_path / "far.csv"
    far.write_text(list_file.read_text().replace("53.25,-27.9", "73.25,-27.9"))
    with pytest.raises(ConfigError, match="expected one field"):
        visits_config(count=10).with_list(ListSection(list=str(far), band="r"))


def test_a_list_is_read_once_while_it_stays_the_same(visits_config, list_file, monkeypatch, tmp_path):
    path, readings = tmp_path / "own.csv", []
    path.write_text(list_file.read_text())

    def read(*arguments, **options):
        readings.append(arguments)
        return read_visit_list(*arguments, **options)

    monkeypatch.setattr(night_config, "read_visit_list", read)
    config = visits_config(count=10).with_list(ListSection(list=str(path), band="r"))
    assert len(config.plan(1)) == config.visits.count
    assert len(readings) == 1
    path.write_text(list_file.read_text().replace("53.25,-27.9", "53.2501,-27.9"))
    with pytest.raises(ProductError, match="the list has changed"):
        config.plan(1)
    assert len(readings) == 2


def test_a_list_that_has_moved_goes_on(visits_config, list_file, tmp_path):
    """The path of the list made another stack of the same visits; a night went on."""
    moved = tmp_path / "elsewhere" / "new_name.csv"
    moved.parent.mkdir()
    moved.write_text(list_file.read_text())
    old = visits_config(count=10).with_list(ListSection(list=str(list_file), band="r"))
    new = visits_config(count=10).with_list(ListSection(list=str(moved), where="band = 'r'"))
    other = visits_config(count=10).with_list(ListSection(list=str(moved), where="band = 'r' and observationId > 1001"))
    experiment = old.experiment()
    assert new.digest(experiment) == old.digest(experiment) != other.digest(experiment)
    claim_visits(tmp_path / "stack", old, resume=False)
    claim_visits(tmp_path / "stack", new, resume=True)
    assert str(moved) in (tmp_path / "stack" / "config.yaml").read_text()
    with pytest.raises(ProductError, match=r"stack holds visits of another list: .*new_name.csv has changed, or other"):
        claim_visits(tmp_path / "stack", other, resume=True)


@pytest.mark.long
@pytest.mark.usefixtures("empty_pictures")
def test_a_stack_of_a_list(visits_config, list_file, tmp_path):
    section = ListSection(list=str(list_file), band="r", where="observationId < 1003")
    config = visits_config(count=10, snapshots=(1,)).with_list(section)
    assert config.visits.count == 2
    assert config.run.atmosphere.exposure_s == 30.0
    result = stack_visits(config, tmp_path / "one", execution=Execution(threads=1))
    # 0.72" and 0.70", 0.5 deg apart: the wider one alone, and with half of the points of the other.
    assert set(result.stacks) == {1, 2}
    sizes = [np.median(result.stacks[n].size) / np.deg2rad(1 / 3600) for n in (1, 2)]
    assert 0.2 < sizes[1] <= sizes[0] < 0.5
    again = stack_visits(config, tmp_path / "one", execution=Execution(resume=True))
    np.testing.assert_array_equal(again.stacks[2].true, result.stacks[2].true)
    # Numbers of the list and the weights that its PSFs have in the sums.
    visits = Table.read(tmp_path / "one" / "visits.ecsv")
    assert visits["visitId"].tolist() == [1001, 1002]
    one, two = visits["weight"]
    with fits.open(tmp_path / "one" / SUMS_NAME) as hdus:
        sums = np.unique(hdus["WEIGHT"].data)
    assert sums.max() > 0.0
    for weight in sums:
        assert np.isclose(weight, [0.0, one, two, one + two], rtol=1e-6, atol=0.0).any()


def test_the_place_of_a_telescope_without_a_site_is_said(list_file, tmp_path):
    """It was that of Cerro Pachon without a word; a site of its own file was refused as an unknown one."""
    text = (DATA / "lsst_v3.3_r.yaml").read_text()
    (tmp_path / "air.yaml").write_text((DATA / "maunakea.yaml").read_text())
    assumed = "telescope mine.yaml has no bundled site: place of cerro_pachon is taken"
    for site, place, scale, remarks in (
        ("", "cerro_pachon", 25.0, [assumed]),
        ("site: air.yaml\n", "cerro_pachon", float(load_site("maunakea").outer_scale), [assumed]),
        ("site: cerro_tololo\n", "cerro_tololo", float(load_site("cerro_tololo").outer_scale), []),
    ):
        (tmp_path / "mine.yaml").write_text(site + text)
        section = ListSection(list=str(list_file), where="observationId = 1004")
        listed = read_section(section, Configuration(telescope="mine.yaml"), tmp_path)
        expected = read_visit_list(list_file, where="observationId = 1004", site=place, outer_scale=scale)
        assert (listed.digest, [*listed.remarks]) == (expected.digest, [*expected.remarks, *remarks])


def test_a_list_of_a_configuration_in_another_folder(visits_config, list_file, tmp_path, capsys, monkeypatch):
    """Its telescope was looked for in the current one; a list under visits.from_list had neither band nor pointing."""
    folder = tmp_path / "settings"
    folder.mkdir()
    (folder / "mine_r.yaml").write_text((DATA / "lsst_v3.3_r.yaml").read_text())
    base = visits_config(count=10)
    base = base.model_copy(update={"run": base.run.model_copy(update={"telescope": "mine_r.yaml"})})
    config = base.with_list(ListSection(list="../visits.csv", band="r"), folder)
    assert config.experiment(folder).telescope.name == "lsst_v3.3_r"
    expected = visits_config(count=10).with_list(ListSection(list=str(list_file), band="r"))
    assert config.visits == expected.visits
    stacked = []

    def stack(config, *_, **__):
        stacked.append(config)
        raise ConfigError("no stack is wanted")

    monkeypatch.setattr("pachon.studies.visits.visits.stack_visits", stack)
    text = "run: {ccds: [R22_S11], telescope: mine_r.yaml}\nvisits: {from_list: {list: ../visits.csv, band: r}}\n"
    (folder / "stack.yaml").write_text(text)
    for options in ([], ["--count", "2"]):
        assert main(["visits", str(folder / "stack.yaml"), *options]) == 2
    assert "visits.count: expected none with a list, whose visits have their own" in capsys.readouterr().err
    assert stacked[0].visits.from_list == expected.visits.from_list
    assert stacked[0].run.pointing == expected.run.pointing


@pytest.mark.parametrize("key", [{"count": 3}, {"dither_deg": 1.0}, {"roll_deg": (0.0,)}, {"first_epoch": 2}])
def test_settings_of_drawn_visits_are_refused_beside_a_list(visits_config, list_file, key):
    """They were ignored."""
    with pytest.raises(ConfigError, match=rf"visits.{next(iter(key))}: expected none with a list"):
        visits_config(**{"count": 10} | key).with_list(ListSection(list=str(list_file), band="r"))
