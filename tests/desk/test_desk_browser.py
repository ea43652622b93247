"""The desk in a real browser: needs Bokeh, Playwright and its Chromium or the system's; else it is skipped."""

import http.client
import re
import select
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytest.importorskip("bokeh", reason="the desk in a browser needs Bokeh: pip install 'pachon[desk]'")
playwright = pytest.importorskip(
    "playwright.sync_api", reason="the desk in a browser needs Playwright: pip install playwright"
)

from test_desk_focal import fitted  # noqa: E402
from test_desk_results import donut_table, night_folder, stack_folder, tolerance_folder  # noqa: E402
from test_desk_sweep import store_of  # noqa: E402

import pachon  # noqa: E402
from pachon.desk.bench import Bench  # noqa: E402
from pachon.desk.run_views import KINDS, RunBench, run_numbers, run_whiskers  # noqa: E402
from pachon.desk.sweep_views import SweepBench  # noqa: E402
from pachon.desk.views import Scene, images_view, numbers, opd_view, spots_view, whiskers_view  # noqa: E402

pytestmark = pytest.mark.long
#: Ample time for a busy machine [ms].
PATIENCE = 120_000
TEXT = "() => window.Bokeh?.documents[0]?.get_model_by_name('numbers')?.text ?? ''"


@contextmanager
def served(source, port):
    """Serve a desk: its address, and a list that gets exit status and further output when Ctrl-C has ended it."""
    ending = []
    command = [sys.executable, "-m", "pachon", "desk", str(source), "--no-browser", "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        try:
            assert select.select([server.stdout], [], [], 120.0)[0]
            yield re.search(r"http://127\.0\.0\.1:\d+/[-\w]{32}", server.stdout.readline())[0], ending
        finally:
            server.send_signal(signal.SIGINT)
            try:
                rest, errors = server.communicate(timeout=60)
                ending += [server.returncode, rest, errors]
            finally:
                server.kill()


@pytest.fixture(scope="module")
def address():
    with served("lsst_v3.3_r", 5306) as (url, ending):
        yield url
    # Ctrl-C ends it, without a word; the port may have been another program's.
    assert ending[:2] == [0, ""]
    assert ending[2] in ("", "port 5306 is taken; the next free one is used\n")


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as program:
        installed = [program.chromium.executable_path, *map(shutil.which, ("chromium", "google-chrome"))]
        path = next((path for path in installed if path and Path(path).is_file()), None)
        if path is None:
            pytest.skip("the desk in a browser needs Chromium: playwright install chromium")
        opened = program.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture
def new_page(address, browser):
    """Return a function that opens the desk; nothing may go wrong on its pages, or leave this machine."""
    pages, problems, hosts = [], [], set()

    def opened(width=1300, theme="light"):
        page = browser.new_page(viewport={"width": width, "height": 900})
        page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("request", lambda request: hosts.add(urlsplit(request.url).hostname))
        page.goto(f"{address}?theme={theme}", timeout=PATIENCE)
        page.wait_for_function(f"({TEXT})().includes('FWHM')", timeout=PATIENCE)
        pages.append(page)
        return page

    yield opened
    for page in pages:
        page.close()
    assert problems == []
    assert hosts - {None} == {"127.0.0.1"}


def shown(page):
    """Return the numbers on the page by name, as texts."""
    return dict(re.findall(r"opacity:.75\">([^<]+)</div><b[^>]*>([^<]+)</b>", page.evaluate(TEXT)))


def expected(state, bench):
    scene = Scene.of(bench, state)
    table = numbers(spots_view(scene), opd_view(scene), whiskers_view(scene), images_view(scene))
    return {name: f"{value:.4g}" for name, (value, _) in table.items()}


def wait_for(page, numbers_of_python):
    for _ in range(240):
        if shown(page) == numbers_of_python:
            return
        page.wait_for_timeout(500)
    assert shown(page) == numbers_of_python


@pytest.mark.parametrize(("width", "theme"), [(1300, "light"), (700, "dark")])
def test_every_picture_draws_and_fits_the_page(new_page, width, theme):
    page = new_page(width, theme)
    names = ["spots", "whiskers", "opd", "zernikes", "optics", "seen", "energy", "section"]
    inside = """name => {
        const view = [...Object.values(Bokeh.index)].find(v => v.model.name == name);
        const canvas = view.canvas_view.primary.canvas, data = canvas.getContext('2d');
        const pixels = new Set(new Uint32Array(data.getImageData(0, 0, canvas.width, canvas.height).data.buffer));
        const box = view.el.getBoundingClientRect();
        return [pixels.size, box.left, box.right];
    }"""
    for name in names:
        page.wait_for_function(f"name => ({inside})(name)[0] > 5", arg=name, timeout=PATIENCE)
        _, left, right = page.evaluate(inside, name)
        assert 0 <= left < right <= width, name
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width
    assert page.evaluate("() => document.documentElement.classList.contains('dark')") == (theme == "dark")


def test_a_slider_gives_the_numbers_of_the_python_api_and_tabs_do_not_mix(new_page):
    bench = Bench("lsst_v3.3_r")
    first, second = new_page(), new_page()
    start = expected(bench.start, bench)
    wait_for(second, start)
    slider = first.get_by_role("slider").first
    slider.focus()
    for _ in range(20):
        slider.press("ArrowRight")
    dz = next(control for control in bench.controls if control.key == "optics.M2_dz")
    moved = expected(replace(bench.start, optics={"M2_dz": 20 * dz.step}), bench)
    assert moved != start
    wait_for(first, moved)
    assert shown(second) == start
    # All steps of a drag are one to undo.
    first.get_by_role("button", name="Undo").click()
    wait_for(first, start)


def test_the_correlation_follows_a_slider_and_the_solid_stands_in_a_frame(new_page):
    page = new_page()
    page.get_by_label("Correlation").check()
    change = "xi+ of its change from the design at 2.8 arcmin"
    page.wait_for_function(f"({TEXT})().includes('{change}')", timeout=PATIENCE)
    assert shown(page)[change] == "0"
    slider = page.get_by_role("slider").first
    slider.focus()
    slider.press("PageUp")
    moved = f"name => !({TEXT})().includes(name + '</div><b style=\"font-size:17px\">0<')"
    page.wait_for_function(moved, arg=change, timeout=PATIENCE)
    assert float(shown(page)[change]) > 0
    page.get_by_label("Three dimensions").check()
    page.get_by_role("button", name="Solid").click()
    frame = page.frame_locator("dialog iframe")
    frame.locator("#container").wait_for(state="attached", timeout=PATIENCE)
    # Without a graphics card there may be no WebGL, and the frame stays empty.
    page.get_by_role("button", name="Close").click()
    assert page.locator("dialog").count() == 0
    with page.expect_download(timeout=PATIENCE) as download:
        page.get_by_role("button", name="Save GLB").click()
    assert Path(download.value.path()).read_bytes()[:4] == b"glTF"


def test_what_is_impossible_is_one_line_and_the_last_good_state_stays(new_page):
    page = new_page()
    before = shown(page)
    number = page.locator("input.bk-input").first
    number.fill("1e9")
    number.press("Enter")
    page.wait_for_function("() => Bokeh.documents[0].get_model_by_name('status').text != ''", timeout=PATIENCE)
    assert shown(page) == before


def status(address, path, headers=None):
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=60)
    try:
        connection.request("GET", path, headers=headers or {})
        return connection.getresponse().status
    finally:
        connection.close()


