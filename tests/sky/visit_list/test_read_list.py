"""Visit lists: angles by spherical trigonometry and astropy, air by Tokovinin's formula, formats by each other."""

import datetime
import sqlite3
from contextlib import closing
from decimal import Decimal

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.table import QTable, Table
from astropy.time import Time
from astropy.utils import iers
from visit_rows import COLUMNS, ROWS

from pachon.core.errors import ConfigError, DomainError, ProductError
from pachon.sky.visit_list.read_list import read_visit_list

ARCSEC = np.pi / 180 / 3600
PACHON = EarthLocation.from_geodetic(-70.749417 * u.deg, -30.244639 * u.deg, 2663 * u.m)


def column(name):
    return np.array([row[COLUMNS.index(name)] for row in ROWS])


@pytest.fixture
def visits(write_list):
    return read_visit_list(write_list())


@pytest.fixture(autouse=True)
def offline():
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        yield


def bearing(ra, dec, ra2, dec2):
    """Position angle of the second point at the first, from north through east, by the sine and cosine rules."""
    return np.arctan2(
        np.sin(ra2 - ra) * np.cos(dec2),
        np.sin(dec2) * np.cos(dec) - np.cos(dec2) * np.sin(dec) * np.cos(ra2 - ra),
    )


def test_the_mapping_of_the_example(visits):
    """Numbers of an independent script (batoid's and imSim's conventions) for these rows."""
    np.testing.assert_allclose(np.rad2deg(visits.roll), [-110.38, -111.72, 101.84, 122.39, 104.37], atol=0.005)
    np.testing.assert_allclose(90 - np.rad2deg(visits.altitude), [8.13, 8.35, 19.07, 4.66, 14.56], atol=0.005)
    np.testing.assert_allclose(visits.r0, [0.1151, 0.1182, 0.0891, 0.1361, 0.0777], atol=5e-5)
    np.testing.assert_allclose(np.rad2deg(visits.rotator), column("rotTelPos"), atol=1e-12)
    assert visits.band.tolist() == ["r", "r", "i", "r", "z"]
    assert visits.snaps.tolist() == [1, 1, 1, 2, 1]
    assert visits.epoch.tolist() == visits.visit.tolist() == [1001, 1002, 1003, 1004, 1005]


def test_the_middle_of_the_exposure_is_that_of_all_snaps(visits):
    seconds = (visits.midpoint - column("observationStartMJD")) * 86400
    # Two snaps of 14.6 s, 2 s apart. Modified Julian dates resolve 1e-6 s.
    np.testing.assert_allclose(seconds, [15, 15, 15, 15.6, 15], atol=1e-5)


def test_the_roll_is_the_bearing_of_the_zenith(visits):
    frame = AltAz(obstime=Time(visits.midpoint, format="mjd", scale="tai"), location=PACHON)
    zenith = SkyCoord(alt=np.full(5, 90.0) * u.deg, az=np.zeros(5) * u.deg, frame=frame).icrs
    expected = bearing(visits.ra, visits.dec, zenith.ra.rad, zenith.dec.rad)
    # Aberration moves the zenith against the pointing by up to 20": 0.07 deg at 4.7 deg from the zenith.
    np.testing.assert_allclose(np.rad2deg(visits.roll - expected), 0.0, atol=0.1)
    horizontal = SkyCoord(visits.ra * u.rad, visits.dec * u.rad).transform_to(frame)
    np.testing.assert_allclose(visits.altitude, horizontal.alt.rad, atol=1e-9)
    np.testing.assert_allclose(visits.azimuth, horizontal.az.rad, atol=1e-9)


