"""Populations from the cases that the rooms' tests are about: what no example of a call reaches."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from diffsim import copter, envs, mesh, optim, soft
from diffsim.copter.codesign.cases import Demands
from diffsim.copter.codesign.hessian import lagrangian_hessian
from tests.derivatives.check import rows
from tests.known.fingerprint import numbers_in
from tests.soft.cases import deformed, noise
from tests.studies import study_of
from tests.systems import kinds
from tests.systems.kinds import SHARE, Ready, uniform


def vars_of(value: Any) -> Any:
    """Fields of a data class or a named tuple."""
    return value._asdict() if hasattr(value, "_asdict") else vars(value)


def vehicles(folder: Path) -> dict[str, Any]:
    """Multicopters of every language in which one may be written, and how they hover."""
    from tests.copter.exchange import test_vehicle_file as files
    from tests.copter.exchange import test_vehicle_sdf as sdf

    rotors = [{"body": f"rotor_{k}", "spin": s} for k, s in enumerate(("ccw", "ccw", "cw", "cw"))]
    of_urdf = {"body": "FLU", "body_file": "body.urdf", "rotors": rotors}
    of_urdf = yaml.safe_dump(of_urdf | {"rotor": {"model": "kde2814_10in"}})
    (folder / "body.urdf").write_text(files.urdf_text(), "utf-8")
    (folder / "of_urdf.yaml").write_text(of_urdf, "utf-8")
    (folder / "own.yaml").write_text(files.QUAD, "utf-8")
    (folder / "own.xml").write_text(files.MJCF, "utf-8")
    sdf.sdf(folder, sdf.BASE + sdf.ROTORS)
    out = {}
    for path in sorted(set(folder.iterdir()) - {folder / "body.urdf"}):
        made = copter.load_vehicle(path)
        out[path.name] = [vars(made), vars(made.vehicle), copter.hover(made.vehicle).thrusts]
    return out


def numbers_of_mjcf(folder: Path) -> dict[str, Any]:
    """A model of MuJoCo with each of its numbers changed."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install mujoco)")
    from tests.systems.outside import test_mjcf_numbers as files

    return {
        f"{path} {actuator[:8]}": files.simulate(actuator, {path: value})
        for path, value, actuator, *_ in files.NUMBERS
    }


def designs_on_paper(folder: Path) -> dict[str, Any]:
    """The program of co-design: values, slopes and curvatures."""
    from tests.copter.codesign import test_codesign_program as case

    out = {}
    for name, weights, demands in (
        ("all", case.ALL, None),
        ("response", {"response": 0.4}, Demands()),
    ):
        whole = case.program(weights, demands, clearance=0.02)
        x = np.random.default_rng(0).uniform(0.2, 0.8, whole.num_all)
        equal, unequal = whole.equalities(x), whole.inequalities(x)
        out[name] = [whole.objective(x), equal, unequal]
        sizes = [np.cos(np.arange(len(part[0]))) for part in (equal, unequal)]
        if demands is None:
            out["curvature"] = lagrangian_hessian(whole, x, *sizes, 0.7)
    return out


TERMS = ("speed", "drift", "distance", "height", "upright", "alive", "change", "energy", "effort")


def described_tasks(folder: Path) -> dict[str, Any]:
    """Soft bodies of task files: what every term of a reward pays, what is seen."""
    from tests.envs import soft_files as files

    bodies = {
        "finger": files.finger(ends={"tilt": "30 deg"}),
        "swimmer": files.with_model(files.finger(current=0.05), fixed=[], water={}),
        "block": files.block_on_floor(),
    }
    bodies = {
        name: {k: v for k, v in keys.items() if k != "reward"} | {"goal": files.finger()["goal"]}
        for name, keys in bodies.items()
    }
    out = {}
    for name, keys in bodies.items():
        for term in TERMS:
            task = envs.make_task("SoftBody", **keys, reward=[{"term": term}])
            state = task.start(2, np.random.default_rng(0))
            for k in range(2):
                action = torch.full((2, task.num_actions), 0.5 - 0.8 * k, dtype=torch.float64)
                state, reward = task.step(state, action)
                out[f"{name} {term} {k}"] = [reward, task.observe(state), task.failed(state)]
    return out


