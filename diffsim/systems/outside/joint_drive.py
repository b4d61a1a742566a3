"""A position drive on a hinge of a MuJoCo model: what MuJoCo's own elements do not have.

This file stands alone, beside the constants that `diffsim diagnose export --to mujoco` writes::

    import json, mujoco
    from joint_drive import JointDrive, model_text

    constants = json.load(open("mujoco.json"))
    model = mujoco.MjModel.from_xml_string(model_text(constants))
    data, drive = mujoco.MjData(model), JointDrive(constants)
    drive.begin(model, goal=0.0)
    while data.time < 2.0:
        drive.set_control(model, data, goal=0.5)    # before each step
        mujoco.mj_step(model, data)

Put the drive's elements into your own model, and name its joint and actuator to the drive.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

GRAVITY = 9.81  # m/s^2
SMALL_ERROR = 0.002  # rad: above it the starting torque is whole
DEFAULTS: dict[str, float] = {
    "kp": 0.0,  # torque per error [N m/rad]
    "forcerange": 0.0,  # largest torque [N m]
    "damping": 0.0,  # with the drive on, its brake included [N m s/rad]
    "brake": 0.0,  # of the drive, which goes with its power [N m s/rad]
    "frictionloss": 0.0,  # [N m]
    "armature": 0.0,  # [kg m^2]
    "zero_rad": 0.0,  # what the angle 0 is off from hanging [rad]
    "delay_s": 0.0,
    "lag_s": 0.0,
    "rate_limit_s": 0.0,  # of the goal inside the drive, as seconds per rad; 0: none
    "start_torque": 0.0,  # added to any error [N m]
    "load_friction": 0.0,  # share of the torques on the gear [-]
    "back_driving": 0.0,  # share of the load where it drives the motor [-]
    "load_damping": 0.0,  # share of the weight [s/rad]
    "bearing_damping": 0.0,  # share of the pull on the bearing [m s]
    "stick_speed": 0.0,  # below it dry friction fades and the joint creeps; 0: it sticks [rad/s]
    "stribeck": 0.0,  # more friction at rest than in motion [N m]
    "stribeck_speed": 1.0,  # [rad/s]
    "friction_asymmetry": 0.0,  # more friction forwards, less backwards [N m]
    "square_drag": 0.0,  # [N m s^2/rad^2]
    "supply_drop": 0.0,  # share at full drive [-]
    "load_inertia": 0.0,  # of what hangs on the joint, about it [kg m^2]
    "load_moment": 0.0,  # its mass times the distance of its center [kg m]
    "load_mass": 0.0,  # pull on the bearing at rest over gravity [kg]
    "load_arm": 0.0,  # distance of what pulls [m]
}


def with_defaults(constants: Mapping[str, Any]) -> dict[str, float]:
    """Constants with all that is not named at nothing."""
    return {name: float(constants.get(name, value)) for name, value in DEFAULTS.items()}


def model_text(constants: Mapping[str, Any], step_s: float = 0.001, delayed: bool = True) -> str:
    """An MJCF of the drive and the pendulum on its shaft.

    Args:
        constants: As exported, with those of a run.
        step_s: Time step [s].
        delayed: Whether the actuator is late by itself, for use without ``JointDrive``.
    """
    c = with_defaults(constants)
    inertia, moment = max(c["load_inertia"], 1e-9), c["load_moment"]
    mass = max(moment**2 / inertia, 1e-9)  # a point with that moment and that inertia
    limit = f' forcerange="{-c["forcerange"]!r} {c["forcerange"]!r}"' if c["forcerange"] else ""
    late = ""
    if delayed and c["delay_s"] > 0.0:
        late = f' delay="{c["delay_s"]!r}" nsample="{math.ceil(c["delay_s"] / step_s) + 1}"'
    return f"""<mujoco model="drive">
  <compiler angle="radian"/>
  <option timestep="{step_s!r}" integrator="implicitfast"/>
  <worldbody>
    <body name="load" euler="0 {c["zero_rad"]!r} 0">
      <joint name="joint" axis="0 1 0" damping="{c["damping"]!r}" armature="{c["armature"]!r}"
             frictionloss="{c["frictionloss"]!r}"/>
      <inertial pos="0 0 {-moment / mass!r}" mass="{mass!r}" diaginertia="1e-9 1e-9 1e-9"/>
    </body>
  </worldbody>
  <actuator>
    <position name="drive" joint="joint" kp="{c["kp"]!r}"{limit}{late}/>
  </actuator>
  <sensor><jointpos name="angle" joint="joint"/></sensor>
