"""What a flight leaves behind, and the command that makes it."""

import numpy as np
import pytest
import yaml

from diffsim import cli
from diffsim.copter import load_design
from diffsim.copter.simulator import FlightLog, FlightSimulator, Pacer, load_mission
from diffsim.core.interrupts import EXIT_INTERRUPTED
from labs.markers import load_csv

SECONDS = 1.5


@pytest.fixture(scope="module")
def flight():
    return FlightSimulator(load_design("pentacopter"), payload=0.3).run(
        load_mission("hover"), seconds=SECONDS
    )


def test_recording_is_tidy_and_z_is_up(flight, tmp_path):
    folder = flight.save(tmp_path / "run")
    recording = load_csv(folder / "flight.csv", markers=["body", "target"])
    assert recording.rate_Hz == pytest.approx(100.0)
    assert len(recording.time_s) == len(flight.samples) == 151
    down = flight.series("position")
    np.testing.assert_allclose(recording.position_of("body")[:, 2], -down[:, 2], atol=1e-6)
    np.testing.assert_allclose(recording.position_of("body")[:, 1], -down[:, 1], atol=1e-6)
    assert recording.position_of("body")[-1, 2] > 0.1
    facts = yaml.safe_load((folder / "flight.yaml").read_text())
    assert facts["payload_kg"] == 0.3 and facts["design"] == "pentacopter"
    assert len(facts["summary"]["saturated_share"]) == 5
    header = (folder / "flight.csv").read_text().partition("\n")[0].split(",")
    assert {"pwm_5_us", "thrust_1_N", "saturated_3", "voltage_V", "current_A"} <= set(header)


def test_series_by_name(flight):
    assert flight.series("pwm").shape == (151, 5)
    with pytest.raises(ValueError, match="did you mean 'voltage'"):
        flight.series("voltag")
    with pytest.raises(ValueError, match="no samples"):
        FlightLog().series("pwm")


def test_interruption_keeps_the_flight():
    simulator = FlightSimulator(load_design("quadcopter"))

    def stop(sample):
        if sample.time > 0.05:
            raise KeyboardInterrupt

    log = simulator.run(load_mission("hover"), observers=[stop])
    assert log.outcome == "interrupted" and len(log.samples) == 7


def test_lag_of_the_wall_clock_is_recorded():
    """A clock on which every look costs 25 ms, more than two control periods."""
    now = [0.0]

    def clock():
        now[0] += 0.025
        return now[0]

    simulator = FlightSimulator(load_design("quadcopter"))
    pacer = Pacer(1.0, clock=clock, sleep=lambda _: None)
    log = simulator.run(load_mission("hover"), seconds=0.1, pacer=pacer)
    assert log.series("lag")[-1] == pytest.approx(pacer.max_lag) == pytest.approx(10 * 0.015)


def test_scene_and_figure(flight, tmp_path):
    pytest.importorskip("rerun")
    pytest.importorskip("matplotlib")
    from diffsim.viz.flight_figures import motor_outputs, save_png
    from diffsim.viz.flight_scene import write_flight

    path = write_flight(tmp_path / "f.rrd", flight, load_design("pentacopter"), payload=0.3)
    assert path.stat().st_size > 50_000  # 48 parts' meshes alone
    figure = motor_outputs([("a", flight), ("b", flight), ("c", flight)])
    assert [len(ax.lines) for ax in figure.axes] == [11, 11, 11, 0]  # pulses, marks, clamp
    assert save_png(figure, tmp_path / "a.png").stat().st_size > 10_000


def test_live_scene_gets_thirty_frames_a_second(monkeypatch):
    """The viewer itself is not started; frames are counted where they reach the stream."""
    rr = pytest.importorskip("rerun")
    from diffsim.viz.flight_scene import live_scene

    frames, log = [], rr.RecordingStream.log

    def count(stream, path, *args, **kwargs):
        frames.append(path)
        log(stream, path, *args, **kwargs)

    monkeypatch.setattr(rr.RecordingStream, "spawn", lambda self: self.memory_recording())
    monkeypatch.setattr(rr.RecordingStream, "log", count)
    scene = live_scene(load_design("quadcopter"), payload=0.2)
    FlightSimulator(load_design("quadcopter"), payload=0.2).run(
        load_mission("hover"), seconds=1.0, observers=[scene.frame]
    )
    # samples 0.01 s apart: every fourth, the first one that is due after 1/30 s
    assert frames.count("world/copter") == 26
    assert frames.count("world/copter/motor_rear__propeller") == 1 + 26  # its mesh and its turns
    assert "world/copter/payload" in frames


def test_command_flies_and_saves(tmp_path, capsys):
    out = tmp_path / "fly"
    argv = ["fly", "quadcopter", "--seconds", "0.5", "--controller", "pid", "--out", str(out)]
    assert cli.main(argv) == 0
    shown = capsys.readouterr().out
    assert "outcome                    done" in shown and "flight.csv" in shown
    assert len(load_csv(out / "flight.csv", markers=["body"]).time_s) == 51


def test_ctrl_c_in_flight_saves_it_and_says_that_it_was_broken_off(tmp_path, capsys, monkeypatch):
    def step_until_ctrl_c(self, setpoint, *, lag=0.0, _step=FlightSimulator.step):
        if self.time > 0.305:
            raise KeyboardInterrupt
        return _step(self, setpoint, lag=lag)

    monkeypatch.setattr(FlightSimulator, "step", step_until_ctrl_c)
    out = tmp_path / "fly"
    assert cli.main(["fly", "quadcopter", "--out", str(out)]) == EXIT_INTERRUPTED
    said = capsys.readouterr()
    assert "interrupted; finished work is kept" in said.err
    assert "outcome                    interrupted" in said.out
    assert len(load_csv(out / "flight.csv", markers=["body"]).time_s) == 31


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["quadcoptr"], "did you mean 'quadcopter'"),
        (["quadcopter", "--payload", "3"], "payload must not exceed 0.9"),
        (["quadcopter", "--controller", "pdi"], "did you mean 'pid'"),
        (["quadcopter", "--mission", "hoover"], "did you mean 'hover'"),
        (["quadcopter", "--sticks", "none.csv"], "no stick file none.csv"),
        (["bunny"], "raise pwm_max"),
    ],
)
def test_command_errors_are_one_line(argv, message, tmp_path, capsys):
    assert cli.main(["fly", *argv, "--out", str(tmp_path)]) == cli.EXIT_MISTAKE
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
