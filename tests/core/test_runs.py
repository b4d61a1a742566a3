"""Many runs: the same results from any executor, kept one by one, a lost worker costs one."""

import json
import os
import signal
import subprocess
import sys
import time
import types
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import pytest

from diffsim.core.errors import ConvergenceError, DiffsimError
from diffsim.core.executors import executor_word, open_executor
from diffsim.core.runs import LostRunError, run_each, run_kept
from diffsim.core.workers import Processes
from tests.core import runs_for_workers as work

pytestmark = pytest.mark.serial  # kills processes

ROOT = Path(__file__).parents[2]
HERE = "tests.core.runs_for_workers"


@pytest.fixture(scope="module")
def two():
    with open_executor("processes:2") as workers:
        yield workers


def test_results_do_not_depend_on_who_computes(two):
    expected = [work.drawn(seed) for seed in range(7)]
    assert run_each(work.drawn, range(7)) == expected
    assert run_each(work.drawn, range(7), two) == expected
    with open_executor(f"{HERE}:make_executor") as own:
        assert isinstance(own, ThreadPoolExecutor)
        assert run_each(work.drawn, range(7), own) == expected


def test_each_run_is_handed_over_once(two):
    for executor in (None, two):
        seen = {}
        run_each(work.drawn, range(5), executor, done=seen.__setitem__)
        assert seen == {k: work.drawn(k) for k in range(5)}


def test_workers_use_one_thread(two):
    assert set(run_each(work.threads, range(4), two)) == {1}


def test_a_lost_worker_costs_one_run(two, tmp_path):
    items = [{"folder": str(tmp_path), "seed": k, "dies": k in (1, 4)} for k in range(6)]
    assert run_each(work.dies_once, items, two) == [work.drawn(k) for k in range(6)]
    assert {p.name for p in tmp_path.iterdir()} == {"died_1", "died_4"}


def test_a_run_that_kills_every_worker_is_given_up(two):
    with pytest.raises(LostRunError, match=r"run 1 of 1 lost its worker 3 times: .*exit code -9"):
        run_each(work.dies, [0], two)
    assert run_each(work.drawn, [3], two) == [work.drawn(3)]  # the executor lives on


def test_a_pool_that_breaks_says_what_to_use():
    with (
        ProcessPoolExecutor(1, get_context("forkserver")) as pool,
        pytest.raises(LostRunError, match="use an executor whose workers die alone"),
    ):
        run_each(work.dies, [0, 1], pool)


def test_errors_come_back_whole(two):
    seen = []
    with pytest.raises(ConvergenceError, match="no way") as caught:
        run_each(work.fails, range(3), two, done=lambda k, value: seen.append(value))
    assert (caught.value.residual_norm, caught.value.num_iters) == (3.0, 2)
    assert "in fails" in str(caught.value.__cause__)  # where it came from
    assert set(seen) <= {0, 1}
    with pytest.raises(Exception, match=r"(?i)pickle"):
        run_each(work.unsendable, [0], two)
    with pytest.raises(Exception, match=r"(?i)pickle"):
        run_each(lambda k: k, [0], two)


def test_a_function_that_workers_cannot_import_is_an_error_not_a_dead_worker(two, monkeypatch):
    module = types.ModuleType("only_here")
    exec("def run(k):\n    return k", module.__dict__)
    monkeypatch.setitem(sys.modules, "only_here", module)
    with pytest.raises(ModuleNotFoundError, match="only_here"):
        run_each(module.run, [1], two)
    assert run_each(work.drawn, [3], two) == [work.drawn(3)]


def test_finished_runs_are_kept_one_by_one(two, tmp_path):
    items = {f"run_{k}": {"seed": k} for k in range(3)}
    first = run_kept(partial(_value, 1.0), items, tmp_path)
    assert first == {name: {"value": work.drawn(k)} for k, name in enumerate(items)}
    (tmp_path / "run_1.json").write_text("{")  # as a full disk leaves it
    items["run_2"] = {"seed": 5}  # asked for something else
    said = []
    again = run_kept(partial(_value, 2.0), items, tmp_path, two, done=lambda n, _: said.append(n))
    assert [again[f"run_{k}"]["value"] for k in range(3)] == [
        work.drawn(0),
        2.0 * work.drawn(1),
        2.0 * work.drawn(5),
    ]
    assert sorted(said) == sorted(items)


def _value(factor, item):
    return {"value": factor * work.drawn(item["seed"])}


@pytest.mark.parametrize("word", ["here", "processes:1"])
def test_an_interruption_while_a_result_is_kept_does_not_lose_it(word, tmp_path):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupted(name, result):
        signal.raise_signal(signal.SIGINT)
        (tmp_path / f"said_{name}").touch()

    try:
        with pytest.raises(KeyboardInterrupt), open_executor(word) as executor:
            run_kept(work.drawn, {"a": 1, "b": 2}, tmp_path, executor, done=interrupted)
    finally:
        signal.signal(signal.SIGINT, before)
    assert {p.name for p in tmp_path.iterdir()} >= {"a.json", "said_a"}


def test_an_error_leaves_what_had_ended(tmp_path):
    items = {f"{k}": k for k in range(4)}
    with pytest.raises(ConvergenceError):
        run_kept(work.fails, items, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.json", "1.json"]


INTERRUPTED = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from diffsim.core import interruptible
from diffsim.core.executors import open_executor
from diffsim.core.runs import run_kept
from tests.core.runs_for_workers import drawn_slowly
if __name__ == "__main__":
    folder = sys.argv[1]
    long = {"1": 0.0, "2": 60.0, "3": 60.0, "4": 0.0}
    items = {k: {"folder": folder, "seed": int(k), "seconds": s} for k, s in long.items()}
    with interruptible("the same command goes on"), open_executor("processes:2") as workers:
        run_kept(drawn_slowly, items, folder + "/kept", workers)
"""


def test_an_interruption_ends_workers_and_keeps_what_ended(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(INTERRUPTED)
    process = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until = time.monotonic() + 60.0
    began = []
    while len(began) < 3 and time.monotonic() < until:
        time.sleep(0.05)
        began = [p for p in tmp_path.glob("[0-9]_*") if p.read_text()]
    os.killpg(process.pid, signal.SIGINT)  # as a terminal sends it: to the workers, too
    _, said = process.communicate(timeout=20)
    assert process.returncode == 130
    assert said.strip() == "interrupted; the same command goes on"
    assert [p.name for p in (tmp_path / "kept").iterdir()] == ["1.json"]
    assert json.loads((tmp_path / "kept" / "1.json").read_text())["result"]["value"] == work.drawn(
        1
    )
    for path in began:
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)


@pytest.mark.parametrize(
    "word", ["", "dask", "dask:", "processes:0", "processes:many", "here:1", "some_module", ":f"]
)
def test_words_that_mean_nothing_are_refused(word):
    with pytest.raises(ValueError, match="executor must be here, processes"):
        executor_word(word)


def test_what_is_no_executor_is_refused():
    with (
        pytest.raises(TypeError, match=r"no_executor must return .*Executor, got int"),
        open_executor(f"{HERE}:no_executor"),
    ):
        pass


def test_here_is_none():
    with open_executor() as none, open_executor("here") as here:
        assert none is None and here is None
    with open_executor("processes") as all_of_them:
        assert isinstance(all_of_them, Processes)
    assert issubclass(LostRunError, DiffsimError)