def test_steps_towards_the_zenith_rise(visits):
    """A small step along the roll raises the altitude by as much, and leaves the azimuth; astropy has the last word."""
    frame = AltAz(obstime=Time(visits.midpoint, format="mjd", scale="tai"), location=PACHON)
    start = SkyCoord(visits.ra * u.rad, visits.dec * u.rad)
    step = 60 * u.arcsec
    higher = start.directional_offset_by(visits.zenith_position_angle * u.rad, step).transform_to(frame)
    level = start.transform_to(frame)
    # Aberration scales angles by 1e-4.
    np.testing.assert_allclose((higher.alt - level.alt).to_value(u.arcsec), 60.0, atol=0.02)
    np.testing.assert_allclose((higher.az - level.az).to_value(u.arcsec) * np.cos(level.alt.rad), 0.0, atol=0.02)


def test_r0_gives_the_seeing_back(visits):
    r0, scale = visits.r0, 25.0
    width = 0.9759 * 500e-9 / r0 * np.sqrt(1 - 2.183 * (r0 / scale) ** 0.356) / ARCSEC
    np.testing.assert_allclose(width, column("seeingFwhm500"), rtol=1e-4)  # 0.9759 has four digits


def test_r0_of_seeing_by_opsim(write_list):
    """OpSim lets seeing grow as airmass^0.6: r0 is that whose long exposure has this width along the line of sight."""
    visits = read_visit_list(write_list(), airmass_law="opsim")
    growth = (1 / np.sin(visits.altitude)) ** 0.6
    along_sight = visits.r0 / growth
    width = 0.9758634 * 500e-9 / along_sight * np.sqrt(1 - 2.183 * (along_sight / 25.0) ** 0.356) / ARCSEC
    np.testing.assert_allclose(width, column("seeingFwhm500") * growth, rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize(("r0", "scale"), [(0.08, 25.0), (0.15, 25.0), (0.15, 50.0), (0.25, 20.0)])
def test_widths_are_those_of_von_karman_profiles(r0, scale):
    galsim = pytest.importorskip("galsim")
    from pachon.sky.visit_list.seeing import fried_parameter, seeing_width

    width = float(seeing_width(np.array([r0]), np.array([scale]))[0])
    # Tokovinin (2002) states 1 % for his formula, GalSim's is exact.
    assert width / ARCSEC == pytest.approx(galsim.VonKarman(lam=500.0, r0_500=r0, L0=scale).calculateFWHM(), rel=0.015)
    assert fried_parameter(np.array([width]), np.array([scale]))[0] == pytest.approx(r0, rel=1e-9)


def test_a_monitor_measures_r0_itself(write_list):
    visits = read_visit_list(write_list(drop=("seeingFwhm500",), dimm_seeing=[1.01, 1.0, 1.0, 1.0, 1.0]))
    assert visits.r0[0] == pytest.approx(0.98 * 500e-9 / (1.01 * ARCSEC))  # 0.1 m, as Tokovinin (2002) has it
    assert "monitor" in " ".join(visits.remarks)


# ---- formats


def same_visits(visits, expected, *, tolerance=1e-9):
    for name in ("visit", "snaps"):
        np.testing.assert_array_equal(getattr(visits, name), getattr(expected, name))
    assert visits.band.tolist() == expected.band.tolist()
    for name in ("ra", "dec", "roll", "rotator", "altitude", "r0", "exposure", "midpoint", "sky"):
        np.testing.assert_allclose(getattr(visits, name), getattr(expected, name), rtol=tolerance, atol=1e-12)


def test_databases_of_schedulers(visits, write_database):
    new = {name: column(name) for name in COLUMNS}
    same_visits(read_visit_list(write_database("observations", new, "new.db")), visits)
    fourth = {("filter" if name == "band" else name): values for name, values in new.items()}
    same_visits(read_visit_list(write_database("SummaryAllProps", fourth, "fourth.db")), visits)


def test_databases_of_opsim_3_have_radians(visits, write_database):
    names = {
        "obsHistID": "observationId",
        "fieldRA": "fieldRA",
        "fieldDec": "fieldDec",
        "expMJD": "observationStartMJD",
        "visitExpTime": "visitExposureTime",
        "filter": "band",
        "rotTelPos": "rotTelPos",
        "rawSeeing": "seeingFwhm500",
        "filtSkyBrightness": "skyBrightness",
        "night": "night",
    }
    angles = ("fieldRA", "fieldDec", "rotTelPos")
    columns = {key: np.deg2rad(column(name)) if key in angles else column(name) for key, name in names.items()}
    old = read_visit_list(write_database("Summary", columns))
    assert "radians" in old.remarks[0]
    one_snap = visits.rows(visits.snaps == 1)
    same_visits(old.rows(visits.snaps == 1), one_snap)


def test_visits_of_several_proposals_are_one_each(visits, write_list, write_database):
    """The table Summary of OpSim 3 has a row for each visit and proposal; such databases were refused."""
    rows = [0, 0, 1, 2, 2, 2, 3, 4]
    columns = {OLD_NAMES.get(name, name): column(name)[rows] for name in COLUMNS}
    columns |= {"propID": np.array([54, 56, 54, 54, 55, 56, 54, 54]), "altitude": np.full(8, None)}
    path = write_database("Summary", columns)
    merged = read_visit_list(path)
    assert merged.digest == visits.digest
    assert "3 rows repeat visits with equal values, as of several proposals: 5 visits are taken" in merged.remarks
    assert read_visit_list(path, where="propID = 56").visit.tolist() == [1001, 1003]
    with pytest.raises(DomainError, match=r"observationid = 1001: 2 rows, .* once; they differ in fieldra$"):
        read_visit_list(write_list(observationId=[1001, 1001, 3, 4, 5], **dict.fromkeys(SAME, [1.0] * 5)))


OLD_NAMES = {"observationId": "obsHistID", "observationStartMJD": "expMJD"}
SAME = ("fieldDec", "observationStartMJD", "seeingFwhm500", "skyBrightness", "night")


def test_names_of_opsim_3_with_degrees(visits, write_database):
    """Declinations beyond pi/2 can only be degrees, in whatever row, whichever rows are taken."""
    columns = {OLD_NAMES.get(name, name): column(name) for name in COLUMNS}
    path = write_database("observations", columns)
    same_visits(read_visit_list(path), visits)
    low = {
        "fieldRA": np.array([5.0, 53.4, 52.9, 53.2, 53]),
        "fieldDec": np.array([-1.2, -27.5, -28.1, -27.9, 9999.0]),
    }
    one = read_visit_list(write_database("observations", columns | low, "low.db"), where="obsHistID = 1001")
    np.testing.assert_allclose(np.rad2deg([one.ra[0], one.dec[0]]), [5.0, -1.2])
    assert "degrees" in one.remarks[0]


def test_error_of_radians_says_so(write_database):
    """Angles that may be either are radians: what cannot be seen then says what was taken, and what to do."""
    columns = {OLD_NAMES.get(name, name): column(name) for name in COLUMNS}
    columns |= {"fieldRA": np.linspace(0.0, 5.0, 5), "fieldDec": np.full(5, 1.2)}
    with pytest.raises(DomainError, match=r"angles are taken in radians, as of OpSim 3.*rename expMJD") as raised:
        read_visit_list(write_database("observations", columns))
    assert "\n" not in str(raised.value)


def test_columns_of_consdb(visits, write_list):
    renamed = {
        "visit_id": column("observationId"),
        "s_ra": column("fieldRA"),
        "s_dec": column("fieldDec"),
        "exp_midpt_mjd": visits.midpoint,
        "exp_time": column("visitExposureTime"),
        "physical_filter": [f"{band}_57" for band in column("band")],
        "physical_rotator_angle": column("rotTelPos"),
        "zenith_distance": 90 - np.rad2deg(visits.altitude),
        "seeing_zenith_500nm_median": column("seeingFwhm500") / 0.2 / (2 * np.sqrt(2 * np.log(2))),
        "wind_speed": [5.0] * 5,
        "wind_dir": [90.0] * 5,
    }
    listed = read_visit_list(write_list(drop=[name for name in COLUMNS if name != "skyBrightness"], **renamed))
    one_snap = visits.snaps == 1
    same_visits(listed.rows(one_snap), visits.rows(one_snap))
    np.testing.assert_allclose(listed.wind_azimuth, np.pi / 2)


def test_airmass_where_there_is_no_altitude(write_list):
    listed = read_visit_list(write_list(airmass=[1.0, 1.2, 2.0, 0.9996, np.nan]))
    at_place = read_visit_list(write_list())
    np.testing.assert_allclose(1.0 / np.sin(listed.altitude[:4]), [1.0, 1.2, 2.0, 1.0])
    assert listed.altitude[4] == at_place.altitude[4]
    assert any("1 of 5 visits have no altitude" in remark for remark in listed.remarks)
    with pytest.raises(DomainError, match=r"airmass = -1: expected a number from 1"):
        read_visit_list(write_list(airmass=[1.0, -1.0, 2.0, 1.0, 1.5]))
    # Of a list with altitudes it does not matter.
    read_visit_list(write_list(altitude=[50.0] * 5, airmass=[-1.0] * 5))


@pytest.mark.parametrize("ending", [".ecsv", ".fits", ".parquet"])
def test_tables(visits, tmp_path, ending):
    path = tmp_path / f"visits{ending}"
    if ending == ".parquet":
        parquet = pytest.importorskip("pyarrow.parquet")
        import pyarrow

        parquet.write_table(pyarrow.table({name: column(name).tolist() for name in COLUMNS}), path)
    else:
        table = QTable({name: column(name) for name in COLUMNS})
        table["fieldRA"] = table["fieldRA"] * u.deg
        table["fieldDec"] = np.deg2rad(column("fieldDec")) * u.rad
        table["seeingFwhm500"] = column("seeingFwhm500") * 1000 * u.marcsec
        table["visitExposureTime"] = column("visitExposureTime") / 60 * u.min
        Table(table).write(path)
    same_visits(read_visit_list(path), visits)


@pytest.mark.parametrize(
    "spreadsheet",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace(",", ";"),
        lambda text: text.replace(",", "\t"),
        lambda text: "# of a night, by hand\n\n" + text,
    ],
    ids=["byte order mark", "semicolons", "tabs", "comment"],
)
def test_tables_of_spreadsheets(visits, write_list, spreadsheet):
    path = write_list()
    path.write_text(spreadsheet(path.read_text()), encoding="utf-8")
    again = read_visit_list(path)
    assert again.digest == visits.digest
    assert again.visit.tolist() == visits.visit.tolist()


