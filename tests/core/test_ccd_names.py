"""Files whose CCDs of the LSST are named as in a mirror are refused in one line; those without such names are read."""

import json
import sqlite3

import pytest
from astropy.io import fits

from pachon.core.ccd_names import NAMES_VERSION, refuse_mirrored_names
from pachon.core.errors import ConfigError, ProductError
from pachon.core.products import Stamp, read_fits, write_fits, write_hdus
from pachon.studies.baseline.baseline import bundled_baselines
from pachon.studies.baseline.file import read_baseline
from pachon.studies.sweep.store import SweepStore

WORDS = (
    f"in a mirror .docs/howto/camera.md.: expected version {NAMES_VERSION} of the names, found 1; make the file again"
)


@pytest.mark.parametrize("name", ["R22_S12", "R01_S00", "R00_SW1", "R44_SG0"])
def test_names_of_rubins_ccds_count(name, tmp_path):
    with pytest.raises(ProductError, match=rf"names CCDs of the LSST, such as {name}, as {WORDS}") as caught:
        refuse_mirrored_names(["x", name], None, tmp_path / "a.fits")
    assert "\n" not in str(caught.value)
    refuse_mirrored_names(["x", name], NAMES_VERSION, tmp_path / "a.fits")


def test_other_names_do_not(tmp_path):
    refuse_mirrored_names(["hsc000", "N4", "RXX_S00", "R22", ""], None, tmp_path / "a.fits")


@pytest.mark.parametrize(("ccd", "refused"), [("R22_S12", True), ("hsc050", False)])
def test_products_of_runs(tmp_path, ccd, refused):
    path, older = tmp_path / "new.fits", tmp_path / "old.fits"
    write_fits(path, [], Stamp("0123", 1), [("CCD", ccd, "")])
    hdus = read_fits(path)
    assert hdus[0].header["CCDNAMES"] == NAMES_VERSION
    del hdus[0].header["CCDNAMES"]
    write_hdus(older, hdus)
    if refused:
        with pytest.raises(ProductError, match=rf"old\.fits: names CCDs of the LSST, such as {ccd}, as {WORDS}"):
            read_fits(older)
    else:
        assert read_fits(older)[0].header["CCD"] == ccd


def test_files_of_other_programs_are_none_of_ours(tmp_path):
    header = fits.Header({"CCD": "R22_S12"})
    fits.PrimaryHDU(header=header).writeto(tmp_path / "theirs.fits")
    assert read_fits(tmp_path / "theirs.fits", checksums=False)[0].header["CCD"] == "R22_S12"


def test_baselines_count_where_they_name_ccds(tmp_path):
    content = json.loads(next(p for p in bundled_baselines() if "v3.3_r" in p.name).read_text())
    path = tmp_path / "older.json"
    path.write_text(json.dumps(content | {"version": 1}))
    with pytest.raises(ConfigError, match=rf"older\.json: names CCDs of the LSST, such as R\d\d_S\d\d, as {WORDS}"):
        read_baseline(path)
    path.write_text(json.dumps(content | {"version": 1, "plan": content["plan"] | {"ccds": []}}))
    assert read_baseline(path).model == content["model"]


def test_stores_of_sweeps(tmp_path):
    with sqlite3.connect(tmp_path / "sweep.db") as connection:
        connection.execute("CREATE TABLE about (key TEXT, value TEXT)")
        connection.execute("INSERT INTO about VALUES ('format', '1')")
    connection.close()
    with pytest.raises(ProductError, match="store of format 1: expected 2; those of 1 name the CCDs of the LSST as in"):
        SweepStore(tmp_path / "sweep.db")
