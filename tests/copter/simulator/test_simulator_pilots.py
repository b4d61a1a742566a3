"""Missions, sticks and the wall clock."""

import sys
import types

import numpy as np
import pytest

from diffsim.copter.simulator import (
    Pacer,
    RecordedSticks,
    StickPilot,
    Sticks,
    example_sticks,
    load_mission,
    load_sticks,
    mission_from_text,
    shipped_missions,
)
from diffsim.copter.simulator.live_input import LiveSticks, NoInputError

AWAY = """\
name: away
steps:
  - take_off: {height: 2, speed: 1}
  - fly_to: {north: 8, east: 6, speed: 2}
  - yaw: {degrees: 190, rate: 60}
  - land
"""


def sampled(mission, dt=1e-3):
    time = np.arange(0.0, mission.duration + dt, dt)
    points = [mission.setpoint(t) for t in time]
    return time, np.array([[*p.position, p.yaw] for p in points]), points


@pytest.mark.property
def test_mission_is_smooth_and_within_its_speeds():
    mission = mission_from_text(AWAY)
    time, pose, points = sampled(mission)
    rate = np.gradient(pose, time, axis=0)
    said = np.array([[*p.velocity, p.yaw_rate] for p in points])
    # second derivatives jump nowhere, third ones between legs: 1e-3 s apart
    np.testing.assert_allclose(rate[1:-1], said[1:-1], atol=2e-3)
    speed = np.linalg.norm(rate[:, :3], axis=1)
    flying_away = (time > mission.legs[1].start) & (time < mission.legs[2].start)
    assert speed[flying_away].max() == pytest.approx(2.0, rel=1e-3)
    assert np.abs(rate[:, 3]).max() <= np.radians(60.0) + 1e-3
    acceleration = np.gradient(rate, time, axis=0)
    said = np.array([p.acceleration for p in points])
    np.testing.assert_allclose(acceleration[5:-5, :3], said[5:-5], atol=2e-2)  # kinks of legs
    assert np.linalg.norm(acceleration[5:-5, :3], axis=1).max() < 1.5 * 1.01


def test_mission_goes_where_it_says():
    mission = mission_from_text(AWAY)
    _, pose, points = sampled(mission)
    np.testing.assert_allclose(pose[-1], [8.0, 6.0, 0.0, np.radians(-170.0)], atol=1e-9)
    assert not points[-1].motors_on and points[0].motors_on
    assert mission.legs[1].at(mission.legs[1].start).position == (0.0, 0.0, -2.0)


def test_shipped_missions_load():
    assert shipped_missions() == ("carry", "hover", "there_and_back")
    for name in shipped_missions():
        assert load_mission(name).legs[0].name == "take_off"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: x", "steps: is missing"),
        ("steps: []", "steps: must have 1 or more entries"),
        ("- a", "must be a mapping"),
        ("stepz: []", "did you mean 'steps'"),
        ("steps:\n  - take_of: {height: 1}", r"steps\[0\]: .*did you mean 'take_off'"),
        ("steps:\n  - take_off: {hight: 1}", r"steps\[0\].take_off: .*did you mean 'height'"),
        ("steps:\n  - take_off: {}", r"steps\[0\].take_off.height: is missing$"),
        ("steps:\n  - take_off: {height: high}", r"steps\[0\].take_off.height: must be a number"),
        ("steps:\n  - take_off: {height: -1}", "height: must be above 0, got -1"),
        ("steps:\n  - take_off: {height: .inf}", "height: must be a finite number, got inf"),
        ("steps:\n  - hover: {seconds: 1}", r"steps\[0\]: hover on the ground.*take_off before"),
        (
            "steps:\n  - take_off: {height: 1}\n  - take_off: {height: 2}",
            r"steps\[1\]: take_off while flying",
        ),
        ("steps:\n  - take_off: 3", r"steps\[0\].take_off: must be a mapping, got 3"),
        ("steps:\n  - 7", "a step is one of"),
    ],
)
def test_mission_errors_name_key_and_remedy(text, message):
    with pytest.raises(ValueError, match=f"(?s)task.*{message}"):
        mission_from_text(text, "task.yaml")


