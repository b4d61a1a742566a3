"""`diagnose export --to`: the whole answer, what it carries and what not, flown on the runs."""

import importlib.util
import json
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

import diffsim
from diffsim.cli import main
from diffsim.cli.diagnose_export import say_interval
from diffsim.cli.export_flight import fly
from diffsim.data import Run
from diffsim.identify.ranges import Range
from tests.systems.outside.test_mjcf import XML as PENDULUM

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install mujoco)")

TIME = 0.02 * np.arange(75)
GOALS = {"steps": np.where(TIME > 0.3, 0.9, -0.3), "drop": np.minimum(2.0 * TIME, 1.2)}
POWER = {"steps": np.ones_like(TIME), "drop": np.where(TIME < 0.9, 1.0, 0.0)}
SETUP = {"mass_kg": 0.7, "arm_m": 0.12, "arm_mass_kg": 0.04}
SERVO = {
    "name": "servo",
    "like": "position_servo",
    "channels": [{"name": "position", "column": "position"}],
    "commands": [{"name": "goal", "column": "goal"}, {"name": "powered", "column": "powered"}],
    "runs": [
        {"file": "steps.csv", "setup": {**SETUP, "kp": 16}},
        {"file": "drop.csv", "setup": {**SETUP, "kp": 8}},
    ],
}
NUMBERS = {"error_gain": 0.16, "kt": 2.2, "resistance": 4.2, "armature": 0.02, "coulomb": 0.1,
           "zero": 0.02, "open_drag": 0.02}  # fmt: skip
CAUSES = {"delay_of_goal": 0.05, "rate_limit_of_goal": 0.2, "load_friction": 0.15,
          "starting_duty": 0.04, "quantization_of_goal": 0.05}  # fmt: skip


UNITS = {"delay_of_goal": "s", "rate_limit_of_goal": "s/command", "quantization_of_goal": "command",
         "error_gain": "1/rad", "kt": "N m/A", "resistance": "ohm", "armature": "kg m^2",
         "coulomb": "N m", "zero": "rad", "open_drag": "N m s",
         "viscous_friction_at_hinge": "N m s/rad", "added_spring_at_hinge": "N m/rad",
         "dry_friction_at_hinge": "N m", "payload_at_rod": "kg",
         **{f"unbalance_at_rod.{axis}": "kg m" for axis in "xyz"}}  # fmt: skip


def entries(values):
    return {n: {"value": v, "sd": 0.01 * v, "unit": UNITS.get(n, "-")} for n, v in values.items()}


def write_answer(folder, numbers, causes):
    saved = {"model": "x", "study": "x", "verdict": "named"}
    saved |= {"parameters": entries(numbers), "effects": entries(causes)}
    (folder / "answer").mkdir()
    (folder / "answer/extended_model.yaml").write_text(yaml.safe_dump(saved))


@pytest.fixture(scope="module")
def servo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("servo")
    for name, goal in GOALS.items():
        table = np.column_stack([TIME, goal, 0.5 * goal, POWER[name]])
        header = "time_s,goal,position,powered"
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=header, comments="")
    (folder / "study.yaml").write_text(yaml.safe_dump(SERVO))
    write_answer(folder, NUMBERS, CAUSES)
    return folder


def export(folder, target):
    code = main(
        ["diagnose", "export", str(folder), "--to", target, "--out", str(folder / "answer")]
    )
    assert code == 0
    return json.loads((folder / "answer/carried.json").read_text())


def test_an_answer_flies_in_mujoco_as_it_does_here(servo, capsys):
    found = export(servo, "mujoco")
    causes = {c["cause"]: c for c in found["causes"]}
    carried = {name for name, c in causes.items() if c["by"]}
    assert carried == {"delay_of_goal", "rate_limit_of_goal", "load_friction", "starting_duty"}
    assert causes["quantization_of_goal"]["cost"]["position"] > 1.0
    said = capsys.readouterr().out
    assert "  quantization of goal: not carried to mujoco; without it off: position by " in said
    assert "  delay of goal: carried by delay_s; without it off: position by " in said
    assert "position, flown in MuJoCo on 2 runs: " in said and "e-0" not in said
    # what is not carried, and MuJoCo's steps of the first order: mrad
    missed = causes["quantization_of_goal"]["cost"]["position"]
    assert len(found["flights"]) == 2
    for flight in found["flights"]:
        assert flight["apart"] < 4.0 + 1.5 * missed
        assert flight["export"] == pytest.approx(flight["model"], rel=0.15)


