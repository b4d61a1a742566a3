"""Results with all digits: what a change of the code's structure must leave as it is.

python -m benchmarks.reference_numbers --out before.txt      everything, about four CPU minutes
python -m benchmarks.reference_numbers --only cantilever rolling_ball
python -m benchmarks.reference_numbers --without silicone_beam     two minutes
python -m benchmarks.reference_numbers --list

One ``name = value`` a line, in a fixed order; ``diff before.txt after.txt`` shows what changed.
Long arrays are shown as shape, norm and SHA-256 of their float64 (or int64) bytes. Lines that begin
with # say on what numbers depend besides the code: instruction set, processor, libraries. Numbers
of two instruction sets differ, so compare runs with the same ``DIFFSIM_ISA``. Everything runs in
one thread. CPU seconds of each item go to standard error. Items that need the measured data
(``DIFFSIM_DATA``) or an extra say so in place of their numbers where that is missing; the exit
status is then 1.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from diffsim.core import interruptible

Item = Callable[[], Mapping[str, Any]]
GROUPS = (
    "benchmarks.reference_simulators",
    "benchmarks.reference_copters",
    "benchmarks.reference_optimizers",
    "benchmarks.reference_systems",
)
"""Modules whose ``ITEMS`` hold functions by name, each of which returns its values by name."""
# Libraries read these when they are first loaded: sums in more threads round otherwise.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def items() -> dict[str, Item]:
    """All items by name, in the order in which they are printed."""
    found: dict[str, Item] = {}
    for group in GROUPS:
        found |= import_module(group).ITEMS
    return found


def header() -> Iterator[str]:
    """What numbers depend on besides the code, as comment lines."""
    import scipy

    from labs.machine import machine

    about = machine()
    for name in ("instruction_set", "cpu", "compiler", "python", "numpy", "torch"):
        yield f"# {name}: {about[name]}"
    yield f"# scipy: {scipy.__version__}"


def summary(item: Item) -> str:
    """The first line of its docstring."""
    return (item.__doc__ or "").partition("\n")[0]


def results(name: str, item: Item) -> tuple[list[str], bool]:
    """Lines of one item, and whether it could be computed."""
    from benchmarks.reference_values import lines_of

    lines = ["", f"# {name}: {summary(item)}"]
    try:
        return [*lines, *lines_of(name, item())], True
    except Exception as error:  # one item that a move has broken must not hide the others
        said = " ".join(str(error).split())
        return [*lines, f"{name} = not computed: {type(error).__name__}: {said}"], False


def cpu_seconds() -> float:
    """Of this process and the children that it has waited for [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def run(chosen: Mapping[str, Item], out: Path | None) -> int:
    """Print the items and write them to ``out``; the exit status."""
    import torch

    torch.set_num_threads(1)
    written = [*header()]
    print("\n".join(written), flush=True)
    complete = True
    for name, item in chosen.items():
        begin = cpu_seconds()
        lines, done = results(name, item)
        complete &= done
        print("\n".join(lines), flush=True)
        print(f"{name}: {cpu_seconds() - begin:.1f} CPU s", file=sys.stderr, flush=True)
        written += lines
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text("\n".join(written) + "\n", encoding="utf-8")
    return 0 if complete else 1


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; the exit status."""
    os.environ.update(dict.fromkeys(THREADS, "1"), TQDM_DISABLE="1")
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.reference_numbers",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help="these items")
    parser.add_argument("--without", nargs="+", metavar="NAME", default=[], help="not these")
    parser.add_argument("--out", type=Path, help="file that gets the same lines")
    parser.add_argument("--list", action="store_true", help="names of the items")
    args = parser.parse_args(arguments)
    known = items()
    if unknown := [name for name in (*args.only, *args.without) if name not in known]:
        parser.error(f"no item {', '.join(unknown)}; choose from {', '.join(known)}")
    if args.list:
        for name, item in known.items():
            print(f"{name:24s}{summary(item)}")
        return 0
    chosen = {name: known[name] for name in args.only or known if name not in args.without}
    return run(chosen, args.out)


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
