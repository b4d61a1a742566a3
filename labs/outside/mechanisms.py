"""Mechanisms in MuJoCo with one hidden cause, described to the diagnosis by their equations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Run
from labs.outside.case import Case, Maker, off, plan, recorded

Array = NDArray[np.float64]
TIME: Array = 0.02 * np.arange(150.0)
FINE = 5e-4  # MuJoCo's usual step [s], forty to a sample
GRAVITY, MIDDLE = 9.81, 0.25  # of MuJoCo [m/s^2]; of a rod's middle from its hinge [m]
SHARP = 'solreffriction="0.0015 1"'  # friction without give
Push = Callable[[Any, Any, float], None]


def commands(most: float, rng: np.random.Generator) -> dict[str, Array]:
    """Sine, steps and chirp of about the same amplitude, and a mixture for the test."""
    a, b = 1.0 + 0.2 * rng.random(2)
    ramp = np.minimum(TIME / 0.1, 1.0)
    steps = np.interp(
        TIME, [0, 0.2, 0.3, 1.2, 1.4, 2.2, 2.3, 3], [0, 0, 0.8, 0.8, -0.6, -0.6, 0, 0]
    )
    return {
        "sine": most * 0.9 * np.sin(4.0 * a * TIME) * ramp,
        "steps": most * steps,
        "chirp": most * np.sin(2 * np.pi * (0.4 + 0.3 * b * TIME) * TIME) * ramp,
        "mixed": most * 0.5 * (np.sin(3.1 * TIME) + np.sin(7.7 * TIME + 0.4)) * ramp,
    }


@dataclass(frozen=True)
class Rig:
    """A MuJoCo model with what was hidden in it."""

    xml: str  # the model
    late_s: float = 0.0  # time by which commands come later [s]
    push: Push | None = None  # function (model, data, time) that adds forces before a step
    read: tuple[str, ...] = ("angle",)  # sensors of the model, in the order of the channels

    def record(self, run: Run) -> Array:
        """(num_samples, num_channels) without noise."""
        import mujoco

        model: Any = mujoco.MjModel.from_xml_string(self.xml)
        data: Any = mujoco.MjData(model)
        sensors = [model.sensor(name) for name in self.read]
        entries = [int(s.adr[0]) + i for s in sensors for i in range(int(s.dim[0]))]
        columns = list(run.command.values())
        time, rows = run.time_s, []
        step = float(model.opt.timestep)
        per_sample = round((time[1] - time[0]) / step)
        for k in range(len(time)):
            mujoco.mj_forward(model, data)
            rows.append(np.array(data.sensordata[entries]))
            for s in range(per_sample if k + 1 < len(time) else 0):
                now = time[k] + (s + 0.5) * step
                data.ctrl[:] = [np.interp(now - self.late_s, time, c) for c in columns]
                if self.push is not None:
                    self.push(model, data, now)
                mujoco.mj_step(model, data)
        return np.array(rows)


# A rod on a hinge, driven by a motor -------------------------------------------------------------

PENDULUM = """
<mujoco>
  <option timestep="{step}" integrator="RK4" {option}/>
  <worldbody>
    <body name="rod">
      <inertial mass="{mass}" pos="0 0 -{middle}" diaginertia="{inertia} {inertia} 0.001"/>
      <joint name="hinge" axis="0 -1 0" damping="{damping}" {joint}/>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
  <sensor><jointpos name="angle" joint="hinge"/><jointvel name="rate" joint="hinge"/></sensor>
