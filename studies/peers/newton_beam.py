"""The beam by Newton: its implicit VBD solver, or its explicit one, with Warp's tape over all steps."""

import sys

import newton
import scene
import warp as wp

wp.config.quiet = True
SUBSTEPS = {"vbd": 1, "semi_implicit": 100}


@wp.kernel
def mean_fall(x: wp.array[wp.vec3], end: wp.array[int], rest: float, down: wp.array[float]):
    """Add each node's share of the mean fall of the free end."""
    i = wp.tid()
    wp.atomic_add(down, 0, -x[end[i]][1] / float(end.shape[0]))


def fall(youngs_modulus: float) -> tuple[float, float]:
    """The beam's fall [m] after all steps, and its derivative by log E [m]."""
    name = sys.argv[1]
    nu = scene.POISSONS_RATIO
    mu = youngs_modulus / (2 * (1 + nu))
    builder = newton.ModelBuilder(up_axis="Y", gravity=(0.0, -scene.GRAVITY, 0.0))
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*x) for x in scene.nodes()],
        indices=scene.tetrahedra().ravel().tolist(),
        density=scene.DENSITY,
        k_mu=mu,
        k_lambda=2 * mu * nu / (1 - 2 * nu),
        k_damp=0.0,
        tri_ke=0.0,
        tri_ka=0.0,
        tri_kd=0.0,
        edge_ke=0.0,
        edge_kd=0.0,
    )
    for i in scene.clamped():
        builder.particle_mass[i] = 0.0
        builder.particle_flags[i] = builder.particle_flags[i] & ~newton.ParticleFlags.ACTIVE
    builder.color()
    model = builder.finalize(device="cpu", requires_grad=True)
    solver = (
        newton.solvers.SolverVBD(model, iterations=200)
        if name == "vbd"
        else newton.solvers.SolverSemiImplicit(model)
    )
    steps = scene.STEPS * SUBSTEPS[name]
    states = [model.state() for _ in range(steps + 1)]
    rest = states[0].particle_q.numpy()[scene.free_end(), 1].mean()
    down = wp.zeros(1, dtype=float, requires_grad=True, device="cpu")
    end = wp.array(scene.free_end(), dtype=int, device="cpu")
    with wp.Tape() as tape:
        for now, then in zip(states, states[1:]):
            now.clear_forces()
            solver.step(now, then, model.control(), None, scene.STEP / SUBSTEPS[name])
        wp.launch(
            mean_fall,
            dim=len(end),
            inputs=[states[-1].particle_q, end, float(rest)],
            outputs=[down],
            device="cpu",
        )
    tape.backward(down)
    gradient = model.tet_materials.grad.numpy()[:, :2] * model.tet_materials.numpy()[:, :2]
    return float(down.numpy()[0] + rest), float(gradient.sum())


scene.answer(newton.__version__, fall)
