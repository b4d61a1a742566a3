"""Are mistakes seen? Plants errors, one at a time, and runs the tests that should see each.

``planted_errors.yaml`` holds mistakes as a developer makes them, over all rooms of the package and
the kernels: a sign in an adjoint, a unit, a window off by one, a frame the wrong way round, an
option that is ignored, test runs that leak into a fit. Each names its file, the text that is
replaced, and the tests that should fail. Every error is planted in a copy of the tree of its own;
an error in ``csrc`` is compiled there. One that no test sees is missed, and is a finding: it stays
in the plan. A suite that became shorter should catch as many as before::

    python -m benchmarks.planted_errors                       # all, kept one by one
    python -m benchmarks.planted_errors --only svd-gap-sign --fresh
    python -m benchmarks.planted_errors --against v0.1        # the same errors in another commit
    python -m benchmarks.planted_errors --table               # of what docs/planted_errors holds
    python -m benchmarks.planted_errors --draw 7 --num 60     # errors nobody chose, from a seed

What is done is kept until the error, the file it is planted in, or a test of its selection
changes; what a change elsewhere does is seen with ``--fresh``. Errors in ``csrc`` need nanobind and
cmeel-eigen in the running Python (see CONTRIBUTING.md); without them they are left out, and said
so. CPU seconds are those of pytest and of all that it starts, to the first failure.

Why not mutmut or cosmic-ray: both change Python alone, and a third of what can go wrong is C++.
Their operators swap ``+`` and ``-`` or a constant, everywhere: thousands of mutants, a run of tests
of 5 to 15 CPU seconds for each, so that one numerical module takes hours. Many of them are no
mistakes, for a tolerance, a preconditioner, a first guess or a cache may be changed and every
answer stays right; someone has to read which. What hurts this package are mistakes of meaning
(another frame, another clock, a test run among those that were fitted), which are not one token.
For a module of pure decisions, such as ``diffsim/diagnose/judge/judge.py``, mutmut would do; it was
not needed to compare two states of one suite.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import io
import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Any, NamedTuple

import yaml

from benchmarks import drawn_errors
from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic
from labs.machine import machine

ROOT = Path(__file__).resolve().parents[1]
PLAN = Path(__file__).with_suffix(".yaml")
KEPT = ROOT / "docs" / "planted_errors"  # records of suites: NAME.json heads a column "NAME"
OBJECTS = ROOT / "build" / "planted_errors"  # objects of the kernels, as setup.py keeps them
LIMIT_S = 600.0  # wall time of one run of tests
NEEDED = {"nanobind": "nanobind", "cmeel": "cmeel-eigen"}  # module: package, to compile
SLOW_IMPORTS = ("torch", "scipy.optimize", "scipy.sparse.linalg", "trimesh", "pydantic", "pytest")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
CAUGHT, MISSED = "caught", "missed"
# Of a run of tests, or of the plan itself.
UNFIT, UNBUILT, RED = "error of the plan", "not compiled", "tests fail without it"


class PlanError(ValueError):
    """The plan does not fit the tree: an error to be mended in the plan."""


@dataclass(frozen=True, kw_only=True)
class Planted:
    """One mistake and where it should be seen."""

    name: str  # short name, another one for each
    file: str  # file of the tree
    old: str  # text that occurs once in it
    new: str  # text that stands there with the mistake
    means: str  # the mistake in words
    tests: tuple[str, ...]  # files or folders of tests that should see it
    only: str = ""  # pytest's ``-k``; empty: all of them

    @property
    def room(self) -> str:
        """Folder of the package or beside it, or of the kernels with "csrc/" before it."""
        parts = Path(self.file).parts
        return f"csrc/{parts[2]}" if parts[0] == "csrc" else parts[1]

    @property
    def is_compiled(self) -> bool:
        """Whether the kernels have to be built for it."""
        return self.file.startswith("csrc/")

    @property
    def selection(self) -> tuple[str, ...]:
        """Arguments of pytest."""
        return (*self.tests, *(("-k", self.only) if self.only else ()))


def read_plan(path: Path = PLAN) -> tuple[Planted, ...]:
    """All errors of the plan.

    Raises:
        PlanError: two errors of one name, or one that changes nothing.
    """
    rows = yaml.safe_load(path.read_text(encoding="utf-8"))
    plan = tuple(Planted(**{**row, "tests": tuple(row["tests"])}) for row in rows)
    names = [error.name for error in plan]
    if doubled := {name for name in names if names.count(name) > 1}:
        raise PlanError(f"{path}: names must differ, got {sorted(doubled)} more than once")
    if idle := [error.name for error in plan if error.old == error.new]:
        raise PlanError(f"{path}: {idle} change nothing")
    return plan


def planted_text(error: Planted, tree: Path) -> str:
    """The file with the mistake in it.

    Raises:
        PlanError: no such file, or its text does not hold the old one exactly once.
    """
    path = tree / error.file
    if not path.is_file():
        raise PlanError(f"{error.name}: no file {error.file}; mend the plan")
    text = path.read_text(encoding="utf-8")
    if (count := text.count(error.old)) != 1:
        raise PlanError(
            f"{error.name}: {error.file} must hold its old text once, found {count} times; mend "
            "the plan"
        )
    return text.replace(error.old, error.new)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a run of tests."""

    state: str  # "caught" or "missed"; or why neither is known
    cpu_s: float = 0.0  # CPU seconds of the tests, to the first failure [s]
    by: str = ""  # the first test that failed, or what else was seen
    key: str = ""  # what it depends on
    build_s: float = 0.0  # CPU seconds of compiling what the error changed, and of linking [s]


