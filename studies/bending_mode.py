"""The reduced bending arm against the soft-body simulator: statics and first frequency, once.

A cantilever of the arm's length, material and cross-sectional area, with one off-center chamber:

    python -m studies.bending_mode
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.core import interruptible
from diffsim.core.errors import ConvergenceError

LENGTH, WIDTH = 0.1, 0.0393  # [m] a square of the cylinder's area (outer radius 22.2 mm)
YOUNGS, POISSON, DENSITY = 263_824.0, 0.45, 1070.0
STEP, PUSH = 1e-3, 0.02  # [s], [N]
LEVELS = (10e3, 15e3, 20e3, 25e3, 30e3, 35e3)  # [Pa]


@dataclass(frozen=True)
class Beam:
    """The body, its clamped-free axis along x, the chamber in the lower half of y."""

    body: soft.SoftBody
    end: Tensor
    second_moment: float
    area: float

    @classmethod
    def of(cls, cells: int) -> Beam:
        """With ``cells`` across; walls one cell thick."""
        num_long = round(2.5 * cells)
        h, hx = WIDTH / cells, LENGTH / num_long
        box = mesh.hex_box((num_long, cells, cells), (LENGTH, WIDTH, WIDTH))
        x, y, z = box.x_rest[box.elements].mean(1).T
        hole = (y > h) & (y < WIDTH / 2) & (z > h) & (z < WIDTH - h)
        inside = hole & (x > hx) & (x < LENGTH - hx)
        nodes, hexes = torch.unique(box.elements[~inside], return_inverse=True)
        hollow = mesh.HexMesh(box.x_rest[nodes], hexes)
        body = soft.SoftBody(
            hollow,
            dt=STEP,
            youngs_modulus=YOUNGS,
            poissons_ratio=POISSON,
            density=DENSITY,
            gravity=(0.0, 0.0, 0.0),
            integrator="implicit_midpoint",
            chambers=[soft.PressureChamber.from_cavity(hollow)],
            fixed=hollow.nodes_near_plane(0, 0.0),
        )
        middle = (x - x.min()).abs() < 1.5 * hx
        at = y[middle & ~hole & (x > hx)]
        area = len(at) * h * h
        moment = float(((at - at.mean()) ** 2).sum() * h * h) + area * h * h / 12.0
        return cls(body, hollow.nodes_near_plane(0, LENGTH), moment, area)

    def bend(self, x: Tensor) -> tuple[float, float]:
        """Angle of the end's face [rad] and how far its middle moved sideways [m]."""
        rest, now = self.body.mesh.x_rest[self.end], x[self.end]
        u, _, v = torch.linalg.svd((now - now.mean(0)).T @ (rest - rest.mean(0)))
        turn = u @ v
        return float(torch.atan2(turn[1, 0], turn[0, 0])), float((now - rest).mean(0)[1])

    def frequency(self, pressure: float) -> float:
        """Of small free oscillations about the rest under a pressure [Hz]."""
        level = torch.tensor([pressure], dtype=torch.float64)
        push = torch.zeros_like(self.body.mesh.x_rest)
        push[self.end, 1] = PUSH / len(self.end)
        with torch.no_grad():
            rest = self.body.static_equilibrium(pressure=level)
            state = self.body.static_equilibrium(pressure=level, external_force=push, guess=rest.x)
            still, seen = float(rest.x[self.end, 1].mean()), []
            for _ in range(260):
                seen.append(float(state.x[self.end, 1].mean()) - still)
                state = self.body(state, pressure=level)
        y = np.array(seen)
        at = np.flatnonzero(np.diff(np.sign(y)))
        zeros = STEP * (at + y[at] / (y[at] - y[at + 1]))
        return float(0.5 / np.mean(np.diff(zeros)))


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    for cells in (6, 8):  # the walls of 8 are thinner: another body, no refinement
        beam = Beam.of(cells)
        stiff = YOUNGS * beam.second_moment / (DENSITY * beam.area)
        euler = 1.875104**2 / (2.0 * np.pi * LENGTH**2) * np.sqrt(stiff)
        print(f"{cells} cells: {beam.frequency(0.0):.2f} Hz, Euler-Bernoulli {euler:.2f} Hz")
        found = []
        for level in LEVELS:
            try:
                with torch.no_grad():
                    x = beam.body.static_equilibrium(
                        pressure=torch.tensor([level], dtype=torch.float64)
                    ).x
            except ConvergenceError:
                print(f"  {level / 100:.0f} mbar: no equilibrium")
                break
            angle, away = beam.bend(x)

            away_arc = LENGTH * (1.0 - np.cos(angle)) / angle
            found.append((level / 1e5, angle))
            print(
                f"  {level / 100:.0f} mbar: {angle:.4f} rad, {1e5 * angle / level:.3f} rad/100 kPa,"
                f" sideways {1e3 * away:.2f} mm, arc {1e3 * away_arc:.2f} mm,"
                f" {beam.frequency(level):.2f} Hz",
                flush=True,
            )
        p, q = np.array(found).T
        # angle = gain p / (1 - k p): linear in 1 / gain and k / gain
        one, k = np.linalg.lstsq(np.column_stack([q / p, q]), np.ones(len(p)), rcond=None)[0]
        off = np.sqrt(np.mean((p / (one + k * p) / q - 1.0) ** 2))
        print(f"  angle = p / ({one:.3f} + {k:.3f} p): k = {-k / one:.2f}, {off:.1%} rms off")


if __name__ == "__main__":
    with interruptible():
        main()