def test_headers_of_instance_catalogues(visits, tmp_path):
    path = tmp_path / "instcat.txt"
    header = {
        "rightascension": 53.25,
        "declination": -27.9,
        "mjd": repr(float(visits.midpoint[3])),
        "altitude": np.rad2deg(visits.altitude[3]),
        "azimuth": np.rad2deg(visits.azimuth[3]),
        "filter": 2,
        "rotskypos": 0.0,
        "rottelpos": 10.0,
        "nsnap": 2,
        "obshistid": 1004,
        "seed": 1,
        "seeing": 0.6,
        "vistime": 32.2,
    }
    lines = ["# made up", *(f"{key} {value}" for key, value in header.items()), "object 1 53.2 -27.9 20 flat"]
    path.write_text("\n".join(lines) + "\n")
    visit = read_visit_list(path)[0]
    expected = visits[3]
    for name in ("visit", "band", "snaps"):
        assert getattr(visit, name) == getattr(expected, name)
    for name in ("ra", "dec", "roll", "rotator", "altitude", "r0", "exposure", "midpoint"):
        assert getattr(visit, name) == pytest.approx(getattr(expected, name), abs=1e-9)


# ---- selection


def test_selection(write_list):
    path = write_list()
    assert read_visit_list(path, where="seeingFwhm500 < 0.9 and band = 'r'").visit.tolist() == [1001, 1002, 1004]
    assert read_visit_list(path, band="i,z").visit.tolist() == [1003, 1005]
    assert read_visit_list(path, night=40).visit.tolist() == [1004]
    # MJD 61001.15 is 2025-11-22T03:36, the night that began on the 21st.
    assert read_visit_list(path, night=20251121).visit.tolist() == [1001, 1002]
    assert read_visit_list(path).day_obs.tolist()[0] == 20251121


