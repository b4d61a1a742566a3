"""Sealed cases of the beam, chosen: ``python -m labs.cases.beam OUT``.

``python -m labs.blind --system beam`` draws its cases; here every kind and most causes come
up, the most telling first. Labels go to ``OUT.vault``, and each diagnosis runs in a process that
sees its data only. One file per case is kept, the same command goes on; OUT/confusion.md has the
tables.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from labs.blind.sealed import BENCHES, is_sealed, seal
from labs.blind.sessions import Blind
from labs.systems import setup_file
from labs.virtual import SoftBeamLab

FINER_STEP = {"coarse": {"time_step": 0.5}}
FINER_MESH = {"coarse": {"mesh": 0.5}}
Label = dict[str, Any]


def labels() -> Iterator[Label]:
    """What is hidden, in order; a seed each, chosen before any was diagnosed."""
    bench = BENCHES["beam"]
    plan: list[Label] = []

    def add(kind: str, *names: str, times: float = 1.0, **more: Any) -> None:
        sizes = {name: [times * SoftBeamLab.effects[name].typical] for name in names}
        label = {"kind": kind, "effects": sizes, "decoys": [], "options": {}}
        plan.append({**label, "seed": 100 + len(plan), **more})

    add("null")
    add("single", "volume_drag")
    add("outside", "stop")
    add("single", "lag")
    add("single", "tilt")
    add("decoy", decoys=["spikes"])
    add("single", "temperature_drift")
    add("pair", "volume_drag", "tip_scale")
    add("null")
    add("single", "delay")
    add("single", "tension_backlash")
    add("single", "quadratic_volume_drag")
    add("null")
    add("single", "saturation")
    add("single", "sensor_scale")
    add("null")
    add("decoy", decoys=["scatter"])
    add("numerical", options={"coarse": dict(bench.coarse)})
    add("single", "lag", options=FINER_STEP)
    add("single", "volume_drag", options=FINER_STEP)
    add("single", "tension_dead_band")
    add("single", "added_mass", times=2.0)
    add("outside", "knock")
    add("single", "loss_factor")
    members, fold = bench.confounded[0]
    add("confounded", members[0], **{"class": list(members)}, blindfold=asdict(fold))
    add("single", "dry_friction")
    add("single", "stiffening")
    add("single", "tip_scale")
    add("single", "volume_drag", times=0.4)
    add("single", "tilt", times=0.5)
    add("decoy", decoys=["colored_noise"])
    add("decoy", decoys=["heavy_tails"])
    add("decoy", decoys=["far_prior"])
    add("pair", "lag", "tilt")
    add("single", "stiffness_damping")
    add("single", "quantization")
    add("outside", "current")
    add("single", "lag", options=FINER_MESH)
    yield from plan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--n", type=int, help="only so many of them")
    parser.add_argument("--kinds", nargs="+", default=(), help="only such cases, and what is there")
    parser.add_argument("--lambda", dest="strength", action="store_true", help="simulate lambda")
    args = parser.parse_args()
    vault = args.out.with_name(args.out.name + ".vault")
    blind = Blind(
        BENCHES["beam"],
        "beam",
        0,
        args.out,
        vault,
        setup_file=setup_file("beam"),
        with_lambda=args.strength,
        command=f"python -m labs.cases.beam {args.out}",
    )
    scores = []
    for i, label in enumerate(list(labels())[: args.n]):
        case = f"case_{i:03d}"
        is_scored = (args.out / "scores" / f"{case}.json").is_file()
        if args.kinds and label["kind"] not in args.kinds and not is_scored:
            continue
        if not is_sealed(blind.data, vault, case):
            seal(blind.bench, label, blind.data, vault, case)
        scores.append(blind.score(case))
        blind.write(scores)
        shown = ("kind", "truth", "verdict", "named", "rivals", "right", "sizes", "cpu_s")
        print(case, *(scores[-1][name] for name in shown), flush=True)


if __name__ == "__main__":
    main()
