"""Finished devices for workshop and viewers: closed solids, the field itself, all files."""

import warnings

import numpy as np
import pytest
import torch

from diffsim.cli.main import main
from diffsim.stokes import devices
from tests.optional import needs
from tests.stokes.test_devices import some_design
from tests.stokes.test_export import _read_image

needs("matplotlib")
needs("rerun")


@pytest.fixture(autouse=True)
def _coarse():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


@pytest.fixture
def export():
    from diffsim.viz.device_files import export

    return export


def cavity(solid):
    """What a block lacks of its bounding box, in the file's unit [mm^3]."""
    return float(np.prod(solid.extents)) - solid.volume


def fluid(device, x):
    """Fluid in the box, from the cut cells [m^dim]."""
    field = device.solve(x)
    return float(field.volume_fraction.sum()) * field.grid.cell_volume


@pytest.mark.story  # solids of a whole device
def test_amplifier_has_a_floor_and_a_depth(tmp_path, export):
    import trimesh

    device = devices.make("amplifier", 0.5)
    x = torch.tensor([0.4, 0.125, 0.9, 0.25, 0.3], dtype=torch.float64)
    files = export(device, x, tmp_path / "new", size=0.08)
    assert [f.name for f in files] == [f"amplifier.{end}" for end in ("stl", "vti", "rrd", "png")]
    assert all(f.stat().st_size > 1000 for f in files)
    solid = trimesh.load(files[0])
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert len(solid.split()) == 1
    # 80 mm long, a quarter of that deep, a floor of a twentieth; open where the flow passes
    assert solid.extents[0] == pytest.approx(80.0, rel=1e-5)  # float32 in the file
    assert solid.extents[2] == pytest.approx(80.0 * 0.3, rel=1e-5)
    # all that is missing is the channel, whose walls are those of the cut cells to second order
    scale = 80.0 / device.grid.size[0]
    assert cavity(solid) == pytest.approx(fluid(device, x) * scale**2 * 20.0, rel=0.01)
    # the channel leaves through the end: there the solid ends in less than the block's side
    end = np.isclose(solid.triangles[:, :, 0], solid.bounds[1, 0]).all(1)
    outlet = 0.4 * scale * 20.0
    side = float(solid.extents[1] * solid.extents[2])
    assert float(solid.area_faces[end].sum()) == pytest.approx(side - outlet, rel=0.01)


@pytest.mark.parametrize(
    ("name", "resolution"),
    [
        pytest.param("averager", 0.25, marks=pytest.mark.story),
        pytest.param("funnel", 0.25, marks=pytest.mark.story),
        ("gate", 0.2),
    ],
)
def test_devices_of_two_inlets(tmp_path, export, name, resolution):
    import trimesh

    device = devices.make(name, resolution)
    x = some_design(device)
    files = export(device, x, tmp_path)
    solid = trimesh.load(files[0])
    assert solid.is_watertight
    assert solid.volume > 0.0
    cases = [c.replace(" ", "_") for c in device.cases]
    expected = {f"{name}.stl", f"{name}.vti"}
    expected |= {f"{name}_{c}.{end}" for c in cases for end in ("rrd", "png")}
    assert {f.name for f in tmp_path.iterdir()} == expected
    # the image holds both cases, x running fastest
    arrays = _read_image(tmp_path / f"{name}.vti")
    velocity = device.solve(x).velocity.numpy()
    for k in (0, 1):
        np.testing.assert_array_equal(
            arrays[f"velocity_{k}"], velocity[k].transpose(2, 1, 0, 3).reshape(-1, 3)
        )


def test_twister_holds_its_tunnel(tmp_path, export):
    import trimesh

    device = devices.make("twister", 0.25)
    x = some_design(device)
    solid = trimesh.load(export(device, x, tmp_path, size=1.0)[0])
    assert solid.is_watertight
    # all that is missing of the block is the tunnel of the cut cells, to second order
    assert cavity(solid) * 1e-9 == pytest.approx(fluid(device, x), rel=0.01)
    # the tunnel runs from top to bottom: the block has one handle, Euler number 0
    assert solid.euler_number == 0


@pytest.mark.story  # solids of a whole device
def test_switch_has_a_solid_for_each_position(tmp_path, export):
    import trimesh

    device = devices.make("switch", 0.25)
    names = {f.name for f in export(device, some_design(device), tmp_path)}
    assert names == {f"switch_{p}.{e}" for p in ("on", "off") for e in ("stl", "vti", "rrd", "png")}
    on, off = (trimesh.load(tmp_path / f"switch_{p}.stl") for p in ("on", "off"))
    assert on.is_watertight
    assert off.is_watertight
    # the obstacle only turns: the same solid to the accuracy of 16 cells
    assert on.volume == pytest.approx(off.volume, rel=0.02)
    assert not np.array_equal(on.vertices[:100], off.vertices[:100])


@pytest.mark.story  # solids of a whole device
def test_command_line_exports(tmp_path, capsys):
    arguments = ["devices", "amplifier", "--resolution", "0.375", "--sample-resolution", "0.25"]
    arguments += ["--samples", "3", "--starts", "1", "--checked", "2", "--evaluations", "3"]
    assert main([*arguments, "--export", "--out", str(tmp_path)]) == 0
    written = {f.name for f in tmp_path.iterdir()}
    assert written == {
        "progress.jsonl", "result.json", "flow.png", "shapes.png",
        "amplifier.stl", "amplifier.vti", "amplifier.rrd", "amplifier.png",
    }  # fmt: skip
    assert "unit loss on the coarse grid" in capsys.readouterr().out
    assert main(["devices", "amplifier", "--export"]) == 2
    assert "--export needs --out" in capsys.readouterr().err


def test_size_must_be_a_length(tmp_path, export):
    device = devices.make("amplifier", 0.25)
    with pytest.raises(ValueError, match="size must"):
        export(device, some_design(device), tmp_path, size=0.0)
