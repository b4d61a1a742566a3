"""The channel network's diagnosis case by case.

``python -m labs.cases.network OUT`` runs them.

Prints a row per case and writes the table so far to OUT (Markdown); ``--from`` and ``--to`` take
a part of the cases.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from diffsim.core.files import write_text_atomic
from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.say.report import Report
from labs.systems import setup_of
from labs.virtual import DECOYS, NetworkLab

Sizes = Mapping[str, float | tuple[float, ...] | None]
PLACED = {"meter_gain": 2, "blocked_branch": 0, "pressure_offset": 1}
"""Where the effects with a place are hidden."""
NAMES = {"pump_gain": "pump_gain_1"}  # in the library
Z90 = 1.645
COARSE = {"cells_per_width": 3.0, "corrected": False}


@dataclass(frozen=True)
class LabCase:
    """What is hidden and which verdicts are right.

    Only ``channels`` are kept, if given, and then no fitted run that commands a pressure. The
    report must say that it cannot see ``unseen``. ``coarse``: the grid is the cause to be named.
    """

    name: str
    seed: int
    hidden: Sizes = field(default_factory=dict)
    decoys: Sequence[str] = ()
    right: tuple[str, ...] = ("named", "ambiguous")
    channels: tuple[str, ...] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    unseen: tuple[str, ...] = ()
    coarse: bool = False


def hidden(name: str, times: float = 1.0) -> dict[str, tuple[float, ...]]:
    """An effect at some times its typical size, at its place."""
    effect = NetworkLab.effects[name]
    sizes = [0.0] * effect.components
    sizes[PLACED.get(name, 0)] = times * effect.typical
    return {name: tuple(sizes)}


def cases() -> Iterator[LabCase]:
    """All of the table."""
    for seed in range(1, 7):
        yield LabCase(f"null {seed}", seed, right=("none",))
    for k, name in enumerate(DECOYS):
        right = "unrepeatable" if name == "scatter" else "none"
        yield LabCase(f"decoy {name}", 20 + k, decoys=(name,), right=(right,))
    for k, (name, effect) in enumerate(NetworkLab.effects.items()):
        if not effect.outside:
            yield LabCase(name, 40 + k, hidden(name))
    for k, pair in enumerate([("thinning", "pressure_offset"), ("compliance", "meter_gain")]):
        both = hidden(pair[0]) | hidden(pair[1])
        yield LabCase(" + ".join(pair), 60 + k, both)
    for seed in (70, 71):
        yield LabCase(f"outside: cracking {seed}", seed, hidden("cracking"), right=("unknown",))
    flows = ("outlet_1_m3_s", "outlet_2_m3_s", "outlet_3_m3_s")
    yield LabCase("viscosity, no pressures", 80, hidden("viscosity"), right=("none",),
                  channels=flows, unseen=("viscosity",))  # fmt: skip
    yield LabCase("meter_gain, one meter only", 81, {"meter_gain": (0.06, 0.0, 0.0)},
                  right=("ambiguous",), channels=flows[:1])  # fmt: skip
    yield LabCase("coarse grid", 82, right=("numerical",), options=COARSE)
    accept = {**COARSE, "accept_numerics": True}
    yield LabCase("coarse grid, accepted", 83, options=accept, coarse=True)


def study_of(case: LabCase) -> Study:
    """The study of a case."""
    study = NetworkLab().case(case.seed, case.hidden, case.decoys).study
    if case.channels is None:
        return study
    keep = [i for i, c in enumerate(study.channels) if c.name in case.channels]
    # a commanded pressure would tell the viscosity, and a meter's gain from the pump's
    runs = tuple(
        replace(r, measured=r.measured[:, keep])
        for r in study.runs
        if r.use == "test" or not r.command["outlet_1_Pa"].any()
    )
    return replace(study, channels=tuple(study.channels[i] for i in keep), runs=runs)


def thinned(study: Study, every: int) -> Study:
    """The study with every n-th sample: its runs are steady from one to the next."""
    keep = slice(None, None, every)
    return replace(study, runs=tuple(run.part(keep) for run in study.runs))


def diagnosed(case: LabCase, every: int = 1, **options: Any) -> Report:
    """The report of a case, of every n-th sample of its runs."""
    study = thinned(study_of(case), every)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the shape is thinner than a cell")
        s = setup_of(study, **{**case.options, **options})
        return diagnose(
            study,
            s.model,
            s.effects,
            seed=0,
            unknowns=s.unknowns,
            bank=s.bank,
            settings=s.settings,
        )


def truth_of(case: LabCase) -> dict[str, float]:
    """Hidden sizes by the library's names."""
    # halving the cells takes away three quarters of an error of second order
    out = {"coarse_mesh": 4.0 / 3.0} if case.coarse else {}
    for name, sizes in case.hidden.items():
        count = NetworkLab.effects[name].components
        for i, size in enumerate(sizes if isinstance(sizes, tuple) else (sizes,)):
            if size:
                out[NAMES.get(name, name) if count == 1 else f"{name}_{i + 1}"] = float(size)
    return out


def judged(case: LabCase, report: Report) -> dict[str, Any]:
    """A row of the table."""
    truth = truth_of(case)
    sets = [set(report.named), *(set(r) for r in report.rivals)]
    sizes = {r.effect: (r.size["size"], r.sd["size"]) for r in report.table}
    inside = {
        n: abs(sizes[n][0] - size) <= Z90 * sizes[n][1]
        for n, size in truth.items()
        if n in report.named
    }
    expects_name = case.right[0] in ("named", "ambiguous")
    return {
        "case": case.name,
        "verdict": report.verdict,
        "named": " + ".join(report.named),
        "rivals": "; ".join(" + ".join(r) for r in report.rivals),
        "right": report.verdict in case.right
        and (not expects_name or set(truth) in sets)
        and set(case.unseen) <= set(report.cannot_see),
        "size": ", ".join(
            f"{sizes[n][0]:.3g} ± {sizes[n][1]:.2g} (hidden {v:.3g})"
            for n, v in truth.items()
            if n in sizes
        ),
        "in 90 %": ", ".join("yes" if ok else "no" for ok in inside.values()),
        "gain": ""
        if report.gain is None
        else f"{report.gain.value:.2f} [{report.gain.low:.2f}, {report.gain.high:.2f}]",
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--from", dest="first", type=int, default=0)
    parser.add_argument("--to", dest="last", type=int)
    args = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    for case in list(cases())[args.first : args.last]:
        start = time.process_time()
        row = judged(case, diagnosed(case))
        row["CPU s"] = f"{time.process_time() - start:.1f}"
        rows.append(row)
        print(row, flush=True)
        write_text_atomic(args.out, table(rows))  # as far as it goes


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown."""
    keys = list(rows[0])
    lines = [f"| {' | '.join(keys)} |", "|---" * len(keys) + "|"]
    for row in rows:
        shown = {**row, "right": "yes" if row["right"] else "**no**"}
        lines.append(f"| {' | '.join(shown[k] for k in keys)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
