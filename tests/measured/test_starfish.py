"""What the page of the starfish claims."""

from __future__ import annotations

import numpy as np
import pytest

from diffsim.data.importers import import_study
from diffsim.data.recording import find_dataset
from diffsim.diagnose import diagnose
from diffsim.diagnose.setups import setup_of
from diffsim.diagnose.setups.starfish import modes

PERIOD_S = {"baseline": 0.9216, "horizontal_cyclic3": 0.9290}  # of the legs, the same sequence
CYCLES, PHASES = 32, 40


@pytest.fixture(scope="module")
def study():
    if find_dataset("starfish") is None:
        pytest.skip("no measured data: set DIFFSIM_DATA to the folder that holds starfish/")
    return import_study("starfish")


@pytest.fixture(scope="module")
def cycles(study):
    """(CYCLES, PHASES, 3 modes) [m] of the two runs of one sequence, from 2 s after the start."""
    cut = modes(study, windows={name: (0.0, 33.0) for name in PERIOD_S}, holdout=[])
    out = {}
    for run in cut.runs:
        when = 2.2 + PERIOD_S[run.name] * np.arange(CYCLES * PHASES) / PHASES
        whole = np.stack([np.interp(when, run.time_s, y) for y in run.measured.T], 1)
        out[run.name] = whole.reshape(CYCLES, PHASES, 3)
    return out


def test_legs_repeat_between_cycles_and_runs(cycles):
    """Mean cycles of odd and even cycles, and of the two runs at the best lag."""
    means = {}
    for name, motion in cycles.items():
        legs = motion[:, :, :2] - motion[:, :, :2].mean(1, keepdims=True)
        means[name] = legs.mean(0)
        for c in range(2):
            assert np.corrcoef(legs[::2, :, c].mean(0), legs[1::2, :, c].mean(0))[0, 1] > 0.98
    a, b = means.values()
    for c in range(2):
        alike = [np.corrcoef(a[:, c], np.roll(b[:, c], s))[0, 1] for s in range(PHASES)]
        assert max(alike) > 0.95


def test_travel_repeats_neither_between_runs_nor_between_cycles(cycles):
    travel = {name: np.diff(motion[:, 0, 2]) for name, motion in cycles.items()}
    slow, fast = (-t.mean() / PERIOD_S[name] for name, t in travel.items())
    assert slow > 0.0  # towards -x
    assert fast / slow > 1.8
    assert travel["baseline"].std() > 0.8 * abs(travel["baseline"].mean())


def test_tracks_are_what_the_page_counts_scatter_in(study):
    """Tracking noise is far below what two equal commands differ by."""
    cut = modes(study, windows={name: (0.0, 1.6) for name in PERIOD_S}, holdout=[])
    still = np.concatenate([run.measured[:9] for run in cut.runs])
    assert still.std(0).max() < 1e-4


@pytest.mark.slow
def test_verdict_on_the_legs_in_water_is_numerical(study):
    """At the thesis' step and a coarse mesh; damping of the solid takes what is actuation's."""
    legs = modes(
        study,
        windows={n: (0.0, 1.6) for n in ("baseline", "horizontal_cyclic3", "horizontal_cyclic1")},
        holdout=["horizontal_cyclic1"],
        channels=("leg_x_m", "leg_z_m"),
    )
    s = setup_of(legs, max_effects=2)
    found = diagnose(legs, s.model, s.effects, seed=0, unknowns=s.unknowns, settings=s.settings)
    assert found.verdict == "numerical"
    failed = {g.name for g in found.gates if not g.passed}
    assert {"time_step", "mesh"} <= failed
    assert found.chi2_null < 1.2 * found.num_samples
    names = [p.name for p in s.model.base]
    beta = s.model.base[names.index("rayleigh_beta")]
    assert found.null.x[names.index("rayleigh_beta")] > 4.0  # prior sd
    assert beta.value < 0.01


@pytest.mark.slow
def test_verdict_on_the_legs_in_air_is_unknown_actuation(study):
    windows = {"airtest": (0.0, 1.6), "airtest+10": (10.0, 1.6), "airtest+20": (20.0, 1.6)}
    legs = modes(study, windows=windows, holdout=["airtest+20"], channels=("leg_x_m", "leg_z_m"))
    s = setup_of(legs, max_effects=2)
    found = diagnose(legs, s.model, s.effects, seed=0, unknowns=s.unknowns, settings=s.settings)
    assert found.verdict == "unknown" and not found.named
    nats = {(h.effects, h.unknown): h.nats for h in found.hypotheses}
    pull, force = nats[(), "unknown pull of the tendons"], nats[(), "unknown force"]
    assert pull > force + 100.0 > 400.0
    assert all(g.passed for g in found.gates if g.name in ("time_step", "mesh"))
