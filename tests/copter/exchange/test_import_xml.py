"""The public tool's designs: the same masses, rotors and feasible sets."""

import json
import re
import shutil

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from diffsim.copter import GRAVITY, import_xml, load_design
from tests.helpers import tensor
from tests.measured import data_folder

NAMES = ["quadcopter", "pentacopter", "y6copter"]
TOL = 1e-6  # the tool keeps its transforms in float32: places off by up to 2e-8 m
AXES = {0: "x", 1: "y", 2: "z", 3: "length"}


@pytest.fixture(scope="module")
def designs():
    folder = data_folder("copter_reference")
    return {name: import_xml(folder / f"{name}.xml") for name in NAMES}


def facts(name):
    text = (data_folder("copter_reference") / "reference_copters.json").read_text()
    return json.loads(text)["copters"][name]


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_mass_properties(designs, name):
    design, fact = designs[name], facts(name)
    copter = design.multicopter()
    assert float(copter.mass) == pytest.approx(fact["mass"], abs=TOL)
    close = {"atol": TOL, "rtol": 0.0}
    torch.testing.assert_close(design.center_of_mass(), tensor(fact["com_world"]), **close)
    torch.testing.assert_close(copter.inertia, tensor(fact["inertia_body"]), **close)


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_rotors(designs, name):
    copter, fact = designs[name].multicopter(), facts(name)
    close = {"atol": TOL, "rtol": 0.0}
    positions = tensor([r["pos_body"] for r in fact["rotors"]])
    torch.testing.assert_close(copter.positions, positions, **close)
    for key, ours in (("torque_to_thrust", "torque_ratios"), ("max_thrust", "max_thrusts")):
        torch.testing.assert_close(
            getattr(copter, ours), tensor([r[key] for r in fact["rotors"]]), **close
        )
    effect = torch.cat([copter.force_matrix, copter.torque_matrix])
    torch.testing.assert_close(effect, tensor(fact["effect_matrix_6xn"]), **close)
    trim = tensor(fact["trim_u"])
    assert float((copter.force_matrix @ trim)[2]) == pytest.approx(
        -fact["mass"] * GRAVITY, abs=1e-5
    )


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_masses_of_single_parts(designs, name):
    entries = designs[name].bill_of_materials()
    ours = sorted(e.mass for e in entries)
    theirs = sorted(c["mass"] for c in facts(name)["components"])
    np.testing.assert_allclose(ours, theirs, atol=TOL)


def reference_set(name):
    """A x = b, C x <= d and x0 in our names, without the rotors' directions."""
    text = (data_folder("copter_reference") / "reference_design_constraints.json").read_text()
    stored = json.loads(text)["copters"][name]
    matrices = []
    for key, rhs in (("A", "b"), ("C", "d")):
        dense = np.zeros((len(stored[rhs]), len(stored["names"])))
        for row, column, value in stored[key]:
            dense[row, column] += value
        matrices.append((dense, np.array(stored[rhs])))
    parts = [n.split(":") for n in stored["names"]]
    keep = [i for i, (p, k) in enumerate(parts) if not (p.startswith("rotor") and int(k) > 2)]
    names = [f"{parts[i][0]}.{AXES[int(parts[i][1])]}" for i in keep]
    (a, b), (c, d) = matrices
    rows = np.abs(a[:, keep]).max(axis=1) > 1e-6  # the rest fixes directions, or is float32 dust
    return names, a[rows][:, keep], b[rows], c[:, keep], d, np.array(stored["x0"])[keep], stored


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_equality_subspace(designs, name):
    design = designs[name]
    names, a, b, *_, x0, stored = reference_set(name)
    rows = [design.all_names.index(n) for n in names]
    basis, offset = design.feasible.basis[rows], design.feasible.offset[rows]
    assert basis.shape[1] == stored["nullity"] == np.linalg.matrix_rank(basis)
    assert np.abs(a @ basis).max() < TOL
    assert np.abs(a @ offset - b).max() < TOL
    s = np.linalg.lstsq(basis, x0 - offset)[0]
    np.testing.assert_allclose(offset + basis @ s, x0, atol=TOL)
    np.testing.assert_allclose(design.values.numpy(), s, atol=TOL)


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_inequalities(designs, name):
    """Both sets of half-spaces, reduced to our free parameters, are the same."""
    design = designs[name]
    names, _, _, c, d, *_ = reference_set(name)
    rows = [design.all_names.index(n) for n in names]
    reduced = c @ design.feasible.basis[rows]
    theirs = np.column_stack([reduced, d - c @ design.feasible.offset[rows]])
    ours = np.column_stack([t.numpy() for t in design.inequalities])
    moving = np.abs(theirs[:, :-1]).max(axis=1) > TOL
    for first, second in ((theirs[moving], ours), (ours, theirs[moving])):
        gaps = np.abs(first[:, None] - second[None]).max(axis=2).min(axis=1)
        assert gaps.max() < TOL


