"""Nights of visit lists: what comes out, with what bytes, and what is said of visits that fail."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS

import pachon
from pachon.commands.night import listed_visit
from pachon.core.errors import ConfigError, DomainError, ProductError
from pachon.core.long_work import Execution
from pachon.core.products import read_fits
from pachon.core.units import ARCSEC
from pachon.imaging.wcs import ccd_wcs
from pachon.models.io.bundled import DATA
from pachon.pipeline.listed_visit import check_bands, visit_experiment
from pachon.sky.visit_list.seeing import fried_parameter
from pachon.studies.night.config import NightConfig
from pachon.studies.night.maps import NightMaps
from pachon.studies.night.night import claim_night, run_night
from pachon.studies.night.visit_product import VisitWork

pytestmark = pytest.mark.long


def content(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*.*")) if path.is_file()}


@pytest.fixture(scope="session")
def night(night_config, tmp_path_factory):
    """Configuration, result and files of a night, products of CCDs among them."""
    config = night_config(products=True, maps={"nside": 1024})
    folder = tmp_path_factory.mktemp("night")
    return config, run_night(config, folder, execution=Execution(threads=1)), content(folder)


def detector_table(folder):
    parquet = pytest.importorskip("pyarrow.parquet")
    return parquet.read_table(folder / "visit_detector.parquet")


def test_a_visit_that_fails_is_left_out(night):
    _, result, _ = night
    assert list(result.left_out) == [1002]
    assert "zenith_angle_deg" in result.left_out[1002]
    assert result.missing == ()
    summary = json.loads((result.folder / "summary.json").read_text())
    assert (summary["visits"], summary["finished"], summary["complete"]) == (3, 3, True)
    assert list(summary["left_out"]) == ["1002"]


def test_a_night_without_a_psf_is_an_error(night_config, tmp_path, monkeypatch):
    def no_light(*_):
        raise DomainError("no light")

    monkeypatch.setattr(VisitWork, "_product", no_light)
    with pytest.raises(DomainError, match=r"visits.csv: none of 3 visits has a PSF; visit 1001: no light"):
        run_night(night_config(models=False, maps={"nside": 0}), tmp_path, execution=Execution(threads=1))
    assert list(json.loads((tmp_path / "summary.json").read_text())["left_out"]) == ["1001", "1002", "1003"]


def test_sky_rotation_of_the_table_is_that_of_images(night):
    """As of LSST's table of visits: position angle of +y of the focal plane, here of an image by its header."""
    config, result, _ = night
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = parquet.read_table(result.folder / "visit.parquet").to_pydict()
    assert rows["visitId"] == [1001, 1002, 1003]
    columns = (rows[key] for key in ("visitId", "skyRotation", "telescopeRotation"))
    for visit, rotation, telescope in zip(*columns, strict=True):
        listed = config.read_list(None).of_visit(visit)
        assert telescope == pytest.approx(np.rad2deg(listed.roll))
        if visit in result.left_out:
            continue
        experiment = visit_experiment(config.run, listed)
        wcs = ccd_wcs(experiment.telescope, experiment.camera, "R22_S11", pointing=experiment.pointing)
        header = WCS(wcs.to_header())
        below, above = (SkyCoord(*header.all_pix2world([[2000.0, y]], 0)[0], unit="deg") for y in (1900.0, 2100.0))
        assert below.position_angle(above).deg == pytest.approx(rotation, abs=0.01)  # optical distortion


