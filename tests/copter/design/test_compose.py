"""Composition: rotations, constraints, adapters, elimination, closest designs, gradients."""

import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from diffsim.copter import (
    Connection,
    DesignSpec,
    InfeasibleDesignError,
    PartSpec,
    build_design,
    load_design,
    shipped_designs,
)
from diffsim.copter.design.adapters import RULES, adapters_for
from diffsim.copter.design.constraints import Constraint, irreducible_conflict, parse_constraint
from diffsim.copter.design.contact import _complement
from diffsim.copter.vehicle.parts import PART_KINDS, make_part

TILT = (0.1, -0.15, -0.9)


def part(name, kind, **options):
    own = {k: options.pop(k) for k in ("place", "rotation", "direction", "bounds") if k in options}
    return PartSpec(name=name, kind=kind, options=options, **own)


def join(host, guest, **options):
    return Connection(host=host, guest=guest, **options)


def cross(constraints=(), **changes):
    """Two crossed rods on a plate with a motor at each end; motor_4 may be tilted."""
    parts = [
        part("plate", "plate"),
        part("arm_1", "rod", length=0.5),
        part("arm_2", "rod", length=0.4),
        *(part(f"motor_{k}", "motor", spin="cw" if k % 2 else "ccw") for k in (1, 2, 3)),
        part("motor_4", "motor", spin="ccw", direction=changes.pop("direction", None)),
    ]
    connections = [
        join("plate.top", "arm_1.shaft"),
        join("arm_1.shaft", "arm_2.shaft", angle=90.0),
        join("arm_1.end", "motor_1.base"),
        join("arm_2.end", "motor_2.base"),
        join("arm_1.start", "motor_3.base"),
        join("arm_2.start", "motor_4.base"),
    ]
    fixed = ("plate.length == 0.15", "plate.width == 0.15")
    return DesignSpec(
        name="cross",
        parts=tuple(parts),
        connections=tuple(changes.pop("connections", connections)),
        constraints=(*fixed, *constraints),
        **changes,
    )


def kinds(design):
    return [p.part.kind for p in design.parts]


def test_rules_insert_adapters():
    design = build_design(cross())
    # one under the first rod, two where rods cross, one under each of four motors
    assert kinds(design).count("round_connector") == 7
    assert kinds(design).count("propeller") == 4
    assert "compound_angle_clip" not in kinds(design)
    tilted = build_design(cross(direction=TILT))
    assert kinds(tilted).count("compound_angle_clip") == 1


def test_rule_table_names_kinds_and_fittings_that_exist():
    fittings = {
        patch.fitting
        for kind in ("rod", "plate", "motor", "battery", "round_connector", "propeller")
        for patch in make_part(kind).patches.values()
    }
    assert {f for pair in RULES for f in pair} == fittings
    assert {a for adapters in RULES.values() for a in adapters} <= set(PART_KINDS)
    assert all(a <= b for a, b in RULES)
    rod, motor = make_part("rod").patches["end"], make_part("motor").patches["base"]
    assert adapters_for(rod, motor) == adapters_for(motor, rod) == ("round_connector",)
    with pytest.raises(ValueError, match="no adapter joins a motor patch and a shaft patch"):
        adapters_for(motor, make_part("propeller").patches["hub"])


def test_own_parts_with_a_feasible_set_of_their_own(monkeypatch):
    """A plate that must be twice as long as it is wide."""

    def long_plate(length: float = 0.2, width: float = 0.05):
        rows = (np.array([[-1.0, 2.0]]), np.array([0.0]))
        return replace(make_part("plate", {"length": length, "width": width}), rows=rows)

    monkeypatch.setitem(PART_KINDS, "long_plate", long_plate)
    design = build_design(DesignSpec(name="own", parts=(part("base", "long_plate"),)))
    wider = design.closest({"base.width": 0.15})
    assert wider.value("base.length") == pytest.approx(0.3)
    with pytest.raises(InfeasibleDesignError, match=r"base: -1 length \+ 2 width <= 0"):
        design.closest({"base.width": 0.15, "base.length": 0.2})


