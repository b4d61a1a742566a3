"""Every quantity of a copter that may be drawn per episode acts as a vehicle that has it."""

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from diffsim.copter import (
    Battery,
    BodyDrag,
    FlightEffects,
    FlightState,
    MotorLag,
    fly,
    load_design,
    rotor_model,
)
from diffsim.envs import Randomization, make_task, make_vector

FACTORS = torch.tensor([0.7, 1.3], dtype=torch.float64)
COMMAND = torch.tensor([0.2, -0.1, 0.3, 0.1], dtype=torch.float64)
BATTERY = Battery.lipo(cells=3, capacity_mah=1300)


def flown(name: str) -> tuple:
    """Velocities and rates after four steps: the task's, and those of vehicles made by hand."""
    bounds = (0.5, 1.0) if name == "battery" else (0.5, 2.0)
    battery = BATTERY if name == "battery" else None
    task = make_task(
        "CopterHover", randomization=Randomization({name: bounds}), battery=battery, drag=0.5
    )
    start = task.start(2, np.random.default_rng(0))
    factors = FACTORS.clamp(max=1.0) if name == "battery" else FACTORS
    state = start = start | {f"random.{name}": factors}
    if name == "battery":
        state = start = start | {"charge": factors.clone()}
    for _ in range(4):
        state, _ = task.step(state, COMMAND.expand(2, 4))
    by_hand = []
    vehicle = task.vehicle
    for k, f in enumerate(factors):
        change = {"mass": vehicle.mass * f} if name == "mass" else {}
        change |= {"inertia": vehicle.inertia * f} if name == "inertia" else {}
        linear = 0.5 * (f if name == "drag" else 1.0) * torch.ones(3, dtype=torch.float64)
        tau = float(np.float32(0.03)) * (f if name == "motor_lag" else 1.0)
        effects = FlightEffects(
            motor_lag=MotorLag(time_constants=tau * torch.ones(4, dtype=torch.float64)),
            body_drag=BodyDrag(linear=linear, quadratic=torch.zeros(3, dtype=torch.float64)),
            battery=None if battery is None else task.sag,
        )
        charge = f[None] if name == "battery" else None
        keys = ("position", "quaternion", "velocity", "body_rates", "thrusts")
        begin = FlightState(*(start[key][k : k + 1] for key in keys), charge=charge)
        thrusts = (task.trim + task.span * COMMAND).expand(1, 4, 4)
        end = fly(vehicle.replace(**change), begin, thrusts, dt=task.dt, effects=effects).state
        by_hand.append(torch.cat([end.velocity[0, -1], end.body_rates[0, -1]]))
    return torch.cat([state["velocity"], state["body_rates"]], 1), torch.stack(by_hand)


@pytest.mark.parametrize("name", ["mass", "inertia", "drag", "motor_lag", "battery"])
def test_a_factor_is_a_vehicle_that_has_it(name: str) -> None:
    ours, theirs = flown(name)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-13)
    assert not torch.allclose(ours[0] - ours[1], torch.zeros(6, dtype=torch.float64), atol=1e-6)


def test_all_at_once_in_a_batch_with_restarts() -> None:
    names = ("thrust", "mass", "inertia", "drag", "motor_lag", "battery")
    drawn = Randomization({name: (0.8, 1.0) for name in names})
    env = make_vector("CopterHover", 3, randomization=drawn, battery=BATTERY, seconds=0.06)
    env.reset(seed=0)
    first = env.state["random.mass"].clone()
    for _ in range(4):
        env.step(np.zeros((3, 4), dtype=np.float32))
    assert (env.state["random.mass"] != first).all()  # drawn anew for the second episode
    assert bool((env.state["charge"] < 1.0).all())


def test_gradients_flow_past_randomized_parameters() -> None:
    task = make_task("CopterHover", randomization=Randomization({"mass": (0.8, 1.2)}))
    state = task.start(2, np.random.default_rng(0))
    action = torch.zeros(2, 4, dtype=torch.float64, requires_grad=True)
    for _ in range(2):
        state, reward = task.step(state, action)
    reward.sum().backward()
    assert bool((action.grad.abs() > 0.0).all())


def test_refusals() -> None:
    with pytest.raises(ValueError, match="battery"):
        make_task("CopterHover", randomization=Randomization({"battery": (0.5, 1.0)}))
    with pytest.raises(ValueError, match="charge"):
        make_task(
            "CopterHover", battery=BATTERY, randomization=Randomization({"battery": (0.5, 1.5)})
        )
    vehicle = load_design("quadcopter").multicopter().replace(rotor_models=())
    with pytest.raises(ValueError, match="rotor_models"):
        make_task("CopterHover", design=vehicle, battery=BATTERY)
    assert rotor_model  # what a battery's sag is made of
