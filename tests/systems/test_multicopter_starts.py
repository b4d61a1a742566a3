"""First guesses of states against a flight in closed form, whatever of it was recorded."""

from itertools import product

import pytest
import torch

from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.rotation import matrix_from_rpy, quaternion_from_rpy, rpy_from_matrix
from diffsim.systems.multicopter.cutting import acceleration_of, states_of
from diffsim.systems.multicopter.frames import BODIES, WORLDS, RecordingFrames
from diffsim.systems.multicopter.shooting import body_rates_from_rpy_rates

DT = 0.02
TIME = DT * torch.arange(60, dtype=torch.float64)[:, None]
PUSHED = torch.tensor([1.2, -0.7, 0.5], dtype=torch.float64)  # [m/s^2]
START = torch.tensor([[0.3, -2.0, -1.5], [0.4, 0.2, -0.1]], dtype=torch.float64)  # [m], [m/s]
TURNS = 0.8  # [rad/s]
TOLD = [
    ("position", "attitude"),
    ("position", "quaternion", "accelerometer"),
    ("position", "yaw"),
    ("position", "pitch", "yaw", "acceleration"),
    ("velocity", "yaw", "body_rates", "specific_force_in_world"),
    ("position", "velocity"),
]


def flight(yaw, turns):
    """Constantly pushed, its thrust along its axis: states of 12, and the thrust over the mass."""
    force = PUSHED - torch.tensor([0.0, 0.0, GRAVITY]).double()
    down = -(force / force.norm()).expand(len(TIME), 3)
    heading = yaw + turns * TIME
    falls = -(heading.cos() * down[:, :1] + heading.sin() * down[:, 1:2]) / down[:, 2:]
    ahead = torch.cat([heading.cos(), heading.sin(), falls], -1)
    ahead = ahead / ahead.norm(dim=-1, keepdim=True)
    rotation = torch.stack([ahead, torch.linalg.cross(down, ahead), down], -1)
    rpy = rpy_from_matrix(rotation)
    rates = body_rates_from_rpy_rates(rpy, torch.gradient(rpy, spacing=DT, dim=0, edge_order=2)[0])
    position = START[0] + START[1] * TIME + 0.5 * PUSHED * TIME**2
    return torch.cat([position, rpy, START[1] + PUSHED * TIME, rates], -1), force


@pytest.mark.parametrize("frames", [RecordingFrames(*pair) for pair in product(WORLDS, BODIES)])
@pytest.mark.parametrize("told", TOLD, ids=" ".join)
def test_states_and_accelerations_are_those_of_the_flight(told, frames):
    ahead = rpy_from_matrix(frames.rotation(torch.eye(3).double()))[2]  # what no yaw stands for
    has_yaw = told != TOLD[-1]
    states, force = flight(0.3 if has_yaw else ahead, TURNS if has_yaw else 0.0)
    rotation = matrix_from_rpy(states[:, 3:6])
    recorded = rpy_from_matrix(frames.rotation(rotation))
    rpy = recorded.clone()
    for k, name in enumerate(("roll", "pitch", "yaw")):
        if "attitude" not in told and name not in told:
            rpy[:, k] = torch.nan
    groups = {
        "position": frames.in_world(states[:, :3]),
        "velocity": frames.in_world(states[:, 6:9]),
        "acceleration": frames.in_world(PUSHED).expand(len(TIME), 3),
        "specific_force_in_world": frames.in_world(force).expand(len(TIME), 3),
        "accelerometer": frames.in_body((rotation.mT @ force[:, None])[..., 0]),
        "body_rates": frames.in_body(states[:, 9:]),
        "quaternion": 1.1 * quaternion_from_rpy(recorded),
        "attitude": rpy,
    }
    kept = {*told, "attitude"} if {"yaw", "attitude"} & {*told} else {*told}
    found = states_of({n: v for n, v in groups.items() if n in kept}, frames, DT)
    if "position" not in told:  # which is added up from the velocity
        found[:, :3] += states[0, :3] - found[0, :3]
    turned = found - states
    turned[:, 3:6] = torch.remainder(turned[:, 3:6] + torch.pi, 2.0 * torch.pi) - torch.pi
    assert float(turned[:, :3].abs().max()) < (1e-9 if "position" in told else 0.02)
    assert float(turned[:, 3:9].abs().max()) < 1e-6
    assert float(turned[8:-8, 9:].abs().max()) < 2e-3  # slopes of angles over 0.15 s
    pushed = acceleration_of({n: v for n, v in groups.items() if n in kept}, frames, found, DT)
    torch.testing.assert_close(pushed, PUSHED.expand_as(pushed), rtol=0.0, atol=1e-6)