def test_plates_get_screw_mounts():
    spec = DesignSpec(
        name="sandwich",
        parts=(part("low", "plate"), part("high", "plate", length=0.1)),
        connections=(join("low.top", "high.bottom"),),
    )
    design = build_design(spec)
    assert kinds(design) == ["plate", "screw_mount", "plate"]
    gap = design.value("low.z") - design.value("high.z")
    assert gap == pytest.approx(design.value("low__high.height") + 0.0024)


@pytest.mark.property
def test_patches_coincide_everywhere_in_the_feasible_set():
    """Motors stay on their rods' ends, 45.6 mm apart in height, whatever the free parameters."""
    design = build_design(cross())
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        s = design.values + 0.1 * torch.randn(len(design.names), generator=generator).double()
        ends = {k: torch.tensor([design.value(f"motor_{k}.{a}", s) for a in "xyz"]) for k in (1, 2)}
        arm = torch.tensor([design.value(f"arm_1.{a}", s) for a in "xyz"])
        along = 0.5 * design.value("arm_1.length", s) - 0.02
        height = 0.0228 + 0.037
        torch.testing.assert_close(ends[1] - arm, torch.tensor([along, 0.0, -height]))
        assert float(ends[1][2] - ends[2][2]) == pytest.approx(0.0456)


@pytest.mark.property
def test_free_parameters_are_parameters():
    design = build_design(cross())
    rows = [design.all_names.index(n) for n in design.names]
    np.testing.assert_array_equal(design.basis[rows].numpy(), np.eye(len(rows)))
    assert float(design.offset[rows].abs().max()) == 0.0
    names = {"arm_1.length", "arm_2.length"}
    assert names <= set(design.names)
    assert "plate.length" not in design.names


def test_direction_of_a_tilted_motor():
    design = build_design(cross(direction=TILT))
    expected = torch.tensor(TILT, dtype=torch.float64)
    expected = expected / expected.norm()
    torch.testing.assert_close(design.directions[3], expected, atol=1e-12, rtol=0.0)
    up = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(design.directions[0], up, atol=0.0, rtol=0.0)
    # the motor's axis goes through the middle of the clip's tilted face
    clip = next(p for p in design.parts if p.part.kind == "compound_angle_clip")
    top = clip.rotation @ clip.part.patches["top"].center.offset
    top = torch.from_numpy(top + [design.value(n) for n in clip.position_names])
    motor = torch.tensor([design.value(f"motor_4.{a}") for a in "xyz"], dtype=torch.float64)
    torch.testing.assert_close(motor - top, 0.037 * expected, atol=1e-12, rtol=0.0)


def test_with_directions_rebuilds():
    flat = build_design(cross()).closest({"arm_1.length": 0.62})
    directions = flat.directions.clone()
    directions[3] = torch.tensor(TILT, dtype=torch.float64) / np.linalg.norm(TILT)
    tilted = flat.with_directions(directions)
    torch.testing.assert_close(tilted.directions, directions, atol=1e-12, rtol=0.0)
    assert tilted.value("arm_1.length") == pytest.approx(0.62)
    assert float(tilted.mass()) > float(flat.mass())  # a clip more


@pytest.mark.grad
@pytest.mark.parametrize("name", ["cross", "x_quadcopter", "bunny"])
def test_gradients(name):
    design = build_design(cross(direction=TILT)) if name == "cross" else load_design(name)
    s = design.values.clone().requires_grad_()

    def outputs(s):
        c = design.multicopter(s)
        return c.mass, 100.0 * c.inertia, c.positions, design.cost(s), design.size(s)

    assert torch.autograd.gradcheck(outputs, (s,))
    jacobian = torch.autograd.functional.jacobian(outputs, s.detach())
    assert all(float(j.abs().max()) > 0.0 for j in jacobian[:-2])