</mujoco>
"""
MOTOR = '<motor name="motor" joint="{joint}"/>'
# not "filterexact": it holds the force over each step, which is half a step more of lag
SLOW = 'dyntype="filter" dynprm="{lag}"'
FILTERED = f'<general name="motor" joint="{{joint}}" gainprm="1" {SLOW}/>'


def fine_step(lag: float) -> float:
    """MuJoCo's step [s]: the usual one, or a part of it no longer than a motor's lag.

    Args:
        lag: Time constant of the motor [s]; 0: none.
    """
    return FINE / max(np.ceil(FINE / lag), 1.0) if lag else FINE


PENDULUM_MODEL = {
    "system": "ode",
    "states": {"angle": "0 rad", "rate": "0 rad/s"},
    "rates": {
        "angle": "rate",
        "rate": "(moment_Nm - damping*rate - weight*sin(angle))/inertia",
    },
    "inputs": ["moment_Nm"],
    "parameters": {
        "inertia": {"value": 0.07, "percent": 10, "unit": "kg m^2"},
        "damping": {"value": 0.06, "percent": 50, "unit": "N m s/rad"},
        "weight": {"value": 1.96, "percent": 7, "unit": "N m"},
    },
    "readings": {"angle_rad": "angle"},
    "places": [
        {
            "name": "hinge",
            "position": "angle",
            "velocity": "rate",
            "inertia": "inertia",
            "unit": "N m",
            "position_unit": "rad",
        }
    ],
}


def pendulum(
    seed: int,
    *,
    hidden: Mapping[str, float | None] | None = None,
    joint: str = "",
    option: str = "",
    lag: float = 0.0,
    late_s: float = 0.0,
    also: tuple[str, ...] = (),
) -> Case:
    """A driven pendulum, its angle measured to 2 mrad.

    Args:
        seed: Of commands, true parameters and noise.
        hidden: What is hidden, with its size in the library's unit.
        joint, option: More attributes of the joint and of the medium.
        lag: Time constant of the motor [s].
        late_s: Delay of the command [s].
        also: Names that say the same.
    """
    rng = np.random.default_rng(seed)
    mass, inertia = off(rng, 0.8, 0.05), 0.02
    damping = off(rng, 0.06, 0.3)
    actuator = (FILTERED if lag else MOTOR).format(joint="hinge", lag=lag)
    rig = Rig(
        PENDULUM.format(
            step=fine_step(lag),
            mass=mass,
            middle=MIDDLE,
            inertia=inertia,
            damping=damping,
            joint=joint,
            option=option,
            actuator=actuator,
        ),
        late_s,
    )
    channels = [Channel("angle_rad", "rad", "angle", sd=2e-3)]
    columns = {k: {"moment_Nm": v} for k, v in commands(0.9, rng).items()}
    runs = plan(TIME, columns, "mixed", 1)
    study, clean = recorded("pendulum", channels, runs, rig.record, PENDULUM_MODEL, rng)
    base = {
        "inertia": inertia + mass * MIDDLE**2,
        "damping": damping,
        "weight": mass * GRAVITY * MIDDLE,
    }
    kind = "single" if hidden else "null"
    return Case(study, clean, kind, hidden or {}, also, base=base)


# A cart on a rail with a spring -----------------------------------------------------------------

CART = """
<mujoco>
  <option timestep="{step}" integrator="RK4" gravity="{gx} 0 -9.81"/>
  <worldbody>
    <body name="cart">
      <inertial mass="{mass}" pos="0 0 0" diaginertia="0.01 0.01 0.01"/>
      <joint name="rail" type="slide" axis="1 0 0" damping="{damping}" stiffness="{spring}"
             {joint}/>
      <site name="hook" pos="0 0 0"/>
      {body}
    </body>
    <site name="wall" pos="0 0.3 0"/>
  </worldbody>
  {more}
  <actuator>{actuator}</actuator>
  <sensor><jointpos name="place" joint="rail"/></sensor>
</mujoco>
"""
ABSORBER = """
<body name="absorber">
  <inertial mass="0.25" pos="0 0 0" diaginertia="0.001 0.001 0.001"/>
  <joint name="absorber" type="slide" axis="1 0 0" damping="0.25" stiffness="30"/>
