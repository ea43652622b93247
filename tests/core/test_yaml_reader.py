"""YAML files that would take memory, time or recursion without bound are refused in one line."""

import os
from pathlib import Path

import numpy as np
import pytest

from pachon.core.errors import ConfigError, PachonError
from pachon.core.products import read_fits
from pachon.core.yaml_reader import MAX_BYTES, read_mapping
from pachon.models.io.grid_file import read_grid
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.mesh_file import load_mesh
from pachon.models.shapes.grid import GridSag
from pachon.models.shapes.sum import Sum
from pachon.pipeline.config import load_configuration
from pachon.reconstruction.own_stars.star_catalogue import load_stars


def _aliases(levels):
    rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    for i in range(1, levels):
        rows.append(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]")
    return "\n".join(rows)


def _merges(levels):
    rows = ["a0: &a0 {" + ", ".join(f"k{i}: x" for i in range(10)) + "}"]
    for i in range(1, levels):
        rows.append(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 10)}]}}")
    return "\n".join(rows)


def test_merged_mappings_give_keys_that_the_mapping_itself_and_earlier_ones_override(tmp_path):
    path = tmp_path / "merge.yaml"
    path.write_text(
        "a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\nc: {y: 7, <<: [{z: 5, x: 4}, *a]}\nd: {<<: &e {<<: *a, x: 9}}\ne: *e"
    )
    content = read_mapping(path)
    assert content["b"] == {"x": 1, "y": 3}
    assert content["c"] == {"x": 4, "y": 7, "z": 5}
    assert content["d"] == content["e"] == {"x": 9, "y": 2}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: {<<: {k: 1, k: 2}}", "key 'k' occurs twice"),
        ("a: &a {x: 1}\nb: {<<: *a, <<: *a}", "key '<<' occurs twice"),
        ("a: {<<: 3}", "expected a mapping or list of mappings for merging"),
    ],
)
def test_wrong_merges_are_refused(tmp_path, text, reason):
    path = tmp_path / "merge.yaml"
    path.write_text(text)
    with pytest.raises(PachonError, match=reason):
        read_mapping(path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (_aliases(30), "aliases for more than 1000000 characters"),
        (
            "a: &a " + "x" * 10_000 + "\nb: [" + ", ".join(["*a"] * 10_000) + "]",
            "more than 1000000 characters",
        ),
        ("a: &a [*a]", r"alias \*a within itself"),
        ("a: &a {<<: *a}", r"alias \*a within itself"),
        (_merges(30), "aliases for more than 1000000 characters"),
        ("a: " + "[" * 2000 + "]" * 2000, "more than 50 levels of nesting"),
        ("a: " + "[" * 2000, "more than 50 levels of nesting"),
        ("a: " + "{b: " * 2000 + "1" + "}" * 2000, "more than 50 levels of nesting"),
        ("a: " + "1:" * 200_000 + "1", "integer of 400001 characters"),
        ("a: 0x" + "f" * 200_000, "integer of 200002 characters"),
        ("a: *" + "b" * 50_000, "found undefined alias"),
        ("a: " + "1:" * 2000 + "1.5", "not valid YAML"),
        ("a: !!bool x", "not valid YAML"),
        ("a: !!timestamp x", "not valid YAML"),
        ("a: !!int ''", "not valid YAML"),
        ("a: [" + ("x" * 1000 + ",") * 990 + "]", "more than 1000000 characters"),
        ("a: " + "x" * MAX_BYTES, f"expected a file of at most {MAX_BYTES} bytes"),
    ],
    ids=[
        "laughs",
        "long",
        "itself",
        "merged itself",
        "merged laughs",
        "lists",
        "open",
        "maps",
        "base60",
        "hex",
        "name",
        "float",
        "bool",
        "time",
        "empty",
        "many",
        "bytes",
    ],
)
@pytest.mark.parametrize("read", [lambda path: read_mapping(path, ConfigError), load_configuration])
def test_content_without_bound_is_refused_at_once_in_one_line(tmp_path, text, reason, read):
    path = tmp_path / "run.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=reason) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400 + len(str(path))


@pytest.mark.slow
def test_a_saved_telescope_with_a_grid_of_many_nodes_is_read_again(tmp_path):
    nodes = np.linspace(-1.0, 1.0, 240)
    plain = load_telescope("paul_baker")
    shape = Sum((plain.surfaces[0].shape, GridSag(nodes, nodes, np.zeros((240, 240)))))
    save_telescope(plain.with_shape(plain.surfaces[0].name, shape), tmp_path / "grid.yaml")
    assert load_telescope(tmp_path / "grid.yaml").surfaces[0].shape == shape


def test_aliases_and_nesting_within_the_limits_keep_their_values(tmp_path):
    path = tmp_path / "good.yaml"
    path.write_text("a: &a {x: 1, y: [0x1f, 1:30]}\nb: [*a, *a]\nc: " + "[" * 40 + "]" * 40)
    content = read_mapping(path)
    assert content["a"] == {"x": 1, "y": [31, 90]}
    assert content["b"] == [content["a"]] * 2
    deep = content["c"]
    for _ in range(39):
        (deep,) = deep
    assert deep == []


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("a.yaml", read_mapping),
        ("a.fits", read_grid),
        ("a.fits", read_fits),
        ("a.fits", load_stars),
        ("a.stl", lambda path: load_mesh(path, merged=True)),
    ],
)
def test_pipes_devices_and_folders_are_refused_and_never_waited_for(tmp_path, name, read):
    places = {kind: tmp_path / kind for kind in ("pipe", "device", "folder")}
    for folder in places.values():
        folder.mkdir()
    os.mkfifo(places["pipe"] / name)
    (places["device"] / name).symlink_to("/dev/zero")
    (places["folder"] / name).mkdir()
    for kind, folder in places.items():
        with pytest.raises(PachonError, match="a folder" if kind == "folder" else "a pipe, device or socket") as caught:
            read(folder / name)
        assert Path(caught.value.file).name == name


def test_a_name_with_a_null_character_is_an_error_of_one_line():
    with pytest.raises(PachonError, match="null"):
        read_mapping(Path("a\0b.yaml"))
