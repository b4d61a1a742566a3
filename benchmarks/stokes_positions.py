"""Do value and slope of a Stokes flow agree wherever its wall lies in the grid?

python -m benchmarks.stokes_positions                    # 24, 48 and 96 cells, 20 CPU seconds
python -m benchmarks.stokes_positions --cells 48 --walls no_separation

A disk in a box of unit side: its radius is swept over two cells, so that the wall cuts the cells in
every way, while five functionals of the flow change smoothly. A cubic through each functional's
values stands for the flow without a grid. The table compares the exact gradient of the simulation
with the cubic's slope, and what the value changes beyond that gradient.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from diffsim.stokes import FlowField, Grid, Inlet, Open, StokesFlow

CENTER = (0.5031, 0.4972)  # nowhere special in a cell
RADIUS = 0.21  # at the beginning of the sweep
CELLS = (24, 48, 96)
WALLS = ("no_separation", "no_slip")


def _centers(field: FlowField) -> torch.Tensor:
    """Velocities at the cells' centers, (*shape, 2) [m/s]."""
    v = field.velocity[0]
    return 0.25 * (v[1:, 1:] + v[1:, :-1] + v[:-1, 1:] + v[:-1, :-1])


def _outflow_energy(field: FlowField) -> torch.Tensor:
    n = field.grid.shape[0]
    return _centers(field)[4 * n // 5 :].square().sum() / n**2


def _gap(field: FlowField) -> torch.Tensor:
    n = field.grid.shape[0]
    return _centers(field)[n // 2, 4 * n // 5 :, 0].mean()


def _at(x: float, y: float, axis: int) -> Callable[[FlowField], torch.Tensor]:
    point = torch.tensor([[x, y]], dtype=torch.float64)
    return lambda field: field.sample(point)[0, 0, axis]


FUNCTIONALS: dict[str, Callable[[FlowField], torch.Tensor]] = {
    "pressure at the inlet": lambda field: field.pressure[0, 0].mean(),
    "velocity above the disk": _at(0.5, 0.86, 0),
    "mean velocity in the gap": _gap,
    "cross velocity behind": _at(0.78, 0.62, 1),
    "energy of the outflow": _outflow_energy,
}


@dataclass(frozen=True, eq=False)
class Sweep:
    """A functional over the wall's positions."""

    radii: np.ndarray  # (n,) [m]
    values: np.ndarray  # (n,) of the functional
    slopes: np.ndarray  # (n,) derivatives by the radius, of the simulation

    @property
    def ratios(self) -> np.ndarray:
        """Slopes over those of the cubic through the values, (n,)."""
        x = self.radii - self.radii.mean()
        return np.asarray(self.slopes / np.polyval(np.polyder(np.polyfit(x, self.values, 3)), x))

    @property
    def jump(self) -> float:
        """Largest change between neighbors that the slopes do not explain, over the value."""
        expected = 0.5 * (self.slopes[1:] + self.slopes[:-1]) * np.diff(self.radii)
        return float(np.abs(np.diff(self.values) - expected).max() / np.abs(self.values).max())


def sweep(cells: int, wall: str, points: int, span: float = 2.0) -> dict[str, Sweep]:
    """Every functional at ``points`` radii over ``span`` cells."""
    grid = Grid((cells, cells), size=1.0)
    flow = StokesFlow(grid, [Inlet("x-"), Open("x+")], wall=wall)
    center = torch.tensor(CENTER, dtype=torch.float64)
    distance = (grid.nodes - center).norm(dim=-1)
    y = flow.inlet_positions()[:, 1]
    inlet = torch.stack([4.0 * y * (1.0 - y), torch.zeros_like(y)], dim=-1)
    radii = RADIUS + np.linspace(0.0, span, points) / cells
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in FUNCTIONALS}
    for r in radii:
        radius = torch.tensor(r, dtype=torch.float64, requires_grad=True)
        field = flow(distance - radius, inlet)
        for name, functional in FUNCTIONALS.items():
            value = functional(field)
            (slope,) = torch.autograd.grad(value, radius, retain_graph=True)
            found[name].append((value.item(), slope.item()))
    return {name: Sweep(radii, *np.array(pairs).T) for name, pairs in found.items()}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, nargs="+", default=list(CELLS))
    parser.add_argument("--walls", nargs="+", choices=WALLS, default=list(WALLS))
    parser.add_argument("--points", type=int, default=161)
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    print("| wall, cells | functional | wrong sign | slope / smoothed slope | largest jump |")
    print("|---|---|---:|---|---:|")
    start = time.process_time()
    for wall in args.walls:
        for cells in args.cells:
            for name, found in sweep(cells, wall, args.points).items():
                ratios = found.ratios
                print(
                    f"| {wall}, {cells} | {name} | {100.0 * np.mean(ratios < 0.0):.1f} % "
                    f"| {ratios.min():.2f} to {ratios.max():.2f} | {found.jump:.0e} |",
                    flush=True,
                )
    print(f"\n{time.process_time() - start:.0f} CPU s")


if __name__ == "__main__":
    main()
