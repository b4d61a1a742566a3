"""Reference results of the simulators: soft bodies, contact, meshes, Stokes flow, environments."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.reference_values import gradients, leaf, weighted_sum

F64 = torch.float64


def _of_pass(run: Any) -> dict[str, Any]:
    """Loss, gradient and effort of a ``benchmarks.soft_scenes.Pass``."""
    return {
        "loss": run.loss,
        "gradient": run.grad,
        "converged": run.converged,
        "step_iterations": [int(s.num_iters.sum()) for s in run.steps],
        "adjoint_iterations": [int(s.num_iters.sum()) for s in run.adjoints],
    }


def cantilever() -> Mapping[str, Any]:
    """The thesis's cantilever of 8,019 degrees of freedom, few steps, by every solver."""
    from benchmarks import soft_scenes
    from diffsim import soft

    found = {}
    for method, num_steps in (
        ("auto", 4),
        ("quasi_newton", 2),
        ("newton_pcg", 2),
        ("newton_jacobi", 2),
        ("newton_cholesky", 2),
    ):
        body = soft_scenes.cantilever(
            solver=soft.SolverOptions(method=method, rtol=1e-6, num_threads=1)
        )
        found[method] = _of_pass(soft_scenes.one_pass(body, num_steps))
    return found


def rolling_ball() -> Mapping[str, Any]:
    """The thesis's rolling sphere, few steps: rolling, sliding with friction, by two solvers."""
    from benchmarks.contact_scenes import rolling_pass, rolling_sphere, solver

    found = {}
    for name, variant, friction, slide, num_steps in (
        ("rolling", "auto", math.inf, False, 8),
        ("sliding", "auto", 0.3, True, 8),
        ("cholesky", "newton_cholesky", 0.3, True, 3),
    ):
        body = rolling_sphere(0.011)
        body.solver = solver(variant, 1e-6)
        found[name] = _of_pass(rolling_pass(body, num_steps, friction, slide=slide))
    return found


def napkin() -> Mapping[str, Any]:
    """A napkin that falls on a ball with friction: many nodes come into contact."""
    from benchmarks import contact_scenes
    from benchmarks.soft_scenes import weighted_loss
    from diffsim import contact, soft

    body = contact_scenes.napkin(10, 1.0, contact_scenes.solver("auto", 1e-6))
    friction, start = leaf(0.3), contact_scenes.falling(body)
    x, v = leaf(start.x), leaf(start.v)
    obstacle = contact.sphere(contact_scenes.OBSTACLE_RADIUS, friction=friction)
    with soft.record_stats() as solves:
        end = soft.rollout(body, soft.State(x, v), 12, obstacles=obstacle).final
    contacts = [int(s.num_contacts.sum()) for s in solves]
    return {"contacts": contacts, **gradients(weighted_loss(end), x=x, v=v, friction=friction)}


def body_contact() -> Mapping[str, Any]:
    """Penalty forces of one soft ball on another, and of balls through their centers."""
    from diffsim import contact, mesh

    lower, upper = mesh.tet_sphere(0.05, 0.02), mesh.tet_sphere(0.05, 0.02, (0.01, 0.0, 0.092))
    law = contact.BodyContact(lower, upper, stiffness=1e6, damping=0.1, friction=0.4)
    x_a, x_b = leaf(lower.x_rest), leaf(upper.x_rest)
    v_a, v_b = leaf(torch.zeros_like(x_a)), leaf(0.3 * x_b.detach().roll(1, -1))
    on_a, on_b = law(x_a, v_a, x_b, v_b)
    balls = torch.stack([torch.arange(4), torch.arange(4, 8)])
    x, v = leaf(upper.x_rest[:8]), leaf(0.1 * upper.x_rest[:8].roll(1, -1))
    centers = contact.ball_force(x, v, balls, radius=0.05, stiffness=300.0, friction=0.2)
    return {
        "on_a": on_a,
        "on_b": on_b,
        **gradients(weighted_sum(on_a, on_b), x_a=x_a, v_a=v_a, x_b=x_b, v_b=v_b),
        "centers": gradients(weighted_sum(centers), x=x),
    }


