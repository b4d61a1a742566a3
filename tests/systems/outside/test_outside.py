"""A simulator of the user's own: how it is found, called, changed and blamed."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from pydantic import TypeAdapter

from diffsim.data.study import Channel, Command, Run, Study
from diffsim.diagnose import diagnose
from diffsim.identify import Parameter
from diffsim.identify.problem import PredictionError
from diffsim.systems.outside import Environment, Place, SimulatorError, outside_setup
from diffsim.systems.outside.description import AnyQuantity
from diffsim.systems.outside.environment import SteppedSimulator
from diffsim.systems.outside.forces import (
    ForceKnots,
    PlaceForces,
    Term,
)
from diffsim.systems.registry import description_of, setup_of
from tests.systems.outside import scenes
from tests.systems.outside.pendulum_sim import Cart, Pendulum, fails_when_heavy


def study_with(**changes) -> Study:
    """The recorded pendulum with other keys under ``model``."""
    study = scenes.recorded()
    return replace(study, model={**study.model, **changes})


def effect_of(setup, name):
    return next(e for e in setup.effects if e.name == name)


def predicted(setup, run, name, *size):
    sizes = {effect_of(setup, name): torch.tensor(size, dtype=torch.float64)}
    return setup.model.predict(run, setup.model.at_prior(), sizes).numpy()


def test_friction_at_a_hinge_is_named_with_its_size():
    study = scenes.recorded(Term("hinge", scenes.law_of("dry_friction"), 0.04, scale=3.0))
    setup = setup_of(study)
    rivals = ("lag", "delay", "dead_band", "backlash", "slack")  # beside all that act at the hinge
    causes = [e for e in setup.effects if e.name.endswith("_at_hinge") or e.name in rivals]
    assert len(causes) == 12
    report = diagnose(study, setup.model, causes, unknowns=setup.unknowns, seed=0)
    assert report.verdict == "named", report.sentences
    assert report.named == ("dry_friction_at_hinge",)
    size = report.best.values["dry_friction_at_hinge"]
    sd = report.best.sd["dry_friction_at_hinge"]
    assert abs(size - 0.04) < 3.0 * sd < 0.01


def test_forces_that_the_simulator_adds_equal_those_of_its_own():
    run = scenes.run_of("sine")
    own = Pendulum(4).predict({**scenes.TRUTH, "damping": 0.09}, run)
    added = Pendulum(4).predict(
        {**scenes.TRUTH, "damping": 0.0},
        run,
        PlaceForces(["hinge"], [Term("hinge", scenes.law_of("viscous_friction"), 0.09)]),
    )
    np.testing.assert_allclose(added, own, atol=1e-12)


@pytest.mark.parametrize(
    ("law", "force"),
    [
        ("viscous_friction", -1.5),
        ("square_drag", -4.5),
        ("dry_friction", -0.5),
        ("added_spring", -1.0),
    ],
)
def test_laws_hold_back_both_ways(law, force):
    at_hinge = PlaceForces(["hinge"], [Term("hinge", scenes.law_of(law), 0.5, scale=1.0)])
    assert at_hinge(0.0, [2.0], [3.0])[0] == pytest.approx(force, rel=1e-12)
    assert at_hinge(0.0, [-2.0], [-3.0])[0] == pytest.approx(-force, rel=1e-12)


def test_names_that_the_hooks_ask_for():
    names = {e.name for e in setup_of(scenes.recorded()).effects}
    assert {"lag", "delay", "dead_band", "backlash", "saturation", "rate_limit"} <= names
    assert {"constant_force_at_hinge", "added_spring_at_hinge", "square_drag_at_hinge"} <= names
    assert {"sensor_scale_of_angle", "sensor_delay_of_velocity", "sensor_drift_of_angle"} <= names
    hooks = {
        "force": {"hinge": {"unit": "N m", "typical": 0.05}},
        "output": {"disk": ["angle_rad"]},
    }
    fewer = {e.name for e in setup_of(study_with(hooks=hooks)).effects}
    assert "constant_force_at_hinge" in fewer and "sensor_scale_of_disk" in fewer
    assert not any(n.startswith(("added", "viscous", "sensor_scale_of_angle")) for n in fewer)


def test_commands_that_are_never_negative_have_slack_instead_of_a_dead_band():
    study = scenes.recorded()
    pulled = [replace(r, command={"moment_Nm": abs(r.command["moment_Nm"])}) for r in study.runs]
    names = {e.name for e in setup_of(replace(study, runs=tuple(pulled))).effects}
    assert "slack" in names and "dead_band" not in names


def test_commands_at_uneven_times_are_delayed_alike():
    run = scenes.run_of("sine")
    time = run.time_s + 0.004 * np.sin(np.arange(len(run.time_s)))
    uneven = replace(run, time_s=time, command={"moment_Nm": 1.2 * np.sin(5.0 * time)})
    setup = setup_of(scenes.recorded())
    sizes = {effect_of(setup, "delay"): torch.tensor([0.1], dtype=torch.float64)}
    heard = setup.model.scene(uneven, setup.model.at_prior(), sizes).job().run.command["moment_Nm"]
    want = 1.2 * np.sin(5.0 * (time - 0.1))
    np.testing.assert_allclose(heard[10:-2], want[10:-2], atol=5e-3)


def test_a_start_value_of_each_run_reaches_the_simulator_by_its_plain_name():
    start = {"angle": {"value": 0.0, "sd": 0.1, "per": "run"}}
    setup = setup_of(study_with(start=start))
    names = [p.name for p in setup.model.base]
    assert {"angle@sine_a", "angle@chirp"} <= set(names)
    q = setup.model.at_prior()
    q[names.index("angle@sine_a")] = 2.0
    study = scenes.recorded()
    moved = setup.model.predict(study.runs[0], q).numpy()
    assert moved[0, 0] == pytest.approx(0.2)
    assert setup.model.predict(study.runs[2], q).numpy()[0, 0] == 0.0


def test_unknown_forces_follow_their_knots():
    knots = ForceKnots("hinge", 1.0, 0.5, (0.0, 2.0, 1.0))
    assert [knots.at(t) for t in (0.0, 1.25, 1.5, 1.75, 9.0)] == [0.0, 1.0, 2.0, 1.5, 1.0]
    (unknown,) = setup_of(scenes.recorded()).unknowns
    assert unknown.name == "unknown force at hinge"


def test_a_failing_simulator_is_reported_with_run_and_parameters():
    study = scenes.recorded()
    setup = outside_setup(study, fails_when_heavy, [Parameter("inertia", 1.0, 0.1)])
    with pytest.raises(SimulatorError, match=r"run sine_a at inertia = 1.*ZeroDivisionError: too"):
        setup.model.predict(study.runs[0], setup.model.at_prior())
    assert issubclass(SimulatorError, PredictionError)  # a search goes on with other sets


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (np.zeros((120, 3)), r"shape \(120, 3\) for run sine_a; it must return \(120, 2\)"),
        (np.zeros(120), r"shape \(120,\)"),
        ({"angle_rad": np.zeros(120)}, "without rate_rad_s"),
    ],
)
def test_a_wrong_shape_is_said_at_the_boundary(returned, message):
    study = scenes.recorded()
    setup = outside_setup(study, lambda parameters, run: returned, [])
    with pytest.raises(ValueError, match=message):
        setup.model.predict(study.runs[0], setup.model.at_prior())


def test_what_a_simulator_offers_may_have_no_default():
    study = scenes.recorded()

    def predict(parameters, run, force):
        return np.full((len(run.time_s), 2), force(0.0, [0.0], [0.0])[0])

    setup = outside_setup(study, predict, [], places=[Place("hinge", "N m", 0.05)])
    assert (predicted(setup, study.runs[0], "constant_force_at_hinge", 0.3) == 0.3).all()


def test_channels_by_name_are_taken_in_the_order_of_the_study():
    study = scenes.recorded()
    by_name = {"rate_rad_s": np.ones(120), "angle_rad": np.zeros(120)}
    setup = outside_setup(study, lambda parameters, run: by_name, [])
    out = setup.model.predict(study.runs[0], setup.model.at_prior()).numpy()
    np.testing.assert_array_equal(out[0], [0.0, 1.0])


@pytest.mark.parametrize(
    ("given", "value", "sd", "unit"),
    [
        ("1200 g", 1.2, None, "kg"),
        ({"value": "30 ms", "sd": "5 ms"}, 0.03, 0.005, "s"),
        ({"value": "4.2 kg", "percent": 3}, 4.2, None, "kg"),
        ({"value": "1.2 kg", "unit": "g"}, 1200.0, None, "g"),
        ({"value": 1.2, "sd": 0.1}, 1.2, 0.1, "-"),
    ],
)
def test_numbers_with_units_are_in_si_or_in_the_stated_unit(given, value, sd, unit):
    read = TypeAdapter(AnyQuantity).validate_python(given)
    assert read.value == pytest.approx(value) and read.unit == unit
    assert read.sd == (None if sd is None else pytest.approx(sd))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"simulator": "absent.py:Pendulum"}, "no file .*absent.py"),
        ({"simulator": "pendulum_sim.py"}, "must read FILE.py:NAME"),
        ({"hooks": {"command": {"motor": ["torque_Nm"]}}}, "hooks.command.motor: no 'torque_Nm'"),
        ({"hooks": {"output": {"disk": ["angel_rad"]}}}, "hooks.output.disk: no 'angel_rad'"),
        ({"environment": {"action": ["torque"]}}, "environment.action: no command 'torque'"),
        ({"environment": {"observation": [0]}}, "1 entries for 2 channels"),
    ],
)
def test_check_finds_it_without_running_the_simulator(changes, message):
    study = study_with(**changes)
    (found,) = description_of(study).problems(study)
    assert re.search(message, found.message)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"simulator": "pendulum_sim.py:Pendulm"}, "has no 'Pendulm'; did you mean 'Pendulum'"),
        ({"options": {"step": 2}}, "cannot be made from options"),
        ({"hook": {}}, "no key 'hook' here"),
        ({"start": {"inertia": 1.0}}, "in parameters or in start, not in both"),
        ({"hooks": {"force": {"a": {"unit": "kg", "typical": 1}}}}, "hooks.force.a.unit"),
        (
            {"simulator": "pendulum_sim.py:Cart", "environment": {"time_step": 0.01}},
            "takes no force",
        ),
    ],
)
def test_what_cannot_be_used_is_said(changes, message):
    with pytest.raises(ValueError, match=message):
        setup_of(study_with(**changes))


def test_a_changed_file_is_another_model(tmp_path):
    text = (scenes.HERE / "pendulum_sim.py").read_text(encoding="utf-8")
    (tmp_path / "pendulum_sim.py").write_text(text, encoding="utf-8")
    before = setup_of(replace(scenes.recorded(), folder=tmp_path)).model.name
    (tmp_path / "pendulum_sim.py").write_text(text + "\n", encoding="utf-8")
    assert setup_of(replace(scenes.recorded(), folder=tmp_path)).model.name != before


def test_numerics_reach_a_simulator_that_takes_a_time_step():
    from diffsim.identify.numerics import Numerics

    study = scenes.recorded()
    setup, run = setup_of(study), study.runs[0]
    q = setup.model.at_prior()
    coarse = setup.model.predict(run, q, numerics=Numerics(time_step=2.0)).numpy()
    fine = setup.model.predict(run, q, numerics=Numerics(time_step=0.25)).numpy()
    plain = setup.model.predict(run, q).numpy()
    assert 0.0 < np.abs(plain - fine).max() < 0.1 * np.abs(coarse - fine).max()


def test_workers_predict_the_same():
    study = study_with(workers=2)
    one, two = setup_of(scenes.recorded()), setup_of(study)
    q = torch.zeros(3, len(one.model.base), dtype=torch.float64)
    q[:, 0] = torch.tensor([-1.0, 0.0, 1.0])
    sizes = {effect_of(two, "added_spring_at_hinge"): torch.full((3, 1), 0.1, dtype=torch.float64)}
    own = {effect_of(one, "added_spring_at_hinge"): torch.full((3, 1), 0.1, dtype=torch.float64)}
    run = study.runs[0]
    many = two.model.predict_many(run, q, sizes)
    assert torch.equal(many, one.model.predict_many(run, q, own))


def cart_study() -> Study:
    time = 0.02 * np.arange(60)
    channels = (Channel("position_m", "m", "position", sd=1e-3),)
    push = np.where(time < 0.6, 1.0, -1.0)
    runs = [
        Run(n, time, np.zeros((60, 1)), {"force_N": push}, n, i) for i, n in enumerate(("a", "b"))
    ]
    return Study("cart", "outside", channels, tuple(runs))


def test_an_environment_is_stepped_under_the_commands():
    study = cart_study()
    setup = outside_setup(
        study,
        Cart(),
        [Parameter("mass", 2.0, 0.1), Parameter("damping", 0.0, 0.1)],
        environment=Environment(observation=(0,)),
        held=True,
    )
    out = setup.model.predict(study.runs[0], setup.model.at_prior()).numpy()[:, 0]
    time, dt = study.runs[0].time_s, Cart.dt
    # explicit Euler under 1 N on 2 kg: half of t (t - dt) times the acceleration
    early = time < 0.6
    np.testing.assert_allclose(out[early], 0.25 * time[early] * (time[early] - dt), atol=1e-12)


class Heard:
    """An environment that keeps the actions of its steps."""

    dt = 0.1

    def reset(self, seed):
        self.actions = []
        return np.zeros(1), {}

    def step(self, action):
        self.actions.append(float(action[0]))
        return np.zeros(1), 0.0, False, False, {}


def test_each_step_of_an_environment_hears_the_command_of_its_beginning():
    time, heard = 0.1 * np.arange(5), Heard()
    run = Run("a", time, np.zeros((5, 1)), {"u": np.arange(5.0)}, "a", 0)
    SteppedSimulator(heard, Environment()).predict({}, run)
    assert heard.actions == [0.0, 1.0, 2.0, 3.0]


def test_entries_of_an_environment_are_set_after_reset():
    study = cart_study()
    start = [Parameter("state[0]", 0.3, 0.1), Parameter("state[1]", 1.0, 0.1)]
    more = [Parameter("mass", 1.0, 0.1), Parameter("damping", 0.0, 0.1)]
    setup = outside_setup(study, Cart(), [*start, *more], environment=Environment(observation=(0,)))
    still = replace(study.runs[0], command={"force_N": np.zeros(60)})
    out = setup.model.predict(still, setup.model.at_prior()).numpy()[:, 0]
    np.testing.assert_allclose(out, 0.3 + study.runs[0].time_s, atol=1e-12)


def test_an_attribute_that_an_environment_lacks_is_said():
    study = cart_study()
    setup = outside_setup(study, Cart(), [Parameter("weight", 1.0, 0.1)])
    with pytest.raises(SimulatorError, match="Cart has no attribute 'weight'"):
        setup.model.predict(study.runs[0], setup.model.at_prior())


def test_a_place_from_python():
    study = scenes.recorded()
    setup = outside_setup(
        study,
        Pendulum(),
        [Parameter("inertia", 0.2, 0.1, log=True), Parameter("damping", 0.05, 0.02)],
        places=[Place("hinge", "N m", 0.05, distance=0.5)],
    )
    run = study.runs[0]
    sizes = {effect_of(setup, "added_spring_at_hinge"): torch.tensor([0.3], dtype=torch.float64)}
    want = Pendulum().predict(
        {"inertia": 0.2, "damping": 0.05},
        run,
        PlaceForces(["hinge"], [Term("hinge", scenes.law_of("added_spring"), 0.3)]),
    )
    got = setup.model.predict(run, setup.model.at_prior(), sizes).numpy()
    np.testing.assert_array_equal(got, want)


def test_a_registered_environment_by_its_name():
    pytest.importorskip("gymnasium", reason="Gymnasium is not installed")
    time = 0.05 * np.arange(40)
    channels = (Channel("height", "-", "position", sd=1e-3), Channel("rate", "rad/s", "x", sd=1e-2))
    runs = [Run(n, time, np.zeros((40, 2)), {"moment": np.zeros(40)}, n, 0) for n in ("a", "b")]
    model = {
        "system": "outside",
        "simulator": "gym:Pendulum-v1",
        "commands_are": "held",
        "environment": {"observation": [0, 2]},
        "parameters": {"m": {"value": 1.0, "percent": 10}, "l": 1.0, "g": 10.0},
        "start": {"state[0]": {"value": 3.0, "sd": 0.1, "per": "run"}, "state[1]": 0.0},
    }
    study = Study("swing", "outside", channels, tuple(runs), model=model)
    setup = setup_of(study)
    own = [p.name for p in setup.model.base if "play" not in p.name and not p.of_effect]
    assert own == ["m", "state[0]@a", "state[0]@b"]
    seen = setup.model.predict(runs[0], setup.model.at_prior()).numpy()
    assert seen[0] == pytest.approx([np.cos(3.0), 0.0])
    # semi-implicit Euler, as the environment steps: 3 g / 2 l sin(angle)
    assert seen[1, 1] == pytest.approx(0.05 * 15.0 * np.sin(3.0), rel=1e-5)


def test_a_delay_of_straight_commands_does_not_smooth_them():
    """Half a sample late, straight lines would be read at their middles: a low-pass filter."""
    run = scenes.run_of("sine")
    time = np.arange(0.0, 2.0, 0.02)
    fast = replace(
        run,
        time_s=time,
        measured=np.zeros((len(time), run.measured.shape[1])),
        command={"moment_Nm": np.sin(15.0 * time)},
    )
    setup = setup_of(scenes.recorded())
    sizes = {effect_of(setup, "delay"): torch.tensor([0.01], dtype=torch.float64)}
    heard = setup.model.scene(fast, setup.model.at_prior(), sizes).job().run.command["moment_Nm"]
    by_lines = np.interp(time - 0.01, time, np.sin(15.0 * time))
    true = np.sin(15.0 * (time - 0.01))
    assert np.std((heard - true)[5:]) < 0.5 * np.std((by_lines - true)[5:])
    assert not effect_of(setup, "delay").signed


def test_held_commands_go_on_in_rows_that_are_lost():
    """A sound leg of which 2 % of the rows were lost left 3.1 times the noise: "unknown"."""

    def held(parameters, run):
        steps = np.append(0.0, np.diff(run.time_s))
        moved = np.append(0.0, np.cumsum((run.command["moment_Nm"] * np.roll(steps, -1))[:-1]))
        return parameters["inertia"] * np.stack([moved, moved], axis=1)

    study = scenes.recorded()
    setup = outside_setup(study, held, [Parameter("inertia", 1.0, 0.1)], held=True)
    whole = next(run for run in study.runs if run.group == "sine")
    kept = np.delete(np.arange(len(whole.time_s)), [30, 70, 71])
    lost = replace(whole.mapped(lambda values: values[kept]), time_s=whole.time_s[kept])
    at = setup.model.at_prior()
    expected = setup.model.predict(whole, at)[kept].numpy()
    np.testing.assert_allclose(setup.model.predict(lost, at).numpy(), expected, atol=5e-4)


def test_sizes_of_commands_are_said_in_their_unit():
    """A play of 0.1 N m was "backlash 0.1"."""
    study = scenes.recorded()
    units = (
        replace(study.commands[0], unit="N m") if study.commands else Command("moment_Nm", "N m")
    )
    setup = setup_of(replace(study, commands=(units,)))
    assert effect_of(setup, "backlash").shown_unit == "N m"
