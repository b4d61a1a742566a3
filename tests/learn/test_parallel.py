"""Two processes that train one controller have the gradient, weights and ratings of one."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need gymnasium: pip install '.[rl]'")
if not torch.distributed.is_available():
    pytest.skip("this PyTorch is built without torch.distributed", allow_module_level=True)

from diffsim.core.workers import Worker
from diffsim.learn import parallel
from diffsim.learn.run import read_rows, train
from rl import train_mixed
from tests.learn import parallel_for_workers as work
from tests.optional import needs

needs("tensorboard", reason="training writes a TensorBoard log")


@pytest.fixture(scope="module")
def pair():
    workers = [Worker(work.__name__) for _ in range(2)]
    yield workers
    for worker in workers:
        worker.end()


def of_both(pair: list[Worker], function: Any, meeting: Path, *more: Any) -> list[Any]:
    with ThreadPoolExecutor(2) as threads:
        calls = [
            threads.submit(w.call, function, k, 2, str(meeting), *more) for k, w in enumerate(pair)
        ]
        return [call.result() for call in calls]


def test_two_processes_have_the_gradient_of_one(pair, tmp_path: Path) -> None:
    alone = work.updated(work.learner())
    assert alone["gradient"].norm() > 1e-3
    one, other = of_both(pair, work.together, tmp_path / "met")
    for name, value in alone.items():
        for part in (one, other):
            torch.testing.assert_close(part[name], value, rtol=1e-12, atol=1e-14, msg=name)
    for name, value in one.items():  # they never part
        assert torch.equal(torch.as_tensor(value), torch.as_tensor(other[name])), name


def test_a_part_that_breaks_down_is_skipped_by_all(pair, tmp_path: Path) -> None:
    one, other = of_both(pair, work.with_a_bad_part, tmp_path / "met")
    assert one["bad"] == other["bad"] == 1.0
    assert one["first"] != one["first"]  # not a number
    assert all(torch.equal(one[k], other[k]) for k in one if k.startswith("net."))


def test_one_of_them_rates_and_writes(pair, tmp_path: Path) -> None:
    setup = work.setup(steps=200, evaluate_every=100)
    alone = train(setup, work.learner(), tmp_path / "alone", show=False)
    one, other = of_both(pair, work.trained, tmp_path / "met", str(tmp_path / "together"))
    assert one == pytest.approx([row["reward"] for row in alone.rows], rel=1e-10)
    assert len(one) > 2 and all(reward != reward for reward in other)
    assert [row["reward"] for row in read_rows(tmp_path / "together")] == one


def test_fewer_episodes_than_processes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "num_processes", lambda: 3)
    monkeypatch.setattr(parallel, "rank", lambda: 1)
    assert parallel.own_members(5) == slice(1, 3)
    with pytest.raises(ValueError, match="batch must be at least 3, an episode per process, got 2"):
        parallel.own_members(2)


def test_other_methods_do_not_share(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(SystemExit):
        train_mixed.main(["--quick"])
    assert "rl/train_gradient.py alone shares its episodes" in capsys.readouterr().err
    assert parallel.launched_together()