def solids(folder: Path) -> dict[str, Any]:
    """Volumes of closed surfaces, by every method, and every solid there is."""
    import trimesh

    surfaces = {
        "ball": trimesh.creation.icosphere(subdivisions=2, radius=0.1),
        "box": trimesh.creation.box((0.2, 0.11, 0.1)),
    }
    out = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, surface in surfaces.items():
            for way, made in (
                ("voxels", mesh.voxelize(surface, 0.03)),
                ("stuffing", mesh.tetrahedralize(surface, 0.05, method="stuffing")),
            ):
                out[f"{name} {way}"] = [vars(made), vars(mesh.quality(made))]
    for kind in ("hex", "tet"):
        for name, sizes in (("sphere", [0.1]), ("cylinder", [0.1, 0.25]), ("torus", [0.2, 0.08])):
            made = getattr(mesh, f"{kind}_{name}")(*sizes, 0.06, center=(0.1, -0.2, 0.3))
            out[f"{kind} {name}"] = [made.x_rest, made.elements, vars(mesh.quality(made))]
    return out


def descents(folder: Path) -> dict[str, Any]:
    """Minimizers, from one start and from many."""
    from tests.optim.test_multi_start import BOUNDS, valleys

    found = optim.multi_start(valleys, BOUNDS, count=12, keep=3, seed=1)
    return {
        "starts": [(e.x, e.value) for e in found.starts],
        "descents": [[(i.x, i.value) for i in d.history] for d in found.descents],
        "best": [found.result.x, found.result.value, found.result.num_evaluations],
    }


def trainings(folder: Path) -> dict[str, Any]:
    """Rows of a training's table, of every method of this package."""
    from dataclasses import replace

    from diffsim.learn.methods import make_learner
    from diffsim.learn.run import read_rows, train
    from tests.learn.test_training import SMALL, TINY

    out = {}
    short = replace(TINY, steps=40, evaluate_every=20, warm_up=2)
    for method in ("gradient", "shac", "sapo", "mixed", "cma"):
        place = folder / method
        learner = make_learner(method, short, SMALL[method])
        train(short, learner, place, show=False)
        out[method] = [
            {k: v for k, v in row.items() if "seconds" not in k} for row in read_rows(place)
        ]
        if hasattr(learner, "critics"):
            with torch.no_grad():
                seen = noise(4, learner.task.num_observations, seed=5)
                out[f"{method} critics"] = [c(seen) for c in learner.critics.members]
    return out


def laws(folder: Path) -> dict[str, Any]:
    """Laws that nobody listed: all that were weighed, what was fitted, the formulas."""
    from tests.diagnose.discover import test_stage as stage
    from tests.diagnose.discover.turntable import turntable_study

    study = turntable_study(stage.cogging, uses=("fit",), noise=stage.NOISE, count=120)
    found = stage.fitted_laws(study)
    return {
        "screened": [(c.entry.words, c.variable.name, c.score, c.share) for c in found.screened],
        "fitted": [
            (f.nats, f.fit.nats, f.reach, f.curve.u, f.curve.values, f.curve.sd, f.by_run)
            for f in found.fitted
        ],
        "laws": found.laws,
        "price": [found.most_nats, found.num_tried],
    }


def shapes_found(folder: Path) -> dict[str, Any]:
    """Designs that co-design finds for two rotors' worth of wishes."""
    pytest.importorskip("cvxpy")
    pytest.importorskip("unopy")
    from diffsim.copter.codesign import SearchOptions, codesign
    from tests.copter.codesign.test_codesign import FOUR
    from tests.copter.codesign_designs import arm_copter

    out = {}
    for method in ("joint", "alternating"):
        found = codesign(
            arm_copter(FOUR), {"payload": 1.0, "mass": 5.0}, method,
            search=SearchOptions(num_starts=1),
        )  # fmt: skip
        out[method] = [found.s, found.spins, found.thrusts, found.objective, found.bound]
        out[f"{method} said"] = [found.metrics, found.attitude, found.feasible]
    return out


def pilots(folder: Path) -> dict[str, Any]:
    """Set points of missions and of sticks."""
    from diffsim.copter import simulator as flying

    out = {}
    for name in flying.shipped_missions():
        mission = flying.load_mission(name)
        times = np.linspace(0.0, mission.duration * 1.1, 12)
        out[name] = [mission.duration, [vars_of(mission.setpoint(t)) for t in times]]
    sticks = flying.load_sticks(flying.example_sticks())
    pilot = flying.StickPilot(sticks)
    out["sticks"] = [
        sticks.duration,
        [(vars_of(sticks.sticks(t)), vars_of(pilot.setpoint(t))) for t in np.linspace(0, 9, 19)],
    ]
    return out


