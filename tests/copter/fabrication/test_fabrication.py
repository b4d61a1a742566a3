"""Fabrication plans: closed prints, cut lists and bills that add up, clips at the right angle."""

import csv
import io
import itertools
import math

import numpy as np
import pytest
import torch
import yaml

from diffsim import cli
from diffsim.copter import import_xml, load_design, shipped_designs
from diffsim.copter.fabrication import (
    FabricationError,
    Printer,
    clip_mesh,
    plan,
    write_plan,
)
from diffsim.copter.fabrication.files import summary
from diffsim.copter.fabrication.materials import bill
from diffsim.copter.fabrication.print_check import check_print, thinnest_wall
from diffsim.copter.fabrication.printable import (
    circle,
    has_screw_holes,
    inside,
    perforated_prism,
    refined,
)
from diffsim.copter.fabrication.rods import RodCut, pack
from diffsim.core.errors import MeshError
from diffsim.viz import fabrication_page
from diffsim.viz.fabrication_page import write_fabrication
from diffsim.viz.report import Table
from tests.measured import data_folder

LARGE = Printer(bed=(700.0, 700.0, 300.0))


@pytest.fixture(scope="module")
def plans():
    return {name: plan(load_design(name), printer=LARGE) for name in shipped_designs()}


def tilted(name="pentacopter", seed=0, largest=12.0):
    """A design whose motors lean by up to ``largest`` degrees in all directions."""
    design = load_design(name)
    rng = np.random.default_rng(seed)
    n = len(design.rotors)
    tilt, azimuth = np.deg2rad(rng.uniform(3.0, largest, n)), rng.uniform(0.0, 2.0 * np.pi, n)
    rows = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
    return design, torch.from_numpy(np.stack(rows, axis=1))


def top_normal(mesh):
    """Of the face of a clip that carries the motor: the largest plane that is not the base."""
    up = mesh.face_normals[:, 2] > 0.5
    normals, areas = mesh.face_normals[up], mesh.area_faces[up]
    assert np.ptp(normals, axis=0).max() < 1e-5  # one plane
    return np.average(normals, axis=0, weights=areas)


@pytest.mark.parametrize(
    "name",  # the overlaps of a tube frame cost most; three others have one
    [pytest.param(n, marks=[pytest.mark.story] * (n == "pentacopter")) for n in shipped_designs()],
)
def test_prints_are_solids_that_fit(plans, name):
    found = plans[name]
    assert found.problems == ()
    for part in found.printed:
        assert part.mesh.is_watertight and part.mesh.is_winding_consistent
        assert part.mesh.volume > 0.0
        assert float(part.mesh.vertices[:, 2].min()) == pytest.approx(0.0, abs=1e-9)
        assert part.check.wall >= 1.2
    printed = {n for p in found.printed for n in p.names if p.process == "print"}
    assert printed == {p.name for p in found.design.parts if p.part.source == "printed"}


@pytest.mark.parametrize("name", shipped_designs())
def test_prints_keep_the_size_of_the_parts(plans, name):
    """Bounding boxes agree; holes take away volume, bores and screws at most a fifth."""
    found = plans[name]
    meshes = found.design.meshes()
    parts = {p.name: p for p in found.design.parts}
    for part, first in ((p, p.names[0]) for p in found.printed):
        own = meshes[first].vertices @ parts[first].rotation  # in the part's frame
        sizes = 1e3 * np.sort(np.ptp(own, axis=0))
        np.testing.assert_allclose(np.sort(part.check.size), sizes, rtol=0.01, atol=0.15)
        share = part.check.volume / (1e9 * meshes[first].volume)
        assert 0.8 < share <= 1.0 + 1e-9


def test_screws_weigh_what_their_steel_does(plans):
    """A head of 5.5 x 3 mm with a socket of 2.5 mm, a thread of its pitch diameter, 2.675 mm."""
    steel = 7850.0
    head = steel * 1e-9 * (math.pi / 4.0 * 5.5**2 * 3.0 - 0.866 * 2.5**2 * 1.3)
    lines = {line for p in plans.values() for line in p.consumables if "M3 screw" in line.item}
    assert len({line.item for line in lines}) >= 2
    for line in lines:
        length = float(line.item.split()[-2])
        thread = steel * 1e-9 * math.pi / 4.0 * 2.675**2 * length
        assert line.mass / line.quantity == pytest.approx(head + thread, rel=0.03)


