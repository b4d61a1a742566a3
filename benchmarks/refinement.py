"""How far does a result depend on its time step and its mesh? One table for six of them.

Same commands, solved again with half and a quarter of the time step, and on a finer mesh:
quadruped (its half, which is exact for its symmetric gait), cow (its half on the finer mesh), the
coarse ring, the coarse bunny, the swimmer, and the coarse creature. The bunny is thrown anew in
steps of an eighth, its loss the mean over these and half of them. Every run is kept;
docs/refinement.json holds the table that ``diffsim examples gallery`` writes into docs/gallery.md.

    python -m benchmarks.refinement --out docs/refinement.json
    python -m benchmarks.refinement --names cow swimmer --changes "as made" "step / 2"
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from diffsim import soft
from diffsim.cli.examples import FOLDER
from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic
from examples.applications import Application, minimize, solver_options
from examples.applications.table import OURS, load
from examples.gallery import REFINED
from labs.machine import machine

LEGGED = "newton_cholesky"  # takes a third of the time of ours on these, to the same tolerance
RTOL, FINER_RTOL = 1e-4, 1e-3  # of steps; the latter on the finer mesh
# Steps that the coarse bunny's are made of: it falls by a cell in one of 2 ms, and what an impact
# of so few steps leaves is theirs.
BUNNY_STEPS = 8


def _legged(name: str, steps: int, cells: int, half: bool) -> float:
    """Travel of a legged robot under the command that its script begins with [mm]."""
    solver = solver_options(LEGGED, rtol=RTOL if cells == 1 else FINER_RTOL)
    made = load(name).build(solver, False, steps, cells, half)
    return _travel(made, made.parameters.first)


def quadruped(out: Path, steps: int, cells: int) -> float:
    """Travel in one second [mm]."""
    return _legged("quadruped", steps, cells, half=True)


def cow(out: Path, steps: int, cells: int) -> float:
    """Travel in 0.6 s [mm]."""
    return _legged("cow", steps, cells, half=cells % 2 == 0)


def torus(out: Path, steps: int, cells: int) -> float:
    """Travel of the coarse ring in 0.8 s [mm]."""
    return _travel(*_optimized("torus", out, steps, cells))


def bunny(out: Path, steps: int, cells: int) -> float:
    """How far the thrown center of the coarse bunny gets [mm]."""
    module = load("bunny")
    solver = solver_options(OURS, rtol=module.RTOL)

    def made(steps: int, cells: int = 1) -> Application:
        return module.build(solver, True, BUNNY_STEPS * steps, cells)

    first, other = made(1), made(2)

    def loss(values: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        return 0.5 * (first.loss(values, x) + other.loss(values, other.simulate(values)))

    record = out / "bunny_of_two_steps.jsonl"
    found = minimize(replace(first, loss=loss), max_evaluations=8, record=record)
    thrown = made(steps, cells)
    with torch.no_grad():
        x = thrown.simulate(torch.tensor(found.best.values, dtype=torch.float64))
    assert thrown.follow is not None  # of the bunny
    print(f"distance from the target: {thrown.numbers(np.array(found.best.values), x)}")
    return 1e3 * float((thrown.follow(x[-1]) - thrown.follow(x[0])).norm())


def swimmer(out: Path, steps: int, cells: int) -> float:
    """Speed of the optimized gait [mm/s]."""
    module, kept = _story("softbody/swimmer.py"), out / "swimmer.json"
    if not kept.is_file():
        write_json_atomic(kept, module.optimized()[0]["optimized"]["knots"].tolist())
    raw = torch.tensor(json.loads(kept.read_text()), dtype=torch.float64)
    with torch.no_grad():
        return 1e3 * float(module.swim_speed(raw, steps=steps, cells=cells))


def creature(out: Path, steps: int, cells: int) -> float:
    """Where the right hand of the coarse creature is after a turn by 36 degrees in 0.2 s [mm]."""
    module = _story("softbody/twisting_armadillo.py")
    shape = module.make_mesh(module.SMALL["spacing"] / cells, None)
    turn = module.Turn(shape.x_rest)
    dt = module.DT / steps
    body = soft.SoftBody(
        shape,
        dt=dt,
        youngs_modulus=2e5,
        poissons_ratio=0.45,
        material="neo_hookean",
        fixed=turn.fixed,
        solver=soft.SolverOptions(rtol=1e-6),
    )
    hand = shape.x_rest[:, 0] < shape.x_rest[:, 0].min() + 0.03  # several nodes on any mesh
    weight = body.nodal_volume * hand
    state = body.rest_state()
    with torch.no_grad():
        for k in range(6 * steps):
            angle = torch.tensor(np.pi * (k + 1) * dt)  # half a turn in a second
            state = body(state, dirichlet_target=turn.target(angle))
    moved = (state.x - body.x_rest)[:, 1]
    return 1e3 * float(weight @ moved / weight.sum())


RESULTS: dict[str, tuple[Callable[[Path, int, int], float], str]] = {
    "quadruped": (quadruped, "travel in 1 s [mm]"),
    "cow": (cow, "travel in 0.6 s [mm]"),
    "torus": (torus, "travel in 0.8 s, coarse ring [mm]"),
    "bunny": (bunny, "way of the throw, coarse, steps of 0.25 ms [mm]"),
    "swimmer": (swimmer, "speed [mm/s]"),
    "creature": (creature, "sideways way of a hand, coarse [mm]"),
}
CHANGES = {"as made": (1, 1), "step / 2": (2, 1), "step / 4": (4, 1), "finer mesh": (1, 2)}
# a tendon lies in the middle of its cells, which halving would move
THIRDS = ("swimmer",)


def _optimized(name: str, out: Path, steps: int, cells: int) -> tuple[Application, np.ndarray]:
    """A coarse application, refined, and the command that was found as it is made."""
    module = load(name)
    solver = solver_options(OURS, rtol=module.RTOL)
    found = minimize(module.build(solver, True), max_evaluations=8, record=out / f"{name}.jsonl")
    return module.build(solver, True, steps, cells), np.array(found.best.values)


def _travel(made: Application, values: np.ndarray) -> float:
    return float(made.numbers(values, made.motion(values))["travel mm"])


def _story(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(path).stem, FOLDER / path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Run what is missing, and keep it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--names", nargs="+", choices=tuple(RESULTS), default=tuple(RESULTS))
    parser.add_argument("--changes", nargs="+", choices=tuple(CHANGES), default=tuple(CHANGES))
    parser.add_argument("--fresh", action="store_true", help="run again what is on record")
    parser.add_argument("--runs", type=Path, default=Path("runs/refinement"))
    parser.add_argument("--out", type=Path, default=FOLDER.parent / "docs" / REFINED)
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.runs.mkdir(parents=True, exist_ok=True)
    record: dict[str, Any] = json.loads(args.out.read_text()) if args.out.is_file() else {}
    for name in args.names:
        run, quantity = RESULTS[name]
        row = {} if args.fresh else record.get(name, {}).get("values", {})
        for change, (steps, cells) in CHANGES.items():
            if change in row or change not in args.changes:
                continue
            if cells > 1 and name in THIRDS:
                cells = 3
            begin = time.process_time()
            row[change] = run(args.runs, steps, cells)
            print(f"{name}, {change}: {row[change]:.4g}, {time.process_time() - begin:.0f} CPU s")
            record[name] = {"quantity": quantity, "values": row, "machine": machine()}
            write_json_atomic(args.out, {n: record[n] for n in RESULTS if n in record})


if __name__ == "__main__":
    with interruptible():
        main()
