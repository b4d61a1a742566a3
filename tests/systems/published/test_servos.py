"""Servos on a pendulum: a twin in the files' form with hidden causes, and the recorded ones."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from benchmarks.servo_bench import constant_error, is_read
from diffsim.cli import main
from diffsim.data.study_check import check_study
from diffsim.data.study_file import load_study
from diffsim.identify import fit
from diffsim.systems import published
from diffsim.systems.ode.refresh_effects import refresh_periods
from diffsim.systems.registry import setup_of
from tests.measured import data_folder

FOLDER = Path(published.__file__).parent
RUNS = "run,motor,mass_kg,arm_m,arm_mass_kg,kp,trajectory"
TRUTH = {"supply": 12.0, "kt": 2.2, "resistance": 4.2, "armature": 0.02, "coulomb": 0.12}
DELAY, FASTEST, LOAD_FRICTION = 0.02, 5.0, 0.15  # s, rad/s, share: hidden
TICK = 0.008  # s: the encoder's own clock, hidden
STUDY = """
name: my_servo
like: position_servo
channels: [{name: position, column: position_rad}]
commands: [{name: goal, column: goal_rad}, {name: powered, column: torque_enabled}]
runs:
  - name: "{run}"
    file: "{run}.csv"
    table: runs.csv
    setup: {mass_kg: "{mass_kg}", arm_m: "{arm_m}", arm_mass_kg: "{arm_mass_kg}", kp: "{kp}"}