@pytest.mark.parametrize("name", shipped_designs())
def test_bill_adds_up_to_the_design(plans, name):
    found = plans[name]
    assert found.mass == pytest.approx(float(found.design.mass()), rel=1e-12)
    assert found.price == pytest.approx(float(found.design.cost()), rel=1e-9)
    names = [n for line in found.materials for n in line.names]
    assert sorted(names) == sorted(p.name for p in found.design.parts)
    assert all(line.quantity == len(line.names) for line in found.materials)
    extra = sum(line.mass for line in found.consumables)
    assert 0.0 < extra < 0.04 * found.mass


def test_bill_that_lacks_a_part_is_refused(monkeypatch):
    design = load_design("quadcopter")
    monkeypatch.setattr(
        "diffsim.copter.fabrication.planner.bill", lambda entries, parts: bill(entries, parts)[1:]
    )
    with pytest.raises(FabricationError, match=r"weighs .* kg, the design 1\.312"):
        plan(design)


@pytest.mark.parametrize("name", shipped_designs())
def test_cut_list_adds_up_to_the_rods(plans, name):
    found = plans[name]
    total = sum(cut.length * cut.quantity for cut in found.cuts)
    assert total == pytest.approx(float(found.design.size()), abs=1e-9)
    pieces = sorted(piece for bar in found.bars for piece in bar.pieces)
    assert pieces == sorted((c.label, c.length) for c in found.cuts for _ in c.names)
    for bar in found.bars:
        assert bar.used + bar.kerf * (len(bar.pieces) - 1) <= bar.length
        assert 0.0 <= bar.remnant <= bar.length - bar.used
    if found.bars:
        bought = sum(bar.length for bar in found.bars)
        assert found.waste == pytest.approx(1.0 - total / bought)


def test_equal_rods_are_one_line(plans):
    cuts = plans["pentacopter"].cuts
    assert [(c.label, c.quantity) for c in cuts] == [("A", 1), ("B", 2), ("C", 2)]
    assert [round(c.length, 4) for c in cuts] == [0.6825, 0.46, 0.415]


def test_packing_against_all_assignments():
    """First fit decreasing uses as few bars as the best of all assignments of seven pieces."""
    lengths = [0.52, 0.47, 0.47, 0.3, 0.25, 0.21, 0.2]
    kerf = 0.003
    cuts = [RodCut(str(k), "tube", v, (f"rod_{k}",)) for k, v in enumerate(lengths)]
    bars = pack(cuts, 1.0, kerf)

    def possible(count):
        for where in itertools.product(range(count), repeat=len(lengths)):
            loads = [
                [v for v, w in zip(lengths, where, strict=True) if w == b] for b in range(count)
            ]
            if all(sum(load) + kerf * (len(load) - 1) <= 1.0 for load in loads if load):
                return True
        return False

    assert not possible(2)
    assert possible(3)
    assert len(bars) == 3


@pytest.mark.property
@pytest.mark.parametrize("kerf", [0.0, 0.003])
def test_pieces_that_fill_a_bar_are_cut_from_one(kerf):
    """Equal pieces and the cuts between them, whatever rounding says; a hair more takes two."""
    for count in range(2, 30):
        length = (1.0 - (count - 1) * kerf) / count
        for extra, needed in ((0.0, 1), (1e-9, 2)):
            cut = RodCut("A", "tube", length + extra, tuple(map(str, range(count))))
            assert len(pack([cut], 1.0, kerf)) == needed, count


def test_sections_are_not_mixed():
    cuts = [RodCut("A", "thick", 0.3, ("a",)), RodCut("B", "thin", 0.3, ("b",))]
    assert sorted(bar.section for bar in pack(cuts, 1.0, 0.0)) == ["thick", "thin"]


