"""Co-design against general solvers (thesis Fig. 3-3), and the payload pentacopter (Table 3.1).

python -m benchmarks.copter_codesign --quick         # a few minutes
python -m benchmarks.copter_codesign                 # five starts per case, an hour or so

Four cases, every method from the same starts. The general solvers get the thesis's problem (soft
hover, eq. 3.9, its weights in SI units) as published, with a maximum in the objective, and fairly
posed, with the maximum as constraints. Where they end is judged twice: by eq. 3.9, and by the
objective of hard hover with that shape and those directions (infinite: it does not hover).
Currents need the measured motors (DIFFSIM_DATA).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.copter_codesign_plots import draw, tables
from benchmarks.copter_soft_program import SoftProgram, solve_active_set, solve_scipy
from benchmarks.harness import Benchmark, Part
from diffsim.copter import load_design
from diffsim.copter.codesign import (
    AlternatingOptions,
    CoDesignError,
    CurrentModel,
    Demands,
    Limits,
    SearchOptions,
    codesign,
)
from diffsim.copter.codesign.alternating import Alternation, alternate, judge, most_controllable
from diffsim.copter.codesign.joint import FEASIBLE, random_point
from diffsim.copter.codesign.steps import thrust_step
from diffsim.copter.codesign.task import Point, Task
from diffsim.core import interruptible
from diffsim.core.paths import data_folder

OPTIONS = AlternatingOptions()  # eta = 0.3, mu = 0.7 as in the caption of Fig. 3-3
CASES: dict[str, tuple[str, dict[str, float]]] = {
    "pentacopter, payload": ("pentacopter", {"payload": 1.0}),
    "bunny, payload + amperage": ("bunny", {"payload": 1.0, "current": 1.0}),
    "pentacopter, max amperage + cost": ("pentacopter", {"max_current": 1.0, "cost": 1.0}),
    "quadcopter, size": ("quadcopter", {"size": 1.0}),
}
METHODS = (
    "joint (ours)",
    "alternating (Alg. 1)",
    "interior point, as published",
    "interior point, epigraph",
    "SQP, as published",
    "SQP, epigraph",
    "active set, epigraph",
)


@dataclass(frozen=True)
class Plan:
    """How much is measured."""

    num_starts: int = 5  # per case; the first is the design as it stands
    max_iters: int = 400  # of the general solvers
    max_rounds: int = 60  # of the alternation
    cases: tuple[str, ...] = tuple(CASES)  # which


QUICK = Plan(num_starts=1, max_iters=60, max_rounds=8)


def measured_current(inches: int) -> tuple[float, float]:
    """Scale and exponent of I = a u^alpha, least squares on the logarithms of a bench test."""
    folder = data_folder()
    path = (
        None
        if folder is None
        else folder / f"copter_reference/measurement/motor_{inches}inch_prop.txt"
    )
    if path is None or not path.is_file():
        raise FileNotFoundError(f"no bench test of the {inches} inch propeller; set DIFFSIM_DATA")
    table = np.loadtxt(path)
    thrust, current = table[:, 2], table[:, 4]
    used = (thrust > 0.5) & (current > 0.0)
    slope, level = np.polyfit(np.log(thrust[used]), np.log(current[used]), 1)
    return float(np.exp(level)), float(slope)


def currents_of(design: Any) -> CurrentModel:
    """Of every rotor: the two measured propellers, others between them by their radius."""
    (a10, e10), (a14, e14) = measured_current(10), measured_current(14)
    radii = design.multicopter(design.values).radii.detach().numpy()
    part = np.clip((radii / 0.0254 - 5.0) / 2.0, -0.5, 1.0)
    return CurrentModel(
        np.exp((1 - part) * np.log(a10) + part * np.log(a14)), (1 - part) * e10 + part * e14
    )


def task_of(name: str) -> Task:
    design_name, weights = CASES[name]
    design = load_design(design_name)
    needed = {"current", "max_current"} & set(weights)
    currents = currents_of(design) if needed else None
    return Task.of(design, weights, Demands(), Limits(), currents)


def starts_of(task: Task, count: int) -> list[Point]:
    """The design as it stands, then random ones, all with the spins of Alg. 1."""
    spins = most_controllable(task, task.start)
    rng = np.random.default_rng(0)
    points = [task.start, *(random_point(task, task.start, rng) for _ in range(count - 1))]
    return [replace(point, spins=spins) for point in points]


def run_method(task: Task, start: Point, method: str, plan: Plan) -> dict[str, Any]:
    """One method from one start: curve of eq. 3.9, times, and the end judged by hard hover."""
    cpu, wall = time.process_time(), time.perf_counter()
    options = replace(OPTIONS, max_rounds=plan.max_rounds)
    if method.startswith("joint"):
        found, _ = task.solve(start, max_iters=plan.max_iters)
        seconds = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
        value = found.value if found.violation <= FEASIBLE else float("inf")
        return {
            "curve": found.history,
            "times": found.seconds,
            "hard": value,
            "message": found.message,
            "iterations": found.num_iters,
            "hard_curve": True,
            **seconds,
        }
    if method.startswith("alternating"):
        ended = alternate(task, start, options)
        curve, times, message = ended.energies, ended.seconds, ended.status
    else:
        soft = SoftProgram(task, start.spins, OPTIONS, epigraph="epigraph" in method)
        first = soft.pack(start, thrust_step(task, start, OPTIONS.relative(soft.rotors)))
        if method.startswith("active set"):
            solved = solve_active_set(soft, first, plan.max_iters)
        else:
            name = "SLSQP" if method.startswith("SQP") else "trust-constr"
            solved = solve_scipy(soft, first, name, plan.max_iters)
        point, u = soft.unpack(solved["y"])
        curve, times, message = solved["energies"], solved["seconds"], solved["message"]
        curve = [*curve, soft.energy(solved["y"])]
        times = [*times, times[-1]]
        ended = Alternation(point, u, curve, times, message)
    seconds = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    return {
        "curve": curve,
        "times": times,
        "hard": judge(task, ended)[0],
        "message": message,
        "iterations": len(curve) - 1,
        "hard_curve": False,
        **seconds,
    }


def case_part(case: str, method: str, plan: Plan) -> Part:
    def compute(_: dict[str, Any], say: Any) -> list[dict[str, Any]]:
        task = task_of(case)
        runs = []
        for k, start in enumerate(starts_of(task, plan.num_starts)):
            say(f"start {k + 1} of {plan.num_starts}")
            try:
                runs.append(run_method(task, start, method, plan))
            except CoDesignError as error:
                runs.append({"failed": str(error)})
        return runs

    return Part(f"{case}/{method}", {"case": case, "method": method, **asdict(plan)}, compute)


def table_3_1(_: dict[str, Any], say: Any) -> dict[str, Any]:
    """The flat pentacopter and its payload-optimized twin; the shipped design is the flat one."""
    design = load_design("pentacopter")
    fixed = Limits(free=("attitude",))
    kept = Demands(authority=(0.5, 0.5, 0.05))
    rows = {}
    for name, settings in {
        "flat": {"limits": fixed, "search": SearchOptions(num_starts=4)},
        "tilt only": {"limits": Limits(free=("directions", "attitude"))},
        "optimized": {},
        "optimized, torque kept": {"demands": kept},
        "flat, torque kept": {
            "limits": fixed,
            "search": SearchOptions(num_starts=4),
            "demands": kept,
        },
    }.items():
        say(name)
        result = codesign(design, "payload", **settings)  # type: ignore[arg-type]
        positions = result.vehicle.positions
        span = (positions.max(0).values - positions.min(0).values).tolist()
        rows[name] = {
            "size": [1e3 * x for x in span[:2]],
            "weight": 1e3 * float(result.vehicle.mass),
            "payload": 1e3 * result.max_payload,
            "overall": 1e3 * (result.max_payload + float(result.vehicle.mass)),
            "angle": float(np.degrees(result.tilts.max())),
            "gap": result.gap,
            "seconds_per_start": float(np.median([s.seconds for s in result.starts])),
        }
    return rows


def collect(results: dict[str, Any], plan: Plan) -> dict[str, Any]:
    """Curves by case and method, None where not run; the rows of Table 3.1."""
    cases = {c: {m: results.get(f"{c}/{m}") for m in METHODS} for c in plan.cases}
    return {"comparison": cases, "table": results.get("table_3_1/all")}


def draw_figures(results: dict[str, Any], out: Path) -> list[str]:
    draw(results["comparison"], out / "fig_3_3")
    return ["fig_3_3"]


BENCHMARK = Benchmark(
    name="copter_codesign",
    about=__doc__,
    stages={
        "table": lambda plan: [Part("table_3_1/all", {}, table_3_1)],
        "comparison": lambda plan: [
            case_part(case, method, plan) for case in plan.cases for method in METHODS
        ],
    },
    collect=collect,
    draw=draw_figures,
    report=lambda results, figures: tables(results["comparison"], results["table"]),
    rooms=("copter", "mesh"),
)


def main(argv: Sequence[str] | None = None) -> int:
    parser = BENCHMARK.parser("one start, few iterations")
    parser.add_argument("--starts", type=int, help="starts per case")
    parser.add_argument("--max-iters", type=int, help="of the general solvers")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    args = parser.parse_args(argv)
    plan = replace(QUICK if args.quick else Plan(), cases=tuple(args.cases))
    if args.starts is not None:
        plan = replace(plan, num_starts=args.starts)
    if args.max_iters is not None:
        plan = replace(plan, max_iters=args.max_iters)
    return BENCHMARK.command(plan, args)


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
