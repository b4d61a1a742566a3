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


def ply(kind="ascii", faces=4, x="float x"):
    return (
        f"ply\nformat {kind} 1.0\nelement vertex 4\nproperty {x}\nproperty float y\n"
        f"property float z\nelement face {faces}\nproperty list uchar int vertex_indices\n"
        "end_header\n"
    ).encode()


POINTS = b"0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
FACES = b"3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
OFF, OBJ = (
    b"OFF\n4 4 0\n" + POINTS + FACES,
    CORNERS.encode() + b"f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n",
)


def binary_ply(last=3, z=1.0, faces=4):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, z]], "<f4").tobytes()
    rows = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, last)]
    body = b"".join(b"\x03" + np.array(row, "<i4").tobytes() for row in rows)
    return ply("binary_little_endian", faces) + corners + body


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", ply() + POINTS + FACES),
        ("a.ply", binary_ply()),
        ("a.off", OFF),
        ("a.off", b"OFF 4 4 0 # counts\n\n# corners\n" + POINTS + FACES),
        ("a.obj", OBJ),
        ("a.obj", OBJ.replace(b"\n", b"\r\n").replace(b"f 1 2 4", b"f -4/ -3/ 4/")),
        ("a.obj", OBJ.replace(b"v 1 0 0", b"v +1.e0 -0.0 1e-320 0.5 0.5 0.5")),
    ],
)
def test_whole_files_are_read(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert mesh.load_surface(tmp_path / name).faces.shape == (4, 3)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", ply() + POINTS + FACES[:-9], r"cut off: .* 4 of face, but 7 lines follow"),
        ("a.ply", ply(faces=9) + POINTS + FACES, r"cut off: .* 9 of face, but 8 lines follow"),
        ("a.ply", ply() + POINTS.replace(b"1 0 0", b"1 x 0") + FACES, "line 11: .* got '1 x 0'"),
        ("a.ply", ply() + POINTS.replace(b"1 0 0", b"nan 0 0") + FACES, "line 11: .* finite"),
        ("a.ply", ply() + POINTS + FACES.replace(b"1 3", b"1 -1"), "line 15: a face needs"),
        ("a.ply", ply() + POINTS + FACES.replace(b"1 3", b"1 9"), "line 15: .* vertex 9, .* are 4"),
        ("a.ply", ply("klingon"), "line 2: the format must be one of ascii"),
        ("a.ply", ply(faces=-4), "line 7: an element needs a name and a count"),
        ("a.ply", ply(x="quux x"), "line 4: a property needs .* got 'property quux x'"),
        ("a.ply", ply(x="float w"), "must name vertices with the properties x, y and z"),
        ("a.ply", b"ply\n1 0 0\n", "no 'end_header'"),
        ("a.ply", b"hello", "PLY files begin with 'ply', got 'hello'"),
        ("a.ply", binary_ply()[:-5], "cut off: .* at least 100 bytes, but 95 follow"),
        ("a.ply", binary_ply(last=-1), r"1 of 4 do not: face 3 is \[1, 2, -1\]"),
        ("a.ply", binary_ply(z=np.nan), r"1 of 4 vertices are not finite: vertex 3"),
        ("a.off", OFF.replace(b"4 4 0", b"4.5 4 0"), "counts .* got '4.5 4 0'"),
        ("a.off", OFF.replace(b"4 4 0", b"9" * 5000 + b" 4"), "counts of vertices and faces"),
        ("a.off", OFF.replace(b"\n1 0 0", b"\n1 0"), "line 4: a vertex needs three"),
        ("a.off", OFF.replace(b"1 3\n", b"1\n"), "line 8: a face needs a count .* got '3 0 1'"),
        ("a.off", OFF.replace(b"1 3\n", b"1 9\n"), "line 8: a face has vertex 9"),
        ("a.off", b"hello\n", "line 1: OFF files begin with 'OFF'"),
        ("a.obj", OBJ.replace(b"v 1 0 0", b"v 1 0"), "line 2: a vertex needs .* got 'v 1 0'"),
        ("a.obj", OBJ.replace(b"v 1 0 0", b"v 1e400 0 0"), "line 2: a vertex needs three finite"),
        ("a.obj", OBJ.replace(b"f 1 2 4", b"f 1 2"), "line 6: a face needs three"),
        ("a.obj", OBJ.replace(b"f 1 2 4", b"f 1.5 2 4"), "line 6: a face needs three whole"),
        ("a.obj", OBJ.decode().encode("utf-16"), "in UTF-16; save it in UTF-8"),
    ],
)
def test_wrong_lines_are_named(tmp_path, name, content, message):
    """Vertices that are NaN, faces of two, of -1 or cut off were lost without a word."""
    (tmp_path / name).write_bytes(content)
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