@pytest.mark.reference
def test_mass_properties_agree_with_trimesh():
    """All meshes of the design at a moved point, summed by trimesh."""
    design = load_design("pentacopter").closest({"spine.length": 0.8})
    meshes = design.meshes()
    densities = {p.name: p.part.density for p in design.parts}
    mass, com = 0.0, np.zeros(3)
    for name, mesh in meshes.items():
        mesh.density = densities[name]
        mass, com = mass + mesh.mass, com + mesh.mass * mesh.center_mass
    com = com / mass
    at_com = np.eye(4)
    at_com[:3, 3] = com
    inertia = sum(mesh.moment_inertia_frame(at_com) for mesh in meshes.values())
    copter = design.multicopter()
    assert float(copter.mass) == pytest.approx(mass, rel=1e-12)
    np.testing.assert_allclose(design.center_of_mass().numpy(), com, atol=1e-12)
    np.testing.assert_allclose(copter.inertia.numpy(), inertia, atol=1e-9)


def test_closest_meets_request_and_constraints():
    design = build_design(cross(["arm_1.length == arm_2.length"]))
    moved = design.closest({"arm_2.length": 0.3})
    assert moved.value("arm_1.length") == pytest.approx(0.3, abs=1e-8)
    assert moved.feasible.violation(moved.values.numpy()) < 1e-8
    # symmetric request, symmetric answer
    assert moved.value("motor_1.x") == pytest.approx(-moved.value("motor_3.x"), abs=1e-6)


@pytest.mark.reference
def test_closest_is_the_closest():
    """Another solver (SLSQP) finds the same point; a bound is active there."""
    design = build_design(cross(["arm_1.length + arm_2.length <= 1.0"]))
    moved = design.closest({"arm_1.length": 0.8})
    assert moved.value("arm_2.length") == pytest.approx(0.2, abs=1e-7)
    x0 = design.all_values().numpy()
    weights = np.array(
        [
            0.0 if p.automatic else 1.0
            for p in design.parts
            for _ in (*p.shape_names, *p.position_names)
        ]
    )
    a, b = (t.numpy() for t in design.inequalities)
    basis, offset = design.basis.numpy(), design.offset.numpy()
    target = x0.copy()
    target[design.all_names.index("arm_1.length")] = 0.8
    pin = design.names.index("arm_1.length")
    found = minimize(
        lambda s: 100.0 * (weights * (offset + basis @ s - target) ** 2).sum(),
        design.values.numpy(),
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": lambda s: b - a @ s},
            {"type": "eq", "fun": lambda s: s[pin] - 0.8},
        ],
        options={"ftol": 1e-14, "maxiter": 500},
    )
    np.testing.assert_allclose(moved.values.numpy(), found.x, atol=1e-5)


def test_closest_is_fast_enough_for_a_slider():
    design = load_design("pentacopter")
    design.closest({"spine.length": 0.7})
    start = time.process_time()
    design.closest({"spine.length": 0.75})
    assert time.process_time() - start < 0.5  # 0.03 s on a quiet core


def test_conflict_is_irreducible():
    extra = [
        "arm_1.length == arm_2.length",
        "arm_2.length == 2 * motor_1.x",
        "arm_1.length >= 0.6",
        "arm_2.length <= 0.45",
    ]
    with pytest.raises(InfeasibleDesignError) as caught:
        build_design(cross(extra))
    conflict = set(caught.value.conflict)
    assert conflict == {extra[0], extra[2], extra[3]}
    for left_out in conflict:  # each alone is to blame
        rest = [e for e in extra if e != left_out]
        build_design(cross(rest[:1] + rest[2:] if extra[1] in rest[:2] else rest))


def test_conflict_names_the_request():
    design = build_design(cross())
    with pytest.raises(InfeasibleDesignError, match="arm_1: length <= 5") as caught:
        design.closest({"arm_1.length": 7.0})
    assert len(caught.value.conflict) == 2


@pytest.mark.parametrize(
    ("name", "message"),
    [("arm_1.lenght", "did you mean 'length'"), ("arn_1.length", "did you mean 'arm_1'")],
)
def test_a_misspelled_parameter_is_answered_by_the_closest(name, message):
    with pytest.raises(ValueError, match=message):
        build_design(cross()).value(name)


def test_inconsistent_equalities_are_found():
    rows = [
        Constraint("a", {"x": 1.0, "y": 1.0}, 1.0, "=="),
        Constraint("b", {"x": 2.0, "y": 2.0}, 1.0, "=="),
        Constraint("c", {"x": 1.0}, 0.0, "<="),
    ]
    assert irreducible_conflict(["x", "y"], rows) == ("a", "b")


