"""A diagnosed copter in ``fly`` and in the design for waypoints."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from diffsim import cli, optim
from diffsim.copter import (
    BodyDrag,
    Feedback,
    FlightEffects,
    FlightState,
    Multicopter,
    fly,
    hover,
    load_design,
)
from diffsim.copter.waypoints import WaypointTask
from diffsim.core import DiffsimError
from diffsim.systems.multicopter import ExtendedCopter

f64 = torch.float64
PARAMETERS = {"mass": (0.62, 0.01), "thrust_gain": (1.05, 0.02)}
CAUSES = {"weak_rotor_2": (0.1, 0.02), "body_drag": (0.3, 0.05)}


def written(folder: Path, causes: dict, parameters: dict | None = None) -> Path:
    parts = [
        {n: {"value": v, "sd": sd, "unit": "-"} for n, (v, sd) in part.items()}
        for part in (parameters or {}, causes)
    ]
    content = {"model": "multicopter", "verdict": "named", "parameters": parts[0]}
    path = folder / "extended_model.yaml"
    path.write_text(yaml.safe_dump(content | {"effects": parts[1]}), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def vehicle() -> Multicopter:
    return load_design("quadcopter").multicopter()


def begin() -> FlightState:
    return FlightState.at_rest(torch.zeros(1, 3, dtype=f64), torch.zeros(1, 3, dtype=f64))


def thrusts(vehicle: Multicopter, steps: int = 20) -> torch.Tensor:
    hovering = hover(vehicle).thrusts.detach()
    ways = torch.tensor([0.05, -0.03, 0.02, 0.0], dtype=f64) * torch.linspace(0, 1, steps)[:, None]
    return (hovering * (1.0 + ways))[None]


def test_flies_as_a_vehicle_changed_by_hand(tmp_path, vehicle):
    copter = ExtendedCopter.read(written(tmp_path, CAUSES, PARAMETERS), vehicle)
    found = copter.fly(vehicle, begin(), thrusts(vehicle), dt=0.02).state
    flat = torch.tensor([0.3, 0.3, 0.0], dtype=f64)
    by_hand = fly(
        vehicle.replace(mass=torch.tensor(0.62, dtype=f64)),
        begin(),
        1.05 * torch.tensor([1.0, 0.9, 1.0, 1.0], dtype=f64) * thrusts(vehicle),
        dt=0.02,
        effects=FlightEffects(body_drag=BodyDrag(linear=flat, quadratic=0.0 * flat)),
    ).state
    for key in ("position", "velocity", "quaternion"):
        torch.testing.assert_close(
            getattr(found, key), getattr(by_hand, key), rtol=1e-10, atol=1e-12
        )


def test_a_feedbacks_thrust_is_weakened_too(tmp_path, vehicle):
    copter = ExtendedCopter.read(written(tmp_path, {"weak_rotor_2": (0.2, 0.0)}), vehicle)
    rng = torch.Generator().manual_seed(0)
    gain = 0.1 * torch.randn(4, 12, generator=rng, dtype=f64)
    target = torch.zeros(12, dtype=f64)
    found = copter.fly(
        vehicle, begin(), thrusts(vehicle), dt=0.02, feedback=Feedback(gain=gain, reference=target)
    )
    kept = torch.tensor([1.0, 0.8, 1.0, 1.0], dtype=f64)
    by_hand = fly(
        vehicle,
        begin(),
        kept * thrusts(vehicle),
        dt=0.02,
        feedback=Feedback(gain=kept[:, None] * gain, reference=target),
    )
    torch.testing.assert_close(found.state.position, by_hand.state.position, rtol=1e-12, atol=0.0)


@pytest.mark.grad
def test_gradient_of_sizes_and_commands(tmp_path, vehicle):
    causes = CAUSES | {"delay": (0.013, 0.002), "lag": (0.04, 0.01)}
    copter = ExtendedCopter.read(written(tmp_path, causes, PARAMETERS), vehicle)
    asked, at = thrusts(vehicle), copter.at
    rng = torch.Generator().manual_seed(1)
    ways = [torch.randn(v.shape, generator=rng, dtype=f64) for v in (asked, at)]
    ways[1] = ways[1] * at

    def end(commands: torch.Tensor, sizes: torch.Tensor) -> torch.Tensor:
        flown = replace(copter, at=sizes).fly(vehicle, begin(), commands, dt=0.02)
        return flown.state.position[0, -1] @ torch.tensor([1.0, 0.7, -0.4], dtype=f64)

    leaves = [v.clone().requires_grad_() for v in (asked, at)]
    slopes = torch.autograd.grad(end(*leaves), leaves)
    for k, h in ((0, 1e-6), (1, 1e-6)):
        moved = [
            [
                v + (s * h * w if i == k else 0.0)
                for i, (v, w) in enumerate(zip((asked, at), ways, strict=True))
            ]
            for s in (1.0, -1.0)
        ]
        difference = float(end(*moved[0]) - end(*moved[1])) / (2.0 * h)
        assert float((slopes[k] * ways[k]).sum()) == pytest.approx(difference, rel=1e-5)


def test_members_are_draws_that_come_again_by_their_seed(tmp_path, vehicle):
    copter = ExtendedCopter.read(written(tmp_path, CAUSES, PARAMETERS), vehicle)
    one, same, other = (copter.drawn(3, np.random.default_rng(s)) for s in (0, 0, 1))
    assert torch.equal(one.at, same.at) and not torch.equal(one.at, other.at)
    ends = one.fly(vehicle, begin(), thrusts(vehicle), dt=0.02).state.position[:, -1]
    assert ends.shape == (3, 3) and (ends[0] - ends[1]).norm() > 1e-4
    alone = replace(one, at=one.at[2:]).fly(vehicle, begin(), thrusts(vehicle), dt=0.02)
    torch.testing.assert_close(alone.state.position[0, -1], ends[2], rtol=1e-12, atol=1e-14)


def test_a_delay_of_two_steps_flies_the_commands_of_two_steps_ago(tmp_path, vehicle):
    copter = ExtendedCopter.read(written(tmp_path, {"delay": (0.04, 0.0)}), vehicle)
    asked = thrusts(vehicle)
    late = torch.cat([asked[:, :1], asked[:, :1], asked[:, :-2]], 1)
    found = copter.fly(vehicle, begin(), asked, dt=0.02).state.position
    by_hand = fly(vehicle, begin(), late, dt=0.02).state.position
    torch.testing.assert_close(found, by_hand, rtol=1e-9, atol=1e-12)
    feedback = Feedback(gain=torch.zeros(4, 12, dtype=f64), reference=torch.zeros(12, dtype=f64))
    with pytest.raises(ValueError, match="make_task"):
        copter.fly(vehicle, begin(), asked, dt=0.02, feedback=feedback)


def test_another_design_is_off_by_the_same_share_of_its_mass(tmp_path, vehicle):
    path = written(tmp_path, {}, {"mass": (1.1 * float(vehicle.mass), 0.0)})
    copter = ExtendedCopter.read(path, vehicle)
    heavy = vehicle.replace(mass=2.0 * vehicle.mass)
    found = copter.fly(heavy, begin(), thrusts(vehicle), dt=0.02).state.position
    by_hand = fly(
        vehicle.replace(mass=2.2 * vehicle.mass), begin(), thrusts(vehicle), dt=0.02
    ).state.position
    torch.testing.assert_close(found, by_hand, rtol=1e-12, atol=1e-14)


@pytest.mark.story
def test_a_design_for_the_diagnosed_copter_serves_it_better_than_one_for_the_plain(tmp_path):
    plain = WaypointTask(num_episodes=4, num_waypoints=1, seconds=1.0, dt=0.02)
    vehicle = plain.airframe.vehicle(plain.airframe.conventional)
    causes = {"weak_rotor_1": (0.25, 0.02), "lag": (0.12, 0.01)}
    copter = ExtendedCopter.read(written(tmp_path, causes), vehicle)
    tasks = {
        "plain": plain,
        "diagnosed": replace(plain, flies=copter.fly),
        "drawn": replace(plain, flies=copter.drawn(4, np.random.default_rng(0)).fly),
    }
    (tmp_path / "rig").mkdir()
    hidden = {"weak_rotor_1": (0.27, 0.0), "lag": (0.11, 0.0)}
    rig = ExtendedCopter.read(written(tmp_path / "rig", hidden), vehicle)
    flown = replace(plain, flies=rig.fly)
    options = optim.Options(
        budget=optim.Budget(25), wall=optim.Wall(failures=(DiffsimError,))
    )  # a design that does not hover
    loss = {
        name: flown.value(
            optim.minimize(task.value_and_gradient, task.start.numpy(), task.bounds, options).x
        )
        for name, task in tasks.items()
    }
    assert loss["diagnosed"] < 0.95 * loss["plain"]
    assert loss["drawn"] < 0.95 * loss["plain"]


def test_the_simulator_flies_it_step_by_step(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("diffsim.cli.fly._save", lambda *_: None)  # pictures: test_fly.py
    argv = ["fly", "quadcopter", "--seconds", "1.5"]
    path = written(tmp_path, {"weak_rotor_1": (0.15, 0.0)})
    errors = []
    for more in ([], ["--model", str(path)]):
        assert cli.main([*argv, *more]) == 0
        said = capsys.readouterr().out
        errors.append(float(said.split("rms_position_error_m")[1].split()[0]))
    assert "says: weak_rotor_1" in said
    assert errors[1] > 1.3 * errors[0]
    late = written(tmp_path, {"delay": (0.02, 0.0)})
    assert cli.main([*argv, "--model", str(late)]) == 2
    assert "make_task" in capsys.readouterr().err