</body>
"""


def cart(
    seed: int,
    *,
    kind: str = "",
    hidden: Mapping[str, float | None] | None = None,
    joint: str = "",
    body: str = "",
    more: str = "",
    actuator: str = "",
    lag: float = 0.0,
    gx: float = 0.0,
    push: Push | None = None,
    also: tuple[str, ...] = (),
) -> Case:
    """A cart on a spring, its place measured to 0.5 mm.

    Args:
        seed: Of commands, true parameters and noise.
        kind: Kind of case; by ``hidden`` if empty.
        hidden: What is hidden, with its size in the library's unit.
        joint, body, more, actuator: More of the MJCF.
        lag: Time constant of the motor, where no actuator is given [s].
        gx: Gravity along the rail [m/s^2].
        push: Force that nobody recorded.
        also: Names that say the same.
    """
    rng = np.random.default_rng(seed)
    # in the order in which they were always drawn
    base = {
        "mass": off(rng, 1.2, 0.05),
        "damping": off(rng, 1.0, 0.3),
        "spring": off(rng, 40.0, 0.1),
    }
    xml = CART.format(
        step=fine_step(lag),
        **base,
        gx=gx,
        joint=joint,
        body=body,
        more=more,
        actuator=actuator or (FILTERED if lag else MOTOR).format(joint="rail", lag=lag),
    )
    rig = Rig(xml, push=push, read=("place",))
    model = {
        "system": "ode",
        "states": {"x": "0 m", "v": "0 m/s"},
        "rates": {"x": "v", "v": "(force_N - damping*v - spring*x)/mass"},
        "inputs": ["force_N"],
        "parameters": {
            "mass": {"value": 1.2, "percent": 7, "unit": "kg"},
            "damping": {"value": 1.0, "percent": 50, "unit": "N s/m"},
            "spring": {"value": 40.0, "percent": 15, "unit": "N/m"},
        },
        "readings": {"place_m": "x"},
        "places": [{"position": "x", "velocity": "v", "inertia": "mass"}],
    }
    channels = [Channel("place_m", "m", "position", sd=5e-4)]
    columns = {k: {"force_N": v} for k, v in commands(3.0, rng).items()}
    runs = plan(TIME, columns, "mixed", 1)
    study, clean = recorded("cart", channels, runs, rig.record, model, rng)
    kind = kind or ("single" if hidden else "null")
    return Case(study, clean, kind, hidden or {}, also, base=base)


def _hit(model: Any, data: Any, time: float) -> None:
    """A ball hits the cart at 1.3 s, in every run."""
    data.qfrc_applied[0] = 2.5 * np.exp(-(((time - 1.3) / 0.05) ** 2))


MECHANISMS: dict[str, Maker] = {
    "pendulum_as_described": pendulum,
    "pendulum_dry_friction": partial(
        pendulum, joint=f'frictionloss="0.03" {SHARP}', hidden={"dry_friction_at_hinge": 0.03}
    ),
    "pendulum_spring": partial(
        pendulum,
        joint='stiffness="0.5"',
        hidden={"added_spring_at_hinge": 0.5},
    ),
    "pendulum_slow_motor": partial(pendulum, lag=0.03, hidden={"lag": 0.03}),
    "pendulum_late_command": partial(pendulum, late_s=0.02, hidden={"delay": 0.02}),
    "cart_as_described": cart,
    "cart_on_a_slope": partial(
        cart, gx=0.15, hidden={"constant_force": None}, also=("command_offset",)
    ),
    "cart_dry_friction": partial(
        cart, joint=f'frictionloss="0.15" {SHARP}', hidden={"dry_friction": 0.15}
    ),
    "cart_weak_motor": partial(
        cart,
        actuator='<motor name="motor" joint="rail" ctrllimited="true" ctrlrange="-2.2 2.2"/>',
        hidden={"saturation": None},
    ),
    "cart_slow_motor": partial(cart, lag=0.04, hidden={"lag": 0.04}),
    "cart_stiffening_spring": partial(
        cart,
        more='<tendon><spatial stiffness="60" springlength="0.3"><site site="hook"/>'
        '<site site="wall"/></spatial></tendon>',
        hidden={"cubic_stiffness": None},
    ),
    "cart_with_an_absorber": partial(cart, kind="outside", body=ABSORBER),
    "cart_hit_by_a_ball": partial(cart, kind="outside", push=_hit),
}