def test_size_and_cost_are_linear():
    design = build_design(cross())
    assert float(design.size()) == pytest.approx(0.9)
    longer = design.closest({"arm_1.length": 0.8})
    assert float(longer.size()) == pytest.approx(1.2)
    assert float(longer.cost() - design.cost()) == pytest.approx(0.3 * 30.0)
    entries = longer.bill_of_materials()
    assert sum(e.price for e in entries) == pytest.approx(float(longer.cost()))
    assert sum(e.mass for e in entries) == pytest.approx(float(longer.mass()))
    assert next(e for e in entries if e.name == "arm_1").dimensions["length"] == pytest.approx(0.8)


def test_what_is_printed_costs_what_it_weighs():
    """The cost that a search sees is that of the list, whose frame is printed plastic."""
    printed = load_design("x_quadcopter")
    prices = sum(entry.price for entry in printed.bill_of_materials())
    assert float(printed.cost()) == pytest.approx(prices, rel=1e-12)


def test_closest_pair_of_patches():
    """Thesis 3.2.2: without named patches the two closest that fit are joined."""
    spec = DesignSpec(
        name="pair",
        parts=(part("arm", "rod"), part("motor", "motor", place=(0.24, 0.0, -0.05))),
        connections=(join("arm", "motor"),),
    )
    design = build_design(spec)
    # the motor's place is asked for, the rod's length is the database's: the rod's end gives way
    assert design.value("motor.x") == pytest.approx(0.24)
    assert design.value("arm.length") == pytest.approx(0.52)


@pytest.mark.property
@pytest.mark.parametrize("slides", [0, 1, 2])
def test_what_does_not_slide_is_held(slides):
    """Directions that slides leave are perpendicular to them, and to one another."""
    free, _ = np.linalg.qr(np.random.default_rng(slides).normal(size=(3, 3)))
    held = _complement(list(free[:slides]), np.array([0.3, -0.5, 0.8]))
    every = np.vstack([free[:slides], held])
    np.testing.assert_allclose(every @ every.T, np.eye(3), atol=1e-12)


@pytest.mark.property
def test_bounds_are_those_of_the_feasible_set():
    design = build_design(cross(["arm_1.length <= 0.7", "arm_1.length >= 2 * arm_2.length - 0.4"]))
    k = design.names.index("arm_2.length")
    assert float(design.lower[k]) == pytest.approx(0.05)
    assert float(design.upper[k]) == pytest.approx(0.55)
    for name in shipped_designs():
        shipped = load_design(name)
        a, b = shipped.inequalities
        assert float((a @ shipped.values - b).max()) < 1e-9
        assert bool((shipped.lower <= shipped.values + 1e-9).all())
        assert bool((shipped.values <= shipped.upper + 1e-9).all())


def test_meshes_follow_directions():
    design = build_design(cross())
    directions = design.directions.clone()
    directions[0] = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    mesh = design.meshes(directions=directions)["motor_1__propeller"]
    normals = mesh.face_normals[np.argsort(mesh.area_faces)[-2:]]
    assert np.abs(normals @ directions[0].numpy()) == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"constraints": ["arm_1.lenth == 0.3"]}, "did you mean 'length'"),
        ({"constraints": ["arm1.length == 0.3"]}, "did you mean 'arm_1'"),
        ({"constraints": ["arm_1.length * arm_2.length == 0.3"]}, "not linear"),
        ({"constraints": ["arm_1.length"]}, "must be one relation"),
        ({"constraints": ["arm_1.length = 3"]}, "cannot be read"),
        ({"constraints": ["1 == 2"]}, "holds no parameter"),
        ({"connections": [join("plate.top", "arm_1.shift")]}, "did you mean 'shaft'"),
        ({"connections": [join("plate.top", "arm1.shaft")]}, "did you mean"),
        ({"connections": [join("arm_2.end", "motor_2.base")]}, "neither part has a place"),
        ({"connections": [join("plate.top", "arm_1.shaft")]}, "'arm_2' is connected to nothing"),
        (
            {"connections": [join("plate.top", "arm_1.shaft", at=(0.1,))]},
            "at must hold 2 numbers for plate.top, got 1",
        ),
        ({"values": {"arm_1.lenght": 0.3}}, "did you mean 'length'"),
    ],
)
def test_bad_designs(changes, message):
    constraints = changes.pop("constraints", ())
    with pytest.raises(ValueError, match=message):
        build_design(cross(constraints, **changes))