def parts_of_copters(folder: Path) -> dict[str, Any]:
    """Every part of the database, of its usual sizes and with moved parameters."""
    from diffsim.copter.vehicle.parts import make_part
    from tests.copter.vehicle.test_parts import BUILT_IN, OPTIONS

    out = {}
    for kind in BUILT_IN:
        part = make_part(kind, OPTIONS.get(kind))
        out[kind] = [vars(part), part.feasible, part.mesh.vertices.at(1.1 * part.values)]
    return out


def fitted_rotors(folder: Path) -> dict[str, Any]:
    """Rotor models that tables give, and what they say over their range."""
    from diffsim.copter.vehicle.fit_rotor import fit_power, fit_rotor, write_rotor
    from tests.copter.vehicle.test_rotor import synthetic

    found, thrust = fit_rotor(synthetic(0.02)), np.linspace(0.1, 4.0, 9)
    speed = np.linspace(-50.0, 700.0, 9)
    path = write_rotor(found, folder)
    return {
        "fit": vars(found),
        "file": yaml.safe_load(path.read_text("utf-8")),
        "answers": [
            found.model.thrust(speed),
            found.model.speed(thrust),
            found.model.current(thrust),
            found.model.power(thrust),
            found.model.torque(thrust),
            found.model.current(thrust, 9.0),
            found.model.signal(thrust, 9.0),
            found.model.speed_at(found.model.signal(thrust), 9.0),
        ],
        "power": fit_power(thrust, 0.3 * thrust**1.7, offset=0.1),
    }


def extended_flights(folder: Path) -> dict[str, Any]:
    """A diagnosed vehicle with each cause that it may have."""
    from diffsim.systems.multicopter import ExtendedCopter
    from tests.systems import test_extended_copter as case

    vehicle = copter.load_design("quadcopter").multicopter()
    out = {}
    for name in CAUSES_OF_COPTERS:
        path = case.written(folder, {name: (0.1, 0.02)}, case.PARAMETERS)
        made = ExtendedCopter.read(path, vehicle)
        flown = made.fly(vehicle, case.begin(), case.thrusts(vehicle, 8), dt=0.02).state
        out[name] = vars(flown)
    return out


CAUSES_OF_COPTERS = ("weak_rotor_2", "body_drag")


def blind_estimators(folder: Path) -> dict[str, Any]:
    """Errors of an estimator that knows no drag."""
    from tests.systems import test_estimator as case

    rng = torch.Generator().manual_seed(1)
    velocity = torch.randn(1, 61, 3, generator=rng, dtype=torch.float64)
    force = torch.randn(1, 60, 3, generator=rng, dtype=torch.float64)
    force = force + torch.tensor([0.0, 0.0, -case.G])
    whole = case._follow_errors(
        velocity, force, torch.zeros(1, 2, 3, dtype=torch.float64), case.rates(), case.DT
    )
    blind = case.BlindEstimator(case.rates()[0], case.rates()[2], whole)
    windows = blind.in_windows(
        torch.tensor([20]), velocity[:, None, 20:], force[:, None, 20:], case.DT
    )
    return {"whole": whole, "windows": windows}


def own_causes(folder: Path) -> dict[str, Any]:
    """Causes of a user, through every port of small studies."""
    out = {}
    for name in ("ode_places", "soft_pulled", "rod_poses"):
        ready = Ready(study_of(name))
        rows = [
            {"name": f"own_{at}", "typical": 0.01, "at": at, **kinds.OWN[at]}
            for at in ("command", "reading")
        ]
        rows += [
            {"name": f"own_{way}", "typical": 0.01, "at": "number", way: number}
            for way, number in zip(("scale", "add"), ready.plant.numbers, strict=False)
        ]
        rows += [
            {"name": f"own_at_{place}", "typical": 0.01, "at": "force", "of": place}
            | kinds.OWN["force"]
            for place in ready.plant.places
        ]
        mine = ready.with_own(*rows)
        for row in rows:
            effect = mine.effects[row["name"]]
            found = mine.shown(mine.run, {effect: uniform(effect, SHARE)})
            out[f"{name} {effect.name}"] = [effect.unit, effect.typical, found - ready.plain[0]]
    return out