"""
TIME = 0.01 * np.arange(250)
STEP = 5e-4  # s, of the twin's own integration


def goals(kind):
    if kind == "brutal":
        return np.where((TIME > 0.5) & (TIME < 2.0), 1.571, 0.0)
    return np.sin(2.0 * TIME + 0.9 * TIME**2)


def swing(goal, mass, arm, kp):
    """Angles of a servo by semi-implicit Euler, friction with a clamp that sticks exactly."""
    arm_mass, angle, speed, profile, register, out = 0.036, 0.0, 0.0, 0.0, 0.0, []
    rotor = TRUTH["armature"] + mass * arm**2 + arm_mass * arm**2 / 3.0
    weight = 9.81 * arm * (mass + arm_mass / 2.0)
    stall = TRUTH["supply"] * TRUTH["kt"] / TRUTH["resistance"]
    for k in range(round(TIME[-1] / STEP) + 1):
        time_s = k * STEP
        if k % round(TICK / STEP) == 6:
            register = angle
        if k % round(0.01 / STEP) == 0:
            out.append(register)
        target = goal[max(int((time_s - DELAY + 1e-9) / 0.01), 0)] if time_s >= DELAY else goal[0]
        profile += np.clip(target - profile, -FASTEST * STEP, FASTEST * STEP)
        duty = np.clip(0.165 * kp * (profile - angle), -1.0, 1.0)
        motor = stall * duty - TRUTH["kt"] ** 2 / TRUTH["resistance"] * speed
        load = -weight * np.sin(angle)
        friction = TRUTH["coulomb"] + LOAD_FRICTION * (abs(motor) + abs(load))
        free = speed + STEP * (motor + load) / rotor
        speed = np.sign(free) * max(abs(free) - STEP * friction / rotor, 0.0)
        angle += STEP * speed
    return np.array(out)


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    """A folder as make_csv.py writes it: causes hidden in the goal, the gear and the encoder."""
    folder = tmp_path_factory.mktemp("servo")
    rng, rows = np.random.default_rng(0), [RUNS]
    for mass, arm, kp, kind in (
        (0.535, 0.1, 4, "brutal"),
        (0.535, 0.1, 4, "sin_time_square"),
        (1.1682, 0.1, 16, "brutal"),
        (1.1682, 0.1, 16, "sin_time_square"),
    ):
        name = f"sts3215_m{mass}_l{arm}_kp{kp}_{kind}"
        rows.append(f"{name},sts3215,{mass},{arm},0.036,{kp},{kind}")
        goal = goals(kind)
        position = swing(goal, mass, arm, kp) + 1e-3 * rng.normal(size=len(TIME))
        if kind == "brutal":
            position[40] = -3.14159  # misread
        table = np.stack(
            [TIME, goal, position, rng.integers(30, 40, len(TIME)), np.ones_like(TIME)], 1
        )
        header = "time_s,goal_rad,position_rad,temperature_C,torque_enabled"
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=header, comments="")
    (folder / "runs.csv").write_text("\n".join(rows) + "\n")
    (folder / "study.yaml").write_text(STUDY)
    return folder


@pytest.mark.cpu(16)  # two fits of a servo whose dry friction needs steps of 1 ms
def test_hidden_causes_of_a_twin_are_fitted_from_its_files(twin):
    study = load_study(twin / "study.yaml")
    told = [p for p in check_study(study) if "misread" in p.message]
    assert [p.where.split("_")[-1] for p in told] == ["brutal", "brutal"]
    made = setup_of(study)
    names = ("delay_of_goal", "rate_limit_of_goal", "load_friction")
    clock = next(e for e in made.effects if e.name == "own_clock_of_position")
    assert clock.needs(study) is None and f"{1e3 * TICK:g} ms" in clock.form
    chosen = [e for e in made.effects if e.name in names]
    runs = [
        replace(run, measured=np.where(is_read(run.measured[:, 0])[:, None], run.measured, np.nan))
        for run in study.fit_runs
    ]
    plain = fit(made.model, runs, study.channels, effects=[], max_evaluations=10)
    found = fit(made.model, runs, study.channels, effects=chosen, max_evaluations=25)
    assert found.chi2 < 0.1 * plain.chi2
    timed = fit(made.model, runs, study.channels, effects=[*chosen, clock], max_evaluations=25)
    assert timed.chi2 < 0.5 * found.chi2
    assert timed.values[clock.name] == pytest.approx(1.0, abs=0.1)
    found = timed
    assert found.values["delay_of_goal"] == pytest.approx(DELAY, abs=0.004)
    assert 1.0 / found.values["rate_limit_of_goal"] == pytest.approx(FASTEST, rel=0.05)
    with torch.no_grad():
        for run in runs:
            left = run.measured - found.problem.predict(run, torch.from_numpy(found.x)).numpy()
            assert np.nanmean(np.abs(left)) < 5e-3


def test_play_of_an_answer_is_exported_with_its_interval(twin, tmp_path):
    numbers = {"supply": 12.0, "error_gain": 0.165, "kt": 2.2, "resistance": 4.2}
    numbers |= {"armature": 0.02, "coulomb": 0.12, "open_drag": 0.01, "zero": 0.0}
    saved = {
        "model": "my_servo",
        "study": "my_servo",
        "verdict": "named",
        "parameters": {name: {"value": v, "sd": 0.0, "unit": "-"} for name, v in numbers.items()},
        "effects": {
            "play_behind_encoder": {
                "value": 0.012, "sd": 1e-4, "unit": "rad", "low": 0.011, "high": 0.0135,
            }
        },
    }  # fmt: skip
    (tmp_path / "extended_model.yaml").write_text(yaml.safe_dump(saved))
    assert main(["diagnose", "export", str(twin), "--out", str(tmp_path)]) == 0
    constants = json.loads((tmp_path / "mujoco.json").read_text())
    assert constants["half_play_rad"] == pytest.approx(0.012)
    assert constants["frictionloss"] == pytest.approx(0.12)
    play = json.loads((tmp_path / "export.json").read_text())["mujoco"]["half_play_rad"]
    assert (play["low"], play["high"]) == pytest.approx((0.011, 0.0135), rel=0.02)


def test_misread_samples_are_left_out_by_the_readme_s_rule():
    position = np.array([0.0, 0.1, -3.14159, 0.3, 0.4, 0.9, 0.5])
    assert is_read(position).tolist() == [True, True, False, True, True, False, True]


@pytest.mark.reference
@pytest.mark.parametrize(
    ("name", "uses"),
    [
        ("servo_sts3215", (30, 17, 16)),
        ("servo_sts3250", (20, 8, 12)),
        ("servo_go1", (5, 3, 2)),
    ],
)
def test_the_recorded_runs_are_found_and_dealt_by_the_stated_rule(name, uses):
    folder = data_folder("servo_bench")
    if not (folder / "runs.csv").exists():
        pytest.skip(f"{folder} has no runs.csv yet; make_csv.py there makes it from two clones")
    study = load_study(FOLDER / f"{name}.yaml")
    assert tuple(len(study.runs_for(use)) for use in ("fit", "select", "test")) == uses
    assert not [p for p in check_study(study) if p.severity == "error"]
    period = refresh_periods(study)["position"]  # the good motor's encoder has no clock to name
    assert period == (0.0 if "go1" in name else pytest.approx(TICK, rel=1e-3))
    if "sts" in name:
        places = {0.535: 0, 0.74117693: 1, 1.1682: 2}, {0.1: 0, 0.15: 2}, {4: 0, 8: 1, 16: 2, 24: 3}
        for run in study.runs:
            facts = run.setup["mass_kg"], run.setup["arm_m"], run.setup["kp"]
            at = sum(of[fact] for of, fact in zip(places, facts, strict=True)) % 4
            assert run.use == ("fit", "select", "fit", "test")[at]
    skill = 1e3 * np.mean([constant_error(run) for run in study.runs])
    assert skill > 150.0  # mrad: what no model at all leaves
