"""Multicopters, all stages: co-design from many starts, gradients, flight.

python -m benchmarks.copter --quick          # half a minute
python -m benchmarks.copter                  # five minutes

Co-design: gain, spread over starts and time of the joint solve and of the thesis's alternation.
Gradients: against central differences of fourth order along one random direction, of the hover and
LQR layers, a flight under feedback, and the mass properties of every shipped design. Flight: steps
per CPU second from one vehicle to 4096. Medians with quartiles; the seconds per start are wall
times, which other programs disturb. The comparison with general solvers (thesis Fig. 3-3) is
``benchmarks.copter_codesign``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks import copter_control, copter_flight
from benchmarks.harness import Benchmark, Part, cores, repeat_for, spread
from diffsim.copter import Feedback, Multicopter, fly, load_design, shipped_designs
from diffsim.copter.codesign import CoDesignError, Limits, SearchOptions, codesign
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.core import interruptible

Say = Callable[[str], None]
CASES = {  # design, objective
    "pentacopter, payload": ("pentacopter", "payload"),
    "hexacopter, payload": ("y6_hexacopter", "payload"),
    "bunny, payload": ("bunny", "payload"),
    "quadcopter, size": ("quadcopter", "size"),
}


@dataclass(frozen=True)
class Plan:
    """How much is measured."""

    starts: int = 32  # of the joint solve, per case
    alternations: int = 4  # starts of the thesis's alternation, per case; 0 leaves it out
    batches: tuple[int, ...] = copter_flight.BATCHES  # vehicles in a flight
    seconds: float = 1.0  # of measurement per row


QUICK = Plan(starts=8, alternations=0, batches=(1, 64, 4096), seconds=0.2)


def codesign_part(case: str, method: str, plan: Plan) -> Part:
    """Gain of the best start, and how the starts spread; hover at the given shape is the base."""
    name, objective = CASES[case]
    count = plan.starts if method == "joint" else plan.alternations

    def compute(_: dict[str, Any], say: Say) -> dict[str, Any]:
        say(f"{count} starts")
        design = load_design(name)
        flat = codesign(
            design,
            objective,
            spins="given",
            limits=Limits(free=("attitude",)),
            search=SearchOptions(num_starts=1),
        )
        try:
            found = codesign(design, objective, method, search=SearchOptions(num_starts=count))
        except CoDesignError as error:
            return {"failed": str(error)}
        values = [s.value for s in found.starts]
        return {
            "gain": flat.objective / found.objective - 1.0,
            "gap": found.gap,
            "within_percent": float(np.mean(np.array(values) <= 1.01 * found.objective)),
            "infeasible": sum(not np.isfinite(v) for v in values),
            "starts": len(values),
            "seconds": spread([s.seconds for s in found.starts]),
            "hover_residual": found.hover_residual,
        }

    return Part(f"codesign/{case}, {method}", {"starts": count}, compute)


def gradients(_: dict[str, Any], say: Say) -> dict[str, float]:
    """Relative errors of directional derivatives."""
    errors = {}
    for num_rotors in (4, 6, 8):
        say(f"hover and LQR, {num_rotors} rotors")
        copter = copter_control.design(num_rotors)
        problem = copter_control.hover_arguments(copter)
        regulator = copter_control.lqr_arguments(copter)
        errors[f"hover, {num_rotors} rotors"] = copter_control.gradient_error(
            copter_control.thrusts, problem, 1e-4
        )
        errors[f"LQR, {num_rotors} rotors"] = copter_control.gradient_error(
            lambda *a: tuple(copter_control.lqr(*a)), regulator, 1e-5
        )
    say("flight")
    errors["flight, 1 s under feedback"] = copter_control.gradient_error(*flight_layer(), 1e-4)
    for name in shipped_designs():
        say(name)
        errors[f"mass properties, {name}"] = copter_control.gradient_error(*mass_layer(name), 1e-3)
    return errors


def flight_layer() -> tuple[Callable[..., tuple[Tensor, ...]], list[Tensor]]:
    """Where a quadcopter is during a second, from commands, gain, mass, arms and inertia."""
    vehicle, K = copter_flight.quadcopter(), copter_flight.gain()
    start = FlightState.at_rest(torch.tensor([[0.1, -0.1, 0.05]], dtype=torch.float64))
    hover = (vehicle.weight / 4).expand(1, 200, 4).contiguous()

    def layer(
        commands: Tensor, K: Tensor, mass: Tensor, positions: Tensor, inertia: Tensor
    ) -> tuple[Tensor, ...]:
        copter = vehicle.replace(mass=mass, positions=positions, inertia=inertia)
        loop = Feedback(gain=K, reference=torch.zeros(12, dtype=torch.float64))
        state = fly(copter, start, commands, dt=5e-3, feedback=loop).state
        return state.position, state.quaternion

    return layer, [hover, K, vehicle.mass, vehicle.positions, vehicle.inertia]


def mass_layer(name: str) -> tuple[Callable[..., tuple[Tensor, ...]], list[Tensor]]:
    """Mass, inertia and rotors' places of a shipped design from its free parameters."""
    design = replace(load_design(name), bounded=False)  # differences step over bounds

    def layer(s: Tensor) -> tuple[Tensor, ...]:
        copter: Multicopter = design.multicopter(s)
        return copter.mass, copter.inertia, copter.positions

    return layer, [design.values]


