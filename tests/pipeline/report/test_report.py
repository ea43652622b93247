"""The report: one file that needs no other, with a picture and words for each thing it shows."""

import base64
import dataclasses
import json
import re
import struct
from html.parser import HTMLParser
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest

from pachon.core import plotting
from pachon.core.plotting import new_figure, png_bytes
from pachon.measure.correlation import SeparationBins, shear_correlation
from pachon.measure.focal_plane_axes import around_field_circle, key_ellipticity, whiskers
from pachon.models.camera.focal_plane import FocalPlane
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.report import focal_plane_plots, statistics_plots
from pachon.pipeline.report.focal_plane_plots import is_flat
from pachon.pipeline.report.pictures import closest_middle_farthest
from pachon.pipeline.report.report import build_report
from pachon.pipeline.report.tables import percent
from pachon.reconstruction.ccd_product import read_product
from pachon.wavefront.opd import wavefront_opd
from pachon.wavefront.zernike import fit_zernikes

PNG = b"\x89PNG\r\n\x1a\n"


class Reader(HTMLParser):
    """Collect what the page refers to, and check that every element that opens closes."""

    def __init__(self):
        super().__init__()
        self.references, self.images, self.open = [], [], []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img", "link", "br"):
            self.open.append(tag)
        for key, value in attrs:
            if key in ("src", "href"):
                self.references.append(value)
            if key == "src":
                self.images.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def page(finished_run):
    return (finished_run / "report.html").read_text()


def test_the_report_refers_to_nothing_outside_itself(page):
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    for reference in reader.references:
        assert reference.startswith(("data:image/png;base64,", "#"))
    # Pictures aside: four megabytes of base64 hold any four letters by chance.
    text = re.sub(r'data:image/png;base64,[^"]+', "", page)
    assert "http" not in text
    assert "@import" not in text
    assert "<script" not in text
    anchors = {r[1:] for r in reader.references if r.startswith("#")}
    assert anchors <= set(re.findall(r'id="([^"]+)"', page))


def test_the_report_opens_with_a_sentence_and_a_picture(page):
    assert page.index('<p class="verdict">On 2 CCDs the PSF is ') < page.index("<img") < page.index("<table")


def test_every_picture_is_a_png_without_date_or_software(page):
    reader = Reader()
    reader.feed(page)
    assert len(reader.images) == 10
    for image in reader.images:
        data = base64.b64decode(image.partition(",")[2])
        assert data.startswith(PNG)
        width, height = struct.unpack(">II", data[16:24])
        assert min(width, height) >= 2 * plotting._DPI  # two inches
        assert b"Software" not in data
        assert b"tIME" not in data


def test_each_picture_says_what_it_shows_and_what_the_paper_shows(page):
    for number in (7, 9, 11, 12, 13, 14):
        assert f"Fig. {number}" in page
    assert page.count("<figure>") == 10
    for word in ("arcsec", "R22_S11", "R24_S12", "seed 1", "config.yaml"):
        assert word in page


def test_text_of_a_user_is_escaped(finished_run, tiny):
    experiment = Experiment.from_config(tiny())
    telescope = dataclasses.replace(experiment.telescope, description="<b>mine</b> & yours")
    experiment = dataclasses.replace(experiment, telescope=telescope)
    page = build_report(experiment, json.loads((finished_run / "summary.json").read_text().replace("null", "NaN")), [])
    assert "&lt;b&gt;mine&lt;/b&gt; &amp; yours" in page


def test_the_page_says_what_the_camera_is_where_it_is_not_the_plain_one(finished_run, tiny):
    summary = json.loads((finished_run / "summary.json").read_text().replace("null", "NaN"))
    options = {"detector__silicon": True, "rotator_deg": 90.0}
    plain, other = (build_report(Experiment.from_config(tiny(**o)), summary, []) for o in ({}, options))
    assert "engine, seed 1. PSF" in plain
    words = " ".join(other.split())
    assert "engine, 100 &micro;m of silicon at 173 K, camera rotated by 90&deg;, seed 1. PSF" in words


def test_a_whisker_lies_along_the_elongation_with_its_length():
    # e1 > 0: along x; e1 < 0: along y; e2 > 0: along x = y.
    e1, e2 = np.array([0.1, -0.1, 0.0, np.nan]), np.array([0.0, 0.0, 0.2, 0.0])
    x, y = np.array([0.0, 1.0, 2.0, 3.0]), np.zeros(4)
    ends = whiskers(x, y, e1, e2, 10.0)
    assert ends.shape == (3, 2, 2)
    np.testing.assert_allclose(ends[:, 1] - ends[:, 0], [[1, 0], [0, 1], [2**0.5, 2**0.5]], atol=1e-12)
    np.testing.assert_allclose(ends.mean(axis=1), [[0, 0], [1, 0], [2, 0]], atol=1e-12)


def test_the_key_whisker_is_round_and_near_the_larger_ones():
    assert key_ellipticity(np.full(10, 0.011)) == 0.01
    assert key_ellipticity(np.full(10, 0.09)) == 0.1
    assert key_ellipticity(np.array([np.nan])) == 0.01


