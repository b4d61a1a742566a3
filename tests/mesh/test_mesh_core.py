"""Meshes are checked once; every refusal names the culprits and the cure."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from diffsim import mesh as m
from diffsim.core.errors import MeshError

CELLS = st.tuples(*[st.integers(1, 4)] * 3)
SIZE = st.tuples(*[st.floats(1e-3, 10.0)] * 3)
ORIGIN = st.tuples(*[st.floats(-5.0, 5.0)] * 3)


def reference(name):
    data = Path(os.environ.get("DIFFSIM_DATA", Path(__file__).parents[3] / "shared/data"))
    path = data / "soft_reference" / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"reference vectors not found at {path}; set DIFFSIM_DATA to shared/data")
    return np.load(path)


def two_tets():
    x = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=torch.float64)
    return x, torch.tensor([[0, 1, 2, 3], [1, 2, 3, 4]])


@pytest.mark.reference
def test_order_of_nodes_and_elements_is_that_of_the_reference():
    ref = reference("materials_static")
    hexes, tets = m.hex_box((3, 2, 1), (0.3, 0.2, 0.1)), m.tet_box((3, 2, 1), (0.3, 0.2, 0.1))
    # one unit in the last place of 0.3: 3 * 0.1 against 0.3 / 3 * 3
    np.testing.assert_allclose(hexes.x_rest.numpy(), ref["X"], rtol=0, atol=6e-17)
    np.testing.assert_array_equal(hexes.hexes.numpy(), ref["hexes"])
    # its tets are the same sets in the same order; half of them are left-handed, ours are not
    np.testing.assert_array_equal(np.sort(tets.tets.numpy()), np.sort(ref["tets"]))


@pytest.mark.property
@settings(max_examples=30, deadline=None)
@given(cells=CELLS, size=SIZE, origin=ORIGIN)
def test_boxes(cells, size, origin):
    for make, per_cell in ((m.hex_box, 1), (m.tet_box, 6)):
        mesh = make(cells, size, origin)
        nx, ny, nz = cells
        assert mesh.num_vertices == (nx + 1) * (ny + 1) * (nz + 1)
        assert mesh.num_elements == per_cell * nx * ny * nz
        # coordinates up to 15 m are rounded to 2e-15 m; the thinnest cell has 1e-3/4 m
        assert m.total_volume(mesh) == pytest.approx(np.prod(size), rel=1e-10)
        assert len(m.surface_triangles(mesh).faces) == 4 * (nx * ny + ny * nz + nz * nx)
        nodes = m.nodal_volume(mesh)
        assert bool((nodes > 0).all())
        assert float(nodes.sum()) == pytest.approx(np.prod(size), rel=1e-10)


def test_a_mesh_owns_its_tensors():
    x, tets = two_tets()
    mesh = m.TetMesh(x, tets)
    x += 1.0
    assert float(mesh.x_rest.min()) == 0.0
    with pytest.raises(AttributeError):
        mesh.x_rest = x
    assert mesh.num_vertices == 5 and mesh.num_elements == 2 and mesh.num_dofs == 15
    assert mesh.elements is mesh.tets
    assert repr(mesh).startswith("TetMesh(5 nodes, 2 elements, x in [0, 1]")


def test_non_contiguous_input_is_taken():
    x, tets = two_tets()
    mesh = m.TetMesh(x.T.contiguous().T, tets.T.contiguous().T)
    assert mesh.x_rest.is_contiguous() and mesh.tets.is_contiguous()


def test_arguments_of_wrong_type():
    x, tets = two_tets()
    with pytest.raises(TypeError, match=r"x_rest must be torch.float64, got torch.float32"):
        m.TetMesh(x.float(), tets)
    with pytest.raises(TypeError, match=r"tets must be torch.int64"):
        m.TetMesh(x, tets.int())
    with pytest.raises(ValueError, match=r"tets must have shape \(num_elements, 4\)"):
        m.TetMesh(x, tets[:, :3])
    with pytest.raises(ValueError, match="x_rest must be finite, got 1 NaN"):
        m.TetMesh(torch.where(torch.arange(15).view(5, 3) == 7, torch.nan, x), tets)
    with pytest.raises(ValueError, match="must not require grad"):
        m.TetMesh(x.requires_grad_(), tets)


def test_bad_indices():
    x, tets = two_tets()
    with pytest.raises(MeshError, match="the mesh has no elements"):
        m.TetMesh(x, tets[:0])
    with pytest.raises(MeshError, match=r"1 of 2 elements does not: 1; check.*starts at 0") as e:
        m.TetMesh(x, tets + torch.tensor([[0], [1]]))
    assert e.value.indices == (1,)
    with pytest.raises(MeshError, match=r"uses a node more than once: 0; drop.*remove_degenerate"):
        m.TetMesh(x, torch.tensor([[0, 1, 2, 2], [1, 2, 3, 4]]))


def test_unused_and_coincident_nodes_and_their_repair():
    x, tets = two_tets()
    more = torch.cat([x, torch.full((1, 3), 9.0, dtype=torch.float64)])
    with pytest.raises(MeshError, match="1 of 6 nodes belongs to no element: 5; drop"):
        m.TetMesh(more, tets)
    assert m.TetMesh(*m.remove_unreferenced_nodes(more, tets)).num_vertices == 5

    split = torch.cat([x, x[1:2]])
    loose = torch.tensor([[0, 1, 2, 3], [5, 2, 3, 4]])
    with pytest.raises(MeshError, match="1 pair of nodes coincide: 1 and 5; merge them"):
        m.TetMesh(split, loose)
    mended = m.TetMesh(*m.merge_duplicate_nodes(split, loose))
    assert torch.equal(mended.tets, tets) and torch.equal(mended.x_rest, x)


def test_inverted_and_flat_tets_and_their_repair():
    x, tets = two_tets()
    turned = tets.clone()
    turned[1] = tets[1, [0, 1, 3, 2]]
    with pytest.raises(MeshError, match=r"1 of 2 elements is inverted.*left-handed.*: 1; mend"):
        m.TetMesh(x, turned)
    assert m.total_volume(m.TetMesh(*m.flip_inverted(x, turned))) == pytest.approx(0.5)
    level = x.clone()
    level[4] = torch.tensor([1.0, 1.0, 0.0])
    slab = torch.tensor([[0, 1, 2, 4]])
    with pytest.raises(MeshError, match=r"1 of 3 elements is inverted or degenerate.*: 2; drop"):
        m.TetMesh(level, torch.cat([tets, slab]))
    assert m.repair(level, torch.cat([turned, slab])).num_elements == 2


def test_inverted_hexes_and_their_repair():
    box = m.hex_box((2, 1, 1))
    mirrored = box.hexes.clone()
    mirrored[1] = mirrored[1, [1, 0, 3, 2, 5, 4, 7, 6]]
    with pytest.raises(MeshError, match=r"1 of 2 elements is inverted.*: 1; they are mirrored"):
        m.HexMesh(box.x_rest, mirrored)
    _, mended = m.flip_inverted(box.x_rest, mirrored)
    assert torch.equal(mended, box.hexes)
    with pytest.raises(MeshError, match="nodes are in VTK order"):
        m.HexMesh(box.x_rest, box.hexes[:, m.VTK_FROM_HEX])
    x = box.x_rest.clone()
    x[0] = torch.tensor([0.4, 0.9, 0.9])  # positive volume, but folded at a corner
    with pytest.raises(MeshError, match=r"1 of 2 elements is inverted.*: 0; move their nodes"):
        m.HexMesh(x, box.hexes)
    assert m.HexMesh(*m.remove_degenerate(x, box.hexes)).num_elements == 1


def test_selection():
    mesh = m.hex_box((4, 2, 2), (0.4, 0.2, 0.2))
    assert mesh.nodes_near_plane("x", 0.0).tolist() == list(range(9))
    assert torch.equal(mesh.nodes_near_plane(0, 0.4), mesh.nodes_where(lambda x: x[:, 0] > 0.39))
    with pytest.raises(MeshError, match=r"plane y = 0.33 m, the nearest is 0.13 m away"):
        mesh.nodes_near_plane(1, 0.33)
    with pytest.raises(MeshError, match=r"no node satisfies.*x in \[0, 0.4\]"):
        mesh.nodes_where(lambda x: x[:, 0] > 1)
    with pytest.raises(TypeError, match=r"predicate\(x_rest\) must be torch.bool"):
        mesh.nodes_where(lambda x: x[:, 0])
    with pytest.raises(ValueError, match="axis must be 0, 1, 2 or 'x', 'y', 'z', got 3"):
        mesh.nodes_near_plane(3, 0.0)


def test_edges():
    assert len(m.hex_box((1, 1, 1)).edges()) == 12
    assert len(m.hex_box((2, 1, 1)).edges()) == 20
    assert len(m.tet_box((1, 1, 1)).edges()) == 19  # 12, six face diagonals, one inside


@pytest.mark.parametrize("make", [m.hex_box, m.tet_box])
def test_meshes_whose_volume_has_no_room_are_refused(make):
    """Cubes of 1e-160 m had volumes of 0.0."""
    with pytest.raises(ValueError, match=r"size\[0\] must lie in \[1e-130, inf\), got 1e-160"):
        make((2, 1, 1), (1e-160,) * 3)
    for length in (1e-108, 1e-89, 1e101):
        with pytest.raises(MeshError, match="longest side must lie between 1e-88 and 1e\\+100"):
            make((2, 1, 1), (length, length, length))
    small = make((2, 1, 1), (1e-87,) * 3)
    assert m.total_volume(small) == pytest.approx(1e-261, rel=1e-9)