def test_slide_follows_its_patch_when_ends_are_swapped():
    """The same connection written from the other end."""
    specs = [
        DesignSpec(
            name="pair",
            parts=(part("arm", "rod"), part("motor", "motor")),
            connections=(connection,),
        )
        for connection in (
            join("arm.shaft", "motor.base", at=(0.1,), slide=False),
            join("motor.base", "arm.shaft", guest_at=(0.1,)),
        )
    ]
    fixed, sliding = (build_design(spec) for spec in specs)
    assert fixed.value("motor.x") == pytest.approx(0.1)
    assert sliding.value("motor.x") == pytest.approx(0.1)
    assert "motor.x" not in fixed.names
    assert "motor.x" in sliding.names


def test_guest_at_is_a_place_on_the_guest():
    """A point 0.1 m along the second rod lies above the first rod's point at 0.05 m."""
    spec = DesignSpec(
        name="pair",
        parts=(part("low", "rod"), part("high", "rod")),
        connections=(join("low.shaft", "high.shaft", at=(0.05,), guest_at=(0.1,), angle=90.0),),
    )
    design = build_design(spec)
    axis = next(p.rotation[:, 0] for p in design.parts if p.name == "high")
    center = np.array([design.value(f"high.{a}") for a in "xyz"])
    np.testing.assert_allclose(center + 0.1 * axis, [0.05, 0.0, -0.0456], atol=1e-12)
    np.testing.assert_allclose(axis, [0.0, -1.0, 0.0], atol=1e-12)


def test_directions_are_never_dropped():
    turned = part("motor", "motor", rotation=(0.0, 0.0, 0.0), place=(0.0, 0.0, 0.0), direction=TILT)
    with pytest.raises(ValueError, match=r"points 11\.3 degrees away from its direction"):
        build_design(DesignSpec(name="alone", parts=(turned,)))
    with pytest.raises(ValueError, match=r"direction of 'motor_4'.*less than 60 degrees"):
        build_design(cross(direction=(1.0, 0.0, 0.1)))
    with pytest.raises(ValueError, match="direction of 'motor_4' must not be zero"):
        build_design(cross(direction=(0.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="'arm' has a direction but is no motor"):
        build_design(DesignSpec(name="arm", parts=(part("arm", "rod", direction=TILT),)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"length": 6.0}, r"part 'arm': length must lie in its bounds .0.05, 5., got 6"),
        ({"bounds": {"length": (0.1, 9.0)}}, r"bounds of length must lie in .0.05, 5."),
        ({"bounds": {"length": (0.3, 0.2)}}, r"got .0.3, 0.2."),
        ({"bounds": {"lenght": (0.1, 0.2)}}, r"did you mean 'length'"),
    ],
)
def test_bounds_and_starts(options, message):
    with pytest.raises(ValueError, match=message):
        build_design(DesignSpec(name="rod", parts=(part("arm", "rod", **options),)))


@pytest.mark.parametrize("name", ["1st", "a.b", "a__b"])
def test_part_names(name):
    with pytest.raises(ValueError, match="single underscores"):
        part(name, "rod")


def test_names_stand_once():
    parts = (part("leg", "rod"), part("arm", "rod"), part("arm", "plate"))
    with pytest.raises(ValueError, match="two parts are called 'arm'"):
        build_design(DesignSpec(name="twins", parts=parts))


