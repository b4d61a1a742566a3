"""Tetrahedra of USD files: placed, in meters, z up, right-handed, with their regions."""

import numpy as np
import pytest
import torch

from diffsim import mesh as m
from diffsim.core.errors import MeshError

USDA = """#usda 1.0
( {layer} )
def Xform "World"
{{
    {placed}
    uniform token[] xformOpOrder = ["{order}"]
    def TetMesh "Body"
    {{
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)]
        int4[] tetVertexIndices = {tets}
        uniform token orientation = "{orientation}"
        def GeomSubset "rubber" {{
            uniform token elementType = "tetrahedron"
            int[] indices = [0]
        }}
        def GeomSubset "bone" {{
            uniform token elementType = "tetrahedron"
            int[] indices = {bone}
        }}
        def GeomSubset "skin" {{
            uniform token elementType = "face"
            int[] indices = [0]
        }}
    }}
}}
"""
TRANSLATED = "double3 xformOp:translate = (10, 0, 0)"
RIGHT = "[(0, 1, 2, 3), (1, 4, 2, 3)]"
LEFT = "[(0, 2, 1, 3), (1, 2, 4, 3)]"


def usd(tmp_path, *, placed=TRANSLATED, **changes):
    pytest.importorskip("pxr")
    path = tmp_path / "body.usda"
    given = {"layer": "", "tets": RIGHT, "orientation": "rightHanded", "bone": "[1]", **changes}
    path.write_text(USDA.format(placed=placed, order=placed.split()[1], **given))
    return path


def test_usd(tmp_path):
    part = m.load_regions(usd(tmp_path))
    assert part.names == ("rubber", "bone") and part.region.tolist() == [0, 1]
    assert part.mesh.x_rest[0].tolist() == [10.0, 0.0, 0.0]  # transforms are applied
    left = m.load(usd(tmp_path, tets=LEFT, orientation="leftHanded"))
    assert torch.equal(left.x_rest, part.mesh.x_rest)
    assert float(m.total_volume(left)) == pytest.approx(float(m.total_volume(part.mesh)))
    # OpenUSD itself finds the same ones inverted
    from pxr import Usd, UsdGeom

    wrong = usd(tmp_path, tets="[(0, 1, 2, 3), (1, 2, 4, 3)]")
    stage = Usd.Stage.Open(str(wrong))
    body = UsdGeom.TetMesh(stage.GetPrimAtPath("/World/Body"))
    assert list(UsdGeom.TetMesh.FindInvertedElements(body)) == [1]
    with pytest.raises(MeshError, match="1 of 2 elements is inverted"):
        m.load(wrong)


@pytest.mark.property
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_any_affine_map_of_usd_is_applied(tmp_path, side):
    """Rows times a matrix, as USD has it; what it mirrors is turned."""
    moved = np.random.default_rng(3).normal(size=(4, 3))
    moved[0] *= side * np.sign(np.linalg.det(moved[:3]))
    rows = ", ".join(f"({x}, {y}, {z}, {k // 3})" for k, (x, y, z) in enumerate(moved))
    found = m.load(usd(tmp_path, placed=f"matrix4d xformOp:transform = ({rows})"))
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    np.testing.assert_allclose(found.x_rest, points @ moved[:3] + moved[3], atol=1e-14)
    volume = abs(np.linalg.det(moved[:3])) * (1.0 / 6.0 + 1.0 / 3.0)
    assert float(m.total_volume(found)) == pytest.approx(volume)


def test_usd_units_and_up(tmp_path):
    said = m.load(usd(tmp_path, layer='metersPerUnit = 0.01\nupAxis = "Y"'))
    plain = m.load(usd(tmp_path)).x_rest
    turned = torch.stack([plain[:, 0], -plain[:, 2], plain[:, 1]], 1)
    torch.testing.assert_close(said.x_rest, 0.01 * turned, rtol=1e-15, atol=0)
    assert m.load(usd(tmp_path), scale=2.0).x_rest[0, 0] == 20.0


def test_usd_reads_one_file_alone(tmp_path):
    (tmp_path / "other.usda").write_text('#usda 1.0\ndef TetMesh "Secret" {}\n')
    with pytest.raises(ValueError, match=r"pulls in other files \(\./other.usda\)"):
        m.load(usd(tmp_path, layer="subLayers = [@./other.usda@]"))
    path = usd(tmp_path)
    path.write_text(path.read_text() + 'def "B" (references = @./other.usda@) {}\n')
    with pytest.raises(ValueError, match="pulls in other files"):
        m.load(path)
    path.write_text("#usda 1.0\n")
    with pytest.raises(MeshError, match="must hold one TetMesh, it holds 0"):
        m.load(path)
    with pytest.raises(MeshError, match="names tetrahedron 8, there are 2"):
        m.load(usd(tmp_path, bone="[8]"))
    with pytest.raises(ValueError, match="USD is read, not written"):
        m.save(m.tet_box((1, 1, 1)), tmp_path / "a.usda")