def test_saves_and_loads(designs, tmp_path):
    design = designs["y6copter"]
    path = design.save(tmp_path / "deep" / "y6.yaml")
    loaded = load_design(path)
    assert loaded.names == design.names
    torch.testing.assert_close(loaded.values, design.values, atol=1e-14, rtol=0.0)
    torch.testing.assert_close(
        loaded.multicopter().inertia, design.multicopter().inertia, atol=1e-14, rtol=0.0
    )


BROKEN = [
    (
        '<translate xyz="0 0 -0.1"/>',
        '<translat xyz="0 0 -0.1"/>',
        "translat.*did you mean 'translate'",
    ),
    ('xyz="0.23 0 -0.076"', 'xzy="0.23 0 -0.076"', "attribute of <translate>.*'xzy'.*'xyz'"),
    ('xyz="0.23 0 -0.076"', 'xyz="0.23 0"', "must be 3 numbers, got 2"),
    ('length="0.5"', 'lenght="0.5"', "'lenght'.*'length'"),
    ('length="0.5"', "", "<instance> needs length"),
    ("<battery", "<batery", "not XML"),
    ("motor_10inch_prop.txt", "motor_11inch_prop.txt", "motor_10inch_prop.txt"),
    ('spin_dir="cw"', 'spin_dir="clockwise"', "spin_dir must be one of"),
]


@pytest.mark.parametrize(("good", "bad", "message"), BROKEN)
def test_broken_files_are_reported_with_their_line(tmp_path, good, bad, message):
    folder = data_folder("copter_reference")
    text = (folder / "quadcopter.xml").read_text()
    assert good in text
    line = 1 + text[: text.index(good)].count("\n")
    shutil.copytree(folder / "mesh", tmp_path / "mesh")
    (tmp_path / "copter.xml").write_text(text.replace(good, bad, 1))
    with pytest.raises(ValueError, match=f"copter.xml, line [0-9]+: .*{message}") as caught:
        import_xml(tmp_path / "copter.xml")
    found = int(re.search(r"line ([0-9]+)", str(caught.value))[1])
    assert abs(found - line) <= 2 or "not XML" in message  # a tag ends lines after it begins


def test_unknown_tags_in_an_own_file(tmp_path):
    """No reference data needed: the file is refused before any mesh is read."""
    (tmp_path / "copter.xml").write_text('<copter>\n  <tubee file="a.obj"/>\n</copter>')
    with pytest.raises(ValueError, match=r"line 2: tag must be one of.*did you mean 'tube'"):
        import_xml(tmp_path / "copter.xml")
    (tmp_path / "copter.xml").write_text("<plane/>")
    with pytest.raises(ValueError, match="root must be <copter>"):
        import_xml(tmp_path / "copter.xml")
    moved = '<copter><tube file="a.obj"><translate xyz="0 0 0"/><instance/></tube></copter>'
    (tmp_path / "copter.xml").write_text(moved)
    with pytest.raises(ValueError, match="<translate> must stand inside an <instance>"):
        import_xml(tmp_path / "copter.xml")
    with pytest.raises(FileNotFoundError, match="no XML design"):
        import_xml(tmp_path / "none.xml")


