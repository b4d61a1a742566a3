"""Rigs of simulators that share no code with ours, most in MuJoCo; each hides what its sheet omits.

A rig takes commands and gives what its sensors show. True parameters lie within about one standard
deviation of the data sheet's (RIG.yaml), hidden causes within a quarter of their usual size; both
are drawn by the seed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.pays.draws import about, off
from benchmarks.pays.quadrotor import quadrotor

Array = NDArray[np.float64]
FINE = 1e-3  # MuJoCo's step [s]
SHARP = 'solreffriction="0.003 1" solimpfriction="0.99 0.99 0.001"'  # friction without give
STIFF = 'solreflimit="0.003 1" solimplimit="0.99 0.99 0.0001"'  # a stop without give


class Rig(Protocol):
    """What stands for the hardware."""

    def record(self, time_s: Array, commands: Sequence[Array]) -> Array:
        """What the sensors show without noise, (num_samples, num_channels).

        Args:
            time_s: Evenly spaced, (num_samples,) [s].
            commands: Each (num_samples,), linear between samples.
        """


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A MuJoCo model with what was hidden in it."""

    xml: str  # the model
    read: tuple[str, ...]  # names of its sensors, one number each, in the order of the channels
    late_s: float = 0.0  # time by which commands come later [s]
    # joints that follow commands exactly, by the command's place; others are actuators
    led: Mapping[str, int] = ()  # type: ignore[assignment]

    def record(self, time_s: Array, commands: Sequence[Array]) -> Array:
        """What the sensors show without noise, (num_samples, num_channels)."""
        import mujoco

        model: Any = mujoco.MjModel.from_xml_string(self.xml)
        data: Any = mujoco.MjData(model)
        places = [int(model.sensor(name).adr[0]) for name in self.read]
        per_sample = round(float(time_s[1] - time_s[0]) / FINE)
        steps = (len(time_s) - 1) * per_sample
        middle = time_s[0] + (np.arange(steps) + 0.5) * FINE - self.late_s
        driven = np.stack([np.interp(middle, time_s, c) for c in commands], 1)
        begin = time_s[0] + np.arange(steps) * FINE - self.late_s
        led = {int(model.joint(j).qposadr[0]): commands[k] for j, k in dict(self.led).items()}
        paths = {at: (np.interp(begin, time_s, c), c) for at, c in led.items()}
        free = [k for k in range(len(commands)) if k not in dict(self.led).values()]
        rows = np.empty((len(time_s), len(places)))
        for step in range(steps + 1):
            if step % per_sample == 0:
                mujoco.mj_forward(model, data)
                rows[step // per_sample] = data.sensordata[places]
            if step == steps:
                break
            data.ctrl[:] = driven[step, free]
            for at, (path, _) in paths.items():
                data.qpos[at] = path[step]
                ahead = path[step + 1] if step + 1 < steps else path[step]
                data.qvel[at] = (ahead - path[step]) / FINE
            mujoco.mj_step(model, data)
        return rows


def _world(option: str, body: str, more: str) -> str:
    return (
        f'<mujoco><option timestep="{FINE}" {option}/><worldbody>{body}</worldbody>{more}</mujoco>'
    )


def _angles(*names: str) -> str:
    return "".join(f'<jointpos name="{name}" joint="{name}"/>' for name in names)


def arm(rng: np.random.Generator) -> Mechanism:
    """Two links in a vertical plane; the elbow rubs, and commands come late."""
    lower = off(rng, 0.6, 5.0)
    body = f"""
    <body><inertial mass="1.0" pos="0 0 -0.15" diaginertia="0.008 0.008 0.001"/>
      <joint name="shoulder" axis="0 -1 0" damping="{off(rng, 0.25, 30.0)}"/>
      <body pos="0 0 -0.3">
        <inertial mass="{lower}" pos="0 0 -0.12" diaginertia="{lower / 150} {lower / 150} 0.0005"/>
        <joint name="elbow" axis="0 -1 0" damping="{off(rng, 0.1, 30.0)}"
               frictionloss="{about(rng, 0.12)}" {SHARP}/></body></body>"""
    more = f"""<actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator>
    <sensor>{_angles("shoulder", "elbow")}</sensor>"""
    return Mechanism(
        _world('integrator="RK4"', body, more), ("shoulder", "elbow"), about(rng, 0.03)
    )


def spindle(rng: np.random.Generator) -> Mechanism:
    """A table on a belt, driven by a spindle whose nut has play and stays where it is left."""
    gap = about(rng, 0.004)
    body = f"""
    <body><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
      <joint name="drive" type="slide" axis="1 0 0" armature="1e5"/></body>
    <body><inertial mass="0.05" pos="0 0 0" diaginertia="1 1 1"/>
      <joint name="nut" type="slide" axis="1 0 0" frictionloss="20" damping="20"
             {SHARP}/></body>
    <body><inertial mass="{off(rng, 1.5, 5.0)}" pos="0 0 0" diaginertia="1 1 1"/>
      <joint name="table" type="slide" axis="1 0 0" damping="{off(rng, 6.0, 30.0)}"/></body>"""
    more = f"""<tendon>
      <fixed name="gap" limited="true" range="{-gap} {gap}" {STIFF}>
        <joint joint="nut" coef="1"/><joint joint="drive" coef="-1"/></fixed>
      <fixed name="belt" stiffness="{off(rng, 150.0, 10.0)}" springlength="0">
        <joint joint="nut" coef="1"/><joint joint="table" coef="-1"/></fixed></tendon>
    <sensor>{_angles("table")}</sensor>"""
    world = _world('integrator="implicitfast" gravity="0 0 0"', body, more)
    return Mechanism(world, ("table",), led={"drive": 0})


def gimbal(rng: np.random.Generator) -> Mechanism:
    """A camera that pans and tilts; its center of mass lies off the axes, and pan rubs."""
    forward, down = about(rng, 0.01), about(rng, 0.02)
    body = f"""
    <body><inertial mass="0.3" pos="0 0 0" diaginertia="0.002 0.002 0.004"/>
      <joint name="pan" axis="0 0 1" damping="{off(rng, 0.05, 30.0)}"
             frictionloss="{about(rng, 0.03)}" {SHARP}/>
      <body><inertial mass="0.8" pos="{forward} 0 -{down}" diaginertia="0.006 0.006 0.006"/>
        <joint name="tilt" axis="0 -1 0" damping="{off(rng, 0.05, 30.0)}"/></body></body>"""
    more = f"""<actuator><motor joint="pan"/><motor joint="tilt"/></actuator>
    <sensor>{_angles("pan", "tilt")}</sensor>"""
    return Mechanism(_world('integrator="RK4"', body, more), ("pan", "tilt"))


def crane(rng: np.random.Generator) -> Mechanism:
    """A trolley with a load on a rod; its motor lags, and the rail rubs."""
    lag = about(rng, 0.06)
    body = f"""
    <body><inertial mass="{off(rng, 2.0, 5.0)}" pos="0 0 0" diaginertia="1 1 1"/>
      <joint name="trolley" type="slide" axis="1 0 0" damping="{off(rng, 3.0, 30.0)}"
             frictionloss="{about(rng, 1.5)}" {SHARP}/>
      <body><inertial mass="{off(rng, 0.8, 5.0)}" pos="0 0 -0.5" diaginertia="1e-4 1e-4 1e-4"/>
        <joint name="rod" axis="0 -1 0" damping="{off(rng, 0.01, 30.0)}"/></body></body>"""
    more = f"""<actuator><general joint="trolley" dyntype="filter" dynprm="{lag}"
      gainprm="1"/></actuator><sensor>{_angles("trolley", "rod")}</sensor>"""
    return Mechanism(_world('integrator="RK4"', body, more), ("trolley", "rod"))


def finger(rng: np.random.Generator) -> Mechanism:
    """A finger that a tendon bends against a spring; the tendon hangs slack, the joint rubs."""
    slack = about(rng, 0.003)
    body = f"""
    <body><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
      <joint name="motor" type="slide" axis="1 0 0" armature="1e5"/></body>
    <body><inertial mass="0.1" pos="0 0 -0.05" diaginertia="5e-4 5e-4 5e-4"/>
      <joint name="finger" axis="0 -1 0" damping="{off(rng, 0.012, 30.0)}"
             stiffness="{off(rng, 0.25, 10.0)}" frictionloss="{about(rng, 0.015)}"
             {SHARP}/></body>"""
    more = f"""<tendon><fixed name="tendon" stiffness="4000" springlength="-1 {slack}">
      <joint joint="motor" coef="1"/><joint joint="finger" coef="-0.01"/></fixed></tendon>
    <sensor>{_angles("finger")}</sensor>"""
    world = _world('integrator="RK4" gravity="0 0 0"', body, more)
    return Mechanism(world, ("finger",), led={"motor": 0})


RIGS: Mapping[str, Callable[[np.random.Generator], Rig]] = {
    f.__name__: f for f in (arm, spindle, gimbal, crane, finger, quadrotor)
}