MEMORIES = {
    "warm": {"of": "u**2", "lasts": "0.3"},
    "late": {"of": "u", "lasts": "tau", "start": "zero"},
}
OWN_FORMULAS: tuple[dict[str, Any], ...] = (
    {"at": "command", "map": "u*(1 + size*warm)", "memories": {"warm": MEMORIES["warm"]}},
    {
        "at": "reading",
        "map": "u + size*late*run_order",
        "memories": {"late": MEMORIES["late"]},
        "shapes": {"tau": {"value": 0.2, "sd": 0.1, "unit": "s"}},
    },
    {"at": "reading", "map": "u + size*t*mean_of_force"},
)


def own_formulas(folder: Path) -> dict[str, Any]:
    """Causes of a user that remember, and that look at more than their own signal."""
    from tests.systems.toy_cart import cart_study

    ready, out = Ready(cart_study()), {}
    for k, row in enumerate(OWN_FORMULAS):
        name = f"own_{k}"
        mine = ready.with_own({"name": name, "typical": 0.1, **row})
        effect = mine.effects[name]
        size = uniform(effect, 1.0)
        out[name] = [mine.shown(run, {effect: size}) for run in mine.cut.runs]
    return out


def laws_as_causes(folder: Path) -> dict[str, Any]:
    """What laws change, wherever they enter, in every form of dependence."""
    from dataclasses import replace as changed

    from tests.systems.ode import test_law_port as laws

    study = laws.turntable_study(laws.thinner_when_warm, uses=("fit",), count=60)
    setup, out = laws.setup_of(study), {}
    angle = next(v for v in setup.laws.variables() if v.name == "angle")
    for entry in setup.laws.entries:
        for variable in (laws.WARM, angle, laws.WARM.with_factor(angle)):
            law = changed(laws.FALLS, entry=entry, variable=variable)
            made = laws.with_law(setup, law)
            effect = next(e for e in made.effects if e.name == law.name)
            with torch.no_grad():
                size = torch.full((len(effect.components),), 0.1, dtype=torch.float64)
                seen = made.model.predict(study.runs[0], made.model.at_prior(), {effect: size})
            out[f"{entry.words} {variable.name}"] = [effect.typical, effect.unit, seen]
    return out


def answers(folder: Path) -> dict[str, Any]:
    """Whole answers about a model of known matrices."""
    from tests.diagnose.say import test_causes as lines

    push, other, double = lines.PUSH, lines.OTHER, lines.DOUBLE
    asked: dict[str, Any] = {
        "none": ({}, (push, other)),
        "certain": ({push: 1.0}, (push, other)),
        "weak": ({push: 0.3}, (push, other)),
        "shared": ({push: 1.0, other: 0.8}, (push, other, double)),
        "unknown": ({push: 2.0}, (other,)),
        "few": ({push: 3.0}, (push,), 1, 0),
        "off": ({push: 1.0}, (push,), 4, 1, (4.0, -3.0)),
    }
    out = {}
    for name, (sizes, effects, *more) in asked.items():
        options = {"base": more.pop()} if len(more) == 3 else {}
        found = lines.diagnosed(sizes, effects, *more, **options)
        said = [found.headline, *found.sentences, *found.cannot_see.values()]
        out[name] = [found.verdict, found.named, found.causes, found.rivals, found.hypotheses]
        out[f"{name} table"] = [found.table, found.errors, found.base, found.outside, found.own]
        out[f"{name} said"] = [len(said), *map(numbers_in, said)]
        gain = [found.gain, found.unknown_share, found.interval_factor, found.band, found.bands]
        out[f"{name} gain"] = gain
    return out


def waypoints(folder: Path) -> dict[str, Any]:
    """A design for waypoints: flights, loss and slope, the airframe."""
    from tests.copter.test_airframe import SHORT, moved

    x = moved(SHORT)
    flown = SHORT.fly(torch.from_numpy(x))
    return {
        "flight": [flown.state.position, SHORT.distances(flown)],
        "loss": SHORT.value_and_gradient(x),
        "design": [SHORT.bounds, SHORT.smallest_gap(x), SHORT.weights(x), SHORT.random_start(1)],
    }


def meshes_in_files(folder: Path) -> dict[str, Any]:
    """Meshes that are written and read back in every format."""
    from diffsim.mesh.files import SURFACE_FORMATS, VOLUME_FORMATS

    out = {}
    for name, made in (("hex", mesh.hex_sphere(0.1, 0.05)), ("tet", mesh.tet_box((2, 3, 1)))):
        for suffix in VOLUME_FORMATS:
            back = mesh.load(mesh.save(made, folder / f"{name}{suffix}"), scale=0.5)
            out[f"{name}{suffix}"] = [back.elements, back.x_rest]
        for suffix in SURFACE_FORMATS:
            back = mesh.load_surface(mesh.save(made, folder / f"{name}{suffix}"))
            out[f"{name} surface{suffix}"] = [back.vertices, back.faces]
    return out


