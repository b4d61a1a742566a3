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

import copy
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from diffsim.copter.exchange.mjcf_text import whole_scene
from diffsim.core.arrays import Array
from diffsim.data.study import Run
from diffsim.systems.outside.forces import PlaceForces
from diffsim.systems.outside.mjcf_laws import hold_of, path_of_law, take_own
from diffsim.systems.outside.mjcf_numbers import Numbers
from diffsim.systems.outside.mjcf_payloads import carriers_of
from diffsim.systems.outside.mjcf_pushes import Pushes
from diffsim.systems.outside.mjcf_runs import Job, Stepper
from diffsim.systems.outside.mjcf_steps import Steps
from diffsim.systems.outside.mjcf_wiring import Wiring, joints_without_sensor, with_sensors
from diffsim.systems.outside.source import Call

MAX_BYTES = 100_000_000  # of the states, and of the models, that are simulated side by side
MAX_MODELS = 64
# of a servo's gain times its largest goal, that it pushes with: the goal is not what is left to it;
# of three drawn servos whose limit was missing the share was 1/30 to 1/80
OF_GOAL = 0.1
OF_CALL, OF_FORCE = 1.0, 1.5  # weighted steps of calling Python at a stage, and of each force there


class Mjcf:
    """A MuJoCo model under recorded commands.

    Parameters by path are listed in ``mjcf_numbers``.

    Args:
        model: File of the model, or its text, which names no files.
        channels: Sensor of the MJCF for each channel, "tip[0]" for one entry of a vector, or
            "joint.elbow.position" or ".velocity" of a joint without a sensor, of a free one
            ".position[0]" and ".orientation[0]"; None: all sensors, in their order.
        commands: Actuator of the MJCF for each command; None: actuators are named as commands are,
            and a single actuator takes a single command.
        held: Commands are held from sample to sample; else straight lines join the samples.
        folder: Folder that no file of the model leaves; None: that of the model.
    """

    def __init__(
        self,
        model: str,
        channels: Mapping[str, str] | None = None,
        commands: Mapping[str, str] | None = None,
        held: bool = False,
        folder: str | None = None,
    ):
        import mujoco

        self.mujoco = mujoco
        text, files = whole_scene(model, None if folder is None else Path(folder))
        with self._without_log():
            self.plain: Any = mujoco.MjModel.from_xml_string(text, files)
            if joints := joints_without_sensor(mujoco, self.plain, (channels or {}).values()):
                text = with_sensors(text, joints)
                self.plain = mujoco.MjModel.from_xml_string(text, files)
        self._text, self._files = text, files
        self.plain.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if not _can_touch(self.plain):  # pairs are looked for at each step: a sixth of a leg's
            self.plain.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        ratios = _list_ratios(mujoco, text, files) if "dampratio" in text else ()
        self.numbers = Numbers(mujoco, self.plain, ratios)
        self.held = held
        self.wiring = Wiring(mujoco, self.plain, self.numbers, channels, commands)
        self.carriers = carriers_of(mujoco, self.plain)
        #: What may set the strength of each actuator
        self.drives = [
            {f"actuator.{self.plain.actuator(i).name}.{gain}" for gain in ("kp", "gain")}
            for i in range(self.plain.nu)
        ]
        is_rk4 = int(self.plain.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)
        self._pushes = Pushes(self.plain, self.numbers, stages=4 if is_rk4 else 1)
        self._stepper = Stepper(mujoco, self.plain, self.numbers, self._pushes)
        self._models: list[Any] = []

    def predict(
        self,
        parameters: Mapping[str, float],
        run: Run,
        force: PlaceForces | None = None,
        time_step: float = 1.0,
        delays: Mapping[str, float] | None = None,
        before: Mapping[str, float] | None = None,
    ) -> Array:
        """Sensors at the samples.

        Args:
            parameters: Values by path.
            run: Run with commands and times.
            force: Forces at joints, by their names.
            time_step: Factor on the model's own time step.
            delays: Time by which a command is heard late, by name [s].
            before: Values of such commands before the run; without a word their first ones.

        Raises:
            DivergedError: the simulation left all bounds.
        """
        (found,) = self.predict_many(
            [Call(parameters, run, force, time_step, delays or {}, before or {})]
        )
        if isinstance(found, Exception):
            raise found
        return found

    def predict_many(self, calls: Sequence[Call], threads: int = 1) -> list[Array | Exception]:
        """Sensors at the samples of each call, or what went wrong with it.

        Args:
            calls: Arguments of ``predict``.
            threads: MuJoCo's own threads that simulate side by side.
        """
        out: list[Array | Exception] = []
        with self._without_log():
            for group in self._groups_of(calls):
                out += self._simulate_group(group, threads)
        return out

    def count_steps(self, run: Run, force: PlaceForces | None = None) -> float:
        """Weighted steps of a run: about a microsecond each (``benchmarks.step_costs``).

        Args:
            force: Forces at joints; those that MuJoCo lacks are asked for at each step.
        """
        _, asked = self._take_own({}, force)
        num_forces = 0 if asked is None or self._pushes.is_known(asked) else len(asked.acting)
        of_forces = OF_CALL + OF_FORCE * num_forces if num_forces else 0.0
        of_step = (1.0 + 0.7 * self.plain.nv + of_forces) * self._pushes.stages
        return Steps.count(run.time_s, float(self.plain.opt.timestep)) * of_step

    def fits_hold(self, place: str, parameters: Collection[str]) -> bool:
        """Whether it is open how soon friction takes hold that a cause brings to a joint.

        Args:
            parameters: Paths that a study states.
        """
        path = path_of_law(self.mujoco, self.numbers, "dry_friction", place)
        return path is not None and hold_of(self.numbers, parameters, path) is not None

    def strengths(self, reaches: Mapping[str, float]) -> dict[str, tuple[float, str]]:
        """What each commanded actuator with a name may push with, and its unit, by its name: no
        more than its gain times the largest command, of a servo a share of it, or than the file's
        limit.

        Args:
            reaches: Largest magnitude of each command, by its name.
        """
        out, plain = dict[str, tuple[float, str]](), self.plain
        hinge = int(self.mujoco.mjtJoint.mjJNT_HINGE)
        for command, reach in reaches.items():
            i = 0 if self.wiring.is_single(len(reaches)) else self.wiring.find_actuator(command)
            if i is None or not plain.actuator(i).name:
                continue
            most = float(np.abs(plain.actuator_gainprm[i, 0])) * reach
            most *= OF_GOAL if self.numbers.is_servo(i) else 1.0
            if plain.actuator_forcelimited[i]:
                most = min(most, float(np.abs(plain.actuator_forcerange[i]).max()))
            if most > 0.0:
                joint = int(plain.actuator_trnid[i, 0]) if self.wiring.is_at_joint(i) else -1
                is_turn = joint >= 0 and int(plain.jnt_type[joint]) == hinge
                out[plain.actuator(i).name] = most, "N m" if is_turn else "N"
        return out

    def value_of(self, path: str) -> float:
        """What the file states for a parameter of a joint, such as "joint.hinge.damping".

        Raises:
            ValueError: there is no such parameter.
        """
        return self.numbers.value_of(path)

    def restated(self, parameters: Mapping[str, float]) -> tuple[str, Mapping[str, bytes]]:
        """The MJCF with numbers of its own, as text, and the files that it names.

        Args:
            parameters: Values by path; starts are no part of a model, so they are left out.
        """
        with self._without_log(), TemporaryDirectory() as folder:
            model = self.mujoco.MjModel.from_xml_string(self._text, self._files)
            setting = self.numbers.put(model, parameters)
            path = Path(folder) / "model.xml"
            self.mujoco.mj_saveLastXML(str(path), model)
            root = ElementTree.parse(path).getroot()
        actuators = [a for section in root.findall("actuator") for a in section]
        for i, late in setting.delays.items():
            number = int(np.ceil(late / float(model.opt.timestep))) + 1
            actuators[i].attrib |= {"delay": repr(late), "nsample": str(number)}
        return ElementTree.tostring(root, encoding="unicode"), self._files

    @contextmanager
    def _without_log(self) -> Iterator[None]:
        """MuJoCo's warnings are answered by errors here: it writes no file into user's folders."""
        before = self.mujoco.get_mju_user_warning()
        self.mujoco.set_mju_user_warning(_ignore)
        try:
            yield
        finally:
            self.mujoco.set_mju_user_warning(before)

    def _take_own(
        self, parameters: Mapping[str, float], force: PlaceForces | None
    ) -> tuple[dict[str, float], PlaceForces | None]:
        """Parameters with the forces that MuJoCo has itself, and the forces that are left."""
        return take_own(self.mujoco, self.numbers, parameters, force)

    def _groups_of(self, calls: Sequence[Call]) -> Iterator[list[tuple[Call, Steps]]]:
        """Calls that are simulated side by side: as many steps each, in bounded memory."""
        longest = float(self.plain.opt.timestep)
        of_model = max(float(getattr(self.plain, "nbuffer", 0)), 1.0)
        most = max(1, min(MAX_MODELS, int(MAX_BYTES / of_model)))
        of_step = 8.0 * (self.plain.nq + self.plain.nv + self.plain.nsensordata + self.plain.nu + 1)
        group: list[tuple[Call, Steps]] = []
        for call in calls:
            steps = Steps.of(call.run.time_s, longest * call.time_step)
            number = len(steps.starts)
            is_alike = not group or len(group[0][1].starts) == number
            if not is_alike or len(group) >= min(most, 1 + MAX_BYTES / (of_step * number)):
                yield group
                group = []
            group.append((call, steps))
        if group:
            yield group

    def _simulate_group(
        self, group: Sequence[tuple[Call, Steps]], threads: int
    ) -> list[Array | Exception]:
        """Sensors of each call; what can be left to MuJoCo's own loop is."""
        out: list[Array | Exception | None] = [None] * len(group)
        ready: list[tuple[int, Job]] = []
        for k, (call, steps) in enumerate(group):
            try:
                job = self._prepare(call, steps, len(ready))
                if job.can_roll:
                    ready.append((k, job))
                else:
                    out[k] = self._stepper.step_through(job)
            except (ValueError, ArithmeticError, self.mujoco.FatalError) as error:
                out[k] = error
        rolled = self._stepper.roll([job for _, job in ready], threads) if ready else []
        for (k, _), found in zip(ready, rolled, strict=True):
            out[k] = found
        return [found for found in out if found is not None]

    def _prepare(self, call: Call, steps: Steps, place: int) -> Job:
        """A call with a model of its own, its start and its commands."""
        while len(self._models) <= place:
            self._models.append(copy.copy(self.plain))
        model, run = self._models[place], call.run
        parameters, force = self._take_own(call.parameters, call.force)
        setting = self.numbers.put(model, parameters)
        values = self.wiring.list_controls(run)
        readers = self.wiring.find_readers(run)
        delays = {self.wiring.control_of_actuator(i): late for i, late in setting.delays.items()}
        for command, late in call.delays.items():
            if (control := self.wiring.control_of(command, run)) is not None:
                delays[control] = delays.get(control, 0.0) + late
        known = (
            (self.wiring.control_of(command, run), value) for command, value in call.before.items()
        )
        before = {control: value for control, value in known if control is not None}
        is_exact = not self.held and self.wiring.reads_forces(readers)
        acting = force if force is not None and force.acts else None
        pushes = None if acting is None else self._pushes.over(acting, steps.starts)
        return Job(
            model=model,
            steps=steps,
            start=self.numbers.start_state(model, setting, float(steps.starts[0])),
            controls=steps.controls(values, self.held, delays, before),
            at_samples=steps.at_samples(values, self.held, delays, before) if is_exact else None,
            readers=readers,
            force=force,
            pushes=pushes,
            can_roll=steps.is_even
            and not is_exact
            and (pushes is not None or acting is None)
            and self._stepper.has_loop,
        )


