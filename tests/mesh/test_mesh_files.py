"""What is written is read back, node order included; bad files are refused by name."""

import numpy as np
import pytest
import torch

from diffsim import mesh as m
from diffsim.core.errors import MeshError
from diffsim.mesh.files import SURFACE_FORMATS, VOLUME_FORMATS


@pytest.fixture(params=["hex", "tet"])
def mesh(request):
    return m.hex_sphere(0.1, 0.05) if request.param == "hex" else m.tet_box((2, 3, 1))


@pytest.mark.parametrize("suffix", VOLUME_FORMATS)
def test_volumes(mesh, suffix, tmp_path):
    path = m.save(mesh, tmp_path / "deep" / f"mesh{suffix}")
    back = m.load(path)
    assert torch.equal(back.elements, mesh.elements)
    # text formats write 16 digits
    torch.testing.assert_close(back.x_rest, mesh.x_rest, rtol=1e-15, atol=1e-17)
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # nothing left behind
    scaled = m.load(path, scale=1e-3)
    torch.testing.assert_close(scaled.x_rest, mesh.x_rest * 1e-3, rtol=1e-14, atol=1e-20)


@pytest.mark.parametrize("suffix", SURFACE_FORMATS)
def test_surfaces(mesh, suffix, tmp_path):
    back = m.load_surface(m.save(mesh, tmp_path / f"mesh{suffix}"))
    assert back.is_watertight
    # STL, PLY and GLB hold float32
    assert back.volume == pytest.approx(m.to_trimesh(mesh).volume, rel=1e-5)
    size = float((mesh.bounds[1] - mesh.bounds[0]).min())
    assert m.voxelize(tmp_path / f"mesh{suffix}", size / 5).num_elements > 50


def test_vtk_order_is_the_standard_one(tmp_path):
    import meshio

    m.save(m.hex_box((1, 1, 1)), tmp_path / "a.vtk")
    raw = meshio.read(tmp_path / "a.vtk")
    walk = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]  # VTK file formats, cell type 12
    expected = walk + [[a, b, 1] for a, b, _ in walk]
    np.testing.assert_array_equal(raw.points[raw.cells[0].data[0]], expected)


def test_data_and_positions(mesh, tmp_path):
    import meshio

    x = mesh.x_rest + 1.0
    path = tmp_path / "a.vtu"
    volume = m.element_volumes(mesh)
    m.save(mesh, path, x=x, node_data={"u": x - mesh.x_rest}, element_data={"volume": volume})
    raw = meshio.read(path)
    np.testing.assert_array_equal(raw.points, x.numpy())
    np.testing.assert_array_equal(raw.cell_data["volume"][0], volume.numpy())
    with pytest.raises(ValueError, match=r"node_data\['u'\] must have .* rows, got shape"):
        m.save(mesh, path, node_data={"u": x[1:]})
    with pytest.raises(ValueError, match=r".stl files hold no data"):
        m.save(mesh, tmp_path / "a.stl", node_data={"u": x})


def test_names(mesh, tmp_path):
    with pytest.raises(ValueError, match=r"got '.vtx' .*did you mean .vt"):
        m.save(mesh, tmp_path / "a.vtx")
    with pytest.raises(ValueError, match=r"a.stl is a surface: read it with .*load_surface"):
        m.load(tmp_path / "a.stl")
    with pytest.raises(ValueError, match=r"a.vtk is a volume mesh: read it with"):
        m.load_surface(tmp_path / "a.vtk")
    m.save(mesh, tmp_path / "finger.vtu")
    with pytest.raises(FileNotFoundError, match=r"did you mean finger.vtu"):
        m.load(tmp_path / "fingr.vtu")


def test_contents(tmp_path):
    import meshio

    hexes, tets = m.hex_box((1, 1, 1)), m.tet_box((1, 1, 1))
    x = hexes.x_rest.numpy()
    cells = {"hexahedron": hexes.hexes.numpy()[:, m.VTK_FROM_HEX], "tetra": tets.tets.numpy()}
    meshio.Mesh(x, list(cells.items())).write(tmp_path / "mixed.vtk")
    with pytest.raises(MeshError, match=r"either tetra or hexahedron .*1 hexahedron and 6 tetra"):
        m.load(tmp_path / "mixed.vtk")
    meshio.Mesh(x, [("triangle", np.array([[0, 1, 2]]))]).write(tmp_path / "flat.vtk")
    with pytest.raises(MeshError, match="holds no volume elements, only triangle"):
        m.load(tmp_path / "flat.vtk")
    (tmp_path / "bad.vtu").write_text("no mesh")
    with pytest.raises(MeshError, match=r"bad.vtu could not be read as vtu"):
        m.load(tmp_path / "bad.vtu")
    # boundary triangles and a stray node are dropped, as Gmsh writes them
    extra = np.concatenate([x, [[9.0, 9.0, 9.0]]])
    blocks = [("triangle", np.array([[0, 1, 2]])), ("tetra", cells["tetra"])]
    meshio.Mesh(extra, blocks).write(tmp_path / "stray.vtk")
    assert m.load(tmp_path / "stray.vtk").num_vertices == 8
    meshio.Mesh(x, [("tetra", cells["tetra"][:, [0, 1, 3, 2]])]).write(tmp_path / "left.vtk")
    with pytest.raises(MeshError, match=r"6 of 6 elements are inverted.*load_arrays"):
        m.load(tmp_path / "left.vtk")
    assert m.repair(*m.load_arrays(tmp_path / "left.vtk")).num_elements == 6


def test_entities_of_a_vtu_are_refused_in_words(tmp_path):
    """meshio said "1", and read on."""
    m.save(m.hex_box((1, 1, 1)), tmp_path / "box.vtu")
    content = (tmp_path / "box.vtu").read_bytes()
    entity = b"<!DOCTYPE x [<!ENTITY a SYSTEM 'file:///etc/hostname'>]><VTKFile"
    (tmp_path / "box.vtu").write_bytes(content.replace(b"<VTKFile", entity))
    with pytest.raises(MeshError, match=r"box.vtu, line 2: a document type .* is not read"):
        m.load(tmp_path / "box.vtu")
    (tmp_path / "box.vtu").write_bytes(content[:300])
    with pytest.raises(MeshError, match=r"box.vtu could not be read as vtu: \D{5}"):
        m.load(tmp_path / "box.vtu")
