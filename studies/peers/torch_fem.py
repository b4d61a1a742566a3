"""The beam by torch-fem, in statics: it has no steps in time."""

from importlib.metadata import version

import scene
import torch
from torchfem import Solid
from torchfem.materials import Hyperelastic3D

torch.set_default_dtype(torch.float64)


def energy(F: torch.Tensor, params: torch.Tensor) -> torch.Tensor:
    """Compressible neo-Hookean energy of log J."""
    C = F.mT @ F
    log_volume = 0.5 * torch.logdet(C)
    mu, lam = params
    return 0.5 * mu * (torch.trace(C) - 3) - mu * log_volume + 0.5 * lam * log_volume**2


def fall(youngs_modulus: float) -> tuple[float, float]:
    """The fall [m] of the beam at rest, and its derivative by log E [m]."""
    log_modulus = torch.tensor(youngs_modulus).log().requires_grad_()
    nu = scene.POISSONS_RATIO
    mu = log_modulus.exp() / (2 * (1 + nu))
    material = Hyperelastic3D(energy, torch.stack([mu, 2 * mu * nu / (1 - 2 * nu)]))
    beam = Solid(torch.as_tensor(scene.nodes()), torch.as_tensor(scene.tetrahedra()), material)
    beam.constraints[torch.as_tensor(scene.clamped())] = True
    beam.forces[:, 1] = -scene.GRAVITY * torch.as_tensor(scene.masses())
    u = beam.solve(increments=torch.linspace(0.0, 1.0, 6), differentiable_parameters=log_modulus)[0]
    down = -u[torch.as_tensor(scene.free_end()), 1].mean()
    down.backward()
    return float(down), float(log_modulus.grad)


scene.answer(version("torch-fem"), fall)
