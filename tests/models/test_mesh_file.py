"""Mesh files: what they name beside themselves, bounds, and what is refused."""

import json
import os

import numpy as np
import pytest
import trimesh

from pachon.core.errors import PrescriptionError
from pachon.models import mesh_file
from pachon.models.io.prescription import prescription_digest
from pachon.models.mesh_file import files_of_mesh, load_mesh
from pachon.models.shapes.mesh import MeshSurface

CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.1]])
FACES = np.array([[0, 1, 2], [1, 3, 2]])


def write_gltf(folder):
    """Write a mesh as a GLTF file with its buffers in a file beside it."""
    made = trimesh.Trimesh(CORNERS, FACES, process=False).export(file_type="gltf")
    names = {name: name.replace(".gltf", "").replace("model", "mesh.gltf") for name in made}
    for name, content in made.items():
        (folder / ("mesh.gltf" if name.endswith(".gltf") else names[name])).write_bytes(content)
    return folder / "mesh.gltf"


@pytest.mark.parametrize("merged", [True, False])
def test_buffers_beside_a_gltf_file_are_read(tmp_path, merged):
    mesh = load_mesh(write_gltf(tmp_path), merged=merged)
    assert len(mesh.faces) == 2
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([1.0, 1.0, 0.1], rel=1e-6)


def test_every_format_has_the_same_vertices(tmp_path):
    mesh = trimesh.Trimesh(CORNERS, FACES, process=False)
    for kind in ("stl", "glb", "obj", "ply", "off"):
        mesh.export(tmp_path / f"mesh.{kind}")
        found = MeshSurface.from_file(tmp_path / f"mesh.{kind}")
        # STL has single precision.
        np.testing.assert_allclose(np.sort(found.vertices, axis=0), np.sort(CORNERS, axis=0), atol=1e-7)


def test_a_changed_buffer_changes_the_hash_of_a_prescription(tmp_path):
    path = write_gltf(tmp_path)
    [buffer, *_] = files_of_mesh(path)
    (tmp_path / "tel.yaml").write_text("surfaces: [{mesh: mesh.gltf}]\n")
    before, content = prescription_digest(tmp_path / "tel.yaml"), (tmp_path / buffer).read_bytes()
    (tmp_path / buffer).write_bytes(content + b"\0")
    assert prescription_digest(tmp_path / "tel.yaml") != before
    (tmp_path / buffer).write_bytes(content)
    assert prescription_digest(tmp_path / "tel.yaml") == before


@pytest.mark.parametrize("name", ["/dev/zero", "../secret.bin", "pipe", "none.bin", "a\0b"])
def test_other_files_and_devices_are_not_read(tmp_path, name):
    folder = tmp_path / "mine"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(b"secret")
    os.mkfifo(folder / "pipe")
    path = write_gltf(folder)
    content = json.loads(path.read_text())
    for buffer in content["buffers"]:
        buffer["uri"] = name
    path.write_text(json.dumps(content))
    with pytest.raises(PrescriptionError, match=r"mesh\.gltf") as caught:
        load_mesh(path, merged=True)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_too_large_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_file, "MAX_MESH_BYTES", 100)
    (tmp_path / "mesh.stl").write_bytes(b"\0" * 101)
    with pytest.raises(PrescriptionError, match="expected a file of at most 100 bytes"):
        load_mesh(tmp_path / "mesh.stl", merged=True)
