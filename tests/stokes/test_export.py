"""Solids to fabricate, VTK files, streamlines."""

import base64
import warnings
import xml.etree.ElementTree as ET
from dataclasses import replace

import meshio
import numpy as np
import pytest
import torch

from diffsim.core.errors import MeshError
from diffsim.stokes.boundary import Boundary, Inlet, Open
from diffsim.stokes.cells import cut_cells
from diffsim.stokes.export import (
    channel_mesh,
    fabrication_mesh,
    fabrication_report,
    wall_mesh,
    write_stl,
    write_vtk,
)
from diffsim.stokes.field import FlowField
from diffsim.stokes.grid import Grid
from diffsim.stokes.isosurface import negative_part
from diffsim.stokes.streamlines import _equal_shares, inlet_seeds, streamlines

RADIUS = 0.3


def tube(n=16, length=2.0):
    grid = Grid((2 * n, n, n), size=(length, 1.0, 1.0))
    return grid, RADIUS - (grid.nodes[..., 1:] - 0.5).norm(dim=-1)


def narrowing(n=24):
    """A 2D channel that narrows from half to a fifth of the box."""
    grid = Grid((2 * n, n), size=(2e-3, 1e-3))
    x, y = grid.nodes.unbind(-1)
    half = 0.25e-3 - 0.15e-3 * torch.sigmoid((x - 1e-3) / 1e-4)
    return grid, half - (y - 0.5e-3).abs()


def obstacle(n=24):
    """A 2D channel that fills the box's height around a round island."""
    grid = Grid((2 * n, n), size=(2.0, 1.0))
    return grid, (grid.nodes - torch.tensor([1.0, 0.5], dtype=torch.float64)).norm(dim=-1) - 0.2


def made_field(grid, phi, velocity):
    """A field of given velocities, without a solve."""
    cases = velocity.shape[0]
    pressure = grid.centers[..., 0].expand(cases, *grid.shape).contiguous()
    fraction = cut_cells(grid, phi).volume / grid.cell_volume
    return FlowField(grid, phi, velocity, pressure, fraction, {})


def channel_field(n=16, dim=2):
    """Parabolic flow along x between y = 0.25 and 0.75."""
    grid = Grid((2 * n, *[n] * (dim - 1)), size=(2.0, *[1.0] * (dim - 1)))
    phi = 0.25 - (grid.nodes[..., 1] - 0.5).abs()
    velocity = torch.zeros(1, *grid.node_shape, dim, dtype=torch.float64)
    velocity[0, ..., 0] = (1.0 - ((grid.nodes[..., 1] - 0.5) / 0.25) ** 2).clamp(min=0.0)
    return made_field(grid, phi, velocity)