def distances() -> Mapping[str, Any]:
    """Signed distances of all families, with normals, and what contact detection makes of them."""
    from diffsim import contact, mesh
    from diffsim.stokes import shapes

    points = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3)) * (0.9, 0.7, 0.9)
    x = torch.from_numpy(points)
    block = mesh.to_trimesh(mesh.tet_box((2, 2, 2), (1.0, 1.2, 0.9)))
    grid = torch.linspace(-1.2, 1.2, 25, dtype=F64)
    heights = 0.1 * torch.sin(3.0 * grid[:, None]) * torch.cos(2.0 * grid)
    solids = {
        "plane": contact.Plane((0.2, -0.3, 2.0), 0.1),
        "sphere": contact.Sphere(0.7),
        "capsule": contact.Capsule((-0.4, 0.1, 0.0), (0.5, 0.2, 0.3), 0.4),
        "box": contact.Box((0.9, 1.1, 1.3)),
        "height_field": contact.HeightField(heights, 0.1, origin=(-1.2, -1.2, 0.0)),
        "mesh": contact.MeshShape(block),
        "custom": contact.Custom(mesh.sdf.torus(0.6, 0.3)),
    }
    found: dict[str, Any] = {"contact": {}, "mesh": {}, "stokes": {}}
    for name, solid in solids.items():
        at = leaf(x)
        distance, normal = solid.distance_normal(at)
        (slope,) = torch.autograd.grad(weighted_sum(distance, normal), at)
        found["contact"][name] = {"distance": distance, "normal": normal, "slope": slope}
    found["mesh"]["surface"] = mesh.SurfaceDistance(block)(points)
    found["mesh"]["functions"] = torch.stack([f(x) for f in _distance_functions()])
    for name, shape in (
        ("sphere", shapes.Sphere(0.6, (0.1, 0.2, 0.0), fluid="inside")),
        ("box", shapes.Box((1.0, 0.8, 0.9), (0.0, 0.1, 0.2), fluid="inside")),
        ("plane", shapes.Plane((0.2, -0.3, 2.0), 0.1)),
    ):
        found["stokes"][name] = shape(x)
    planes = contact.detect([contact.sphere(0.5, friction=0.3)], x, x * 0.9, 0.01)
    found["detect"] = {"normal": planes.normal, "offset": planes.offset, "at": planes.reference}
    return found


def _distance_functions() -> list[Callable[[Tensor], Tensor]]:
    from diffsim.mesh import sdf

    ball, block = sdf.sphere(0.6, (0.1, 0.0, 0.0)), sdf.box((0.9, 0.8, 0.7))
    return [
        ball,
        block,
        sdf.cylinder(0.4, 0.9),
        sdf.capsule((0.0, 0.0, -0.4), (0.1, 0.2, 0.5), 0.3),
        sdf.torus(0.6, 0.2),
        sdf.ellipsoid((0.5, 0.7, 0.9)),
        sdf.union(ball, block),
        sdf.intersection(ball, block),
        sdf.difference(block, ball),
        sdf.smooth_union(ball, block, 0.2),
        sdf.rotate(block, (1.0, 2.0, 3.0), 0.7),
        sdf.shell(ball, 0.1),
    ]


