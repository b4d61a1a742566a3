"""Parts: closed, linear in their parameters, weighing what formulas say."""

import math

import numpy as np
import pytest
import torch

from diffsim.copter import rotor_model
from diffsim.copter.vehicle.geometry import fan_prism, rotation_about, rotation_rpy
from diffsim.copter.vehicle.mass import Moments, mesh_moments, placed_moments, rigid_body
from diffsim.copter.vehicle.parts import PART_KINDS, make_part, rotor_data
from diffsim.copter.vehicle.patches import aligning_rotation, misalignment
from diffsim.core.errors import MeshError

SQUARE = [[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]]
TILTED = (0.1, -0.2, -math.sqrt(0.95))
OPTIONS = {
    "outline_frame": {"outline": SQUARE, "mounts": {"corner": [0.4, 0.4]}},
    "compound_angle_clip": {"normal": TILTED},
}
BUILT_IN = [k for k in PART_KINDS if not k.startswith(("imported", "mesh"))]


def part_mesh(part, values=None):
    import trimesh

    vertices = part.mesh.vertices.at(part.values if values is None else np.asarray(values))
    return trimesh.Trimesh(vertices, part.mesh.faces, process=False)


def part_moments(part):
    """Torch moments about the part's origin."""
    vertices = torch.from_numpy(part.mesh.vertices.at(part.values))
    faces = torch.from_numpy(part.mesh.faces)
    owner = torch.zeros(len(faces), dtype=torch.int64)
    return mesh_moments(vertices, faces, owner, torch.tensor([part.density], dtype=torch.float64))


@pytest.mark.parametrize("kind", BUILT_IN)
def test_built_in_parts_are_closed_and_outwards(kind):
    part = make_part(kind, OPTIONS.get(kind))
    mesh = part_mesh(part)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0.0
    assert mesh.body_count == 1


def test_a_post_weighs_what_its_cylinder_does():
    """32 corners stand for the circle, whose printed plastic has 1200 kg/m^3."""
    part = make_part("screw_mount", {"height": 0.03, "diameter": 0.012})
    corners = len(part.mesh.vertices.at(part.values)) // 2
    area = 0.5 * corners * 0.006**2 * np.sin(2.0 * np.pi / corners)
    assert float(rigid_body(part_moments(part))[0]) == pytest.approx(1200.0 * area * 0.03, rel=0.02)


@pytest.mark.reference
@pytest.mark.parametrize("kind", BUILT_IN)
def test_moments_agree_with_trimesh(kind):
    part = make_part(kind, OPTIONS.get(kind))
    assert part.density > 0.0
    mass, com, inertia = rigid_body(part_moments(part))
    mesh = part_mesh(part)
    mesh.density = part.density
    assert float(mass) == pytest.approx(mesh.mass, rel=1e-12)
    np.testing.assert_allclose(com.numpy(), mesh.center_mass, atol=1e-12)
    np.testing.assert_allclose(inertia.numpy(), mesh.moment_inertia, atol=1e-9 * mesh.mass)


@pytest.mark.reference
def test_rod_weighs_what_its_formula_says():
    part = make_part("rod", {"length": 0.7, "outer_diameter": 0.02, "inner_diameter": 0.018})
    area = math.pi * (0.01**2 - 0.009**2)
    mass, _, inertia = rigid_body(part_moments(part))
    assert float(mass) == pytest.approx(area * 0.7 * part.density, rel=1e-12)
    # about x: m (R^2 + r^2) / 2; a regular 32-gon of equal area has 1 + 2e-5 of it
    assert float(inertia[0, 0]) == pytest.approx(float(mass) * (0.01**2 + 0.009**2) / 2, rel=1e-4)
    across = float(mass) * (0.7**2 / 12 + (0.01**2 + 0.009**2) / 4)
    assert float(inertia[1, 1]) == pytest.approx(across, rel=1e-6)


@pytest.mark.parametrize(
    ("kind", "mass"), [("battery", 0.2127), ("motor", rotor_data("kde2814_10in").motor_mass)]
)
def test_mass_given_is_mass_had(kind, mass):
    assert float(part_moments(make_part(kind)).mass[0]) == pytest.approx(mass, rel=1e-12)