@pytest.mark.property
def test_both_sides_of_any_level_set_close_and_fill_the_box():
    import trimesh

    rng = np.random.default_rng(0)
    coords = [np.cumsum(rng.uniform(0.1, 1.0, n)) for n in (5, 6, 4)]
    level = rng.normal(size=(5, 6, 4))
    volume = 0.0
    for sign in (1.0, -1.0):
        mesh = trimesh.Trimesh(*negative_part(coords, sign * level), process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent
        volume += mesh.volume
    box = np.prod([c[-1] - c[0] for c in coords])
    assert volume == pytest.approx(box, rel=1e-12)  # same cuts from both sides


def test_nodes_on_the_wall_leave_no_gap():
    import trimesh

    level = np.zeros((4, 4, 4))
    level[2:] = 1.0
    mesh = trimesh.Trimesh(*negative_part([np.arange(4.0)] * 3, level), process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(9.0 * 1.01)  # zeros count as solid, 0.01 cells further


@pytest.mark.reference
def test_block_around_a_tube():
    grid, phi = tube()
    mesh = fabrication_mesh(grid, phi)
    report = fabrication_report(mesh)
    assert report.is_watertight and report.num_parts == 1 and not report.cavity_volumes
    assert mesh.euler_number == 0  # one hole, open at both ends
    np.testing.assert_allclose(mesh.extents, grid.size, rtol=1e-12)
    assert mesh.volume == pytest.approx(2.0 - 2.0 * np.pi * RADIUS**2, rel=0.01)
    cells = grid.num_cells * grid.cell_volume - float(cut_cells(grid, phi).volume.sum())
    assert mesh.volume == pytest.approx(cells, rel=3e-3)  # both of second order
    assert channel_mesh(grid, phi).volume + mesh.volume == pytest.approx(2.0, rel=1e-9)


@pytest.mark.order
def test_volume_is_of_second_order():
    error = []
    for n in (8, 16, 32):
        grid, phi = tube(n)
        error.append(abs(channel_mesh(grid, phi).volume - 2.0 * np.pi * RADIUS**2))
    order = np.polyfit(np.log([1 / 8, 1 / 16, 1 / 32]), np.log(error), 1)[0]
    assert order == pytest.approx(2.0, abs=0.25)  # the error of a circle oscillates with the grid


@pytest.mark.reference
def test_shell_around_a_tube():
    grid, phi = tube()
    mesh = fabrication_mesh(grid, phi, wall_thickness=0.15)
    assert mesh.is_watertight and mesh.euler_number == 0
    ring = 2.0 * np.pi * ((RADIUS + 0.15) ** 2 - RADIUS**2)
    assert mesh.volume == pytest.approx(ring, rel=0.02)  # h = 1/16: two cells and a half
    thick = fabrication_mesh(grid, phi, wall_thickness=0.3)  # reaches beyond the box
    assert thick.volume == pytest.approx(2.0 * np.pi * (0.6**2 - RADIUS**2), rel=0.02)
    np.testing.assert_allclose(thick.extents, [2.0, 1.2, 1.2], rtol=5e-3)
    scaled = fabrication_mesh(grid, 7.0 * phi, wall_thickness=0.15)  # phi need not be a distance
    assert scaled.volume == pytest.approx(mesh.volume, rel=1e-9)
    with pytest.raises(ValueError, match=r"wall_thickness must lie in .* two cells"):
        fabrication_mesh(grid, phi, wall_thickness=0.1)


def test_closed_faces_get_a_wall():
    grid, phi = tube()
    blind = fabrication_mesh(grid, phi, openings=["x-"], margin=0.1)
    assert blind.is_watertight and blind.euler_number == 2  # a blind hole: no handle
    np.testing.assert_allclose(blind.extents, [2.1, 1.0, 1.0], rtol=1e-9)
    shell = fabrication_mesh(grid, phi, wall_thickness=0.15, openings=["x-"])
    assert shell.is_watertight and shell.euler_number == 2
    assert shell.bounds[1, 0] == pytest.approx(2.15, abs=0.01)
    with pytest.raises(ValueError, match="openings touch no fluid"):
        fabrication_mesh(grid, phi, openings=["y+"])


@pytest.mark.property
@pytest.mark.parametrize("seed", range(6))
def test_rough_designs_close(tmp_path, seed):
    """Random level sets with random openings, as read back from single precision."""
    import trimesh

    generator = torch.Generator().manual_seed(seed)
    shape = [8, 9, 7][: 2 + seed % 2]
    grid = Grid(shape, spacing=[0.1, 0.13, 0.11][: len(shape)])
    phi = 0.1 * torch.randn(grid.node_shape, dtype=torch.float64, generator=generator)
    boundary = Boundary(grid, [Inlet("x-", where=lambda p: p[:, 1] < 0.5), Open("y+")])
    flat = {"height": 0.1, "floor": 0.05} if grid.dim == 2 else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # loose parts and cavities there are
        for openings in (None, ["x-", "y+"], boundary):
            for thickness in (None, 0.3):
                mesh = fabrication_mesh(
                    grid, phi, openings=openings, wall_thickness=thickness, **flat
                )
                path = write_stl(tmp_path / "rough.stl", mesh)
                assert trimesh.load_mesh(path).is_watertight


def test_inlet_in_a_part_of_a_face():
    grid = Grid((16, 16, 16), size=1.0)
    phi = torch.full(grid.node_shape, 0.05, dtype=torch.float64)
    phi[6:9, 6:9, 6:9] = -0.05
    center = torch.tensor([0.5, 0.5], dtype=torch.float64)
    boundary = Boundary(
        grid, [Inlet("x-", where=lambda p: (p[:, 1:] - center).norm(dim=-1) < 0.26), Open("z+")]
    )
    with pytest.warns(UserWarning, match="1 of 2 solid parts are loose"):
        mesh = fabrication_mesh(grid, phi, openings=boundary, margin=0.2)
    report = fabrication_report(mesh)
    assert report.is_watertight
    np.testing.assert_allclose(report.size, [1.4, 1.4, 1.2], rtol=1e-9)
    hull = mesh.split(only_watertight=True)[0]
    assert hull.euler_number == 0  # in at x-, out at z+


def test_flat_channel_with_floor_is_one_part(tmp_path):
    import trimesh

    grid, phi = narrowing()
    with pytest.warns(UserWarning, match=r"1 of 2 solid parts are loose.*floor="):
        fabrication_mesh(grid, phi, height=0.2e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = fabrication_mesh(grid, phi, height=0.2e-3, floor=0.1e-3)
        closed = fabrication_mesh(grid, phi, height=0.2e-3, floor=0.1e-3, lid=0.1e-3)
    fluid = float(cut_cells(grid, phi).volume.sum()) * 0.2e-3
    assert mesh.is_watertight and closed.is_watertight
    assert (mesh.euler_number, closed.euler_number) == (2, 0)  # a groove, a bore
    # the skin between channel and plate is 0.01 cells thick
    assert mesh.volume == pytest.approx(2e-6 * 0.3e-3 - fluid, rel=5e-3)
    assert closed.volume == pytest.approx(2e-6 * 0.4e-3 - fluid, rel=5e-3)
    path = write_stl(tmp_path / "sub" / "channel.stl", mesh)
    again = trimesh.load_mesh(path)
    assert again.is_watertight
    np.testing.assert_allclose(again.extents, [2.0, 1.0, 0.3], rtol=1e-6)  # millimeters
    assert again.volume == pytest.approx(mesh.volume * 1e9, rel=1e-5)  # single precision


def test_flat_shell_has_plates_of_its_outline():
    grid, phi = narrowing()
    mesh = fabrication_mesh(grid, phi, wall_thickness=0.15e-3, height=0.2e-3, floor=0.1e-3)
    assert mesh.is_watertight and fabrication_report(mesh).num_parts == 1
    assert mesh.extents[1] == pytest.approx(0.8e-3, rel=0.02)


def test_island_is_reported_as_loose():
    grid, phi = obstacle()
    boundary = Boundary(grid, [Inlet("x-"), Open("x+")])
    with pytest.warns(UserWarning, match=r"loose"):
        mesh = fabrication_mesh(grid, phi, height=0.1, openings=boundary)
    report = fabrication_report(mesh)
    assert report.num_parts == 3  # two side walls and the island
    assert min(report.part_volumes) == pytest.approx(np.pi * 0.04 * 0.1, rel=0.02)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        held = fabrication_mesh(grid, phi, height=0.1, floor=0.05, openings=boundary)
    assert fabrication_report(held).num_parts == 1


def test_cavity_is_reported():
    grid = Grid((12, 12, 12), size=1.0)
    center = torch.full((3,), 0.5, dtype=torch.float64)
    bubble = 0.2 - (grid.nodes - center).norm(dim=-1)
    pipe = 0.12 - (grid.nodes[..., 1:] - 0.15).norm(dim=-1)
    with pytest.warns(UserWarning, match="1 cavities have no way out"):
        mesh = fabrication_mesh(grid, torch.maximum(bubble, pipe))
    (volume,) = fabrication_report(mesh).cavity_volumes
    assert volume == pytest.approx(4 / 3 * np.pi * 0.2**3, rel=0.1)  # radius of 2.4 cells


def test_wrong_arguments_say_what_to_do(tmp_path):
    grid, phi = narrowing()
    solid = -torch.ones_like(phi)
    with pytest.raises(ValueError, match="solid everywhere"):
        fabrication_mesh(grid, solid, height=1e-3)
    with pytest.raises(ValueError, match="solid everywhere"):
        channel_mesh(grid, solid, height=1e-3)
    with pytest.raises(ValueError, match="fluid everywhere"):
        fabrication_mesh(grid, -solid, height=1e-3)
    with pytest.raises(ValueError, match="height must be given"):
        fabrication_mesh(grid, phi)
    with pytest.raises(TypeError, match="openings must be a Boundary"):
        fabrication_mesh(grid, phi, height=1e-3, openings="x-")
    with pytest.raises(ValueError, match="face must be one of"):
        fabrication_mesh(grid, phi, height=1e-3, openings=["z-"])
    with pytest.raises(ValueError, match="height, floor and lid are for 2D"):
        fabrication_mesh(*tube(), height=1.0)
    with pytest.raises(ValueError, match=r"\.stl"):
        write_stl(tmp_path / "a.obj", channel_mesh(grid, phi, height=1e-3))
    with pytest.raises(MeshError, match="mesh must be closed"):
        write_stl(tmp_path / "a.stl", wall_mesh(grid, phi, height=1e-3))
    with pytest.raises(TypeError, match="must be a FlowField"):
        write_vtk(tmp_path / "a.vti", phi)
    with pytest.raises(ValueError, match=r"\.vti or \.vtu"):
        write_vtk(tmp_path / "a.vtk", channel_field())
    assert not list(tmp_path.iterdir())


def _read_image(path):
    """Arrays of a .vti by name, as its specification says: x fastest, length before the data."""
    arrays = {}
    for node in ET.parse(path).getroot().iter("DataArray"):
        raw = base64.b64decode(node.text)
        assert int(np.frombuffer(raw[:8], "<u8")[0]) == len(raw) - 8
        arrays[node.get("Name")] = np.frombuffer(raw[8:], "<f8").reshape(
            -1, int(node.get("NumberOfComponents"))
        )
    return arrays


@pytest.mark.parametrize("dim", [2, 3])
def test_vtk_files_hold_the_field(tmp_path, dim):
    field = channel_field(6, dim)
    content = meshio.read(write_vtk(tmp_path / "flow.vtu", field))
    assert content.cells[0].type == ("quad" if dim == 2 else "hexahedron")
    at = torch.from_numpy(content.points[:, :dim].copy())
    np.testing.assert_allclose(content.point_data["velocity"][:, :dim], field.sample(at)[0])
    middle = content.points[content.cells[0].data].mean(1)
    np.testing.assert_allclose(content.cell_data["pressure"][0], middle[:, 0])
    total = content.cell_data["volume_fraction"][0].sum() * field.grid.cell_volume
    assert total == pytest.approx(1.0)  # half of the box
    image = _read_image(write_vtk(tmp_path / "flow.vti", field))
    order = np.lexsort(content.points.T)  # by z, then y, then x: as in the image
    np.testing.assert_array_equal(image["velocity"], content.point_data["velocity"][order])
    np.testing.assert_array_equal(image["phi"][:, 0], content.point_data["phi"][order])
    order = np.lexsort(middle.round(9).T)
    np.testing.assert_array_equal(image["pressure"][:, 0], content.cell_data["pressure"][0][order])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["flow.vti", "flow.vtu"]


def test_vtk_names_the_cases(tmp_path):
    field = channel_field(6)
    twice = FlowField(
        field.grid,
        field.phi,
        field.velocity.repeat(2, 1, 1, 1),
        field.pressure.repeat(2, 1, 1),
        field.volume_fraction,
        {},
    )
    content = meshio.read(write_vtk(tmp_path / "flow.vtu", twice))
    assert {"velocity_0", "velocity_1", "phi"} == set(content.point_data)
    assert {"pressure_0", "pressure_1", "volume_fraction"} == set(content.cell_data)


@pytest.mark.reference
@pytest.mark.parametrize("dim", [2, 3])
def test_streamlines_of_a_rotation_close(dim):
    grid = Grid((20,) * dim, size=1.0)
    away = grid.nodes - 0.5
    velocity = torch.zeros(1, *grid.node_shape, dim, dtype=torch.float64)
    velocity[0, ..., 0], velocity[0, ..., 1] = -away[..., 1], away[..., 0]
    field = made_field(grid, torch.ones(grid.node_shape, dtype=torch.float64), velocity)
    seeds = torch.full((3, dim), 0.5, dtype=torch.float64)
    seeds[:, 0] += torch.tensor([0.1, 0.25, 0.4], dtype=torch.float64)
    lines = streamlines(field, seeds)
    for line, radius in zip(lines, (0.1, 0.25, 0.4), strict=True):
        assert line.end == "closed"
        r = np.linalg.norm(line.points[:, :2] - 0.5, axis=-1)
        np.testing.assert_allclose(r, radius, rtol=1e-4)
        assert line.length == pytest.approx(2 * np.pi * radius, rel=5e-3)  # chords of half a cell
        assert line.time[-1] == pytest.approx(2 * np.pi, rel=5e-3)
    (up,) = streamlines(field, seeds[:1], direction="upstream")
    assert up.start == "closed" and up.end == "seed"
    (some,) = streamlines(field, seeds[2:], max_length=0.3)
    assert some.end == "length" and some.length == pytest.approx(0.3, rel=1e-3)


@pytest.mark.reference
def test_seeds_share_an_uneven_inflow_in_equal_parts():
    """(0.5 + 1.5 y/b) (c z - z^2): strips of y, and in each places of z, by their share of it."""
    y, z = (np.arange(60) + 0.5) / 60, (np.arange(40) + 0.5) / 40
    flow = np.outer(0.5 + 1.5 * y, z * (1.0 - z))
    flow[:, 30:] *= y[:, None] > 0.3  # a wall beside the lower strips
    seeds = _equal_shares(flow, 12)
    row, column = np.divmod(seeds, 40)
    assert (flow[row, column] > 0.0).all() and len(set(seeds)) == 12
    strips = np.cumsum(flow.sum(1)) / flow.sum()
    for k, (rows, columns) in enumerate(zip(row.reshape(4, 3), column.reshape(4, 3), strict=True)):
        assert len(set(rows)) == 1 and strips[rows[0]] == pytest.approx((k + 0.5) / 4, abs=0.03)
        part = flow[(strips > k / 4) & (strips <= (k + 1) / 4 + 1e-9)].sum(0)
        np.testing.assert_allclose(
            np.cumsum(part)[columns] / part.sum(), [1 / 6, 3 / 6, 5 / 6], atol=0.05
        )


@pytest.mark.reference
@pytest.mark.parametrize("dim", [2, 3])
def test_streamlines_of_a_channel_are_straight(dim):
    field = channel_field(dim=dim)
    lines = streamlines(field, 9)
    assert len(lines) == 9
    for line in lines:
        assert line.end == "box"
        np.testing.assert_allclose(
            line.points[:, 1:], line.points[:1, 1:].repeat(len(line.points), 0)
        )
        assert line.points[[0, -1], 0].tolist() == pytest.approx([0.0, 2.0])
        assert (np.diff(line.points[:, 0]) > 0).all()
    start = torch.tensor([[1.0, 0.4, 0.5][:dim]], dtype=torch.float64)
    (both,) = streamlines(field, start, direction="both")
    assert (both.start, both.end) == ("box", "box") and both.length == pytest.approx(2.0)


@pytest.mark.property
def test_inlet_seeds_share_the_inflow_equally():
    y = inlet_seeds(channel_field(32), 8)[:, 1].numpy()
    eta = (y - 0.5) / 0.25
    share = 0.5 + 0.75 * (eta - eta**3 / 3)  # of the parabola's flow below y
    # a sample is an eighth of a cell; the multilinear profile is of second order
    np.testing.assert_allclose(share, (np.arange(8) + 0.5) / 8, atol=0.01)


def test_streamlines_stop_at_wall_and_at_rest():
    grid = Grid((16, 16), size=1.0)
    phi = 0.7 - grid.nodes[..., 0]
    velocity = torch.zeros(1, *grid.node_shape, 2, dtype=torch.float64)
    velocity[..., 0] = 1.0
    velocity[:, :, :4] = 0.0
    field = made_field(grid, phi, velocity)
    seeds = torch.tensor([[0.1, 0.8], [0.1, 0.1], [0.9, 0.8]], dtype=torch.float64)
    wall, rest, outside = streamlines(field, seeds)
    assert wall.end == "wall" and wall.points[-1, 0] == pytest.approx(0.7, abs=1e-6)
    assert rest.end == "rest" and len(rest.points) == 1
    assert outside.end == "wall" and len(outside.points) == 1
    still = made_field(grid, phi, torch.zeros_like(velocity))
    with pytest.raises(ValueError, match="nothing flows into the box"):
        streamlines(still)
    with pytest.raises(ValueError, match="seeds must lie in the box"):
        streamlines(field, seeds + 1.0)
    with pytest.raises(ValueError, match=r"case must lie in \[0, 1\)"):
        streamlines(field, seeds, case=1)
    with pytest.raises(ValueError, match="direction must be one of"):
        streamlines(field, seeds, direction="down")
    with pytest.raises(TypeError, match="field must be a FlowField"):
        streamlines(phi, seeds)


KINDS = [None, "text", 1.0, object()]


def spoiled_tensors(right):
    """Wrong kinds and shapes of a field's tensor."""
    return [*KINDS, right.float(), right.long(), right.to("meta"), right[None], right[..., :-1],
            right[:0]]  # fmt: skip


@pytest.mark.parametrize(
    "name", ["grid", "phi", "velocity", "pressure", "volume_fraction", "stats"]
)
def test_fields_made_by_hand_are_refused_where_they_are_spoiled(name, tmp_path):
    field = channel_field()
    right = getattr(field, name)
    tensors = spoiled_tensors(right) if torch.is_tensor(right) else KINDS
    for wrong in tensors:
        with pytest.raises((TypeError, ValueError), match=rf"\b({name}|case) must"):
            spoiled = replace(field, **{name: wrong})
            if name == "velocity":
                inlet_seeds(spoiled, 4)  # no cases are a field, which has none to ask for
            write_vtk(tmp_path / "field.vti", spoiled)


def test_numbers_of_fields_that_are_none_are_refused():
    field = channel_field()
    with pytest.raises(ValueError, match="phi must be finite"):
        replace(field, phi=field.phi * float("nan"))
    broken = replace(field, velocity=field.velocity * float("nan"))
    for ask in (streamlines, lambda field: inlet_seeds(field, 4)):
        with pytest.raises(ValueError, match=r"field.velocity must be finite"):
            ask(broken)
    with pytest.raises(ValueError, match="stats must hold 'divergence'"):
        field.mass_report()