def meshes() -> Mapping[str, Any]:
    """Nodes and elements of meshes made in every way, and their measures."""
    from diffsim import mesh

    ring = mesh.sdf.torus(0.06, 0.02)
    bounds = ((-0.09, -0.09, -0.03), (0.09, 0.09, 0.03))
    surface = mesh.to_trimesh(mesh.tet_sphere(0.05, 0.015))
    made: dict[str, mesh.HexMesh | mesh.TetMesh] = {
        "hex_box": mesh.hex_box((3, 2, 2), (0.3, 0.2, 0.1)),
        "tet_box": mesh.tet_box((3, 2, 2), (0.3, 0.2, 0.1)),
        "hex_sphere": mesh.hex_sphere(0.05, 0.011),
        "tet_torus": mesh.tet_torus(0.06, 0.02, 0.012),
        "hex_from_sdf": mesh.hex_from_sdf(ring, bounds, 0.008),
        "tet_from_sdf": mesh.tet_from_sdf(ring, bounds, 0.012),
        "voxelize": mesh.voxelize(surface, 0.008),
        "stuffing": mesh.tetrahedralize(surface, 0.012, method="stuffing"),
    }
    return {
        name: {
            "x": m.x_rest,
            "elements": m.elements,
            "volumes": mesh.element_volumes(m),
            "gradients": mesh.shape_gradients(m).grad,
            "surface": mesh.surface_triangles(m).faces,
        }
        for name, m in made.items()
    }


def _muscled(material: str, integrator: str = "implicit_euler") -> Any:
    """A clamped bar of tetrahedra with a muscle of two kinds, and damping."""
    from diffsim import mesh, soft

    box = mesh.tet_box((5, 2, 2), (0.1, 0.03, 0.03))
    top = torch.nonzero(box.x_rest[box.elements].mean(1)[:, 2] > 0.015).flatten()
    below = torch.nonzero(box.x_rest[box.elements].mean(1)[:, 2] < 0.015).flatten()
    return soft.SoftBody(
        box,
        dt=5e-3,
        youngs_modulus=2.6e5,
        poissons_ratio=0.45,
        density=1070.0,
        material=material,
        integrator=integrator,
        damping=soft.Damping(rayleigh_beta=1e-3),
        fixed=box.nodes_near_plane("x", 0.0),
        muscles=[
            soft.Muscle(elements=top, direction=(1.0, 0.0, 0.1), stiffness=1e5),
            soft.Muscle(elements=below, direction=(1.0, 0.2, 0.0), stiffness=8e4, kind="tendon"),
        ],
        solver=soft.SolverOptions(rtol=1e-8, num_threads=1),
    )


def _parameters(body: Any) -> tuple[dict[str, Tensor], Any]:
    """Leaves of the material, the muscles and gravity, and the physics made of them."""
    leaves = {
        "youngs_modulus": leaf(2.6e5),
        "poissons_ratio": leaf(0.45),
        "density": leaf(1070.0),
        "gravity": leaf((0.3, -0.2, -9.7)),
        "fiber_stiffness": leaf((1e5, 8e4)),
    }
    return leaves, body.physics(**leaves)


def statics() -> Mapping[str, Any]:
    """Rest under gravity, muscles and a force, in every material, with all gradients."""
    from diffsim import soft

    found = {}
    for material in soft.MATERIALS:
        body = _muscled(material)
        leaves, physics = _parameters(body)
        activation, force = leaf((0.9, 0.95)), leaf(torch.zeros_like(body.x_rest))
        x = body.static_equilibrium(activation=activation, external_force=force, physics=physics).x
        found[material] = {
            "x": x,
            **gradients(weighted_sum(x), activation=activation, force=force, **leaves),
        }
    return found


