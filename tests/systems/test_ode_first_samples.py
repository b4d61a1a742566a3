"""A state that starts at a channel's first sample starts as well known as the sensor knows it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data import load_study
from diffsim.identify import fit
from diffsim.systems.registry import setup_of
from tests.systems.late_cart import MODEL, T, study_of

STUDY = """\
name: tank
model:
  system: ode
  parameters: {lag: {value: 100 s, percent: 30}}
  inputs: [pump]
  states: {level: first_seen}
  rates: {level: (pump - level)/lag}
  readings: {seen: level}
channels: [{name: seen, unit: m, SD}]
commands: [{name: pump, unit: m}]
runs: [{file: a.csv}, {file: b.csv}, {file: c.csv, use: test}]
"""
NOISE, NUM = 0.01, 200


@pytest.mark.parametrize("stated", ["sd: 0.01", "sensor: gauge"])
def test_noise_of_the_first_sample_is_no_misfit(tmp_path, stated):
    rng = np.random.default_rng(4)
    t = np.arange(float(NUM))
    for run in "abc":
        pump = 1.0 + 0.5 * np.sin(2.0 * np.pi * t / rng.uniform(80.0, 120.0))
        level = [1.0]
        for value in pump[:-1]:
            level.append(value + (level[-1] - value) * np.exp(-1.0 / 100.0))
        seen = np.array(level) + NOISE * rng.standard_normal(NUM)
        seen[0] = 1.0 + 2.5 * NOISE  # once in eighty runs
        rows = "\n".join(f"{a:g},{b:.6f},{c:.6f}" for a, b, c in zip(t, seen, pump, strict=True))
        (tmp_path / f"{run}.csv").write_text(f"time_s,seen,pump\n{rows}\n")
    text = STUDY.replace("SD", stated).replace(
        "inputs: [pump]", "inputs: [{name: pump, held: true}]"
    )
    (tmp_path / "study.yaml").write_text(text)
    study = load_study(tmp_path)
    setup = setup_of(study)
    names = [p.name for p in setup.model.base if "noise" in p.name]
    assert names == [f"first_seen_noise@{run}" for run in "abc"]
    sd = next(p.sd for p in setup.model.base if "noise" in p.name)
    assert sd == pytest.approx(NOISE, rel=0.15)
    if study.channels[0].sd is None:
        return
    found = fit(setup.model, study.fit_runs, study.channels)
    # 400 samples: chi2 scatters by 28; the start alone would add 2.5^2 * 50 a run, 620 in all
    assert found.chi2 < 400 + 3 * 28
    offs = [found.values[name] for name in names if name in found.values]
    assert offs[:2] == pytest.approx([2.5 * NOISE] * 2, abs=4e-3)
    assert found.values["lag"] == pytest.approx(100.0, rel=0.03)


@pytest.mark.grad
def test_what_is_known_of_a_run_may_be_asked_first_without_gradients():
    """It is read once: tensors of inference mode had no place in a gradient later."""
    made = study_of([np.full((len(T), 1), 0.01)] * 2)
    made = replace(made, model=MODEL | {"states": {"x": "0 m", "v": "run_order*damping"}})
    model, run = setup_of(made).model, replace(made.runs[1])
    at = model.at_prior().requires_grad_()
    with torch.inference_mode():
        seen = model.predict(run, at.detach())
    after = model.predict(run, at)
    assert torch.equal(after.detach(), seen)
    (slope,) = torch.autograd.grad(after.sum(), at)
    assert slope[:3].abs().min() > 0.0
