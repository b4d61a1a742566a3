"""From a log of a flight to an answer, by commands and a text editor alone."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diffsim.cli.main import main
from diffsim.data import load_study
from diffsim.data.names import log_column
from tests.data.flight_logs import write_rosbag, write_ulog
from tests.systems import small_copter
from tests.systems.small_copter import Causes

LAG = 0.05  # of the motors, hidden [s]
MODEL = """\
model:
  system: multicopter
  frames: {world: NED, body: FRD}
  mass: {value: 0.5, percent: 1}
  inertia: [3.6e-3, 3.7e-3, 6.5e-3]
  rotors:
    - {at: [0.12, 0.12, 0], spin: cw}
    - {at: [-0.12, -0.12, 0], spin: cw}
    - {at: [0.12, -0.12, 0], spin: ccw}
    - {at: [-0.12, 0.12, 0], spin: ccw}
  commands: {columns: [control_0, control_1, control_2, control_3], as: throttle}
  thrust: {coefficient: 8.0208, exponent: 2}
  torque_ratio: 0.0245
  sensors:
    position: [x, y, z]
    velocity: [vx, vy, vz]
    quaternion: {columns: [q_0, q_1, q_2, q_3], order: wxyz}
    body_rates: [xyz_0, xyz_1, xyz_2]
  effects: {without: [gust, slung_load]}
"""


def flights(seconds: float = 2.0):
    """Flights of the other simulator with the noise of usual sensors."""
    rng = np.random.default_rng(3)
    for kind in ("circle", "dash", "hop"):
        f = small_copter.fly(kind, Causes(motor_lag_s=LAG), seconds=seconds, fine=4)
        turn = rng.normal(0.0, 2e-3, (len(f.time), 3))
        zero = np.zeros(len(turn))
        small = np.array([[zero, -turn[:, 2], turn[:, 1]], [turn[:, 2], zero, -turn[:, 0]],
                          [-turn[:, 1], turn[:, 0], zero]]).transpose(2, 0, 1)  # fmt: skip
        yield (
            kind,
            replace(
                f,
                position=f.position + rng.normal(0.0, 2e-3, f.position.shape),
                velocity=f.velocity + rng.normal(0.0, 5e-3, f.velocity.shape),
                rotation=f.rotation @ (np.eye(3) + small),
                rates=f.rates + rng.normal(0.0, 5e-3, f.rates.shape),
            ),
        )


def diffsim(*args: str | Path) -> int:
    return main(["diagnose", *map(str, args)])


def written_in(text: str, model: str) -> str:
    """The study that `init` wrote, with the model that its user writes and nothing left to do."""
    head, rest = text[: text.index("model:\n")], text[text.index("# The clock of the files.") :]
    return head + model + rest[: rest.index("# `check` repeats these")]


def study_of_px4_logs(folder: Path, capsys, seconds: float) -> Path:
    """The study that `init` makes of three logs, ready for a diagnosis."""
    for kind, flight in flights(seconds):
        write_ulog(folder / f"{kind}.ulg", flight)
    assert diffsim("init", folder, "--system", "multicopter") == 0
    said = capsys.readouterr().out
    assert "vehicle_local_position and vehicle_attitude and vehicle_angular_velocity" in said
    assert "control_3, by its topic" in said
    file = folder / "study.yaml"
    file.write_text(written_in(file.read_text(), MODEL))
    assert diffsim("check", file) == 0, capsys.readouterr().out
    assert "ready for a diagnosis" in capsys.readouterr().out
    return file


def test_a_px4_log_is_initialized_and_checked(tmp_path, capsys):
    study_of_px4_logs(tmp_path, capsys, seconds=0.5)


@pytest.mark.slow
def test_a_px4_log_is_explained(tmp_path, capsys):
    file, out = study_of_px4_logs(tmp_path, capsys, seconds=2.0), tmp_path / "answer"
    assert diffsim("explain", file, "--quick", "--out", out) == 0
    report = json.loads((out / "report.json").read_text())
    assert (report["verdict"], report["named"]) == ("named", ["lag"]), report["sentences"]
    (size,) = next(c["size"] for c in report["causes"] if c["name"] == "lag").values()
    assert size["low"] <= LAG <= size["high"]


@pytest.mark.parametrize("as_mcap", [False, True])
def test_a_ros_2_bag_has_units_and_commands_by_convention(tmp_path, capsys, as_mcap):
    for kind, flight in flights(seconds=0.5):
        write_rosbag(tmp_path / kind, flight, as_mcap=as_mcap)
    assert diffsim("init", tmp_path, "--system", "multicopter") == 0
    said = capsys.readouterr().out
    assert "fields of topics, not used: header.stamp.sec" in said
    assert "other topics: /battery" in said
    study = load_study(tmp_path)
    units = {c.name.removeprefix("pose_pose_").removeprefix("twist_twist_"): c.unit
             for c in study.channels}  # fmt: skip
    assert (units["position_x"], units["orientation_w"]) == ("m", "-")
    assert (units["linear_z"], units["angular_y"]) == ("m/s", "rad/s")
    assert [c.name for c in study.commands] == [f"velocity_{k}" for k in range(4)]
    assert [r.name for r in study.runs] == ["circle", "dash", "hop"]
    assert not study.runs[0].setup


@pytest.mark.parametrize(
    ("part", "name", "unit"),
    [
        ("/imu/data", "linear_acceleration.z", "m/s^2"),
        ("/imu/data", "angular_velocity.x", "rad/s"),
        ("/wrench", "wrench.force.x", "N"),
        ("/tf", "transform.rotation.w", "-"),
        ("vehicle_odometry.1", "velocity[2]", "m/s"),
        ("sensor_combined", "accelerometer_m_s2[0]", "m/s^2"),
        ("battery_status", "voltage_v", "V"),
    ],
)
def test_units_of_fields_by_convention(part, name, unit):
    assert log_column(name, part).unit == unit


def test_what_nobody_needs_of_a_log_is_left_out():
    assert log_column("pose.covariance[7]", "/odom") is None
    assert log_column("xy_reset_counter", "vehicle_local_position") is None
    assert log_column("time_s", "vehicle_attitude") is not None
    assert log_column("control[0]", "actuator_motors").is_asked
