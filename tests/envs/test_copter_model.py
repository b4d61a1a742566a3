"""A diagnosis's model file as the copter of an environment."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from diffsim.copter import BodyDrag, FlightEffects, FlightState, MotorLag, fly
from diffsim.envs import make_task, make_vector
from diffsim.envs.copter_random import delayed
from diffsim.systems.multicopter.extended import CopterSizes

COMMAND = torch.tensor([0.2, -0.1, 0.3, 0.1], dtype=torch.float64)
STATE = ("position", "quaternion", "velocity", "body_rates", "thrusts")
FLU = {"frames": {"world": "ENU", "body": "FLU"}}


def entry(value: float, sd: float = 0.0) -> dict:
    return {"value": value, "sd": sd, "unit": "-"}


def saved(folder: Path, effects: dict, parameters: dict | None = None, **more: object) -> Path:
    content = {"model": "multicopter", "study": "flights", "verdict": "named"}
    content |= {"parameters": parameters or {}, "effects": effects, **more}
    path = folder / "extended_model.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def flown(task, steps: int = 4, batch: int = 1) -> tuple[dict, dict]:
    """Start and end of a flight under one command."""
    state = start = task.start(batch, np.random.default_rng(0))
    for _ in range(steps):
        state, _ = task.step(state, COMMAND.expand(batch, 4))
    return start, state


def assert_flies_as(task, vehicle, effects, gains=1.0, steps: int = 4) -> None:
    """The task's flight is that of a vehicle made by hand."""
    start, end = flown(task, steps)
    begin = FlightState(*(start[key] for key in STATE))
    thrusts = ((task.trim + task.span * COMMAND) * gains).expand(1, steps, 4)
    by_hand = fly(vehicle, begin, thrusts, dt=task.dt, effects=effects).state
    for key in ("position", "velocity", "body_rates"):
        torch.testing.assert_close(end[key], getattr(by_hand, key)[:, -1], rtol=1e-9, atol=1e-11)


def usual(linear: float = 0.0, quadratic: float = 0.0, tau: float | None = None) -> FlightEffects:
    tau = float(np.float32(0.03)) if tau is None else tau
    flat = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    return FlightEffects(
        motor_lag=MotorLag(time_constants=tau * torch.ones(4, dtype=torch.float64)),
        body_drag=BodyDrag(
            linear=linear * flat, quadratic=quadratic * torch.ones(3, dtype=torch.float64)
        ),
    )


def test_a_file_without_causes_is_the_design_without_drag(tmp_path):
    path = saved(tmp_path, {})
    task = make_task("CopterHover", model=path)
    assert_flies_as(task, task.vehicle, usual())


@pytest.mark.parametrize("name", ["weak_rotor_2", "rotor_2_share", "thrust_loss_2"])
def test_a_rotors_lost_thrust_arrives(tmp_path, name):
    parameters = {"rotor_2_share": entry(0.8)} if name == "rotor_2_share" else {}
    effects = {} if parameters else {name: entry(0.2)}
    task = make_task("CopterHover", model=saved(tmp_path, effects, parameters))
    gains = torch.tensor([1.0, 0.8, 1.0, 1.0], dtype=torch.float64)
    vehicle = task.vehicle
    if name == "thrust_loss_2":  # of the thrust alone: for the same torque
        vehicle = vehicle.replace(torque_ratios=vehicle.torque_ratios / gains)
    assert_flies_as(task, vehicle, usual(), gains)


def test_mass_gains_lag_and_drag_arrive(tmp_path):
    parameters = {
        "mass": entry(0.6),
        "thrust_gain": entry(1.1),
        "torque_gain": entry(1.3),
        "inertia_gain": entry(0.8),
        "motor_lag": entry(0.07),
        "inertia_xx": entry(0.011),
    }
    effects = {
        "extra_mass": entry(0.1),
        "body_drag": entry(0.4),
        "parasitic_drag": entry(0.05),
        "torque_loss_3": entry(0.25),
    }
    task = make_task("CopterHover", model=saved(tmp_path, effects, parameters), seconds=2.0)
    inertia = task.vehicle.inertia.clone()
    inertia[0, 0] = 0.011
    kept = torch.tensor([1.0, 1.0, 0.75, 1.0], dtype=torch.float64)
    vehicle = task.vehicle.replace(
        mass=torch.tensor(0.7, dtype=torch.float64),
        inertia=0.8 * inertia,
        torque_ratios=1.3 * kept * task.vehicle.torque_ratios,
    )
    assert_flies_as(task, vehicle, usual(0.4, 0.05, 0.07), 1.1)


@pytest.mark.parametrize("name", ["center_of_mass", "center_of_mass_y"])
def test_a_center_of_mass_arrives_in_the_recordings_frame(tmp_path, name):
    by_cause = {"center_of_mass.x": entry(0.01), "center_of_mass.y": entry(0.02)}
    described = {"center_of_mass_x": entry(0.01), "center_of_mass_y": entry(0.02)}
    is_cause = name == "center_of_mass"
    path = saved(
        tmp_path, by_cause if is_cause else {}, {} if is_cause else described, frame=dict(FLU)
    )
    task = make_task("CopterHover", model=path)
    shift = torch.tensor([0.01, -0.02, 0.0], dtype=torch.float64)  # left is minus right
    vehicle = task.vehicle.replace(positions=task.vehicle.positions - shift)
    assert_flies_as(task, vehicle, usual())


