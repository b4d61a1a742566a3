"""Regions of material from GMSH, VTK and Abaqus: the right elements under the right name."""

import numpy as np
import pytest
import torch

from diffsim import mesh as m
from diffsim import soft
from diffsim.core.errors import MeshError

# Two tetrahedra that share a face, and a triangle of the boundary; "bone" is the second one.
GMSH_41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
3
2 5 "skin"
3 7 "rubber"
3 9 "bone"
$EndPhysicalNames
$Entities
0 0 1 2
1 0 0 0 1 1 0 1 5 0
1 0 0 0 1 1 1 1 7 0
2 0 0 0 1 1 1 {groups} 0
$EndEntities
$Nodes
1 5 1 5
3 1 0 5
1
2
3
4
5
0 0 0
1 0 0
0 1 0
0 0 1
1 1 1
$EndNodes
$Elements
3 3 1 3
2 1 2 1
1 1 2 3
3 1 4 1
2 1 2 3 4
3 2 4 1
3 2 5 3 4
$EndElements
"""


def test_gmsh_groups(tmp_path):
    path = tmp_path / "two.msh"
    path.write_text(GMSH_41.format(groups="1 9"))
    part = m.load_regions(path, scale=1e-3)
    assert part.names == ("rubber", "bone") and part.region.tolist() == [0, 1]
    assert part.elements("bone").tolist() == [1]
    # the second tetrahedron is the one with the corner (1, 1, 1) mm
    far = part.mesh.x_rest[part.mesh.elements[part.elements("bone")]].max()
    assert float(far) == pytest.approx(1e-3)
    path.write_text(GMSH_41.format(groups="2 7 9"))
    assert m.load(path).num_elements == 2  # groups that overlap are no matter without regions
    with pytest.raises(MeshError, match=r"1 elements, the first 1, are in two groups, 'rubber'"):
        m.load_regions(path)
    assert m.load_regions(path, key="gmsh:geometrical").names == ("1", "2")


def test_gmsh_2_and_unnamed_groups(tmp_path):
    import meshio

    box = m.tet_box((2, 1, 1))
    tag = np.where(box.x_rest[box.elements].mean(1)[:, 0].numpy() < 0.5, 7, 3)
    triangle = np.array([[0, 1, 2]])
    cells = [("triangle", triangle), ("tetra", box.elements.numpy())]
    data = {k: [np.array([1]), tag] for k in ("gmsh:physical", "gmsh:geometrical")}
    names = {"soft": np.array([7, 3]), "skin": np.array([1, 2])}
    raw = meshio.Mesh(box.x_rest.numpy(), cells, cell_data=data, field_data=names)
    raw.write(tmp_path / "a.msh", file_format="gmsh22", binary=False)
    part = m.load_regions(tmp_path / "a.msh")
    assert part.names == ("3", "soft")
    assert torch.equal(part.region == 1, torch.from_numpy(tag == 7))


def test_cell_data(tmp_path):
    box = m.hex_box((4, 1, 1))
    region = torch.tensor([4, 4, 2, 2])
    stiff = torch.tensor([1.5, 2.0, 2.5, 3.0])
    path = m.save(box, tmp_path / "a.vtu", element_data={"region": region, "E": stiff})
    part = m.load_regions(path)
    assert part.names == ("2", "4") and part.region.tolist() == [1, 1, 0, 0]
    assert torch.equal(part.element_data["E"], stiff.double())
    with pytest.raises(ValueError, match=r"'E' must be one whole number .*element_data\['E'\]"):
        m.load_regions(path, key="E")
    both = {"region": region, "batch": torch.arange(4)}
    path = m.save(box, tmp_path / "b.vtk", element_data=both)
    with pytest.raises(ValueError, match="several cell data of whole numbers: region, batch"):
        m.load_regions(path)
    assert m.load_regions(path, key="region").names == ("2", "4")
    with pytest.raises(ValueError, match="did you mean 'region'"):
        m.load_regions(path, key="regions")
    with pytest.raises(ValueError, match="holds no regions"):
        m.load_regions(m.save(box, tmp_path / "c.vtu"))


def test_abaqus_sets(tmp_path):
    import meshio

    box = m.hex_box((3, 1, 1))
    raw = meshio.Mesh(box.x_rest.numpy(), [("hexahedron", box.elements.numpy())])
    raw.cell_sets = {"tip": [np.array([2])]}
    raw.write(tmp_path / "a.inp")
    with pytest.raises(MeshError):  # meshio writes its own node order: not ours, and refused
        m.load_regions(tmp_path / "a.inp")
    path = m.save(box, tmp_path / "b.inp")
    path.write_text(path.read_text() + "*ELSET, ELSET=tip\n3\n")
    part = m.load_regions(path)
    assert part.names == ("tip",) and part.region.tolist() == [-1, -1, 0]
    assert part.values({"tip": 2.0}, default=1.0).tolist() == [1.0, 1.0, 2.0]
    with pytest.raises(ValueError, match="no value for 2 elements that are in no region"):
        part.values({"tip": 2.0})


def test_values_reach_a_body_with_gradient(tmp_path):
    box = m.hex_box((4, 1, 1), (0.4, 0.1, 0.1))
    half = torch.tensor([0, 0, 1, 1])
    part = m.load_regions(m.save(box, tmp_path / "a.vtu", element_data={"region": half}))
    modulus = torch.tensor(2e5, dtype=torch.float64, requires_grad=True)
    young = part.values({"0": modulus, "1": 1e6})
    assert young.tolist() == [2e5, 2e5, 1e6, 1e6]
    body = soft.SoftBody(
        part.mesh,
        dt=0.01,
        youngs_modulus=young.detach(),
        poissons_ratio=0.3,
        density=part.values({"0": 1000.0, "1": 1200.0}),
        fixed=part.mesh.nodes_near_plane("x", 0.0),
    )
    assert float(body.physics().mass.sum()) == pytest.approx(0.004 * 1100)
    body.static_equilibrium(physics=body.physics(youngs_modulus=young)).x[:, 2].mean().backward()
    assert float(modulus.grad) > 0  # stiffer: sags less
    with pytest.raises(ValueError, match=r"no region 'O'.*it has 0, 1"):
        part.values({"O": 1.0})
    with pytest.raises(ValueError, match="no value for regions 1"):
        part.values({"0": 1.0})
    with pytest.raises(ValueError, match=r"value of region '0' must have shape \(\)"):
        part.values({"0": torch.ones(2, dtype=torch.float64)}, default=1.0)