@pytest.mark.property
@pytest.mark.parametrize("kind", [k for k in BUILT_IN if make_part(k, OPTIONS.get(k)).parameters])
def test_patches_stay_on_the_surface_as_parameters_change(kind):
    """A flat patch's center lies on the mesh, its normal points away from it."""
    import trimesh

    part = make_part(kind, OPTIONS.get(kind))
    for values in (part.values, 1.3 * part.values):
        mesh = part_mesh(part, values)
        assert mesh.is_watertight
        for name, patch in part.patches.items():
            if patch.shape == "circular":
                continue
            center = patch.center.at(values)
            _, distance, face = trimesh.proximity.closest_point_naive(mesh, center[None])
            assert distance[0] < 1e-9, name
            np.testing.assert_allclose(mesh.face_normals[face[0]], patch.axis, atol=1e-9)


@pytest.mark.property
def test_placed_moments_are_those_of_the_moved_mesh():
    part = make_part("compound_angle_clip", {"normal": TILTED})
    rotation, shift = rotation_rpy((20.0, -35.0, 110.0)), np.array([0.3, -0.2, 0.5])
    moved = part_mesh(part)
    moved.vertices = moved.vertices @ rotation.T + shift
    moments = placed_moments(
        part_moments(part), torch.from_numpy(rotation)[None], torch.from_numpy(shift)[None]
    )
    mass, com, inertia = rigid_body(Moments(*moments))
    moved.density = part.density
    assert float(mass) == pytest.approx(moved.mass, rel=1e-12)
    np.testing.assert_allclose(com.numpy(), moved.center_mass, atol=1e-12)
    np.testing.assert_allclose(inertia.numpy(), moved.moment_inertia, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("host_kind", ["rod.shaft", "plate.top", "round_connector.left"])
@pytest.mark.parametrize("guest_kind", ["rod.shaft", "motor.base", "round_connector.bore"])
def test_alignment(host_kind, guest_kind):
    """Thesis Fig. 3-2: axes coincide, normals oppose, a normal is perpendicular to an axis."""
    (a, pa), (b, pb) = host_kind.split("."), guest_kind.split(".")
    host, guest = make_part(a).patches[pa], make_part(b).patches[pb]
    placed = rotation_rpy((10.0, 50.0, -70.0))
    seen = []
    for degrees in (0.0, 25.0):
        turned = aligning_rotation(host, placed, guest, degrees=degrees)
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turned) == pytest.approx(1.0)
        assert misalignment(host, placed, guest, turned) < 1e-6
        seen.append(turned)
    between = seen[1] @ seen[0].T
    np.testing.assert_allclose(between, rotation_about(placed @ host.axis, 25.0), atol=1e-12)
    wrong = rotation_rpy((0.0, 5.0, 3.0)) @ seen[0]
    assert misalignment(host, placed, guest, wrong) > 1.0


@pytest.mark.reference
def test_rotation_order_of_rpy():
    """R = Rz Ry Rx: roll first."""
    from scipy.spatial.transform import Rotation

    expected = Rotation.from_euler("xyz", (10.0, 20.0, 30.0), degrees=True).as_matrix()
    np.testing.assert_allclose(rotation_rpy((10.0, 20.0, 30.0)), expected, atol=1e-14)
    np.testing.assert_array_equal(rotation_rpy((0, 0, 90)), [[0, -1, 0], [1, 0, 0], [0, 0, 1]])


def test_clip_top_is_tilted():
    mesh = part_mesh(make_part("compound_angle_clip", {"normal": TILTED}))
    tilted = mesh.face_normals @ np.array(TILTED) > 1.0 - 1e-9
    assert mesh.area_faces[tilted].sum() == pytest.approx(math.pi * 0.018**2 / -TILTED[2])
    with pytest.raises(ValueError, match="less than 60 degrees"):
        make_part("compound_angle_clip", {"normal": (1.0, 0.0, 0.0)})


def test_spin_of_a_pusher_is_reversed():
    puller = make_part("motor", {"spin": "cw"}).rotor_mount
    pusher = make_part("motor", {"spin": "cw", "pusher": True}).rotor_mount
    assert (puller.spin, pusher.spin) == (1, -1)
    np.testing.assert_array_equal(puller.direction, -pusher.direction)