@pytest.mark.parametrize("name", ["pentacopter", "quadcopter", "y6_hexacopter"])
def test_connectors_are_where_the_meshes_meet(plans, name):
    """Distances from the end that the plan names, measured on the composed meshes."""
    found = plans[name]
    meshes = found.design.meshes()
    held = [p.name for p in found.design.parts if p.part.kind == "round_connector"]
    assert sorted(p.connector for p in found.places) == sorted(held)
    ends = {"rear": (0, 0), "front": (1, 0), "left": (0, 1), "right": (1, 1)}
    ends |= {"upper": (0, 2), "lower": (1, 2)}  # low or high coordinate of an axis, NED
    for place in found.places:
        side, axis = ends[place.start]
        rod, connector = meshes[place.rod].bounds, meshes[place.connector].bounds
        assert axis == int(np.ptp(rod, axis=0).argmax())
        distance = abs(0.5 * connector.sum(axis=0)[axis] - rod[side, axis])
        assert place.from_start == pytest.approx(distance, abs=1e-9)


def test_turn_of_a_connector(plans):
    """By hand: the pentacopter's front cross rod hangs in connectors that face down."""
    places = {p.connector: p for p in plans["pentacopter"].places}
    assert places["rail_left__cross_front"].roll == pytest.approx(180.0)
    assert places["cross_rear__rail_left"].roll == pytest.approx(0.0)


@pytest.mark.parametrize("along", [-14.0, 0.0, 6.0])
@pytest.mark.parametrize("across", [0.0, 9.0])
def test_angles_of_a_clip_on_its_mesh(along, across):
    mesh = clip_mesh(along, across, middle=14.0)
    x, y, z = top_normal(mesh)
    assert math.degrees(math.atan2(x, z)) == pytest.approx(along, abs=1e-6)
    assert math.degrees(math.atan2(-y, z)) == pytest.approx(across, abs=1e-6)
    assert mesh.is_watertight
    # the notch is at +x
    rim = mesh.vertices[np.hypot(*mesh.vertices[:, :2].T) > 15.0]
    nearest = rim[np.hypot(*rim[:, :2].T).argmin()]
    assert nearest[:2] == pytest.approx([16.5, 0.0], abs=1e-9)


def test_screw_holes_are_square_to_the_motor():
    """The walls of a clip's screw holes contain the normal of its top."""
    mesh = clip_mesh(6.0, -4.0, middle=10.0)
    normal = top_normal(mesh)
    middles = mesh.triangles_center[:, :2]
    walls = (np.abs(mesh.face_normals[:, 2]) < 0.3) & (np.hypot(*middles.T) < 14.0)
    walls &= np.hypot(*middles.T) > 5.0  # not the shaft's room, which is upright
    assert walls.sum() == 4 * 2 * 48
    assert np.abs(mesh.face_normals[walls] @ normal).max() < 1e-6
    assert has_screw_holes(10.6, 0.0, 10.0)  # the thesis's steepest motor
    assert clip_mesh(30.0, 0.0, middle=17.0).is_watertight


@pytest.mark.property
def test_screws_leave_a_clip_through_its_base():
    """From the motor's bolts along the top's normal down to the bed, 3.7 mm within the rim."""
    random, seen = np.random.default_rng(0), set()
    turns = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    bolts = 9.5 * np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], 1)
    for along, across, middle in random.uniform([-25, -25, 4], [25, 25, 14], (200, 3)):
        normal = np.array([np.tan(np.deg2rad(along)), -np.tan(np.deg2rad(across)), 1.0])
        on_top = bolts + (middle - bolts @ normal)[:, None] * [0.0, 0.0, 1.0]
        on_bed = on_top - on_top[:, 2:] * normal
        fits = np.hypot(*on_bed[:, :2].T).max() <= 18.0 - 1.7 - 2.0
        assert has_screw_holes(along, across, middle) == fits, (along, across, middle)
        seen.add(bool(fits))
    assert seen == {True, False}


