"""The beam by torch-diffsim, which takes the name diffsim: its implicit solver, then its explicit one."""

import sys
from importlib.metadata import version

import diffsim
import scene
import torch


def fall(youngs_modulus: float) -> tuple[float, float]:
    """The beam's fall [m] after all steps, and its derivative by log E [m]."""
    dtype = torch.float64
    beam = diffsim.TetrahedralMesh(
        torch.as_tensor(scene.nodes(), dtype=dtype), torch.as_tensor(scene.tetrahedra())
    )
    material = diffsim.DifferentiableMaterial(youngs_modulus, scene.POISSONS_RATIO).to(dtype)
    with torch.no_grad():
        material.E.fill_(youngs_modulus)  # its constructor rounds to float32
    if sys.argv[1] == "implicit":
        solver = diffsim.IPCImplicitEulerSolver(dt=scene.STEP, gravity=-scene.GRAVITY, dhat=1e-3)
    else:
        solver = diffsim.DifferentiableSolver(
            dt=scene.STEP, gravity=-scene.GRAVITY, damping=1.0, substeps=40
        )
    rest = beam.vertices.clone()
    x, v = rest + torch.tensor([0.0, 10.0, 0.0]), torch.zeros_like(rest)  # far above its own floor
    masses = torch.as_tensor(scene.masses(), dtype=dtype)
    for _ in range(scene.STEPS):
        x, v = solver.step(beam, material, x, v, masses, torch.as_tensor(scene.clamped()))
    down = (rest[:, 1] + 10.0 - x[:, 1])[torch.as_tensor(scene.free_end())].mean()
    down.backward()
    return float(down), youngs_modulus * float(material.E.grad)


scene.answer(version("torch-diffsim"), fall)
