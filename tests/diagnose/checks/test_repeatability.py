"""Nuisances of single runs against their priors: scatter between repeats that gains take up."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run
from diffsim.diagnose.checks.gates import repeatability_gate
from diffsim.diagnose.checks.noise import UNREPEATABLE
from diffsim.identify import Parameter, SimModel, fit
from tests.diagnose.linear import LinearScene

SD, JITTER = 0.002, 0.005  # so that data, not priors, tell the gains
COMMANDS = {"low": 1.0, "high": 5.0}


def recorded(jitter: float) -> list[Run]:
    """Two repeats of each command; what is measured is the command times a gain of the run."""
    rng, runs = np.random.default_rng(0), []
    for repeat in "ab":
        for name, level in COMMANDS.items():
            gain = 1.0 + jitter * rng.normal()
            time = 0.1 * np.arange(80)
            push = level * (1.0 + np.sin(time))
            measured = gain * push + SD * rng.normal(size=80)
            runs.append(
                Run(
                    f"{name}_{repeat}",
                    time,
                    measured[:, None],
                    {"push": push},
                    name,
                    setup={"gain": gain},
                )
            )
    return runs


def fitted(runs: list[Run]):
    def build(values, run, numerics):
        push = torch.from_numpy(run.command["push"])[:, None]
        return LinearScene(values["gain"] * values[f"jitter@{run.name}"] * push)

    base = [Parameter("gain", 1.0, 0.05)]
    base += [Parameter(f"jitter@{run.name}", 1.0, JITTER) for run in runs]
    return fit(SimModel(build, base), runs, [Channel("y", "m", "position", sd=SD)])


def test_gains_far_beyond_what_was_stated_are_scatter():
    runs = recorded(0.1)
    (gate,) = repeatability_gate(fitted(runs))
    assert gate.name == "repeats:jitter" and not gate.passed
    low, high = ([r.setup["gain"] for r in runs if r.group == name] for name in COMMANDS)
    drawn = np.sqrt(0.5 * (np.var(low, ddof=1) + np.var(high, ddof=1))) / JITTER
    assert gate.value == pytest.approx(drawn, rel=0.1)


def test_gains_as_stated_are_none():
    (gate,) = repeatability_gate(fitted(recorded(JITTER)))
    assert gate.passed


@pytest.mark.reference
def test_false_alarms_are_as_rare_as_said():
    """Values as their priors have them, three groups of two: one in a thousand."""
    rng = np.random.default_rng(0)
    runs = [SimpleNamespace(name=f"{g}{k}", group=g) for g in "abc" for k in range(2)]
    model = SimpleNamespace(base=[SimpleNamespace(name=f"gain@{r.name}") for r in runs])
    problem = SimpleNamespace(runs=runs, model=model)
    gates = [
        repeatability_gate(SimpleNamespace(problem=problem, x=rng.normal(size=6)))[0]
        for _ in range(4000)
    ]
    failed = sum(not g.passed for g in gates)
    assert 0 < failed < 12
    assert np.mean([g.value**2 for g in gates]) == pytest.approx(1.0, abs=0.1)
    assert np.mean([g.value > UNREPEATABLE for g in gates]) > 0.05  # the ratio alone would not do


def test_no_repeats_no_check():
    runs = recorded(0.1)[:2]
    assert repeatability_gate(fitted(runs)) == []
