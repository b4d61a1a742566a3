"""Reference vectors of ../shared/data/soft_reference: another code's Newton-Cholesky answers."""

import numpy as np
import pytest
import torch

from diffsim import mesh, soft
from tests.measured import data_folder

pytestmark = pytest.mark.reference

# The vectors agree between two independent implementations to 1e-9; the solver below stops at
# 1e-12 of the force scale.
SOLVER = soft.SolverOptions(method="newton_cholesky", rtol=1e-12, adjoint_rtol=1e-12)


def load(name):
    return {
        k: torch.from_numpy(v)
        for k, v in np.load(data_folder("soft_reference") / f"{name}.npz").items()
        if v.dtype.kind != "U"
    }


def close(actual, expected, tol=1e-9):
    """Relative to the largest entry, since single entries can be arbitrarily small."""
    expected = torch.as_tensor(expected, dtype=torch.float64).reshape(actual.shape)
    assert (actual - expected).abs().max() <= tol * expected.abs().max()


def make_mesh(kind, d, elements="elements"):
    if kind == "hex":
        return mesh.HexMesh(d["X"], d[elements])
    # The vectors' tets are left-handed by halves; energies do not depend on the node order.
    return mesh.TetMesh(*mesh.flip_inverted(d["X"], d[elements]))


def reference_mass(m, d):
    """The published code's lumped mass: every node gets density times mean element volume."""
    volume = float(d["dx"]) ** 3 / (1 if m.kind == "hex" else 6)
    return torch.full((m.num_nodes,), float(d["rho"]) * volume, dtype=torch.float64)


@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("num_steps", [1, 5, 25])
def test_cantilever_states_and_gradients(kind, num_steps):
    d = load(f"{kind}_cantilever_plain")
    m = make_mesh(kind, d)
    body = soft.SoftBody(
        m,
        dt=float(d["h"]),
        youngs_modulus=float(d["E"]),
        poissons_ratio=float(d["nu"]),
        masses=soft.Masses(node_mass=reference_mass(m, d)),
        fixed=d["fixed_nodes"],
        material=soft.Material(volume_weight="thesis"),
        solver=SOLVER,
    )
    youngs_modulus = torch.tensor(float(d["E"]), dtype=torch.float64, requires_grad=True)
    poissons_ratio = torch.tensor(float(d["nu"]), dtype=torch.float64, requires_grad=True)
    gravity = d["gravity"].clone().requires_grad_()
    physics = body.physics(
        youngs_modulus=youngs_modulus, poissons_ratio=poissons_ratio, gravity=gravity
    )
    x0 = d["q0"].reshape(-1, 3).clone().requires_grad_()
    v0 = d["v0"].reshape(-1, 3).clone().requires_grad_()
    forces = d["f_ext"].reshape(-1, 3).repeat(num_steps, 1, 1).requires_grad_()
    traj = soft.rollout(
        body,
        soft.State(x0, v0),
        num_steps,
        external_force=lambda k, state: forces[k],
        physics=physics,
    )
    final = traj.final
    close(final.x.flatten(), d[f"q{num_steps}"])
    close(final.v.flatten(), d[f"v{num_steps}"])
    loss = (final.x.flatten() * d["wq"]).sum() + (final.v.flatten() * d["wv"]).sum()
    close(loss.reshape(1), d[f"loss{num_steps}"])
    loss.backward()
    free = ~body.fixed.flatten()
    prefix = f"dL{num_steps}_"
    close(x0.grad.flatten()[free], d[prefix + "dq0"][free], 1e-8)
    close(v0.grad.flatten()[free], d[prefix + "dv0"][free], 1e-8)
    close(forces.grad.sum(0).flatten()[free], d[prefix + "df_ext_sum"][free], 1e-8)
    close(torch.stack([youngs_modulus.grad, poissons_ratio.grad]), d[prefix + "dE_dnu"], 1e-8)
    close(gravity.grad, d[prefix + "dgravity"], 1e-8)
    if num_steps == 5:
        close(forces.grad.reshape(5, -1)[:, free], d["dL5_df_ext_steps"][:, free], 1e-8)


def test_muscles():
    d = load("hex_muscle")
    m = make_mesh("hex", d)
    muscles = [
        soft.Muscle(
            elements=torch.tensor([e]), direction=d["fiber"], stiffness=float(d["w_muscle"])
        )
        for e in range(m.num_elements)
    ]
    body = soft.SoftBody(
        m,
        dt=float(d["h"]),
        youngs_modulus=float(d["E"]),
        poissons_ratio=float(d["nu"]),
        masses=soft.Masses(node_mass=reference_mass(m, d)),
        fixed=d["fixed_nodes"],
        muscles=muscles,
        gravity=(0.0, 0.0, 0.0),
        material=soft.Material(volume_weight="thesis"),
        solver=SOLVER,
    )
    activation = d["act"].clone().requires_grad_()
    stiffness = torch.full((m.num_elements,), float(d["w_muscle"]), dtype=torch.float64)
    stiffness.requires_grad_()
    x0 = d["q0"].reshape(-1, 3).clone().requires_grad_()
    v0 = d["v0"].reshape(-1, 3).clone().requires_grad_()
    traj = soft.rollout(
        body,
        soft.State(x0, v0),
        10,
        activation=lambda k, state: activation[k],
        physics=body.physics(fiber_stiffness=stiffness),
    )
    close(traj.x.reshape(11, -1), d["q"])
    close(traj.v.reshape(11, -1), d["v"], 1e-8)
    loss = (traj.final.x.flatten() * d["wq"]).sum() + (traj.final.v.flatten() * d["wv"]).sum()
    loss.backward()
    free = ~body.fixed.flatten()
    close(activation.grad, d["dL_dact"], 1e-8)
    close(stiffness.grad.sum().reshape(1), d["dL_dw_muscle"], 1e-8)
    close(v0.grad.flatten()[free], d["dL_dv0"][free], 1e-8)


@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("term", ["corotated", "volume"])
def test_static_energies_and_forces(kind, term):
    d = load("materials_static")
    m = make_mesh(kind, d, {"hex": "hexes", "tet": "tets"}[kind])
    body = soft.SoftBody(
        m, dt=1e-2, youngs_modulus=float(d["E"]), poissons_ratio=float(d["nu"]),
        material=soft.Material(volume_weight="thesis"),
    )  # fmt: skip
    physics = body.physics()
    without = {"corotated": 1, "volume": 0}[term]
    physics.weights[without] = 0.0
    q = d["q"].reshape(-1, 3).clone().requires_grad_()
    energy = body.elastic_energy(q, physics=physics)
    force = body.elastic_force(q, physics=physics)
    close(energy.reshape(1), d[f"{kind}_pd_{term}_energy"])
    close(force.flatten(), d[f"{kind}_pd_{term}_force"])
    # dforce is the derivative along dq; the tangent is symmetric, so the adjoint gives it too.
    (dforce,) = torch.autograd.grad(force, q, d["dq"].reshape(-1, 3))
    close(dforce.flatten(), d[f"{kind}_pd_{term}_dforce"], 1e-8)
