"""Does the story of the sim-to-real loop end, and resume, as told? At its small size."""

from dataclasses import replace
from functools import partial

import pytest

from tests.examples.stories import load_story

pytestmark = pytest.mark.example


@pytest.mark.story
def test_starfish_loop_runs_and_resumes(tmp_path, monkeypatch):
    story, out = load_story("sim_to_real/starfish_loop.py"), tmp_path / "loop"
    short = story.FitSettings(duration_s=1.0, max_evaluations=2)
    step = story.TrajectorySettings(periods=1, max_evaluations=2)
    monkeypatch.setattr(story, "QUICK", replace(story.QUICK, fit=short, trajectory=step))
    laboratory, sine = story.VirtualLaboratory, story.sinusoid
    brief = lambda **given: laboratory(**given | {"duration_s": 2.2})  # noqa: E731
    monkeypatch.setattr(story, "VirtualLaboratory", brief)
    monkeypatch.setattr(story, "sinusoid", partial(sine, period_s=1.0, cycles=1))
    # 6 s of pictures: tests/labs/loop/test_loop.py draws them
    monkeypatch.setattr("labs.loop.report.write_loop", lambda *_, **__: None)
    numbers = story.main(str(out), quick=True, real=False)
    assert numbers is not None and {"v_r_0_cm_s", "v_r_1_cm_s", "cpu_s"} <= set(numbers)
    again = story.main(str(out), quick=True, real=False, resume=True)
    assert again is not None and again["v_r_1_cm_s"] == numbers["v_r_1_cm_s"]


def test_a_rig_is_told_what_to_execute(tmp_path, capsys):
    story = load_story("sim_to_real/starfish_loop.py")
    rig = tmp_path / "rig"
    assert story.main(str(tmp_path / "loop"), quick=True, real=False, rig=str(rig)) is None
    assert (rig / "command_0.csv").is_file()
    assert "resume the loop" in capsys.readouterr().out


@pytest.mark.slow
def test_a_diagnosed_delay_makes_a_better_command(tmp_path):
    misses = load_story("sim_to_real/command_from_csv.py").main(tmp_path)
    assert misses["diagnosed"] < 0.25 * misses["plain"]


@pytest.mark.slow
def test_a_diagnosed_rotor_makes_a_better_flight(tmp_path):
    pytest.importorskip("rotorpy", reason="flies RotorPy's quadrotor")
    misses = load_story("sim_to_real/copter_from_csv.py").main(tmp_path)
    assert max(misses["diagnosed"], misses["drawn"]) < 0.1 * misses["plain"]
