"""Design files: the thesis's designs, round trips, errors that say where."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from scipy.optimize import linprog

from diffsim.copter import load_design, shipped_designs
from diffsim.copter.design.design_file import design_from_text

SHIPPED = (
    "bunny",
    "pentacopter",
    "pentacopter_payload",
    "quadcopter",
    "quadcopter_flight_time",
    "x_quadcopter",
    "y6_hexacopter",
)
SMALL = """name: small
parts:
  plate: {kind: plate, length: 0.2}
  arm:
    kind: rod
    length: 0.4
    bounds: {length: [0.1, 0.6]}
  motor: {kind: motor, spin: ccw, direction: [0.1, 0.0, -1.0]}
connections:
  - {host: plate.top, guest: arm.shaft, at: [0.01, 0.02], angle: 30}
  - {host: arm.end, guest: motor.base}
constraints: ["plate.width == 0.5 * plate.length"]
"""


@pytest.fixture(scope="module")
def designs():
    return {name: load_design(name) for name in SHIPPED}


def greatest_lift(copter):
    """Greatest thrust with balanced torques, any attitude: a lower bound by one LP [N]."""
    force, torque = copter.force_matrix.numpy(), copter.torque_matrix.numpy()
    bounds = [(0.0, u) for u in copter.max_thrusts.tolist()]
    found = linprog(force[2], A_eq=torque, b_eq=np.zeros(3), bounds=bounds)
    return float(np.linalg.norm(force @ found.x))


def test_shipped_names():
    assert shipped_designs() == SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_designs_can_hover(designs, name):
    copter = designs[name].multicopter()
    assert greatest_lift(copter) > 1.15 * float(copter.weight)
    assert np.linalg.matrix_rank(copter.torque_matrix.numpy(), tol=1e-6) == 3


@pytest.mark.parametrize("name", SHIPPED)
def test_propellers_of_shipped_designs_are_clear(designs, name):
    """Beside each other by 10 mm, or above each other (coaxial pairs)."""
    copter = designs[name].multicopter()
    for i, j in itertools.combinations(range(copter.num_rotors), 2):
        gap = (copter.positions[i] - copter.positions[j]).abs()
        beside = float(gap[:2].norm() - copter.radii[i] - copter.radii[j])
        assert beside > 0.01 or (float(gap[:2].norm()) < 1e-9 and float(gap[2]) > 0.05)


@pytest.mark.parametrize("name", SHIPPED)
def test_meshes_of_shipped_designs_are_closed(designs, name):
    meshes = designs[name].meshes()
    assert set(meshes) == {p.name for p in designs[name].parts}
    assert all(m.is_watertight and m.volume > 0.0 for m in meshes.values())


@pytest.mark.reference
def test_pentacopters_have_the_sizes_of_table_3_1(designs):
    flat, tilted = designs["pentacopter"], designs["pentacopter_payload"]
    assert flat.extent()[:2].tolist() == pytest.approx([0.75, 0.42], abs=1e-9)
    assert float(flat.mass()) == pytest.approx(2.322, abs=1e-3)
    # the clips move the propellers by up to 1.2 mm
    assert tilted.extent()[:2].tolist() == pytest.approx([0.65, 0.67], abs=1.5e-3)
    assert float(tilted.mass()) == pytest.approx(2.353, rel=0.015)  # measured 2.383
    torch.testing.assert_close(flat.directions, torch.tensor([[0.0, 0.0, -1.0]] * 5).double())


@pytest.mark.reference
def test_payload_twin_lifts_a_quarter_more(designs):
    """Upright, five rotors lift 4 u_max; the twin nearly 5 u_max, which no design exceeds."""
    flat, tilted = (designs[n].multicopter() for n in ("pentacopter", "pentacopter_payload"))
    limit = float(flat.max_thrusts.sum())
    assert greatest_lift(flat) == pytest.approx(0.8 * limit, rel=1e-9)
    assert 0.998 * limit < greatest_lift(tilted) <= limit


def test_flight_time_twin_keeps_the_width(designs):
    square, long = designs["quadcopter"], designs["quadcopter_flight_time"]
    assert float(long.extent()[1]) == pytest.approx(float(square.extent()[1]))
    assert float(long.size()) > float(square.size())
    assert sorted(long.multicopter().radii.tolist()) == [0.127, 0.127, 0.1778, 0.1778]
    widest = square.upper[square.names.index("arm_y.length")]
    assert float(widest) == pytest.approx(square.value("arm_y.length"))


def test_coaxial_pairs_of_the_hexacopter(designs):
    copter = designs["y6_hexacopter"].multicopter()
    up = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    assert copter.num_rotors == 6
    torch.testing.assert_close(copter.directions, up.expand(6, 3), atol=1e-12, rtol=0.0)
    assert copter.spins.view(3, 2).sum(1).tolist() == [0.0, 0.0, 0.0]  # the pairs counter-rotate


def test_legs_of_the_hexacopter_reach_the_ground_together(designs):
    """Six legs as in the public XML; the front ones end within 5 mm of the rear ones."""
    meshes = designs["y6_hexacopter"].meshes()
    feet = [float(m.vertices[:, 2].max()) for name, m in meshes.items() if name.startswith("leg_")]
    assert len(feet) == 6
    assert max(feet) - min(feet) < 0.005
    lowest = max(float(m.vertices[:, 2].max()) for n, m in meshes.items() if "leg_" not in n)
    assert min(feet) > lowest


def test_bunny_is_asymmetric(designs):
    copter = designs["bunny"].multicopter()
    assert len(set(copter.radii.tolist())) == 4
    heights = copter.positions[:, 2]
    assert float(torch.pdist(heights[:, None]).min()) > 0.01


@pytest.mark.parametrize("name", SHIPPED)
def test_round_trip(designs, name, tmp_path):
    design = designs[name]
    stretched = design.closest({design.names[0]: 1.05 * float(design.values[0])})
    loaded = load_design(stretched.save(tmp_path / f"{name}.yaml"))
    assert loaded.names == design.names
    torch.testing.assert_close(loaded.values, stretched.values, atol=1e-14, rtol=0.0)
    ours, theirs = stretched.multicopter(), loaded.multicopter()
    torch.testing.assert_close(theirs.inertia, ours.inertia, atol=1e-13, rtol=0.0)
    torch.testing.assert_close(theirs.directions, ours.directions, atol=1e-13, rtol=0.0)
    torch.testing.assert_close(theirs.positions, ours.positions, atol=1e-13, rtol=0.0)


def test_small_design():
    design = design_from_text(SMALL)
    assert design.value("plate.width") == pytest.approx(0.1)
    # 30 degrees about the upward normal: counterclockwise seen from above, towards -y
    reach = 0.5 * 0.4 - 0.02
    clip = next(p for p in design.parts if p.part.kind == "compound_angle_clip")
    assert design.value(f"{clip.name}.x") == pytest.approx(0.01 + reach * np.cos(np.pi / 6))
    assert design.value(f"{clip.name}.y") == pytest.approx(0.02 - reach * np.sin(np.pi / 6))
    assert float(design.upper[design.names.index("arm.length")]) == pytest.approx(0.6)


def test_mesh_files_are_found_from_the_saved_design(tmp_path):
    import trimesh

    (tmp_path / "a").mkdir()
    trimesh.creation.box((0.3, 0.2, 0.02)).export(tmp_path / "a" / "frame.stl")
    text = """