def event_shapes(folder: Path) -> dict[str, Any]:
    """What acts for a limited time, and where it is found in a course."""
    from diffsim.identify.locate import Course
    from diffsim.systems.ode.event_forms import TIMINGS, placed, shape_of
    from tests.systems.test_ode_events import TRUE

    times, out = np.arange(0.0, 20.0, 0.1), {}
    for form in TIMINGS:
        timing = {k: torch.tensor(TRUE[k]) for k in TIMINGS[form]}
        shape = shape_of(form, torch.from_numpy(times), timing, 0.1)
        force = 3.0 * shape.numpy() + 0.05 * np.cos(7.0 * times)
        course = Course(times, 400.0 * np.eye(len(times)), 20.0 * force)
        out[form] = [shape, placed(form, course, 1.0)]
    return out


def thinned_records(folder: Path) -> dict[str, Any]:
    """Long records without the rows that lines tell."""
    from tests.systems.ode import test_thinning as long

    study = long.study_of(long.run_of("a", long.SLOW), long.run_of("bb", long.JUMPS))
    interval = long.interval_of(study, 800)
    out: dict[str, Any] = {"interval": interval}
    for held in (False, True):
        found = long.thinned(study, interval, held)
        out[f"held {held}"] = [(r.time_s, r.measured, r.command) for r in found.runs]
    return out


def signed_distances(folder: Path) -> dict[str, Any]:
    """Distances from every solid, and from what is made of them."""
    from diffsim.mesh import sdf

    points = 0.4 * noise(40, 3, seed=4)
    ball, block = sdf.sphere(0.3, (0.1, 0.0, 0.0)), sdf.box((0.5, 0.4, 0.3), (0.0, 0.1, 0.0))
    shapes = {
        "sphere": ball,
        "box": block,
        "cylinder": sdf.cylinder(0.2, 0.5, (0.0, 0.1, 0.2)),
        "capsule": sdf.capsule((0.0, 0.0, -0.2), (0.2, 0.1, 0.3), 0.15),
        "torus": sdf.torus(0.3, 0.1, (0.0, 0.0, 0.1)),
        "plane": sdf.plane((0.2, 0.3, 1.0), 0.1),
        "ellipsoid": sdf.ellipsoid((0.4, 0.3, 0.2), (0.1, 0.0, 0.0)),
        "union": sdf.union(ball, block),
        "smooth": sdf.smooth_union(ball, block, 0.1),
        "both": sdf.intersection(ball, block),
        "cut": sdf.difference(block, ball),
        "moved": sdf.rotate(sdf.translate(block, (0.1, 0.2, 0.0)), (0.0, 0.3, 1.0), 0.4),
        "shell": sdf.shell(sdf.offset(ball, 0.05), 0.02),
    }
    return {name: shape(points) for name, shape in shapes.items()}


def chambers(folder: Path) -> dict[str, Any]:
    """Volumes and forces of hollow bodies."""
    from tests.soft.test_chambers import SHAPES, hollow

    out = {}
    for kind in ("hex", "tet"):
        for shape in SHAPES:
            made, chamber = hollow(kind, shape)
            x = deformed(made, 0.1)
            volume = chamber.volume(x)
            out[f"{kind} {shape}"] = [chamber.faces, volume, rows(chamber)]
    return out


def solid_bodies(folder: Path) -> dict[str, Any]:
    """Energy and forces of every material in every element."""
    from tests.soft.cases import irregular_mesh, soft_body

    out = {}
    for kind in ("hex", "tet", "assumed_strain", "quadratic"):
        made = irregular_mesh(kind, (2, 1, 1))
        element = {"element": kind} if "_" in kind or kind == "quadratic" else {}
        for material in soft.MATERIALS:
            body = soft_body(made, material=material, **element)
            x = deformed(made, 0.1)
            out[f"{kind} {material}"] = [body.elastic_energy(x), body.elastic_force(x)]
    return out


