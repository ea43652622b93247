"""A desk that Python opens: documents without a browser, and the frame of notebooks."""

import asyncio
import re
import urllib.error
import urllib.request

import pytest

import pachon
from pachon.core.errors import DomainError, ProductError, UnknownNameError

pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")

from pachon.desk.bench import Bench
from pachon.desk.views import Scene, spots_view

PICTURES = {"spots", "whiskers", "opd", "zernikes", "optics", "energy", "section", "seen"}
PICTURES |= {"spots_a", "whiskers_a", "opd_a", "mtf", "sensitivity", "merit", "space"}


@pytest.fixture(scope="module")
def triplet():
    return pachon.new_telescope("triplet")


@pytest.fixture(scope="module")
def desk(triplet):
    return pachon.open_desk(triplet)


def names_in(document):
    return {root.name for root in document.roots}


@pytest.mark.long
def test_a_document_is_made_without_a_browser(desk, triplet):
    document = desk.document()
    assert names_in(document) == PICTURES | {"sidebar", "status", "numbers"}
    bench = Bench(triplet)
    largest = spots_view(Scene.of(bench, bench.start)).rms_um.max()
    assert f">{largest:.4g}</b>" in document.get_model_by_name("numbers").text
    # Each document is a session of its own.
    assert document.roots[0] is not desk.document().roots[0]


@pytest.mark.long
def test_a_notebook_gets_a_frame_that_is_served_until_it_is_closed(desk):
    async def notebook():
        html = desk._repr_html_()
        address = re.search(r'src="(http://127\.0\.0\.1:\d+/[-\w]{32})"', html)[1]
        assert desk._repr_html_() == html
        page = await asyncio.to_thread(lambda: urllib.request.urlopen(address, timeout=60).read().decode())
        desk.close()
        with pytest.raises(urllib.error.URLError):
            await asyncio.to_thread(lambda: urllib.request.urlopen(address, timeout=60))
        return page

    page = asyncio.run(notebook())
    assert f"<title>{desk.name}: desk</title>" in page


def test_without_a_notebook_one_line_says_what_serves(desk):
    with pytest.raises(DomainError, match=r"^no event loop runs: expected a notebook; `pachon desk` serves"):
        desk.address  # noqa: B018
    assert "no event loop runs" in desk._repr_html_()


@pytest.mark.long
def test_states_of_a_telescope_name_the_file_that_it_is_saved_as(desk, triplet, tmp_path):
    pachon.save_telescope(triplet, tmp_path / f"{triplet.name}.yaml")
    (tmp_path / "desk.yaml").write_text(Bench(triplet).start.with_value("optics.S1_radius", 0.1).to_yaml())
    opened = pachon.open_desk(tmp_path / "desk.yaml")
    assert opened.name == triplet.name
    opened.export(tmp_path / "desk.html")
    assert "S1_radius: 0.1" in (tmp_path / "desk.html").read_text(encoding="utf-8")


def test_what_is_nothing_to_show_is_one_line(tmp_path):
    with pytest.raises(ProductError, match=r"expected the folder of a run \(ccd_"):
        pachon.open_desk(tmp_path)
    with pytest.raises(UnknownNameError):
        pachon.open_desk("lsst_v3.3_rr")
    with pytest.raises(ProductError, match=r"gone.sweep: no such file"):
        pachon.open_desk(tmp_path / "gone.sweep")
