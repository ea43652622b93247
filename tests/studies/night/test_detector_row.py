"""Rows of the table of visits and detectors: formulas of SMTN-002 and of tensors, restated."""

import math
import sys

import numpy as np
import pytest
from astropy.table import QTable, Table

import pachon
from pachon.core.errors import ConfigError
from pachon.core.units import ARCSEC
from pachon.models.camera.cameras import load_camera
from pachon.pipeline.config import configuration_of
from pachon.pipeline.listed_visit import ground_wind, telescope_of_band, visit_cards, visit_experiment
from pachon.pipeline.simulate.photometry import limiting_magnitude, saturation_magnitude
from pachon.sky.sky_shapes import along_sky
from pachon.sky.visit_list.visit_list import ListedVisit
from pachon.studies.night import detector_row
from pachon.studies.night.night_files import write_named_table
from pachon.studies.night.sky_pixels import interpolated


def listed(**changes):
    values = dict(visit=7, band="r", ra=0.9, dec=-0.5, roll=2.0, zenith_position_angle=2.0, rotator=0.3, altitude=1.0,
                  azimuth=4.0, midpoint=61000.25, exposure=30.0, snaps=2, r0=0.13, outer_scale=25.0,
                  wind_speed=math.nan, wind_azimuth=math.nan, sky=20.7, epoch=7, weight=math.nan)  # fmt: skip
    return ListedVisit(**(values | changes))


@pytest.fixture(scope="module")
def experiment():
    run = {"ccds": ["R22_S11"], "psf": {"engine": "long_exposure"}}
    return visit_experiment(configuration_of(run, "test"), listed())


@pytest.mark.parametrize(("name", "angle"), [("lsst", 0.0), ("lsst", 33.0), ("decam", 0.0)])
def test_moments_along_pixels(name, angle):
    camera = load_camera(name).turned(angle)
    sigma, g1, g2 = 1.7, 0.11, -0.23
    # A tensor of axes a > b: (a - b)/(a + b) = |g|, sqrt(a b) = sigma, at half the angle of g.
    g = math.hypot(g1, g2)
    a, b = sigma * math.sqrt((1 + g) / (1 - g)), sigma * math.sqrt((1 - g) / (1 + g))
    phi = 0.5 * math.atan2(g2, g1)
    turn = np.array([[math.cos(phi), -math.sin(phi)], [math.sin(phi), math.cos(phi)]])
    tensor = turn @ np.diag([a**2, b**2]) @ turn.T
    # The Jacobian of the map from the focal plane to pixels, by differences.
    center, step = camera.centers[3], 1e-4
    shifts = np.array([[step, 0.0], [0.0, step]])
    jacobian = (camera.to_pixel(3, center + shifts) - camera.to_pixel(3, center)).T / step * camera.pixel_size
    expected = jacobian @ tensor @ jacobian.T
    xx, yy, xy = detector_row.moments_along_pixels(camera, 3, *(np.array([v]) for v in (sigma, g1, g2)))
    np.testing.assert_allclose([xx[0], yy[0], xy[0]], [expected[0, 0], expected[1, 1], expected[0, 1]], atol=1e-8)


def test_photometry_of_a_visit(experiment):
    """SMTN-002: zero point 28.36, extinction 0.13, 8.8 electrons of read noise, r band."""
    airmass = 1 / math.sin(1.0)
    columns = detector_row.noise_columns(experiment, 0.98)
    zero_point = 28.36 - 0.13 * (airmass - 1) + 2.5 * math.log10(30 * 0.98)
    assert columns["zeroPoint"] == pytest.approx(zero_point)
    # Vignetting dims the sky as it does stars.
    sky = 0.98 * 30 * 0.04 * 10 ** (0.4 * (28.36 + 0.13 - 20.7))
    assert columns["skyBg"] == pytest.approx(sky)
    variance = sky + 2 * 8.8**2 + 0.2 * 30
    assert columns["skyNoise"] == pytest.approx(math.sqrt(variance))
    assert columns["weight"] == pytest.approx(1 / (variance * 10 ** (0.8 * (31.4 - zero_point))))


def test_a_configuration_of_a_visit_starts_another(experiment):
    """The two snaps of the first were in its read noise and full well again: 17.6 e for 12.4, of one snap 12.4."""
    for snaps in (2, 1):
        again, first = (
            visit_experiment(config, listed(snaps=snaps)).config.photometry
            for config in (experiment.config, configuration_of({"ccds": ["R22_S11"]}, "test"))
        )
        assert again.read_noise_e == pytest.approx(first.read_noise_e, rel=1e-14)
        assert again.full_well_e == pytest.approx(first.full_well_e, rel=1e-14)