def test_a_visit_does_not_depend_on_the_others(write_list):
    all_visits, one = read_visit_list(write_list()), read_visit_list(write_list(), where="observationId = 1004")
    assert repr(one[0]) == repr(all_visits[3])  # NaN included


@pytest.mark.parametrize(
    "where",
    [
        "nosuch < 1",
        "seeing <",
        "1) UNION SELECT * FROM visits WHERE (1",
        "(SELECT count(*) FROM sqlite_master) > 0",
        "1; DROP TABLE visits",
        "load_extension('x')",
        "__import__('os').system('true')",
    ],
)
def test_a_condition_can_only_read_columns(write_list, where):
    with pytest.raises(ConfigError, match="expected a condition on its columns"):
        read_visit_list(write_list(), where=where)


@pytest.mark.parametrize("where", ['"nosuch" > 1', 'observationId > 0 AND "no""such" > 1', '/* " */ "nosuch" > 1 -- "'])
def test_a_name_in_double_quotes_is_that_of_a_column(write_list, where):
    """SQLite takes one that no column has for a text, which is greater than any number."""
    with pytest.raises(ConfigError, match=r"no such column: no.?such; expected .*, observationstartmjd"):
        read_visit_list(write_list(), where=where)
    columns_and_text = """ "observationId" = 1004 AND '"nosuch"' < "band" COLLATE "nocase" -- "nosuch" """
    assert read_visit_list(write_list(), where=columns_and_text).visit.tolist() == [1004]


