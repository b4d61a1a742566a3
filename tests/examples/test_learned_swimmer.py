"""The swimmer that learns before and after its diagnosis: task, servo, chain at its small size."""

import json

import numpy as np
import pytest
import torch
import yaml

from diffsim import soft
from diffsim.core.errors import DiffsimError
from diffsim.envs.rollout import rollout_task
from diffsim.learn import GradientLearner, GradientOptions, train
from labs.loop import open_close
from tests.examples.stories import load_story

pytest.importorskip("gymnasium", reason="tasks need the extra 'rl'")
story = load_story("sim_to_real/learned_swimmer.py")
LIMITS = story.LIMITS


def task_of(**servo):
    setup = story.SwimSetup(
        "TendonSwim", story.swim_options(story.Servo(**servo), 0.5, LIMITS), warm_up=1
    )
    return setup.make_task()


def pulled(task, level, steps=2):
    """State after control steps that ask for a share ``level`` of the limit."""
    state = task.start(1, np.random.default_rng(0))
    action = torch.full((1, 1), 2.0 * level - 1.0, dtype=torch.float64)
    for _ in range(steps):
        state, _ = task.step(state, action)
    return state


def test_slack_takes_up_what_is_pulled_first():
    rest = pulled(task_of(slack_m=0.0074), 0.4)  # 7.2 mm
    moved = pulled(task_of(), 0.4)
    assert float((rest["x"] - task_of().body.x_rest).abs().max()) < 1e-12
    assert float((moved["x"] - task_of().body.x_rest).abs().max()) > 5e-3


def test_lag_and_limited_speed_are_the_servos():
    lagging = pulled(task_of(lag_s=0.1), 1.0, steps=1)["arm"]
    slow = pulled(task_of(rate_m_s=0.03), 1.0, steps=1)["arm"]
    assert float(slow) == pytest.approx(0.1 * 0.03)  # it has not arrived
    assert 0.3 * LIMITS.contraction_m < float(lagging) < 0.7 * LIMITS.contraction_m
    assert float(pulled(task_of(), 1.0)["arm"]) == pytest.approx(LIMITS.contraction_m)


def test_command_respects_the_limits_of_the_servos_sheet():
    task = task_of()
    one = torch.ones(1, 1, dtype=torch.float64)
    first = task.ask(one, 0.0 * one)
    assert float(first) == pytest.approx(LIMITS.rate_m_s / 60.0)
    assert float(task.ask(one, LIMITS.contraction_m * one)) == pytest.approx(LIMITS.contraction_m)


def test_pulls_of_a_command_are_those_of_the_tasks_servo():
    task = task_of(lag_s=0.04, rate_m_s=0.11, slack_m=0.0074)
    command = story.STROKES["strokes"].during(1.2)
    found = task.servo.pulls(command)
    state = task.start(1, np.random.default_rng(0))
    now, expected = soft.State(state["x"], state["v"]), []
    arm = torch.tensor([[command[0]]])  # the laboratory waits there
    for asked in torch.from_numpy(command):
        now, arm = task.pulled(now, arm, asked[None, None])
        expected.append(max(float(arm) - 0.0074, 0.0))
    assert found == pytest.approx(expected, abs=1e-15)
    assert 0.009 < found.max() <= 0.018 - 0.0074  # a stroke is just long enough


def test_what_was_identified_is_what_is_trained_on():
    weak = {**story.DATA_SHEET, "axial_stiffness": 60.0}
    options = story.swim_options(story.Servo(), 0.5, LIMITS, weak)
    task = story.SwimSetup("TendonSwim", options, warm_up=1).make_task()
    bent = [float((pulled(t, 1.0)["x"] - t.body.x_rest).abs().max()) for t in (task, task_of())]
    assert bent[0] < 0.7 * bent[1]


def test_strokes_are_the_real_robots():
    """As logged in horizontal_cyclic1: 0.3 m/s up, 0.55 s, 18 mm, half of it closed."""
    period = story.STROKES["strokes"].contraction_m
    assert len(period) == 33
    assert period.max() == 0.018
    assert period.min() == 0.0
    assert np.abs(np.diff(period)).max() == pytest.approx(LIMITS.rate_m_s / 60.0)
    assert (period > 0.009).mean() == pytest.approx(0.5, abs=0.05)
    with pytest.raises(ValueError, match="closed"):
        open_close(closed=1.0, limits=LIMITS)