@pytest.mark.parametrize("given", [{}, {"brightest": 16.0}])
def test_limits_of_a_catalogue_are_those_of_the_sky_and_snaps(tmp_path, given):
    """They were those of a dark sky and one snap."""
    magnitudes = np.linspace(14.0, 26.0, 60)
    table = Table({"x_m": np.linspace(-0.01, 0.01, 60), "y_m": np.full(60, 0.003), "mag": magnitudes})
    table.write(tmp_path / "stars.csv")
    stars = {"catalogue": str(tmp_path / "stars.csv"), **given}
    of_visit = visit_experiment(configuration_of({"ccds": ["R22_S11"], "stars": stars}, "test"), listed(sky=18.0))
    width = 0.6 * ARCSEC
    bright = given.get("brightest", saturation_magnitude(of_visit.band, 30.0, width))
    faint = limiting_magnitude(30.0, of_visit.band, 30.0, width)
    expected = magnitudes[(magnitudes >= bright) & (magnitudes <= faint)]
    np.testing.assert_allclose(np.sort(of_visit.star_list.on("R22_S11")[1]), expected)


def test_limiting_magnitude_has_a_signal_to_noise_of_5(experiment):
    columns = detector_row.noise_columns(experiment, 1.0)
    limit = detector_row.limiting_magnitude(experiment, 42.0, columns["skyBg"], columns["zeroPoint"])
    counts = 10 ** (0.4 * (columns["zeroPoint"] - limit))
    assert counts / math.sqrt(counts + 42.0 * (columns["skyBg"] + 2 * 8.8**2)) == pytest.approx(5.0)


def test_effective_time(experiment):
    columns = detector_row.noise_columns(experiment, 1.0)
    airmass = 1 / math.sin(1.0)
    sigma = 0.9
    time = detector_row.effective_time(experiment, sigma, columns["skyBg"], columns["zeroPoint"], airmass)
    # Half the sky of 21.2 mag is twice the time; FWHM 0.73" is a sigma of 1.55 pixels.
    sky = 10 ** (0.4 * (20.7 - 21.2))
    seeing = (0.73 / 0.2 / (2 * math.sqrt(2 * math.log(2))) / sigma) ** 2
    assert time == pytest.approx(30.0 * seeing * sky * 10 ** (-0.8 * 0.13 * (airmass - 1)))
    nominal = visit_experiment(experiment.config, listed(altitude=math.pi / 2, sky=21.2, snaps=1))
    columns = detector_row.noise_columns(nominal, 1.0)
    sigma = 0.73 / 0.2 / (2 * math.sqrt(2 * math.log(2)))
    time = detector_row.effective_time(nominal, sigma, columns["skyBg"], columns["zeroPoint"], 1.0)
    assert time == pytest.approx(30.0)


@pytest.mark.parametrize(("band", "dark", "fwhm"), [("g", 22.04, 0.77), ("z", 18.46, 0.69)])
def test_effective_time_under_the_dark_sky_of_another_camera(band, dark, fwhm):
    """As long as the exposure in nominal seeing at the zenith; DECam's dark sky in z is 1.15 mag above the LSST's."""
    run = {"telescope": "decam", "ccds": ["N4"], "psf": {"engine": "long_exposure"}}
    visit = listed(band=band, altitude=math.pi / 2, sky=dark, snaps=1)
    nominal = visit_experiment(configuration_of(run, "test"), visit)
    columns = detector_row.noise_columns(nominal, 1.0)
    sigma = fwhm * ARCSEC / nominal.band.pixel_scale / (2 * math.sqrt(2 * math.log(2)))
    time = detector_row.effective_time(nominal, sigma, columns["skyBg"], columns["zeroPoint"], 1.0)
    assert time == pytest.approx(30.0)


