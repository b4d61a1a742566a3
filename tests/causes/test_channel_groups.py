"""Instruments: which channels are late, lagged or behind a play together."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.causes.channel_groups import channel_groups, channels_of
from diffsim.causes.signals import Grid, with_play
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.systems.registry import setup_of

STEP = 0.02
T = STEP * np.arange(150)
PLAY, LATE = 0.004, 0.05
MODEL = {
    "system": "ode",
    "parameters": {"gain": {"value": 1.0, "percent": 5}},
    "inputs": [{"name": "speed", "held": False}],
    "states": {"x": 0},
    "rates": {"x": "gain*speed"},
    "readings": {"motor": "x", "carriage": "x"},
}
CHANNELS = (
    Channel("motor", "m", "position", 1e-4),
    Channel("carriage", "m", "position", 2e-4),
)
COMMANDS = {
    "slow": 0.1 * np.sin(3.0 * T),
    "fast": 0.2 * np.sin(7.0 * T),
    "mixed": 0.1 * np.sin(2.0 * T) + 0.1 * np.sin(9.0 * T),
    "test": 0.1 * np.sin(5.0 * T) * np.sin(0.7 * T),
}


def names(channels, **options):
    return {d.name: d.channels for d in channel_groups(channels, late_record=True, **options)}


def test_channels_of_a_stated_sensor_share_its_clock():
    channels = (
        Channel("x", "m", "position", sensor="camera"),
        Channel("angle", "rad", "angle", sensor="camera"),
        Channel("joint", "rad", "angle", sensor="encoder"),
    )
    found = channel_groups(channels, late_record=False)
    clocks = {d.name: d.channels for d in found if "sensor_delay" in d.causes}
    assert clocks == {"camera": ("x", "angle"), "encoder": ("joint",)}
    zeros = {d.name: d.channels for d in found if "sensor_offset" in d.causes}
    assert zeros["position_of_camera"] == ("x",) and zeros["angle_of_camera"] == ("angle",)


def test_without_a_statement_kinds_and_each_of_few_channels_are_tried():
    one, two, three = (Channel(n, "m", "position") for n in "abc")
    angle = Channel("q", "rad", "angle")
    assert names((one, two, angle)) == {
        "": ("a", "b", "q"),
        "position": ("a", "b"),
        "angle": ("q",),
        "a": ("a",),
        "b": ("b",),
    }
    many = [Channel(f"m{i}", "m", "position") for i in range(5)]
    assert names((*many, one, angle)).keys() == {"", "position", "angle"}
    # of a record that is late as a whole nothing is known where inputs may be
    assert "" not in {d.name for d in channel_groups((one, three, angle), late_record=False)}


def test_what_no_channel_is_called_is_told():
    with pytest.raises(ValueError, match="no sensor, kind or channel 'carrige'; did you mean 'car"):
        channels_of(CHANNELS, "carrige")


def test_a_play_starts_anywhere_in_it():
    u = torch.from_numpy(np.sin(3.0 * T))
    grid, half = Grid.even(len(T), STEP), torch.tensor(0.3, dtype=torch.float64)
    for start in (-1.0, -0.4, 0.0, 1.0):
        seen = with_play(u, grid, half, torch.tensor(start, dtype=torch.float64)).numpy()
        wanted = [start * 0.3]
        for target in np.sin(3.0 * T)[1:]:
            wanted.append(min(max(wanted[-1], target - 0.3), target + 0.3))
        np.testing.assert_allclose(seen, wanted, atol=1e-15)
    given = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda s: with_play(u[:40], Grid.even(40, STEP), half, s), (given,)
    )


def runs(seed: int = 4) -> tuple[Run, ...]:
    """A motor that is read at once, and a carriage behind a play that a late camera sees."""
    rng = np.random.default_rng(seed)
    fine = np.linspace(-LATE, T[-1], 20 * len(T))
    out = []
    for order, (name, speed) in enumerate(COMMANDS.items()):
        there = np.interp(fine, T, speed) * (fine >= 0.0)
        x = np.cumsum(there) * (fine[1] - fine[0])
        carriage = [rng.uniform(-PLAY, PLAY)]
        for target in x[1:]:
            carriage.append(min(max(carriage[-1], target - PLAY), target + PLAY))
        measured = np.column_stack(
            [np.interp(T, fine, x), np.interp(T - LATE, fine, np.array(carriage))]
        )
        measured += rng.normal(size=measured.shape) * [1e-4, 2e-4]
        use = "test" if name == "test" else "fit"
        out.append(Run(name, T, measured, {"speed": speed}, name, order, use))
    return tuple(out)


@pytest.mark.story  # a whole diagnosis
def test_a_play_and_a_late_camera_on_one_of_two_alike_channels_are_named():
    study = Study("gantry", "ode", CHANNELS, runs(), model=MODEL)
    setup = setup_of(study)
    # all that two alike channels could do apart, and what they would do together
    shared = ("lag", "delay", "backlash", "dead_band")
    causes = [e for e in setup.effects if "_of_" in e.name or e.name in shared]
    assert len(causes) == 15
    report = diagnose(study, setup.model, causes, seed=0, unknowns=setup.unknowns)
    assert report.verdict == "named", report.sentences
    assert set(report.named) == {"sensor_delay_of_carriage", "sensor_backlash_of_carriage"}
    for name, truth in (
        ("sensor_delay_of_carriage", LATE),
        ("sensor_backlash_of_carriage", PLAY),
    ):
        (size,) = next(c.size for c in report.causes if c.name == name).values()
        assert size.low <= truth <= size.high and size.high - size.low < 0.1 * truth, name


def test_what_is_read_slowly_may_be_late_by_half_a_sample():
    slow = tuple(replace(r, time_s=100.0 * r.time_s) for r in runs())
    for made, usual in ((runs(), (0.03, 0.02)), (slow, (50.0 * STEP, 50.0 * STEP))):
        study = Study("gantry", "ode", CHANNELS, made, model=MODEL)
        typical = {e.name: e.typical for e in setup_of(study).effects}
        assert (typical["lag"], typical["sensor_delay_of_motor"]) == pytest.approx(usual)


def test_a_late_record_is_a_cause_where_runs_begin_in_motion():
    def causes(study):
        return {e.name for e in setup_of(study).effects}

    model = MODEL | {"readings": {"motor": "x"}}
    one = tuple(replace(r, measured=r.measured[:, :1]) for r in runs())
    study = Study("one", "ode", CHANNELS[:1], one, model=model)
    assert "sensor_delay" not in causes(study)  # a late input, exactly
    jumps = [replace(r, command={"speed": 0.1 + r.command["speed"]}) for r in study.runs]
    assert "sensor_delay" not in causes(replace(study, runs=tuple(jumps)))  # from rest
    falling = model | {"rates": {"x": "gain*speed + 0.2"}}
    assert "sensor_delay" in causes(replace(study, model=falling))
