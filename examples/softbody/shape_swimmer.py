"""How much faster does a soft fish swim if its shape is learned together with its controller?

A fish of silicone, free in water, bends by two pairs of muscles; its upper half is simulated. A
small neural network reads how it is bent and a clock. Its shape is a cage of control points: half
width, half height and sweep at eight stations, for the same volume and length. Three searches from
the same starts: Adam on shape and controller, Adam on the controller alone, and CMA-ES (``pip
install cma``) on both at as many simulated steps, an adjoint counted as a step. All are stated on a
finer mesh and with half the time step, too, where none was optimized.

Expected, on the finer mesh, five seeds: 141 mm/s (standard deviation 37), with the controller alone
76 (1.5), by CMA-ES 122 (10). Running time: 2.5 min for a seed; results are kept in a folder, so
that seeds and arms can be run side by side, and a last call gathers what there is.

    python examples/softbody/shape_swimmer.py --seeds 0 --arms cage --out runs/fish
    python examples/softbody/shape_swimmer.py --seeds 0 1 2 3 4 --out runs/fish --plot fish.png
    python examples/softbody/shape_swimmer.py --quick
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import math
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.core import run_kept
from examples.softbody.shape_search import by_adam, by_evolution

LENGTH, SECONDS, DT = 0.3, 2.0, 0.02  # [m], simulated [s], time step [s]
# the fish before: share of the length from the nose, half width and half height there [m]
SHARE = (0.0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 1.0)
WIDE = (0.009, 0.016, 0.020, 0.0187, 0.016, 0.012, 0.006, 0.004)
HIGH = (0.016, 0.028, 0.036, 0.034, 0.028, 0.018, 0.026, 0.045)
MUSCLES = ((0.2, 0.5), (0.5, 0.8))  # where the pairs lie, shares of the length
CONTRACTED = 0.15  # at most [-]
STATIONS = 8
MOST = (0.6 * max(WIDE), 0.6 * max(HIGH), 0.012)  # of half width, half height, sweep [m]
HZ, SENSED, HIDDEN = 2.0, 6, 8  # of the clock; inputs and hidden units of the network
SIZES = (SENSED * HIDDEN, HIDDEN, HIDDEN * 2)  # weights, biases, weights of the outputs
WEIGHT = 3.0  # largest weight of the network
BENT, FAST = 0.1, 1.0  # scale what is sensed [m], [m/s]: with much feedback learning is lost
# searches, and motions that each may simulate over those with gradient of the first
ARMS = {"cage": 1, "controller": 1, "cma": 2, "cma10": 20}
QUICK = {"arms": ("cage", "controller"), "evaluations": 10, "seconds": 0.8, "refined": False}
COARSE, FINE = (10, 2, 2), (20, 4, 4)  # cells; searched is on the coarse ones
CHECKS = {
    "coarse": (COARSE, DT),
    "half step": (COARSE, 0.5 * DT),
    "fine, half step": (FINE, 0.5 * DT),
    "fine": (FINE, DT),
}


class Fish:
    """The upper half of a fish, its cage, its water and its controller.

    Args:
        cells: Cells from nose to tail, across, and from the middle to the back.
        dt: Time step [s].
    """

    def __init__(self, cells: tuple[int, int, int], dt: float = DT):
        grid = mesh.hex_box(cells, (1.0, 2.0, 1.0), (0.0, -1.0, 0.0))
        share, side, up = grid.x_rest.unbind(1)
        wide, high = (torch.from_numpy(np.interp(share, SHARE, of)) for of in (WIDE, HIGH))
        self.mesh = mesh.HexMesh(
            torch.stack([-LENGTH * share, -wide * side, high * up], dim=1), grid.hexes
        )
        self.cage = mesh.Cage(self.mesh, (STATIONS, 2, 2), degree=2)
        self.volume = mesh.total_volume(self.mesh)
        self.counts = tuple(n + 1 for n in cells)
        nodes = torch.arange(self.mesh.num_nodes).reshape(self.counts)
        self.back = nodes[[0, cells[0] // 2, -1], cells[1] // 2, 0]  # nose, middle, tail
        center = grid.x_rest[grid.hexes].mean(1)
        muscles = []
        for first, last in MUSCLES:
            here = (center[:, 0] > first) & (center[:, 0] < last)
            for sign in (-1.0, 1.0):
                where = torch.nonzero(here & (sign * center[:, 1] > 0.0)).flatten()
                muscles.append(
                    soft.Muscle(elements=where, direction=(1.0, 0.0, 0.0), stiffness=2e5)
                )
        mirror = torch.zeros(self.mesh.num_nodes, 3, dtype=torch.bool)
        mirror[up == 0.0, 2] = True
        self.water = soft.Hydrodynamics(self.mesh, fade_angle=0.2).requires_grad_(False)
        self.body = soft.SoftBody(
            self.mesh,
            dt=dt,
            youngs_modulus=2e5,
            poissons_ratio=0.4,
            density=1000.0,  # as water: weight and buoyancy cancel
            gravity=(0.0, 0.0, 0.0),
            element="assumed_strain",
            fixed=mirror,
            muscles=muscles,
            damping=soft.Damping(rayleigh_beta=0.01),
            solver=soft.SolverOptions(rtol=1e-6),
        )

    def shape(self, moves: Tensor) -> Tensor:
        """Positions of the nodes of moves (3, STATIONS) in [-1, 1]: width, height, sweep [m].

        Moves within these bounds turn no element inside out.
        """
        wide, high, sweep = torch.tensor(MOST, dtype=torch.float64)[:, None] * moves
        ends = torch.tensor([[-1.0, 1.0], [0.0, 1.0]], dtype=torch.float64)
        y = (wide[:, None] * ends[0])[:, :, None].expand(-1, 2, 2)
        z, x = ((of[:, None] * ends[1])[:, None].expand(-1, 2, 2) for of in (high, sweep))
        moved = self.cage(torch.stack([x, y, z], dim=-1))
        share = (self.volume / mesh.nodal_volume(self.mesh, moved).sum()).sqrt()
        return moved * torch.stack([torch.ones_like(share), share, share])

    def physics(self, x: Tensor) -> soft.Physics:
        """The body of another shape, and the water that it takes along: that of plates."""
        grid = x.reshape(*self.counts, 3)
        slender = grid[:, 0, -1, 2] / grid[:, 0, 0, 1]  # height over width of each section
        volume = mesh.nodal_volume(self.mesh, x).reshape(self.counts)
        added = 1000.0 * math.pi / 4.0 * slender[:, None, None] * volume
        return self.body.physics(x_rest=x, added_mass=added.flatten())

    def swim(self, numbers: Tensor, seconds: float = SECONDS) -> tuple[Tensor, Tensor]:
        """Positions of the nodes [m], and of the center of mass, at all steps.

        Args:
            numbers: In [-1, 1], of the network and, where the shape is not the first one, of it.
            seconds: Simulated time [s].
        """
        weights, moves = WEIGHT * numbers[: sum(SIZES)], numbers[sum(SIZES) :]
        x = self.shape(moves.reshape(3, -1)) if len(moves) else self.mesh.x_rest
        physics = self.physics(x)

        def activation(k: int, state: soft.State) -> Tensor:
            front, rear = CONTRACTED * commands(weights, self.sensed(k, state))
            return 1.0 + torch.stack([front, -front, rear, -rear])

        motion = soft.rollout(
            self.body,
            self.body.rest_state(physics=physics),
            round(seconds / self.body.dt),
            external_force=lambda k, s: self.water(s.x, s.v),
            activation=activation,
            physics=physics,
        )
        mass = mesh.nodal_volume(self.mesh, x)
        return motion.x, (motion.x * mass[:, None]).sum(1) / mass.sum()

    def sensed(self, k: int, state: soft.State) -> Tensor:
        """A clock, and how far and how fast nose and tail are out of line, (SENSED,)."""
        phase = torch.tensor(2.0 * math.pi * HZ * k * self.body.dt, dtype=torch.float64)
        clock = torch.stack([phase.sin(), phase.cos()])
        y, v = state.x[self.back, 1] / BENT, state.v[self.back, 1] / FAST
        return torch.cat([clock, y[[0, 2]] - y[1], v[[0, 2]] - v[1]])

    def speed(self, numbers: Tensor, seconds: float = SECONDS) -> Tensor:
        """Mean speed along x in the second half of the time, which begins at rest [mm/s]."""
        _, path = self.swim(numbers, seconds)
        half = len(path) // 2
        return 1e3 * (path[-1, 0] - path[half, 0]) / (self.body.dt * (len(path) - 1 - half))


def commands(weights: Tensor, sensed: Tensor) -> Tensor:
    """What the network makes of its inputs: bends of front and rear, (2,) in (-1, 1)."""
    first, bias, last = weights.split(SIZES)
    hidden = torch.tanh(first.reshape(HIDDEN, SENSED) @ sensed + bias)
    return torch.tanh(last.reshape(2, HIDDEN) @ hidden)


def start(arm: str, seed: int) -> np.ndarray:
    """Where a search begins: the same network for all arms of a seed."""
    rng = np.random.default_rng(seed)
    inputs = np.repeat([SENSED, SENSED, HIDDEN], SIZES)
    weights = rng.standard_normal(len(inputs)) / np.sqrt(inputs) / WEIGHT
    moves = 0.1 * rng.standard_normal(3 * STATIONS)
    return weights if arm == "controller" else np.concatenate([weights, moves]).clip(-1.0, 1.0)


def search(item: dict[str, Any]) -> dict[str, Any]:
    """One search: what it found, and how fast that swims, refined in space and time, too."""
    began = time.process_time()
    arm, seed, seconds, evaluations = (item[k] for k in ("arm", "seed", "seconds", "evaluations"))
    fish, first = Fish(COARSE), start(arm, seed)

    def gain(numbers: Tensor) -> Tensor:
        return fish.speed(numbers, seconds)

    if arm.startswith("cma"):
        found = by_evolution(gain, first, ARMS[arm] * evaluations, seed)
    else:
        found = by_adam(gain, first, evaluations)
    speeds = {}
    with torch.no_grad():
        numbers = torch.from_numpy(found)
        for name, (grid, dt) in CHECKS.items() if item["refined"] else [("coarse", (COARSE, DT))]:
            speeds[name] = Fish(grid, dt).speed(numbers, seconds).item()
    return {"numbers": found, "speeds": speeds, "cpu_s": time.process_time() - began}


def main(
    seeds: Sequence[int] = (0,),
    arms: Sequence[str] = ("cage", "controller", "cma"),
    evaluations: int = 100,
    seconds: float = SECONDS,
    refined: bool = True,
    out: str = "runs/fish",
) -> dict[str, Any]:
    """Results of searches, made where the folder does not have them.

    Args:
        seeds: Of the starts.
        arms: Of ``ARMS``; CMA-ES is left out where it is not installed.
        evaluations: Motions with gradient of a search; without, CMA-ES has twice as many, and
            twenty times as many as ``cma10``.
        seconds: Simulated time of a motion [s].
        refined: Whether speeds on the finer mesh and with half the time step are stated.
        out: Folder of the results.
    """
    settings = {"evaluations": evaluations, "seconds": seconds, "refined": refined}
    items = {
        f"{arm}_{seed}": {"arm": arm, "seed": seed, **settings}
        for arm in arms
        for seed in seeds
        if arm in ("cage", "controller") or find_spec("cma")
    }
    return run_kept(search, items, out)


def table(found: dict[str, Any]) -> str:
    """Speeds of the arms, and differences of each seed's arms, mean and standard deviation."""
    of = {arm: {k: r for k, r in found.items() if k.startswith(f"{arm}_")} for arm in ARMS}
    names = [name for name in CHECKS if name in next(iter(found.values()))["speeds"]]
    speeds = {
        arm: {
            k.partition("_")[2]: np.array([r["speeds"][n] for n in names]) for k, r in kept.items()
        }
        for arm, kept in of.items()
        if kept
    }
    rows = {arm: list(by_seed.values()) for arm, by_seed in speeds.items()}
    first = speeds.pop("cage", {})
    for arm, by_seed in speeds.items():
        rows[f"cage - {arm}"] = [first[k] - v for k, v in by_seed.items() if k in first]
    lines = [f"{'mm/s':18s}" + "".join(f"{name:>20s}" for name in names)]
    for name, values in rows.items():
        if values:
            mean, spread = np.mean(values, 0), np.std(values, 0, ddof=min(1, len(values) - 1))
            cells = (f"{m:11.1f} +- {s:5.1f}" for m, s in zip(mean, spread, strict=True))
            lines.append(f"{name:18s}" + "".join(cells) + f"  ({len(values)} seeds)")
    return "\n".join(lines)


