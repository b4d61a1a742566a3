"""Long records: rows that lines between others tell are not simulated, and nothing else changes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Command, Run, Study
from diffsim.systems.ode.keys import Input
from diffsim.systems.ode.thinning import INTERVAL, interval_of, simulated
from diffsim.systems.registry import setup_of

STEP, ROWS = 1e-3, 4_000
TIME = STEP * np.arange(ROWS)
SLOW = np.sin(2.0 * np.pi * 0.7 * TIME)
JUMPS = np.floor(2.7 * TIME) % 3.0
MODEL = {
    "system": "ode",
    "parameters": {"lag": {"value": 0.05, "percent": 20}},
    "inputs": [{"name": "u", "held": True}],
    "states": {"x": 0},
    "rates": {"x": "(u - x)/lag"},
    "readings": {"seen": "x"},
    "most_rows": 1000,
}


def run_of(name, u, seen=None, use="fit"):
    seen = np.zeros(ROWS) if seen is None else seen
    noise = np.random.default_rng(len(name)).normal(0.0, 1e-3, ROWS)
    return Run(name, TIME, (seen + noise)[:, None], {"u": u}, name, use=use)


def study_of(*runs, **more):
    channels = (Channel("seen", "m", "position", sd=1e-3),)
    return Study("long", "ode", channels, runs, commands=(Command("u"),), **more)


def thinned(study, interval, held=False):
    return simulated((Input(name="u", held=held),), study, interval)[1]


def rows_of(run):
    return np.round(run.time_s / STEP).astype(int)


def test_all_that_lines_do_not_tell_stays():
    hop = np.exp(-((TIME - 2.0) ** 2) / 2e-4**0.5 / 1e-2)
    misread = np.where(np.arange(ROWS) == 1_501, 0.5, 0.0)
    before = replace(run_of("bb", JUMPS), row_s=0.2 * STEP)  # of a record that was finer still
    study = study_of(run_of("a", SLOW, hop + misread), before, run_of("t", SLOW, use="test"))
    assert interval_of(study, 2 * ROWS) == 0.0 and thinned(study, 0.0) is study
    interval = interval_of(study, 800)
    found = thinned(study, interval)
    slow, jumps, test = map(rows_of, found.runs)
    assert interval == pytest.approx(0.01, rel=0.01) and len(test) < 450 and len(jumps) < 500
    assert {*np.flatnonzero(np.diff(JUMPS))} <= {*jumps} >= {*np.flatnonzero(np.diff(JUMPS)) + 1}
    assert np.ptp(found.runs[0].measured) == pytest.approx(np.ptp(hop), abs=0.02)
    assert 1_501 not in slow and len(slow) < 0.2 * ROWS
    between = np.interp(TIME, found.runs[0].time_s, found.runs[0].command["u"])
    assert np.abs(between - SLOW).max() < 2e-3
    assert [run.row_s for run in found.runs] == pytest.approx([STEP, 0.2 * STEP, STEP])
    said = f"of {3 * ROWS} rows {len(slow) + len(jumps) + len(test)} are simulated"
    assert said in found.mended[-1]
    assert len(found.runs) == 3 and interval_of(replace(study, frame={INTERVAL: 0.5}), 1) == 0.5


@pytest.mark.parametrize("share", [1.1, 1.9])
def test_few_more_rows_than_may_be_are_thinned_too(share):
    """Each second one and the last are more than half, so all stayed, up to twice as many."""
    study = study_of(run_of("a", SLOW), run_of("bb", JUMPS))
    found = thinned(study, interval_of(study, int(2 * ROWS / share)))
    assert sum(len(run.time_s) for run in found.runs) < 0.4 * 2 * ROWS


def test_what_needs_all_rows_keeps_them():
    noisy = np.random.default_rng(0).normal(size=ROWS)
    study = study_of(run_of("a", noisy), run_of("bb", np.where(TIME > 1.0, np.nan, 0.0)))
    assert thinned(study, 0.01) is study
    measured = replace(study, commands=(Command("u", is_measured=True),))
    assert len(thinned(measured, 0.01).runs[0].time_s) < 0.2 * ROWS


@pytest.mark.parametrize("held", [True, False])
def test_predictions_are_those_of_all_rows(held):
    model = MODEL | {"inputs": [{"name": "u", "held": held}]}
    runs = (run_of("a", SLOW), run_of("bb", JUMPS), run_of("ccc", 0.3 * SLOW + 0.1 * JUMPS))
    study = study_of(*runs, model=model)
    whole, cut = setup_of(replace(study, model=model | {"most_rows": 10**6})), setup_of(study)
    assert whole.study is None and cut.model.frame[INTERVAL] > 0.0
    for run, short in zip(study.runs, cut.study.runs, strict=True):
        q = torch.zeros(len(cut.model.base), dtype=torch.float64)
        now, before = cut.model.predict(short, q), whole.model.predict(run, q)
        assert len(short.time_s) < 0.3 * ROWS
        off = np.abs(now.numpy() - before.numpy()[rows_of(short)])
        assert off.max() < 3e-4 * np.abs(before.numpy()).max()