def test_own_file_with_translat(tmp_path):
    import trimesh

    trimesh.creation.box((1.0, 1.0, 0.0024)).export(tmp_path / "plate.obj")
    text = (
        '<copter>\n <plate file="plate.obj" density="1180">\n  <instance size="0.1 0.1">\n'
        '   <translat xyz="0 0 -0.1"/>\n  </instance>\n </plate>\n</copter>'
    )
    (tmp_path / "copter.xml").write_text(text)
    with pytest.raises(ValueError, match=r"line 4: tag must be one of.*mean 'translate'"):
        import_xml(tmp_path / "copter.xml")
    (tmp_path / "copter.xml").write_text(text.replace("translat ", "translate "))
    design = import_xml(tmp_path / "copter.xml")
    assert float(design.mass()) == pytest.approx(0.1 * 0.1 * 0.0024 * 1180, rel=1e-9)
    assert float(design.center_of_mass()[2]) == pytest.approx(-0.1)


def test_missing_mesh(tmp_path):
    shutil.copy(data_folder("copter_reference") / "quadcopter.xml", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"line 3: no mesh plate.obj"):
        import_xml(tmp_path / "quadcopter.xml")


def test_part_that_touches_nothing(tmp_path):
    folder = data_folder("copter_reference")
    text = (folder / "quadcopter.xml").read_text()
    shutil.copytree(folder / "mesh", tmp_path / "mesh")
    moved = text.replace('<translate xyz="0 -0.23 -0.124"/>\n      <translate', "<translate", 1)
    assert moved != text
    (tmp_path / "copter.xml").write_text(moved)
    with pytest.raises(ValueError, match="rotor_3 touches no other part"):
        import_xml(tmp_path / "copter.xml")


TAIL = 45.0  # tilt of the motors of a V tail [deg]
HUB = (("translate", (-0.23, 0.0, -0.126)),)
LEFT, RIGHT = (("rotate", (TAIL, 0.0, 0.0)), *HUB), (("rotate", (-TAIL, 0.0, 0.0)), *HUB)
ACROSS = ("rotate", (0.0, 0.0, 90.0))


def up(y, z):
    return ("translate", (0.0, y, z))


def at(*place):
    return ("translate", place)


VTAIL = {
    "plate": [({"size": "0.15 0.15"}, [at(0.0, 0.0, -0.15)])],
    "battery": [({}, [ACROSS, at(0.0, 0.0, -0.15)])],
    "electronics": [({}, [at(0.03, 0.0, -0.1644)])],
    "tube": [
        ({"length": "0.5"}, [at(0.0, 0.0, -0.126)]),
        ({"length": "0.5"}, [ACROSS, at(0.23, 0.0, -0.174)]),
        ({"length": "0.14"}, [ACROSS, up(0.05, -0.0454), *LEFT]),
        ({"length": "0.14"}, [ACROSS, up(-0.05, -0.0454), *RIGHT]),
    ],
    "round_connector": [
        ({}, [("rotate", (180.0, 0.0, 90.0)), at(0.23, 0.0, -0.174)]),
        ({}, [at(0.0, 0.0, -0.126)]),
        ({}, [("rotate", (180.0, 0.0, 0.0)), at(0.23, 0.0, -0.126)]),
        ({}, [*LEFT]),
        ({}, [ACROSS, at(0.23, -0.23, -0.174)]),
        ({}, [("rotate", (0.0, 0.0, -90.0)), at(0.23, 0.23, -0.174)]),
        *(({}, [ACROSS, up(0.0, -0.0454), *side]) for side in (LEFT, RIGHT)),
        ({}, [ACROSS, up(0.1, -0.0454), *LEFT]),
        ({}, [ACROSS, up(-0.1, -0.0454), *RIGHT]),
    ],
    "motor": [
        ({"spin_dir": "cw"}, [up(-0.1, -0.0854), *RIGHT]),
        ({"spin_dir": "ccw"}, [at(0.23, 0.23, -0.214)]),
        ({"spin_dir": "cw"}, [up(0.1, -0.0854), *LEFT]),
        ({"spin_dir": "ccw"}, [at(0.23, -0.23, -0.214)]),
    ],
}
TAGS = {
    "plate": ("plate.obj", 1180.0, ""),
    "battery": ("battery.obj", 2857.1, ' capacity="2200"'),
    "electronics": ("electronics.obj", 601.6, ""),
    "tube": ("tube.obj", 1638.9, ""),
    "round_connector": ("connector.obj", 1170.0, ""),
    "motor": (
        "motor.obj",
        4833.3,
        ' measurement="motor_10inch_prop.txt" propeller_height="0.019"',
    ),
}


