"""Does an installed diffsim work? A minute of everything, without pytest and outside the clone.

    python smoke.py                 # in a fresh environment with the wheel, anywhere

Every check compares with something known: a closed form, or differences. It ends with a line
``smoke test passed``, or raises.
"""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

import diffsim
from diffsim import contact, copter, mesh, soft, stokes
from diffsim.core.compiled import INSTRUCTION_SET


def near(name: str, got: float, expected: float, rel: float) -> None:
    """Say and require that a number is as expected."""
    print(f"  {name}: {got:.6g}, expected {expected:.6g}")
    if not abs(got - expected) <= rel * abs(expected):
        raise AssertionError(f"{name} must be {expected:g} within {rel:g}, got {got:g}")


def soft_bodies() -> None:
    """A gradient of a falling, bending bar against differences, and contact that holds it."""
    bar = mesh.hex_box((4, 2, 2), (0.1, 0.03, 0.03))
    body = soft.SoftBody(
        bar,
        dt=0.01,
        youngs_modulus=2e5,
        poissons_ratio=0.4,
        density=1000.0,
        fixed=bar.nodes_near_plane("x", 0.0),
    )

    def height(modulus: torch.Tensor) -> torch.Tensor:
        physics = body.physics(youngs_modulus=modulus)
        return soft.rollout(body, body.rest_state(), 5, physics=physics).x[-1, -1, 2]

    modulus = torch.tensor(2e5, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(height(modulus), modulus)
    with torch.no_grad():
        step = 20.0
        ends = [float(height(torch.tensor(2e5 + s * step, dtype=torch.float64))) for s in (1, -1)]
    near("slope of a bending bar", float(slope), (ends[0] - ends[1]) / (2 * step), 1e-4)

    cube = mesh.hex_box((2, 2, 2), (0.1, 0.1, 0.1))
    block = soft.SoftBody(cube, dt=0.01, youngs_modulus=1e6, poissons_ratio=0.3, density=1000.0)
    floor = contact.Obstacle(contact.Plane((0.0, 0.0, 1.0)))
    state = block.rest_state()
    for _ in range(20):
        state = block(state, obstacles=floor)
    near("weight on the floor", float(state.contact_force[:, 2].sum()), 9.81, 0.05)


def flows() -> None:
    """Poiseuille's pressure drop."""
    cells, rate, high = 20, 0.1, 0.63
    grid = stokes.Grid((24, cells), spacing=1.0 / cells)
    flow = stokes.StokesFlow(grid, [stokes.Inlet("x-"), stokes.Open("x+")], wall="no_slip")
    y = grid.nodes[..., 1] - 0.5
    inflow = 6.0 * rate / high**3 * (high**2 / 4.0 - y[0] ** 2).clamp(min=0.0)
    field = flow(high / 2.0 - y.abs(), inlet=torch.stack([inflow, torch.zeros_like(inflow)], -1))
    drop = field.pressure[0, 6, cells // 2] - field.pressure[0, 18, cells // 2]
    near("pressure drop", float(drop), 12.0 * rate * 12 / cells / high**3, 0.05)


def copters() -> None:
    """A shipped design hovers with its weight."""
    design = copter.load_design(copter.shipped_designs()[0])
    vehicle = design.multicopter()
    thrusts = copter.hover(vehicle).thrusts
    lift = -(vehicle.force_matrix @ thrusts)[2]
    near("lift at hover", float(lift), float(vehicle.weight), 1e-6)


def commands() -> None:
    """The command, its examples and the scripts of training run from here."""
    command = Path(sys.executable).with_name("diffsim")
    with tempfile.TemporaryDirectory() as folder:
        for arguments in (
            ["info"],
            ["examples", "list"],
            ["examples", "run", "sliding_block"],
            ["examples", "run", "train_gradient", "--", "--help"],
            ["fly", "pentacopter", "--seconds", "1", "--out", "fly"],
        ):
            done = subprocess.run(
                [str(command), *arguments], cwd=folder, capture_output=True, text=True, check=False
            )
            print(f"  diffsim {' '.join(arguments)}: status {done.returncode}")
            if done.returncode != 0:
                raise AssertionError(done.stdout[-2000:] + done.stderr[-2000:])
        if not (Path(folder) / "fly" / "flight.csv").is_file():
            raise AssertionError("diffsim fly wrote no flight.csv")


def main() -> None:
    version = importlib.metadata.version("diffsim-robot")
    where = Path(diffsim.__file__).parent
    print(f"diffsim {version}, Python {sys.version.split()[0]}, {INSTRUCTION_SET}, {where}")
    if (where.parent / "pyproject.toml").exists():
        raise AssertionError(f"this is a checkout, not what a wheel installed: {where}")
    for check in (soft_bodies, flows, copters, commands):
        check()
    print("smoke test passed")


if __name__ == "__main__":
    main()