def test_a_database_is_not_changed(write_database):
    path = write_database("observations", {name: column(name) for name in COLUMNS})
    before = path.read_bytes()
    read_visit_list(path, where="band = 'r'")
    with pytest.raises(ConfigError):
        read_visit_list(path, where="1); DELETE FROM observations; SELECT (1")
    assert path.read_bytes() == before


# ---- the angle of the camera on the sky


def test_without_rottelpos_it_follows_from_the_camera(visits, write_list):
    q = np.rad2deg(visits.zenith_position_angle)
    lsstcam = write_list("lsstcam.csv", drop=("rotTelPos",), rotSkyPos=(q - column("rotTelPos") - 90) % 360)
    comcam = write_list("comcam.csv", drop=("rotTelPos",), rotSkyPos=(q - column("rotTelPos")) % 360)
    for path, camera in ((lsstcam, "lsst"), (comcam, "comcam")):
        listed = read_visit_list(path, camera=camera)
        np.testing.assert_allclose(listed.rotator, visits.rotator, atol=1e-9)
        assert "no rotTelPos" in " ".join(listed.remarks)


def test_visits_without_rottelpos_beside_others(visits, write_list):
    sky = (np.rad2deg(visits.zenith_position_angle) - column("rotTelPos") - 90) % 360
    mixed = changed("rotTelPos", slice(2), ["", ""])
    listed = read_visit_list(write_list(rotSkyPos=sky, **mixed))
    np.testing.assert_allclose(listed.rotator, visits.rotator, atol=1e-9)
    assert "2 of 5 visits have no rotTelPos: it is q - rotSkyPos - 90 deg, as of LSSTCam" in listed.remarks
    assert any("rotTelPos is taken" in remark for remark in listed.remarks)
    with pytest.raises(DomainError, match="visit 1002: rottelpos = nothing: expected a finite angle"):
        read_visit_list(write_list(rotSkyPos=[sky[0], "", *sky[2:]], **mixed))