@pytest.mark.parametrize("count", [4, 8, 30])
def test_shapes_of_maps_at_the_pole(count):
    """The axes of the sky turn within a CCD there: a polynomial of shapes along them was wrong by up to twice g."""
    camera, rng = load_camera("lsst"), np.random.default_rng(5)
    xy, at = (camera.from_pixel(94, rng.uniform(0.0, 4095.0, (n, 2))) for n in (count, 20))
    g1, g2 = np.full((2, count), [[0.1], [0.03]])
    places = detector_row.PlaceShapes(xy=xy, sigma=np.full(count, 2.0), g1=g1, g2=g2, area=np.full(count, 40.0))
    longitudes = np.arctan2(*(at - camera.centers[94]).T)
    cosine, sine = np.cos(longitudes), np.sin(longitudes)
    jacobians = np.stack([cosine, -sine, sine, cosine], axis=1).reshape(-1, 2, 2)
    expected = [np.full(20, 2.0), *along_sky(np.full(20, 0.1), np.full(20, 0.03), jacobians), np.full(20, 40.0)]
    np.testing.assert_allclose(interpolated(camera, 94, places, jacobians, at).T, expected, rtol=1e-12)


@pytest.mark.parametrize("altitude", [0.7, 1.1, 1.5])
def test_wind_on_the_pupil(altitude):
    """Projections of the wind on the axes of the telescope, with vectors towards east, north and up."""
    azimuth, source = 4.0, 1.1
    visit = listed(altitude=altitude, azimuth=azimuth, wind_speed=7.0, wind_azimuth=source)
    wind = -7.0 * np.array([math.sin(source), math.cos(source), 0.0])  # it blows from its azimuth

    def towards(az, alt):
        return np.array([math.sin(az) * math.cos(alt), math.cos(az) * math.cos(alt), math.sin(alt)])

    z = towards(azimuth, altitude)
    y = np.array([0, 0, 1.0]) - z * z[2]
    y /= np.linalg.norm(y)
    x = np.cross(y, z)
    np.testing.assert_allclose(ground_wind(visit), [wind @ x, wind @ y], atol=1e-12)
    if altitude < 1.2:
        return  # an experiment takes a while
    config = visit_experiment(configuration_of({"ccds": ["R22_S11"]}, "test"), visit)
    np.testing.assert_allclose(config.atmosphere.velocities[0], [wind @ x, wind @ y], atol=1e-9)


def test_the_zenith_lies_towards_y(experiment):
    assert experiment.zenith_direction == pytest.approx(math.pi / 2)
    assert experiment.config.rotator_deg == pytest.approx(math.degrees(0.3))
    assert experiment.atmosphere.r0 == pytest.approx(0.13 * math.sin(1.0) ** 0.6)


def test_cards_of_headers(experiment):
    cards = {key: value for key, value, _ in visit_cards(experiment, "R22_S11")}
    assert (cards["INSTRUME"], cards["DETECTOR"], cards["VISIT"]) == ("LSSTCam", 94, 7)  # 94 of obs_lsst
    assert cards["TIMESYS"] == "TAI"
    # MJD 61000.25 is 2025-11-21T06:00; half of 30 s and of 2 s between the snaps before.
    assert cards["DATE-AVG"] == "2025-11-21T06:00:00.000"
    assert cards["DATE-OBS"] == "2025-11-21T05:59:44.000"
    assert cards["MJD-OBS"] == pytest.approx(61000.25 - 16 / 86400, abs=1e-9)
    assert visit_cards(pachon.Experiment.from_config(pachon.Configuration(ccds=("R22_S11",))), "R22_S11") == []


def test_telescopes_of_bands(tmp_path):
    assert telescope_of_band(None, "i") is None
    assert telescope_of_band("rubin_v3.14_r", "z") == "rubin_v3.14_z"
    assert telescope_of_band("decam", "i") == "decam"
    with pytest.raises(ConfigError, match="comcam_r: has no band i; expected visits in its band r"):
        telescope_of_band("comcam_r", "i")
    for band in "ri":
        (tmp_path / f"mine_{band}.yaml").write_text("")
    assert telescope_of_band("mine_r.yaml", "i", tmp_path) == "mine_i.yaml"
    with pytest.raises(ConfigError, match="has no band g"):
        telescope_of_band("mine_r.yaml", "g", tmp_path)


def test_tables_without_a_writer_of_parquet(tmp_path, monkeypatch):
    columns = {"psfIxx": (np.array([1.5, 2.0]), "pixel2", "moment"), "band": (np.array(["r", "i"]), "", "band")}
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    write_named_table(tmp_path / "visit_detector", columns, {"seed": 1})
    table = QTable.read(tmp_path / "visit_detector.ecsv")
    np.testing.assert_allclose(table["psfIxx"].to_value("pixel2"), [1.5, 2.0])
    assert table["band"].tolist() == ["r", "i"]
