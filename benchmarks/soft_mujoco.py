"""Error along the path over CPU seconds: the cantilever's steps here, and MuJoCo's flex.

python -m benchmarks.soft_mujoco                     needs the package mujoco >= 4
python -m benchmarks.soft_mujoco --cells 32 8 8 --halvings 3

St. Venant-Kirchhoff tetrahedra, six in every cell, equal masses, twisted, let go without gravity
or damping. The same mesh is stepped by leapfrog until half a step changes nothing that matters:
the motion that all are compared with. Each method runs at steps of 10 ms, 5 ms, ...; its error is
the distance from that motion at 10, 20, 50, 100 and 250 ms, relative to how far the twist moved the
beam. Two rows simulate nothing: the beam stays twisted, or is at rest from the start. A method that
damps all motion ends as good as the second, and is no better on the way.

MuJoCo's integrator "discrete" solves one linear system a step for the flex's stiffness, with no
gradient. All take turns in one process; printed and drawn are medians of CPU time of one thread.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import cores, no_garbage_collection
from benchmarks.plot_style import new_figure, save, style
from benchmarks.soft_scenes import MATERIAL, cantilever, twisted
from diffsim import soft
from diffsim.core.errors import DiffsimError
from diffsim.viz.figures import INK

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST = 1e-2  # [s], the longest step
AT = (1, 2, 5, 10, 25)  # longest steps after which paths are compared
LEAPFROG = 9  # halvings of the longest step at which the motion is taken for exact


@dataclass(frozen=True)
class Method:
    """A way to step the beam."""

    # integrator, solver: of the soft body; no integrator: MuJoCo's flex
    integrator: str | None
    solver: soft.SolverOptions | None
    # the longest step is halved from so many times on; explicit steps begin where they are stable,
    # the midpoint's where it gains no energy
    halvings: int
    # color, marker: in the figure
    color: str
    marker: str


# Of each step's residual. With 1e-4 the midpoint at 0.6 ms was off by 31 % instead of 2 %: nothing
# damps what many short steps leave. With 1e-8 the errors are those of 1e-6.
RTOL = 1e-6
AUTO = soft.SolverOptions(rtol=RTOL)
LINEAR = soft.SolverOptions(method="linearly_implicit", rtol=RTOL)
METHODS = {
    "auto, implicit Euler": Method("implicit_euler", AUTO, 0, "#0b6e75", "o"),
    "auto, BDF2": Method("bdf2", AUTO, 0, "#1d2433", "D"),
    "auto, implicit midpoint": Method("implicit_midpoint", AUTO, 1, "#2f7d32", "P"),
    "linearly implicit Euler": Method("implicit_euler", LINEAR, 0, "#7a4fa3", "s"),
    "explicit (semi-implicit Euler)": Method("semi_implicit_euler", None, 6, "#b08a00", "v"),
    "MuJoCo flex, discrete": Method(None, None, 0, "#c2571a", "^"),
}


def beam(
    cells: Sequence[int], dt: float, integrator: str, solver: soft.SolverOptions | None
) -> soft.SoftBody:
    """The beam with one mass for all nodes, as a flex has."""
    plain = cantilever("tet", cells)
    mass = plain.physics().mass
    return cantilever(
        "tet",
        cells,
        dt=dt,
        material="stvk",
        volume_weight="small_strain",
        gravity=(0.0, 0.0, 0.0),
        masses=soft.Masses(node_mass=torch.full_like(mass, float(mass.mean()))),
        integrator=integrator,
        solver=solver,
    )


def flex(body: soft.SoftBody) -> str:
    """The same beam in MJCF."""
    points = " ".join(f"{v:.17g}" for v in body.x_rest.flatten().tolist())
    tets = " ".join(str(k) for k in body.mesh.elements.flatten().tolist())
    held = " ".join(str(int(k)) for k in torch.nonzero(body.fixed[:, 0])[:, 0])
    mass = float(body.physics().mass.sum())
    return f"""<mujoco>
  <option timestep="{body.dt}" integrator="discrete" gravity="0 0 0"/>
  <size memory="4G"/>
  <worldbody>
    <flexcomp type="direct" name="beam" dim="3" mass="{mass}" radius="1e-4"
              point="{points}" element="{tets}">
      <contact selfcollide="none" conaffinity="0" contype="0"/>
      <edge equality="false"/>
      <elasticity young="{MATERIAL["youngs_modulus"]}" poisson="{MATERIAL["poissons_ratio"]}"/>
      <pin id="{held}"/>
    </flexcomp>
  </worldbody>