def soft_rollout() -> Mapping[str, Any]:
    """Motion with muscles, gravity and damping: materials, integrators, tangents, pressure."""
    from diffsim import mesh, soft

    found: dict[str, Any] = {}
    cases = [(m, "implicit_euler") for m in soft.MATERIALS]
    cases += [(soft.MATERIALS[-1], name) for name in ("bdf2", "implicit_midpoint")]
    for material, integrator in cases:
        body = _muscled(material, integrator)
        leaves, physics = _parameters(body)
        activation = leaf((0.9, 0.95))
        x, v = leaf(body.x_rest), leaf(torch.zeros_like(body.x_rest))
        run = soft.rollout(
            body, soft.State(x, v), 12, activation=activation, physics=physics, checkpoint_every=5
        )
        found[f"{material}/{integrator}"] = gradients(
            weighted_sum(run.x, run.v), x=x, v=v, activation=activation, **leaves
        )
    body = _muscled(soft.MATERIALS[-1], "bdf2")
    moving = soft.Directions(v=body.x_rest.expand(1, -1, -1).roll(1, -1).contiguous())
    swept = soft.rollout_tangents(body, body.rest_state(), 6, 1, moving)
    found["tangent"] = {"x": swept.x, "tangent": swept.tangent}
    shell = mesh.hex_from_sdf(
        mesh.sdf.shell(mesh.sdf.box((0.05, 0.05, 0.05)), 0.02),
        ((-0.045,) * 3, (0.045,) * 3),
        0.01,
    )
    balloon = soft.SoftBody(
        shell,
        dt=5e-3,
        youngs_modulus=2e5,
        poissons_ratio=0.4,
        chambers=[soft.PressureChamber.from_cavity(shell)],
        solver=soft.SolverOptions(rtol=1e-8, num_threads=1),
    )
    pressure = leaf((2e3,))
    end = soft.rollout(balloon, balloon.rest_state(), 6, pressure=pressure).final
    found["pressure"] = gradients(weighted_sum(end.x, end.v), pressure=pressure)
    return found


def swimming() -> Mapping[str, Any]:
    """A soft block in water: drag, thrust and added mass, with gradients."""
    from diffsim import mesh, soft

    block = mesh.hex_box((4, 2, 1), (0.2, 0.1, 0.03))
    body = soft.SoftBody(
        block,
        dt=5e-3,
        youngs_modulus=1e5,
        poissons_ratio=0.4,
        gravity=(0.0, 0.0, 0.0),
        masses=soft.Masses(added_mass=soft.added_mass(block, 0.5, 1e3)),
        solver=soft.SolverOptions(rtol=1e-8, num_threads=1),
    )
    drag = leaf((0.1, 0.2, 1.8, 2.0))
    water = soft.Hydrodynamics(block, drag_coefficients=drag)
    x, v = leaf(body.x_rest), leaf(0.3 * body.x_rest.roll(1, -1))
    state, total = soft.State(x, v), torch.zeros((), dtype=F64)
    for _ in range(5):
        force = water(state.x, state.v)
        state = soft.step(body, state, external_force=force)
        total = total + weighted_sum(force)
    return gradients(total + weighted_sum(state.x, state.v), x=x, v=v, drag=drag)


def stokes_devices() -> Mapping[str, Any]:
    """Loss and gradient of the six devices: the amplifier on the thesis's grid, all coarse."""
    from diffsim.stokes import devices

    found = {}
    for name, resolution, options in (
        ("amplifier", 1.0, {}),
        *((name, 0.25, {}) for name in devices.DEVICES),
        ("averager", 0.5, {}),
        ("twister", 0.25, {"wall": "no_slip"}),
    ):
        device = devices.make(name, resolution, **options)
        device.flow.num_threads = 1
        middle = 0.5 * (device.lower + device.upper)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="the shape is thinner than a cell")
            loss, gradient = device.value_and_gradient(middle)
        label = "/".join([f"{name}_{resolution:g}", *options.values()])
        found[label] = {"loss": loss, "gradient": gradient, "level_set": device.level_set(middle)}
    return found