class Ended(NamedTuple):
    """A process that has ended: exit status (negative: signal), output, CPU time [s]."""

    status: int
    output: str
    cpu_s: float
    is_late: bool


def run_limited(
    command: Sequence[str], folder: Path, env: Mapping[str, str], limit: float
) -> Ended:
    """Run a command in a session of its own, all of which ends with it or with its time."""
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            command, cwd=folder, env=env, stdout=output, stderr=output, start_new_session=True
        )
        until, is_late = time.monotonic() + limit, False
        try:
            while True:
                done, status, usage = os.wait4(process.pid, os.WNOHANG)
                if done:
                    break
                if time.monotonic() > until and not is_late:
                    is_late = True
                    os.killpg(process.pid, signal.SIGKILL)
                time.sleep(0.05)
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        text = output.read().decode("utf-8", "replace")
    return Ended(process.returncode, text, usage.ru_utime + usage.ru_stime, is_late)


def environment_of(tree: Path) -> dict[str, str]:
    """Variables under which a copy imports itself, on one thread."""
    return {
        **os.environ,
        **ONE_THREAD,
        "PYTHONPATH": str(tree),
        # objects one by one: an error changes one of them
        "DIFFSIM_UNITY": "0",
        "DIFFSIM_BUILD_ISA": "native",
    }


class WarmTests:
    """Runs tests in forks of a process that has imported torch (``warm_pytest``).

    Args:
        folder: Where outputs go.
        warm: Modules that are imported once.
    """

    def __init__(self, folder: Path, warm: Sequence[str] = SLOW_IMPORTS):
        self._output = folder / f"output_{id(self)}.txt"
        self._server = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("warm_pytest.py")), *warm],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **ONE_THREAD},
            start_new_session=True,
            bufsize=0,  # what is read ahead would hide from select
        )

    def outcome(self, tree: Path, selection: Sequence[str], limit: float) -> Outcome:
        """Run tests in a copy until one fails."""
        # in one process, where pytest-xdist is there and the project's options ask for more
        serial = ["-n0"] if importlib.util.find_spec("xdist") else []
        ways = ["-x", "-q", "--tb=no", "-p", "no:cacheprovider", "-rfE"]
        ended = self._run(tree, [*selection, *serial, *ways], limit)
        if ended.is_late:
            return Outcome(state=CAUGHT, cpu_s=ended.cpu_s, by=f"not over after {limit:g} s")
        if ended.status < 0:
            name = signal.Signals(-ended.status).name
            return Outcome(state=CAUGHT, cpu_s=ended.cpu_s, by=f"ended by {name}")
        last = ended.output.strip().rpartition("\n")[2]
        # 4: of a test that is asked for by name the file cannot be imported
        is_broken = ended.status == 4 and re.search(r"^ERROR \S+\.py", ended.output, re.MULTILINE)
        if ended.status in (1, 2) or is_broken:
            found = re.search(r"^(?:FAILED|ERROR) (\S+?):?(?: |$)", ended.output, re.MULTILINE)
            return Outcome(state=CAUGHT, cpu_s=ended.cpu_s, by=found[1] if found else last)
        if ended.status == 0:
            return Outcome(state=MISSED, cpu_s=ended.cpu_s)
        return Outcome(state=UNFIT, by=f"pytest: {last}")

    def _run(self, tree: Path, arguments: Sequence[str], limit: float) -> Ended:
        job = {
            "tree": str(tree),
            "arguments": list(arguments),
            "environment": environment_of(tree),
            "output": str(self._output),
        }
        assert self._server.stdin is not None and self._server.stdout is not None  # both are pipes
        self._server.stdin.write(json.dumps(job).encode() + b"\n")
        process = json.loads(self._server.stdout.readline())["process"]
        is_late = not select.select([self._server.stdout], [], [], limit)[0]
        if is_late:
            os.killpg(process, signal.SIGKILL)
        ended = json.loads(self._server.stdout.readline())
        text = self._output.read_text("utf-8", "replace") if self._output.is_file() else ""
        return Ended(ended["status"], text, ended["cpu_s"], is_late)

    def end(self) -> None:
        """End the process."""
        self._server.communicate()


