"""A MuJoCo model (MJCF) as a simulator: parameters, commands, places and channels by their names.

In a study::

    model:
      system: outside
      simulator: diffsim.systems.outside.mjcf:Mjcf
      options: {model: pendulum.xml, channels: {angle_rad: angle}}    # sensors of the MJCF
      parameters:
        joint.hinge.damping: {value: 0.05, percent: 50}
        body.rod.mass: {value: 0.4, percent: 5}
      hooks: {force: {hinge: {unit: N m, typical: 0.05, speed: 3}}}    # joints of the MJCF

MuJoCo is an optional package: ``pip install mujoco``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.copter.exchange.mjcf_text import whole_scene
from diffsim.core.check import did_you_mean
from diffsim.data.study import Run
from diffsim.systems.outside.forces import PlaceForces

Array = NDArray[np.float64]
_ENTRY = re.compile(r"(.+)\[(\d+)\]")
_JOINT = {
    "damping": "dof_damping",
    "armature": "dof_armature",
    "frictionloss": "dof_frictionloss",
}


class Mjcf:
    """A MuJoCo model under recorded commands.

    Parameters by path: ``body.NAME.mass`` (its inertia grows alike), ``joint.NAME.damping``,
    ``.armature``, ``.frictionloss``, ``.stiffness``, ``.start`` and ``.start_rate``;
    ``actuator.NAME.gain``; ``gravity`` (downwards), ``density`` and ``viscosity`` of the medium.

    Args:
        model: File of the model, whose files stay in its folder, or its text, which names none.
        channels: Sensor of the MJCF for each channel, "tip[0]" for one entry of a vector; None:
            sensors are named as channels are.
        commands: Actuator of the MJCF for each command; None: actuators are named as commands are,
            and a single actuator takes a single command.
        held: Commands are held from sample to sample; else straight lines join the samples.
    """

    def __init__(
        self,
        model: str,
        channels: Mapping[str, str] | None = None,
        commands: Mapping[str, str] | None = None,
        held: bool = False,
    ):
        import mujoco

        self.mujoco = mujoco
        text, files = whole_scene(model)
        self.model: Any = mujoco.MjModel.from_xml_string(text, files)
        self.plain: Any = mujoco.MjModel.from_xml_string(text, files)
        self.channels, self.commands, self.held = channels, commands, held

    def predict(
        self,
        parameters: Mapping[str, float],
        run: Run,
        force: PlaceForces | None = None,
        time_step: float = 1.0,
    ) -> Array:
        """Sensors at the samples.

        Args:
            parameters: Values by path.
            run: Run with commands and times.
            force: Forces at joints, by their names.
            time_step: Factor on the model's own time step.
        """
        self._reset_numbers()
        data = self.mujoco.MjData(self.model)
        starts = []
        for path, value in parameters.items():
            if self._set_number(path, value) == "start":
                starts.append((path, value))
        self.mujoco.mj_setConst(self.model, data)
        self.mujoco.mj_resetData(self.model, data)
        for path, value in starts:
            _, name, what = path.split(".")
            if what == "start":
                data.qpos[self.model.joint(name).qposadr[0]] = value
            else:
                data.qvel[self.model.joint(name).dofadr[0]] = value
        if force is None or not force.acts:
            return self._step_model(data, run, time_step)
        # called at every stage of an integrator, so that forces are as exact as the step
        before = self.mujoco.get_mjcb_passive()
        self.mujoco.set_mjcb_passive(self._push_joints(force))
        try:
            return self._step_model(data, run, time_step)
        finally:
            self.mujoco.set_mjcb_passive(before)

    def _step_model(self, data: Any, run: Run, time_step: float) -> Array:
        model, mj_step = self.model, self.mujoco.mj_step
        controls = self._list_controls(run)
        readers = self._find_readers(run)
        data.time = float(run.time_s[0])
        longest = float(self.plain.opt.timestep) * time_step
        rows = [self._read_sensors(data, readers, controls[0])]
        for k in range(len(run.time_s) - 1):
            gap = float(run.time_s[k + 1] - run.time_s[k])
            count = max(int(np.ceil(gap / longest - 1e-6)), 1)
            model.opt.timestep = gap / count
            rise = 0.0 if self.held else (controls[k + 1] - controls[k]) / count
            for s in range(count):
                data.ctrl[:] = controls[k] + (s + 0.5) * rise
                mj_step(model, data)
            rows.append(self._read_sensors(data, readers, controls[k + 1]))
        return np.array(rows)

    def _read_sensors(self, data: Any, entries: list[int], control: Array) -> Array:
        data.ctrl[:] = control
        self.mujoco.mj_forward(self.model, data)
        return np.array(data.sensordata[entries])

    def _find_readers(self, run: Run) -> list[int]:
        """Entry of ``sensordata`` for each channel."""
        width = run.measured.shape[1]
        if self.channels is None:
            if self.model.nsensordata != width:
                raise ValueError(
                    f"the MJCF has {self.model.nsensordata} sensor values for {width} channels; "
                    "state options.channels: {CHANNEL: SENSOR}"
                )
            return list(range(width))
        out = []
        for name in self.channels.values():
            entry = _ENTRY.fullmatch(name)
            sensor = self._find_index("sensor", entry[1] if entry else name, "options.channels")
            out.append(int(self.model.sensor_adr[sensor]) + (int(entry[2]) if entry else 0))
        return out

    def _list_controls(self, run: Run) -> Array:
        """(num_samples, num_actuators) in the order of the actuators."""
        out = np.zeros((len(run.time_s), self.model.nu))
        given = self.commands
        if given is None and len(run.command) == 1 and self.model.nu == 1:
            return np.asarray(next(iter(run.command.values())), dtype=np.float64)[:, None]
        for command in run.command:
            name = command if given is None else given.get(command)
            if name is not None:
                out[:, self._find_index("actuator", name, "options.commands")] = run.command[
                    command
                ]
        return out

    def _push_joints(self, force: PlaceForces) -> Callable[[Any, Any], None]:
        """What MuJoCo calls for passive forces: the forces at the joints that are the places."""
        joints = [self._find_index("joint", name, "hooks.force") for name in force.places]
        rates = [int(self.model.jnt_dofadr[j]) for j in joints]
        places = [int(self.model.jnt_qposadr[j]) for j in joints]

        def push(model: Any, data: Any) -> None:
            data.qfrc_passive[rates] += force(data.time, data.qpos[places], data.qvel[rates])

        return push

    def _reset_numbers(self) -> None:
        """Numbers that parameters may have changed, as the file has them."""
        for name in ("body_mass", "body_inertia", *_JOINT.values(), "jnt_stiffness"):
            getattr(self.model, name)[:] = getattr(self.plain, name)
        for name in ("actuator_gainprm", "actuator_biasprm"):
            getattr(self.model, name)[:] = getattr(self.plain, name)
        for name in ("density", "viscosity"):
            setattr(self.model.opt, name, getattr(self.plain.opt, name))
        self.model.opt.gravity[:] = self.plain.opt.gravity

    def _set_number(self, path: str, value: float) -> str:
        """Set one number; "start" where it is a start value."""
        m, (kind, *rest) = self.model, path.split(".")
        if kind == "gravity" and not rest:
            m.opt.gravity[:] = (0.0, 0.0, -value)
        elif kind in ("density", "viscosity") and not rest:
            setattr(m.opt, kind, value)
        elif kind == "body" and len(rest) == 2 and rest[1] == "mass":
            i = self._find_index("body", rest[0], "parameters")
            m.body_inertia[i] = self.plain.body_inertia[i] * value / self.plain.body_mass[i]
            m.body_mass[i] = value
        elif kind == "joint" and len(rest) == 2:
            return self._set_joint(self._find_index("joint", rest[0], "parameters"), rest[1], value)
        elif kind == "actuator" and len(rest) == 2 and rest[1] == "gain":
            m.actuator_gainprm[self._find_index("actuator", rest[0], "parameters"), 0] = value
        else:
            raise ValueError(
                f"parameter {path!r} is none of body.NAME.mass, joint.NAME.damping (armature, "
                "frictionloss, stiffness, start, start_rate), actuator.NAME.gain, gravity, "
                "density, viscosity"
            )
        return "model"

    def _set_joint(self, joint: int, what: str, value: float) -> str:
        m = self.model
        if what in ("start", "start_rate"):
            return "start"
        if what == "stiffness":
            m.jnt_stiffness[joint] = value
        elif what in _JOINT:
            getattr(m, _JOINT[what])[int(m.jnt_dofadr[joint])] = value
        else:
            known = [*_JOINT, "stiffness", "start", "start_rate"]
            raise ValueError(f"a joint has no {what!r}{did_you_mean(what, known)}")
        return "model"

    def _find_index(self, kind: str, name: str, where: str) -> int:
        objects: Callable[[int], Any] = getattr(self.model, kind)
        count = {"body": "nbody", "joint": "njnt", "sensor": "nsensor", "actuator": "nu"}[kind]
        known = [objects(i).name for i in range(getattr(self.model, count))]
        if name not in known:
            raise ValueError(
                f"{where}: the MJCF has no {kind} {name!r}{did_you_mean(name, known)}; "
                f"it has {', '.join(known)}"
            )
        return known.index(name)
