import dataclasses
import math
import re
from pathlib import Path

import pytest

from pachon.core.errors import PrescriptionError, UnknownNameError
from pachon.models.io.site_file import BUNDLED, DATA, load_site

TEXT = (DATA / "cerro_pachon.yaml").read_text()
DOCS = Path(__file__).parents[2] / "docs"


def test_cerro_pachon_has_the_figures_of_the_paper():
    # Jee & Tyson (2011), section 3, after Ellerbroek (2002); weather of section 2.
    site = load_site("cerro_pachon")
    assert site.altitudes == (0.0, 2580.0, 5160.0, 7730.0, 12890.0, 15460.0)
    assert site.weights == (0.652, 0.172, 0.055, 0.025, 0.074, 0.022)
    assert sum(site.weights) == pytest.approx(1.0, abs=1e-12)
    assert site.r0 == 0.16
    assert site.outer_scale == 25.0
    assert max(site.wind_speeds) == site.wind_speeds[-1] == 20.0
    assert list(site.wind_speeds) == sorted(site.wind_speeds)
    assert (site.weather.pressure_mmhg, site.weather.temperature_c, site.weather.water_vapour_mmhg) == (520, 5, 8)
    assert BUNDLED == ("cerro_pachon", "cerro_tololo", "maunakea")
    assert site.wind_directions == (None,) * 6


def test_a_layer_may_have_a_wind_direction(tmp_path):
    path = tmp_path / "site.yaml"
    path.write_text(TEXT.replace("wind_speed: 8.0", "wind_speed: 8.0, wind_direction_deg: -90"))
    assert load_site(path).wind_directions == (None, -math.pi / 2, None, None, None, None)


def test_the_site_file_of_the_docs_has_every_key(tmp_path):
    page = (DOCS / "howto" / "running.md").read_text()
    block = re.search(r"```yaml\n(# my_site.yaml.*?)```", page, flags=re.S).group(1)
    path = tmp_path / "my_site.yaml"
    path.write_text(block)
    site = load_site(path)
    assert len(site.altitudes) == 3
    assert site.wind_directions == (math.pi / 2, None, None)
    assert (site.name, site.r0, site.outer_scale) == ("my_site", 0.13, 30.0)
    # All that the loader allows stands in the example.
    for key in ("description", "source", "units", "layers", "weather", "wind_direction_deg", "water_vapour_mmhg"):
        assert f"{key}:" in block


def test_sites_made_in_python_are_checked_too():
    site = load_site("cerro_pachon")
    for key, value, expected in (
        ("weights", (math.nan,) * 6, "weights = (nan"),
        ("wind_speeds", (math.inf,) * 6, "wind_speeds = (inf"),
        ("altitudes", (0.0, 1.0, 2.0, 3.0, 4.0, math.nan), "altitudes = (0.0"),
        ("wind_directions", (math.nan,) * 6, "wind_directions = (nan"),
        ("wind_directions", (0.0,), "expected an altitude, weight and wind for each"),
    ):
        with pytest.raises(PrescriptionError, match=re.escape(expected)):
            dataclasses.replace(site, **{key: value})


def test_unknown_and_missing_sites():
    with pytest.raises(UnknownNameError, match="unknown site 'cerro_pachom': did you mean cerro_pachon"):
        load_site("cerro_pachom")
    with pytest.raises(PrescriptionError, match="no such file"):
        load_site("nowhere.yaml")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("r0: 0.16 ", "r0: -1 ", "r0 = -1: expected a positive number"),
        ("r0: 0.16 ", "r: 0.16 ", "unknown key r = 0.16"),
        ("r0: m,", "r0: cm,", "units.r0 = 'cm': expected one of m"),
        ("weight: 0.652", "weight: 0.9", "weights = (0.9, 0.172, 0.055, 0.025, 0.074, 0.022): expected fractions"),
        ("weight: 0.652", "weight: 0.9", "from 0 that sum to 1, not 1.248"),
        ("weight: 0.022", "weight: -0.022", "expected fractions from 0"),
        (
            "wind_speed: 5.0",
            "wind_speed: 5.0, wind_direction_deg: east",
            "wind_direction_deg = 'east': expected a number",
        ),
        ("weight: 0.652", "wait: 0.9", "unknown key layers[0.0].wait = 0.9: did you mean weight?"),
        ("wind_speed: 5.0", "wind_speed: -5", "wind_speeds = "),
        ("altitude: 2580.0", "altitude: 9000", "altitudes = "),
        ("pressure_mmhg: 520.0", "pressure_mmhg: 0", "pressure_mmhg = 0.0: expected a positive number"),
        ("temperature_c: 5.0", "temperature_c: -300", "temperature_c = -300.0: expected above -273.15"),
        ("water_vapour_mmhg: 8.0", "water_vapour_mmhg: 600", "water_vapour_mmhg = 600.0: expected 0 to the pressure"),
    ],
)
def test_malformed_sites_are_one_line(tmp_path, old, new, expected):
    assert old in TEXT
    path = tmp_path / "site.yaml"
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(PrescriptionError) as caught:
        load_site(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
