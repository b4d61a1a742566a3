"""Runs of different uses are different recordings: by their samples, whatever they are called."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.checks.gates import _shared_runs, cut_in_two, data_gate

CHANNELS = (Channel("x_m", "m", "position", sd=0.01),)
TIME = 0.01 * np.arange(400)


def recorded(seed, name="run", use="fit", **changes):
    noise = 0.01 * np.random.default_rng(seed).normal(size=(len(TIME), 1))
    measured = np.sin(3.0 * TIME)[:, None] + noise
    return replace(Run(name, TIME, measured, {}, name, use=use), **changes)


def part(run, where, **changes):
    return replace(run, time_s=run.time_s[where], measured=run.measured[where], **changes)


def study(*runs):
    return Study("doubles", "rigid_body", CHANNELS, runs)


def gates(*runs):
    return {g.name: g for g in data_gate(study(*runs))}


def shared_samples(*runs):
    """Samples of the longest stretch that two runs share; 0 where chance may explain it."""
    return max((count for *_, count in _shared_runs(runs, lambda *_: False)), default=0)


def test_one_recording_under_two_names_is_refused():
    first = recorded(1, "first")
    again = replace(first, name="again", group="again", use="test", time_s=TIME + 3.0)
    with pytest.raises(ValueError, match=r"run again \(use: test\) and run first .* share 400"):
        data_gate(study(first, recorded(2, "second"), again))


@pytest.mark.parametrize("use", ["select", "test"])
def test_overlapping_pieces_are_refused_unless_declared(use):
    whole = recorded(1)
    early = part(whole, slice(0, 250), name="early")
    late = part(whole, slice(200, None), name="late", use=use)
    with pytest.raises(ValueError, match="share 50 samples"):
        data_gate(study(early, late))
    declared = [replace(r, setup={"block_of": "whole"}) for r in (early, late)]
    data_gate(study(*declared))


def test_a_recording_cut_in_two_is_told():
    whole = recorded(1)
    early = part(whole, slice(0, 250), name="early")
    late = part(whole, slice(250, None), name="late", use="test")
    gate = gates(early, late)["separate_runs"]
    assert not gate.passed and "run late goes on where run early ends" in gate.note
    assert cut_in_two(study(early, replace(late, time_s=late.time_s + 1.0))) == []
    other = part(recorded(2), slice(250, None), name="late", use="test")
    away = replace(other, measured=other.measured + 1.0)  # the same clock, another place
    assert gates(early, away)["separate_runs"].passed


@pytest.mark.parametrize(("missing", "is_told"), [((), True), ((2, 5), False)])
def test_few_samples_tell_that_another_run_begins_elsewhere(missing, is_told):
    """Eight are enough; without three in a row nothing tells the noise."""
    whole = recorded(1)
    early = part(whole, slice(0, 8), name="early")
    early.measured[list(missing)] = np.nan
    late = part(whole, slice(8, None), name="late", use="test")
    away = replace(late, measured=late.measured + 1.0)
    assert cut_in_two(study(early, late))
    assert bool(cut_in_two(study(early, away))) is not is_told


def test_equal_samples_by_chance_are_no_double():
    coarse = [replace(r, measured=np.round(r.measured)) for r in (recorded(1), recorded(2))]
    assert np.mean(coarse[0].measured == coarse[1].measured) > 0.9
    assert shared_samples(*coarse) == 0
    ramp = [replace(recorded(k), measured=0.5 * TIME[:, None]) for k in (1, 2)]
    assert shared_samples(*ramp) == 0  # a steady ramp says nothing
    assert shared_samples(recorded(1), recorded(2)) == 0


def test_what_does_not_apply_did_not_pass():
    by_name = gates(recorded(1, "first"), recorded(2, "second"))
    for name in ("held_out", "separate_runs", "repeats"):
        assert not by_name[name].applies
    assert by_name["commands"].applies and by_name["commands"].passed
