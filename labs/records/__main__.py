"""``python -m labs.records``: damage sound records, and count what is named with which remedy."""

from __future__ import annotations

import argparse
import re
import secrets
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffsim.data.study_check import check_study
from diffsim.data.study_file import load_study
from diffsim.diagnose.checks.gates import require_separate
from diffsim.diagnose.checks.whole_record import model_problems
from diffsim.systems.registry import setup_of
from labs.records.damages import DAMAGES, damaged
from labs.records.rates import rates_page
from labs.records.rig import Folder
from labs.records.rigs import ALIKE, SOUND


def told(folder: Folder, room: Path) -> list[tuple[str, str, bool]]:
    """What is said of a folder: rule, sentence with remedy, and whether it stops."""
    folder.write(room)
    try:
        study = load_study(room)
    except ValueError as error:
        return [("reading", line, True) for line in str(error).splitlines()]
    found = [(p.rule or "check", p.message, p.severity == "error") for p in check_study(study)]
    try:
        require_separate(study)
    except ValueError as error:
        found.append(("copies", str(error), True))
    if not any(f[2] for f in found):
        asked = model_problems(study, setup_of(study))
        found += [(p.rule, p.message, True) for p in asked]
    return [f for f in found if f[2] or f[0] != "check"]


def main(argv: Sequence[str] | None = None) -> int:
    """Draw, damage, check and count.

    Args:
        argv: Arguments without the program's name; None takes the process's own.
    """
    parser = argparse.ArgumentParser(prog="python -m labs.records", description=__doc__)
    parser.add_argument("--n", type=int, default=4, help="copies of each damage (default: 4)")
    parser.add_argument("--seed", type=int, help="drawn afresh if not given")
    parser.add_argument("--only", help="damages whose name has this")
    parser.add_argument("--quiet", action="store_true", help="only counts")
    parser.add_argument("--keep", type=Path, help="write what was missed there")
    parser.add_argument("--sound", type=int, default=2, help="copies of each sound rig")
    parser.add_argument("--page", type=Path, help="write counts of faults and rules there")
    args = parser.parse_args(argv)
    seed = args.seed if args.seed is not None else secrets.randbelow(2**31)
    rng, started = np.random.default_rng(seed), time.process_time()
    named, stopped, total = Counter[str](), Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory(prefix="records_") as home:
        rooms = (Path(home) / str(k) for k in range(1_000_000))
        for damage in DAMAGES:
            if args.only and args.only not in damage.name:
                continue
            for _ in range(args.n):
                if (pair := damaged(rng, damage)) is None:
                    continue
                folder = pair[1]
                found = told(folder, next(rooms))
                total[damage.name] += 1
                right = [f for f in found if re.search(damage.remedy, f[1])]
                stopped[damage.name] += any(f[2] for f in found)
                named[damage.name] += bool(right)
                if not right and not args.quiet:
                    said = "; ".join(f"{f[0]}: {f[1]}"[:150] for f in found[:3]) or "nothing"
                    print(f"{damage.name} on {folder.study['name']}: {said}")
                    if args.keep:
                        folder.write(args.keep / f"{damage.name}_{total[damage.name]}")
        accused, folders = 0, 0
        for make in (*SOUND, *ALIKE) if not args.only else ():
            for _ in range(args.sound):
                folder = make(rng)
                found = told(folder, next(rooms))
                folders += 1
                accused += any(f[1].find("`") >= 0 for f in found)
                for f in found:
                    print(f"SOUND {folder.study['name']}: {f[0]} stops={f[2]}: {f[1][:200]}")
    for name, count in total.items():
        print(f"{name:<20} {named[name]:>3} named, {stopped[name]:>3} stopped of {count}")
    if args.page is not None:
        counts = {n: (named[n], stopped[n], total[n]) for n in total}
        with tempfile.TemporaryDirectory(prefix="records_") as home:
            page = rates_page(seed, args.sound, Path(home), counts)
        args.page.write_text(page, encoding="utf-8")
    count = sum(total.values())
    print(
        f"seed {seed}: {sum(named.values())} of {count} named with the right remedy, "
        f"{sum(stopped.values())} stopped; {accused} of {folders} sound folders accused; "
        f"{time.process_time() - started:.0f} CPU s"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