</mujoco>"""


Run = tuple[float, Tensor]
"""CPU seconds of a run, and positions at the times of ``AT``, (5, num_nodes, 3) [m]."""


def mujoco_run(body: soft.SoftBody, degrees: float, per_longest: int) -> Callable[[], Run]:
    """MuJoCo's steps from the twisted beam, as a function that takes them."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(flex(body))
    moved = (twisted(body, degrees) - body.x_rest).numpy()
    free = [k for k in range(model.nflexvert) if model.body_jntnum[model.flex_vertbodyid[k]] == 3]
    first = model.jnt_qposadr[model.body_jntadr[model.flex_vertbodyid[free]]]

    def run() -> Run:
        data = mujoco.MjData(model)
        for axis in range(3):
            data.qpos[first + axis] = moved[free, axis]
        mujoco.mj_forward(model, data)
        seconds, taken, path = 0.0, 0, []
        for at in AT:
            began = time.process_time()
            for _ in range(at * per_longest - taken):
                mujoco.mj_step(model, data)
            seconds += time.process_time() - began
            taken = at * per_longest
            seen = mujoco.MjData(model)  # positions of vertices, without touching the run
            seen.qpos[:] = data.qpos
            mujoco.mj_kinematics(model, seen)
            mujoco.mj_flex(model, seen)
            path.append(torch.from_numpy(np.array(seen.flexvert_xpos)))
        return seconds, torch.stack(path)

    return run


def our_run(body: soft.SoftBody, degrees: float, per_longest: int) -> Run:
    """Our steps from the twisted beam, without gradient."""
    start = twisted(body, degrees)
    state = soft.State(start, torch.zeros_like(start))
    with torch.no_grad(), no_garbage_collection():
        began = time.process_time()
        x = soft.rollout(body, state, AT[-1] * per_longest).x
        return time.process_time() - began, x[[at * per_longest for at in AT]].clone()


def exact_path(cells: Sequence[int], degrees: float, halvings: int) -> Tensor:
    """The motion by leapfrog: semi-implicit Euler whose first velocity is half a step early."""
    per_longest = 2**halvings
    body = beam(cells, LONGEST / per_longest, "semi_implicit_euler", None)
    start = twisted(body, degrees)
    with torch.no_grad():
        still = soft.State(start, torch.zeros_like(start))
        state = soft.State(start, -0.5 * soft.step(body, still).v)
        path, taken = [], 0
        for at in AT:
            for _ in range(at * per_longest - taken):
                state = soft.step(body, state)
            taken = at * per_longest
            path.append(state.x)
    return torch.stack(path)


