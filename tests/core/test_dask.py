"""The same runs on a real Dask cluster of two workers, one of which is killed in the middle."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import pytest

from diffsim.core.executors import open_executor
from diffsim.core.runs import run_each, run_kept
from tests.core import runs_for_workers as work

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None,
    reason="distributed is not installed: pip install -e '.[cluster]'",
)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Address file of a scheduler with two workers, one thread each, that nobody starts again."""
    folder = tmp_path_factory.mktemp("dask")
    address = folder / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": (folder / "log").open("w"), "cwd": folder}
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}

    def start(*words):
        command = [sys.executable, "-m", "dask", *words, "--scheduler-file", str(address)]
        return subprocess.Popen(command, env=environment, **quiet)

    made = [start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")]
    made += [
        start("worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1")
        for _ in range(2)
    ]
    try:
        from distributed import Client

        until = time.monotonic() + 60.0
        while not address.exists() and time.monotonic() < until:
            time.sleep(0.1)
        with Client(scheduler_file=str(address), set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        yield str(address)
    finally:
        for process in made:
            process.kill()
            process.wait()


def test_a_cluster_gives_the_same_results_and_errors(scheduler):
    with open_executor(f"dask:{scheduler}") as cluster:
        assert run_each(work.drawn, range(7), cluster) == [work.drawn(k) for k in range(7)]
        assert set(run_each(work.threads, range(4), cluster)) == {1}
        with pytest.raises(Exception, match="no way") as caught:
            run_each(work.fails, range(3), cluster)
        assert caught.value.num_iters == 2
        assert run_each(work.drawn, [3], cluster) == [work.drawn(3)]


def test_a_worker_killed_in_the_middle_costs_one_run(scheduler, tmp_path):
    items = {f"run_{k}": {"folder": str(tmp_path), "seed": k, "seconds": 0.5} for k in range(10)}
    killed = []

    def kill_one() -> None:
        """Kill a worker that is in a run, all its earlier ones being kept."""
        until = time.monotonic() + 60.0
        while not killed and time.monotonic() < until:
            time.sleep(0.02)
            kept = [json.loads(p.read_text()) for p in (tmp_path / "kept").glob("*.json")]
            ended = Counter(k["result"]["process"] for k in kept)
            began = Counter(int(p.read_text() or 0) for p in tmp_path.glob("[0-9]_*"))
            for process, count in ended.items():
                if began[process] == count + 1 and not killed:
                    killed.append(process)
                    os.kill(process, signal.SIGKILL)

    thread = threading.Thread(target=kill_one)
    thread.start()
    with open_executor(f"dask:{scheduler}") as cluster:
        results = run_kept(work.drawn_slowly, items, tmp_path / "kept", cluster)
    thread.join()
    assert [r["value"] for r in results.values()] == [work.drawn(k) for k in range(10)]
    assert len(killed) == 1
    by_killed = sum(r["process"] == killed[0] for r in results.values())
    assert 0 < by_killed < 10  # it had done its part before, and none of it was lost
    assert len(list(tmp_path.glob("[0-9]_*"))) == 11  # one run began twice
    assert len(list((tmp_path / "kept").glob("*.json"))) == 10


def test_no_scheduler_is_an_error_not_a_wait():
    from dask import config

    with (
        config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(OSError),
        open_executor("dask:tcp://127.0.0.1:1"),
    ):
        pass
