"""Examples of bringing a simulator: each names what was put into its recordings."""

import numpy as np
import pytest

from diffsim.data import load_study
from diffsim.diagnose.judge.records import Interval
from diffsim.systems import setup_of
from tests.examples.stories import load_story

pytestmark = pytest.mark.example


def found(story: str, folder, name: str) -> Interval:
    """Size of the only cause that is named, as it is stated."""
    report = load_story(f"diagnose/{story}.py").main(folder)
    assert report.named == (name,), report.sentences
    (size,) = next(c for c in report.causes if c.name == name).size.values()
    return size


def test_a_simulator_of_my_own_is_read_and_misses_what_rubs(tmp_path):
    """Without the diagnosis: the folder is written, read, and simulated with the true values."""
    truth = {"mass": 1.25, "spring": 38.0, "damping": 1.1}
    story = load_story("diagnose/own_simulator.py")
    left = []
    for friction in (0.0, 0.3):
        folder = tmp_path / str(friction)
        folder.mkdir()
        story.record(folder, friction)
        (folder / "my_cart.py").write_text(story.SIMULATOR)
        (folder / "study.yaml").write_text(story.STUDY)
        study = load_study(folder)
        model = setup_of(study).model
        q = model.at_prior().clone()
        for k, parameter in enumerate(model.base):
            if parameter.name in truth:
                q[k] = parameter.coordinate_of(truth[parameter.name])
        errors = [model.predict(run, q).numpy() - run.measured for run in study.runs]
        left.append(float(np.sqrt(np.mean(np.square(np.concatenate(errors))))))
    assert left[0] < 4e-3 < 1e-2 < left[1]  # [m]; Euler's steps alone cost 2.7 mm


@pytest.mark.story
def test_a_simulator_of_my_own_lacks_friction(tmp_path):
    size = found("own_simulator", tmp_path, "dry_friction_at_rail")
    assert size.low < 0.3 < size.high < size.low + 0.06


@pytest.mark.slow
def test_a_camera_is_late_and_a_belt_has_play(tmp_path):
    report = load_story("diagnose/late_camera.py").main(tmp_path)
    truth = {"sensor_delay_of_carriage": 0.045, "sensor_backlash_of_carriage": 9e-4}
    assert set(report.named) == set(truth), report.sentences
    for cause in report.causes:
        if cause.name in truth:
            (size,) = cause.size.values()
            assert size.low <= truth[cause.name] <= size.high, cause.name
    assert all(g.passed for g in report.gates if g.name.startswith("gradient:") and g.applies)


@pytest.mark.slow
def test_the_law_of_a_motor_that_cogs_is_found(tmp_path):
    story = load_story("diagnose/cogging_motor.py")
    report = story.main(tmp_path)
    assert report.verdict == "described", report.sentences
    (law,) = report.described.laws
    assert law.entry == {"kind": "force", "target": "shaft"} and law.variables == ("angle",)
    hidden = {"amplitude": story.COGGING_NM, "wave_number": story.TEETH}
    for name, truth in hidden.items():
        assert law.numbers[name].low <= truth <= law.numbers[name].high, name
    story.draw(report, tmp_path / "law.png")
    assert (tmp_path / "law.png").stat().st_size > 5000


@pytest.mark.slow
def test_a_mujoco_model_lacks_a_spring(tmp_path):
    pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install mujoco)")
    size = found("mujoco_pendulum", tmp_path, "added_spring_at_hinge")
    assert size.low < 0.6 < size.high < size.low + 0.1


@pytest.mark.slow
def test_rotorpy_hears_its_commands_too_early(tmp_path):
    pytest.importorskip("rotorpy", reason="RotorPy is not installed (pip install rotorpy)")
    size = found("rotorpy_climb", tmp_path, "delay")
    assert size.low < 0.04 < size.high < size.low + 0.01