@dataclass(frozen=True)
class Row:
    """One method at one step: CPU seconds, and the error at the times of ``AT``."""

    method: str
    dt: float
    seconds: float
    errors: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Root of the mean square along the path."""
        return math.sqrt(statistics.fmean(e * e for e in self.errors))


def measure(cells: Sequence[int], degrees: float, halvings: int, repetitions: int) -> list[Row]:
    """All methods at all their steps, and the two that simulate nothing."""
    exact = exact_path(cells, degrees, LEAPFROG)
    body = beam(cells, LONGEST, "implicit_euler", AUTO)
    start, rest = twisted(body, degrees), body.x_rest
    scale = float((start - rest).norm())

    def errors(path: Tensor) -> tuple[float, ...]:
        return tuple(float(e) for e in (path - exact).flatten(1).norm(dim=1) / scale)

    rows = [
        Row("exact, step twice as long", LONGEST / 2 ** (LEAPFROG - 1), math.nan,
            errors(exact_path(cells, degrees, LEAPFROG - 1))),
        Row("stays twisted", math.nan, 0.0, errors(start.expand_as(exact))),
        Row("at rest from the start", math.nan, 0.0, errors(rest.expand_as(exact))),
    ]  # fmt: skip
    runs: dict[tuple[str, float], Callable[[], Run]] = {}
    for name, method in METHODS.items():
        for k in range(method.halvings, method.halvings + halvings + 1):
            dt = LONGEST / 2**k
            stepped = beam(cells, dt, method.integrator or "implicit_euler", method.solver or AUTO)
            if method.integrator is None:
                runs[name, dt] = mujoco_run(stepped, degrees, 2**k)
            else:
                runs[name, dt] = partial(our_run, stepped, degrees, 2**k)
    times: dict[tuple[str, float], list[float]] = {key: [] for key in runs}
    paths: dict[tuple[str, float], Tensor] = {}
    for k in range(repetitions + 1):  # the first round warms up
        for key, run in list(runs.items()):
            try:
                seconds, paths[key] = run()
            except DiffsimError as error:  # an explicit step that is too long
                print(f"{key[0]} at {1e3 * key[1]:g} ms: {error}")
                del runs[key]
                continue
            times[key] += [seconds] if k else []
    return rows + [Row(*key, statistics.median(times[key]), errors(paths[key])) for key in runs]


def table(rows: Sequence[Row]) -> str:
    """Rows as Markdown."""
    at = " | ".join(f"{1e3 * LONGEST * k:g} ms" for k in AT)
    lines = [f"| method | step [ms] | CPU s | {at} | mean |", "|---|" + "---:|" * (3 + len(AT))]
    for row in rows:
        cells = [f"{1e3 * row.dt:.3g}", f"{row.seconds:.3f}"]
        cells = ["" if value == "nan" else value for value in cells]
        cells += [f"{e:.2%}" if e < 10 else "diverged" for e in (*row.errors, row.mean)]
        lines.append(f"| {row.method} | {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(rows: Sequence[Row], title: str) -> Figure:
    """Error along the path over CPU seconds, a line per method."""
    figure = new_figure(7.0, 4.4)
    ax = figure.add_subplot()
    for name, method in METHODS.items():
        mine = [row for row in rows if row.method == name and row.mean < 10]
        ax.loglog(
            [row.seconds for row in mine],
            [row.mean for row in mine],
            color=method.color,
            marker=method.marker,
            markersize=5,
            linewidth=1.5,
            label=f"{name}, {1e3 * mine[0].dt:.2g} to {1e3 * mine[-1].dt:.2g} ms" if mine else name,
        )
    idle = next(row.mean for row in rows if row.method == "at rest from the start")
    ax.axhline(idle, color=INK, linewidth=1.0, linestyle=":")
    ax.annotate("at rest from the start", (1.0, idle), xycoords=("axes fraction", "data"),
                ha="right", va="bottom", fontsize=8, color=INK)  # fmt: skip
    style(ax, title, "CPU seconds of 0.25 s of motion", "error along the path")
    ax.legend(fontsize=8, frameon=False, loc="lower left")
    return figure


def main() -> None:
    """Print the table and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, nargs=3, default=(12, 3, 3))
    parser.add_argument("--degrees", type=float, default=30.0)
    parser.add_argument("--halvings", type=int, default=3, help="of each method's longest step")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("runs/soft_mujoco"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    with cores(1):
        rows = measure(args.cells, args.degrees, args.halvings, args.repetitions)
    x, y, z = args.cells
    dof = 3 * (x + 1) * (y + 1) * (z + 1)
    print(f"{dof} DoF, {1e3 * LONGEST * AT[-1]:g} ms from {args.degrees:g} degrees\n{table(rows)}")
    args.out.mkdir(parents=True, exist_ok=True)
    save(draw(rows, f"Twisted beam, {dof:,} DoF"), args.out / "soft_time_to_accuracy")


if __name__ == "__main__":
    main()