@pytest.mark.parametrize(
    ("sign", "offset", "name"), [(-1, -90, "LSSTCam"), (-1, 0, "ComCam"), (1, 0, "imSim's first lists")]
)
def test_the_convention_is_named_and_rottelpos_trusted(visits, write_list, sign, offset, name):
    q = np.rad2deg(visits.zenith_position_angle)
    # A scheduler's parallactic angle lacks precession, half a degree here.
    sky = -sign * (q + 0.5) + sign * column("rotTelPos") + offset
    listed = read_visit_list(write_list(rotSkyPos=sky % 360, paraAngle=q + 0.5))
    np.testing.assert_allclose(np.rad2deg(listed.rotator), column("rotTelPos"), atol=1e-9)
    assert any(name in remark and "0.5 deg" in remark and "rotTelPos is taken" in remark for remark in listed.remarks)


def test_no_convention_is_said(write_list):
    listed = read_visit_list(write_list(rotSkyPos=[10, 200, 77, 150, 310]))
    assert any("no convention" in remark for remark in listed.remarks)


def test_altitudes_that_do_not_fit_are_said(visits, write_list):
    altitude = np.rad2deg(visits.altitude)
    altitude[1] -= 3.0
    listed = read_visit_list(write_list(altitude=altitude))
    assert any("visit 1002 by 3.0 deg" in remark for remark in listed.remarks)
    np.testing.assert_allclose(np.rad2deg(listed.altitude), altitude)
    altitude[1] += 3.0
    assert read_visit_list(write_list(altitude=altitude)).remarks == ()


def test_filters_of_hsc(write_list):
    filters = ["HSC-G", "HSC-R2", "HSC-I2", "HSC-Z", "HSC-Y"]
    listed = read_visit_list(write_list(drop=["band"], physical_filter=filters))
    assert listed.band.tolist() == ["g", "r", "i", "z", "y"]
    with pytest.raises(DomainError, match="physical_filter = NB0921: expected one of u, g, r, i, z, y"):
        read_visit_list(write_list(drop=["band"], physical_filter=[*filters[:4], "NB0921"]))


# ---- bad input


@pytest.mark.parametrize(
    ("drop", "looked_for"),
    [
        ("fieldRA", "fieldra, ra, s_ra, rightascension"),
        ("observationStartMJD", "exp_midpt_mjd"),
        ("visitExposureTime", "visitexposuretime"),
        ("band", "physical_filter"),
        ("seeingFwhm500", "seeingfwhm500"),
        ("rotTelPos", "rottelpos"),
    ],
)
def test_a_column_that_is_needed(write_list, drop, looked_for):
    with pytest.raises(ProductError, match=looked_for) as error:
        read_visit_list(write_list(drop=(drop,)))
    assert "columns are" in str(error.value)
    assert str(error.value).count("\n") == 0


def changed(name, index, value):
    values = column(name).astype(object)
    values[index] = value
    return {name: values.tolist()}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (changed("observationId", 1, 1001), "observationid = 1001: 2 rows, expected each visit once"),
        (changed("seeingFwhm500", 2, ""), "visit 1003: seeingfwhm500 = nothing: expected a width above 0"),
        (changed("seeingFwhm500", 2, 0.02), "visit 1003: seeing = 0.02 arcsec: expected at least 0.0401 arcsec"),
        (changed("band", 4, "w"), "visit 1005: band = w: expected one of u, g, r, i, z, y"),
        (changed("band", 4, "gr"), "visit 1005: band = gr: expected one of u, g, r, i, z, y"),
        (changed("fieldDec", 0, 70.0), "visit 1001: altitude = -1"),
        (changed("fieldDec", 0, 95.0), "visit 1001: fielddec = 95 deg: expected -90 to 90 deg"),
        (changed("visitExposureTime", 0, -3.0), "visit 1001: visitexposuretime = -3 s: expected a time above 0 s"),
        (changed("numExposures", 1, 1.5), "visit 1002: numexposures = 1.5: expected a whole number"),
        (changed("numExposures", 1, -1), "visit 1002: numexposures = -1: expected a whole number"),
        (changed("observationId", 1, 3.5), "expected whole numbers from 0"),
        (changed("observationId", 1, 1e20), "column observationid, row 2: 1e+20: expected whole numbers from 0"),
        (changed("fieldRA", 1, "12h"), "column fieldra, row 2: '12h': expected a number"),
        (changed("fieldRA", 1, "inf"), "visit 1002: fieldra = inf deg: expected a finite angle"),
        (changed("skyBrightness", 2, 0), "visit 1003: skybrightness = 0 mag: expected 5 to 35 mag"),
        (changed("seeingFwhm500", slice(5), [3e-6] * 5), "its median is 3e-06 arcsec: expected widths in arcsec"),
        ({"outer_scale": [20, 20, -20, 20, 20]}, "visit 1003: outer_scale = -20 m: expected a length above 0 m"),
        ({"outer_scale": [20, 20, "inf", 20, 20]}, "visit 1003: outer_scale = inf m: expected a length above 0 m"),
        ({"weight": [1, 0, -1, 1, 1]}, "visit 1002: weight = 0: expected a weight above 0; 2 of 5 visits are so"),
        ({"epoch": [1, 2, 2.5, 3, 4]}, "visit 1003: epoch = 2.5: expected a whole number from 0"),
        ({"wind_speed": [1, -2, 1, 1, 1]}, "visit 1002: wind_speed = -2 m/s: expected a speed from 0 m/s"),
    ],
)
def test_values_that_cannot_be(write_list, changes, message):
    with pytest.raises(DomainError) as error:
        read_visit_list(write_list(**changes))
    assert message in str(error.value)
    assert "visits.csv" in str(error.value)


