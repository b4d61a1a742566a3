"""An actuator that moves in steps: its map, its slopes, when it is named and when not."""

from functools import partial

import numpy as np
import pytest
import torch

from diffsim.causes.commands import CommandGroup, command_cause
from diffsim.causes.needs import needs_fine_command
from diffsim.causes.signals import Grid, after, held_in_steps, in_steps, with_play
from diffsim.data.study import Channel, Run, Study
from diffsim.data.study_file import load_study
from diffsim.data.study_save import save_study
from diffsim.systems.registry import setup_of
from tests.diagnose.discover.answers import answer

STEP = 0.37
TIMES = np.linspace(0.0, 3.0, 61) ** 1.1  # uneven
GRID = Grid(torch.from_numpy(TIMES), torch.arange(61), TIMES)
WAY = torch.from_numpy(2.0 * np.sin(3.0 * TIMES) + 0.1 * np.cos(17.0 * TIMES))


def number(value):
    return torch.tensor(value, dtype=torch.float64)


def test_a_held_command_is_rounded_to_the_nearest_step_from_zero():
    want = STEP * np.round(WAY.numpy() / STEP)
    np.testing.assert_allclose(held_in_steps(WAY, GRID, number(STEP)), want, atol=1e-15)


def test_a_straight_command_is_the_mean_of_the_steps_on_its_way():
    fine = (np.arange(20_000) + 0.5) / 20_000
    u, got = WAY.numpy(), in_steps(WAY, GRID, number(STEP)).numpy()
    for k in range(1, 60):
        ways = [u[k] + 0.5 * fine * (u[j] - u[k]) for j in (k - 1, k + 1)]
        off = [np.mean(STEP * np.round(way / STEP) - way) for way in ways]
        shares = [TIMES[k] - TIMES[k - 1], TIMES[k + 1] - TIMES[k]]
        assert got[k] == pytest.approx(u[k] + np.average(off, weights=shares), abs=2e-5)


@pytest.mark.parametrize("change", [in_steps, held_in_steps])
def test_no_step_is_the_command_and_many_sizes_are_each_alone(change):
    sizes = torch.tensor([0.0, 0.2, STEP], dtype=torch.float64)
    many = change(WAY, GRID, sizes)
    assert torch.equal(many[0], WAY)
    for size, row in zip(sizes, many, strict=True):
        torch.testing.assert_close(row, change(WAY, GRID, size), rtol=0, atol=1e-15)
    tiny = change(WAY, GRID, number(1e-9))
    assert (tiny - WAY).abs().max() < 1e-9


def test_slopes_by_size_are_those_of_differences():
    """On a plateau the whole number of steps; on the way with the places where values change."""
    rest = torch.full((5,), 2.1 * STEP, dtype=torch.float64)
    for change in (in_steps, held_in_steps):
        slope = torch.func.jacfwd(lambda s, f=change: f(rest, Grid.even(5, 0.1), s))(number(STEP))
        h = 1e-4
        ends = [change(rest, Grid.even(5, 0.1), number(s)) for s in (STEP + h, STEP - h)]
        torch.testing.assert_close(slope, (ends[0] - ends[1]) / (2.0 * h))
        torch.testing.assert_close(slope, torch.full((5,), 2.0, dtype=torch.float64))
    size = number(STEP).requires_grad_()
    assert torch.autograd.gradcheck(lambda s: in_steps(WAY, GRID, s), (size,))


def test_what_comes_before_is_felt_through_the_steps():
    """A shift of the command moves the mean of its steps as much, though each rests almost always;
    held ones have the same slopes."""
    assert torch.autograd.gradcheck(
        lambda u: in_steps(u, GRID, number(STEP)), (WAY.clone().requires_grad_(),)
    )
    even, t = Grid.even(4001, 1e-3), torch.arange(4001, dtype=torch.float64)
    slow = 3.0 * torch.sin(1.5e-3 * t)
    for change in (in_steps, held_in_steps):
        u = slow.clone().requires_grad_()
        change(u, even, number(STEP)).mean().backward()
        assert float(u.grad.sum()) == pytest.approx(1.0, abs=0.15)
    moved = held_in_steps(slow + 0.5 * STEP, even, number(STEP)) - held_in_steps(
        slow, even, number(STEP)
    )
    assert float(moved.mean()) == pytest.approx(0.5 * STEP, rel=0.15)


