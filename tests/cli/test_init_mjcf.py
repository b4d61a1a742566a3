"""``diffsim diagnose init`` in a folder that holds an MJCF beside its recordings."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from diffsim.cli.diagnose_init import init
from diffsim.data.study_file import load_study
from diffsim.identify import Problem, WhiteNoise
from diffsim.systems.outside.mjcf import Mjcf
from diffsim.systems.outside.mjcf_guess import _joint_of
from diffsim.systems.registry import setup_of

mujoco = pytest.importorskip("mujoco", reason="MJCF needs the extra 'robots'")

ARM = """<mujoco model="arm"><option timestep="0.002"/><worldbody>
  <body name="upper" pos="0 0 1"><joint name="{one}" axis="0 1 0" damping="0.6"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.8"/>
    <body name="fore" pos="0.3 0 0"><joint name="{two}" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.015" mass="0.4"/>
  </body></body></worldbody>
  <actuator><position name="m1" joint="{one}" kp="60"/><motor name="m2" joint="{two}"/></actuator>
  {more}</mujoco>"""
TIME = 0.02 * np.arange(100)
HEADER = "time_s,goal_shoulder_rad,torque_elbow_Nm,shoulder_rad,elbow_deg,elbow_speed_rad_s"


def arm_folder(tmp_path: Path, one="shoulder", two="elbow", more="") -> Path:
    """An arm of two joints and two recordings of it, without noise."""
    text = ARM.format(one=one, two=two, more=more)
    (tmp_path / "arm.xml").write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    for k, name in enumerate(("slow", "fast")):
        data = mujoco.MjData(model)
        data.qpos[:] = [-0.3, 0.1 * k]
        push = np.c_[-0.3 + 0.2 * np.sin((2.0 + k) * TIME), 0.4 * np.sin((3.0 + k) * TIME)]
        rows = []
        for control in push:
            mujoco.mj_forward(model, data)
            rows.append([data.qpos[0], np.degrees(data.qpos[1]), data.qvel[1]])
            data.ctrl[:] = control
            for _ in range(10):
                mujoco.mj_step(model, data)
        table = np.c_[TIME, push, np.array(rows)]
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header=HEADER, comments="")
    return tmp_path


def test_a_folder_with_an_mjcf_is_simulated_without_a_word(tmp_path, capsys):
    folder = arm_folder(tmp_path)
    init(folder)
    assert "arm.xml, an MJCF that MuJoCo simulates" in capsys.readouterr().out
    stated = yaml.safe_load((folder / "study.yaml").read_text())["model"]
    assert stated["options"]["channels"] == {
        "shoulder_rad": "joint.shoulder.position",
        "elbow": "joint.elbow.position",
        "elbow_speed_rad_s": "joint.elbow.velocity",
    }
    assert stated["options"]["commands"] == {"goal_shoulder_rad": "m1", "torque_elbow_Nm": "m2"}
    assert set(stated["parameters"]) == {
        "body.upper.mass",
        "body.fore.mass",
        "joint.shoulder.damping",
        "actuator.m1.kp",
    }
    start = stated["start"]["joint.elbow.start"]
    assert start["first"] == "elbow" and start["sd"] > 0.05  # of 0 and 0.1 rad
    study = load_study(folder / "study.yaml")
    setup = setup_of(study)
    assert {"dry_friction_at_elbow", "delay_of_m1"} <= {effect.name for effect in setup.effects}
    problem = Problem(setup.model, study.runs, WhiteNoise(study.channels), ())
    # each run begins as its first readings show
    shown = problem.record(np.zeros(problem.num_base))
    measured = np.concatenate([run.measured.ravel() for run in study.runs])
    assert shown == pytest.approx(measured, abs=1e-4)


def test_names_that_say_nothing_are_taken_in_order_and_to_be_checked(tmp_path, capsys):
    init(
        arm_folder(
            tmp_path, one="j_a", two="j_b", more="<sensor><jointpos name='s' joint='j_a'/></sensor>"
        )
    )
    text = (tmp_path / "study.yaml").read_text()
    assert "actuators were taken by their order" in text
    assert "joint of the MJCF for elbow_speed_rad_s; it has joint.j_a.velocity" in text


def test_files_that_are_parts_or_no_mjcf_are_passed_over(tmp_path):
    folder = arm_folder(tmp_path)
    (folder / "scene.xml").write_text('<mujoco><include file="arm.xml"/></mujoco>')
    (folder / "table.xml").write_text("<table/>")
    (folder / "broken.xml").write_text("<mujoco>")
    (folder / "typed.xml").write_text('<!DOCTYPE a [<!ENTITY b "c">]><mujoco/>')
    (folder / "gone.xml").symlink_to(folder / "nowhere.xml")
    init(folder)
    assert "model: scene.xml" in (folder / "study.yaml").read_text()


def test_models_are_found_in_folders_as_collections_lay_them_out(tmp_path):
    folder = arm_folder(tmp_path)
    (folder / "vendor").mkdir()
    (folder / "arm.xml").rename(folder / "vendor" / "arm.xml")
    scene = '<mujoco><include file="arm.xml"/><worldbody><light pos="0 0 3"/></worldbody></mujoco>'
    (folder / "vendor" / "scene.xml").write_text(scene)
    init(folder)
    stated = yaml.safe_load((folder / "study.yaml").read_text())["model"]
    assert stated["options"]["model"] == "vendor/scene.xml"
    study = load_study(folder)
    run, model = study.fit_runs[0], setup_of(study).model
    assert np.isfinite(model.predict(run, model.at_prior()).numpy()).all()


def test_a_column_called_like_an_actuator_and_no_joint_is_its_command(tmp_path):
    belt = '<velocity name="belt" joint="slider" kv="4"/>'
    joint = '<joint name="slider" type="slide" axis="1 0 0" damping="1"/>'
    body = f'<worldbody><body name="cart">{joint}<geom size="0.1"/></body></worldbody>'
    text = f"<mujoco>{body}<actuator>{belt}</actuator></mujoco>"
    (tmp_path / "cart.xml").write_text(text)
    speed = np.sin(3.0 * TIME)
    table = np.c_[TIME, speed, 0.2 * (1.0 - np.cos(3.0 * TIME))]
    header = "time_s,belt_speed_m_s,cart_m"
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header=header, comments="")
    init(tmp_path)
    options = yaml.safe_load((tmp_path / "study.yaml").read_text())["model"]["options"]
    assert options["commands"] == {"belt_speed_m_s": "belt"}
    assert options["channels"] == {"cart_m": "joint.slider.position"}


GANTRY = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body name="bridge"><joint name="x" type="slide" axis="1 0 0" damping="12"/>
    <geom size="0.1" mass="6"/>
    <body name="carriage"><joint name="y" type="slide" axis="0 1 0" damping="6"/>
      <geom size="0.1" mass="2"/></body></body></worldbody>
  <actuator><motor name="drive_x" joint="x" gear="10"/><motor name="drive_y" joint="y" gear="5"/>
  </actuator>{more}</mujoco>"""


