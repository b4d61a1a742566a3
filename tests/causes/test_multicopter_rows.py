"""Causes that flights have by the tables alone: commands, readings in windows, rows of a user."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.causes.ports import on_place
from diffsim.causes.row import Row
from diffsim.systems.multicopter.scene import Flyer
from diffsim.systems.registry import setup_of
from tests.causes.test_own_rows import with_rows
from tests.systems import small_copter
from tests.systems.test_copter_instruments import STEP, told
from tests.systems.test_multicopter import HOVER, straight_up
from tests.systems.test_multicopter_description import MODEL, SPEEDS, misfit, study

f64 = torch.float64
CAMERA = ["x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz"]
ON_COMMANDS = {
    *("quantization", "command_gain", "gain_slope", "command_offset"),
    *("backlash", "slack", "saturation", "rate_limit"),
}


def commanded_in_newtons(**keys):
    """A study whose commands are thrusts."""
    made = study(
        kinds=("circle",), commands={"columns": SPEEDS, "as": "thrust"}, thrust=None, **keys
    )
    runs = tuple(
        replace(r, command={n: small_copter.COEFFICIENT * u**2 for n, u in r.command.items()})
        for r in made.runs
    )
    return replace(made, runs=runs)


def flown(setup, run, effect=None, size=()):
    """Channels of windows from their first guess, (num_windows, length, num_channels)."""
    with torch.no_grad():
        scene = setup.model.scene(run, setup.model.at_prior())
        if effect is not None:
            values = {n: torch.tensor(s.value, dtype=f64) for n, s in effect.shapes.items()}
            scene = effect.act(scene, torch.as_tensor(size, dtype=f64), run, values)
        return Flyer(scene, 1)(scene.windows.guess[None])[0]


def test_causes_on_the_way_of_commands_are_there_where_a_study_asks():
    assert not {e.name for e in setup_of(study()).effects} & ON_COMMANDS
    only = [*ON_COMMANDS, "inflow"]
    found = {e.name: e for e in setup_of(study(effects={"only": only})).effects}
    assert set(found) == {*only}
    greatest = max(
        small_copter.COEFFICIENT * u.max() ** 2 for r in study().runs for u in r.command.values()
    )
    assert found["slack"].typical == pytest.approx(0.05 * greatest)
    assert found["slack"].shown_unit == "N"
    assert found["rate_limit"].words(0.5) == "a rate limit near 2 N/s"


def test_slack_of_all_rotors_at_its_size_leaves_noise():
    lost = 0.03  # [N] of each thrust
    made = commanded_in_newtons(effects={"only": ["slack"]})
    runs = tuple(replace(r, command={n: u + lost for n, u in r.command.items()}) for r in made.runs)
    made = replace(made, runs=runs)
    assert misfit(made, slack=lost) < 1.3 < 2.0 < misfit(made)


def test_a_drift_in_windows_goes_on_from_one_to_the_next():
    """It rises over the run, though each window is a flight of its own."""
    rise = torch.tensor([0.0, 0.3, 0.0], dtype=f64)
    only = [f"sensor_{kind}_of_imu" for kind in ("drift", "backlash", "curvature")]
    made = told(kinds=("circle",), windows={"length": 0.4}, effects={"only": only})
    setup, run = setup_of(made), made.runs[0]
    assert [e.name for e in setup.effects] == only  # as they act
    imu = [[c.name for c in made.channels].index(name) for name in "pqr"]
    plain = flown(setup, run)
    more = flown(setup, run, setup.effects[0], rise) - plain
    time = STEP * torch.arange(plain.shape[0] * plain.shape[1], dtype=f64)
    share = time.reshape(*plain.shape[:2], 1) / float(run.time_s[-1])
    share = torch.expm1(-0.001 * share) / np.expm1(-0.001)  # as even as makes no difference
    torch.testing.assert_close(more[..., imu], rise * share)
    assert float(more[..., : min(imu)].abs().max()) == 0.0
    drifting = run.measured.copy()
    drifting[:, imu] += rise.numpy() * run.time_s[:, None] / run.time_s[-1]
    made = replace(made, runs=(replace(run, measured=drifting),))
    assert misfit(made, sensor_drift_of_imu=rise) < 1.3 < 2.0 < misfit(made)


def test_play_of_a_reading_in_windows_is_half_its_width_behind():
    made = told(kinds=("circle",), effects={"only": ["sensor_backlash_of_baro"]})
    setup, run = setup_of(made), made.runs[0]
    z = [c.name for c in made.channels].index("z")
    plain, half = flown(setup, run)[..., z].numpy(), 2e-4
    seen = flown(setup, run, setup.effects[0], [half])[..., z].numpy()
    behind = plain[:, 0].copy()
    for k in range(plain.shape[1]):
        behind = np.clip(behind, plain[:, k] - half, plain[:, k] + half)
        np.testing.assert_allclose(seen[:, k], behind, atol=1e-12)


@pytest.mark.parametrize(
    ("row", "like", "share"),
    [
        ({"at": "command", "map": "u*(1 - size)", "of": "rotor_2"}, "weak_rotor_2", 1.0),
        ({"at": "command", "map": "u*(1 - size*t)"}, "battery_sag", 1.0),
        ({"at": "number", "add": "mass"}, "extra_mass", 1.0),
        ({"at": "number", "scale": "ground_scale"}, "ground_scale", 1.0),
        ({"at": "number", "add": "center_of_mass_y"}, "center_of_mass", [0.0, 1.0]),
        ({"at": "number", "add": "world_force_x"}, "wind", [1.0, 0.0]),
        ({"at": "reading", "map": "u + size", "of": "q"}, "gyro_offset", [0.0, 1.0, 0.0]),
        ({"at": "force", "of": "y", "law": "size"}, "wind", [0.0, 1.0]),
        ({"at": "clock", "of": CAMERA}, "camera_delay", 1.0),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_a_row_of_a_user_does_what_the_librarys_does(row, like, share):
    sensors = {**MODEL["sensors"], "velocity": ["vx", "vy", "vz"]}
    own = {"name": "mine", "typical": 0.1, **row}
    made = with_rows(commanded_in_newtons(sensors=sensors), own)
    setup, run = setup_of(made), made.runs[0]
    known = {e.name: e for e in setup.effects}
    size = 0.3 * known[like].typical
    wanted = flown(setup, run, known[like], np.atleast_1d(share) * size)
    found = flown(setup, run, known["mine"], [size])
    plain = flown(setup, run)
    moved = (wanted - plain).abs().amax((0, 1))
    if row["at"] == "clock":  # one by cubics of what was flown, the other by Taylor's series
        off = (found - wanted)[:, 2:].abs().amax((0, 1))
        assert float(off.max()) < 0.2 * float(moved.max())
    else:
        torch.testing.assert_close(found, wanted, atol=1e-9, rtol=1e-9)
    assert float(moved.max()) > 1e-6
    torch.testing.assert_close(flown(setup, run, known["mine"], [0.0]), plain, atol=1e-12, rtol=0)


def test_a_force_by_its_law_brakes_along_its_axis():
    """m v' = -c v: the way is v_0 m / c (1 - exp(-c t / m))."""
    row = Row.model_validate(
        {"name": "a", "at": "force", "kind": "force", "law": "-size*v", "typical": 1.0}
    )
    brake = row.effect(on_place(row, "x"))
    channels, t = straight_up(
        brake, torch.tensor([0.3], dtype=f64), thrust=HOVER, velocity=(5.0, 5.0, 0.0)
    )
    # the force of a step's mean speed is held over it: an error of second order
    np.testing.assert_allclose(channels[:, 0], 5.0 * (1.0 - np.exp(-0.3 * t)) / 0.3, atol=1e-4)
    np.testing.assert_allclose(channels[:, 1], 5.0 * t, atol=1e-9)


def test_a_row_that_names_no_rotor_number_or_axis_is_refused():
    rows = [
        {"name": "a", "at": "command", "map": "u*size", "of": "rotor_5", "typical": 0.1},
        {"name": "b", "at": "number", "add": "masss", "typical": 0.1},
        {"name": "c", "at": "force", "law": "-size*v", "of": "north", "typical": 0.1},
    ]
    with pytest.raises(ValueError, match="no command 'rotor_5'") as error:
        setup_of(with_rows(commanded_in_newtons(), *rows))
    said = str(error.value)
    assert "did you mean 'mass'" in said and "no force 'north'; known: x, y, z" in said
