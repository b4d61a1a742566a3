"""First commands of recordings that start at rest: heard before, or come with the record."""

import dataclasses

import numpy as np
import pytest

from diffsim.data.study import Channel, Run, Study
from diffsim.systems.first_commands import LATE as TRIED
from diffsim.systems.first_commands import is_heard_at_once
from diffsim.systems.registry import setup_of

TIME = 0.01 * np.arange(200)
LATE = 0.024  # [s]
MODEL = {
    "system": "ode",
    "parameters": {"k": {"value": 60.0, "percent": 5}, "d": {"value": 9.0, "percent": 10}},
    "inputs": [{"name": "goal", "held": True}],
    "states": {"q": 0, "w": 0},
    "rates": {"q": "w", "w": "k*(goal - q) - d*w"},
    "readings": {"angle": "q"},
}


def servo(seed: int, *, before: float | None, late: float = LATE) -> Study:
    """A servo whose first goals are 0.5 and -0.4 rad, at rest at zero; None: they stood before."""
    rng, runs = np.random.default_rng(seed), []
    for name, first in (("up", 0.5), ("down", -0.4)):
        goal = np.where(TIME < 0.9, first, 0.1)
        q = w = 0.0
        seen = []
        for t in TIME:
            seen.append(q)
            for part in range(20):
                now = t + 0.0005 * part - late
                there = goal[int(now / 0.01 + 1e-9)] if now >= 0.0 else before
                push = 61.0 * ((first if there is None else there) - q) - 9.2 * w
                q, w = q + 0.0005 * w, w + 0.0005 * push
        measured = np.array(seen)[:, None] + rng.normal(0.0, 1e-3, (len(TIME), 1))
        runs.append(Run(name, TIME, measured, {"goal": goal}, name))
    channel = Channel("angle", "rad", "angle", sd=1e-3)
    return Study("servo", "ode", (channel,), tuple(runs), model=MODEL)


@pytest.mark.parametrize("before", [None, 0.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_record_tells_whether_its_first_command_stood_before(before, seed):
    """A delay of a goal that had long been heard shows at its next change alone; a log that begins
    with its goal moves late."""
    study = servo(seed, before=before)
    model = setup_of(study).model
    scene = model.scene(study.runs[0], model.at_prior())
    known = scene.commands.before
    assert (known is None) is (before is None)
    assert known is None or known.tolist() == [0.0]


@pytest.mark.parametrize("stood", [True, False])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_speed_that_changes_at_once_is_heard_before_though_it_comes_late(stood, seed):
    """Feed-forward of a sine begins with its greatest speed: a drive that was let go with it moves
    at once, and still hears all that follows late."""
    rng, runs = np.random.default_rng(seed), []
    for name, size, rate in (("slow", 0.4, 6.0), ("fast", 0.2, 15.0)):
        goal, speed = size * np.sin(rate * TIME), size * rate * np.cos(rate * TIME)
        q = w = 0.0
        seen = []
        for t in TIME:
            seen.append(q)
            for part in range(20):
                k = int(np.floor((t + 0.0005 * part - LATE) / 0.01 + 1e-9))
                first = speed[0] if stood else 0.0
                to, at = (goal[k], speed[k]) if k >= 0 else (0.0, first)
                w += 0.0005 * (61.0 * (to - q) + 9.2 * (at - w))
                q += 0.0005 * w
        measured = np.array(seen)[:, None] + rng.normal(0.0, 1e-3, (len(TIME), 1))
        runs.append(Run(name, TIME, measured, {"goal": goal, "speed": speed}, name))
    model = {
        **MODEL,
        "inputs": [{"name": "goal", "held": True}, {"name": "speed", "held": True}],
        "rates": {"q": "w", "w": "k*(goal - q) + d*(speed - w)"},
    }
    channel = Channel("angle", "rad", "angle", sd=1e-3)
    study = Study("servo", "ode", (channel,), tuple(runs), model=model)
    made = setup_of(study).model
    before = made.scene(study.runs[0], made.at_prior()).commands.before
    assert before is not None
    goal_before, speed_before = before.tolist()
    assert goal_before == 0.0
    assert np.isnan(speed_before) == stood  # its first value, else zero


def test_without_motion_or_noise_that_is_stated_nothing_is_told():
    rng = np.random.default_rng(5)
    delays = (0.0, *(0.0 for _ in TRIED), *TRIED)
    moved = [1.0 - np.exp(-6.0 * np.maximum(TIME - 0.01 * d, 0.0)) for d in delays]
    every = np.array(moved)[..., None]
    noise = 1e-3 * rng.normal(size=every[0].shape)
    sd = np.array([1e-3])
    assert is_heard_at_once([(every, every[0] + noise)], sd)
    assert not is_heard_at_once([(every, every[-1] + noise)], sd)
    assert not is_heard_at_once([(every, every[0] + noise)], np.array([np.nan]))
    assert not is_heard_at_once([(0.0 * every, noise)], sd)
    assert not is_heard_at_once([(every, np.full_like(noise, np.nan))], sd)
    assert not is_heard_at_once([], sd)
    assert not is_heard_at_once([(np.full_like(every, np.inf), noise)], sd)  # at the priors


@pytest.mark.parametrize("seed", [1, 2])
def test_an_input_that_no_formula_reads_is_no_mistake(seed):
    """A room's temperature that is recorded, and that only a law may turn out to need."""
    study = servo(seed, before=0.0)
    rng = np.random.default_rng(seed)
    for run in study.runs:
        run.command["room"] = 20.0 + rng.normal(0.0, 0.1, len(TIME))
    unread = [*MODEL["inputs"], {"name": "room", "held": False}]
    model = setup_of(dataclasses.replace(study, model={**MODEL, "inputs": unread})).model
    known = model.scene(study.runs[0], model.at_prior()).commands.before
    assert known is not None and known[0] == 0.0
