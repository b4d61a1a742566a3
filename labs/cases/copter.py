"""Causes hidden in the copter laboratory, and their verdicts.

``python -m labs.cases.copter OUT.jsonl [first [last]]`` appends a line
per case; with ``table OUT.jsonl`` it prints them as a table.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np

from diffsim.diagnose import diagnose
from labs.systems import setup_of
from labs.virtual import DECOYS, CopterLab

Case = dict[str, Any]
HALF = {"body_drag": 0.12, "lag": 0.015}
SINGLES: dict[str, Any] = {
    "body_drag": None,
    "wind": [0.2, -0.2],
    "center_of_mass": [0.003, -0.004],
    "lag": None,
    "body_tilt": [0.015, -0.01],
    "gyroscopic": None,
    "ground_effect": None,
    "delay": None,
    "parasitic_drag": None,
    "voltage_exponent": None,
    "weak_rotor": [0.0, 0.05, 0.0, 0.0],
    "inflow": None,
    "thrust_curvature": None,
    "accelerometer_scale": None,
    "gyro_offset": [0.01, -0.02, 0.01],
    "quantization": None,
}
NAMES = {"weak_rotor": "weak_rotor_2"}  # in the library


def cases() -> list[Case]:
    """All, the most telling first; a seed each."""
    plan: list[Case] = []

    def add(kind: str, hidden: dict[str, Any] | None = None, **options: Any) -> None:
        case = {"kind": kind, "seed": 100 + len(plan), "hidden": hidden or {}}
        plan.append(case | {"options": options})

    singles = list(SINGLES.items())
    for name, size in singles[:4]:
        add("single", {name: size})
    add("null")
    add("outside", {"updraught": None})
    for name, size in singles[4:10]:
        add("single", {name: size})
    add("null")
    add("pair", HALF)
    for name, size in singles[10:15]:
        add("single", {name: size})
    add("null")
    add("pair", {"wind": [0.1, 0.1], "inflow": 0.015})
    add("twins", {"wind": [0.2, 0.2]}, turns=False)
    for decoy in DECOYS:
        add("decoy", decoys=[decoy])
    add("null")
    add("single", {"quantization": None})
    add("outside", {"updraught": 0.4})
    return plan


def solve(case: Case) -> Case:
    """The case with its verdict and how near the sizes are."""
    options = dict(case["options"])
    lab = CopterLab(turns=options.pop("turns", True))
    made = lab.case(case["seed"], case["hidden"], **options)
    setup = setup_of(made.study)
    begin = time.process_time()
    report = diagnose(
        made.study,
        setup.model,
        setup.effects,
        seed=0,
        unknowns=setup.unknowns,
        bank=setup.bank,
        settings=setup.settings,
    )
    rows = {row.effect: row for row in report.table}
    sizes = {}
    for name, truth in made.truth["effects"].items():
        row = rows.get(NAMES.get(name, name))
        if row is not None:
            true = [t for t in truth if t] if name == "weak_rotor" else list(truth)
            sizes[name] = [
                (t, float(s), float(d))
                for t, s, d in zip(true, row.size.values(), row.sd.values(), strict=True)
            ]
    gain = report.gain
    return case | {
        "verdict": report.verdict,
        "named": sorted(report.named),
        "rivals": [sorted(r) for r in report.rivals],
        "sizes": sizes,
        "inside": all(abs(s - t) <= 1.645 * d for v in sizes.values() for t, s, d in v),
        "gain": None if gain is None else [gain.value, gain.low, gain.high],
        "chi2": [report.chi2_null, report.chi2_best, report.num_samples],
        "top": [(h.effects, h.unknown, round(float(h.nats), 1)) for h in report.hypotheses[:5]],
        "gates": {g.name: g.value for g in report.gates if not g.name.startswith("gradient")},
        "failed_gates": [g.name for g in report.gates if not g.passed],
        "next_run": None if report.next_run is None else report.next_run.best,
        "next_over_median": None if report.next_run is None else report.next_run.over_median,
        "scatter": float(np.nanmax(report.noise["scatter_ratio"])),
        "cpu_s": time.process_time() - begin,
    }


def is_right(case: Case) -> bool:
    """The verdict asked for; the truth alone, or for twins in the set."""
    kind, verdict = case["kind"], case["verdict"]
    truth = sorted(NAMES.get(name, name) for name in case["hidden"])
    if kind in ("null", "decoy"):
        scatter = "scatter" in case["options"].get("decoys", ())
        return verdict == ("unrepeatable" if scatter else "none")
    if kind == "twins":
        return verdict == "ambiguous" and truth in [case["named"], *case["rivals"]]
    if kind == "outside":
        return verdict == "unknown"
    return verdict in ("named", "ambiguous") and truth in [case["named"], *case["rivals"]]


def table(path: str) -> None:
    """Markdown."""
    print("| kind | hidden | verdict | true, found +- 90 % | held-out gain | right | CPU s |")
    print("|---|---|---|---|---|---|---|")
    with open(path) as file:
        done = [json.loads(line) for line in file]
    for case in sorted(done, key=lambda c: c["number"]):
        hidden = ", ".join([*case["hidden"], *case["options"].get("decoys", ())]) or "-"
        named = " + ".join(case["named"])
        rivals = "".join(f" or {' + '.join(r) or 'an unknown cause'}" for r in case["rivals"])
        sizes = "; ".join(
            f"{t:g}, {s:.4g} +- {1.645 * d:.2g}" for v in case["sizes"].values() for t, s, d in v
        )
        gain = "-" if case["gain"] is None else "{:.3f} ({:.3f} to {:.3f})".format(*case["gain"])
        found = f"{case['verdict']} {named}{rivals}".strip()
        right = "yes" if case["right"] else "**no**"
        print(
            f"| {case['kind']} | {hidden} | {found} | {sizes} | {gain} | {right} "
            f"| {case['cpu_s']:.0f} |"
        )


def main() -> None:
    """Append the cases to a file."""
    if sys.argv[1] == "table":
        table(sys.argv[2])
        return
    path = sys.argv[1]
    first, last = ([int(a) for a in sys.argv[2:4]] + [0, 10**6][len(sys.argv) - 2 :])[:2]
    for number, case in enumerate(cases()):
        if first <= number < last:
            done = solve(case)
            done["right"] = is_right(done)
            with open(path, "a") as file:
                file.write(json.dumps({"number": number} | done, default=str) + "\n")
            print(number, done["kind"], done["hidden"], done["verdict"], done["named"], flush=True)


if __name__ == "__main__":
    main()
