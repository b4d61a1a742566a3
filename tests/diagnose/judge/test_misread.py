"""Misread samples are no error on unseen runs; what a model makes of a sample is."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run
from diffsim.diagnose.judge.unseen import on_unseen
from diffsim.identify import Parameter, SimModel, fit

CHANNELS = (Channel("q", "m", "position", sd=0.01),)
SD = np.array([0.01])


@dataclass
class Follower:
    """Shows a command, times a gain."""

    shown: torch.Tensor

    def simulate(self) -> torch.Tensor:
        return self.shown[:, None]


def build(values, run, numerics):
    return Follower(values["gain"] * torch.from_numpy(run.command["path"]))


def recorded(name: str, measured: np.ndarray, path: np.ndarray) -> Run:
    return Run(name, 0.01 * np.arange(len(path)), measured[:, None], {"path": path}, name)


@pytest.mark.parametrize("whose", ["record", "model"])
def test_a_sample_is_left_out_where_the_record_leaps_and_no_model(whose):
    rng = np.random.default_rng(3)
    path = 5.0 * np.sin(6.0 * np.pi * np.arange(300) / 300)  # 30 sd from sample to sample
    noise = rng.normal(0.0, 0.01, (2, 300))
    leaps = np.zeros(300)
    leaps[[40, 150, 222]] = 0.4, -1.0, 0.8
    known = recorded("known", path + noise[0], path)
    if whose == "record":
        unseen = recorded("new", path + noise[1] + leaps, path)
    else:
        unseen = recorded("new", path + noise[1], path + leaps)
    model = SimModel(build, [Parameter("gain", 1.0, 0.1, "-")], "follower")
    at = fit(model, [known], CHANNELS)
    found = on_unseen(at, at, [unseen], CHANNELS, SD, {}, seed=0)
    assert found.num_spikes == (3 if whose == "record" else 0)
    (row,) = found.errors
    assert row.after == pytest.approx(0.01 if whose == "record" else 0.0775, rel=0.15)
