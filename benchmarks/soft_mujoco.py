"""The cantilever beside MuJoCo's flex: same tetrahedra, masses, material and time step.

python -m benchmarks.soft_mujoco                     needs the package mujoco >= 4 (extra "outside")
python -m benchmarks.soft_mujoco --cells 8 2 2

St. Venant-Kirchhoff tetrahedra, six in every cell, twisted and let go without gravity. MuJoCo's
integrator "discrete" solves one linear system a step for the flex's stiffness, with no gradient.
All take turns in one process; printed are medians of CPU time of one thread over the rollout, and
the distance of the end positions from implicit Euler's solved to 1e-10, relative to the motion.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import cores, no_garbage_collection
from benchmarks.soft_scenes import MATERIAL, cantilever, one_pass, twisted
from diffsim import soft

STEP = 1e-2  # [s]
OURS = {
    "auto, 1e-4": soft.SolverOptions(rtol=1e-4),
    "linearly_implicit, 1e-4": soft.SolverOptions(method="linearly_implicit", rtol=1e-4),
}


def beam(cells: Sequence[int], solver: soft.SolverOptions) -> soft.SoftBody:
    """The beam with one mass for all nodes, as a flex has."""
    plain = cantilever("tet", cells)
    mass = plain.physics().mass
    return cantilever(
        "tet",
        cells,
        dt=STEP,
        material="stvk",
        volume_weight="small_strain",
        gravity=(0.0, 0.0, 0.0),
        masses=soft.Masses(node_mass=torch.full_like(mass, float(mass.mean()))),
        solver=solver,
    )


def flex(body: soft.SoftBody) -> str:
    """The same beam in MJCF."""
    points = " ".join(f"{v:.17g}" for v in body.x_rest.flatten().tolist())
    tets = " ".join(str(k) for k in body.mesh.elements.flatten().tolist())
    held = " ".join(str(int(k)) for k in torch.nonzero(body.fixed[:, 0])[:, 0])
    mass = float(body.physics().mass.sum())
    return f"""<mujoco>
  <option timestep="{STEP}" integrator="discrete" gravity="0 0 0"/>
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


def mujoco_rollout(body: soft.SoftBody, degrees: float) -> Callable[[int], tuple[float, Tensor]]:
    """A function that takes steps from the twisted beam: CPU seconds and end positions."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(flex(body))
    moved = (twisted(body, degrees) - body.x_rest).numpy()
    free = [k for k in range(model.nflexvert) if model.body_jntnum[model.flex_vertbodyid[k]] == 3]
    first = model.jnt_qposadr[model.body_jntadr[model.flex_vertbodyid[free]]]

    def run(num_steps: int) -> tuple[float, Tensor]:
        data = mujoco.MjData(model)
        for axis in range(3):
            data.qpos[first + axis] = moved[free, axis]
        mujoco.mj_forward(model, data)
        began = time.process_time()
        for _ in range(num_steps):
            mujoco.mj_step(model, data)
        seconds = time.process_time() - began
        mujoco.mj_kinematics(model, data)
        mujoco.mj_flex(model, data)
        return seconds, torch.from_numpy(np.array(data.flexvert_xpos))

    return run


def our_end(body: soft.SoftBody, num_steps: int, degrees: float) -> tuple[float, Tensor]:
    """CPU seconds of a rollout without gradient, and its end positions."""
    start = twisted(body, degrees)
    with torch.no_grad(), no_garbage_collection():
        began = time.process_time()
        end = soft.rollout(body, soft.State(start, torch.zeros_like(start)), num_steps).x[-1]
        return time.process_time() - began, end


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, nargs=3, default=(32, 8, 8))
    parser.add_argument("--steps", type=int, default=25)
    parser.add_argument("--degrees", type=float, default=30.0)
    parser.add_argument("--repetitions", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    bodies = {name: beam(args.cells, solver) for name, solver in OURS.items()}
    theirs: dict[str, Any] = {
        "MuJoCo flex, discrete": mujoco_rollout(next(iter(bodies.values())), args.degrees),
    }
    times: dict[str, list[float]] = {name: [] for name in (*bodies, *theirs)}
    back: dict[str, list[float]] = {name: [] for name in bodies}
    ends: dict[str, Tensor] = {}
    with cores(1):
        for k in range(args.repetitions + 1):  # the first round warms up
            for name, body in bodies.items():
                seconds, ends[name] = our_end(body, args.steps, args.degrees)
                times[name] += [seconds] if k else []
                if k:
                    passed = one_pass(body, args.steps, degrees=args.degrees)
                    back[name].append(passed.backward.cpu)
            for name, run in theirs.items():
                seconds, ends[name] = run(args.steps)
                times[name] += [seconds] if k else []
        solved = beam(args.cells, soft.SolverOptions(rtol=1e-10))
        exact = our_end(solved, args.steps, args.degrees)[1]
    moved = float((exact - twisted(solved, args.degrees)).norm())
    print(f"{3 * len(exact)} DoF, {args.steps} steps of {STEP:g} s from {args.degrees:g} degrees")
    print("| method | forward [CPU s] | backward [CPU s] | off by |")
    print("|---|---:|---:|---:|")
    for name, spent in times.items():
        gradient = f"{statistics.median(back[name]):.2f}" if name in back else "none"
        off = float((ends[name] - exact).norm()) / moved
        shown = f"{off:.1%}" if math.isfinite(off) else "diverged"
        print(f"| {name} | {statistics.median(spent):.2f} | {gradient} | {shown} |")


if __name__ == "__main__":
    main()