def test_adapters_overrule_the_rules(tmp_path):
    """A mount between a battery and a motor, which no rule joins; kept by saving."""
    connections = (join("low.top", "motor.base", adapters=("standoff",)),)
    spec = DesignSpec(
        name="odd", parts=(part("low", "battery"), part("motor", "motor")), connections=connections
    )
    design = build_design(spec)
    assert kinds(design) == ["battery", "standoff", "motor", "propeller"]
    direct = DesignSpec(
        name="direct",
        parts=(part("low", "plate"), part("high", "plate")),
        connections=(join("low.top", "high.bottom", adapters=()),),
    )
    loaded = load_design(build_design(direct).save(tmp_path / "direct.yaml"))
    assert kinds(loaded) == ["plate", "plate"]
    with pytest.raises(ValueError, match="no adapter joins a strap patch and a motor patch"):
        build_design(replace(spec, connections=(join("low.top", "motor.base"),)))


@pytest.mark.parametrize(
    ("parts", "connection", "said"),
    [
        (
            (part("arm", "rod"), part("blades", "propeller")),
            join("arm", "blades"),
            "a rod patch takes motor, mount, plate, rod, strap",
        ),
        (
            (part("low", "plate"), part("high", "plate")),
            join("low.top", "high.bottom", adapters=("screw_mout",)),
            "did you mean 'screw_mount'",
        ),
        (
            (part("arm", "rod"), part("cap", "round_connector", rotation=(0.0, 10.0, 0.0))),
            join("arm.shaft", "cap.bore"),
            "10 degrees off",
        ),
    ],
)
def test_pairs_that_do_not_fit_are_refused(parts, connection, said):
    with pytest.raises(ValueError, match=said):
        build_design(DesignSpec(name="pair", parts=parts, connections=(connection,)))


def test_values_outside_are_refused():
    design = build_design(cross())
    s = design.values.clone()
    s[design.names.index("arm_1.length")] = 6.0
    with pytest.raises(ValueError, match="violates 'arm_1: length <= 5'"):
        design.with_values(s)
    with pytest.raises(ValueError, match=r"s must have shape \(\d+\)"):
        design.multicopter(s[:-1])
    with pytest.raises(ValueError, match="did you mean 'arm_1'"):
        design.closest({"arm1.length": 0.3})


def test_design_without_motors():
    design = build_design(DesignSpec(name="bare", parts=(part("arm", "rod"),)))
    with pytest.raises(ValueError, match="has no motor"):
        design.multicopter()
    with pytest.raises(ValueError, match="has no parts"):
        build_design(DesignSpec(name="none", parts=()))


@pytest.mark.parametrize(
    ("text", "coefficients", "bound", "relation"),
    [
        ("a.x == b.y", {"a.x": 1.0, "b.y": -1.0}, 0.0, "=="),
        ("2 * (a.x - 0.5) <= 1 - b.y / 4", {"a.x": 2.0, "b.y": 0.25}, 2.0, "<="),
        ("-a.x >= 3", {"a.x": 1.0}, -3.0, "<="),
    ],
)
def test_expressions(text, coefficients, bound, relation):
    parsed = parse_constraint(text, lambda name: name)
    assert parsed.coefficients == pytest.approx(coefficients)
    assert (parsed.bound, parsed.relation) == (pytest.approx(bound), relation)


def test_without_osqp(monkeypatch):
    """Loading needs no QP; moving a parameter says what is missing."""
    monkeypatch.setitem(sys.modules, "osqp", None)
    design = build_design(cross())
    with pytest.raises(ImportError, match=r"pip install 'osqp>="):
        design.closest({"arm_1.length": 0.3})


def test_parameters_outside_of_the_bounds_are_refused():
    design = load_design("quadcopter")
    for step in (-1.0, 3.0):  # rods of negative length, and longer than allowed
        s = design.values + step
        for ask in (design.multicopter, design.mass, design.cost, design.meshes, design.extent):
            with pytest.raises(ValueError, match=r"s violates .* use closest"):
                ask(s)
    s = design.values.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda s: design.multicopter(s).mass, (s,))
    torch.func.jacrev(lambda s: design.mass(s))(design.values)
    with pytest.raises(ValueError, match="s violates"):
        torch.func.vmap(design.mass)(design.values + torch.tensor([[0.0], [3.0]]).double())
    trial = replace(design, bounded=False)  # for a solver's trial points
    assert torch.isfinite(trial.mass(design.values + 0.3))