def test_the_rail_stops_a_push():
    """Friction opposes the center's way, and pushes at the rail's nodes only."""
    task = task_of()
    v = torch.zeros_like(task.body.x_rest)[None]
    v[..., 0] = -0.02
    force = task.on_rail(v)
    assert float(force.sum()) == pytest.approx(0.25 * 2e-3, rel=1e-6)
    assert not force[0, task.model.quarter.rail == 0.0].any()


def test_reward_knows_its_slope():
    task = task_of(lag_s=0.04, slack_m=0.002)
    torch.manual_seed(0)
    wave = torch.randn(13, 1, 1, dtype=torch.float64)

    def total(gain):
        episode = rollout_task(
            task,
            lambda _seen, k: torch.tanh(gain + wave[k]),
            task.start(1, np.random.default_rng(0)),
            13,
        )
        return episode.rewards.sum()

    gain = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(total(gain), gain)
    step = 1e-3  # steps are solved to 1e-4
    up, down = (float(total(gain.detach() + s * step)) for s in (1.0, -1.0))
    assert abs(float(slope)) > 1e-3
    assert float(slope) == pytest.approx((up - down) / (2.0 * step), rel=0.05)


def test_a_controller_steers_the_laboratory():
    lab, task = story.laboratory(0, 0.3), task_of()
    net = torch.nn.Identity()
    net.forward = lambda _seen, _k: torch.ones(1, 1).double()
    run = lab.steer(story.Steering(net, task), order=0)
    asked = run.command[story.COMMAND]
    assert np.diff(asked).max() <= LIMITS.rate_m_s / 60.0 + lab.rig.step_m
    assert asked[-1] == pytest.approx(LIMITS.contraction_m, abs=lab.rig.step_m)


def test_what_the_diagnosis_names_becomes_the_servo(tmp_path):
    def named(**effects):
        content = {"effects": {k: {"value": v} for k, v in effects.items()}}
        (tmp_path / "extended_model.yaml").write_text(yaml.safe_dump(content))
        return story.extended(tmp_path)

    found = named(rate_limit=9.0, slack=0.007)
    assert (found.rate_m_s, found.slack_m, found.lag_s) == (pytest.approx(1.0 / 9.0), 0.007, 0.0)
    assert named(lag=0.04).lag_s == 0.04
    with pytest.raises(DiffsimError, match="saturation, of which TendonSwim has no form"):
        named(saturation=0.1, slack=0.007)


def test_runs_of_another_servo_are_not_resumed(tmp_path):
    def learn(**servo):
        options = story.swim_options(story.Servo(**servo), 0.2, LIMITS)
        setup = story.SwimSetup(
            "TendonSwim", options, steps=2, evaluate_every=2, evaluation_episodes=1, warm_up=1
        )
        learner = GradientLearner(setup, GradientOptions(batch=1))
        train(setup, learner, tmp_path, resume=True, show=False)

    learn()
    with pytest.raises(ValueError, match="task_options"):
        learn(slack_m=0.007)


def test_interval_is_students():
    mean, low, high = story.interval(np.array([1.0, 2.0, 3.0]))
    assert (mean, high - mean) == (2.0, pytest.approx(4.303 / np.sqrt(3.0), rel=1e-3))
    assert low == pytest.approx(2.0 * mean - high)


@pytest.mark.slow
@pytest.mark.example
def test_whole_chain_at_its_small_size(tmp_path):
    pytest.importorskip("matplotlib", reason="needs the extra viz")
    numbers = story.main(str(tmp_path), seeds=(0,), effort=story.QUICK)
    assert {"before_cm_s", "after_cm_s", "off_before_cm_s", "off_after_cm_s"} < set(numbers)
    kept = json.loads((tmp_path / "seed_0/numbers.json").read_text())
    assert "slack" in kept["named"]
    assert kept["servo"]["slack_m"] == pytest.approx(story.HIDDEN.slack_m, rel=0.1)
    assert kept["servo"]["rate_m_s"] == pytest.approx(story.HIDDEN.rate_m_s, rel=0.1)
    plain, extended = kept["misfit_mm"]
    assert extended < 0.5 * plain
    assert (tmp_path / "learned_swimmer.png").stat().st_size > 10_000
    again = story.main(str(tmp_path), seeds=(0,), effort=story.QUICK, plot=False)
    assert again == numbers