def test_what_a_visit_leaves_open(write_list):
    columns = {name: [7, "", 8, 9, 10] for name in ("epoch", "outer_scale", "weight", "wind_speed")}
    visits = read_visit_list(write_list(**columns))
    assert visits.epoch.tolist() == [7, 1002, 8, 9, 10]
    assert visits.outer_scale.tolist() == [7.0, 25.0, 8.0, 9.0, 10.0]
    assert np.isnan([visits.weight[1], visits.wind_speed[1]]).all()
    assert any(
        remark.startswith("1 of 5 visits without a weight have the inverse variance") for remark in visits.remarks
    )


def test_snaps_of_an_instance_catalogue_take_time(tmp_path):
    path = tmp_path / "instcat.txt"
    header = "rightascension 53\ndeclination -28\nmjd 61001.2\nfilter 2\nrottelpos 1\nseeing 0.7\nobshistid 7\n"
    path.write_text(header + "nsnap 12\nvistime 33\n")
    with pytest.raises(DomainError, match="visit 7: vistime = 33 s: expected more than 33 s between 12 snaps"):
        read_visit_list(path)


@pytest.mark.parametrize("kind", ["decimal", "mapping", "time of day", "long whole number", "list"])
def test_columns_of_other_types(visits, tmp_path, kind):
    """What no visit needs does not matter; decimals are numbers."""
    parquet = pytest.importorskip("pyarrow.parquet")
    import pyarrow

    value = {"decimal": Decimal("1.5"), "mapping": {"a": 1}, "time of day": datetime.time(1, 2), "list": [1, 2],
             "long whole number": np.uint64(2**63 + 5)}[kind]  # fmt: skip
    columns = {name: column(name).tolist() for name in COLUMNS} | {"other": [value] * 5}
    columns["fieldRA"] = [Decimal(str(ra)) for ra in column("fieldRA")]
    path = tmp_path / "visits.parquet"
    parquet.write_table(pyarrow.table(columns), path)
    same_visits(read_visit_list(path), visits)


def test_names_that_differ_in_capitals(visits, write_list):
    """The column in small letters is taken, whatever the order; of others none."""
    both = dict(ra=column("fieldRA"), RA=[0.0] * 5)
    for columns in (both, dict(reversed(both.items()))):
        assert read_visit_list(write_list(drop=("fieldRA",), **columns)).digest == visits.digest
    with pytest.raises(ProductError, match=r"visits\.csv: columns RA and Ra: expected names that differ in more than"):
        read_visit_list(write_list(RA=[0.0] * 5, Ra=[0.0] * 5))