def draw(found: dict[str, Any], path: str) -> None:
    """The fastest fish before and after: from the side at rest, from above as it swims."""
    import matplotlib.pyplot as plt

    fish = Fish(FINE)
    faces = mesh.surface_quads(fish.mesh).faces
    titles = {"controller": "controller alone", "cage": "shape and controller"}
    figure, axes = plt.subplot_mosaic(
        [["side controller", "side cage"], ["above controller", "above cage"], ["way", "way"]],
        figsize=(10, 6.5),
        height_ratios=(1.2, 0.8, 1.5),
        layout="constrained",
    )
    for arm, title in titles.items():
        results = [r for k, r in found.items() if k.startswith(f"{arm}_")]
        best = max(results, key=lambda r: r["speeds"]["coarse"])
        with torch.no_grad():
            motion, path_of = fish.swim(torch.tensor(best["numbers"], dtype=torch.float64))
        side, above = axes[f"side {arm}"], axes[f"above {arm}"]
        for sign in (1.0, -1.0):  # the upper half and its mirror image
            fill(side, motion[0][faces][..., [0, 2]] * torch.tensor([1.0, sign]), "tab:orange")
        stroke = round(1.0 / HZ / DT)
        for k in range(4):  # poses of a stroke, one after another, without the way between
            step = len(motion) - 1 - stroke + round(k * stroke / 4)
            moved = torch.stack([path_of[step, 0] - 0.3 * k, path_of[step, 1]])
            fill(above, motion[step][faces][..., [0, 1]] - moved, "tab:blue")
        side.set_title(f"{title}: from the side, at rest")
        above.set_title("from above, a stroke")
        for ax in (side, above):
            ax.set_aspect("equal")
            ax.set(xlabel="x [mm]")
        axes["way"].plot(
            DT * np.arange(len(path_of)), 1e3 * (path_of[:, 0] - path_of[0, 0]), label=title
        )
    axes["way"].set(xlabel="time [s]", ylabel="way on the finer mesh [mm]")
    axes["way"].legend()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def fill(ax: Any, faces: Tensor, color: str) -> None:
    """Faces (n, 4, 2) [m] drawn over each other in millimeters."""
    from matplotlib.collections import PolyCollection

    ax.add_collection(
        PolyCollection(
            list(1e3 * faces.numpy()), facecolor=color, edgecolor="0.4", lw=0.2, alpha=0.4
        )
    )
    ax.autoscale_view()


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--seeds", type=int, nargs="+", default=[0])
        parser.add_argument(
            "--arms", nargs="+", default=["cage", "controller", "cma"], choices=ARMS
        )
        parser.add_argument("--evaluations", type=int, default=100)
        parser.add_argument("--out", default="runs/fish", help="folder of the results")
        parser.add_argument("--plot", metavar="FILE", help="needs cage and controller")
        parser.add_argument("--quick", action="store_true", help="short searches of short motions")
        args = parser.parse_args()
        settings = {"arms": args.arms, "evaluations": args.evaluations}
        results = main(args.seeds, out=args.out, **(QUICK if args.quick else settings))
        print(table(results))
        if args.plot:
            draw(results, args.plot)