def test_estimated_rotors_lie_between_the_measured():
    sizes = [rotor_data(f"kde2814_{d}in") for d in (8, 10, 12, 14)]
    assert [r.measured for r in sizes] == [False, True, False, True]
    for key in ("torque_ratio", "max_thrust"):
        values = [getattr(r, key) for r in sizes]
        assert values == sorted(values)
    middle = sizes[2]
    growth = math.log(11.672 / 7.2182) / math.log(1.4)
    assert middle.max_thrust == pytest.approx(7.2182 * 1.2**growth)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("rodd", {}, "did you mean 'rod'"),
        ("rod", {"lenght": 0.3}, "did you mean 'length'"),
        ("rod", {"inner_diameter": 0.02}, "inner_diameter must lie between"),
        ("outline_frame", {"outline": SQUARE}, "outline_frame.mounts: is missing"),
        ("outline_frame", {"outline": SQUARE[::-1], "mounts": {}}, "counterclockwise"),
        ("motor", {"rotor": "kde2814_11in"}, "kde2814_10in"),
        ("motor", {"spin": "left"}, "spin must be one of"),
        (
            "mesh_frame",
            {"file": "f.stl", "mounts": {"nose": {"centre": [0, 0, 0]}}},
            r"mesh_frame.mounts.nose.centre.\[key\]: must be 'center' or 'normal'",
        ),
        ("rod", {"length": -0.1}, "rod.length: must be above 0, got -0.1"),
        ("battery", {"size": [0.1, 0.1]}, "size of a battery must be 3 lengths"),
        ("battery", {"size": [0.1, 0.0, 0.1]}, "size of a battery along y must lie in"),
    ],
)
def test_bad_parts(kind, options, message):
    with pytest.raises(ValueError, match=message):
        make_part(kind, options)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("rod", {"length": "long"}, "rod.length: must be a number in m.*, got 'long'"),
        ("motor", {"pusher": 1}, "motor.pusher: must be true or false, got 1"),
    ],
)
def test_options_of_the_wrong_type(kind, options, message):
    with pytest.raises(ValueError, match=message):
        make_part(kind, options)


def test_frame_from_a_mesh(tmp_path):
    import trimesh

    mesh = trimesh.creation.box((0.2, 0.1, 0.02))
    mesh.export(tmp_path / "frame.stl")
    mounts = {"nose": {"center": [0.1, 0.0, 0.0], "normal": [2.0, 0.0, 0.0]}}
    part = make_part("mesh_frame", {"file": tmp_path / "frame.stl", "mounts": mounts})
    assert part_mesh(part, [2.0, 1.0, 0.5]).volume == pytest.approx(mesh.volume)
    assert part.patches["nose"].center.at(np.array([2.0, 1.0, 1.0])) == pytest.approx([0.2, 0, 0])
    mounts["nose"]["normal"] = [1.0, 0.0, -1.0]
    with pytest.raises(ValueError, match="normal of mount 'nose' must be along"):
        make_part("mesh_frame", {"file": tmp_path / "frame.stl", "mounts": mounts})
    mesh.update_faces(np.arange(1, len(mesh.faces)))
    mesh.export(tmp_path / "open.stl")
    with pytest.raises(MeshError, match="open"):
        make_part("mesh_frame", {"file": tmp_path / "open.stl", "mounts": mounts})


def test_open_geometry_is_reported_by_name():
    from dataclasses import replace

    part = make_part("rod")
    holed = replace(part, mesh=replace(part.mesh, faces=part.mesh.faces[1:]))
    with pytest.raises(MeshError, match=r"part 'arm_1' .rod. is not closed"):
        holed.require_closed("arm_1")
    flipped = replace(part, mesh=replace(part.mesh, faces=part.mesh.faces[:, ::-1]))
    with pytest.raises(MeshError, match="inside out"):
        flipped.require_closed("arm_1")


def test_hidden_corner_of_an_outline():
    with pytest.raises(ValueError, match="star-shaped"):
        fan_prism(np.array([[1.0, 0.0], [1.0, 1.0], [1.2, 0.5], [-1.0, 0.0]]), 0.1)


@pytest.mark.parametrize("name", ["kde2814_10in", "kde2814_14in"])
def test_rotor_data_is_that_of_the_model(name):
    data, model = rotor_data(name), rotor_model(name)
    for key in ("radius", "torque_ratio", "max_thrust"):
        assert getattr(data, key) == getattr(model, key)


def test_rotor_data_by_name():
    assert rotor_data("kde2814_14in").max_thrust == 11.672
    with pytest.raises(ValueError, match="kde2814_14in"):
        rotor_data("kde2814_15in")