# A motor whose speed follows a command that a computer holds for 20 ms.
DT, TAU, NOISE = 0.02, 0.15, 0.02
TRUE_STEP = 0.83
MODEL = {
    "system": "ode",
    "states": {"speed": "0"},
    "rates": {"speed": "(gain*drive - speed)/tau"},
    "readings": {"speed_rad_s": "speed"},
    "inputs": [{"name": "drive", "held": True}],
    "parameters": {
        "gain": {"value": 1.0, "percent": 5, "unit": "rad/s"},
        "tau": {"value": 0.15, "percent": 10, "unit": "s"},
    },
}
CLOCK = DT * np.arange(300)
COMMANDS = {
    "sweep": (6.0 * np.sin(2.0 * np.pi * (0.2 + 0.05 * CLOCK) * CLOCK), "fit"),
    "ramp": (8.0 * np.abs((CLOCK / 3.0) % 2 - 1.0) - 4.0, "fit"),
    "slow": (5.0 * np.sin(1.1 * CLOCK) + 2.0 * np.sin(2.9 * CLOCK), "test"),
}


def motor(folder, drive=lambda u: u, recorded=lambda u: u, seed=0):
    """Recordings of the motor in a folder, as a stranger has them: files and ``study.yaml``."""
    from scipy.signal import lfilter

    rng, decay = np.random.default_rng(seed), np.exp(-DT / TAU)
    runs = []
    for order, (name, (u, use)) in enumerate(COMMANDS.items()):
        speed = lfilter([0.0, 1.0 - decay], [1.0, -decay], drive(u))
        measured = (speed + NOISE * rng.normal(size=len(u)))[:, None]
        runs.append(Run(name, CLOCK, measured, {"drive": recorded(u)}, name, order, use))
    channels = (Channel("speed_rad_s", "rad/s", "angular_velocity", NOISE),)
    save_study(Study("motor", "ode", channels, tuple(runs), model=MODEL), folder)
    return load_study(folder)


def in_whole_steps(u):
    return TRUE_STEP * np.round(u / TRUE_STEP)


def test_hidden_steps_are_named_with_their_size(tmp_path):
    report = answer(motor(tmp_path, in_whole_steps))
    assert (report.verdict, report.named) == ("named", ("quantization",))
    (row,) = (cause for cause in report.causes if cause.name == "quantization")
    (size,) = row.size.values()
    assert size.low < TRUE_STEP < size.high < 1.1 * size.low
    assert report.gain is not None and report.gain.low > 0.8


def test_nothing_is_named_where_the_actuator_moves_smoothly(tmp_path):
    report = answer(motor(tmp_path))
    assert (report.verdict, report.named) == ("none", ())


def test_finer_steps_than_are_tried_are_not_ruled_out(tmp_path):
    """Forty steps to the greatest command: not found, and not said to be absent."""
    finer = 6.9 / 40.0
    report = answer(motor(tmp_path, lambda u: finer * np.round(u / finer)))
    (row,) = (cause for cause in report.causes if cause.name == "quantization")
    assert report.named == () and row.size["size"].high > finer < row.smallest_visible["size"]


PLAY = partial(with_play, half_gap=number(0.3))
LOOK_ALIKES = {
    "dead_band": lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.4, 0.0),
    "saturation": lambda u: np.clip(u, -0.7 * 6.9, 0.7 * 6.9),
    "backlash": lambda u: after(
        torch.from_numpy(u), Grid.even(300, DT), PLAY, torch.tensor(0.0)
    ).numpy(),
}


@pytest.mark.parametrize("name", LOOK_ALIKES)
def test_a_look_alike_keeps_its_name(name, tmp_path):
    report = answer(motor(tmp_path, LOOK_ALIKES[name]))
    assert (report.verdict, report.named) == ("named", (name,))


def test_steps_that_were_recorded_are_no_cause(tmp_path):
    """The command was logged as the actuator made it: few values, and nothing is missing."""
    coarse = motor(tmp_path, in_whole_steps, in_whole_steps)
    setup = setup_of(coarse)
    (effect,) = (e for e in setup.effects if e.name == "quantization")
    assert "48 values or more; the recorded one has" in effect.needs(coarse)
    report = answer(coarse)
    assert (report.verdict, report.named) == ("none", ())


def test_needs_a_command_of_many_values():
    u = np.linspace(-1.0, 1.0, 100)
    channels = (Channel("x_m", "m", "position", 1e-3),)

    def study(values):
        run = Run("a", np.arange(100.0), np.zeros((100, 1)), values, "a")
        return Study("s", "ode", channels, (run,))

    assert needs_fine_command(study({"u": u})) is None
    assert needs_fine_command(study({"u": u, "v": np.sign(u)})) is None
    assert needs_fine_command(study({})) == "runs with a recorded command"
    noisy = np.round(u, 1) + 1e-9 * np.random.default_rng(0).normal(size=100)
    assert "recorded one has 21" in needs_fine_command(study({"u": noisy}))


def test_sizes_are_told_in_the_command_s_unit():
    said = command_cause("quantization", CommandGroup((), {"reach": 1.6}, unit="N"))
    assert (said.unit, said.shown_unit) == ("command", "N")
    tried = np.array(said.tries) * said.typical
    assert tried.max() == pytest.approx(0.8) and tried.min() == pytest.approx(1.6 / 24.8, rel=0.03)
    assert not said.smooth
