"""The beam by this library: implicit Euler to a tolerance, adjoint of each step."""

import subprocess

import scene
import torch

from diffsim import mesh, soft


def fall(youngs_modulus: float) -> tuple[float, float]:
    """The beam's fall [m] after all steps, and its derivative by log E [m]."""
    beam = mesh.TetMesh(torch.as_tensor(scene.nodes()), torch.as_tensor(scene.tetrahedra()))
    body = soft.SoftBody(
        beam,
        dt=scene.STEP,
        youngs_modulus=youngs_modulus,
        poissons_ratio=scene.POISSONS_RATIO,
        density=scene.DENSITY,
        material="stable_neo_hookean",
        gravity=(0.0, -scene.GRAVITY, 0.0),
        fixed=torch.as_tensor(scene.nodes()[:, 0] == 0),
        solver=soft.SolverOptions(rtol=1e-10),
    )
    log_modulus = torch.tensor(youngs_modulus, dtype=torch.float64).log().requires_grad_()
    physics = body.physics(youngs_modulus=log_modulus.exp())
    x = soft.rollout(body, body.rest_state(), scene.STEPS, physics=physics).x[-1]
    down = (beam.x_rest - x)[torch.as_tensor(scene.free_end()), 1].mean()
    down.backward()
    return float(down), float(log_modulus.grad)


commit = subprocess.run(
    ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
).stdout
scene.answer(f"commit {commit.strip()}", fall)
