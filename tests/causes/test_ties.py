"""What several members have alike: ties, exchanges, a bus; rows of drives against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.causes.ports import SignalChange
from diffsim.causes.scene import Commands
from diffsim.causes.signals import MAPS, Grid, accelerated, held_accelerated
from diffsim.causes.ties import tie
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.identify import Problem, WhiteNoise, fit
from diffsim.systems.registry import setup_of
from labs.search_compare.drives import DRIVES

T = 0.01 * np.arange(120)
MODEL = {
    "system": "ode",
    "inputs": [{"name": f"u{k}", "held": False} for k in range(3)],
    "states": {f"q{k}": 0 for k in range(3)},
    "rates": {f"q{k}": f"20*(u{k} - q{k})" for k in range(3)},
    "readings": {f"y{k}": f"q{k}" for k in range(3)},
    "parameters": {"unused": {"value": 1.0, "percent": 5}},
}


def study(units=("rad", "rad", "rad")):
    """Three joints that follow their commands, of which the third has another unit or not."""
    rng = np.random.default_rng(0)
    runs = []
    for n in range(3):
        u = {f"u{k}": np.sin((k + 1.0 + n) * T) * (T > 0.1) for k in range(3)}
        runs.append(Run(f"r{n}", T, rng.normal(size=(120, 3)), u, f"r{n}", n, "fit"))
    channels = tuple(Channel(f"y{k}", "rad", "angle", 1e-3) for k in range(3))
    commands = tuple(Command(f"u{k}", unit) for k, unit in enumerate(units))
    return Study("joints", "ode", channels, tuple(runs), commands=commands, model=MODEL)


def shown(setup, run, *sizes):
    """Channels with causes at sizes."""
    given = {e: torch.tensor([size], dtype=torch.float64) for e, size in sizes}
    return setup.model.predict(run, setup.model.at_prior(), given)


@pytest.fixture(scope="module")
def joints():
    made = study()
    setup = setup_of(made)
    return made.runs[0], setup, {e.name: e for e in setup.effects}


@pytest.mark.parametrize("row", ["delay", "command_gain", "dead_band"])
def test_a_tie_is_its_members_with_one_size(joints, row):
    run, setup, known = joints
    whole = known[f"{row}_of_all_commands"]
    assert whole.members == tuple(f"{row}_of_u{k}" for k in range(3))
    each = [(known[name], whole.typical) for name in whole.members]
    both = shown(setup, run, (whole, whole.typical))
    torch.testing.assert_close(both, shown(setup, run, *each), rtol=1e-12, atol=1e-12)
    some = tie([known[name] for name in whole.members[:2]], "some")
    torch.testing.assert_close(
        shown(setup, run, (some, whole.typical)), shown(setup, run, *each[:2]), rtol=1e-12, atol=0
    )


@pytest.mark.parametrize("row", ["delay", "gain_drift", "slow_share"])
def test_a_member_acts_beside_its_tie_with_a_size_of_its_own(joints, row):
    """Causes by formulas took the tie's size for the member's: the sum acted twice, or not."""
    run, setup, known = joints
    run = replace(run, order=2)
    whole, one = known[f"{row}_of_all_commands"], known[f"{row}_of_u1"]
    others = [known[f"{row}_of_u{k}"] for k in (0, 2)]
    both = shown(setup, run, (whole, whole.typical), (one, 0.5 * whole.typical))
    apart = shown(setup, run, *[(e, whole.typical) for e in others])
    torch.testing.assert_close(both[:, [0, 2]], apart[:, [0, 2]], rtol=1e-12, atol=1e-12)
    for sizes in ((0.0, one.typical), (one.typical, 0.0)):  # either alone
        alone = shown(setup, run, (one, one.typical))[:, 1]
        given = zip((whole, one), sizes, strict=True)
        torch.testing.assert_close(shown(setup, run, *given)[:, 1], alone, rtol=1e-12, atol=1e-12)
    assert (both[:, 1] - alone).abs().max() > 1e-3


def test_sizes_are_tied_by_their_unit_and_times_whatever_they_delay():
    names = {e.name for e in setup_of(study(("rad", "rad", "N m"))).effects}
    assert {"delay_of_all_commands", "command_gain_of_all_commands_in_rad"} <= names
    assert "command_gain_of_all_commands" not in names
    assert {n for n in names if n.startswith("exchanged")} == {"exchanged_of_u0_and_u1"}
    with pytest.raises(ValueError, match="two causes or more"):
        tie([], "none")


def test_gains_alone_and_tied_are_tried_at_the_factors_of_gears(joints):
    gains = [e for name, e in joints[2].items() if name.startswith("command_gain")]
    assert len(gains) == 4 and all(e.scanned for e in gains)
    for e in gains:
        factors = [1.0 + e.typical * times for times in e.tries]
        assert factors == pytest.approx([0.25, 0.5, 2.0, 4.0])


def test_exchanged_commands_and_channels_are_each_others(joints):
    run, setup, known = joints
    plain = shown(setup, run)
    for name in ("exchanged_of_u0_and_u2", "sensor_exchanged_of_y0_and_y2"):
        found = shown(setup, run, (known[name], 1.0))
        torch.testing.assert_close(found, plain[:, [2, 1, 0]], rtol=1e-12, atol=1e-12)


def test_the_age_of_readings_grows_along_the_bus(joints):
    run, setup, known = joints
    plain, found = shown(setup, run), shown(setup, run, (known["bus_age"], 0.02))
    for k in range(3):  # of two samples more from one to the next
        torch.testing.assert_close(found[2 * k :, k], plain[: 120 - 2 * k, k], rtol=0, atol=1e-12)


def test_a_profile_is_that_of_constant_acceleration():
    grid, a, v = Grid.even(400, 0.01), 2.0, 1.0
    step = torch.ones(400, dtype=torch.float64)
    step[0] = 0.0
    t = grid.times - 0.01
    slowness, cruise = torch.tensor([1 / a, v**2 / a], dtype=torch.float64)
    place = accelerated(step, grid, slowness, cruise, held=True)
    ways = [0.5 * a * t**2, 0.25 + v * (t - 0.5), 1.0 - 0.5 * a * (1.5 - t) ** 2]
    expected = torch.where(t < 0.5, ways[0], torch.where(t < 1.0, ways[1], ways[2]))
    expected = torch.where(t < 0, 0.0, torch.where(t > 1.5, 1.0, expected))
    torch.testing.assert_close(place, expected.double(), rtol=0, atol=1e-3)
    u = torch.from_numpy(np.random.default_rng(1).normal(size=12).cumsum())
    none = torch.zeros(2, dtype=torch.float64)
    assert torch.equal(held_accelerated(u, Grid.even(12, 0.1), none), u.expand(2, 12))


@pytest.mark.parametrize(
    ("rig", "seed", "cause", "limit"),
    [
        ("elastic", 0, "elastic_coupling_at_joint", 1.1),
        ("elastic_arm", 0, "elastic_coupling_at_joint1", 1.1),
        pytest.param("elastic_arm", 1, "elastic_coupling_at_joint2", 1.1, marks=pytest.mark.story),
        ("late_torque", 0, "delay_inside_motor", 1.4),
    ],
)
def test_rows_of_joints_leave_the_noise_of_rigs_that_others_integrated(rig, seed, cause, limit):
    made = DRIVES[rig].record(seed, False)
    setup = setup_of(made)
    effect = next(e for e in setup.effects if e.name == cause)

    found = fit(
        setup.model, made.fit_runs[:3], made.channels, effects=[effect],
        start=np.r_[np.zeros(len(setup.model.base)), 0.7], max_evaluations=15,
    )  # fmt: skip
    left = [
        run.measured - found.problem.predict(run, torch.from_numpy(found.x)).detach().numpy()
        for run in made.fit_runs[:3]
    ]
    assert np.sqrt(np.mean(np.concatenate(left) ** 2)) < limit * made.channels[0].sd


def test_sizes_that_are_simulated_together_are_those_of_one_by_one():
    """Of what a controller says late, commands came as late as the first size of a batch says:
    slopes of a delay were twice as large as they are, and its fits ended anywhere."""
    made = DRIVES["late_torque"].record(0, False)
    setup = setup_of(made)
    for effect in setup.effects:
        problem = Problem(setup.model, made.fit_runs[:1], WhiteNoise(made.channels), (effect,))
        points = np.zeros((3, len(problem.names)))
        points[:, problem.columns_of(effect)] = np.array([[0.5], [0.2], [0.9]])
        together, alone = problem.records(points), [problem.record(x) for x in points]
        np.testing.assert_allclose(together, alone, rtol=0, atol=1e-10, err_msg=effect.name)


@pytest.mark.parametrize("row", ["delayed", "lagged", "slowed", "with_play", "in_steps"])
def test_points_at_which_a_command_changes_alike_are_heard_once_with_the_same_bits(row):
    grid = Grid.even(len(T), 0.01)
    u = torch.from_numpy(np.random.default_rng(1).normal(size=(2, len(T))))
    drawn = torch.tensor([0.02, 0.3, 0.02, 0.0, 0.3, 0.02], dtype=torch.float64)[:, None]
    asked = []

    def counted(signal, grid, size):
        asked.append(len(size))
        return MAPS[row]["straight"](signal, grid, size)

    commands = Commands.named(("a", "b"), u).changed(
        (), SignalChange(counted, drawn, is_plain=True)
    )
    with torch.no_grad():
        heard = commands.each_heard(grid)
        alone = [SignalChange(counted, size, is_plain=True)(u, grid) for size in drawn]
    assert asked[:2] == [3, 3]
    for k in range(2):
        assert torch.equal(heard[k], torch.stack([one[k] for one in alone]))
    commands.each_heard(grid)  # where slopes are asked for, every point has its own
    assert asked[-1] == len(drawn)
