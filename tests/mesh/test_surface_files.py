"""Damaged surface files are refused with what is wrong with them."""

import numpy as np
import pytest

from diffsim import mesh
from diffsim.core import MeshError


def box():
    import trimesh

    return trimesh.creation.box((1.0, 1.0, 1.0))


CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"


@pytest.mark.parametrize("share", [0.02, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_a_truncated_stl_says_so(tmp_path, kind, share):
    import trimesh

    whole = trimesh.exchange.export.export_mesh(box(), None, file_type=kind)
    whole = whole.encode() if isinstance(whole, str) else whole
    path = tmp_path / "box.stl"
    path.write_bytes(whole)
    assert len(mesh.load_surface(path).faces) == 12
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(MeshError, match=r"box.stl is cut off: .*again"):
        mesh.load_surface(path)


def test_counts_of_a_binary_stl_are_told(tmp_path):
    path = tmp_path / "box.stl"
    path.write_bytes(box().export(file_type="stl")[:400])
    with pytest.raises(MeshError, match="12 triangles, 684 bytes, but there are 6, 400 bytes"):
        mesh.load_surface(path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.obj", CORNERS + "f 1 2 3\nf 1 2 9\n", "a face has a vertex that there is not"),
        ("a.obj", CORNERS + "f 1 2 3\nf 1 2 0\n", "line 6: a face has vertex 0, .* from 1"),
        ("a.obj", CORNERS + "f 1/1 0/1 3/1\n", "line 5: a face has vertex 0"),
        ("a.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "cut off: .* 2 faces, but 4 lines"),
        ("a.stl", "", "a.stl is empty"),
        ("a.glb", "glTF", "cut off; copy or export it again"),
    ],
)
def test_damaged_files(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(MeshError, match=message):
        mesh.load_surface(tmp_path / name)


@pytest.mark.parametrize("wrong", [9, -1])
def test_wrong_face_indices_of_a_trimesh_are_named(wrong):
    """-1 was the last vertex, without a word; 9 an IndexError."""
    import trimesh

    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, wrong], [0, 3, 2], [1, 2, 3]])
    surface = trimesh.Trimesh(x, faces, process=False)
    with pytest.raises(MeshError, match=rf"4 vertices in \[0, 4\).*face 1 is \[0, 1, {wrong}\]"):
        mesh.voxelize(surface, 0.2)