@pytest.mark.parametrize("name", ["pentacopter", "quadcopter", "x_quadcopter", "y6_hexacopter"])
def test_clips_give_the_motors_their_directions(name):
    """From the STL file, through the clip's place in the design, to the direction asked for."""
    import trimesh

    design, directions = tilted(name)
    found = plan(design, directions=directions, printer=LARGE)
    parts = {p.name: p for p in found.design.parts}
    prints = {p.file: p.mesh for p in found.printed}
    for motor, wanted in zip(found.motors, directions.numpy(), strict=True):
        stl = io.BytesIO(trimesh.exchange.stl.export_stl(prints[f"clip_motor_{motor.number}.stl"]))
        mesh = trimesh.load(stl, file_type="stl")
        assert mesh.is_watertight
        normal = parts[motor.clip].rotation @ (np.diag([1.0, -1.0, -1.0]) @ top_normal(mesh))
        if motor.pusher:  # hangs below: the clip's top faces down, the thrust goes up
            normal = -normal
        sine = np.linalg.norm(np.cross(normal, wanted))
        assert math.degrees(math.atan2(sine, normal @ wanted)) < 1e-3  # STL: single precision
        assert motor.tilt == pytest.approx(math.degrees(math.acos(-wanted[2])), abs=1e-6)
        azimuth = math.degrees(math.atan2(wanted[1], wanted[0])) % 360.0
        assert motor.azimuth == pytest.approx(azimuth, abs=1e-6)


def test_shape_and_directions_reach_the_plan():
    design, directions = tilted("quadcopter")
    longer = design.closest({"arm_x.length": 0.6})
    found = plan(design, longer.values, directions)
    assert {round(c.length, 6) for c in found.cuts} == {0.6, 0.5}
    torch.testing.assert_close(found.design.directions, directions, atol=1e-9, rtol=0.0)
    assert found.mass > plan(design).mass


@pytest.mark.parametrize("name", ["pentacopter", "y6_hexacopter"])
def test_spins_reach_the_plan(name, tmp_path):
    design = load_design(name)
    spins = design.spins * torch.tensor([-1.0] + [1.0] * (len(design.rotors) - 2) + [-1.0]).double()
    found = plan(design, spins=spins)
    assert [m.clockwise for m in found.motors] == (spins > 0.0).tolist()
    loaded = load_design(found.design.save(tmp_path / "design.yaml"))
    assert loaded.multicopter().spins.tolist() == spins.tolist()
    torch.testing.assert_close(loaded.values, design.values, atol=1e-14, rtol=0.0)
    with pytest.raises(ValueError, match="spins must be"):
        plan(design, spins=0.5 * spins)


def test_spins_and_numbers(plans):
    pentacopter, y6 = plans["pentacopter"].motors, plans["y6_hexacopter"].motors
    assert [m.number for m in pentacopter] == [1, 2, 3, 4, 5]
    spins = plans["pentacopter"].design.multicopter().spins
    assert [m.clockwise for m in pentacopter] == (spins > 0.0).tolist()
    assert [m.pusher for m in y6] == [False, True] * 3
    assert all(a.clockwise != b.clockwise for a, b in zip(y6[::2], y6[1::2], strict=True))
    assert all(m.clip is None and m.tilt < 1e-6 for m in pentacopter)


def test_files(plans, tmp_path):
    import trimesh

    found = plans["pentacopter_payload"]
    page = write_fabrication(found, tmp_path / "deep" / "plan").read_text(encoding="utf-8")
    folder = tmp_path / "deep" / "plan"
    assert page.count("data:image/") == 4
    assert 'src="http' not in page and "<script" not in page
    for heading in ("Rods", "Motors", "Bill of materials", "Assembly"):
        assert f">{heading}</h2>" in page
    with (folder / "materials.csv").open(encoding="utf-8") as file:
        rows = [r for r in csv.DictReader(file) if r["source"] != "consumable"]
    # hundredths of a gram per line
    assert sum(float(r["mass_g"]) for r in rows) == pytest.approx(1e3 * found.mass, abs=0.1)
    summary = yaml.safe_load((folder / "plan.yaml").read_text(encoding="utf-8"))
    assert summary["mass_kg"] == found.mass
    assert [m["number"] for m in summary["motors"]] == [1, 2, 3, 4, 5]
    assert {f.name for f in (folder / "stl").iterdir()} == {p.file for p in found.printed}
    assert all(trimesh.load(f).is_watertight for f in (folder / "stl").iterdir())
    again = load_design(folder / "design.yaml")
    assert float(again.mass()) == pytest.approx(found.mass, rel=1e-12)