@pytest.mark.parametrize(("scale", "form"), [("utc", "isot"), ("tai", "mjd"), ("tdb", "jd")])
def test_times_of_fits(visits, tmp_path, scale, form):
    """Coordinates by the FITS standard, as astropy writes times; lists with them were said to have no time."""
    table = QTable({name: column(name) for name in COLUMNS})
    times = getattr(Time(column("observationStartMJD"), format="mjd", scale="tai"), scale)
    table["observationStartMJD"] = Time(times, format=form)
    path = tmp_path / "visits.fits"
    table.write(path)
    # A microsecond, by which TDB is that of no place on the Earth.
    same_visits(read_visit_list(path), visits, tolerance=1e-9)


def test_times_and_positions_of_astropy(visits, tmp_path):
    table = QTable({name: column(name) for name in COLUMNS})
    table["observationStartMJD"] = Time(column("observationStartMJD"), format="mjd", scale="tai").utc
    table["target"] = SkyCoord(column("fieldRA") * u.deg, column("fieldDec") * u.deg)
    path = tmp_path / "visits.ecsv"
    table.write(path)
    same_visits(read_visit_list(path), visits)


@pytest.mark.parametrize(
    ("name", "unit", "message"),
    [
        ("fieldRA", "furlong", "column fieldra in furlong: expected a unit such as deg"),
        ("fieldRA", "", "column fieldra in pure numbers: expected a unit such as deg"),
        ("seeing_zenith_500nm_median", "arcsec", "seeing_zenith_500nm_median in arcsec: expected a unit such as pixel"),
    ],
)
def test_units_that_cannot_be(tmp_path, name, unit, message):
    table = Table({key: column(key) for key in COLUMNS})
    table.rename_column("seeingFwhm500", "seeing_zenith_500nm_median")
    table[name].unit = u.dimensionless_unscaled if unit == "" else u.Unit(unit, parse_strict="silent")
    path = tmp_path / "visits.ecsv"
    table.write(path)
    with pytest.raises(DomainError, match=message):
        read_visit_list(path)


def test_columns_that_are_not_taken_may_have_anything(visits, write_list):
    listed = read_visit_list(write_list(paraAngle=["12d30m"] * 5))
    assert listed.digest == visits.digest


def test_small_outer_scales_allow_less(write_list):
    with pytest.raises(DomainError, match=r"expected at least .* with an outer scale of 1 m"):
        read_visit_list(write_list(outer_scale=[1.0] * 5))


def test_selections_without_a_visit(write_list):
    for options, wanted in (
        ({"where": "band = 'u'"}, "with band = 'u'"),
        ({"band": "u"}, "of band u"),
        ({"night": 0}, "of night 0"),
        ({"night": 20200101}, "of night 20200101"),
    ):
        with pytest.raises(DomainError, match=f"no visit {wanted}: "):
            read_visit_list(write_list(), **options)
    with pytest.raises(ConfigError, match="expected a date"):
        read_visit_list(write_list(), night=20251399)


def test_files_that_are_no_list(tmp_path, write_database):
    text = tmp_path / "notes.txt"
    text.write_text("these are words\n")
    with pytest.raises(ProductError, match="no list of visits"):
        read_visit_list(text)
    with pytest.raises(ProductError, match="cannot be read"):
        read_visit_list(tmp_path / "none.db")
    words = tmp_path / "words.csv"
    words.write_text("these are words\n1\n")
    with pytest.raises(ProductError, match=r"no column of the .*: expected one of .*; columns are these are words"):
        read_visit_list(words)
    two = tmp_path / "two.db"
    with closing(sqlite3.connect(two)) as connection:
        connection.execute("CREATE TABLE a (ra)")
        connection.execute("CREATE TABLE b (ra)")
    with pytest.raises(ProductError, match=r"no table of visits: expected observations, .*; tables are a, b"):
        read_visit_list(two)
    broken = tmp_path / "broken.db"
    broken.write_bytes(b"SQLite format 3\x00" + bytes(200))
    with pytest.raises(ProductError, match="cannot be read"):
        read_visit_list(broken)
