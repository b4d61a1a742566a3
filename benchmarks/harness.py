"""What a long benchmark needs: clocks, and stages of parts that are kept."""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch

from diffsim.core.files import read_kept, to_plain, write_json_atomic, write_text_atomic
from diffsim.core.progress import show_progress
from labs.machine import code_fingerprint, machine

Result = Any
T = TypeVar("T")


class Seconds(NamedTuple):
    """Wall time and CPU time (of all threads) of one call [s]."""

    wall: float
    cpu: float


def timed(call: Callable[[], T]) -> tuple[T, Seconds]:
    """The result of ``call`` and its time, with Python's garbage collector held back."""
    with no_garbage_collection():
        return _timed(call)


def repeat_for(call: Callable[[], object], *, seconds: float, at_most: int = 200) -> list[Seconds]:
    """Times of repeated calls, after one that is not counted; at least one."""
    call()
    times: list[Seconds] = []
    with no_garbage_collection():
        while not times or (sum(t.wall for t in times) < seconds and len(times) < at_most):
            times.append(_timed(call)[1])
    return times


def _timed(call: Callable[[], T]) -> tuple[T, Seconds]:
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, Seconds(time.perf_counter() - wall, time.process_time() - cpu)


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Collect young garbage now (all of it would take 0.2 s with torch), nothing in the block."""
    gc.collect(0)
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median and quartiles."""
    q1, median, q3 = np.percentile(np.asarray(values, float), [25, 50, 75])
    return {"median": float(median), "q1": float(q1), "q3": float(q3), "count": len(values)}


@contextmanager
def cores(count: int) -> Iterator[None]:
    """Keep this process on ``count`` of its cores, so that a thread count means what it says."""
    if not hasattr(os, "sched_setaffinity"):  # not Linux: the system decides
        yield
        return
    allowed = os.sched_getaffinity(0)
    # The last ones: interrupts and other people's work tend to gather on the first.
    os.sched_setaffinity(0, sorted(allowed)[-count:])
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


@dataclass(frozen=True)
class Part:
    """One piece of a benchmark that is measured as a whole and kept when it is done.

    Attributes:
        name: ``stage/what``, also its file name.
        settings: Everything its result depends on besides the code.
        compute: ``compute(results, say)``: results of earlier parts by name; ``say(text)`` shows
            what is being done.
    """

    name: str
    settings: dict[str, Any]
    compute: Callable[[dict[str, Result], Callable[[str], None]], Result]


@dataclass
class Store:
    """Finished parts of a run, one JSON file each.

    A part is taken from an earlier run only with ``resume``, and only if its settings and the
    code fingerprint are the same.
    """

    folder: Path
    fingerprint: str
    resume: bool
    results: dict[str, Result] = field(default_factory=dict)

    def run(self, parts: Sequence[Part]) -> None:
        """Compute what is missing, in order, under a progress bar."""
        first = parts[0].name if parts else ""
        with show_progress(desc=first, total=len(parts), unit="part", dynamic_ncols=True) as bar:
            for part in parts:
                bar.set_description(part.name)
                kept = self._read(part, bar.write) if self.resume else None
                if kept is None:
                    say = bar.set_postfix_str
                    kept = {
                        "settings": to_plain(part.settings),
                        "fingerprint": self.fingerprint,
                        "result": to_plain(part.compute(self.results, say)),
                    }
                    write_json_atomic(self._path(part), kept)
                    say("")
                self.results[part.name] = kept["result"]
                bar.update()

    def _path(self, part: Part) -> Path:
        return self.folder / f"{part.name.replace('/', '__')}.json"

    def _read(self, part: Part, say: Callable[[str], None]) -> dict[str, Any] | None:
        kept = read_kept(self._path(part))
        if kept is None:
            return None
        same = (kept["settings"], kept["fingerprint"]) == (
            to_plain(part.settings),
            self.fingerprint,
        )
        if not same:
            say(f"{part.name}: measured with other code or settings before, measuring anew")
        return kept if same else None


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """A benchmark of stages, each a list of parts; measured, kept, resumed and reported alike.

    Attributes:
        name: ``python -m benchmarks.NAME``; results go to ``runs/bench_NAME`` unless told.
        about: The command line's help.
        stages: Stage to the parts that a plan asks for. A plan is a dataclass; its fields that are
            called like a stage hold that stage's settings.
        collect: ``collect(results, plan)``: results of parts by name, as results.json shows them.
        draw: ``draw(results, folder)``: writes figures; their names without suffix.
        report: ``report(results, figures)``: tables in Markdown.
        rooms: Folders of the package whose change makes kept parts stale.
    """

    name: str
    about: str | None
    stages: Mapping[str, Callable[[Any], list[Part]]]
    collect: Callable[[dict[str, Result], Any], dict[str, Any]]
    report: Callable[[dict[str, Any], list[str]], str]
    rooms: tuple[str, ...]
    draw: Callable[[dict[str, Any], Path], list[str]] = lambda results, folder: []

    def run(
        self, plan: Any, out: Path, *, stages: Sequence[str] | None = None, resume: bool = False
    ) -> dict[str, Any]:
        """Measure stages (default all) and write the report; an interruption keeps what is done.

        Returns:
            What results.json holds.

        Raises:
            KeyboardInterrupt: after the report of the finished parts has been written.
        """
        torch.set_num_threads(1)  # the kernels' own threads are what is measured
        about = machine()
        stages = list(self.stages) if stages is None else stages
        store = Store(out / "parts", code_fingerprint(*self.rooms), resume)
        try:
            store.run([part for name in stages for part in self.stages[name](plan)])
        finally:
            settings = asdict(plan)
            skipped = set(self.stages) - set(stages)
            results = {
                "machine": {**about, "load_average_at_end": os.getloadavg()[0]},
                "plan": {name: v for name, v in settings.items() if name not in skipped},
                **self.collect(store.results, plan),
            }
            write_json_atomic(out / "results.json", results)
            figures = self.draw(results, out)
            write_text_atomic(out / "report.md", self.report(results, figures))
        return results

    def parser(self, quick: str) -> argparse.ArgumentParser:
        """Command line with --out, --stages, --quick (explained by ``quick``) and --resume."""
        parser = argparse.ArgumentParser(
            prog=f"python -m benchmarks.{self.name}",
            description=self.about,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        parser.add_argument("--out", type=Path, default=Path(f"runs/bench_{self.name}"))
        names = list(self.stages)
        parser.add_argument("--stages", nargs="+", choices=names, default=names)
        parser.add_argument("--quick", action="store_true", help=quick)
        parser.add_argument("--resume", action="store_true", help="keep finished parts")
        return parser

    def command(self, plan: Any, args: argparse.Namespace) -> int:
        """Run as the command line asks; the exit code."""
        try:
            self.run(plan, args.out, stages=args.stages, resume=args.resume)
        except KeyboardInterrupt:
            print(
                f"\ninterrupted; finished parts are in {args.out}, go on with --resume",
                file=sys.stderr,
            )
            return 130
        print(f"report: {args.out / 'report.md'}")
        return 0
