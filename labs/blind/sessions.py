"""Sealed cases, each diagnosed in a process of its own that sees its data only."""

from __future__ import annotations

import argparse
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import diffsim
from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.core.errors import DiffsimError
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.core.progress import show_progress
from diffsim.core.runs import run_each
from diffsim.data.study_file import load_study
from labs.blind.score import score_answer, with_strength
from labs.blind.sealed import BENCHES, Bench, draw_label, is_sealed, open_label, seal
from labs.blind.sheets import held_sheets
from labs.blind.strength import score_simulated
from labs.blind.table import by_strength, confusion, figures, markdown
from labs.systems import setup_file

_KEPT_ENVIRONMENT = ("PATH", "LD_LIBRARY_PATH", "OMP_NUM_THREADS", "DIFFSIM_CORE", "LANG", "TMPDIR")


@dataclass(frozen=True)
class Blind:
    """A set of sealed cases on disk.

    Attributes:
        bench: The laboratory.
        name: Of the bench.
        seed: Of the cases.
        out: Folder: ``data/CASE``, ``answers/CASE.json``, ``scores/CASE.json``, the tables.
        vault: Labels, outside ``out``.
        kinds: Only such cases; all if empty.
        quick: Fewer refits.
        timeout_s: Per case.
        setup_file: Model of the laboratory; None: that of the studies.
        with_lambda: Score with the simulations that lambda takes.
        command: That made the cases, for the tables; empty: ``python -m labs.blind``.
    """

    bench: Bench
    name: str
    seed: int
    out: Path
    vault: Path
    kinds: tuple[str, ...] = ()
    quick: bool = False
    timeout_s: float = 3600.0
    setup_file: Path | None = None
    with_lambda: bool = True
    command: str = ""

    @property
    def data(self) -> Path:
        """What diagnoses may see."""
        return self.out / "data"

    def seal_all(self, count: int) -> list[str]:
        """Draw and seal the first cases; those that are sealed already stay."""
        rng = np.random.default_rng(self.seed)
        names = [f"case_{i:03d}" for i in range(count)]
        for case in names:
            label = draw_label(rng, self.bench, self.kinds)
            if not is_sealed(self.data, self.vault, case):
                seal(self.bench, label, self.data, self.vault, case)
        return names

    def answer(self, case: str) -> dict[str, Any]:
        """Diagnose a case in a process of its own; an answer that is there is kept."""
        path = self._answer_path(case)
        if not self._is_answered(case):
            path.parent.mkdir(parents=True, exist_ok=True)
            # a copy: nothing of the other cases lies beside what the process is given
            with tempfile.TemporaryDirectory(prefix="blind_") as room:
                folder = Path(room) / "study"
                shutil.copytree(self.data / case, folder)
                error = self._run(folder, Path(room) / "answer.json")
                if error is not None:
                    answer = {"verdict": "failed", "error": error, "timeout_s": self.timeout_s}
                else:
                    answer = json.loads((Path(room) / "answer.json").read_text("utf-8"))
            write_json_atomic(path, answer)
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return found

    def _answer_path(self, case: str) -> Path:
        return self.out / "answers" / f"{case}.json"

    def _is_answered(self, case: str) -> bool:
        """Whether an answer is there; a failure within less time than there is now is none."""
        path = self._answer_path(case)
        if not path.is_file():
            return False
        answer = json.loads(path.read_text(encoding="utf-8"))
        return bool(answer.get("timeout_s", np.inf) >= self.timeout_s)

    def _run(self, folder: Path, result: Path) -> str | None:
        """What went wrong, or None."""
        command = [sys.executable, "-m", "labs.blind.case", ".", str(result)]
        command += ["--quick"] if self.quick else []
        command += ["--setup", str(self.setup_file.resolve())] if self.setup_file else []
        kept = {name: os.environ[name] for name in _KEPT_ENVIRONMENT if name in os.environ}
        # the case's folder is where it runs: both diffsim and labs are found by path
        roots = [str(Path(diffsim.__file__).parents[1]), str(Path(__file__).parents[2])]
        paths = [*dict.fromkeys(roots), os.environ.get("PYTHONPATH", "")]
        environment = kept | {"PYTHONPATH": os.pathsep.join(p for p in paths if p)}
        try:
            status, said = _ended(command, folder, environment, self.timeout_s)
        except subprocess.TimeoutExpired:
            return f"no answer within {self.timeout_s:g} s"
        if status in (-signal.SIGINT, -signal.SIGTERM):
            raise KeyboardInterrupt  # no answer: the case is asked again
        if status:
            return f"status {status}: {(said.strip().splitlines() or ['no message'])[-1]}"
        return None

    def score(self, case: str) -> dict[str, Any]:
        """Diagnose and score a case; a score that is there is kept.

        Raises:
            ValueError: the label is not the one that was sealed.
        """
        path = self.out / "scores" / f"{case}.json"
        content = open_label(self.data, self.vault, case)
        label = content["label"]
        if not (path.is_file() and self._is_answered(case)):
            answer = self.answer(case)
            folder = self.data / case
            setup = inputs_of(load_study(folder), seed=0, setup_file=self.setup_file).setup
            sheets = held_sheets(self.bench, content["truth"], answer.get("sheets", {}))
            score = {"case": case, **score_answer(label, answer, setup.effects, sheets)}
            if self.with_lambda and label["effects"]:
                try:
                    score |= score_simulated(self.bench, label, folder, score, self.setup_file)
                except DiffsimError as error:
                    score["not_simulated"] = str(error)
            write_json_atomic(path, with_strength(score))
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return found

    def run(self, count: int, executor: Executor | None = None) -> list[dict[str, Any]]:
        """All cases; tables are written after each, so that an interruption loses one case.

        Args:
            count: Number of cases.
            executor: Executor of the cases, whose workers see ``out`` and ``vault``; None: one
                after another.
        """
        names = self.seal_all(count)
        scores: dict[int, dict[str, Any]] = {}
        with show_progress(total=count, desc="blind", unit="case") as bar:

            def keep(k: int, score: dict[str, Any]) -> None:
                scores[k] = score
                self.write([scores[i] for i in sorted(scores)])
                bar.update()

            return run_each(self.score, names, executor, done=keep)

    def write(self, scores: Sequence[Mapping[str, Any]]) -> Path:
        """confusion.json and confusion.md, the path of the latter."""
        content: dict[str, Any] = {"confusion": confusion(scores), "figures": figures(scores)}
        content["by_strength"] = by_strength(scores)
        write_json_atomic(self.out / "confusion.json", {**content, "seed": self.seed})
        command = f"python -m labs.blind --system {self.name} --n {len(scores)}"
        command += f" --seed {self.seed}" + (" --quick" if self.quick else "")
        command += f" --kinds {','.join(self.kinds)}" if self.kinds else ""
        cpu = [s["cpu_s"] for s in scores if s["cpu_s"] is not None]
        notes = [f"diffsim {diffsim.__version__}."]
        if cpu:
            notes.append(f"Processor time of a diagnosis: median {np.median(cpu):.0f} s.")
        text = markdown(
            scores,
            title=f"Sealed cases of the {self.name}",
            command=self.command or command,
            notes=notes,
        )
        return write_text_atomic(self.out / "confusion.md", text)