def pictures(folder: Path) -> dict[str, Any]:
    """What environments draw: lines, surfaces, points and what the camera sees."""
    pytest.importorskip("matplotlib", reason="pictures need the extra 'viz'")
    from diffsim.envs import pictures as drawing
    from tests.envs.cases import OPTIONS

    out = {}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(drawing, "_pixels", lambda figure: figure)
        for name in ("CopterTrack", "QuadrupedWalk", "TendonReach"):
            task = envs.make_task(name, **OPTIONS[name])
            figure = task.picture(task.start(2, np.random.default_rng(0)), 1)
            (axes,) = figure.axes
            out[name] = [
                [axes.get_xlim(), axes.get_ylim(), axes.get_zlim(), axes.elev, axes.azim],
                [line.get_data_3d() for line in axes.lines],
                [(vars(c).get("_vec"), c.get_facecolor()) for c in axes.collections],
                [np.ma.getdata(p) for c in axes.collections for p in vars(c).get("_offsets3d", ())],
            ]
    return out


def beams(folder: Path) -> dict[str, Any]:
    """Beams that swing free, are pulled, or hang a weight on a string: slopes by every cause."""
    from tests.systems import test_soft_body_tangents as case
    from tests.systems.soft_body.causes import CAUSES
    from tests.systems.test_soft_body import held_beam, held_run

    hung = [CAUSES["slack_string"], CAUSES["weight"]]
    problems = {
        "free": case.problem_of(case.beam(), case.FREE, *case.AIR),
        "pulled": case.problem_of(case.tendon(), case.PULLED, *case.SMOOTH[:6]),
        "hung": case.problem_of(held_beam(), held_run(0.006), *hung),
    }
    out = {}
    for name, problem in problems.items():
        x = np.full(len(problem.names), 0.1)
        out[name] = [problem.linearize(x), problem.records(np.stack([x, 2.0 * x]))]
        out[f"{name} slope"] = problem.gradient(x)
    return out


def outside_machines(folder: Path) -> dict[str, Any]:
    """An environment that is stepped, and rates that a function of Python writes."""
    from diffsim.identify import Parameter
    from diffsim.systems.ode.traced import formulas_of
    from diffsim.systems.outside import Environment, outside_setup
    from tests.systems import test_traced as traced
    from tests.systems.outside import test_outside as case

    study = case.cart_study()
    start = [Parameter("state[0]", 0.3, 0.1), Parameter("state[1]", 1.0, 0.1)]
    numbers = [*start, Parameter("mass", 2.0, 0.1), Parameter("damping", 0.3, 0.1)]
    out: dict[str, Any] = {}
    for held in (True, False):
        environment = Environment(observation=(0,))
        setup = outside_setup(study, case.Cart(), numbers, environment=environment, held=held)
        out[f"held {held}"] = setup.model.predict(study.runs[0], setup.model.at_prior())
    out["traced"] = formulas_of(traced.everyday, "f")
    out["values"] = [traced.values_of(traced.everyday, a=a, b=0.4) for a in (0.7, -1.2, 3.0)]
    return out


def batches(folder: Path) -> dict[str, Any]:
    """Members of native batches, one of which is lost, over the ends of episodes."""
    from tests.envs import test_vector_standard as many

    out = {}
    for mode in ("NextStep", "SameStep"):
        env = many.native(mode)
        out[f"{mode} reset"] = env.reset(seed=many.SEEDS)[0]
        for k, row in enumerate(many.actions(8)):
            if k == 2:
                env.unwrapped.state["position"][1] += 100.0
            out[f"{mode} {k}"] = env.step(row)[:4]
    return out


CASES: dict[str, Callable[[Path], Mapping[str, Any]]] = {
    "vehicles": vehicles,
    "mjcf": numbers_of_mjcf,
    "codesign": designs_on_paper,
    "soft tasks": described_tasks,
    "solids": solids,
    "optim": descents,
    "learn": trainings,
    "laws": laws,
    "shapes": shapes_found,
    "pilots": pilots,
    "parts": parts_of_copters,
    "rotors": fitted_rotors,
    "extended copter": extended_flights,
    "estimator": blind_estimators,
    "own causes": own_causes,
    "own formulas": own_formulas,
    "laws as causes": laws_as_causes,
    "answers": answers,
    "waypoints": waypoints,
    "meshes": meshes_in_files,
    "events": event_shapes,
    "thinning": thinned_records,
    "distances": signed_distances,
    "chambers": chambers,
    "materials": solid_bodies,
    "batches": batches,
    "pictures": pictures,
    "beams": beams,
    "outside": outside_machines,
}