def _can_touch(model: Any) -> bool:
    """Whether shapes of two bodies may touch, as far as their masks say, or a flex may."""
    both = model.geom_contype[:, None] & model.geom_conaffinity[None, :]
    apart = model.geom_bodyid[:, None] != model.geom_bodyid[None, :]
    return bool(both[apart].any() or model.npair or getattr(model, "nflex", 0))


def _ignore(_: str) -> None:
    """What MuJoCo warns of is looked at after each run."""


def _list_ratios(mujoco: Any, text: str, files: Mapping[str, bytes]) -> tuple[int, ...]:
    """Actuators whose kv the file states as a damping ratio."""
    spec = mujoco.MjSpec.from_string(text, assets=dict(files))
    return tuple(i for i, a in enumerate(spec.actuators) if a.biasprm[2] > 0.0)


#: What a word of a file means otherwise since a version: version, word, what
MEANS_OTHERWISE = (
    ((3, 15), "dampratio", "the damping follows from the inertia that the actuator moves with all "
     "joints free; before it was that of its own joint with the others held"),
    ((3, 17), "young", "of a flex of one dimension bends it; before it was ignored"),
    ((3, 12), "dcmotor", "has gains in torque, and `input` names its commands; before they were "
     "in volt"),
)  # fmt: skip


def version_notes(text: str, version: str) -> list[str]:
    """What a file means otherwise under other versions of MuJoCo, a sentence each."""
    own = tuple(int(n) for n in re.findall(r"\d+", version)[:2])
    out = []
    for since, word, meaning in MEANS_OTHERWISE:
        if re.search(rf"\b{word}\b", text):
            number = ".".join(map(str, since))
            side = "this is so here" if own >= since else "this is not so here yet"
            out.append(f"`{word}`: since MuJoCo {number} {meaning}; {side} ({version})")
    return out
