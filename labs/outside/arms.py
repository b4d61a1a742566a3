"""A two-link arm in MuJoCo with a hidden cause, described by its own MJCF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Run
from labs.outside.case import Case, Maker, off, plan, recorded
from labs.outside.mechanisms import SHARP, SLOW, Rig, fine_step

Array = NDArray[np.float64]
TIME: Array = 0.025 * np.arange(65.0)

ARM = """
<mujoco>
  <option timestep="{step}" integrator="{integrator}" {option}/>
  <worldbody>
    <body name="upper">
      <inertial mass="1.0" pos="0 0 -0.15" diaginertia="0.008 0.008 0.001"/>
      <joint name="shoulder" axis="0 -1 0" damping="{shoulder}"/>
      <body name="lower" pos="0 0 -0.3">
        <inertial mass="{lower}" pos="0 0 -0.12" diaginertia="{turning} {turning} 0.0005"/>
        <joint name="elbow" axis="0 -1 0" damping="{elbow}" {joint}/>
        <site name="hand" pos="0 0 -0.25"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
  <sensor>
    <jointpos name="shoulder" joint="shoulder"/>
    <jointpos name="elbow" joint="elbow"/>
    <framepos name="hand" objtype="site" objname="hand"/>
  </sensor>
</mujoco>
"""
MOTORS = (
    '<motor name="shoulder_Nm" joint="shoulder"/>'
    '<general name="elbow_Nm" joint="elbow" gainprm="1" {more}/>'
)
CHANNELS = (
    Channel("shoulder_rad", "rad", "angle", sd=2e-3),
    Channel("elbow_rad", "rad", "angle", sd=2e-3),
    Channel("hand_x_m", "m", "position", sd=1e-3),
    Channel("hand_z_m", "m", "position", sd=1e-3),
)


def _record(rig: Rig, camera_s: float, run: Run) -> Array:
    """Two angles, then the hand's place across and up, as a late camera sees it."""
    seen = rig.record(run)[:, [0, 1, 2, 4]]
    if camera_s:
        often = run.time_s[0] + 0.005 * np.arange(5 * len(run.time_s) - 4)
        pushed = {n: np.interp(often, run.time_s, c) for n, c in run.command.items()}
        empty = np.zeros((len(often), run.measured.shape[1]))
        filming = replace(run, time_s=often, measured=empty, command=pushed)
        filmed = rig.record(filming)[:, [2, 4]]
        at = np.maximum(5 * np.arange(len(run.time_s)) - round(camera_s / 0.005), 0)
        seen[:, 2:] = filmed[at]
    return seen


def arm(
    seed: int,
    *,
    hidden: Mapping[str, float | None] | None = None,
    joint: str = "",
    option: str = "",
    lag: float = 0.0,
    camera_s: float = 0.0,
    also: tuple[str, ...] = (),
) -> Case:
    """An arm under two commanded moments.

    Args:
        seed: Of commands, true parameters and noise.
        hidden: What is hidden, with its size in the library's unit.
        joint, option: More attributes of the elbow and of the medium.
        lag: Time constant of the elbow's motor [s].
        camera_s: Time by which the camera is late [s].
        also: Names that say the same.
    """
    rng = np.random.default_rng(seed)
    lower = off(rng, 0.6, 0.05)
    base = {
        "joint.shoulder.damping": off(rng, 0.25, 0.3),
        "joint.elbow.damping": off(rng, 0.1, 0.3),
        "body.lower.mass": lower,
    }
    xml = ARM.format(
        step=fine_step(lag),
        integrator="RK4",
        option=option,
        shoulder=base["joint.shoulder.damping"],
        elbow=base["joint.elbow.damping"],
        lower=lower,
        turning=0.004 * lower / 0.6,
        joint=joint,
        actuator=MOTORS.format(more=SLOW.format(lag=lag) if lag else ""),
    )
    rig = Rig(xml, read=("shoulder", "elbow", "hand"))
    own = ARM.format(
        step=0.00625,
        integrator="RK4",
        option="",
        shoulder=0.25,
        elbow=0.1,
        lower=0.6,
        turning=0.004,
        joint="",
        actuator=MOTORS.format(more=""),
    )
    moment = {"unit": "N m", "typical": 0.05}
    model = {
        "system": "outside",
        "simulator": "diffsim.systems.outside.mjcf:Mjcf",
        "options": {
            "model": own,
            "channels": {
                "shoulder_rad": "shoulder",
                "elbow_rad": "elbow",
                "hand_x_m": "hand[0]",
                "hand_z_m": "hand[2]",
            },
        },
        "parameters": {
            "joint.shoulder.damping": {"value": 0.25, "percent": 40, "unit": "N m s/rad"},
            "joint.elbow.damping": {"value": 0.1, "percent": 40, "unit": "N m s/rad"},
            "body.lower.mass": {"value": 0.6, "percent": 7, "unit": "kg"},
        },
        "hooks": {
            "command": {"shoulder": ["shoulder_Nm"], "elbow": ["elbow_Nm"]},
            "force": {
                "shoulder": {**moment, "distance": 0.4, "speed": 2.0},
                "elbow": {**moment, "distance": 0.4, "speed": 2.0},
            },
            "output": {
                "encoders": ["shoulder_rad", "elbow_rad"],
                "camera": ["hand_x_m", "hand_z_m"],
            },
        },
    }
    runs = plan(TIME, _commands(rng), "mixed", len(CHANNELS))
    study, clean = recorded("arm", CHANNELS, runs, partial(_record, rig, camera_s), model, rng)
    kind = "single" if hidden else "null"
    return Case(study, clean, kind, hidden or {}, also, base=base)


def _commands(rng: np.random.Generator) -> dict[str, dict[str, Array]]:
    a, b = 1.0 + 0.2 * rng.random(2)
    ramp = np.minimum(TIME / 0.1, 1.0)

    def both(shoulder: Array, elbow: Array) -> dict[str, Array]:
        return {"shoulder_Nm": shoulder * ramp, "elbow_Nm": elbow * ramp}

    return {
        "slow": both(1.5 * np.sin(3.0 * a * TIME), 0.5 * np.sin(4.0 * b * TIME + 1.0)),
        "fast": both(1.5 * np.sin(6.5 * b * TIME), 0.6 * np.sign(np.sin(5.0 * a * TIME))),
        "mixed": both(1.0 * np.sin(5.0 * TIME), 0.5 * np.sin(7.0 * TIME + 2.0)),
    }


ARMS: dict[str, Maker] = {
    "arm_as_described": arm,
    "arm_rubbing_elbow": partial(
        arm, joint=f'frictionloss="0.02" {SHARP}', hidden={"dry_friction_at_elbow": 0.02}
    ),
    "arm_cable_at_elbow": partial(
        arm, joint='stiffness="0.25"', hidden={"added_spring_at_elbow": 0.25}
    ),
    "arm_slow_elbow_motor": partial(arm, lag=0.03, hidden={"lag_of_elbow": 0.03}),
    "arm_late_camera": partial(arm, camera_s=0.03, hidden={"sensor_delay_of_camera": 0.03}),
}
