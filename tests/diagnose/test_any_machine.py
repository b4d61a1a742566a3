"""The same answer on any machine: beside a busy process, by a clock that lies, on more threads."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from diffsim.data.study_save import save_study
from diffsim.diagnose.say.tables import hypothesis_rows
from diffsim.diagnose.search.evidence import Hypothesis, SetPosterior
from tests import warm
from tests.cli import test_diagnose
from tests.diagnose import linear, toy

RUNS = ("chirp_a", "steps_a", "held_a")
BUDGET = "8e3"  # ends before all that could win is fitted
LYING = """
import time
for name in ("process_time", "perf_counter", "monotonic", "thread_time"):
    real = getattr(time, name)
    setattr(time, name, lambda real=real: 10.0 * real())
"""
BUSY = """
import time
while True:
    sum(range(200_000))
    time.sleep(0.005)
"""
EXPLAIN = """
import sys
sys.modules |= dict.fromkeys(("matplotlib", "plotly", "rerun"))  # pictures take longer than this
from diffsim.cli import main
study, out, setup, budget, threads = sys.argv[1:]
raise SystemExit(main(["diagnose", "explain", study, "--out", out, "--setup", setup,
                       "--budget", budget, "--threads", threads]))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("any_machine") / "study"
    study = toy.generate(2, {"drag": 0.2, "bias": 0.1})
    save_study(replace(study, runs=tuple(r for r in study.runs if r.name in RUNS)), folder)
    return folder


def words_of(folder: Path, out: Path, *, before: str = "", threads: int = 1) -> list[str]:
    given = [str(folder), str(out), test_diagnose.SETUP, BUDGET, str(threads)]
    return ["-c", before + EXPLAIN, *given]


def answer_in(out: Path) -> dict[str, bytes]:
    return {n: (out / n).read_bytes() for n in ("report.json", "extended_model.yaml")}


@pytest.fixture(scope="module")
def quiet(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("quiet")
    warm.python(*words_of(folder, out), check=True, timeout=300)
    return answer_in(out)


def test_the_budget_ended_the_search(quiet):
    report = json.loads(quiet["report.json"])
    assert "refit_budget" in {gate["name"] for gate in report["gates"]}
    assert report["settings"]["work"]["steps"] > float(BUDGET)


@pytest.mark.cpu(9)  # one diagnosis; a busy process runs beside it
@pytest.mark.serial
def test_beside_a_busy_process_on_two_threads_by_a_lying_clock_every_byte_is_the_same(
    folder, quiet, tmp_path
):
    """A clock that runs ten times as fast: what reads it for a budget ends elsewhere."""
    busy = subprocess.Popen([sys.executable, "-c", BUSY])
    words = words_of(folder, tmp_path, before=LYING, threads=2)
    try:  # an interpreter of its own: the clock lies before diffsim is loaded
        subprocess.run([sys.executable, *words], check=True, timeout=300)
    finally:
        busy.kill()
        busy.wait()
    assert answer_in(tmp_path) == quiet


def test_sets_that_only_rounding_tells_apart_stand_in_the_order_in_which_they_were_weighed():
    effects = [linear.line("push"), linear.line("pull")]
    sets = [Hypothesis(frozenset({k})) for k in (0, 1)]
    for less, more in ((1.0, 1.0 + 1e-12), (1.0 + 1e-12, 1.0)):
        at = np.zeros(2)
        weighed = {
            h: SetPosterior(nats, at, at, chi2=0.0, amplitude=0.0)
            for h, nats in zip(sets, (less, more), strict=True)
        }
        search = SimpleNamespace(posteriors={}, linear=weighed, nats=lambda _: 0.0)
        assert [row.effects for row in hypothesis_rows(search, effects, [])] == [
            ("push",),
            ("pull",),
        ]