def test_a_delay_of_two_steps_acts_two_steps_later(tmp_path):
    late = make_task("CopterHover", model=saved(tmp_path, {"delay": entry(0.04)}))
    soon = make_task("CopterHover", model=saved(tmp_path, {}), action_delay=2)
    (_, a), (_, b) = flown(late), flown(soon)
    torch.testing.assert_close(a["velocity"], b["velocity"], rtol=1e-12, atol=1e-12)


def test_a_delay_between_steps_mixes_what_was_asked():
    queue = torch.tensor([[[1.0], [2.0], [4.0]]], dtype=torch.float64)
    asked = torch.tensor([[8.0]], dtype=torch.float64)
    acting, kept = delayed(queue, asked, torch.tensor([1.25], dtype=torch.float64))
    assert acting.item() == pytest.approx(0.75 * 4.0 + 0.25 * 2.0)
    assert kept.flatten().tolist() == [2.0, 4.0, 8.0]


def test_members_draw_their_own_sizes_by_the_seed(tmp_path):
    path = saved(tmp_path, {"weak_rotor_1": entry(0.1, 0.03)}, {"mass_gain": entry(1.2, 0.05)})
    task = make_task("CopterTrack", model=path, posterior=True)
    draws = [task.start(3, np.random.default_rng(s))["random.model"] for s in (7, 7, 8)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    assert len(set(draws[0][:, 0].tolist())) == 3
    _, end = flown(task, batch=3)
    assert torch.equal(end["random.model"], task.start(3, np.random.default_rng(0))["random.model"])
    # a member flies as one whose file holds what was drawn
    mass, weak = end["random.model"][1].tolist()
    path = saved(tmp_path, {"weak_rotor_1": entry(weak)}, {"mass_gain": entry(mass)})
    alone = make_task("CopterTrack", model=path)
    start = task.start(3, np.random.default_rng(0))
    one = {k: v[1:2] for k, v in start.items() if k != "random.model"}
    for _ in range(4):
        one, _ = alone.step(one, COMMAND[None])
    torch.testing.assert_close(one["velocity"], end["velocity"][1:2], rtol=1e-9, atol=1e-11)


def test_draws_have_the_files_spread_and_correlation(tmp_path):
    path = saved(
        tmp_path,
        {"body_drag": entry(0.01, 0.02)},
        {"mass_gain": entry(1.2, 0.06), "thrust_gain": entry(1.0, 0.05)},
        correlation={"thrust_gain": {"mass_gain": 0.98}},
    )
    sizes = CopterSizes.read(path, 4)
    draws = sizes.draw(4000, np.random.default_rng(0)).numpy()
    logs = np.log(draws[:, :2])
    assert logs.std(0) == pytest.approx([0.05, 0.05], rel=0.05)
    assert np.corrcoef(logs.T)[0, 1] == pytest.approx(0.98, abs=0.005)
    assert draws[:, 2].min() == 0.0  # the air never pushes


def test_a_vector_environment_draws_anew_for_every_episode(tmp_path):
    path = saved(tmp_path, {"delay": entry(0.03, 0.01)})
    envs = make_vector("CopterHover", 4, model=path, posterior=True, seconds=0.1)
    envs.reset(seed=3)
    first = envs.state["random.model"].clone()
    for _ in range(6):
        envs.step(np.zeros((4, 4), dtype=np.float32))
    assert not torch.isclose(first, envs.state["random.model"]).any()


@pytest.mark.parametrize(
    ("causes", "parameters", "said"),
    [
        *(
            ([name, "weak_rotor_1"], [], rf"extended_model.yaml: {name} cannot be simulated")
            for name in ("wind.x", "gyroscopic", "gyro_offset.x", "weak_rotor_5")
        ),
        ([], ["thrust_coefficient"], "thrust_coefficient cannot be simulated"),
        ([], ["center_of_mass_x"], "in which frame center_of_mass_x is"),
    ],
)
def test_what_cannot_be_simulated_is_refused_by_name(tmp_path, causes, parameters, said):
    path = saved(tmp_path, *(dict.fromkeys(names, entry(0.01)) for names in (causes, parameters)))
    with pytest.raises(ValueError, match=said):
        make_task("CopterHover", model=path)


def test_what_instruments_and_runs_had_is_set_aside_and_said(tmp_path):
    names = ["attitude_offset_x", "specific_force_offset_z", "clock@run_1", "thrust_gain@run_1"]
    path = saved(tmp_path, {}, {name: entry(0.5) for name in names})
    task = make_task("CopterHover", model=path)
    assert set(task.sizes.set_aside) == set(names)
    assert_flies_as(task, task.vehicle, usual())


@pytest.mark.parametrize("system", ["soft body", "ode", ""])
def test_a_file_of_another_system_is_refused(tmp_path, system):
    path = saved(tmp_path, {})
    path.write_text(path.read_text().replace("model: multicopter", f"model: '{system}'"))
    with pytest.raises(ValueError, match="not of a multicopter"):
        make_task("CopterHover", model=path)


def test_options_that_contradict_the_file_are_refused(tmp_path):
    path = saved(tmp_path, {"body_drag": entry(0.1)}, {"motor_lag": entry(0.05)})
    with pytest.raises(ValueError, match="drag is that of"):
        make_task("CopterHover", model=path, drag=0.2)
    with pytest.raises(ValueError, match="motor_time_constant is that of"):
        make_task("CopterHover", model=path, motor_time_constant=0.02)
    with pytest.raises(ValueError, match="posterior needs a model"):
        make_task("CopterHover", posterior=True)