def test_a_cause_that_no_formula_reads_says_which_one_would(servo, tmp_path, capsys):
    """It said "not carried to mujoco" of a delay, which MuJoCo's drive has."""
    ready = Path(diffsim.__file__).parent / "data/ready/position_servo.yaml"
    rig = yaml.safe_load(ready.read_text("utf-8"))
    fewer = {n: f for n, f in rig["export"]["mujoco"].items() if n != "delay_s"}
    fewer["supply_drop"] = 0  # a number is a formula, too
    folder = shutil.copytree(servo, tmp_path / "servo")
    rig = {**rig, "export": {"mujoco": fewer}}
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    (folder / "study.yaml").write_text(yaml.safe_dump({**SERVO, "like": "rig.yaml"}))
    found = {c["cause"]: c for c in export(folder, "mujoco")["causes"]}
    assert not found["delay_of_goal"]["by"] and found["delay_of_goal"]["would"] == "delay_s"
    said = capsys.readouterr().out
    assert "to mujoco, unless export.mujoco says `delay_s: delay_of_goal`; without it" in said
    assert not found["quantization_of_goal"]["would"], "a drive has no constant for it"
    export(folder, "urdf")
    assert "unless" not in capsys.readouterr().out, "a joint of a URDF has no delay"


def test_what_is_written_stands_alone(servo):
    """The callback is imported from its file, and the MJCF opened by MuJoCo itself."""
    export(servo, "mujoco")
    path = servo / "answer/joint_drive.py"
    assert "diffsim" not in path.read_text().replace("`diffsim diagnose", "")
    spec = importlib.util.spec_from_file_location("written_drive", path)
    written = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(written)
    runs = json.loads((servo / "answer/mujoco_runs.json").read_text())
    plain = mujoco.MjModel.from_xml_path(str(servo / "answer/drive.xml"))
    assert plain.actuator_gainprm[0, 0] == pytest.approx(runs["steps"]["kp"])
    assert runs["steps"]["kp"] == pytest.approx(2.0 * runs["drop"]["kp"])
    assert plain.dof_armature[0] == 0.02
    model = mujoco.MjModel.from_xml_string(written.model_text(runs["steps"]))
    data, drive = mujoco.MjData(model), written.JointDrive(runs["steps"])
    drive.begin(model, 0.0)
    while data.time < 3.0:
        drive.set_control(model, data, 0.5)
        mujoco.mj_step(model, data)
    assert data.qpos[0] == pytest.approx(0.5, abs=0.1)


def test_bam_and_urdf_say_what_they_cannot_carry(servo, capsys):
    by = {c["cause"]: c["by"] for c in export(servo, "bam")["causes"]}
    assert by["load_friction"] and not by["delay_of_goal"] and not by["starting_duty"]
    assert json.loads((servo / "answer/bam.json").read_text())["model"] == "m3"
    worse = export(servo, "urdf")
    assert not any(c["by"] for c in worse["causes"] if c["cause"] != "rate_limit_of_goal")
    assert '<dynamics damping="1.17' in (servo / "answer/joint.urdf.xml").read_text()
    assert np.mean([f["apart"] for f in worse["flights"]]) > 10.0
    assert "not carried to urdf" in capsys.readouterr().out


def test_yaml_has_every_number_and_form(servo):
    found = export(servo, "yaml")
    assert all(c["by"] for c in found["causes"])
    answer = yaml.safe_load((servo / "answer/answer.yaml").read_text())
    assert answer["parameters"]["kt"]["value"] == 2.2
    cause = answer["causes"]["load_friction"]
    assert cause["low"] < 0.15 < cause["high"] and "torques on the gear" in cause["form"]


