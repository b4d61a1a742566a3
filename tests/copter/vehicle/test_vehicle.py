"""Mass properties and rotors: the public tool's effect matrices, and the checks at the boundary."""

import json

import pytest
import torch

from diffsim.copter import GRAVITY, Multicopter
from tests.measured import data_folder

NAMES = ["quadcopter", "pentacopter", "y6copter"]


def reference(name):
    facts = json.loads((data_folder("copter_reference") / "reference_copters.json").read_text())
    return facts["copters"][name]


def of_rotors(facts, key):
    return torch.tensor([r[key] for r in facts["rotors"]], dtype=torch.float64)


def from_reference(facts):
    """A flipped rotor pushes against its axis and turns the other way seen from above."""
    sign = 1.0 - 2.0 * of_rotors(facts, "flip").double()
    return Multicopter(
        mass=torch.tensor(facts["mass"], dtype=torch.float64),
        inertia=torch.tensor(facts["inertia_body"], dtype=torch.float64),
        positions=of_rotors(facts, "pos_body"),
        directions=sign[:, None] * of_rotors(facts, "dir_body"),
        spins=sign * (1.0 - 2.0 * of_rotors(facts, "is_ccw").double()),
        torque_ratios=of_rotors(facts, "torque_to_thrust"),
        max_thrusts=of_rotors(facts, "max_thrust"),
        radii=torch.full((len(facts["rotors"]),), 0.127, dtype=torch.float64),
    )


def plus_quadcopter(**changes):
    """Arms of 0.25 m along x and y, 1.2 kg."""
    arm = 0.25
    positions = [[arm, 0, 0], [0, arm, 0], [-arm, 0, 0], [0, -arm, 0]]
    values = {
        "mass": 1.2,
        "inertia": [[0.02, 0, 0], [0, 0.022, 0], [0, 0, 0.04]],
        "positions": positions,
        "directions": [[0.0, 0.0, -1.0]] * 4,
        "spins": [1.0, -1.0, 1.0, -1.0],
        "torque_ratios": [0.0147] * 4,
        "max_thrusts": [7.2] * 4,
        "radii": [0.127] * 4,
    } | changes
    return Multicopter(**{k: torch.as_tensor(v, dtype=torch.float64) for k, v in values.items()})


@pytest.mark.parametrize("name", NAMES)
def test_effect_matrix_of_public_tool(name):
    facts = reference(name)
    copter = from_reference(facts)
    expected = torch.tensor(facts["effect_matrix_6xn"], dtype=torch.float64)
    torch.testing.assert_close(copter.force_matrix, expected[:3], atol=1e-12, rtol=0)
    torch.testing.assert_close(copter.torque_matrix, expected[3:], atol=1e-12, rtol=0)


def test_weight():
    assert float(plus_quadcopter().weight) == pytest.approx(1.2 * GRAVITY)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": -1.0}, "mass must be above 0 kg"),
        ({"inertia": [[0.02, 0, 0], [0, -0.022, 0], [0, 0, 0.04]]}, "positive definite"),
        ({"inertia": [[0.02, 1e-3, 0], [0, 0.022, 0], [0, 0, 0.04]]}, "asymmetry"),
        ({"directions": [[0.0, 0.0, -2.0]] + [[0.0, 0.0, -1.0]] * 3}, "rotor 0 has length 2"),
        ({"spins": [1.0, 0.5, 1.0, -1.0]}, "spins must be"),
    ],
)
def test_bad_input(changes, message):
    with pytest.raises(ValueError, match=message):
        plus_quadcopter(**changes)