</mujoco>
"""


class JointDrive:
    """The drive of one hinge, called before each step.

    Args:
        constants: As exported, with those of a run.
        joint: Name of the hinge.
        actuator: Name of its ``<position>`` actuator.
    """

    def __init__(self, constants: Mapping[str, Any], joint: str = "joint", actuator: str = "drive"):
        self.constants = with_defaults(constants)
        self.joint, self.actuator = joint, actuator
        self._goals: deque[tuple[float, float]] = deque()
        self._reached, self._lagged = 0.0, 0.0

    def begin(self, model: Any, goal: float) -> None:
        """Start at a goal that was there all the time.

        Args:
            model: MuJoCo's model; what is late by itself in it is so no more.
            goal: Goal at the start [rad].
        """
        self._joint, self._actuator = model.joint(self.joint).id, model.actuator(self.actuator).id
        if hasattr(model, "actuator_delay"):
            model.actuator_delay[self._actuator] = 0.0  # the goal comes late here
        self._goals = deque([(-math.inf, goal)])
        self._reached, self._lagged = goal, goal

    def set_control(self, model: Any, data: Any, goal: float, powered: float = 1.0) -> None:
        """Set the goal of the actuator, friction and damping of the joint, for the next step.

        Args:
            model: MuJoCo's model.
            data: Its state.
            goal: What is commanded now [rad].
            powered: 1, or 0 where the torque is off.
        """
        c, step = self.constants, model.opt.timestep
        place, rate = int(model.jnt_qposadr[self._joint]), int(model.jnt_dofadr[self._joint])
        q, w = float(data.qpos[place]), float(data.qvel[rate])
        error = self._follow(float(data.time), goal, step) - q
        torque = c["kp"] * error + c["start_torque"] * math.tanh(error / SMALL_ERROR)
        limit = c["forcerange"] or math.inf
        torque = min(max(torque, -limit), limit) * powered
        if c["forcerange"]:
            torque *= 1.0 - c["supply_drop"] * abs(torque) / limit
        # the actuator itself pushes: its goal is where its own gain gives this torque
        data.ctrl[self._actuator] = q + torque / c["kp"] if c["kp"] else q
        damping, motor = self._damping(q, w, powered), torque - powered * c["brake"] * w
        friction = self._friction(w, motor, float(data.qfrc_bias[rate]))
        if (creep := c["stick_speed"]) > 0.0:
            # as a damping it is integrated implicitly, so that it may be steep
            slow = max(abs(w), 1e-9)
            damping, friction = damping + friction * math.tanh(slow / creep) / slow, 0.0
        model.dof_damping[rate], model.dof_frictionloss[rate] = damping, friction

    def _follow(self, now: float, goal: float, step: float) -> float:
        """The goal inside the drive: late, no faster than its limit, smoothed."""
        c, goals = self.constants, self._goals
        goals.append((now, goal))
        then = now - c["delay_s"] + 1e-9
        while len(goals) > 1 and goals[1][0] <= then:
            goals.popleft()
        heard = goals[0][1]
        if c["rate_limit_s"] > 0.0:
            most = step / c["rate_limit_s"]
            self._reached += min(max(heard - self._reached, -most), most)
        else:
            self._reached = heard
        if c["lag_s"] > 0.0:
            self._lagged += (self._reached - self._lagged) * -math.expm1(-step / c["lag_s"])
        else:
            self._lagged = self._reached
        return self._lagged

    def _damping(self, q: float, w: float, powered: float) -> float:
        c = self.constants
        pull = c["load_mass"] * (GRAVITY * math.cos(q) + c["load_arm"] * w * w)
        damping = (
            c["damping"]
            - (1.0 - powered) * c["brake"]
            + c["load_damping"] * GRAVITY * (c["load_moment"])
        )
        return max(damping + c["bearing_damping"] * pull + c["square_drag"] * abs(w), 0.0)

    def _friction(self, w: float, motor: float, bias: float) -> float:
        """Dry friction at this moment [N m]; ``bias`` is what gravity asks the joint to hold."""
        c = self.constants
        load = -bias
        friction = c["frictionloss"] + c["load_friction"] * (abs(motor) + abs(load))
        friction += c["back_driving"] * abs(load) * (load * w > 0.0)
        friction += c["stribeck"] * math.exp(-((w / c["stribeck_speed"]) ** 2))
        return max(friction + c["friction_asymmetry"] * math.copysign(w != 0.0, w), 0.0)