@pytest.mark.parametrize("shown", ["joint", "sensor"])
@pytest.mark.parametrize("commands", ["ux,uy", "cmd_x,cmd_y", "cmd_x"])
def test_a_gantry_of_slides_has_its_commands_its_starts_and_its_places(tmp_path, shown, commands):
    """Of joints that sensors show it had neither places of forces nor starts; ux was a channel."""
    sensors = "".join(f'<jointpos name="{j}_pos" joint="{j}"/>' for j in "xy")
    more = f"<sensor>{sensors}</sensor>" if shown == "sensor" else ""
    (tmp_path / "gantry.xml").write_text(GANTRY.format(more=more))
    names = commands.split(",")
    rng = np.random.default_rng(0)
    for run in "ab":
        told = np.repeat(rng.uniform(-3, 3, (5, len(names))), 20, axis=0)
        moved = np.c_[np.sin(2.0 * TIME), 0.5 * np.sin(3.0 * TIME)]
        table = np.c_[TIME, moved, told]
        header = f"t_s,x_pos_m,y_pos_m,{commands}"
        np.savetxt(tmp_path / f"{run}.csv", table, delimiter=",", header=header, comments="")
    init(tmp_path)
    stated = yaml.safe_load((tmp_path / "study.yaml").read_text())["model"]
    drives = {name: f"drive_{name[-1]}" for name in names}
    assert stated["options"]["commands"] == drives
    assert len(stated["options"]["channels"]) == 2
    assert {*stated["start"]} >= {"joint.x.start", "joint.y.start"}
    places = stated["hooks"]["force"]
    assert [place["unit"] for place in places.values()] == ["N", "N"] and {*places} == {"x", "y"}
    # a twentieth of what the drive pushes with; without one, a hundredth of the weight
    assert places["x"]["typical"] > 0.5
    assert (places["y"]["typical"] > 0.25) == (len(names) == 2)


