"""Pictures of the desk's pages, by a browser: python docs/desk_pictures.py (needs pachon[desk] and Playwright).

Each is of a live page of 1300 pixels, light. A run with a focal-plane model may be given, whose model is shown too:
python docs/desk_pictures.py RUN/focal_plane_psf.fits
"""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image
from playwright.sync_api import Page, sync_playwright

import pachon
from pachon.studies import NightConfig, run_night
from pachon.studies.tolerance.file import ToleranceFile
from pachon.studies.tolerance.product import STORE_FILE, write_tolerances
from pachon.studies.tolerance.study import run_tolerances

IMAGES = Path(__file__).parent / "images"
#: Time for a page to draw what a click has asked for [ms].
PATIENCE = 20_000
MISALIGNED = """desk: 1
model: lsst_v3.3_r
optics: {M2_dz: -20.0, M2_dx: 400.0, M1M3_B2: 0.2}
field_deg: [0.0, 0.0]
wavelength_nm: 624.0
"""
TOLERANCES = {
    "fields_deg": [[0, 0], [0, 8.5], [0, 12]],
    "surfaces": {"radius_percent": 0.2},
    "elements": {"thickness_um": 30, "decentre_um": 20},
    "compensators": ["Detector.dz_um"],
    "draws": 300,
}
VISITS = """visit,ra,dec,mjd,exp_time,band,rotTelPos,seeingFwhm500,altitude
1001,53.1,-27.8,61001.15,30,r,-35,0.72,80
1002,52.95,-27.95,61001.16,30,r,-35,0.78,79
1003,53.0,-28.0,61001.19,30,r,42.5,0.95,70
"""
NIGHT = {
    "run": {
        "ccds": [f"R22_S{row}{column}" for row in range(3) for column in range(3)],
        "psf": {"engine": "long_exposure", "n_pupil": 300},
        "stars": {"truth": 16},
    },
    "maps": {"nside": 1024},
    "models": False,
}


def made(folder: Path) -> dict[str, Path]:
    """Compute what the pages show, and return it by the name of the picture."""
    (folder / "misaligned.yaml").write_text(MISALIGNED)
    lens = folder / "triplet.yaml"
    pachon.save_telescope(pachon.new_telescope("triplet"), lens)
    file = ToleranceFile.model_validate({"telescope": str(lens), **TOLERANCES})
    (folder / "tolerance_triplet").mkdir()
    study = run_tolerances(pachon.load_telescope(lens), file, folder / "tolerance_triplet" / STORE_FILE)
    write_tolerances(study, file, folder / "tolerance_triplet")
    (folder / "visits.csv").write_text(VISITS)
    night = {**NIGHT, "visits": {"list": str(folder / "visits.csv")}}
    run_night(NightConfig.model_validate(night), folder / "night")
    sources = {"desk_panels": "misaligned.yaml", "desk_tolerances": "tolerance_triplet", "desk_visits": "night"}
    return {name: folder / source for name, source in sources.items()}


def panels(page: Page) -> None:
    """Show all further pictures but the pinned state, and optimise two variables."""
    for label in ("MTF", "Sensitivities", "Optimisation", "Three dimensions"):
        page.get_by_role("checkbox", name=label).check()
    page.wait_for_timeout(PATIENCE)
    page.locator("select[multiple]").select_option(["M2_dz", "M2_dx", "M1M3_B2"])
    page.get_by_role("button", name="Optimise").click()
    page.wait_for_timeout(PATIENCE)
    page.locator("[data-picture=mtf]").scroll_into_view_if_needed()
    page.evaluate("window.scrollTo(0, document.querySelector('[data-picture=mtf]').offsetTop - 12)")


def photographed(page: Page, source: Path, target: Path, prepare: Callable[[Page], None] | None) -> None:
    """Serve a page, and write its picture with few colours."""
    command = [sys.executable, "-m", "pachon", "desk", str(source), "--no-browser", "--port", "5606"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            [address] = re.findall(r"http\S+", server.stdout.readline())
            page.goto(f"{address}?theme=light", timeout=20 * PATIENCE)
            page.wait_for_timeout(PATIENCE)
            if prepare is not None:
                prepare(page)
            page.wait_for_timeout(PATIENCE // 4)
            page.screenshot(path=target)
        finally:
            server.terminate()
    Image.open(target).convert("P", palette=Image.Palette.ADAPTIVE, colors=200).save(target, optimize=True)


def main() -> None:
    """Make all pictures."""
    with TemporaryDirectory() as folder, sync_playwright() as program:
        sources = made(Path(folder))
        with suppress(IndexError):
            sources["desk_focal_plane"] = Path(sys.argv[1])
        path = shutil.which("chromium") or program.chromium.executable_path
        browser = program.chromium.launch(executable_path=path, args=["--no-sandbox"])
        heights = {"desk_focal_plane": 900}
        for name, source in sources.items():
            page = browser.new_page(viewport={"width": 1300, "height": heights.get(name, 860)})
            target = IMAGES / f"{name}.png"
            photographed(page, source, target, panels if name == "desk_panels" else None)
            print(f"{target}: {target.stat().st_size / 1e3:.0f} kB")
            page.close()
        browser.close()


if __name__ == "__main__":
    main()
