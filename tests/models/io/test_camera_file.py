"""Camera files: what they hold, where they are found, and one line for what is wrong."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from pachon import PachonError, load_camera, load_telescope
from pachon.core.errors import PrescriptionError
from pachon.models.ideal_telescope import ideal_telescope
from pachon.models.io.bundled import DATA
from pachon.models.io.camera_file import CcdSection
from pachon.models.io.prescription import prescription_digest, save_telescope

TEXT = """\
name: mine
source: a drawing
pixel_um: 12.5
pixels: [1000, 2000]
ccds:
  - {name: A1, x_mm: -7.0, y_mm: 0.0, raft: A, vendor: x}
  - {name: A2, x_mm: 7.0, y_mm: 0.5, raft: A, vendor: y, rotation_deg: -90, pixels: [500, 400]}
  - {name: B, x_mm: 0, y_mm: 30, vendor: x, dz_um: 12, rx_urad: 50, ry_urad: -20}
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(TEXT)
    return path


def test_a_file_is_read_with_its_units(file):
    camera = load_camera(file)
    assert (camera.name, camera.pixel_size, camera.ccd_names) == ("mine", 12.5e-6, ("A1", "A2", "B"))
    assert np.array_equal(camera.centers, [[-7e-3, 0.0], [7e-3, 0.5e-3], [0.0, 0.03]])
    assert np.array_equal(camera.pixels, [[1000, 2000], [500, 400], [1000, 2000]])
    assert np.array_equal(camera.rotation_deg, [0.0, -90.0, 0.0])
    assert (camera.raft_names, camera.raft_of, camera.vendors) == (("A",), ("A", "A", ""), ("x", "y", "x"))
    assert np.allclose(camera.placement, [[0, 0, 0], [0, 0, 0], [12e-6, 50e-6, -20e-6]], rtol=1e-15)


def test_the_file_of_the_docs_has_every_key(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "howto" / "camera.md").read_text()
    path = tmp_path / "my_camera.yaml"
    path.write_text(re.search(r"```yaml\n(# my_camera.yaml.*?)```", page, flags=re.S).group(1))
    camera = load_camera(path)
    assert camera.members("A") == (0, 1)
    keys = {key for ccd in yaml.safe_load(path.read_text())["ccds"] for key in ccd}
    assert keys | {"vendor"} == set(CcdSection.keys())


def test_an_unchanged_file_is_one_camera_a_changed_one_another(file):
    assert load_camera(file) is load_camera(str(file))
    file.write_text(TEXT.replace("y_mm: 30", "y_mm: 31"))
    assert load_camera(file).centers[2, 1] == 0.031


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("pixel_um: 12.5\n", ""), "pixel_um is missing"),
        (("pixel_um: 12.5", "pixel_um: 0"), "pixel_um = 0"),
        (("pixels: [1000, 2000]\n", ""), r"ccds\[A1\].pixels"),
        (("pixels: [500, 400]", "pixels: [500, -4]"), "-4"),
        (("pixels: [500, 400]", "pixels: [500, 4.5]"), "4.5"),
        (("vendor: y, ", ""), r"ccds\[A2\].vendor: expected a text, as A1 has one"),
        (("name: B", "name: A1"), "'A1' occurs more than once"),
        (("name: B", "name: A"), "A names a CCD and a raft"),
        (("x_mm: 7.0", "x_mm: 1.0"), "CCDs A1 and A2 overlap"),
        (("rotation_deg", "angle"), "angle"),
        (("x_mm: 7.0", "x_mm: .inf"), "inf"),
        ((TEXT[TEXT.index("  - ") :], ""), "ccds"),
        ((TEXT[TEXT.index("\n  - ") :], " []"), "ccds"),
        (("source: a drawing\n", ""), "source"),
    ],
)
def test_bad_files_are_one_line_with_file_and_name(file, change, words):
    file.write_text(TEXT.replace(*change))
    with pytest.raises(PachonError, match=words) as caught:
        load_camera(file)
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(PachonError, match=r"nothing\.yaml"):
        load_camera(tmp_path / "nothing.yaml")


def test_prescriptions_name_a_file_beside_them(file, tmp_path):
    path = tmp_path / "telescope.yaml"
    path.write_text((DATA / "lsst_v3.3_r.yaml").read_text().replace("camera: lsst", "camera: mine.yaml"))
    telescope = load_telescope(path)
    assert load_camera(telescope.camera) is load_camera(file)
    before = prescription_digest(path)
    file.write_text(TEXT + "# more\n")
    assert prescription_digest(path) != before
    for kind in ("pachon", "batoid"):
        save_telescope(telescope, tmp_path / f"{kind}.yaml", format=kind)
        assert load_telescope(tmp_path / f"{kind}.yaml").camera == telescope.camera


def test_site_and_dispersion_corrector_of_a_telescope_are_kept(tmp_path):
    for kind in ("pachon", "batoid"):
        save_telescope(load_telescope("hsc"), tmp_path / f"{kind}.yaml", format=kind)
        telescope = load_telescope(tmp_path / f"{kind}.yaml")
        assert (telescope.site, telescope.dispersion_corrector) == ("maunakea", "ADC")


def test_an_unknown_dispersion_corrector_is_told():
    with pytest.raises(PrescriptionError, match=r"dispersion_corrector: unknown surface or group .ADC3"):
        replace(load_telescope("hsc"), dispersion_corrector="ADC3")


def test_telescopes_in_place_of_one_have_no_dispersion_corrector():
    assert ideal_telescope(load_telescope("hsc"), 2.0).dispersion_corrector is None
