"""Fresh toy cases and their verdicts: `python -m tests.diagnose.confusion SEED`."""

import argparse
import json
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.cli.arguments import add_executor
from diffsim.core import interruptible, open_executor, run_each
from diffsim.diagnose import diagnose
from diffsim.identify import SimModel, Whitener, fit
from tests.diagnose import toy

Case = dict[str, Any]
OUTSIDE = {"pulse": 0.3, "stop": 3.0, "tide": 0.25}


def cases(seed: int, scale: int = 1) -> Iterator[Case]:
    """72 cases at scale 1, sizes and seeds drawn from ``seed``."""
    rng = np.random.default_rng(seed)

    def case(kind: str, hidden: dict[str, float] | None = None, **options: Any) -> Case:
        return {
            "kind": kind,
            "seed": int(rng.integers(2**31)),
            "hidden": hidden or {},
            "options": options,
        }

    def size(effect: Any) -> float:
        # a softening spring may run away
        both = effect.signed and effect.name != "stiffening"
        sign = rng.choice([-1.0, 1.0]) if both else 1.0
        return float(sign * effect.typical * np.exp(rng.uniform(np.log(0.05), np.log(0.8))))

    for _ in range(scale):
        for _ in range(10):
            yield case("null")
        for option in (
            {"tails": True},
            {"spikes": True},
            {"color": 0.7},
            {"far_base": 1.5},
            {"lost_repeat": True},
        ):
            for _ in range(2):
                yield case("decoy", **option)
        for effect in toy.LIBRARY:
            for _ in range(3):
                yield case("single", {effect.name: size(effect)})
        for name, large in OUTSIDE.items():
            for _ in range(3):
                yield case("outside", {name: large * rng.uniform(0.5, 1.0)})
        for _ in range(5):
            a, b = rng.choice(len(toy.LIBRARY), 2, replace=False)
            pair = [toy.LIBRARY[a], toy.LIBRARY[b]]
            yield case("pair", {e.name: float(np.sign(size(e)) * 0.5 * e.typical) for e in pair})
        for _ in range(5):
            yield case("unrepeatable", scatter=rng.uniform(0.1, 0.2))
        for _ in range(4):
            yield case("numerical")
        for _ in range(5):
            yield case("twins", {"delay": rng.uniform(0.01, 0.03)})


def solve(case: Case) -> Case:
    """The case with the verdict; lambda of single effects from noise-free data."""
    started = time.process_time()
    study = toy.generate(case["seed"], case["hidden"], **case["options"])
    step = 0.02 if case["kind"] == "numerical" else None
    library = toy.LIBRARY + ((toy.CLOCK_OFFSET,) if case["kind"] == "twins" else ())
    model = toy.model(study.runs, step)
    report = diagnose(study, model, library, seed=0, unknowns=[toy.unknown_force()])
    out = {
        **case,
        "verdict": report.verdict,
        "named": sorted(report.named),
        "rivals": [sorted(r) for r in report.rivals],
        "scatter": float(np.max(report.noise["scatter_ratio"])),
        "top": [(h.effects, h.unknown, round(h.nats, 1)) for h in report.hypotheses[:4]],
        "gain": None
        if report.gain is None
        else [report.gain.value, report.gain.low, report.gain.high, report.gain.excess],
    }
    out["simulations"] = report.settings["work"]["simulations"]
    out["cpu_s"] = time.process_time() - started
    rows = {r.effect: r for r in report.table}
    hidden = case["hidden"]
    if case["kind"] in ("single", "pair"):
        out["size"] = {n: rows[n].size["size"] for n in hidden}
        out["sd"] = {n: rows[n].sd["size"] for n in hidden}
    if case["kind"] in ("single", "pair", "outside"):
        out["lambda"] = lambdas(case, model, report.null.problem.whitener)
    return out


def lambdas(case: Case, model: SimModel, whitener: Whitener) -> dict[str, float]:
    """|W (truth - refit without this effect)| on noise-free data, by hidden effect."""
    clean = toy.generate(case["seed"], case["hidden"], noise=0.0)
    out = {}
    for name in case["hidden"]:
        others = [e for e in toy.LIBRARY if e.name in case["hidden"] and e.name != name]
        left = fit(model, clean.fit_runs, clean.channels, effects=others, whitener=whitener)
        out[name] = float(np.sqrt(left.chi2))
    return out


def is_right(case: Case) -> bool:
    """The verdict asked for, with the truth alone or in the set."""
    truth, verdict, kind = sorted(case["hidden"]), case["verdict"], case["kind"]
    if kind in ("null", "decoy"):
        return verdict == "none"
    if kind in ("single", "pair", "twins"):
        if kind == "twins" and verdict != "ambiguous":
            return False
        sets = [case["named"], *case["rivals"]]
        return verdict in ("named", "ambiguous") and truth in sets
    return verdict == {"outside": "unknown"}.get(kind, kind)


def main() -> None:
    """Print the table; write all cases as JSON lines."""
    parser = argparse.ArgumentParser()
    parser.add_argument("seed", type=int)
    parser.add_argument("--scale", type=int, default=1)
    add_executor(parser, "cases")
    parser.add_argument(
        "--out", default="runs/confusion.jsonl", help="of one seed; a part is completed"
    )
    args = parser.parse_args()
    path = Path(args.out)
    path.parent.mkdir(parents=True, exist_ok=True)
    done = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    plan = list(cases(args.seed, args.scale))
    # in random order: a run that is cut short still saw every kind; each has a seed of its own
    plan = [plan[i] for i in np.random.default_rng(args.seed).permutation(len(plan))]
    solved = {case["seed"] for case in done}
    with open_executor(args.executor) as executor, path.open("a") as file:

        def keep(_: int, case: Case) -> None:
            case["right"] = is_right(case)
            done.append(case)
            file.write(json.dumps(case) + "\n")
            file.flush()

        missing = [case for case in plan if case["seed"] not in solved]
        run_each(solve, missing, executor, done=keep)
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for case in done:
        table[case["kind"]][case["verdict"]] += 1
        table[case["kind"]]["right"] += case["right"]
    for kind, counts in table.items():
        print(f"{kind:14s}", dict(counts))


if __name__ == "__main__":
    with interruptible("the same command goes on"):
        main()