def test_a_study_of_a_mujoco_model_gets_its_own_model_back(tmp_path, capsys):
    time = 0.02 * np.arange(60)
    table = np.column_stack([time, np.sin(5.0 * time), 0.2 * np.sin(4.0 * time)])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="time_s,moment,angle", comments="")
    (tmp_path / "rod.xml").write_text(PENDULUM)
    study = {
        "name": "rod",
        "channels": [{"name": "angle", "unit": "rad", "sd": 0.001}],
        "commands": [{"name": "moment", "unit": "N m"}],
        "runs": [{"file": "a.csv"}],
        "model": {
            "system": "outside",
            "simulator": "diffsim.systems.outside.mjcf:Mjcf",
            "commands_are": "held",
            "options": {"model": "rod.xml", "channels": {"angle": "angle"}},
            "parameters": {"body.rod.mass": {"value": 0.4, "percent": 10},
                           "joint.hinge.damping": {"value": 0.06, "percent": 50}},
            "start": {"joint.hinge.start": {"value": 0.0, "sd": 0.1, "per": "run"}},
            "hooks": {"force": {"hinge": {"unit": "N m", "typical": 0.1, "distance": 0.5,
                                          "speed": 2}}},
        },
    }  # fmt: skip
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(study))
    numbers = {"body.rod.mass": 0.5, "joint.hinge.damping": 0.03, "joint.hinge.start@a": 0.1}
    causes = {"viscous_friction_at_hinge": 0.05, "dry_friction_at_hinge": 0.02,
              "added_spring_at_hinge": 0.4, "payload_at_rod": 0.1, "lag_of_command": 0,
              "unbalance_at_rod.x": 0.003, "unbalance_at_rod.y": 0.012,
              "unbalance_at_rod.z": 0.006}  # fmt: skip
    write_answer(tmp_path, numbers, {n: v for n, v in causes.items() if v})
    found = export(tmp_path, "mujoco")
    assert {c["cause"]: c["by"] for c in found["causes"]} == {
        "viscous_friction_at_hinge": ["joint.hinge.damping"],
        "dry_friction_at_hinge": ["joint.hinge.frictionloss"],
        "added_spring_at_hinge": ["joint.hinge.stiffness"],
        "payload_at_rod": ["body.rod.payload"],
        "unbalance_at_rod": [f"body.rod.unbalance[{k}]" for k in range(3)],
    }
    (flight,) = found["flights"]
    assert flight["apart"] < 2e-4 < flight["export"], "six digits, forces of RK4 and of the joint"
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "answer/model.xml"))
    said = capsys.readouterr().out
    assert "viscous friction at hinge: carried by joint.hinge.damping; without it off: " in said
    assert "angle, flown in MuJoCo on 1 run: " in said and " rad" not in said  # mrad
    assert "value (90 % interval)" not in said, "no constant follows"
    assert model.dof_damping[0] == pytest.approx(0.08) and model.body("rod").mass == 0.6
    np.testing.assert_allclose(model.body("rod").ipos[:2], [0.005, 0.02], atol=1e-6)
    urdf = export(tmp_path, "urdf")
    lacks = [c["cause"] for c in urdf["causes"] if not c["by"]]
    assert lacks == ["added_spring_at_hinge"], "what a joint of a URDF cannot have"
    root = ElementTree.fromstring(f"<r>{(tmp_path / 'answer/joints.urdf.xml').read_text()}</r>")
    assert float(root.find("joint/dynamics").get("damping")) == pytest.approx(0.08)
    assert float(root.find("joint/dynamics").get("friction")) == pytest.approx(0.02)
    assert float(root.find("link[@name='rod']/inertial/mass").get("value")) == 0.6
    inertia = root.find("link[@name='rod']/inertial/inertia")  # of all, about their center
    mujoco.mju_quat2Mat(turn := np.zeros(9), model.body("rod").iquat)
    full = turn.reshape(3, 3) @ np.diag(model.body("rod").inertia) @ turn.reshape(3, 3).T
    assert float(inertia.get("ixx")) == pytest.approx(full[0, 0], rel=1e-4)
    assert float(inertia.get("iyz")) == pytest.approx(full[1, 2], rel=1e-3)
    assert urdf["flights"][0]["apart"] > 10.0 * flight["apart"], "without the spring"
    study["channels"][0]["shown_unit"] = "mrad"
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(study))
    (shown,) = export(tmp_path, "mujoco")["flights"]
    for error in ("model", "export", "apart"):
        assert shown[error] == pytest.approx(1e3 * flight[error])


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (Range(1.18, 1.1, 2e10), "(at least 1.1; the data give no upper limit)"),
        (Range(1e-3, 1e-9, 1.2e-3), "(at most 0.0012; the data give no lower limit)"),
        (Range(1.0, 1e-9, 1e9), "(1e-9 to 1e9; the data give no limit)"),
        (Range(0.01, 0.0, 0.03), "(at most 0.03)"),
        (Range(1.2, 1.1, 1.3), "(1.1 to 1.3)"),
        (Range(-0.2, -0.3, 0.3), "(-0.3 to 0.3)"),
        (Range(2.0, 2.0, 2.0), ""),
    ],
)
def test_an_interval_without_an_end_is_said_in_words(found, words):
    assert say_interval(found).strip() == words


def test_a_held_goal_is_flown_held():
    """Lines between samples lead a held goal by half a sample: 20 mrad of a servo at 4 rad/s."""
    time = np.array([0.0, 0.5, 1.0])
    run = Run(name="a", group="a", time_s=time, measured=np.zeros((3, 1)), command={"goal": time})
    drive = {"kp": 20.0, "damping": 2.0, "load_inertia": 0.01, "load_moment": 0.01}
    held, lines = (fly(drive, run, is_held=held) for held in (True, False))
    assert abs(held[1]) < 1e-6 and lines[1] > 0.2
