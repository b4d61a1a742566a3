"""Does hardware execute what it is told, and record in the study's format?"""

import ast
import inspect
from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.study_save import save_study
from labs.loop import AwaitingRecordingError, Command, FileHardware, Limits, rod_swimmer
from labs.loop.hardware import as_study
from labs.loop.laboratory import VirtualLaboratory
from labs.loop.model import CHANNELS
from labs.loop.recordings import COMMAND
from labs.loop.rod_swimmer import DT, STEPS_PER_SAMPLE, RodSwimmer, Truth

PULSE = Command(0.005 * (1.0 - np.cos(2.0 * np.pi * np.arange(30) / 30)))
LAB = VirtualLaboratory(duration_s=0.5)


@pytest.fixture(scope="module")
def recording():
    return LAB.execute(PULSE, order=0)


def test_recording_has_the_study_format(recording):
    assert recording.measured.shape == (30, len(CHANNELS))
    assert recording.time_s[1] == pytest.approx(1.0 / 60.0)
    # the servo goes to whole steps: what was executed differs from what was asked
    steps = recording.command[COMMAND] / LAB.rig.step_m
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    off = np.abs(recording.command[COMMAND] - PULSE.contraction_m)
    assert 0.0 < off.max() <= 0.5 * LAB.rig.step_m + 1e-12


def test_legs_close_towards_the_flat_side(recording):
    moved = recording.measured[20] - recording.measured[0]
    tip_x, tip_z = moved[[0, 6]], moved[[1, 7]]
    assert (tip_x > 2e-3).all()
    assert tip_z[0] > 1e-3  # the lower tip goes up,
    assert tip_z[1] < -1e-3  # the upper one down


def test_equal_orders_repeat_and_others_scatter(recording):
    again, other = LAB.execute(PULSE, order=0), LAB.execute(PULSE, order=1)
    np.testing.assert_array_equal(again.measured, recording.measured)
    assert np.nanmax(np.abs(other.measured - recording.measured)) > 1e-4


def test_commands_beyond_the_limits_are_refused():
    with pytest.raises(ValueError, match="must lie in"):
        LAB.execute(Command(np.linspace(0.0, 0.05, 30)), order=0)


def test_a_controller_that_knows_the_command_moves_the_robot_alike():
    lab = replace(LAB, scatter=0.0)
    still = Command(np.append(np.zeros(6), PULSE.contraction_m))  # the servo waits at its start
    executed = lab.execute(still, order=0)
    steered = lab.steer(lambda t, _seen: still.contraction_m[round(60.0 * t)], order=0)
    np.testing.assert_array_equal(steered.command[COMMAND], executed.command[COMMAND])
    a, b = (run.measured - run.measured[0] for run in (executed, steered))
    assert np.nanmax(np.abs(a)) > 5e-3
    assert np.nanmax(np.abs(a - b)) < 6e-4  # noise, pixels, and a half sample of clock


def test_a_controller_sees_what_is_recorded_and_lost_markers_stay():
    lab, seen = replace(LAB, rig=replace(LAB.rig, lost=0.3)), []

    def policy(_time, places):
        seen.append(places)
        return 0.005

    run = lab.steer(policy, order=3)
    seen = np.array(seen)
    lost = np.isnan(run.measured)
    assert lost.any() and not np.isnan(seen).any()
    np.testing.assert_array_equal(seen[~lost], run.measured[~lost])
    after = lost[1:]
    np.testing.assert_array_equal(seen[1:][after], seen[:-1][after])


def test_a_controller_beyond_the_limits_is_refused():
    with pytest.raises(ValueError, match="clamp what it asks for"):
        LAB.steer(lambda _t, _seen: 0.05, order=0)


def test_the_laboratory_shares_no_code_with_the_model():
    tree = ast.parse(inspect.getsource(rod_swimmer))
    imported = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    imported |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    assert imported <= {"__future__", "dataclasses", "numpy", "numpy.typing"}


def test_robot_rests_without_pull_and_without_current():
    places = RodSwimmer(Truth()).run(np.zeros(10 * STEPS_PER_SAMPLE))
    assert np.abs(places - places[0]).max() < 1e-12


def test_forces_inside_the_robot_do_not_push_it():
    """Without water's drag, rail and current, the center of all momentum stays."""
    free = Truth(
        crossflow_flat=0.0, crossflow_top=0.0, skin=0.0, core_drag=0.0, rail_friction=0.0, added=0.0
    )
    robot = RodSwimmer(free)
    time = DT * np.arange(20 * STEPS_PER_SAMPLE)
    places = robot.run(0.006 * np.clip(time / 0.15, 0.0, 1.0))
    legs = (robot.mass * places[:, :, 1:, 0]).sum((1, 2))
    core = robot.core_mass * places[:, 0, 0, 0]
    assert np.ptp(legs) > 1e-5  # [kg m]: the legs do move
    assert np.ptp(legs + core) < 1e-9 * np.ptp(legs)


def test_files_are_awaited_then_read(tmp_path, recording):
    rig = FileHardware(folder=tmp_path, duration_s=0.5, limits=Limits())
    with pytest.raises(AwaitingRecordingError, match="run_3"):
        rig.execute(PULSE, order=3)
    table = np.genfromtxt(tmp_path / "command_3.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(table[COMMAND], PULSE.contraction_m)
    save_study(as_study(recording, "a rig"), tmp_path / "run_3")
    found = rig.execute(PULSE, order=3)
    assert found.order == 3
    np.testing.assert_array_equal(found.measured, recording.measured)


def test_files_with_other_channels_are_refused(tmp_path, recording):
    study = as_study(recording, "a rig")
    short = replace(recording, measured=recording.measured[:, :2])
    save_study(replace(study, channels=study.channels[:2], runs=(short,)), tmp_path / "run_0")
    with pytest.raises(ValueError, match="m4_z_m"):
        FileHardware(folder=tmp_path).execute(PULSE, order=0)


def test_water_shares_the_momentum_across_a_leg():
    """m v + m_water (v . n) n is the momentum, m_water that of a cylinder of the leg's width."""
    truth = Truth()
    robot = RodSwimmer(truth)
    now = robot.rest_state()
    random = np.random.default_rng(0)
    momentum = 1e-3 * random.standard_normal(now.momentum.shape)
    turn = 0.3 * random.standard_normal(now.momentum.shape[:-1])
    across = np.stack([np.cos(turn), np.sin(turn)], -1)
    robot._move(now.at, now.velocity, momentum, across, 0.0)
    normal = across.copy()
    normal[:, :-1] += across[:, 1:]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    ends = np.append(robot.length[:-1] + robot.length[1:], robot.length[-1]) / 2.0
    cylinder = truth.added * 1000.0 * np.pi * (rod_swimmer.WIDTH / 2.0) ** 2 * ends
    v = now.velocity[:, 1:]
    moved = robot.mass[:, None] * v
    moved += (cylinder * (v * normal).sum(-1))[..., None] * normal
    np.testing.assert_allclose(moved, momentum, rtol=1e-9, atol=1e-15)