def test_prism_with_holes():
    square = refined(np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 20.0], [0.0, 20.0]]), 2.0)
    holes = [circle(3.0, (10.0, 10.0)), circle(2.0, (30.0, 8.0))]
    mesh = perforated_prism(square, holes, 5.0, slope=(0.1, 0.0))
    assert mesh.is_watertight
    area = 0.5 * 48 * math.sin(2.0 * math.pi / 48)  # of a unit polygon
    volume = 800.0 * 7.0 - area * (9.0 * 6.0 + 4.0 * 8.0)
    assert mesh.volume == pytest.approx(volume, rel=1e-12)
    assert mesh.euler_number == 2 - 2 * 2  # two handles
    backwards = perforated_prism(square[::-1], [h[::-1] for h in holes], 5.0, slope=(0.1, 0.0))
    assert backwards.volume == pytest.approx(volume, rel=1e-12)
    assert inside(np.array([[1.0, 1.0], [10.0, 10.0], [50.0, 1.0]]), [square, *holes]).tolist() == [
        True,
        False,
        False,
    ]


@pytest.mark.parametrize("degrees", [0.0, 17.0, 31.4, 45.0, 67.5])
def test_prism_of_any_orientation(degrees):
    """Points of one straight side are collinear up to rounding, which differs with the angle."""
    a = math.radians(degrees)
    turn = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    corners = np.array(
        [[0.0, 0.0], [80.0, 0.0], [80.0, 10.0], [10.0, 10.0], [10.0, 50.0], [0.0, 50.0]]
    )
    for spacing in (1.1, 2.3, 5.0):
        hole = circle(1.5, turn @ [60.0, 5.0], segments=24)
        mesh = perforated_prism(refined(corners @ turn.T, spacing), [hole], 3.0)
        assert mesh.is_watertight
        inner = 12.0 * 1.5**2 * math.sin(2.0 * math.pi / 24)
        assert mesh.volume == pytest.approx(3.0 * (1200.0 - inner), rel=1e-12)


def test_holes_that_leave_the_outline_are_refused():
    square = refined(np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [0.0, 20.0]]), 2.0)
    with pytest.raises(MeshError, match="move holes away"):
        perforated_prism(square, [circle(3.0, (1.0, 10.0))], 5.0)


def test_thinnest_wall_of_a_tube():
    tube = perforated_prism(circle(10.0, segments=96), [circle(8.5, segments=96)], 30.0)
    assert thinnest_wall(tube) == pytest.approx(1.5, abs=0.01)
    assert check_print(tube, Printer(min_wall=1.6)).problems == (
        "a wall of 1.5 mm is thinner than 1.6 mm",
    )


def test_what_cannot_be_printed_is_said():
    import trimesh

    box = trimesh.creation.box((10.0, 300.0, 20.0))
    assert check_print(box, Printer(bed=(320.0, 50.0, 50.0))).problems == ()  # turned by 90 degrees
    assert "10 x 300 x 20 mm do not fit" in check_print(box, Printer()).problems[0]
    inverted = box.copy()
    inverted.invert()
    assert "inside out" in check_print(inverted, LARGE).problems[0]
    open_box = trimesh.Trimesh(box.vertices, box.faces[:-1], process=False)
    assert "not closed" in check_print(open_box, LARGE).problems[0]


def test_frame_larger_than_the_printer_is_a_problem_not_an_error():
    found = plan(load_design("x_quadcopter"))
    assert len(found.problems) == 1
    assert "frame.stl: 382 x 382 x 8 mm do not fit" in found.problems[0]


def test_imported_designs_are_planned_as_far_as_they_say(tmp_path):
    """The public tool's file names meshes, not kinds: rods are cut, the rest is bought."""
    design = import_xml(data_folder("copter_reference") / "y6copter.xml")
    found = plan(design)
    write_plan(found, tmp_path)
    assert [(round(c.length, 3), c.quantity) for c in found.cuts] == [
        (0.6, 2),
        (0.18, 4),
        (0.132, 2),
    ]
    assert found.mass == pytest.approx(float(design.mass()), rel=1e-12)
    assert [m.pusher for m in found.motors] == [False, True] * 3
    assert found.printed == () and found.steps[0].startswith("Cut the rods")