def _of_flow(flow: Any, level: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Velocity and pressure in a pipe, and gradients of the velocity's square."""
    radius, inlet = leaf(0.2), leaf((1.0, 0.0, 0.0))
    field = flow(level(radius), inlet)
    return {
        "velocity": field.velocity,
        "pressure": field.pressure,
        **gradients(field.velocity.square().sum(), radius=radius, inlet=inlet),
    }


def stokes_thesis() -> Mapping[str, Any]:
    """A bent pipe in the thesis's published formulation."""
    from benchmarks.stokes_worker import bent_pipe
    from benchmarks.thesis_stokes import ThesisFlow
    from diffsim.stokes import Inlet, Open

    grid, level = bent_pipe(12)
    return _of_flow(ThesisFlow(grid, [Inlet("x-"), Open("x+")]), level)


def stokes_flow() -> Mapping[str, Any]:
    """A bent pipe by every solver, and the cells that its wall cuts."""
    from benchmarks.stokes_worker import bent_pipe
    from diffsim.stokes import Inlet, Open, SolverOptions, StokesFlow, cut_cells

    grid, level = bent_pipe(12)
    cases: dict[str, dict[str, Any]] = {
        "direct": {"solver": SolverOptions(method="direct")},
        "iterative": {"solver": SolverOptions(method="iterative")},
        "incompressible": {"incompressible": True},
        "no_separation": {"wall": "no_separation"},
    }
    found: dict[str, Any] = {}
    for name, options in cases.items():
        flow = StokesFlow(grid, [Inlet("x-"), Open("x+")], **options)
        found[name] = _of_flow(flow, level)
    found["cut_cells"] = cut_cells(grid, level(torch.tensor(0.2, dtype=F64)))._asdict()
    return found


def stokes_export() -> Mapping[str, Any]:
    """Streamlines of a bent pipe, and the closed surface of its walls."""
    from benchmarks.stokes_worker import bent_pipe
    from diffsim.stokes import Inlet, Open, StokesFlow
    from diffsim.stokes.isosurface import negative_part
    from diffsim.stokes.streamlines import streamlines

    grid, level = bent_pipe(12)
    phi = level(torch.tensor(0.2, dtype=F64))
    flow = StokesFlow(grid, [Inlet("x-"), Open("x+")])
    lines = streamlines(flow(phi, torch.tensor([1.0, 0.0, 0.0], dtype=F64)), 6)
    axes = [np.linspace(0.0, size, n) for size, n in zip((1.0, 1.0, 0.5), phi.shape, strict=True)]
    vertices, triangles = negative_part(axes, phi.numpy())
    return {
        "ends": [line.end for line in lines],
        "points": np.concatenate([line.points for line in lines]),
        "times": np.concatenate([line.time for line in lines]),
        "vertices": vertices,
        "triangles": triangles,
    }


OPTIONS: dict[str, dict[str, Any]] = {
    "CopterHover": {"seconds": 0.2},
    "CopterTrack": {"seconds": 0.2},
    "StarfishSwim": {"robot": {"coarse": True}, "num_steps": 6},
    "SharkSwim": {"robot": {"coarse": True}, "num_steps": 6},
    "QuadrupedWalk": {"robot": {"coarse": True}, "num_steps": 6},
    "CowWalk": {"robot": {"coarse": True}, "num_steps": 6, "substeps": 2},
    "TorusRoll": {"robot": {"coarse": True}, "num_steps": 6, "substeps": 2},
    "TendonReach": {"robot": {"coarse": True}, "num_steps": 6},
}


def environments() -> Mapping[str, Any]:
    """A few steps of every environment, coarse, and the gradient of two members' rewards."""
    from diffsim.envs import make_task, make_vector

    found = {}
    for name, options in OPTIONS.items():
        vector = make_vector(name, 2, sensor_noise=0.01, **options)
        observation, _ = vector.reset(seed=0)
        rng, seen, rewards = np.random.default_rng(0), [observation], []
        for _ in range(6):
            action = rng.uniform(-1.0, 1.0, vector.action_space.shape).astype(np.float32)
            observation, reward, *_ = vector.step(action)
            seen.append(observation)
            rewards.append(reward)
        task = make_task(name, **options)
        state = task.start(2, np.random.default_rng(1))
        commands = leaf(rng.uniform(-0.5, 0.5, (4, 2, task.num_actions)))
        total = torch.zeros((), dtype=F64)
        for command in commands:
            state, earned = task.step(state, command)
            total = total + earned.sum()
        found[name] = {
            "observations": np.stack(seen),
            "rewards": np.stack(rewards),
            **gradients(total, commands=commands),
        }
    return found


ITEMS = {
    f.__name__: f
    for f in (
        cantilever,
        rolling_ball,
        napkin,
        body_contact,
        distances,
        meshes,
        statics,
        soft_rollout,
        swimming,
        stokes_devices,
        stokes_flow,
        stokes_thesis,
        stokes_export,
        environments,
    )
}
