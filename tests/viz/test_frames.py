"""The surface of a hexahedral mesh as a small file; small PNGs."""

import io

import numpy as np
import pytest

from diffsim.mesh import hex_box, surface_quads
from diffsim.viz.frames import pack, triangles
from tests.optional import needs


@pytest.mark.property
def test_surface_is_closed_and_faces_outwards():
    mesh = hex_box((4, 3, 2), (0.4, 0.3, 0.2))
    nodes, quads = np.unique(surface_quads(mesh).faces.numpy(), return_inverse=True)
    quads = quads.reshape(-1, 4)
    x = mesh.x_rest.numpy()[nodes]
    assert len(quads) == 2 * (4 * 3 + 3 * 2 + 4 * 2)
    assert len(nodes) == 5 * 4 * 3 - 3 * 2 * 1
    t = triangles(quads)
    edges = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    assert {tuple(e) for e in edges} == {tuple(e[::-1]) for e in edges}  # every edge both ways
    a, b, c = (x[t[:, i]] for i in range(3))
    volume = np.sum(a * np.cross(b, c)) / 6
    assert volume == pytest.approx(0.4 * 0.3 * 0.2)  # positive: outward; divergence theorem


def test_pack_round_trip():
    kept = np.load(io.BytesIO(pack(a=np.arange(3), b=np.eye(2))))
    np.testing.assert_array_equal(kept["a"], [0, 1, 2])
    np.testing.assert_array_equal(kept["b"], np.eye(2))


needs("matplotlib")


def test_png_has_a_palette_replaces_the_old_one_and_closes_the_figure(tmp_path):
    from matplotlib import pyplot as plt
    from PIL import Image

    from diffsim.viz.palette import save

    path = tmp_path / "made" / "line.png"
    for _ in range(2):
        figure, axes = plt.subplots(figsize=(2, 1))
        axes.plot([0, 1], color="#c2571a")
        assert save(figure, path, dpi=50) == path
        assert not plt.fignum_exists(figure.number)
    with Image.open(path) as picture:
        assert (picture.mode, picture.size) == ("P", (100, 50))
    assert [p.name for p in path.parent.iterdir()] == ["line.png"]