def _ended(
    command: list[str], folder: Path, environment: dict[str, str], timeout_s: float
) -> tuple[int, str]:
    """Exit status of a process, and what was said on stderr.

    Raises:
        subprocess.TimeoutExpired: it ran too long, and was ended.
    """
    process = subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        _, said = process.communicate(timeout=timeout_s)
    finally:  # an interruption, too
        if process.poll() is None:
            process.kill()
            process.wait()
    return process.returncode, said


def kept_scores(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """Scores of the finished cases of several sets.

    Args:
        folders: ``--out`` of each set.

    Raises:
        ValueError: a folder holds none.
    """
    out = []
    for folder in folders:
        found = sorted((folder / "scores").glob("*.json"))
        if not found:
            raise ValueError(f"{folder} holds no scores; give the folder that --out named")
        for path in found:
            score: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            out.append({**score, "case": f"{folder.name}/{score['case']}"})
    return out


def planned(args: argparse.Namespace) -> Blind:
    """The set of cases; an earlier one in --out is gone on with.

    Raises:
        ValueError: --out holds another set.
    """
    seed = secrets.randbits(31) if args.seed is None else args.seed
    out = args.out or Path("runs/blind") / f"{args.system}_{seed}"
    vault = args.vault or out.with_name(out.name + ".vault")
    # the plan holds the seed, from which every label follows: it belongs into the vault
    plan = vault / "plan.json"
    wanted = {"system": args.system, "kinds": list(args.kinds), "quick": args.quick}
    if plan.is_file():
        earlier = json.loads(plan.read_text(encoding="utf-8"))
        seed = earlier["seed"] if args.seed is None else seed
        if earlier != wanted | {"seed": seed}:
            raise ValueError(
                f"--out {out} holds other cases ({earlier}); choose another folder, or the same "
                "--system, --kinds, --quick and --seed"
            )
    write_json_atomic(plan, wanted | {"seed": seed})
    return Blind(
        BENCHES[args.system],
        args.system,
        seed,
        out,
        vault,
        args.kinds,
        args.quick,
        args.timeout,
        setup_file=args.setup or setup_file(args.system),
    )
