"""Killed at random moments, by SIGKILL and SIGTERM, then run again: the results are the same."""

import json
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

MOMENTS = 10  # of each of five programs
STOPPED = (0, 130, -signal.SIGTERM, -signal.SIGKILL)  # -SIGTERM: while modules are imported
MAX_WALL_S = 900.0
UNEQUAL = re.compile("machine|second|cpu_s|wall|load_average|reused|memory")

pytestmark = [pytest.mark.slow, pytest.mark.serial]  # kills processes


@dataclass(frozen=True)
class Program:
    """A resumable program.

    Attributes:
        code: Python that computes into the folder ``OUT``, going on with what is there.
        results: The results that must be equal, from the folder.
    """

    code: str
    results: Callable[[Path], Any]


def without_times(value: Any) -> Any:
    """Plain results without what counts seconds or names the folder."""
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if not UNEQUAL.search(k.lower())}
    if isinstance(value, list):
        return [without_times(item) for item in value]
    return value


def json_at(*names: str) -> Callable[[Path], Any]:
    """Content of files, each of which must be there."""

    def read(out: Path) -> Any:
        whole = {}
        for name in names:
            text = (out / name).read_text(encoding="utf-8").replace(str(out), "OUT")
            whole[name] = (
                without_times(json.loads(text)) if name.endswith("json") else len(text) > 0
            )
        return whole

    return read


def trained(out: Path) -> Any:
    """Ratings and the weights of the last checkpoint."""
    import torch

    from diffsim.learn.run import read_rows

    state = torch.load(out / "checkpoint.pt", weights_only=True)["controller"]
    weights = {name: value.flatten().tolist() for name, value in state.items()}
    return [without_times(row) for row in read_rows(out)], weights


PROGRAMS = {
    "demo": Program(
        "from examples import demo\n"
        "from examples.demo import story\n"
        "from tests.examples.demo.conftest import TINY\n"
        "story.find_dataset = lambda *_: None\n"  # the virtual laboratory's recordings
        "demo.main(data=None, out=OUT, resume=True, threads=1, plan=TINY)\n",
        json_at("results.json", "report.html"),
    ),
    "explain": Program(
        "from diffsim import cli\n"
        "sys.argv = ['diffsim', 'diagnose', 'explain', str(DATA / 'study'), '--out', str(OUT),\n"
        "            '--quick', '--setup', 'tests/diagnose/toy_setup.py']\n"
        "sys.exit(cli.main())\n",
        json_at("report.json", "inputs.json", "report.html"),
    ),
    "training": Program(
        "from diffsim.core import interruptible\n"
        "from rl import train_shac\n"
        "sys.argv = ['train_shac', '--quick', '--resume', '--out', str(OUT), '--steps', '320']\n"
        "with interruptible():\n"
        "    train_shac.main()\n",
        trained,
    ),
    "devices": Program(
        "from diffsim import cli\n"
        "sys.argv = ['diffsim', 'devices', 'averager', '--resolution', '0.3', '--samples', '3',\n"
        "            '--evaluations', '3', '--out', str(OUT)]\n"
        "sys.exit(cli.main())\n",
        json_at("result.json"),
    ),
    "benchmark": Program(
        "from tests.interrupted_benchmark import main\n"
        "from diffsim.core import interruptible\n"
        "with interruptible():\n"
        "    sys.exit(main(['--resume', '--out', str(OUT)]))\n",
        json_at("results.json", "report.md"),
    ),
}


def start(program: Program, out: Path, data: Path) -> subprocess.Popen[str]:
    """The program in a process of its own."""
    head = (
        "import sys\nfrom pathlib import Path\n"
        f"OUT, DATA = Path({str(out)!r}), Path({str(data)!r})\n"
    )
    return subprocess.Popen(
        [sys.executable, "-c", head + program.code],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def run_to_its_end(program: Program, out: Path, data: Path) -> float:
    """Wall seconds of a whole run, which must succeed."""
    begin = time.perf_counter()
    process = start(program, out, data)
    _, said = process.communicate(timeout=MAX_WALL_S)
    assert process.returncode == 0, said[-2000:]
    return time.perf_counter() - begin


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with a study, and with no recordings of the demo: it makes its own."""
    from diffsim.data.study_save import save_study
    from tests.diagnose import toy

    folder = tmp_path_factory.mktemp("data")
    save_study(toy.generate(2, {"drag": 0.2}), folder / "study")
    return folder


@pytest.mark.parametrize("name", PROGRAMS)
def test_killed_at_random_moments_it_ends_the_same(name, data, tmp_path):
    program, draw = PROGRAMS[name], random.Random(name)
    wall = run_to_its_end(program, tmp_path / "whole", data)
    whole = program.results(tmp_path / "whole")
    for moment in range(MOMENTS):
        out = tmp_path / f"killed_{moment}"
        number = (signal.SIGKILL, signal.SIGTERM)[moment % 2]
        process = start(program, out, data)
        try:
            process.wait(timeout=wall * draw.uniform(0.1, 1.0))
        except subprocess.TimeoutExpired:
            process.send_signal(number)
        _, said = process.communicate(timeout=MAX_WALL_S)
        assert process.returncode in STOPPED, said[-2000:]
        assert "Traceback" not in said, said[-2000:]
        run_to_its_end(program, out, data)
        assert program.results(out) == whole, f"moment {moment}, {number.name}"