def build(tree: Path) -> tuple[str, float]:
    """Compile what changed in a copy: empty, or the compiler's last words; and the CPU time [s]."""
    command = [sys.executable, "setup.py", "build_ext", "--inplace"]
    ended = run_limited(command, tree, environment_of(tree), 3600.0)
    if ended.status == 0:
        return "", ended.cpu_s
    lines = ended.output.strip().splitlines() or ["no output"]
    return next((line for line in lines if ": error: " in line), lines[-1]), ended.cpu_s


def lacking() -> list[str]:
    """Packages that compiling needs and the running Python lacks."""
    return [pack for module, pack in NEEDED.items() if not importlib.util.find_spec(module)]


def copy_of_checkout(target: Path) -> None:
    """The working tree: what git tracks or would, and the compiled cores."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    names = [name for name in listed.stdout.decode().split("\0") if name]
    cores = [str(p.relative_to(ROOT)) for p in (ROOT / "diffsim").glob("_core_*.so")]
    for name in (*names, *cores):
        if not (ROOT / name).is_file():
            continue  # deleted, and not yet committed
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target / name)


def copy_of_commit(reference: str, target: Path) -> None:
    """The tree of a commit; its cores are compiled."""
    packed = subprocess.run(
        ["git", "archive", "--format=tar", reference], cwd=ROOT, capture_output=True, check=True
    )
    with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
        if hasattr(tarfile, "data_filter"):
            archive.extraction_filter = tarfile.data_filter
        archive.extractall(target)


def share_objects(tree: Path, *, apart: bool) -> None:
    """Give a copy the objects that are compiled already; ``apart``: files of its own."""
    known = ROOT / "build" / "objects"
    if not OBJECTS.is_dir():
        shutil.copytree(known, OBJECTS) if known.is_dir() else OBJECTS.mkdir(parents=True)
    place = tree / "build" / "objects"
    place.parent.mkdir(exist_ok=True)
    if apart:
        shutil.copytree(OBJECTS, place)
    else:
        place.symlink_to(OBJECTS)


def untouched_tree(folder: Path, reference: str | None, *, compiles: bool) -> Path:
    """A copy without mistakes, which copies with one are made of.

    Raises:
        PlanError: the package that is imported there is another one.
        RuntimeError: it does not compile.
    """
    tree = folder / "untouched"
    tree.mkdir()
    if reference is None:
        copy_of_checkout(tree)
    else:
        copy_of_commit(reference, tree)
    if compiles:
        share_objects(tree, apart=False)
        if failed := build(tree)[0]:
            raise RuntimeError(f"the tree does not compile without a mistake: {failed}")
        shutil.rmtree(tree / "build", ignore_errors=True)
    asked = [sys.executable, "-c", "import diffsim.core.compiled as c; print(c.core.__file__)"]
    ended = run_limited(asked, tree, environment_of(tree), 120.0)
    if ended.status or str(tree) not in ended.output:
        raise PlanError(f"the copy does not import its own package: {ended.output.strip()}")
    return tree


@contextmanager
def copy_with(error: Planted, untouched: Path, folder: Path) -> Iterator[Path]:
    """A copy of the tree with one mistake in it."""
    text = planted_text(error, untouched)
    tree = folder / error.name
    shutil.copytree(untouched, tree, symlinks=True)
    try:
        (tree / error.file).write_text(text, encoding="utf-8")
        # a cached file of the same second and size would pass for current, wherever it is kept
        kept = Path(importlib.util.cache_from_source(str(tree / error.file)))
        for cached in kept.parent.glob(f"{Path(error.file).stem}.*"):
            cached.unlink()
        yield tree
    finally:
        shutil.rmtree(tree, ignore_errors=True)


def try_one(
    error: Planted, untouched: Path, folder: Path, tests: WarmTests, limit: float
) -> Outcome:
    """Plant one error and run its tests."""
    build_s = 0.0
    try:
        with copy_with(error, untouched, folder) as tree:
            if error.is_compiled:
                share_objects(tree, apart=True)
                failed, build_s = build(tree)
                if failed:
                    return Outcome(state=UNFIT, by=f"does not compile: {failed}")
            found = tests.outcome(tree, error.selection, limit)
            return replace(found, build_s=build_s)
    except PlanError as mistake:
        return Outcome(state=UNFIT, by=str(mistake))


def with_tests_of(error: Planted, tree: Path) -> Planted:
    """The error without tests that another commit does not have; as it is where it has none."""
    there = tuple(t for t in error.tests if (tree / t.partition("::")[0]).exists())
    return replace(error, tests=there or error.tests)


def digest(*parts: object) -> str:
    """What tells contents apart."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def texts_of(tree: Path, names: Sequence[str]) -> list[str]:
    """Contents of files and of the Python files in folders; of "tests/x.py::test" those of x."""
    out = []
    for name in names:
        path = tree / name.partition("::")[0]
        files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
        out += [p.read_text(encoding="utf-8") for p in files if p.is_file()]
    return out


