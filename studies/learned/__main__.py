"""``python -m studies.learned``: a copter's controller learns here and flies in RotorPy.

RotorPy shares no code with the simulators here. Twenty vehicles differ in mass and in the delay of
their commands. Each is let go near its place, and held against it in the last second of four.
"""

from __future__ import annotations

from diffsim.core.script import ask_for

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.core.files import write_json_atomic
from diffsim.core.rotation import matrix_from_quaternion
from diffsim.core.threads import one_thread
from diffsim.envs.task import Task, TaskState
from diffsim.learn import GradientLearner, recipe, train

Array = NDArray[np.float64]
TASK = Path(__file__).parent / "hover.yaml"
STEPS = 160_000
# what a task needs that randomizes its vehicle; chosen on seeds 100 and 101
OPTIONS = {"horizon": 200, "learning_rate": 1e-2}
FLIGHTS, SECONDS = 20, 4.0
MASSES, DELAYS = (0.9, 1.1), (0.0, 0.03)  # factor on the mass; time [s]
LOOP = 5e-3  # steps of RotorPy, which integrates finer within them [s]
# north, east, down of east, north, up; forward, right, down of forward, left, up
TO_NED, TO_FRD = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]), np.array([1.0, -1.0, -1.0])


class Rig:
    """A Hummingbird of RotorPy whose commands come late.

    Args:
        mass: Factor on its mass.
        delay: Time by which commands come later [s].
        start: First state of the task, a batch of one.
    """

    def __init__(self, mass: float, delay: float, start: TaskState):
        from rotorpy.vehicles.hummingbird_params import quad_params
        from rotorpy.vehicles.multirotor import Multirotor

        numbers = {**quad_params, "mass": mass * quad_params["mass"]}
        self.thrust_per_square = numbers["k_eta"]
        self.vehicle = Multirotor(numbers, aero=True)
        rotation = TO_NED @ matrix_from_quaternion(start["quaternion"])[0].numpy() * TO_FRD
        first = {name: start[name][0].numpy() for name in ("position", "velocity", "body_rates")}
        self.state: dict[str, Array] = {
            "x": TO_NED @ first["position"],
            "v": TO_NED @ first["velocity"],
            "q": _quaternion(rotation)[[1, 2, 3, 0]],
            "w": TO_FRD * first["body_rates"],
            "wind": np.zeros(3),
            "rotor_speeds": self._speeds(start["thrusts"][0].numpy()),
        }
        self._waiting = [start["thrusts"][0].numpy()] * round(delay / LOOP)

    def hold(self, thrusts: Array, seconds: float) -> None:
        """Ask for thrusts (4,) [N] for some time."""
        for _ in range(round(seconds / LOOP)):
            self._waiting.append(thrusts)
            asked = {"cmd_motor_speeds": self._speeds(self._waiting.pop(0))}
            self.state = self.vehicle.step(self.state, asked, LOOP)

    def shown(self) -> TaskState:
        """What the task's sensors show, a batch of one."""
        x, y, z, w = self.state["q"]
        rotation = _matrix(np.array([w, x, y, z]))
        values = {
            "position": TO_NED @ self.state["x"],
            "velocity": TO_NED @ self.state["v"],
            "quaternion": _quaternion(TO_NED @ rotation * TO_FRD),
            "body_rates": TO_FRD * self.state["w"],
            "thrusts": self.thrust_per_square * self.state["rotor_speeds"] ** 2,
        }
        return {name: torch.from_numpy(value)[None] for name, value in values.items()}

    def _speeds(self, thrusts: Array) -> Array:
        return np.sqrt(np.maximum(thrusts, 0.0) / self.thrust_per_square)


def _matrix(quaternion: Array) -> Array:
    return matrix_from_quaternion(torch.from_numpy(quaternion)).numpy()


def _quaternion(rotation: Array) -> Array:
    """(w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]


def fly(task: Any, controller: Any, rng: np.random.Generator) -> dict[str, float]:
    """One flight: mass, delay, and the farthest from its place in the last second [m]."""
    mass, delay = rng.uniform(*MASSES), rng.uniform(*DELAYS)
    start = task.start(1, rng)
    rig, away = Rig(mass, delay, start), []
    for k in range(round(SECONDS / task.dt)):
        state = {**start, **rig.shown(), "step": torch.tensor([k])}
        with torch.no_grad():
            action = controller(task.observe(state), k).clamp(-1.0, 1.0)
        rig.hold((task.trim + task.span * action)[0].numpy(), task.dt)
        away.append(float(np.linalg.norm(rig.state["x"])))
    last = away[-round(1.0 / task.dt) :]
    return {"mass": mass, "delay_s": delay, "farthest_m": max(last), "at_end_m": last[-1]}


@one_thread
def main(argv: Sequence[str] | None = None) -> int:
    """Train, fly, say the worst."""
    parser = argparse.ArgumentParser(prog="python -m studies.learned", description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="default: %(default)s")
    parser.add_argument("--steps", type=int, default=STEPS, help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("runs/learned"))
    args = parser.parse_args(argv)
    ask_for(["rotorpy"], purpose="these flights")
    found = []
    for seed in range(args.seeds):
        tried = recipe(str(TASK))
        budget = {"steps": args.steps, "evaluate_every": args.steps}
        setup = tried.setup_of(str(TASK), seed=seed, **budget)
        learner = GradientLearner(setup, tried.gradient_options(**OPTIONS))
        began = time.process_time()
        run = train(setup, learner, args.out / f"seed_{seed}", show=False)
        spent = time.process_time() - began
        task: Task = setup.make_task()
        rng = np.random.default_rng([seed, 7])
        flights = [fly(task, learner.controller(), rng) for _ in range(FLIGHTS)]
        far = sorted(100.0 * flight["farthest_m"] for flight in flights)
        print(
            f"seed {seed}: reward {run.rows[-1]['reward']:.3f}, {spent:.1f} CPU s; farthest in the "
            f"last second [cm]: worst {far[-1]:.1f}, median {far[len(far) // 2]:.1f}",
            flush=True,
        )
        found.append({"seed": seed, "cpu_s": spent, "flights": flights})
    print(f"wrote {write_json_atomic(args.out / 'flights.json', found)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