def test_the_table_has_units_and_the_psf_of_the_products(night):
    _, result, _ = night
    table = detector_table(result.folder)
    assert table.schema.field("psfIxx").metadata[b"unit"] == b"pixel2"
    rows = table.to_pydict()
    assert rows["visitId"] == [1001, 1003]
    assert rows["detector"] == [94, 94]
    assert rows["band"] == ["r", "i"]
    for i, visit in enumerate((1001, 1003)):
        hdus = read_fits(result.folder / "visits" / f"visit_{visit}_ccd_R22_S11.fits")
        image = hdus["TRUTH_PSF"].data[0].astype(float)  # that in the middle of the CCD
        assert rows["psfArea"][i] == pytest.approx(image.sum() ** 2 / (image**2).sum(), rel=1e-6)
        determinant = rows["psfIxx"][i] * rows["psfIyy"][i] - rows["psfIxy"][i] ** 2
        assert rows["psfSigma"][i] == pytest.approx(determinant**0.25)
        # Images of the LSST exchange x and y of the focal plane, along which stamps lie.
        galsim = pytest.importorskip("galsim")
        moments = galsim.hsm.FindAdaptiveMom(galsim.Image(np.ascontiguousarray(image.T), scale=1.0))
        assert rows["psfSigma"][i] == pytest.approx(moments.moments_sigma, rel=1e-4)
        e1 = (rows["psfIxx"][i] - rows["psfIyy"][i]) / (rows["psfIxx"][i] + rows["psfIyy"][i])
        assert e1 == pytest.approx(moments.observed_shape.e1, abs=1e-4)
        # The zero point is that of the stars of the file, but for what vignetting changes over the CCD.
        stars = hdus["STARS"].data
        measured = np.median(stars["MAG"] + 2.5 * np.log10(stars["ELECTRON"]))
        assert rows["zeroPoint"][i] == pytest.approx(measured, abs=2e-3)
        # Stamps have the exact scale, 0.20006", photometry that of SMTN-002, 0.2".
        assert rows["skyBg"][i] == pytest.approx(hdus[0].header["SKY"], rel=1e-3)
        assert rows["nPsfStar"][i] == stars["USED"].sum()
        assert (rows["ra"][i], rows["dec"][i]) == pytest.approx((hdus[0].header["RA"], hdus[0].header["DEC"]))
        assert hdus[0].header["DETECTOR"] == 94


def test_pixel_scale_of_the_table_is_that_of_world_coordinates(night_config, tmp_path):
    """At the edge of the focal plane the LSST's pixels are 0.2 % narrower than in the middle."""
    run = {"ccds": ["R22_S11", "R01_S02"], "telescope": "lsst_v3.3_r"}
    config = night_config(run, models=False, maps={"nside": 0})
    rows = detector_table(run_night(config, tmp_path, execution=Execution(threads=1)).folder).to_pydict()
    experiment = visit_experiment(config.run, config.read_list(None).of_visit(1001))
    for name in ("R01_S02", "R22_S11"):
        at = rows["detector"].index(experiment.camera.ccd_index(name))
        wcs = ccd_wcs(experiment.telescope, experiment.camera, name, pointing=experiment.pointing)
        x, y = 0.5 * experiment.camera.pixels[experiment.camera.ccd_index(name)] - 0.5
        places = WCS(wcs.to_header()).pixel_to_world([x, x + 100.0, x], [y, y, y + 100.0])
        east, north = places[0].spherical_offsets_to(places[1:])
        area = abs(east[0] * north[1] - east[1] * north[0]).to_value("arcsec2") / 100.0**2
        assert rows["pixelScale"][at] == pytest.approx(np.sqrt(area), rel=3e-5)


def test_maps_agree_with_world_coordinates_and_shapes_on_the_sky(night):
    healsparse = pytest.importorskip("healsparse")
    _, result, _ = night
    size = healsparse.HealSparseMap.read(str(result.folder / "deepCoadd_psf_size_consolidated_map_weighted_mean_r.hsp"))
    pixels = size.valid_pixels
    # 13.65' on a side, pixels of 3.44'.
    assert len(pixels) == pytest.approx((13.65 / 3.4355) ** 2, abs=6)
    rows = detector_table(result.folder).to_pydict()
    np.testing.assert_allclose(size[pixels], rows["psfSigma"][0], rtol=0.05)
    ra, dec = size.pixels_to_angles(pixels) if hasattr(size, "pixels_to_angles") else size.valid_pixels_pos(lonlat=True)
    away = np.hypot((ra - rows["ra"][0]) * np.cos(np.deg2rad(dec)), dec - rows["dec"][0])
    assert np.degrees(np.deg2rad(away.max())) < 0.5 * np.hypot(13.65, 13.65) / 60
    truth = read_fits(result.folder / "visits" / "visit_1001_ccd_R22_S11.fits")["TRUTH"].data
    names = {"e1": "G1_SKY", "e2": "G2_SKY"}
    for name, key in names.items():
        values = healsparse.HealSparseMap.read(
            str(result.folder / f"deepCoadd_psf_{name}_consolidated_map_weighted_mean_r.hsp")
        )
        # Polynomials of the second order describe the PSF over a CCD to 1e-3.
        assert values[pixels].mean() == pytest.approx(truth[key].mean(), abs=2e-3)