parts:
  frame:
    kind: mesh_frame
    file: frame.stl
    mounts: {nose: {center: [0.1, 0, -0.01], normal: [0, 0, -1]}}
  motor: {kind: motor}
connections: [{host: frame.nose, guest: motor.base}]
"""
    (tmp_path / "a" / "copter.yaml").write_text(text)
    design = load_design(tmp_path / "a" / "copter.yaml")
    saved = design.closest({"frame.scale_x": 1.5}).save(tmp_path / "b" / "copter.yaml")
    assert yaml.safe_load(saved.read_text())["parts"]["frame"]["file"] == "frame.stl"
    (tmp_path / "a" / "frame.stl").unlink()  # the saved design needs nothing of the other folder
    assert load_design(saved).value("motor.x") == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("good", "bad", "message"),
    [
        ("name: small", "nmae: small", r"no key 'nmae' here; did you mean 'name'"),
        ("length: 0.2", "length: .nan", r"parts.plate.length: must be a finite number, got nan"),
        ("length: 0.2", "lenght: 0.2", r"parts.plate: no key 'lenght' .*mean 'length'"),
        ("kind: plate", "kind: plaet", r"parts.plate: kind must be.*mean 'plate'"),
        ("{kind: plate, length: 0.2}", "{length: 0.2}", r"parts.plate: kind is missing"),
        ("[0.1, 0.6]", "[0.1]", r"parts.arm.bounds.length\[1\]: is missing"),
        ("[0.1, 0.6]", "[0.6, 0.1]", r"arm.bounds.length: must be .lower, upper."),
        ("[0.1, 0.6]", "[0.1, wide]", r"length\[1\]: must be a number in m.*, got 'wide'"),
        ("    length: 0.4", "    kind: rod", r"line 6: key 'kind' stands twice"),
        ("angle: 30", "angel: 30", r"connections\[0\]: .*'angle'"),
        ("guest: motor.base", "gest: motor.base", r"connections\[1\]: .*'guest'"),
        ("constraints: [", "rigid: 3\nconstraints: [", r"rigid: must be a list, got 3"),
        ("plate.length", "plate.lentgh", r"did you mean 'length'"),
        ("  arm:", "  1arm:", r"parts.1arm: .*letters, digits"),
        ("0.4", "[", r"line \d+: not YAML"),
    ],
)
def test_errors_say_where(good, bad, message):
    assert good in SMALL
    with pytest.raises(ValueError, match=message) as caught:
        design_from_text(SMALL.replace(good, bad, 1), "small.yaml")
    assert str(caught.value).startswith("small.yaml")


def test_every_mistake_has_a_line():
    text = SMALL.replace("length: 0.2", "length: 2 kg").replace("spin: ccw", "pusher: 1")
    with pytest.raises(ValueError, match=r"^small\.yaml: ") as caught:
        design_from_text(text.replace("angle", "angel"), "small.yaml")
    plate, motor, connection = str(caught.value).split("\n")
    assert plate.startswith("small.yaml: parts.plate.length: unit 'kg' is no unit of")
    assert motor == "small.yaml: parts.motor.pusher: must be true or false, got 1"
    assert connection.startswith("small.yaml: connections[0]: no key 'angel' here")


def test_units_are_converted():
    text = SMALL.replace("length: 0.2", "length: 20 cm").replace("angle: 30", "angle: 0.5 turn")
    text = text.replace("[0.1, 0.6]", "[10 cm, 600 mm]").replace("[0.01, 0.02]", "[10 mm, 0.02]")
    ours = design_from_text(text)
    theirs = design_from_text(SMALL.replace("angle: 30", "angle: 180"))
    assert ours.names == theirs.names
    torch.testing.assert_close(ours.values, theirs.values, atol=1e-12, rtol=0.0)
    torch.testing.assert_close(ours.upper, theirs.upper, atol=1e-12, rtol=0.0)


def test_unknown_designs(tmp_path):
    with pytest.raises(ValueError, match="did you mean 'pentacopter'"):
        load_design("pentcopter")
    with pytest.raises(FileNotFoundError, match="the shipped ones are bunny"):
        load_design(tmp_path / "none.yaml")


def test_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    design = design_from_text(SMALL)
    path = design.save(tmp_path / "small.yaml")
    before = path.read_text()
    monkeypatch.setattr("os.replace", lambda *args: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(OSError, match="full"):
        design.closest({"arm.length": 0.5}).save(path)
    assert path.read_text() == before
    assert [p.name for p in tmp_path.iterdir()] == ["small.yaml"]


NAN = float("nan")


@pytest.mark.parametrize("how", ["nan", "inf", "huge", "float32", "int64", "short", "list", "text"])
def test_spoiled_values_of_a_design_are_refused(how):
    design = design_from_text(SMALL)
    right = design.values
    wrong = {"nan": right * NAN, "inf": right / 0.0, "huge": right * 1e200, "text": "0.4"}
    wrong |= {"float32": right.float(), "int64": right.long(), "list": right.tolist()}
    with pytest.raises((TypeError, ValueError), match="values must"):
        replace(design, values=right[:-1] if how == "short" else wrong[how]).named_values()


@pytest.mark.parametrize(
    ("where", "changes", "message"),
    [
        ("spec", {"parts": ("plate",)}, r"parts\[0\] must be a PartSpec"),
        ("spec", {"connections": (None,)}, r"connections\[0\] must be a Connection"),
        ("spec", {"constraints": None}, "constraints must be a tuple"),
        ("spec", {"constraints": (1,)}, r"constraints\[0\]: must be text"),
        ("spec", {"rigid": (1,)}, r"rigid\[0\]: must be a list"),
        ("spec", {"name": 3.0}, "name must be text"),
        ("spec", {"notes": NAN}, "notes must be text"),
        ("part", {"place": (0.0, NAN, 0.0)}, r"plate.place\[1\]: must be a finite number, got nan"),
        ("part", {"place": NAN}, "place must be a tuple"),
        ("part", {"options": {"length": NAN}}, "plate.length: must be a finite number, got nan"),
        ("part", {"options": {"length": "long"}}, "plate.length: must be a number in m"),
        ("part", {"bounds": {"length": 0.1}}, "plate.bounds.length: must be a list"),
        ("part", {"kind": 3}, "kind must be text"),
        (
            "part",
            {"kind": "mesh_frame", "options": {"file": 3}},
            "file of part plate must be a path",
        ),
        ("connection", {"angle": NAN}, "angle must be a number, got nan"),
        ("connection", {"at": (NAN, 0.0)}, r"connections\[0\].at\[0\]: must be a finite number"),
        ("connection", {"adapters": (1,)}, r"connections\[0\].adapters\[0\]: must be text"),
    ],
)
def test_what_could_not_be_read_again_is_not_saved(where, changes, message, tmp_path):
    design = design_from_text(SMALL)
    spec = design.spec

    def spoiled():
        if where == "part":
            return replace(spec, parts=(replace(spec.parts[0], **changes), *spec.parts[1:]))
        if where == "connection":
            first, *others = spec.connections
            return replace(spec, connections=(replace(first, **changes), *others))
        return replace(spec, **changes)

    with pytest.raises((TypeError, ValueError), match=message):
        replace(design, spec=spoiled()).save(tmp_path / "small.yaml")
    assert not list(tmp_path.iterdir())