def vtail_xml():
    """The public tool's V tail, whose two rear motors, connectors and tubes are tilted."""
    lines = ["<copter>", ' <propeller file="propeller_10inch.obj"/>']
    for tag, instances in VTAIL.items():
        file, density, more = TAGS[tag]
        lines.append(f' <{tag} file="{file}" density="{density}"{more}>')
        for given, moves in instances:
            lines.append("  <instance" + "".join(f' {k}="{v}"' for k, v in given.items()) + ">")
            for kind, values in moves:
                key = "xyz" if kind == "translate" else "rpy"
                lines.append(f'   <{kind} {key}="{" ".join(map(str, values))}"/>')
            lines.append("  </instance>")
        lines.append(f" </{tag}>")
    return "\n".join([*lines, "</copter>"])


def placed(moves):
    """4x4 transform of moves in file order."""
    whole = np.eye(4)
    for kind, values in moves:
        move = np.eye(4)
        if kind == "translate":
            move[:3, 3] = values
        else:
            move[:3, :3] = Rotation.from_euler("xyz", values, degrees=True).as_matrix()
        whole = move @ whole
    return whole


def mass_by_meshes(folder):
    """Mass, center and inertia about it, from the triangles alone; place and axis of motors."""
    import trimesh

    total, first, second, rotors = 0.0, np.zeros(3), np.zeros((3, 3)), []
    for tag, instances in VTAIL.items():
        file, density, _ = TAGS[tag]
        for given, moves in instances:
            mesh = trimesh.load(folder / "mesh" / file, force="mesh")
            scale = [float(v) for v in given.get("size", "1 1").split()] + [1.0]
            mesh.apply_transform(np.diag([float(given.get("length", scale[0])), *scale[1:], 1.0]))
            mesh.apply_transform(placed(moves))
            mesh.density = density
            mass, center = mesh.mass, mesh.center_mass
            total, first = total + mass, first + mass * center
            second += mesh.moment_inertia + mass * (center @ center * np.eye(3))
            second -= mass * np.outer(center, center)
            if tag == "motor":
                rotors.append((placed(moves)[:3, 3], placed(moves)[:3, :3] @ [0.0, 0.0, -1.0]))
    center = first / total
    about = second - total * (center @ center * np.eye(3) - np.outer(center, center))
    return total, center, about, rotors


@pytest.mark.reference
def test_tilted_motors_are_imported(tmp_path):
    """Boxes were compared in world axes: rotor_0, rotor_2 touched no other part."""
    folder = data_folder("copter_reference")
    shutil.copytree(folder / "mesh", tmp_path / "mesh")
    (tmp_path / "vtail.xml").write_text(vtail_xml())
    design = import_xml(tmp_path / "vtail.xml")
    copter = design.multicopter()
    mass, center, inertia, rotors = mass_by_meshes(folder)
    close = {"atol": TOL, "rtol": 0.0}
    assert float(copter.mass) == pytest.approx(mass, abs=TOL)
    torch.testing.assert_close(design.center_of_mass(), tensor(center), **close)
    torch.testing.assert_close(copter.inertia, tensor(inertia), **close)
    places, axes = (np.array(column) for column in zip(*rotors, strict=True))
    torch.testing.assert_close(copter.positions, tensor(places - center), **close)
    torch.testing.assert_close(copter.force_matrix, tensor(axes.T), **close)
    drag = copter.torque_matrix.numpy() - np.cross(places - center, axes).T
    np.testing.assert_allclose(
        np.abs(drag), abs(float(copter.torque_ratios[0])) * abs(axes.T), atol=TOL
    )
    assert len(design.spec.rigid) == 7  # motors and connectors face to face, the tilted ones too


@pytest.mark.reference
def test_a_motor_turned_away_from_its_connector_is_refused(tmp_path):
    folder = data_folder("copter_reference")
    shutil.copytree(folder / "mesh", tmp_path / "mesh")
    text = vtail_xml()
    wrong = text.replace('<rotate rpy="-45.0 0.0 0.0"/>', '<rotate rpy="-40.0 0.0 0.0"/>')
    last = text.rindex('<rotate rpy="-45.0')
    (tmp_path / "vtail.xml").write_text(text[:last] + wrong[last:])
    with pytest.raises(ValueError, match="rotor_0 touches no other part"):
        import_xml(tmp_path / "vtail.xml")
