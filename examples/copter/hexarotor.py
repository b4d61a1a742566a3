"""How much agility does a hexarotor gain if airframe and controller are designed together?

Fifteen numbers of the airframe (places and tilts of three rotors, mirrored, after arXiv 2510.04724)
and eight weights of an LQR are improved by L-BFGS through hover, LQR and flight. The measure is the
mean distance from waypoints that follow each other every 1.5 s, 2 m apart in any direction.

Expected: 1.33 m on unseen flights for the flat regular hexarotor with middle weights, 0.90 m with
its controller improved alone, 0.76 m with both. That is one descent each: from many starts the
controller alone gets to 0.77 m, and both to 0.74 m (python -m benchmarks.hexarotor). Running time:
26 CPU seconds.

    python examples/copter/hexarotor.py
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffsim import optim
from diffsim.copter.waypoints import WaypointTask
from diffsim.core import DiffsimError


def improved(task: WaypointTask, evaluations: int, *, airframe: bool) -> np.ndarray:
    """The point that L-BFGS finds from the flat regular hexarotor, (num_parameters,)."""
    start, (lower, upper) = task.start.numpy(), task.bounds
    if not airframe:
        lower[: task.num_design] = upper[: task.num_design] = start[: task.num_design]
    options = optim.Options(
        budget=optim.Budget(evaluations),
        wall=optim.Wall(failures=(DiffsimError,)),  # a design that does not hover
    )
    return optim.minimize(task.value_and_gradient, start, (lower, upper), options).x


def main(argv: Sequence[str] | None = None) -> dict[str, float]:
    """Improve the controller alone, then both; print distances on flights seen and unseen."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--evaluations", type=int, default=200, help="of loss and gradient (200)")
    args = parser.parse_args(argv)
    task = WaypointTask()
    unseen = replace(task, seed=1, num_episodes=48)
    points = {"flat regular, middle weights": task.start.numpy()}
    for name, airframe in (("flat regular, controller alone", False), ("both together", True)):
        began = time.process_time()
        points[name] = improved(task, args.evaluations, airframe=airframe)
        print(f"{name}: {time.process_time() - began:.0f} CPU s")
    numbers = {}
    for name, x in points.items():
        numbers[name], numbers[f"{name}, unseen"] = task.value(x), unseen.value(x)
        print(
            f"{name:32} {task.value(x):.3f} m, unseen {unseen.value(x):.3f} m, smallest gap of the "
            f"streams {1e3 * task.smallest_gap(x):.1f} mm"
        )
    print({k: round(v, 3) for k, v in task.weights(points["both together"]).items()})
    return numbers


if __name__ == "__main__":
    with interruptible():
        main()