def test_other_addresses_and_other_origins_are_refused(address):
    path = urlsplit(address).path
    assert [status(address, p) for p in ("/", "/desk", path[:-1] + "~", f"/ws{path}")] == [404] * 4
    key = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    key |= {"Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA=="}
    assert status(address, f"{path}/ws", key | {"Origin": "http://example.org"}) == 403


def test_a_port_that_is_taken_gives_way_to_the_next(address):
    port = urlsplit(address).port
    with served("lsst_v3.3_r", port) as (url, ending):
        assert urlsplit(url).port == port + 1
    assert ending == [0, "", f"port {port} is taken; the next free one is used\n"]


def test_an_exported_page_needs_nothing_else(browser, tmp_path):
    target = tmp_path / "desk.html"
    state = tmp_path / "desk.yaml"
    bench = Bench("lsst_v3.3_r")
    state.write_text(bench.start.with_value("optics.M2_dx", 300.0).to_yaml())
    command = [sys.executable, "-m", "pachon", "desk", str(state), "--export", str(target)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"page: {target}\n", "")
    page = browser.new_page()
    requests, problems = [], []
    page.on("request", lambda request: requests.append(request.url))
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.goto(target.as_uri(), timeout=PATIENCE)
    page.wait_for_function("() => document.querySelectorAll('.bk-Figure').length == 8", timeout=PATIENCE)
    assert "M2_dx: 300.0" in page.content()
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert problems == []
    page.close()