def test_propellers_that_touch_are_a_problem():
    design = load_design("x_quadcopter")
    # neighbors 0.2 m apart, radii 0.127 m
    small = design.closest({"frame.half_length": 0.1, "frame.half_width": 0.1})
    found = plan(small, printer=LARGE).problems
    assert len(found) == 4
    assert found[0] == "the propellers of motors 1 and 2 cut into each other"


def test_screw_holes_that_leave_too_little_of_an_arm_are_refused():
    """Arms of an X that is far wider than long are too slim for the motor's screws."""
    wide = load_design("x_quadcopter").closest({"frame.half_length": 0.1})
    with pytest.raises(FabricationError, match=r"frame\.stl: a wall of 0\.\d+ mm is thinner"):
        plan(wide, printer=LARGE)


def test_errors():
    design = load_design("quadcopter")
    with pytest.raises(ValueError, match=r"stock must be .* 0\.3 m for 'arm_x' of 0\.5 m"):
        plan(design, stock=0.3)
    with pytest.raises(ValueError, match="bed along y"):
        Printer(bed=(200.0, 0.0, 200.0))
    with pytest.raises(FabricationError, match=r"plate_.*2\.4 mm is thinner than 3 mm"):
        plan(design, printer=Printer(min_wall=3.0))


def test_command_line(tmp_path, capsys):
    out = tmp_path / "plan"
    assert cli.main(["fabricate", "quadcopter", "--out", str(out), "--stock", "1.2"]) == 0
    assert "1312 g" in capsys.readouterr().out
    assert (out / "index.html").stat().st_size > 50_000
    assert cli.main(["fabricate", "quadcoptr", "--out", str(out)]) == 2
    assert "did you mean 'quadcopter'" in capsys.readouterr().err
    assert cli.main(["fabricate", "quadcopter", "--stock", "0.1", "--out", str(out)]) == 2
    assert "buy longer bars" in capsys.readouterr().err


#: columns of a table of the page, and those of the file that hold the same
SHOWN = {
    "Rods": ("rods", {"quantity": "quantity", "length [mm]": "length_mm"}),
    "Connectors on rods": (
        "connectors",
        {"to its middle [mm]": "from_start_mm", "turned [deg]": "roll_deg"},
    ),
    "Motors": (
        "motors",
        {
            **{f"{way} [mm]": f"{way}_mm" for way in ("front", "right", "down")},
            "angle from up [deg]": "tilt_deg",
        },
    ),
    "Printed parts and sheets": (
        "prints",
        {"mass each [g]": "mass_g", "thinnest wall [mm]": "thinnest_wall_mm"},
    ),
    "Bill of materials": ("materials", {"mass [g]": "mass_g", "price [EUR]": "price_eur"}),
}


def test_page_and_files_show_the_numbers_of_the_plan(plans, monkeypatch):
    for picture in ("view", "wiring", "bars", "printed"):  # seconds of drawing
        monkeypatch.setattr(fabrication_page.draw, picture, lambda *_: None)
    monkeypatch.setattr(fabrication_page, "data_uri", lambda *_, **__: "")
    found = plans["pentacopter_payload"]
    files = summary(found)
    for section in fabrication_page.page(found).sections:
        name, columns = SHOWN.get(section.title, ("", {}))
        for table in (part for part in section.content if isinstance(part, Table) and name):
            shown = [row for row in table.rows if row[0] != "total"]
            for column, own in columns.items():
                cells = [float(row[table.columns.index(column)]) for row in shown]
                digits = 0.5 if "turned" in column else 0.051
                assert cells == pytest.approx([row[own] for row in files[name]], abs=digits)
    in_si = {
        ("rods", "length_mm"): [1e3 * cut.length for cut in found.cuts],
        ("connectors", "from_start_mm"): [1e3 * place.from_start for place in found.places],
        ("motors", "down_mm"): [1e3 * motor.position[2] for motor in found.motors],
        ("materials", "mass_g"): [
            1e3 * line.mass for line in (*found.materials, *found.consumables)
        ],
    }
    for (name, own), wanted in in_si.items():
        assert [row[own] for row in files[name]] == pytest.approx(wanted, abs=0.051)
        assert len(wanted) > 2
