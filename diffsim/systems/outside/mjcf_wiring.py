"""Which sensor of a MuJoCo model a channel reads, and which actuator a command drives."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.data.study import Run
from diffsim.systems.outside.mjcf_numbers import Numbers

_ENTRY = re.compile(r"(.+)\[(\d+)\]")
#: What a channel may show of a joint without a sensor, by the MJCF's own kind of sensor
JOINT_SENSORS = {"position": "jointpos", "velocity": "jointvel"}
#: The same of a joint that moves freely, by its entries: x, y, z and w, x, y, z of its body
FREE_SENSORS = {"position": "framepos", "orientation": "framequat"}
JOINT = re.compile(r"joint\.(.+)\.(position|velocity|orientation)(?:\[(\d)\])?")


@dataclass(frozen=True, eq=False)
class Wiring:
    """Channels and commands of a study at the sensors and actuators of a model."""

    mujoco: Any  # the package
    plain: Any  # the model
    numbers: Numbers
    channels: Mapping[str, str] | None  # sensor for each channel; None: all, in their order
    commands: Mapping[str, str] | None  # actuator for each command; None: they are named alike

    def reads_forces(self, readers: Sequence[int]) -> bool:
        """Whether a channel shows accelerations or forces, which depend on the command itself."""
        if not hasattr(self.plain, "sensor_needstage"):
            return True
        last = int(self.mujoco.mjtStage.mjSTAGE_ACC)
        first, width = self.plain.sensor_adr, self.plain.sensor_dim
        late = [
            range(int(first[i]), int(first[i]) + int(width[i]))
            for i in range(self.plain.nsensor)
            if int(self.plain.sensor_needstage[i]) == last
        ]
        return any(entry in own for entry in readers for own in late)

    def control_of_actuator(self, actuator: int) -> int:
        """Index of the command of an actuator, of the first where it has several."""
        firsts = getattr(self.plain, "actuator_ctrladr", None)
        return actuator if firsts is None else int(firsts[actuator])

    def find_readers(self, run: Run) -> list[int]:
        """Entry of ``sensordata`` for each channel."""
        width = run.measured.shape[1]
        if self.channels is None:
            if self.plain.nsensordata != width:
                raise ValueError(
                    f"the MJCF has {self.plain.nsensordata} sensor values for {width} channels; "
                    "state options.channels: {CHANNEL: SENSOR}, of a joint without a sensor "
                    "{CHANNEL: joint.NAME.position}"
                )
            return list(range(width))
        out = []
        for name in self.channels.values():
            entry = _ENTRY.fullmatch(name)
            sensor = self.numbers.find("sensor", entry[1] if entry else name, "options.channels")
            if entry and int(entry[2]) >= int(self.plain.sensor_dim[sensor]):
                raise ValueError(f"options.channels: {name!r}: {entry[1]} has no such entry")
            out.append(int(self.plain.sensor_adr[sensor]) + (int(entry[2]) if entry else 0))
        return out

    def list_controls(self, run: Run) -> Array:
        """(num_samples, num_controls) in the order of MuJoCo's controls."""
        out = np.zeros((len(run.time_s), self.plain.nu))
        for command, values in run.command.items():
            if (control := self.control_of(command, run)) is not None:
                out[:, control] = values
        return out

    def control_of(self, command: str, run: Run) -> int | None:
        """Index of the control that a command of a run drives; None: it drives none."""
        if self.is_single(len(run.command)):
            return 0
        actuator = self.find_actuator(command)
        return None if actuator is None else self.control_of_actuator(actuator)

    def is_at_joint(self, actuator: int) -> bool:
        return int(self.plain.actuator_trntype[actuator]) == int(self.mujoco.mjtTrn.mjTRN_JOINT)

    def is_single(self, num_commands: int) -> bool:
        """Whether the one command drives the one actuator, whatever their names."""
        return bool(self.commands is None and num_commands == 1 and self.plain.nu == 1)

    def find_actuator(self, command: str) -> int | None:
        """Index of the actuator that a command drives; None: it drives none."""
        name = command if self.commands is None else self.commands.get(command)
        return None if name is None else self.numbers.find("actuator", name, "options.commands")


def joints_without_sensor(
    mujoco: Any, model: Any, channels: Iterable[str]
) -> list[tuple[str, dict[str, str]]]:
    """Sensors that channels name by a joint, and the file lacks: their kind and attributes.

    Raises:
        ValueError: there is no such joint, or nothing of it is so called.
    """
    numbers, out = Numbers(mujoco, model, ()), dict[str, tuple[str, dict[str, str]]]()
    for channel in dict.fromkeys(channels):
        found = JOINT.fullmatch(channel)
        is_sensor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, channel) >= 0
        if found is None or is_sensor:
            continue
        name, what, entry = found.groups()
        joint = numbers.find("joint", name, "options.channels")
        kind = (JOINT_SENSORS if numbers.num_axes(joint) == 1 else {}).get(what)
        of = {"joint": name}
        if int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE):
            kind = FREE_SENSORS.get(what)
            of = {"objtype": "xbody", "objname": model.body(int(model.jnt_bodyid[joint])).name}
        if kind is None or (entry is None) != ("joint" in of) or not all(of.values()):
            raise ValueError(
                f"options.channels: {channel!r} of a joint with "
                f"{numbers.num_axes(joint)} axes is no reading; of one axis .position and "
                ".velocity are, of a free joint whose body has a name .position[0] to [2] and "
                ".orientation[0] to [3]; for others add a sensor of what was measured to the "
                "MJCF, and name it"
            )
        label = channel.partition("[")[0] if entry else channel
        out[label] = kind, {"name": label, **of}
    return list(out.values())


def with_sensors(text: str, sensors: Iterable[tuple[str, dict[str, str]]]) -> str:
    """The text of a model with more sensors, by their kinds and attributes."""
    root = ElementTree.fromstring(text)
    section = ElementTree.SubElement(root, "sensor")
    for kind, attributes in sensors:
        ElementTree.SubElement(section, kind, attributes)
    return ElementTree.tostring(root, encoding="unicode")