def test_depth_of_a_stack_of_one_is_that_of_the_visit(night):
    healsparse = pytest.importorskip("healsparse")
    _, result, _ = night
    rows = detector_table(result.folder).to_pydict()
    limit = healsparse.HealSparseMap.read(
        str(result.folder / "deepCoadd_psf_maglim_consolidated_map_weighted_mean_r.hsp")
    )
    # magLim has the noise of the star itself too, and no dark current.
    assert np.median(limit[limit.valid_pixels]) == pytest.approx(rows["magLim"][0], abs=0.06)


@pytest.mark.slow
def test_workers_parts_and_interruptions_leave_the_same_bytes(night, night_config, tmp_path, backwards, monkeypatch):
    config, _, files = night
    run_night(config, tmp_path / "workers", execution=Execution(backwards))
    assert content(tmp_path / "workers") == files
    first = run_night(config, tmp_path / "parts", part=(1, 2))
    assert first.missing == (1002,)
    assert not first.summary["complete"]
    run_night(config, tmp_path / "parts", part=(5, 5))  # more jobs than visits
    run_night(config, tmp_path / "parts", part=(2, 2))
    assert content(tmp_path / "parts") == files

    compute = VisitWork.compute_here

    def killed(self, reporter, visit, threads, folder):
        if visit.visit == 1003:
            raise KeyboardInterrupt
        return compute(self, reporter, visit, threads, folder)

    with monkeypatch.context() as patch:
        patch.setattr(VisitWork, "compute_here", killed)
        with pytest.raises(KeyboardInterrupt):
            run_night(config, tmp_path / "killed")
    # The table has grown with the visits.
    assert detector_table(tmp_path / "killed").to_pydict()["visitId"] == [1001]
    run_night(config, tmp_path / "killed", execution=Execution(resume=True))
    assert content(tmp_path / "killed") == files


def test_visits_without_products_of_ccds_are_made_anew(night, tmp_path, monkeypatch):
    """Their own files were taken for all of them."""
    config, result, files = night
    folder = tmp_path / "night"
    shutil.copytree(result.folder, folder)
    lost, damaged = (folder / "visits" / f"visit_{visit}_ccd_R22_S11.fits" for visit in (1001, 1003))
    lost.unlink()
    damaged.write_bytes(damaged.read_bytes()[:-2880])
    computed = []
    compute = VisitWork.compute_here
    monkeypatch.setattr(VisitWork, "compute_here", lambda *work: computed.append(work[2].visit) or compute(*work))
    monkeypatch.setattr(NightMaps, "write", lambda *_: None)
    monkeypatch.setattr("pachon.studies.night.night_files.night_page", lambda *_: "")
    run_night(config, folder, execution=Execution(resume=True))
    assert computed == [1001, 1003]
    of_visits = {Path(name).name: data for name, data in files.items() if name.startswith("visits/")}
    assert content(folder / "visits") == of_visits


def test_a_list_that_has_changed_is_refused(night, night_config):
    config, result, _ = night
    path = config.visits.list
    with open(path) as stream:
        text = stream.read()
    try:
        with open(path, "w") as stream:
            stream.write(text.replace("0.72", "0.73"))
        with pytest.raises(ProductError, match="holds a night of another list"):
            run_night(config, result.folder, execution=Execution(resume=True))
    finally:
        with open(path, "w") as stream:
            stream.write(text)
    with pytest.raises(ProductError, match="go on with --resume"):
        run_night(config, result.folder)