def test_missing_mission():
    with pytest.raises(ValueError, match="did you mean 'hover'"):
        load_mission("hoover")
    with pytest.raises(FileNotFoundError, match="shipped ones are carry"):
        load_mission("no/such.yaml")


def test_shipped_sticks_fly_a_square_and_land():
    sticks = load_sticks(example_sticks())
    pilot = StickPilot(sticks)
    targets = [pilot.setpoint(t) for t in np.arange(0.0, sticks.duration, 0.01)]
    heights = [-t.position[2] for t in targets]
    assert max(heights) > 1.5 and heights[-1] == 0.0
    assert not targets[0].motors_on and not targets[-1].motors_on
    assert targets[-1].position[0] > 1.0 and targets[-1].position[1] > 1.0


def held(**values):
    """The same sticks for ever, after a second of climbing."""
    up, then = (
        [0.0, 0.0, 0.0, 1.0],
        [values.get(k, 0.0) for k in ("roll", "pitch", "yaw", "throttle")],
    )
    return RecordedSticks(np.array([0.0, 1.0, 1.001, 10.0]), np.array([up, up, then, then]))


def flown(pilot, seconds=3.0):
    for time in np.arange(0.0, seconds + 1e-9, 1e-3):
        target = pilot.setpoint(time)
    return target


def test_sticks_mean_speeds_in_the_frame_of_the_heading():
    ahead = flown(StickPilot(held(pitch=0.5)))
    np.testing.assert_allclose(ahead.position, [2.0, 0.0, -1.0], atol=0.01)  # 1 m/s for 2 s
    turned = StickPilot(held(pitch=0.5, yaw=1.0))
    target = flown(turned)
    assert target.yaw == pytest.approx(np.radians(120.0), abs=0.01)
    # an arc: radius speed / rate, chord from north turning east
    radius = 1.0 / np.radians(60.0)
    expected = [radius * np.sin(target.yaw), radius * (1.0 - np.cos(target.yaw)), -1.0]
    np.testing.assert_allclose(target.position, expected, atol=0.02)


def test_attitude_sticks_tilt_and_hold_height():
    target = flown(StickPilot(held(pitch=1.0, roll=0.5), mode="attitude"))
    assert target.hold_attitude
    assert target.pitch == pytest.approx(-np.radians(15.0))
    assert target.roll == pytest.approx(np.radians(7.5))
    np.testing.assert_allclose(target.position, [0.0, 0.0, -1.0], atol=0.01)


def test_ground_and_ceiling_bound_the_target():
    assert flown(StickPilot(held(throttle=-1.0))).position[2] == 0.0
    ceiling = flown(StickPilot(held(throttle=1.0)), seconds=9.0)
    assert ceiling.position[2] == pytest.approx(-9.0, abs=0.01)
    with pytest.raises(ValueError, match="did you mean 'position'"):
        StickPilot(held(), mode="postion")


HEADER = "time_s,roll,pitch,yaw,throttle\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty; expected a header line with time_s"),
        ("time_s,roll,pitch,throttle\n0,0,0,0\n", "column yaw is missing"),
        (HEADER + "0,0,0,0,0\n1,0,x,0,0\n", "line 3: pitch must be a number, got 'x'"),
        (HEADER + "0,0,0,0,0\n1,0,0,0\n", "row 3: 4 cells, but the header has 5"),
        (HEADER + "0,0,0,0,0\n1,0,nan,0,0\n", "line 3: pitch must be a number, got 'nan'"),
        (HEADER + "0,0,0,0,0\n1,1500,0,0,0\n", r"line 3: roll must lie in \[-1, 1\].*microsec"),
        (HEADER + "0,0,0,0,0\n0,0,0,0,0\n", "line 3: time_s must increase"),
        (HEADER + "1,0,0,0,0\n2,0,0,0,0\n", "line 2: time_s must start at 0"),
        (HEADER + "0,0,0,0,0\n", "two rows or more"),
    ],
)
def test_stick_file_errors_name_the_line(tmp_path, text, message):
    path = tmp_path / "sticks.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"sticks.csv.*{message}"):
        load_sticks(path)


