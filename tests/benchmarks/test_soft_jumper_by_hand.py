"""A period of commands for the soft jumper: it gets better, and leaves its ratings and commands."""

from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from benchmarks.soft_jumper_by_hand import COMMANDS, Options, Period, optimize
from diffsim.envs.soft_named import SoftJumper
from diffsim.learn.run import read_rows


def test_a_period_gets_better(tmp_path: Path) -> None:
    still = {"drop": 0.0, "aside": 0.0, "size_spread": 0.0}
    task = SoftJumper(robot={"coarse": True}, num_steps=12, **still)
    options = Options(period=6, horizon=12, batch=1, iterations=4, every=2)
    period = optimize(task, options, tmp_path)
    rows = read_rows(tmp_path)
    assert [row["steps"] for row in rows] == [0, 24, 48]
    assert rows[-1]["finished"]
    assert rows[-1]["reward"] > rows[1]["reward"] > rows[0]["reward"] + 1e-3
    kept = torch.from_numpy(np.load(tmp_path / COMMANDS)).double()
    torch.testing.assert_close(kept, torch.tanh(period.raw.detach()), rtol=0.0, atol=1e-3)


def test_a_period_repeats() -> None:
    period = Period(4, 3)
    seen = torch.zeros(2, 7, dtype=torch.float64)
    commands = torch.stack([period(seen, k) for k in range(8)])
    assert commands.shape == (8, 2, 3)
    assert torch.equal(commands[:4], commands[4:])
    assert (commands[:2] > 0.6).all()
    assert (commands[2:4] < -0.6).all()