@pytest.mark.parametrize("beside", ["ux,uy", "u_x,u_y", "vx,vy", "battery,temperature"])
def test_a_u_before_what_tells_actuators_apart_makes_a_command(tmp_path, beside):
    """Commands that vary all the time look as a reading does; a battery's charge is none."""
    (tmp_path / "gantry.xml").write_text(GANTRY.format(more=""))
    rng = np.random.default_rng(0)
    for run in "ab":
        waves = [
            np.sin(f * TIME + p) for f, p in zip(range(2, 6), rng.uniform(0, 3, 4), strict=True)
        ]
        table = np.c_[TIME, np.array(waves).T + 1e-3 * rng.normal(size=(len(TIME), 4))]
        header = f"t_s,x_pos_m,y_pos_m,{beside}"
        np.savetxt(tmp_path / f"{run}.csv", table, delimiter=",", header=header, comments="")
    init(tmp_path)
    stated = yaml.safe_load((tmp_path / "study.yaml").read_text())
    told = [command["name"] for command in stated.get("commands") or []]
    assert told == (beside.split(",") if beside.startswith("u") else [])


def test_two_models_are_a_question_and_a_broken_one_is_said(tmp_path):
    folder = arm_folder(tmp_path)
    (folder / "other.xml").write_text((folder / "arm.xml").read_text())
    init(folder)
    assert "which of arm.xml, other.xml was recorded" in (folder / "study.yaml").read_text()
    (folder / "other.xml").unlink()
    (folder / "arm.xml").write_text("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    init(folder, force=True)
    text = (folder / "study.yaml").read_text()
    assert "arm.xml is an MJCF that cannot be read" in text and "system: ode" in text


def test_of_scenes_that_include_a_robot_the_robot_is_taken(tmp_path, capsys, monkeypatch):
    """Of a bimanual arm's repository init asked which of fourteen scenes had been recorded."""
    folder = arm_folder(tmp_path)
    (folder / "model/scenes").mkdir(parents=True)
    (folder / "arm.xml").rename(folder / "model/arm.xml")
    scene = '<mujoco><include file="../arm.xml"/><worldbody>{}</worldbody></mujoco>'
    body = '<body><joint name="{}" type="slide"/><geom size="1"/></body>'
    for name in ("puck", "valve"):
        (folder / f"model/scenes/{name}.xml").write_text(scene.format(body.format(name)))
    monkeypatch.chdir(folder)
    init(Path("."))
    said = capsys.readouterr().out
    assert "model: arm.xml by its joints' and actuators' names; not puck.xml, valve.xml" in said
    stated = yaml.safe_load((folder / "study.yaml").read_text())["model"]
    assert stated["options"]["model"] == "model/arm.xml"


ARMS = """<mujoco><worldbody><body name="left" pos="0 1 1"><joint name="left_1" damping="1"/>
    <geom size=".1" mass="1"/><body name="left_hand" pos=".3 0 0"><joint name="left_2" damping="1"/>
    <geom size=".1" mass="1"/></body></body>
  <body name="right" pos="0 -1 1"><joint name="right_1" damping="1"/><geom size=".1" mass="1"/>
  </body></worldbody><actuator><position name="left_1" joint="left_1" kp="9"/>
  <{servo} name="left_2" joint="left_2" {gain}="9"/>
  <position name="right_1" joint="right_1" kp="9"/></actuator>{more}</mujoco>"""
TIE = '<equality><joint joint1="left_1" joint2="{}"/></equality>'


@pytest.mark.parametrize(
    ("servo", "tied", "held", "is_tied"),
    [
        ("position", "", {"left_2", "right_1"}, False),
        ("motor", "", {"right_1"}, False),  # no servo holds the hand: it swings along
        ("position", "left_2", {"left_2", "right_1"}, False),
        ("position", "right_1", {"left_2", "right_1"}, True),  # one arm pulls at the other
    ],
)
def test_what_drives_without_a_command_hold_is_not_fitted(
    tmp_path, capsys, servo, tied, held, is_tied
):
    gain, more = "kp" if servo == "position" else "gear", TIE.format(tied) if tied else ""
    (tmp_path / "arms.xml").write_text(ARMS.format(servo=servo, gain=gain, more=more))
    for run in "ab":
        goal = np.sin(TIME + ord(run))
        table = np.c_[TIME, 0.9 * goal, goal]
        header = "time_s,left_1_pos_rad,left_1_goal_rad"
        np.savetxt(tmp_path / f"{run}.csv", table, delimiter=",", header=header, comments="")
    init(tmp_path)
    stated = yaml.safe_load((tmp_path / "study.yaml").read_text())["model"]["parameters"]
    joints = {name.split(".")[1] for name in stated if name.startswith(("joint.", "actuator."))}
    assert joints == {"left_1", "left_2", "right_1"} - held
    bodies = {name.split(".")[1] for name in stated if name.startswith("body.")}
    assert bodies == {"left", "left_hand"} | ({"right"} if is_tied else set())
    said = capsys.readouterr().out
    assert "joints of drives without a recorded command stay as in the file: " in said


def test_where_columns_say_nothing_of_joints_all_numbers_stay_open(tmp_path):
    (tmp_path / "arms.xml").write_text(ARMS.format(servo="position", gain="kp", more=""))
    for run in "ab":
        table = np.c_[TIME, np.sin(TIME + ord(run)), np.sin(2.0 * TIME + ord(run))]
        header = "time_s,encoder_rad,resolver_rad"
        np.savetxt(tmp_path / f"{run}.csv", table, delimiter=",", header=header, comments="")
    init(tmp_path)
    stated = yaml.safe_load((tmp_path / "study.yaml").read_text())["model"]["parameters"]
    assert {"body.right.mass", "joint.left_2.damping", "actuator.right_1.kp"} <= stated.keys()


def test_a_joint_without_a_sensor_is_told_by_its_path(tmp_path):
    from diffsim.systems.outside.mjcf import Mjcf

    path = str(arm_folder(tmp_path) / "arm.xml")
    with pytest.raises(ValueError, match="no joint 'elbw'; did you mean 'elbow'"):
        Mjcf(path, channels={"q": "joint.elbw.position"})
    body = "<body><joint name='b' type='ball'/><geom size='1'/></body>"
    ball = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    with pytest.raises(ValueError, match=r"with 3 axes is no reading; .* add a sensor"):
        Mjcf(ball, channels={"q": "joint.b.position"})


ROVER = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <geom type="plane" size="5 5 .1"/>
  <body name="chassis" pos="0 0 .05"><freejoint{name}/>
    <geom type="box" size=".1 .06 .02" mass="2"/><geom type="sphere" size=".02" pos=".08 0 -.03"/>
    <body name="wheel" pos="-.04 .08 0"><joint name="left" axis="0 1 0" damping="0.02"/>
      <geom type="cylinder" size=".05 .01" euler="90 0 0" mass=".1"/></body>
    <body name="other" pos="-.04 -.08 0"><joint name="right" axis="0 1 0" damping="0.02"/>
      <geom type="cylinder" size=".05 .01" euler="90 0 0" mass=".1"/></body>
  </body></worldbody>
  <actuator><velocity name="lm" joint="left" kv=".5"/><velocity name="rm" joint="right" kv=".5"/>
  </actuator></mujoco>"""

COMMANDS = {"lm_cmd_rad_s": "lm", "rm_cmd_rad_s": "rm"}


def rover_folder(tmp_path: Path, name: str) -> tuple[Path, np.ndarray]:
    (tmp_path / "rover.xml").write_text(ROVER.format(name=name))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "rover.xml"))
    for k, run in enumerate("ab"):
        data, rows = mujoco.MjData(model), []
        push = np.c_[3.0 + np.sin((1.0 + k) * TIME), 3.0 + np.cos(TIME)]
        for control in push:
            rows.append(data.qpos[:7].copy())
            data.ctrl[:] = control
            mujoco.mj_step(model, data, nstep=4)
        header = "time_s,lm_cmd_rad_s,rm_cmd_rad_s,x_m,pos_y_m,z_m,qw,quat_x,qy,qz"
        table = np.c_[TIME, push, np.array(rows)]
        np.savetxt(tmp_path / f"{run}.csv", table, delimiter=",", header=header, comments="")
    return tmp_path, np.array(rows)


def test_the_pose_of_a_body_that_moves_freely_is_that_of_its_columns(tmp_path):
    folder, pose = rover_folder(tmp_path, ' name="root"')
    init(folder)
    stated = yaml.safe_load((folder / "study.yaml").read_text())["model"]
    entries = [f"joint.root.position[{k}]" for k in range(3)]
    entries += [f"joint.root.orientation[{k}]" for k in range(4)]
    assert list(stated["options"]["channels"].values()) == entries
    assert list(stated["start"]) == [f"joint.root.start[{k}]" for k in range(7)]
    assert stated["parameters"]["actuator.lm.kv"] == {"value": 0.5, "percent": 20}
    study = load_study(folder / "study.yaml", strict=False)
    setup = setup_of(study)
    run = study.runs[1]
    starts = {name: float(v) for name, v in zip(stated["start"], pose[0], strict=True)}
    found = setup.model.predict_run(starts, run)
    np.testing.assert_allclose(found, pose, atol=1e-9)


def test_a_free_joint_without_a_name_is_asked_for_one(tmp_path, capsys):
    folder, _ = rover_folder(tmp_path, "")
    init(folder)
    assert "the free joint needs a name" in (folder / "study.yaml").read_text()


@pytest.mark.parametrize("channel", ["position", "velocity", "orientation[4]", "position[3]"])
def test_what_is_no_entry_of_a_pose_is_refused(tmp_path, channel):
    folder, _ = rover_folder(tmp_path, ' name="root"')
    run = load_study(_init(folder), strict=False).runs[0]
    with pytest.raises(ValueError, match=r"is no reading|has no such entry"):
        sim = Mjcf(str(folder / "rover.xml"), {"c": f"joint.root.{channel}"}, COMMANDS)
        sim.predict({}, run)


def _init(folder: Path) -> Path:
    init(folder)
    return folder / "study.yaml"


def test_pieces_of_one_long_run_begin_where_and_as_fast_as_they_do(tmp_path):
    folder = arm_folder(tmp_path)
    (folder / "fast.csv").unlink()
    init(folder)
    start = yaml.safe_load((folder / "study.yaml").read_text())["model"]["start"]
    study = load_study(folder / "study.yaml", strict=False)
    assert len(study.runs) == 6
    for joint, place in (("shoulder", 0), ("elbow", 1)):
        first = np.array([run.measured[0, place] for run in study.runs])
        stated = start[f"joint.{joint}.start"]
        assert stated["first"] == study.channels[place].name
        assert stated["sd"] == pytest.approx(2.0 * np.abs(first - first.mean()).max(), rel=0.05)
        rates = [np.gradient(r.measured[:, place], 0.02, edge_order=2)[0] for r in study.runs]
        rate = start[f"joint.{joint}.start_rate"]
        assert rate["value"] == 0.0 and rate["per"] == "run"
        # the elbow turns within few samples: its rate there is known to a third
        assert rate["sd"] == pytest.approx(2.0 * np.abs(rates).max(), rel=0.4)


def test_runs_that_begin_at_rest_have_no_rate_there(tmp_path):
    folder = arm_folder(tmp_path)
    for name in ("slow", "fast"):
        table = np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1)
        table = np.vstack([table[:1].repeat(6, axis=0), table])
        table[:, 0] = 0.02 * np.arange(len(table))
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=HEADER, comments="")
    init(folder)
    start = yaml.safe_load((folder / "study.yaml").read_text())["model"]["start"]
    assert list(start) == ["joint.shoulder.start", "joint.elbow.start"]


def test_friction_is_a_candidate_where_the_file_states_a_rate_and_no_clock(tmp_path):
    """Without a usual speed a place has no friction and no drag."""
    folder = arm_folder(tmp_path)
    init(folder)
    with_clock = yaml.safe_load((folder / "study.yaml").read_text())["model"]
    for name in ("slow", "fast"):
        table = np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1)
        table[:, 0] = 50.0
        header = HEADER.replace("time_s", "sample_rate")
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=header, comments="")
    (folder / "study.yaml").unlink()
    init(folder)
    stated = yaml.safe_load((folder / "study.yaml").read_text())
    assert stated["time"] == {"step": 0.02}
    assert stated["model"]["hooks"] == with_clock["hooks"]
    assert stated["model"]["start"] == with_clock["start"]
    assert all(place["speed"] > 0.0 for place in with_clock["hooks"]["force"].values())


def test_dry_friction_that_the_file_states_is_a_number_of_the_model(tmp_path):
    folder = arm_folder(tmp_path)
    text = (folder / "arm.xml").read_text()
    (folder / "arm.xml").write_text(
        text.replace('damping="0.6"', 'damping="0.6" frictionloss="0.2"')
    )
    init(folder)
    numbers = yaml.safe_load((folder / "study.yaml").read_text())["model"]["parameters"]
    assert numbers["joint.shoulder.frictionloss"] == {"value": 0.2, "percent": 50}
    assert "joint.elbow.frictionloss" not in numbers


def test_what_a_drive_can_do_at_most_is_a_number_of_the_model(tmp_path):
    """A servo kept its speed by its largest torque and its damping: neither was in the model."""
    folder = arm_folder(tmp_path)
    text = (folder / "arm.xml").read_text()
    text = text.replace('damping="0.6"', 'damping="0.6" armature="0.02"')
    text = text.replace('kp="60"', 'kp="60" kv="4" forcerange="-2.5 2.5"')
    (folder / "arm.xml").write_text(text)
    init(folder)
    numbers = yaml.safe_load((folder / "study.yaml").read_text())["model"]["parameters"]
    assert numbers["joint.shoulder.armature"] == {"value": 0.02, "percent": 50}
    assert numbers["actuator.m1.kv"] == {"value": 4.0, "percent": 50}
    assert numbers["actuator.m1.forcerange"] == {"value": 2.5, "percent": 10}
    assert "actuator.m2.forcerange" not in numbers
    assert load_study(folder).model is not None


@pytest.mark.parametrize("first", [0.4, 0.0])
def test_what_a_servo_was_told_before_is_where_its_joint_rests(tmp_path, first):
    """Logs begin with their step: of a delay or a speed limit nothing is seen without what was
    commanded before."""
    (tmp_path / "arm.xml").write_text(ARM.format(one="shoulder", two="elbow", more=""))
    time = 0.02 * np.arange(60)
    for k, sign in enumerate((1.0, -1.0, 1.5)):
        late = np.clip(time - 0.06, 0.0, None)
        moved = sign * 0.4 * (1.0 - np.exp(-late / 0.1))
        goal = np.full(60, sign * 0.4)
        if not first:
            goal = sign * 0.4 * np.sin(4.0 * time)
        table = np.c_[time, goal, moved]
        header = "time_s,goal_shoulder_rad,shoulder_rad"
        np.savetxt(tmp_path / f"step_{k}.csv", table, delimiter=",", header=header, comments="")
    init(tmp_path)
    (command,) = yaml.safe_load((tmp_path / "study.yaml").read_text())["commands"]
    assert command.get("before") == (0.0 if first else None)
    if not first:
        return
    study = load_study(tmp_path / "study.yaml", strict=False)
    assert study.commands[0].before == 0.0
    setup = setup_of(study)
    (late,) = (e for e in setup.effects if e.name == "delay_of_m1")
    run = study.runs[0]
    problem = Problem(setup.model, (run,), WhiteNoise(study.channels), (late,))
    x = np.zeros(len(problem.names))
    still = problem.record(x)
    x[-1] = 1.0
    moved = problem.record(x)
    assert np.abs(moved - still).max() > 0.01  # a delay of the step with the first row shows


def test_meshes_and_includes_in_folders_of_their_own_are_found(tmp_path):
    """As makers lay robots out: models two folders deep, meshes beside their folder."""
    folder = arm_folder(tmp_path)
    models, meshes = folder / "robot" / "mjcf", folder / "robot" / "meshes"
    for path in (models / "common", meshes):
        path.mkdir(parents=True)
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    lines = [f"v {x} {y} {z}" for x, y, z in points]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    (meshes / "hull.obj").write_text("\n".join(lines))
    asset = '<mujocoinclude><asset><mesh name="hull" file="hull.obj"/></asset></mujocoinclude>'
    (models / "common" / "assets.xml").write_text(asset)
    text = (folder / "arm.xml").read_text()
    head = '<compiler meshdir="../meshes"/><include file="common/assets.xml"/>'
    head += '<default><geom contype="0" conaffinity="0"/></default>'
    text = text.replace("<option", f"{head}<option", 1)
    mesh = '<geom type="mesh" mesh="hull" mass="0.01"/><body name="fore"'
    (models / "arm.xml").write_text(text.replace('<body name="fore"', mesh))
    (models / "scene.xml").write_text('<mujoco><include file="arm.xml"/></mujoco>')
    (folder / "arm.xml").unlink()
    init(folder)
    stated = yaml.safe_load((folder / "study.yaml").read_text())["model"]
    assert stated["options"]["model"] == "robot/mjcf/scene.xml"
    assert "body.fore.mass" in stated["parameters"]
    assert setup_of(load_study(folder / "study.yaml")).model.name == "scene.xml in MuJoCo"


def test_a_file_that_is_the_model_is_not_said_to_be_unused(tmp_path, capsys):
    """Two lines contradicted each other: "not used: arm.xml", "model: arm.xml"."""
    folder = arm_folder(tmp_path)
    (folder / "wiring.dwg").write_bytes(b"AC1015")
    init(folder)
    said = capsys.readouterr().out
    assert "guessed: model: arm.xml" in said
    assert "other files, not used: wiring.dwg\n" in said


def test_words_that_all_joints_share_tell_none_and_a_current_is_no_torque(tmp_path, capsys):
    folder = arm_folder(tmp_path, one="FR_thigh_joint", two="FR_calf_joint")
    for path in folder.glob("*.csv"):
        first, rest = path.read_text().split("\n", 1)
        assert first == HEADER
        header = "time_s,goal_thigh_rad,calf_current_A,calf_q_deg,thigh_q_deg,calf_rate_rad_s"
        path.write_text(f"{header}\n{rest}")
    init(folder)
    stated = yaml.safe_load((folder / "study.yaml").read_text())
    assert stated["model"]["options"]["channels"]["calf_q"] == "joint.FR_calf_joint.position"
    (todo,) = [one for one in stated["todo"] if one.startswith("commands:")]
    assert "calf_current_A is in A, but actuator m2 takes N m: state unit: N m" in todo
    assert "joints of the MJCF by their names" in capsys.readouterr().out


def test_an_actuator_of_a_tendon_drives_no_joint():
    """Its number among tendons was read as one among joints."""
    text = """<mujoco><worldbody><body><joint name="a" type="hinge"/><geom size="0.1"/></body>
      </worldbody><tendon><fixed name="t"><joint joint="a" coef="2"/></fixed></tendon>
      <actuator><motor name="pull" tendon="t"/><motor name="turn" joint="a"/></actuator></mujoco>"""
    plain = mujoco.MjModel.from_xml_string(text)
    assert [_joint_of(plain, i) for i in range(2)] == ["", "a"]


def test_columns_need_not_repeat_a_word_that_all_joints_share(tmp_path):
    """Of a bimanual arm's repository none was told by columns right_joint1 and not openarm_..."""
    arms = ARMS.format(servo="position", gain="kp", more="")
    arms = arms.replace('"left_', '"bot_left_').replace('"right_', '"bot_right_')
    (tmp_path / "arms.xml").write_text(arms)
    puck = '<body name="puck"><joint name="puck" type="slide"/><geom size="1"/></body>'
    scene = f'<mujoco><include file="arms.xml"/><worldbody>{puck}</worldbody></mujoco>'
    for name in ("desk", "shelf"):
        (tmp_path / f"{name}.xml").write_text(scene)
    for run in "ab":
        goal = np.sin(TIME + ord(run))
        header = "time_s,left_1_pos_rad,left_1_goal_rad"
        table = np.c_[TIME, 0.9 * goal, goal]
        np.savetxt(tmp_path / f"{run}.csv", table, delimiter=",", header=header, comments="")
    init(tmp_path)
    stated = yaml.safe_load((tmp_path / "study.yaml").read_text())["model"]
    assert stated["options"]["model"] == "arms.xml"
    assert stated["options"]["channels"] == {"left_1_pos_rad": "joint.bot_left_1.position"}
