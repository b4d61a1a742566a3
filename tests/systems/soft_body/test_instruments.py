"""Sensors of a soft body that each have a clock, a lag, a scale and a zero of their own."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from diffsim.data.study import Channel
from diffsim.diagnose import diagnose
from diffsim.systems.registry import setup_of
from diffsim.systems.soft_body.causes import tilt_camera
from tests.systems.soft_body.described import BAR, TENDON, predicted, run_of, study_of

STEP = 0.02
T = STEP * np.arange(40)
TWO = (
    Channel("tip_z_m", "m", "position", 1e-5, sensor="camera", shown_unit="mm"),
    Channel("mid_z_m", "m", "position", 1e-5, sensor="laser"),
)
SEEN = {
    "markers": {"tip": [0.08, 0.008, 0.008], "mid": [0.04, 0.008, 0.008]},
    "channels": {
        "tip_z_m": {"markers": "tip", "axis": "z"},
        "mid_z_m": {"markers": "mid", "axis": "z"},
    },
}
OFFSET = {"shape": "held", "where": {"x": 0.08}, "axes": "z", "at": 0.0, "offset": 0.01}
RUN = run_of("a", T, 2, load_kg=0.002)


class Seen:
    """What a sensor's cause needs of a scene with markers."""

    rest_places = torch.tensor([0.1, 0.0, 0.02, 0.3, -0.1, 0.0], dtype=torch.float64)

    def with_places(self, change):
        return change


def test_a_tilted_camera_turns_what_markers_move_by():
    turn = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    moved = torch.linspace(-0.02, 0.03, 18, dtype=torch.float64).reshape(3, 2, 3)
    rest = Seen.rest_places
    change = tilt_camera(Seen(), turn, RUN)
    found = change(rest + moved.flatten(1), None) - rest
    wanted = Rotation.from_rotvec(turn.numpy()).apply(moved.reshape(-1, 3).numpy())
    np.testing.assert_allclose(found.reshape(-1, 3), wanted, rtol=0, atol=1e-15)


def bar(channels=TWO, runs=(RUN,), **changes):
    return study_of(BAR, runs, channels, **{**SEEN, "start": OFFSET, **changes})


def test_causes_are_tried_for_each_stated_sensor():
    names = {e.name for e in setup_of(bar()).effects}
    own = {"sensor_delay", "sensor_lag", "sensor_scale", "sensor_offset", "sensor_drift"}
    assert {f"{n}_of_{s}" for n in own for s in ("camera", "laser")} <= names
    assert {"sensor_delay", "sensor_scale", "placement"} <= names  # of the whole record
    assert {"sensor_backlash_of_laser", "sensor_curvature_of_laser"} <= names
    alone = tuple(replace(c, sensor=None) for c in TWO)
    assert not {e.name for e in setup_of(bar(alone)).effects} & {n for n in names if "_of_" in n}
    one = tuple(replace(c, sensor="camera") for c in TWO)
    assert not {n for n in {e.name for e in setup_of(bar(one)).effects} if "_of_camera" in n}


def test_a_late_sensor_shows_what_was_and_nothing_moves_the_other():
    plain = predicted(bar())[0]
    late = predicted(bar(), {"sensor_delay_of_camera": 2.0 * STEP})[0]
    torch.testing.assert_close(late[2:, 0], plain[:-2, 0], atol=2e-9, rtol=0.0)
    torch.testing.assert_close(late[:2, 0], plain[:1, 0].expand(2))  # held until it is let go
    torch.testing.assert_close(late[:, 1], plain[:, 1])
    early = predicted(bar(), {"sensor_delay_of_camera": -2.0 * STEP})[0]
    torch.testing.assert_close(early[:-2, 0], plain[2:, 0], atol=2e-9, rtol=0.0)
    both = predicted(bar(), {"sensor_delay_of_camera": STEP, "sensor_delay": STEP})[0]
    torch.testing.assert_close(both[2:, 0], plain[:-2, 0], atol=2e-9, rtol=0.0)
    torch.testing.assert_close(both[1:, 1], plain[:-1, 1], atol=2e-9, rtol=0.0)


@pytest.mark.slow
def test_a_late_camera_beside_a_laser_is_named():
    """Records are shifted by NumPy from a fine one; the simulation has no part in the shift."""
    late, rng = 0.05, np.random.default_rng(5)
    pulls = {
        "slow": lambda t: 1e-3 * (1.0 - np.cos(2.0 * t)),
        "quick": lambda t: 8e-4 * (1.0 - np.cos(5.0 * t)),
        "mixed": lambda t: 1e-3 * np.abs(np.sin(1.5 * t)) + 4e-4 * np.sin(4.0 * t) ** 2,
        "test": lambda t: 9e-4 * (1.0 - np.cos(3.5 * t)),
    }
    fine = 0.002 * np.arange(-50, 800)
    seen = {**SEEN, "markers": {"tip": [0.08, 0.005, 0.008], "mid": [0.04, 0.005, 0.008]}}
    runs = []
    for name, pull in pulls.items():
        command = {"pull_m": pull(np.maximum(fine, 0.0))}
        exact = predicted(study_of(TENDON, (run_of(name, fine, 2, command=command),), TWO, **seen))
        tip, mid = exact[0].numpy().T
        measured = np.column_stack([np.interp(T - late, fine, tip), np.interp(T, fine, mid)])
        measured += rng.normal(0.0, 1e-5, measured.shape)
        use = "test" if name == "test" else "fit"
        made = run_of(name, T, 2, use, command={"pull_m": pull(T)})
        runs.append(replace(made, measured=measured, group=name))
    only = [f"sensor_{w}_of_{s}" for w in ("delay", "lag", "scale") for s in ("camera", "laser")]
    effects = {"only": [*only, "delay", "lag", "sensor_scale", "slack"]}
    study = study_of(TENDON, tuple(runs), TWO, **seen, effects=effects)
    setup = setup_of(study)
    report = diagnose(study, setup.model, setup.effects, settings=setup.settings, seed=0)
    assert report.named == ("sensor_delay_of_camera",), report.sentences
    (size,) = next(c.size for c in report.causes if c.name in report.named).values()
    assert size.low <= late <= size.high and size.high - size.low < 0.1 * late
