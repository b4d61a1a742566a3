"""Time of a member, alone and among 288: a step of an ODE's tape, a pose of a rod.

python -m benchmarks.members                   the table of docs/benchmarks.md, two minutes
python -m benchmarks.members --rounds 1        quickly

The ODE is a pendulum with dry friction that a torque drives, by the classical Runge-Kutta method;
the rod that of benchmarks/rod_poses.py. With gradient: of all numbers. CPU time of one thread; the
instruction sets that are built take turns, a process each time; medians over rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

import torch

from benchmarks.harness import no_garbage_collection
from benchmarks.rod_poses import calls_of as rod_calls
from diffsim.core import interruptible
from diffsim.core.compiled import available
from diffsim.ode import Ode

COUNTS = (1, 288)
SETS = {"avx2": "AVX2", "avx512": "AVX-512"}
NUM_SAMPLES, DT = 501, 0.01  # of the ODE; [s]
LEAST = 0.2  # CPU time that calls of one kind are repeated for [s]

PENDULUM = Ode(
    rates={
        "angle": "speed",
        "speed": "(torque - damping*speed - friction*tanh(speed/0.02) - weight*sin(angle))/inertia",
    },
    readings={"measured": "angle + offset"},
    inputs=["torque"],
    parameters=["damping", "friction", "weight", "inertia", "offset"],
)
VALUES = (0.02, 0.05, 1.5, 0.03, 0.01)  # N m s, N m, N m, kg m^2, rad


def ode_calls(count: int) -> dict[str, Callable[[], object]]:
    """What is timed, of so many pendulums that differ by their friction."""
    times = DT * torch.arange(NUM_SAMPLES, dtype=torch.float64)
    torque = torch.sin(3.0 * times)[:, None]
    share = torch.linspace(0.8, 1.2, count, dtype=torch.float64)[:, None]
    values = torch.tensor(VALUES, dtype=torch.float64) * share
    start = torch.zeros(count, 2, dtype=torch.float64)
    wanted = [start.clone().requires_grad_(), values.clone().requires_grad_()]

    def differentiate() -> object:
        readings, _ = PENDULUM.solve(times, wanted[0], torque, wanted[1])
        return torch.autograd.grad(readings.square().sum(), wanted)

    return {
        "`ode`, step": lambda: PENDULUM.solve(times, start, torque, values),
        "`ode`, step with gradient": differentiate,
    }


def microseconds(call: Callable[[], object]) -> float:
    """CPU time of a call [us]."""
    call()
    repeats, spent = 0, 0.0
    with no_garbage_collection():
        while spent < LEAST:
            began = time.process_time()
            call()
            spent, repeats = spent + time.process_time() - began, repeats + 1
    return 1e6 * spent / repeats


def measure() -> dict[str, list[float]]:
    """Of each row, the time of a member alone and among many [us]."""
    torch.set_num_threads(1)
    found: dict[str, list[float]] = {}
    for count in COUNTS:
        for name, call in ode_calls(count).items():
            each = microseconds(call) / (count * (NUM_SAMPLES - 1))
            found.setdefault(name, []).append(each)
        for name, call in rod_calls(count).items():
            found.setdefault(name, []).append(microseconds(call) / count)
    return found


def measured_with(name: str) -> dict[str, list[float]]:
    """``measure`` in a process of its own, with another instruction set."""
    command = [sys.executable, "-m", "benchmarks.members", "--measure"]
    told = subprocess.run(
        command, env={**os.environ, "DIFFSIM_ISA": name}, stdout=subprocess.PIPE, check=True
    )
    found: dict[str, list[float]] = json.loads(told.stdout)
    return found


def table(rounds: int) -> str:
    """Rows for the documentation."""
    sets = [name for name in SETS if name in available()]
    found: dict[str, list[dict[str, list[float]]]] = {name: [] for name in sets}
    for _ in range(rounds):
        for name in sets:
            found[name].append(measured_with(name))
    heads = [f"{SETS[name]}, {n:d}" for name in sets for n in COUNTS]
    lines = [f"| us each | {' | '.join(heads)} |", "|---|" + "---:|" * len(heads)]
    for row in found[sets[0]][0]:
        cells = [
            f"{statistics.median(once[row][k] for once in found[name]):.3g}"
            for name in sets
            for k in range(len(COUNTS))
        ]
        lines.append(f"| {row} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--measure", action="store_true", help="one round with this set, as JSON")
    args = parser.parse_args(argv)
    if args.measure:
        print(json.dumps(measure()))
        return
    print(f"load {os.getloadavg()[0]:.0f} at the start", file=sys.stderr)
    print(table(args.rounds))


if __name__ == "__main__":
    with interruptible():
        main()
