"""How must a starfish pull its tendons to swim fastest?

A foam starfish of the size of Tao Du's robot (thesis, chapter 5) hangs on a rail in water, free to
move along x only. One servo, with a lag and a limited speed, pulls four tendons that run along the
legs near the flat side. The command repeats every 0.9 s; Adam moves its 12 knots, through servo,
body and water, so that the robot is fastest in the second and third period from rest. The gait it
starts from opens and closes like a sine.

Expected: the sine goes nowhere (0.7 mm/s backwards), eight iterations make it 5.9 mm/s forwards:
the robot learns to close fast and open slowly. The same gait is simulated at 5.5 and 5.4 mm/s with
half and a quarter of the time step, at 9.1 with elements of a third of the edge, and at 6.6 with
both fine enough. The coefficients of water are those of Min et al. 2019 and the mesh is coarse: the
numbers are a model's, not the robot's. Running time: about 15 s.

    python examples/softbody/swimmer.py --plot runs/swimmer.png
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft

REACH, WIDTH, CORE, THICK = 0.070, 0.015, 0.018, 0.0175  # tip, leg, half center, flat to top [m]
PULL = 0.018  # longest pull of the servo [m]
PERIOD, DT = 0.9, 1.0 / 60.0  # [s]


def servo() -> soft.ActuatorDynamics:
    """What pulls: it lags, and its speed is limited."""
    return soft.ActuatorDynamics(time_constant=0.03, max_rate=0.25)


def make_mesh(cells: int = 1) -> mesh.HexMesh:
    """Four legs in the y-z plane around a square center; flat side x = 0, top at x < 0.

    ``cells`` elements are made of one along each edge.
    """
    arm = np.linspace(CORE, REACH, 7 * cells + 1)
    arm = np.concatenate([np.linspace(WIDTH / 2, CORE, cells + 1)[1:-1], arm])
    across = np.linspace(-WIDTH / 2, WIDTH / 2, cells + 1)
    ticks = np.concatenate([-arm[::-1], across, arm])
    n, layers = len(ticks) - 1, 3 * cells
    grid = mesh.hex_box((layers, n, n))
    scale = torch.tensor([layers, n, n], dtype=torch.float64)
    index = torch.round(grid.x_rest * scale).long()
    x = torch.stack(
        [
            (index[:, 0] - layers) * (THICK / layers),
            torch.from_numpy(ticks)[index[:, 1]],
            torch.from_numpy(ticks)[index[:, 2]],
        ],
        dim=1,
    )
    middle = x[grid.hexes].mean(1).abs()
    leg = (middle[:, 1:] < WIDTH / 2).any(1)
    core = (middle[:, 1:] < CORE).all(1)
    used, local = torch.unique(grid.hexes[leg | core], return_inverse=True)
    return mesh.HexMesh(x[used], local)


def in_center(x: Tensor) -> Tensor:
    """Which nodes ride on the rail, the same part of the center on every mesh."""
    return (x[:, 1:].abs() < WIDTH / 2 + 1e-9).all(1)


def make_robot(
    dt: float = DT, cells: int = 1
) -> tuple[soft.SoftBody, soft.Hydrodynamics, list[soft.Tendon]]:
    """Body on its rail, water, and one tendon of 65 mm along each leg."""
    m = make_mesh(cells)
    depth = -THICK / 6  # through the middle of the elements on the flat side
    tendons = [
        soft.Tendon(m, [[depth, *(0.005 * d)], [depth, *(REACH * d)]], axial_stiffness=300.0)
        for d in np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    ]
    hydro = soft.Hydrodynamics(m).requires_grad_(False)
    rail = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
    rail[m.nodes_where(in_center), 1:] = True
    body = soft.SoftBody(
        m,
        dt=dt,
        element="standard",
        youngs_modulus=5e5,
        poissons_ratio=0.4,
        density=1000.0,  # ballasted: weight and buoyancy cancel, so
        gravity=(0.0, 0.0, 0.0),
        damping=soft.Damping(rayleigh_beta=0.01),
        fixed=rail,
        muscles=[t.muscle for t in tendons],
        masses=soft.Masses(added_mass=soft.added_mass(hydro, 1.0)),
        solver=soft.SolverOptions(rtol=1e-6),
    )
    return body, hydro, tendons


def gait(raw: Tensor, num_steps: int, dt: float = DT) -> Tensor:
    """Commanded pull at each step, (num_steps,) [m], linear between the knots of one period."""
    pull = PULL * torch.sigmoid(raw)
    at = (torch.arange(num_steps, dtype=torch.float64) * dt / PERIOD * len(raw)) % len(raw)
    k = at.long()
    return torch.lerp(pull[k], pull[(k + 1) % len(raw)], at - k)


def swim(
    body: soft.SoftBody,
    hydro: soft.Hydrodynamics,
    tendons: list[soft.Tendon],
    command: Tensor,
) -> tuple[soft.Trajectory, Tensor]:
    """Motion from rest under a command (num_steps,) [m], and the pull that the servo made of it."""
    pull = servo().sequence(command[:, None], body.dt, torch.zeros(1, dtype=torch.float64))
    activation = torch.stack([t.activation(t.rest_length - pull[:, 0]) for t in tendons], dim=1)
    motion = soft.rollout(
        body,
        body.rest_state(),
        len(command),
        external_force=lambda k, s: hydro(s.x, s.v),
        activation=lambda k, s: activation[k],
    )
    return motion, pull[:, 0]


def path_of(body: soft.SoftBody, motion: soft.Trajectory) -> Tensor:
    """Way of the center along -x, where it swims, (num_steps + 1,) [m]."""
    hub = body.mesh.nodes_where(in_center)
    return -(motion.x[:, hub, 0] - motion.x[0, hub, 0]).mean(1)


def speed_of(path: Tensor, dt: float, periods: int) -> Tensor:
    """Mean speed [m/s] after the first period, which gets it going."""
    num_steps = len(path) - 1
    first = num_steps // periods
    return (path[-1] - path[first]) / (dt * (num_steps - first))


def swim_speed(raw: Tensor, *, steps: int = 1, cells: int = 1, periods: int = 3) -> Tensor:
    """Speed of a gait [m/s] in time steps and cells so many times smaller."""
    body, hydro, tendons = make_robot(DT / steps, cells)
    command = gait(raw, steps * round(periods * PERIOD / DT), body.dt)
    motion, _ = swim(body, hydro, tendons, command)
    return speed_of(path_of(body, motion), body.dt, periods)


def main(
    iterations: int = 8, periods: int = 3, lr: float = 0.8, plot: str | None = None
) -> dict[str, float]:
    """Optimize the gait, and draw; returns the numbers that the story ends with."""
    runs, speeds = optimized(iterations, periods, lr)
    if plot:
        draw(make_mesh(), runs, Path(plot))
    return {"before_mm_per_s": 1e3 * speeds[0], "after_mm_per_s": 1e3 * max(speeds)}


def optimized(
    iterations: int = 8, periods: int = 3, lr: float = 0.8
) -> tuple[dict[str, dict[str, Tensor]], list[float]]:
    """Runs of the sine and of the best gait, and the speeds of all iterations [m/s]."""
    body, hydro, tendons = make_robot()
    num_steps = round(periods * PERIOD / DT)
    raw = 1.5 * torch.sin(2 * torch.pi * torch.arange(12, dtype=torch.float64) / 12)
    raw.requires_grad_()
    optimizer = torch.optim.Adam([raw], lr=lr)
    runs: dict[str, dict[str, Tensor]] = {}
    speeds: list[float] = []
    for i in range(iterations + 1):
        command = gait(raw, num_steps)
        motion, pull = swim(body, hydro, tendons, command)
        path = path_of(body, motion)
        speed = speed_of(path, DT, periods)
        speeds.append(speed.item())
        record = {"knots": raw, "command": command, "pull": pull, "path": path, "x": motion.x}
        record = {name: value.detach().clone() for name, value in record.items()}
        if i == 0:
            runs["sine"] = record
        if speeds[-1] == max(speeds):
            runs["optimized"] = record
        if i < iterations:
            optimizer.zero_grad()
            (-speed / 0.01).backward()
            optimizer.step()
    return runs, speeds


def draw(m: mesh.HexMesh, runs: dict[str, dict[str, Tensor]], path: Path) -> None:
    """One period of the optimized gait, swimming upwards; pull and travel of both gaits."""
    import matplotlib.pyplot as plt
    from matplotlib.colors import LightSource
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    faces = mesh.surface_quads(m).faces
    colors = {"sine": "#9aa5a5", "optimized": "#c0392b"}
    figure = plt.figure(figsize=(11, 6.2), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(0.9, 1.0))
    upper.set_facecolor("#eaf3f8")
    best = runs["optimized"]
    last = len(best["pull"])
    period = round(PERIOD / DT)
    start = period // 2 + int(best["pull"][period // 2 : period // 2 + period].argmin())
    for k, after in enumerate([0.0, 0.1, 0.3, 0.6]):  # since the legs were widest open [s]
        step = start + round(after / DT)
        axes = upper.add_subplot(1, 4, k + 1, projection="3d", computed_zorder=False)
        up = 1e3 * best["x"][step][:, [2, 1, 0]] * torch.tensor([1.0, 1.0, -1.0])
        top = float(up[up[:, :2].norm(dim=1) < 1e3 * WIDTH, 2].max())
        axes.add_collection3d(
            Poly3DCollection(
                up[faces].numpy(),
                facecolors="#f0a95c",
                edgecolors="#7a4310",
                linewidths=0.4,
                shade=True,
                lightsource=LightSource(azdeg=240, altdeg=45),
            )
        )
        axes.plot([0, 0], [0, 0], [top, 60], color="#5b7480", lw=1.2)  # the rail
        axes.set(xlim=(-62, 62), ylim=(-62, 62), zlim=(-25, 60))
        axes.set_box_aspect((1, 1, 85 / 124), zoom=1.3)
        axes.view_init(14, -66)
        axes.patch.set_alpha(0.0)
        axes.set_axis_off()
        axes.set_title(f"{step * DT:.2f} s", y=0.06, fontsize=10)
    left, right = lower.subplots(1, 2)
    for name, run in runs.items():
        t = DT * np.arange(1, last + 1)
        left.plot(t, 1e3 * run["command"], color=colors[name], lw=0.9, ls="--")
        left.plot(t, 1e3 * run["pull"], color=colors[name], lw=1.8, label=name)
        right.plot(np.append(0.0, t), 1e3 * run["path"], color=colors[name], lw=1.8, label=name)
    left.set(xlabel="time [s]", ylabel="pull of the tendons [mm]", xlim=(0, t[-1]))
    left.set_title("command (dashed), servo (solid)", fontsize=10)
    right.set(xlabel="time [s]", ylabel="travel of the center [mm]", xlim=(0, t[-1]))
    right.set_title("swimming along the rail", fontsize=10)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    right.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=105)
    plt.close(figure)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--iterations", type=int, default=8)
        parser.add_argument("--periods", type=int, default=3, help="of 0.9 s, at least two")
        parser.add_argument("--lr", type=float, default=0.8, help="Adam's step in the knots")
        parser.add_argument("--plot", metavar="PNG", help="write the picture here")
        args = parser.parse_args()
        for name, value in main(args.iterations, args.periods, args.lr, args.plot).items():
            print(f"{name:16s} {value:.4g}")
