"""The design report: a prescription in the unit and signs of lens design, first-order data, one page in one file."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.design.report import report, sections
from pachon.design.report.prescription_table import first_order_rows, prescription_rows
from pachon.models.shapes.freeform import Toroid
from pachon.models.shapes.shape import EvenAsphere, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM

DATA = Path(__file__).parents[1] / "data" / "zmx"


class Reader(HTMLParser):
    """Collect references, and check that every element that opens closes."""

    def __init__(self):
        super().__init__()
        self.open, self.references, self.ids = [], [], set()

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.references += [v for k, v in attrs if k in ("src", "href")]
        self.ids |= {attributes["id"]} if "id" in attributes else set()
        if tag not in ("img", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def check(page):
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    for reference in reader.references:
        assert reference.startswith("data:image/") or (reference.startswith("#") and reference[1:] in reader.ids)
    assert "http" not in re.sub(r"data:image/[^\"]+", "", page)


@pytest.fixture(scope="module")
def folded(paraboloid):
    """A Newtonian whose flat is in the path: its surfaces do not share an axis."""
    telescope = paraboloid(2.0, 10.0)
    half = np.sqrt(0.5)
    turned = ((1, 0, 0), (0, half, -half), (0, half, half))
    flat = Surface("flat", Interaction.MIRROR, Plane(), (0.0, 0.0, 1.8), VACUUM, rotation=turned)
    aside = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
    end = replace(telescope.surfaces[1], vertex=(0.0, 0.2, 1.8), rotation=aside)
    return replace(telescope, surfaces=(telescope.surfaces[0], flat, end))


def test_the_prescription_is_in_the_signs_of_lens_design(paraboloid):
    mirror = EvenAsphere(4.0, -1.0, (1e-6, -2e-9))
    telescope = paraboloid(2.0, 10.0)
    telescope = replace(telescope, surfaces=(replace(telescope.surfaces[0], shape=mirror), telescope.surfaces[1]))
    assert telescope.length_unit == ("mm", 1e-3)
    assert replace(telescope, pupil_diameter=1.0).length_unit == ("m", 1.0)
    first, last = prescription_rows(telescope, 5e-7, {"mirror": 0.1, "detector": 0.02})
    # A concave mirror at the start: radius and thickness negative; a4 = 1e-6 /m^3 is 1e-15 /mm^3.
    assert first[:7] == ["mirror", "mirror", "-4000", "-2000", "mirror", "", "100"]
    assert first[7:] == ["-1", "r^4: -1e-15; r^6: 2e-24"]
    assert last[2:4] == ["flat", ""]


def test_a_lens_has_its_glass(paraboloid):
    rows = prescription_rows(pachon.models.doublet(), 587.5618e-9, {})
    assert [row[4] for row in rows] == ["N-BK7", "F2", "", ""]
    assert float(rows[0][5]) == pytest.approx(1.5168, abs=1e-4)
    assert float(rows[0][2]) > 0 > float(rows[1][2])


def test_first_order_data(paraboloid):
    found = dict(first_order_rows(paraboloid(2.0, 10.0), 5e-7))
    assert found["effective focal length"] == "2000 mm"
    assert found["focal ratio"] == "f/10"
    # Of one mirror, the focal length.
    assert found["Petzval radius"] == "2000 mm"
    assert found["plate scale"] == f"{np.rad2deg(1e-3 / 2.0) * 3600:.6g} arcsec/mm"


@pytest.mark.long
def test_a_page_without_most_sections(folded, monkeypatch):
    chosen = [s for s in sections.SECTIONS if s.title in ("Seidel diagram", "Strehl ratio", "Chromatic focal shift")]
    monkeypatch.setattr(report, "SECTIONS", chosen)
    steps = []
    page = pachon.design_report(folded, [(0.0, 0.0)], progress=steps.append)
    assert steps == [1] * 4
    check(page)
    assert "axis tilted by 45°" in page
    # A flat costs neither first-order data nor Seidel sums.
    assert re.search(r"effective focal length.*2000 mm", page, re.DOTALL)
    assert page.count("<img") == 3
    # A paraboloid has a point for an image on its axis.
    assert page.index('<p class="verdict">Its spots have ') < page.index("<img") < page.index("<table")
    off_axis = replace(folded, surfaces=(folded.surfaces[0].moved(shift=(0.1, 0.0, 0.0)), *folded.surfaces[1:]))
    # Seidel sums need a common axis: the report says so.
    page = pachon.design_report(off_axis, [(0.0, 0.0)])
    assert re.search(r"Seidel diagram: surface \w+ of paraboloid: expected one on the axis", page)


@pytest.mark.long
def test_analyses_of_one_wavelength_take_the_primary_one_of_a_lens_file(request):
    lens = pachon.load_telescope(request.config.rootpath / "tests/data/zmx/lens1.zmx")
    assert len(lens.design_data.wavelengths) == 3
    primary = lens.default_wavelength
    assert np.array_equal(
        pachon.design.seidel_diagram(lens).coefficients, pachon.design.seidel_diagram(lens, primary).coefficients
    )
    [zernikes] = [s for s in sections.SECTIONS if s.title == "Wavefront in Zernike terms"]
    figure = zernikes.draw(sections.Where(lens, None, None, 1))
    assert f"{primary * 1e9:.4g} nm" in figure.get_suptitle()
    found, given = (pachon.design.relative_illumination(lens, wavelength=w, n_pupil=256) for w in (None, primary))
    assert np.array_equal(found.solid_angle, given.solid_angle)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["lsst_v3.3_r", "tests/data/zmx/lens1.zmx", "tests/data/zmx/simple_fold_mirror_up.zmx"]
)
@pytest.mark.filterwarnings("ignore")
def test_whole_reports(name, request):
    path = name if "/" not in name else request.config.rootpath / name
    page = pachon.design_report(pachon.load_telescope(path))
    check(page)
    assert page.count("<img") >= (2 if "fold" in name else len(sections.SECTIONS))
    assert page == pachon.design_report(pachon.load_telescope(path), threads=1)


def test_first_order_data_of_an_off_axis_parabola():
    """Half the radius of the parent over cos^2 of half the angle of 90 degrees: its radius."""
    rows = dict(first_order_rows(pachon.load_telescope(DATA / "zmax_37992.zmx"), 587.6e-9))
    lengths = re.findall(r"[0-9.]+", rows["effective focal lengths"])
    assert [float(v) for v in lengths[:2]] == pytest.approx([190.6, 190.6], rel=1e-6)
    assert "back focus" not in rows


def test_the_stop_stands_in_the_table():
    lens = pachon.load_telescope(DATA / "lens1.zmx")
    rows = {row[0]: row[1] for row in prescription_rows(lens, 587.6e-9, {})}
    assert rows["S5"] == "baffle, stop"
    assert rows["S4"] == "lens surface"


def test_the_verdict_on_a_cylinder_has_no_airy_disc(paraboloid):
    """It said nan, with a warning of NumPy."""
    cylinder = paraboloid(2.0, 20.0).with_shape("mirror", Toroid(np.inf, 4.0, -1.0))
    where = sections.Where(cylinder, np.zeros((1, 2)), np.array([5e-7]), None)
    assert report._verdict(where) == "Its spots have 2.5e+04 µm rms radius at its one field."


def test_light_of_a_cylinder_is_parallel_along_one_direction(paraboloid):
    """All of it was said to be; and the depth of focus, infinite, was drawn with a warning of NumPy."""
    cylinder = paraboloid(2.0, 20.0).with_shape("mirror", Toroid(np.inf, 4.0, -1.0))
    for analysis in (pachon.field_curvature, pachon.design.spot_matrix, pachon.design.target_image):
        with pytest.raises(DomainError, match="its light is parallel at some fields or along one direction"):
            analysis(cylinder)
    assert pachon.design.chromatic_focus(cylinder).plot().axes