def test_missing_stick_file_offers_the_example(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"square_sticks\.csv"):
        load_sticks(tmp_path / "none.csv")


class FakeClock:
    """Wall time that passes only by sleeping and by hand."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_pacing_keeps_to_the_clock_and_reports_lag():
    clock = FakeClock()
    pacer = Pacer(2.0, clock=clock, sleep=clock.sleep)
    for step in range(11):
        assert pacer.wait(0.1 * step) == 0.0
    assert clock.now == pytest.approx(100.5)  # 1 s at twice the speed
    clock.now += 0.3
    assert pacer.wait(1.1) == pytest.approx(0.25)
    assert pacer.max_lag == pytest.approx(0.25)
    assert (pacer.num_late, pacer.num_steps) == (1, 12)
    assert pacer.wait(2.0) == 0.0  # it has caught up
    assert clock.now == pytest.approx(101.0)


def test_speed_zero_never_looks_at_the_clock():
    def forbidden(*_):
        raise AssertionError("looked at the clock")

    assert Pacer(0.0, clock=forbidden, sleep=forbidden).wait(5.0) == 0.0
    with pytest.raises(ValueError, match="speed"):
        Pacer(-1.0)


def fake_pygame(pressed=(), events=(), pads=0, axes=()):
    keys = ["K_RIGHT", "K_LEFT", "K_UP", "K_DOWN", "K_d", "K_a", "K_w", "K_s", "K_ESCAPE"]
    module = types.ModuleType("pygame")
    for k, name in enumerate([*keys, "KEYDOWN", "QUIT"]):
        setattr(module, name, k)
    module.init = module.quit = lambda: None
    module.display = types.SimpleNamespace(set_mode=lambda *_: None, set_caption=lambda *_: None)
    down = {getattr(module, name) for name in pressed}
    module.key = types.SimpleNamespace(get_pressed=lambda: [k in down for k in range(len(keys))])
    module.event = types.SimpleNamespace(
        get=lambda: [
            types.SimpleNamespace(type=getattr(module, t), key=getattr(module, k))
            for t, k in events
        ]
    )
    pad = types.SimpleNamespace(get_axis=lambda k: axes[k], get_numaxes=lambda: len(axes))
    module.joystick = types.SimpleNamespace(get_count=lambda: pads, Joystick=lambda _: pad)
    return module


def test_keys_are_sticks(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setitem(sys.modules, "pygame", fake_pygame(pressed=["K_UP", "K_a", "K_w"]))
    assert LiveSticks("keyboard").sticks(0.0) == Sticks(pitch=1.0, yaw=-1.0, throttle=1.0)
    escape = fake_pygame(events=[("KEYDOWN", "K_ESCAPE")])
    monkeypatch.setitem(sys.modules, "pygame", escape)
    with pytest.raises(KeyboardInterrupt):
        LiveSticks("keyboard").sticks(0.0)


def test_gamepad_up_is_up_and_small_deflections_are_none(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setitem(sys.modules, "pygame", fake_pygame(pads=1, axes=(0.03, -0.5, 0.2, -1.0)))
    assert LiveSticks("gamepad").sticks(0.0) == Sticks(roll=0.2, pitch=1.0, throttle=0.5)
    monkeypatch.setitem(sys.modules, "pygame", fake_pygame())
    with pytest.raises(NoInputError, match="no gamepad found"):
        LiveSticks("gamepad")


def test_without_pygame_or_display(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r"pip install 'pygame.*mission"):
        LiveSticks("keyboard")
    monkeypatch.setitem(sys.modules, "pygame", fake_pygame())
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(NoInputError, match="need a display"):
        LiveSticks("keyboard")