def test_a_list_that_has_moved_is_the_same(night_config, tmp_path):
    """The digest tells the visits: neither the place of their file nor how they are chosen is of the night."""
    config = night_config()
    moved = shutil.copy(config.visits.list, tmp_path / "moved.csv")
    again = config.visits.model_copy(update={"list": str(moved), "where": "observationId < 2000"})
    visits = config.read_list()
    nights = [config, config.model_copy(update={"visits": again})]
    for night in nights:
        experiment = visit_experiment(night.run, visits[0])
        claim_night(tmp_path / "night", night.started(visits, experiment), resume=True)
    opsim = again.model_copy(update={"airmass_law": "opsim"})
    with pytest.raises(ProductError, match="airmass_law"):
        claim_night(
            tmp_path / "night", config.model_copy(update={"visits": opsim}).started(visits, experiment), resume=True
        )


def test_outer_scale_of_a_list_without_one(night_config, tmp_path):
    """That of the configuration was replaced by that of the telescope's site, and a site file was refused."""
    site = (DATA / "cerro_pachon.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(site.replace("outer_scale: 25.0", "outer_scale: 40.0"))
    for air, scale in (({}, 25.0), ({"outer_scale_m": 50.0}, 50.0), ({"site": "mine.yaml"}, 40.0)):
        visits = night_config({"atmosphere": air}).read_list(tmp_path)
        assert visits.outer_scale.tolist() == [scale] * 3
        assert visits.r0[0] == pytest.approx(fried_parameter(np.array([0.72 * ARCSEC]), np.array([scale]))[0])


def test_bands_that_the_telescope_has_not(night_config, tmp_path):
    with pytest.raises(ConfigError, match=r"band i, 1 visit of visits.csv: .*has no band i"):
        run_night(night_config({"telescope": "comcam_r", "ccds": None}), tmp_path / "night")
    assert not (tmp_path / "night").exists()


def test_a_band_of_visits_that_fail_is_one_of_the_telescope(night_config):
    """Visits below the range of the optics are left out later, one by one, though a band has no others."""
    night = night_config()
    visits = night.read_list()
    low = replace(visits, altitude=np.where(visits.band == "i", np.deg2rad(4.0), visits.altitude))
    check_bands(night.run, low)
    comcam = night_config({"telescope": "comcam_r", "ccds": None})
    with pytest.raises(ConfigError, match="has no band i"):
        check_bands(comcam.run, low)


def test_settings_that_do_not_fit(night_config, tmp_path):
    for sections, message in (
        ({"maps": {"nside": 1000}}, "power of 2"),
        ({"models": False, "products": True}, "expected models = true"),
    ):
        with pytest.raises(ConfigError, match=message):
            run_night(night_config(**sections), tmp_path)
    with pytest.raises(DomainError, match="part = 5/4"):
        run_night(night_config(), tmp_path, part=(5, 4))


@pytest.mark.usefixtures("empty_pictures")
def test_psfs_alone(night_config, tmp_path):
    result = run_night(night_config(models=False, maps={"nside": 0}), tmp_path)
    rows = detector_table(result.folder).to_pydict()
    assert np.isnan(rows["modelDeltaE1Rms"]).all()
    assert np.isfinite(rows["psfSigma"]).all()
    assert not list(tmp_path.glob("*.hsp"))


def test_a_single_visit_may_have_a_model_of_the_focal_plane(night_config):
    # Visits of a whole night are modelled CCD by CCD; that is no limit of a run of one of them.
    night = night_config(run={"reconstruction": {"model": "focal_plane"}})
    with pytest.raises(ConfigError, match="expected ccd for visits of a list"):
        night.read_list()
    assert listed_visit(night.run, Path(night.visits.list), 1003, None, None, None).visit == 1003


def test_files_beside_a_configuration_are_found_from_anywhere(night_config, tmp_path):
    """The telescope of a run as well as the list: both tell where on the Earth the visits are."""
    pachon.save_telescope(pachon.load_telescope("lsst_v3.3_r"), tmp_path / "mine.yaml")
    shutil.copy(night_config().visits.list, tmp_path / "list.csv")
    visits = {"list": "list.csv", "where": "observationId = 1003"}
    night = NightConfig.model_validate({"run": {"telescope": "mine.yaml"}, "visits": visits})
    assert len(night.read_list(tmp_path)) == 1
    assert listed_visit(night.run, tmp_path / "list.csv", 1003, None, None, None, tmp_path).visit == 1003
