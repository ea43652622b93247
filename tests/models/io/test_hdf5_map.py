"""Maps in HDF5 files: orientation, unit, degrees of freedom, and what is refused in one line."""

import sys

import numpy as np
import pytest
from astropy import units as u

import pachon

h5py = pytest.importorskip("h5py")

RAW = np.random.default_rng(4).normal(size=(6, 5))


@pytest.fixture
def figure(tmp_path):
    path = tmp_path / "m1.h5"
    with h5py.File(path, "w") as file:
        file["dataset"] = RAW
        file["about"] = "text"
        file["rows"] = np.arange(6.0)
    return path


def sag_of(raw, x, y, half, turns):
    """Value of the map at a node, by turning the node back: four turns about the centre, one by one."""
    rows, columns = raw.shape
    for _ in range(turns % 4):
        # A turn of the map from +x towards +y: the value at (x, y) came from (y, -x).
        x, y = y, -x
    return raw[round((y / half + 1) / 2 * (rows - 1)), round((x / half + 1) / 2 * (columns - 1))]


@pytest.mark.parametrize("turns", [-1, 0, 1, 2])
def test_maps_lie_as_stated(figure, turns):
    grid = pachon.models.read_hdf5_map(figure, 4.18, unit=0.5e-6, quarter_turns=turns)
    for x in grid.x:
        for y in grid.y:
            expected = 0.5e-6 * sag_of(RAW, x, y, 4.18, turns)
            assert float(grid.sag(np.array([x]), np.array([y]))[0]) == pytest.approx(expected, abs=1e-18)


def test_the_recipe_for_batoid_rubin_is_a_turn(figure):
    # Its own conversion takes rot90 of the dataset, rows along y from below.
    grid = pachon.models.read_hdf5_map(figure, 418 * u.cm, unit=0.5 * u.um, quarter_turns=-1)
    np.testing.assert_allclose(grid.values, 0.5e-6 * np.rot90(RAW), rtol=1e-14)
    assert (grid.x[0], grid.x[-1]) == (-4.18, 4.18)


def test_outside_the_mirror_the_sag_is_zero(tmp_path):
    holes = RAW.copy()
    holes[0, 0] = np.nan
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["group/map"] = holes
        file["other"] = RAW
    assert pachon.models.read_hdf5_map(tmp_path / "a.h5", 1.0, dataset="group/map").values[0, 0] == 0.0


def test_figures_are_degrees_of_freedom(figure, tmp_path):
    path = tmp_path / "dof.yaml"
    path.write_text(
        "name: figures\nsource: here\n"
        "figures: {M2_figure: {surfaces: [M2], hdf5: {F: {file: m1.h5, half_width: 1.8, unit: 0.5e-6, "
        "quarter_turns: -1}}}}\n"
        "degrees_of_freedom: [{name: figure, unit: '1', of: M2_figure.F}]\n"
    )
    telescope = pachon.load_telescope("lsst_v3.3_r")
    changed = pachon.load_degrees_of_freedom(path).apply(telescope, [2.0])
    grid = pachon.models.read_hdf5_map(figure, 1.8, unit=0.5e-6, quarter_turns=-1)
    x, y = np.array([0.3, -1.0]), np.array([1.2, 0.4])
    added = changed.surface("M2").shape.sag(x, y) - telescope.surface("M2").shape.sag(x, y)
    # Two of it; sags of 0.1 m are given to 2e-17 m.
    np.testing.assert_allclose(added, 2.0 * grid.sag(x, y), atol=1e-15)


def test_what_is_wrong_is_one_line(figure, tmp_path, monkeypatch):
    (tmp_path / "text.h5").write_text("no HDF5")
    with h5py.File(tmp_path / "two.h5", "w") as file:
        file["a"], file["b"] = RAW, RAW
    with h5py.File(tmp_path / "few.h5", "w") as file:
        file["a"] = RAW[:3]
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file["a"] = h5py.ExternalLink("m1.h5", "dataset")
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        layout = h5py.VirtualLayout((6, 5), dtype="f8")
        layout[:] = h5py.VirtualSource(str(figure), "dataset", (6, 5))
        file.create_virtual_dataset("a", layout)
    with h5py.File(tmp_path / "external.h5", "w") as file:
        file.create_dataset("a", (6, 5), "f8", external=[("/etc/hostname", 0, 240)])
    cases = [
        (tmp_path / "none.h5", {}, "no such file"),
        (tmp_path / "text.h5", {}, "cannot be read as HDF5"),
        (tmp_path / "two.h5", {}, "expected one dataset of numbers of two dimensions; the file has a, b"),
        (tmp_path / "two.h5", {"dataset": "c"}, "expected a dataset 'c' of numbers of two dimensions; the file has a"),
        (tmp_path / "few.h5", {}, "grid y has 3 nodes: expected at least 4"),
        (tmp_path / "linked.h5", {}, "the file has none"),
        (tmp_path / "virtual.h5", {}, "dataset '/a' lies in another file, which is not read"),
        (tmp_path / "external.h5", {}, "dataset '/a' lies in another file, which is not read"),
    ]
    for path, options, message in cases:
        with pytest.raises(pachon.errors.PrescriptionError, match=message) as caught:
            pachon.models.read_hdf5_map(path, 1.0, **options)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    for wrong in ({"half_width": 0.0}, {"half_width": 1 * u.s}, {"half_width": 1.0, "unit": 0.0}):
        with pytest.raises(pachon.errors.DomainError):
            pachon.models.read_hdf5_map(figure, **wrong)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(pachon.errors.PrescriptionError, match=r"m1\.h5: HDF5 needs the package h5py"):
        pachon.models.read_hdf5_map(figure, 1.0)
