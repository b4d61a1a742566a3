"""Answers of studies, idle and beside busy processes, byte by byte.

``python -m benchmarks.same_answer --out FOLDER`` for the published sets.

Each study is explained twice in processes of its own, the second time beside processes that do
nothing but compute. Verdict, evidence, sizes and the saved model must be equal to the last byte.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from diffsim.cli.arguments import described

FILES = ("report.json", "extended_model.yaml")
ROW = "{:20s} {:>10s} {:>10s}  {:s}"


@contextmanager
def busy(number: int) -> Iterator[None]:
    """Processes that compute until the block ends."""
    processes = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(number)
    ]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def explained(study: str, out: Path, budget: str) -> tuple[dict[str, str], float]:
    """Hash of every file of an answer made anew, and the CPU seconds of its process."""
    command = [sys.executable, "-m", "diffsim", "diagnose", "explain", study, "--out", str(out)]
    before = os.times()
    made = subprocess.run([*command, "--budget", budget], capture_output=True, text=True)
    after = os.times()
    if made.returncode:
        raise RuntimeError(f"{study}: {made.stderr.strip().splitlines()[-1]}")
    # a model is saved where causes are named
    hashes = {
        n: hashlib.sha256((out / n).read_bytes()).hexdigest() for n in FILES if (out / n).exists()
    }
    spent = (after.children_user + after.children_system) - (
        before.children_user + before.children_system
    )
    return hashes, spent


def main() -> None:
    """Print a row per study; the exit status says whether all are equal."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("studies", nargs="*", help="study.yaml, folder or published set")
    parser.add_argument("--out", type=Path, required=True, help="new folder of the answers")
    parser.add_argument("--budget", default="quick")
    parser.add_argument("--busy", type=int, default=3, help="processes beside the second answer")
    args = parser.parse_args()
    print(ROW.format("study", "CPU s", "beside", "answers"))
    differ = 0
    for study in args.studies or [path.stem for path in described()]:
        name = Path(study).stem
        try:
            first, quiet_s = explained(study, args.out / f"{name}-idle", args.budget)
            with busy(args.busy):
                second, beside_s = explained(study, args.out / f"{name}-busy", args.budget)
        except RuntimeError as error:
            print(error, flush=True)
            continue
        differ += first != second
        said = "equal" if first == second else "DIFFER"
        # what the busy processes took is theirs
        print(ROW.format(name, f"{quiet_s:.0f}", f"{beside_s:.0f}", said), flush=True)
    sys.exit(int(differ > 0))


if __name__ == "__main__":
    main()
