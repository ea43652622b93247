"""Ideal thin lenses in prescription files and lens files: read, written, refused."""

import warnings

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.first_order import first_order, seidel_sums


def zemax_file(folder, *blocks, distance="INFINITY", fields=("0", "5")):
    """Surfaces in the order of the light, in millimetres."""
    lines = [
        "VERS 190513 30 123457 L123457", "MODE SEQ", "UNIT MM X W X CM MR CPMM", "ENPD 10",
        f"FTYP 0 0 {len(fields)} 1 0 0 0", f"XFLN {' '.join('0' for _ in fields)}", f"YFLN {' '.join(fields)}",
        "WAVM 1 0.55 1", "PWAV 1", "SURF 0", "  TYPE STANDARD", "  CURV 0.0", f"  DISZ {distance}",
    ]  # fmt: skip
    for number, block in enumerate(blocks, start=1):
        lines += [f"SURF {number}", *(f"  {line}" for line in block)]
    path = folder / "lens.zmx"
    path.write_text("\n".join(lines) + "\n")
    return path


def paraxial(focal_length, thickness, *lines):
    return ["TYPE PARAXIAL", "CURV 0.0", f"PARM 1 {focal_length}", "PARM 2 1", *lines, f"DISZ {thickness}"]


IMAGE = ["TYPE STANDARD", "CURV 0.0", "DISZ 0"]


def test_a_paraxial_lens_of_zemax(tmp_path):
    """All light of a field comes to f times its tangent, with equal paths."""
    telescope = pachon.load_telescope(zemax_file(tmp_path, paraxial(80.0, 80.0, "STOP"), IMAGE))
    assert telescope.surfaces[0].thin_lens == pachon.models.ThinLens(0.08)
    assert first_order(telescope).focal_length == pytest.approx(0.08, rel=1e-14)
    assert not seidel_sums(telescope).contributions.any()
    for field in telescope.design_data.fields:
        opd = pachon.wavefront_opd(telescope, field, 550e-9, grid=16)
        assert np.nanmax(np.abs(opd.value)) < 1e-15
        assert np.allclose(opd.landing[opd.lit], opd.center, rtol=0, atol=1e-16)
        assert abs(opd.center[1]) == pytest.approx(0.08 * np.tan(abs(field[1])), abs=1e-16)


def test_two_lenses_of_an_object_at_a_finite_distance(tmp_path):
    """The paths of each lens are those of its own object."""
    blocks = paraxial(80.0, 70.0, "STOP"), paraxial(-50.0, 100.0), IMAGE
    telescope = pachon.load_telescope(zemax_file(tmp_path, *blocks, distance="120", fields=("0",)))
    first, second = (s.thin_lens for s in telescope.surfaces[:2])
    assert first.object_distance == pytest.approx(0.12, rel=1e-14)
    image = 1.0 / (1.0 / 0.08 - 1.0 / 0.12)
    assert second.object_distance == pytest.approx(0.07 - image, rel=1e-13)
    ray = pachon.launch_rays(telescope, (0.0, 0.0), 550e-9, ([0.0, 0.004], [0.003, 0.0]))
    results = pachon.trace(telescope, ray, "all")
    behind = 1.0 / (1.0 / -0.05 - 1.0 / (0.07 - image))
    expected = results[1].position[:, :2] * (1.0 - 0.1 / behind)
    assert np.allclose(results[2].position[:, :2], expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("ending", ["yaml", "zmx", "json"])
def test_written_and_read_again(ending, tmp_path):
    glass = ["TYPE STANDARD", "CURV 0.01", "GLAS N-BK7 0 0 1.5 40 0 0 0 0 0 0", "DISZ 4"]
    back = ["TYPE STANDARD", "CURV -0.002", "DISZ 30"]
    telescope = pachon.load_telescope(zemax_file(tmp_path, glass, back, paraxial(60.0, 40.0, "STOP"), IMAGE))
    path = tmp_path / f"again.{ending}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionWarning)
        pachon.save_telescope(telescope, path)
        again = pachon.load_telescope(path)
    lens, read = (t.surfaces[2].thin_lens for t in (telescope, again))
    assert read.focal_length == pytest.approx(lens.focal_length, rel=1e-14)
    assert read.object_distance == pytest.approx(lens.object_distance, rel=1e-9)
    x, y = np.meshgrid(np.linspace(-0.004, 0.004, 5), np.linspace(-0.004, 0.004, 5))
    ends = [
        pachon.trace(t, pachon.launch_rays(t, (0.01, 0.02), 550e-9, (x.ravel(), y.ravel()))) for t in (telescope, again)
    ]
    assert np.abs(ends[0].position[:, :2] - ends[1].position[:, :2]).max() < 1e-15


def test_formats_without_them_say_so(tmp_path):
    telescope = pachon.load_telescope(zemax_file(tmp_path, paraxial(80.0, 80.0, "STOP"), IMAGE))
    for ending in ("seq", "len", "roa"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PrescriptionWarning)
            with pytest.raises(PrescriptionError, match=r"surface S1: thin lens: .* is written without them"):
                pachon.save_telescope(telescope, tmp_path / f"lens.{ending}")
    with pytest.raises(PrescriptionError, match="surface S1: thin lens: a batoid file has none"):
        pachon.save_telescope(telescope, tmp_path / "batoid.yaml", format="batoid")


def test_refused_in_one_line(tmp_path):
    mirror = paraxial(80.0, -80.0, "STOP", "GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0")
    with pytest.raises(PrescriptionError, match="surface 1: TYPE PARAXIAL, GLAS MIRROR: a thin lens that reflects"):
        pachon.load_telescope(zemax_file(tmp_path, mirror, IMAGE))
    telescope = pachon.load_telescope(zemax_file(tmp_path, paraxial(80.0, 80.0, "STOP"), IMAGE))
    path = tmp_path / "lens.yaml"
    pachon.save_telescope(telescope, path)
    text = path.read_text()
    for old, new, message in (
        ("focal_length: 80.0", "focal_length: 0.0", "focal_length"),
        ("thin_lens: {", "lens: {", "lens"),
    ):
        assert old in text
        path.write_text(text.replace(old, new))
        with pytest.raises(PrescriptionError, match=message) as caught:
            pachon.load_telescope(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("ending", ["yaml", "zmx", "json"])
def test_a_thin_lens_out_of_a_medium_into_air(ending, tmp_path):
    """In water its focus is at 1.33 focal lengths, in air at one: the medium behind it is kept."""
    window = ["TYPE STANDARD", "CURV 0.0", "STOP", "GLAS WATER 0 0 1.5 40 0 0 0 0 0 0", "DISZ 10"]
    telescope = pachon.load_telescope(zemax_file(tmp_path, window, paraxial(60.0, 60.0), IMAGE))
    pachon.save_telescope(telescope, tmp_path / f"again.{ending}")
    again = pachon.load_telescope(tmp_path / f"again.{ending}")
    assert first_order(telescope).back_focus == pytest.approx(0.06, rel=1e-14)
    assert first_order(again).back_focus == pytest.approx(0.06, rel=1e-14)
    assert [s.medium_after for s in again.surfaces] == [s.medium_after for s in telescope.surfaces]