def test_shares_are_never_rounded_up_to_all():
    assert percent(0.5) == "50 %"
    assert percent(0.99123) == "99.12 %"
    assert percent(0.9999999) == "> 99.98 %"


def test_the_ccds_shown_large_are_the_closest_the_middle_and_the_farthest(finished_run):
    products = [read_product(finished_run / f"ccd_{name}.fits") for name in ("R24_S12", "R22_S11")]
    assert [p.name for p in closest_middle_farthest(products)] == ["R22_S11", "R24_S12"]


@pytest.mark.long
def test_figures_do_not_depend_on_the_users_matplotlib(lsst_r):
    opd = wavefront_opd(lsst_r, (0.0, 0.01), 620e-9, grid=32)
    fit = fit_zernikes(opd, 4.18, 0.612, 11)
    plain = png_bytes(opd.plot(fit, "lsst"))
    with matplotlib.rc_context({"font.size": 20.0, "axes.facecolor": "black"}):
        assert png_bytes(opd.plot(fit, "lsst")) == plain
    assert new_figure(2, 2).canvas.manager is None


def test_flat_focal_planes_have_no_scale_of_heights(monkeypatch):
    figures = []
    monkeypatch.setattr(focal_plane_plots, "png_bytes", lambda figure: figures.append(figure) or b"")
    for plane in (FocalPlane.flat("hsc"), FocalPlane.from_budget("lsst", seed=1)):
        assert is_flat(plane) == (plane.camera.name == "hsc")
        focal_plane_plots.heights_plot(plane, (), 0.3)
    flat, uneven = figures
    assert (len(flat.axes), len(uneven.axes)) == (1, 2)
    assert flat.axes[0].get_title().startswith("CCDs, without heights")


def test_edge_of_the_field_is_drawn_whole_beside_ccds_that_reach_it():
    camera, radius = FocalPlane.flat("hsc").camera, 247.0
    # At the sides the CCDs of HSC end inside of the edge; above and below they reach beyond.
    low, high = (
        1e3 * camera.corners(range(len(camera))).min((0, 1)),
        1e3 * camera.corners(range(len(camera))).max((0, 1)),
    )
    assert max(-low[0], high[0]) < radius < high[1]
    x_low, x_high, y_low, y_high = around_field_circle((low[0], high[0], low[1], high[1]), radius)
    assert x_low == -x_high
    assert radius < x_high < 1.03 * radius
    assert (y_low, y_high) == (low[1], high[1])
    # CCDs from the centre to the right edge, and a raft in the middle.
    assert around_field_circle((-20.0, 230.0, -20.0, 20.0), radius) == (-20.0, x_high, -20.0, 20.0)
    assert around_field_circle((-60.0, 60.0, -60.0, 60.0), radius) == (-60.0, 60.0, -60.0, 60.0)


def test_lines_of_the_paper_are_for_the_lsst(monkeypatch):
    """3e-5 and 1e-8 are what Jee & Tyson (2011) find of the LSST; another camera has no such line."""
    figures = []
    monkeypatch.setattr(statistics_plots, "png_bytes", lambda figure: figures.append(figure) or b"")
    rng = np.random.default_rng(1)
    fields = rng.uniform(-0.01, 0.01, (200, 2))
    e1, e2 = 0.01 * rng.standard_normal((2, 200))
    correlation = shear_correlation(*fields.T, e1, e2, bins=SeparationBins(1e-4, 1e-2, 5))
    for paper in (True, False):
        statistics_plots.correlation_plot({"truth": correlation}, paper)
    lines = [[t.get_text() for t in f.axes[0].texts if t.get_text().startswith("paper")] for f in figures]
    assert lines[0]
    assert not lines[1]


def test_whiskers_of_a_column_of_ccds_fit_on_a_page(monkeypatch):
    """Nine CCDs along y, as of the default run, were drawn 32 inches tall."""
    figures = []
    monkeypatch.setattr(focal_plane_plots, "png_bytes", lambda figure: figures.append(figure) or b"")
    plane = FocalPlane.flat()
    names = [name for name, (x, y) in zip(plane.camera.ccd_names, plane.camera.centers, strict=True) if abs(x) < 1e-3]

    class Stars:
        def __init__(self, center):
            self.x, self.y = center[:, None] + np.linspace(-0.01, 0.01, 3)

        def __len__(self):
            return 3

    def product(name):
        stars = Stars(plane.camera.centers[plane.camera.ccd_index(name)])
        return SimpleNamespace(
            name=name, stars=lambda kind: stars, ellipticity=lambda kind, moments="e": np.full((2, 3), 0.01)
        )

    focal_plane_plots.whiskers_plot([product(name) for name in names[-9:]], plane, 0.317)
    width, height = figures[0].get_size_inches()
    assert 4.0 < width < height <= 12.0
    panels = figures[0].axes[:3]
    assert len({axes.get_ylim() for axes in panels}) == 1
    assert panels[2].get_title(loc="left").count("\n") == 1