def key_of(error: Planted, tree: Path) -> str:
    """What a kept outcome depends on: the error, its file, its tests."""
    return digest(asdict(error), texts_of(tree, [error.file, *error.tests]))


@dataclass
class Record:
    """Outcomes by error, and of the tests without one, kept in a file as they come.

    Attributes:
        path: The file.
        about: What was run, and where.
        errors: Outcomes by name of the error, with its room and meaning.
        clean: Outcomes of selections without a mistake, by their arguments.
    """

    path: Path
    about: dict[str, Any]
    errors: dict[str, dict[str, Any]] = field(default_factory=dict)
    clean: dict[str, dict[str, Any]] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)

    @classmethod
    def at(cls, path: Path, about: dict[str, Any], *, fresh: bool) -> Record:
        """The record of an earlier run, or an empty one."""
        kept = json.loads(path.read_text()) if path.is_file() and not fresh else {}
        return cls(path, about, kept.get("errors", {}), kept.get("clean", {}))

    def save(self) -> None:
        """Write what is there."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        ordered = {k: dict(sorted(getattr(self, k).items())) for k in ("errors", "clean")}
        write_json_atomic(self.path, {"about": self.about, **ordered})

    def keep(self, plan: Sequence[Planted]) -> None:
        """Drop what is not in the plan any more."""
        names = {error.name for error in plan}
        self.errors = {n: row for n, row in self.errors.items() if n in names}

    def add(self, error: Planted, outcome: Outcome) -> None:
        """Keep the outcome of an error."""
        with self.lock:
            self.errors[error.name] = {
                "room": error.room, "means": error.means, **asdict(outcome)
            }  # fmt: skip
            self.save()

    def is_known(self, error: Planted, key: str) -> bool:
        """Whether an error was tried with these contents."""
        kept = self.errors.get(error.name, {})
        return kept.get("key") == key and kept["state"] in (CAUGHT, MISSED)

    def clean_outcome(self, error: Planted, tree: Path, tests: WarmTests, limit: float) -> Outcome:
        """What the tests of an error say without it, once for each selection."""
        name, key = " ".join(error.selection), digest(texts_of(tree, error.tests))
        with self.lock:
            kept = self.clean.get(name)
            if kept is None or kept["key"] != key or kept["state"] != MISSED:
                kept = asdict(replace(tests.outcome(tree, error.selection, limit), key=key))
                self.clean[name] = kept
                self.save()
        return Outcome(**kept)


def outcome_of(
    error: Planted,
    record: Record,
    untouched: Path,
    folder: Path,
    tests: WarmTests,
    limit: float,
) -> Outcome:
    """The outcome of an error; the test that failed was seen to pass without it."""
    if error.is_compiled and (missing := lacking()):
        how = f"pip install -c constraints.txt {' '.join(missing)}"
        return Outcome(state=UNBUILT, by=how)
    found = try_one(error, untouched, folder, tests, limit)
    if found.state != CAUGHT:
        return found
    if (untouched / found.by.partition("::")[0]).is_file():  # a test, and no word of a signal
        test = found.by.partition("[")[0]
        how = ("--collect-only",) if test.endswith(".py") else ()  # it could not be imported
        error = replace(error, tests=(test, *how), only="")
    clean = record.clean_outcome(error, untouched, tests, limit)
    return found if clean.state == MISSED else Outcome(state=RED, by=clean.by)


def run_plan(
    plan: Sequence[Planted], record: Record, reference: str | None, *, jobs: int, limit: float
) -> None:
    """Try all errors that the record does not know yet."""
    compiles = reference is not None or any(e.is_compiled for e in plan)
    if compiles and lacking() and reference is None:
        compiles = False
    with tempfile.TemporaryDirectory(prefix="planted_errors_") as temporary:
        folder = Path(temporary)
        untouched = untouched_tree(folder, reference, compiles=compiles)
        if reference is not None:
            plan = [with_tests_of(error, untouched) for error in plan]
        keys = {error.name: key_of(error, untouched) for error in plan}
        left = [error for error in plan if not record.is_known(error, keys[error.name])]
        print(f"{len(plan)} errors, {len(plan) - len(left)} known from before", flush=True)

        idle: SimpleQueue[WarmTests] = SimpleQueue()
        every = [WarmTests(folder) for _ in range(jobs)]
        for tests in every:
            idle.put(tests)

        def do(error: Planted) -> None:
            tests = idle.get()
            try:
                outcome = outcome_of(error, record, untouched, folder, tests, limit)
            finally:
                idle.put(tests)
            record.add(error, replace(outcome, key=keys[error.name]))
            said = f"{error.name}: {outcome.state}, {outcome.cpu_s:.1f} CPU s  {outcome.by}"
            print(said.rstrip(), flush=True)

        with ThreadPoolExecutor(max_workers=jobs) as pool:
            try:
                for done in [pool.submit(do, error) for error in left]:
                    done.result()
            except BaseException:  # what is under way comes to its end, and is kept
                pool.shutdown(wait=True, cancel_futures=True)
                raise
            finally:
                for tests in every:
                    tests.end()


def table(records: Mapping[str, Mapping[str, Any]]) -> str:
    """By room: errors planted, and how many each record has caught; Markdown.

    Args:
        records: Contents of records by the name that heads their column.
    """
    rooms: dict[str, set[str]] = {}
    for record in records.values():
        for name, row in record["errors"].items():
            rooms.setdefault(row["room"], set()).add(name)
    heads = ["room", "planted", *(f"caught, {label}" for label in records)]
    lines = [heads, ["---", *["---:"] * (len(heads) - 1)]]
    everything = {name for names in rooms.values() for name in names}
    for room, names in [*sorted(rooms.items()), ("**all**", everything)]:
        counts = [_num_caught(record, names) for record in records.values()]
        lines.append([room, str(len(names)), *counts])
    missed = [f"Missed, {label}: {_missed(record)}." for label, record in records.items()]
    return "\n".join([*(f"| {' | '.join(line)} |" for line in lines), "", *missed])


def _num_caught(record: Mapping[str, Any], names: set[str]) -> str:
    """How many of some errors a record has caught; "-" where it tried none."""
    states = [record["errors"][name]["state"] for name in names if name in record["errors"]]
    return str(states.count(CAUGHT)) if states else "-"


def _missed(record: Mapping[str, Any]) -> str:
    """Names of what was not caught."""
    rows = record["errors"].items()
    names = [f"`{n}` ({r['means']})" for n, r in sorted(rows) if r["state"] == MISSED]
    other = [f"`{n}` ({r['state']})" for n, r in sorted(rows) if r["state"] not in (CAUGHT, MISSED)]
    return ", ".join([*names, *other]) or "none"


def read_records(paths: Sequence[Path]) -> dict[str, Any]:
    """Records by the names of their files, the oldest first."""
    read = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths}
    return dict(sorted(read.items(), key=lambda item: item[1]["about"]["date"]))


def commit_of(reference: str | None) -> str:
    """Short name of a commit; of the working tree, that it has changes."""
    if reference is None:
        return str(machine()["commit"])
    asked = ["git", "rev-parse", "--short=12", f"{reference}^{{commit}}"]
    done = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise PlanError(f"--against: git knows no commit {reference!r}")
    return done.stdout.strip()


def drawn_plan(args: argparse.Namespace) -> tuple[Planted, ...]:
    """Errors drawn from ``--draw``, whose record is a file of its own."""
    drawn = drawn_errors.draw(args.draw, args.num, args.nearest)
    args.out = args.out.with_name(f"drawn_errors_{args.draw}.json")
    return tuple(Planted(**error._asdict()) for error in drawn)


def shares_caught(record: Record, harmless: Mapping[str, str]) -> str:
    """Which share of drawn errors was caught, without those that change no answer; two lines."""
    tried = {n: r for n, r in record.errors.items() if r["state"] in (CAUGHT, MISSED)}
    lines = []
    for part, is_kernel in (("Python", False), ("kernels", True)):
        names = [n for n, r in tried.items() if r["room"].startswith("csrc/") == is_kernel]
        counted = [tried[n]["state"] for n in names if n not in harmless]
        caught = counted.count(CAUGHT)
        tests_s, build_s = (
            sum(tried[n].get(key, 0.0) for n in names) / max(len(names), 1)
            for key in ("cpu_s", "build_s")
        )
        lines.append(
            f"{part}: caught {caught} of {len(counted)} "
            f"({100.0 * caught / max(len(counted), 1):.0f} %); {tests_s:.0f} CPU s each, "
            f"{build_s:.0f} more to compile; "
            f"{len(names) - len(counted)} change no answer ({drawn_errors.HARMLESS.name})"
        )
    return "\n".join(lines)


def main(given: Sequence[str] | None = None) -> int:
    """Run the plan, or show a table of what was run; 1 if the plan has errors of its own."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.planted_errors", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="errors or rooms, in this order")
    parser.add_argument("--jobs", type=int, default=1, help="errors at a time (default: 1)")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="of one run of tests [s]")
    parser.add_argument("--against", metavar="REF", help="plant them in the tree of a commit")
    parser.add_argument("--draw", type=int, metavar="SEED", help="errors drawn over all files")
    parser.add_argument("--num", type=int, default=60, help="number of drawn ones (default: 60)")
    parser.add_argument(
        "--nearest", type=int, metavar="N", help="of drawn ones: only the N nearest test files"
    )
    parser.add_argument("--fresh", action="store_true", help="run again what is kept")
    parser.add_argument("--out", type=Path, default=Path("runs/planted_errors.json"))
    parser.add_argument(
        "--table",
        nargs="*",
        type=Path,
        metavar="FILE",
        help="print the table of records (default: docs/planted_errors/*.json), run nothing",
    )
    args = parser.parse_args(given)
    if args.table is not None:
        print(table(read_records(args.table or sorted(KEPT.glob("*.json")))))
        return 0
    try:
        plan = read_plan() if args.draw is None else drawn_plan(args)
        if args.only:
            known = {e.name for e in plan} | {e.room for e in plan}
            if unknown := set(args.only) - known:
                raise PlanError(f"--only: no errors or rooms {sorted(unknown)} in {PLAN.name}")
            asked = [e for word in args.only for e in plan if word in (e.name, e.room)]
            plan = tuple(dict.fromkeys(asked))
        about = {**machine(), "commit": commit_of(args.against)}
        record = Record.at(args.out, about, fresh=args.fresh)
        if not args.only:
            record.keep(plan)
        run_plan(plan, record, args.against, jobs=args.jobs, limit=args.limit)
    except PlanError as error:
        print(error, file=sys.stderr)
        return 1
    record.save()
    print(f"\n{table({args.out.stem: {'errors': record.errors}})}\n\nwritten to {args.out}")
    if args.draw is not None:
        print(shares_caught(record, drawn_errors.read_harmless()))
    return int(any(record.errors[e.name]["state"] == UNFIT for e in plan))


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