def flight_part(kind: str, batch: int, seconds: float) -> Part:
    """Vehicle-steps per CPU second, forward and with gradient."""
    steps = 100

    def compute(_: dict[str, Any], say: Say) -> dict[str, Any]:
        torch.manual_seed(0)
        rates = {}
        with cores(1):
            for name, call in copter_flight.passes(batch, steps, kind, 1).items():
                say(name)
                times = spread([t.cpu for t in repeat_for(call, seconds=seconds)])
                rates[name] = {k: batch * steps / times[k] for k in ("median", "q1", "q3")}
        return rates

    return Part(f"flight/{kind}, {batch}", {"steps": steps, "seconds": seconds}, compute)


def flight_parts(plan: Plan) -> list[Part]:
    """Bare and with effects, from one vehicle to many."""
    kinds = ("bare", "drag, wind, lag")
    return [flight_part(kind, batch, plan.seconds) for kind in kinds for batch in plan.batches]


def codesign_parts(plan: Plan) -> list[Part]:
    """The joint solve, and the thesis's alternation if asked for."""
    methods = ("joint", "alternating") if plan.alternations else ("joint",)
    return [codesign_part(case, method, plan) for method in methods for case in CASES]


def collect(results: dict[str, Any], plan: Plan) -> dict[str, Any]:
    """Results by stage and name."""
    found: dict[str, Any] = {}
    for name, result in results.items():
        stage, _, what = name.partition("/")
        found.setdefault(stage, {})[what] = result
    return found


def report(results: dict[str, Any], figures: Sequence[str] = ()) -> str:
    """Tables in Markdown."""
    lines = ["# Multicopters", "", "## Gradients against differences of fourth order", ""]
    lines += ["| layer | relative error |", "|---|---|"]
    lines += [f"| {k} | {v:.1e} |" for k, v in results.get("gradients", {}).get("all", {}).items()]
    lines += ["", "## Flight, one thread, million vehicle-steps per CPU second", ""]
    lines += ["| effects, vehicles | forward | forward, end alone | forward + backward |"]
    lines += ["|---|---|---|---|"]
    for name, row in results.get("flight", {}).items():
        cells = (
            f"{1e-6 * r['median']:.3f} ({1e-6 * r['q3']:.3f} to {1e-6 * r['q1']:.3f})"
            for r in row.values()
        )
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", "## Co-design", ""]
    lines += [
        "| case, method | design as it stands / optimum - 1 | gap to the bound | starts within 1 % "
        "| infeasible | wall seconds per start |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in results.get("codesign", {}).items():
        if "failed" in row:
            lines.append(f"| {name} | failed: {row['failed']} | | | | |")
            continue
        seconds = row["seconds"]
        gap = "no bound" if row["gap"] is None else f"{100.0 * row['gap']:.2g} %"
        lines.append(
            f"| {name} | {100.0 * row['gain']:+.1f} % | {gap} "
            f"| {100.0 * row['within_percent']:.0f} % of {row['starts']} | {row['infeasible']} "
            f"| {seconds['median']:.3f} ({seconds['q1']:.3f} to {seconds['q3']:.3f}) |"
        )
    return "\n".join(lines) + "\n"


BENCHMARK = Benchmark(
    name="copter",
    about=__doc__,
    stages={
        "gradients": lambda plan: [Part("gradients/all", {}, gradients)],
        "flight": flight_parts,
        "codesign": codesign_parts,
    },
    collect=collect,
    report=report,
    rooms=("copter", "mesh"),
)


def main(argv: Sequence[str] | None = None) -> int:
    args = BENCHMARK.parser("fewer starts, batches and repeats").parse_args(argv)
    return BENCHMARK.command(QUICK if args.quick else Plan(), args)


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