def test_the_desk_of_a_run_draws_its_stars_and_a_clicked_ccd(finished_run, browser):
    with served(finished_run, 5386) as (url, _):
        page, problems, hosts = browser.new_page(), [], set()
        page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        page.on("request", lambda request: hosts.add(urlsplit(request.url).hostname))
        page.goto(url, timeout=PATIENCE)
        page.wait_for_function(f"({TEXT})().includes('ellipticity')", timeout=PATIENCE)
        bench = RunBench(finished_run)
        for kind in list(KINDS)[::-1]:
            page.locator("select").first.select_option(kind)
            table = run_numbers(run_whiskers(bench, replace(bench.start, kind=kind)), len(bench.ccds))
            wait_for(page, {name: f"{value:.4g}" for name, (value, _) in table.items()})
        page.locator("select").nth(1).select_option(list(bench.ccds)[-1])
        page.wait_for_function(
            "name => Object.values(Bokeh.index).some(v => v.model.title?.text?.startsWith(name))",
            arg=list(bench.ccds)[-1],
            timeout=PATIENCE,
        )
        page.close()
    assert problems == []
    assert hosts - {None} == {"127.0.0.1"}


def test_pages_of_results_draw_without_errors(browser, tmp_path):
    sources = {
        tolerance_folder(tmp_path / "tolerance"): 5,
        donut_table(tmp_path / "donuts.ecsv"): 2,
        night_folder(tmp_path / "night"): 2,
        stack_folder(tmp_path / "stacks"): 2,
        fitted(): 4,
    }
    page, problems, requests = browser.new_page(viewport={"width": 700, "height": 900}), [], []
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    for source, pictures in sources.items():
        target = tmp_path / "desk.html"
        pachon.open_desk(source).export(target)
        page.goto(target.as_uri(), timeout=PATIENCE)
        count = "n => document.querySelectorAll('.bk-Figure').length == n"
        page.wait_for_function(count, arg=pictures, timeout=PATIENCE)
        assert page.evaluate("() => document.documentElement.scrollWidth") <= 700, source
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert problems == []
    page.close()


def test_a_box_in_one_plot_of_a_sweep_selects_in_all_and_a_point_opens(browser, tmp_path):
    path = store_of(tmp_path)
    with served(path, 5446) as (url, _):
        context = browser.new_context(viewport={"width": 1300, "height": 900})
        page, problems, hosts = context.new_page(), [], set()
        context.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        context.on("request", lambda request: hosts.add(urlsplit(request.url).hostname))
        page.goto(url, timeout=PATIENCE)
        page.wait_for_function(f"({TEXT})().includes('fwhm')", timeout=PATIENCE)
        page.wait_for_function("() => document.querySelectorAll('.bk-Figure').length == 4", timeout=PATIENCE)
        bench = SweepBench(path)
        # A box over the left half of the first plot.
        frame = page.evaluate("""() => {
            const view = Object.values(Bokeh.index).find(v => v.model.name == 'x0');
            const canvas = view.canvas_view.el.getBoundingClientRect(), inner = view.frame.bbox;
            return [canvas.left + inner.left, canvas.top + inner.top, inner.width, inner.height];
        }""")
        left, top, width, height = frame
        page.mouse.move(left + 2, top + 2)
        page.mouse.down()
        page.mouse.move(left + 0.3 * width, top + 0.9 * height, steps=4)
        page.mouse.move(left + 0.3 * width, top + height - 2)
        page.mouse.up()
        [row] = [i for i, x in enumerate(bench.parameters["M2.dz_um"]) if x == -10]
        table = bench.numbers("fwhm_arcsec", [row])
        wait_for(page, {name: f"{value:.4g}" for name, (value, _) in table.items()})
        number = int(bench.table.number[row])
        chosen = "() => Bokeh.documents[0].get_model_by_name('x1').renderers[0].data_source.selected.indices"
        assert page.evaluate(chosen) == [row]
        with context.expect_page(timeout=PATIENCE) as opening:
            page.get_by_role("button", name="Open this telescope").click()
        opened = opening.value
        assert opened.url.endswith(f"?point={number}")
        wait_for(opened, expected(bench.opened(number)[1], bench.opened(number)[0]))
        page.goto(f"{url}?point=x", timeout=PATIENCE)
        page.wait_for_selector("text=expected a whole number", timeout=PATIENCE)
        context.close()
    assert problems == []
    assert hosts - {None} == {"127.0.0.1"}
