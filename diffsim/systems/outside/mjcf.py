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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from diffsim.copter.exchange.mjcf_text import whole_scene
from diffsim.core.arrays import Array, Mask
from diffsim.data.study import Run
from diffsim.systems.outside.forces import PlaceForces
from diffsim.systems.outside.mjcf_laws import hold_of, path_of_law, take_own
from diffsim.systems.outside.mjcf_numbers import Numbers, several_axes
from diffsim.systems.outside.mjcf_payloads import carriers_of
from diffsim.systems.outside.mjcf_steps import Steps
from diffsim.systems.outside.source import Call

_ENTRY = re.compile(r"(.+)\[(\d+)\]")
#: What a channel may show of a joint without a sensor, by the MJCF's own kind of sensor
JOINT_SENSORS = {"position": "jointpos", "velocity": "jointvel"}
#: The same of a joint that moves freely, by its entries: x, y, z and w, x, y, z of its body
FREE_SENSORS = {"position": "framepos", "orientation": "framequat"}
JOINT = re.compile(r"joint\.(.+)\.(position|velocity|orientation)(?:\[(\d)\])?")
MAX_BYTES = 100_000_000  # of the states, and of the models, that are simulated side by side
MAX_MODELS = 64
# of a servo's gain times its largest goal, that it pushes with: the goal is not what is left to it;
# of three drawn servos whose limit was missing the share was 1/30 to 1/80
OF_GOAL = 0.1
OF_CALL, OF_FORCE = 1.0, 1.5  # weighted steps of calling Python at a stage, and of each force there


@dataclass(frozen=True, eq=False)
class _Job:
    """A call of the simulator, ready to be stepped.

    Attributes:
        model: Model with the numbers of the call.
        steps: Steps over the run.
        start: State at the first sample.
        controls: Commands over the steps, (num_steps, num_controls).
        at_samples: Commands at the samples, where sensors depend on them; None: they do not.
        readers: Entry of ``sensordata`` for each channel.
        force: Forces that Python adds; None: none.
        pushes: The same over the steps, of each degree of freedom, (num_steps, nv), where they are
            known before; None: they are not.
        can_roll: Whether MuJoCo's own loop does it.
    """

    model: Any
    steps: Steps
    start: Array
    controls: Array
    at_samples: Array | None
    readers: Sequence[int]
    force: PlaceForces | None
    pushes: Array | None
    can_roll: bool


class DivergedError(ArithmeticError):
    """A simulation left all bounds; the message has the joint, the time and the value."""


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
            if joints := _joints_without_sensor(mujoco, self.plain, (channels or {}).values()):
                text = _with_sensors(text, joints)
                self.plain = mujoco.MjModel.from_xml_string(text, files)
        self._text, self._files = text, files
        self.plain.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if not _can_touch(self.plain):  # pairs are looked for at each step: a sixth of a leg's
            self.plain.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        ratios = _list_ratios(mujoco, text, files) if "dampratio" in text else ()
        self.numbers = Numbers(mujoco, self.plain, ratios)
        self.channels, self.commands, self.held = channels, commands, held
        self.carriers = carriers_of(mujoco, self.plain)
        #: What may set the strength of each actuator
        self.drives = [
            {f"actuator.{self.plain.actuator(i).name}.{gain}" for gain in ("kp", "gain")}
            for i in range(self.plain.nu)
        ]
        is_rk4 = int(self.plain.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)
        self._stages = 4 if is_rk4 else 1  # of a step
        self._models: list[Any] = []
        self._rollouts: dict[int, tuple[Any, list[Any]]] = {}  # with a state for each thread
        self._make_rollout = _find_rollout()

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
            run: Run that is simulated.
            force: Forces at joints; those that MuJoCo lacks are asked for at each step.
        """
        _, asked = self._take_own({}, force)
        num_forces = 0 if asked is None or self._is_known(asked) else len(asked.acting)
        of_forces = OF_CALL + OF_FORCE * num_forces if num_forces else 0.0
        of_step = (1.0 + 0.7 * self.plain.nv + of_forces) * self._stages
        return Steps.count(run.time_s, float(self.plain.opt.timestep)) * of_step

    def fits_hold(self, place: str, parameters: Collection[str]) -> bool:
        """Whether it is open how soon friction takes hold that a cause brings to a joint.

        Args:
            place: Name of the joint.
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
            i = 0 if self._is_single(len(reaches)) else self._find_actuator(command)
            if i is None or not plain.actuator(i).name:
                continue
            most = float(np.abs(plain.actuator_gainprm[i, 0])) * reach
            most *= OF_GOAL if self.numbers.is_servo(i) else 1.0
            if plain.actuator_forcelimited[i]:
                most = min(most, float(np.abs(plain.actuator_forcerange[i]).max()))
            if most > 0.0:
                joint = int(plain.actuator_trnid[i, 0]) if self._is_at_joint(i) else -1
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
        ready: list[tuple[int, _Job]] = []
        for k, (call, steps) in enumerate(group):
            try:
                job = self._prepare(call, steps, len(ready))
                if job.can_roll:
                    ready.append((k, job))
                else:
                    out[k] = self._step_through(job)
            except (ValueError, ArithmeticError, self.mujoco.FatalError) as error:
                out[k] = error
        rolled = self._roll([job for _, job in ready], threads) if ready else []
        for (k, _), found in zip(ready, rolled, strict=True):
            out[k] = found
        return [found for found in out if found is not None]

    def _prepare(self, call: Call, steps: Steps, place: int) -> _Job:
        """A call with a model of its own, its start and its commands."""
        while len(self._models) <= place:
            self._models.append(copy.copy(self.plain))
        model, run = self._models[place], call.run
        parameters, force = self._take_own(call.parameters, call.force)
        setting = self.numbers.put(model, parameters)
        values = self._list_controls(run)
        readers = self._find_readers(run)
        delays = {int(self._ctrl_of(i)): late for i, late in setting.delays.items()}
        for command, late in call.delays.items():
            if (control := self._control_of(command, run)) is not None:
                delays[control] = delays.get(control, 0.0) + late
        known = ((self._control_of(command, run), value) for command, value in call.before.items())
        before = {control: value for control, value in known if control is not None}
        is_exact = not self.held and self._reads_forces(readers)
        acting = force if force is not None and force.acts else None
        pushes = None if acting is None else self._pushes(acting, steps.starts)
        return _Job(
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
            and self._make_rollout is not None,
        )

    def _roll(self, jobs: Sequence[_Job], threads: int) -> list[Array | Exception]:
        """MuJoCo's own loop over the steps, on its own threads."""
        count = threads if threads > 1 and len(jobs) > 1 else 0
        if count not in self._rollouts:
            states = [self.mujoco.MjData(self.plain) for _ in range(max(count, 1))]
            self._rollouts[count] = self._make_rollout(nthread=count), states
        rollout, at_threads = self._rollouts[count]
        for data in at_threads:  # nothing of the last calls, such as a warning, is kept
            self.mujoco.mj_resetData(self.plain, data)
        for job in jobs:
            job.model.opt.timestep = job.steps.lengths[0]
        of_state = self.mujoco.mjtState
        given, spec = np.stack([job.controls for job in jobs]), int(of_state.mjSTATE_CTRL)
        if any(job.pushes is not None for job in jobs):
            spec += of_state.mjSTATE_QFRC_APPLIED
            none = np.zeros((given.shape[1], self.plain.nv))
            pushes = [none if job.pushes is None else job.pushes for job in jobs]
            given = np.concatenate([given, np.stack(pushes)], axis=2)
        states, sensors = rollout.rollout(
            [job.model for job in jobs],
            at_threads,
            np.stack([job.start for job in jobs]),
            given,
            control_spec=spec,
        )
        out: list[Array | Exception] = []
        for job, state, sensor in zip(jobs, states, sensors, strict=True):
            if state[-1, 0] < job.steps.starts[-1] - 0.5 * job.steps.lengths[-1]:  # it stopped
                out.append(self._explain_divergence(job))
            else:
                out.append(np.array(sensor[job.steps.samples][:, job.readers]))
        return out

    def _step_through(self, job: _Job, watch: bool = False) -> Array:
        """One step after the other, for what MuJoCo's own loop does not do."""
        force = job.force
        if force is None or not force.acts:
            return self._loop(job, watch)
        # called at every stage of an integrator, so that forces are as exact as the step
        before = self.mujoco.get_mjcb_passive()
        self.mujoco.set_mjcb_passive(self._push_joints(force))
        try:
            return self._loop(job, watch)
        finally:
            self.mujoco.set_mjcb_passive(before)

    def _loop(self, job: _Job, watch: bool = False) -> Array:
        model, mj_step = job.model, self.mujoco.mj_step
        data = self.numbers.begin(model, job.start)
        rows, following = [], 0
        is_read = np.zeros(len(job.controls), dtype=bool)
        is_read[job.steps.samples] = True
        for first, end in _alike(job, is_read, alone=watch):
            model.opt.timestep = job.steps.lengths[first]
            if is_read[first] and job.at_samples is not None:
                data.ctrl[:] = job.at_samples[following]
                self.mujoco.mj_forward(model, data)
                rows.append(np.array(data.sensordata[job.readers]))
            data.ctrl[:] = job.controls[first]
            mj_step(model, data, nstep=end - first)
            if is_read[end - 1]:
                following += 1
                if job.at_samples is None:  # sensors of the state that the step began with
                    rows.append(np.array(data.sensordata[job.readers]))
            if (watch or is_read[end - 1]) and (said := self._say_divergence(model, data)):
                if not watch:
                    self._loop(job, watch=True)  # raises at the step itself
                raise DivergedError(said)
        return np.array(rows)

    def _explain_divergence(self, job: _Job) -> DivergedError:
        try:
            self._step_through(job, watch=True)
        except DivergedError as error:
            return error
        return DivergedError("the simulation stopped before the end of the run")

    def _say_divergence(self, model: Any, data: Any) -> str | None:
        """Joint, time and value of what is beyond all bounds; None: nothing is."""
        kinds = self.mujoco.mjtWarning
        for kind, what, per in (
            (kinds.mjWARN_BADQACC, "acceleration", "/s^2"),
            (kinds.mjWARN_BADQVEL, "speed", "/s"),
            (kinds.mjWARN_BADQPOS, "position", ""),
        ):
            found = data.warning[int(kind)]
            if not found.number:
                continue
            i = int(found.lastinfo)
            of_position = kind == kinds.mjWARN_BADQPOS
            if of_position:
                joint = int(np.searchsorted(model.jnt_qposadr, i, side="right")) - 1
            else:
                joint = int(model.dof_jntid[i])
            values = {"acceleration": data.qacc, "speed": data.qvel, "position": data.qpos}[what]
            first = (model.jnt_qposadr if of_position else model.jnt_dofadr)[joint]
            type_of = int(model.jnt_type[joint])
            unit = "m" if type_of == 2 or (type_of == 0 and i - first < 3) else "rad"
            name = model.joint(joint).name or f"number {joint}"
            return (
                f"joint {name!r} diverged at {data.time:.4g} s: its {what} is {values[i]:.3g} "
                f"{unit}{per}; give the MJCF a shorter timestep, or bound the parameters"
            )
        return None

    def _reads_forces(self, readers: Sequence[int]) -> bool:
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

    def _ctrl_of(self, actuator: int) -> int:
        """Index of the command of an actuator, of the first where it has several."""
        firsts = getattr(self.plain, "actuator_ctrladr", None)
        return actuator if firsts is None else int(firsts[actuator])

    def _find_readers(self, run: Run) -> list[int]:
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

    def _list_controls(self, run: Run) -> Array:
        """(num_samples, num_controls) in the order of MuJoCo's controls."""
        out = np.zeros((len(run.time_s), self.plain.nu))
        for command, values in run.command.items():
            if (control := self._control_of(command, run)) is not None:
                out[:, control] = values
        return out

    def _control_of(self, command: str, run: Run) -> int | None:
        """Index of the control that a command of a run drives; None: it drives none."""
        if self._is_single(len(run.command)):
            return 0
        actuator = self._find_actuator(command)
        return None if actuator is None else int(self._ctrl_of(actuator))

    def _is_at_joint(self, actuator: int) -> bool:
        return int(self.plain.actuator_trntype[actuator]) == int(self.mujoco.mjtTrn.mjTRN_JOINT)

    def _is_single(self, num_commands: int) -> bool:
        """Whether the one command drives the one actuator, whatever their names."""
        return bool(self.commands is None and num_commands == 1 and self.plain.nu == 1)

    def _find_actuator(self, command: str) -> int | None:
        """Index of the actuator that a command drives; None: it drives none."""
        name = command if self.commands is None else self.commands.get(command)
        return None if name is None else self.numbers.find("actuator", name, "options.commands")

    def _is_known(self, force: PlaceForces) -> bool:
        """Whether forces over time alone are all there is, and an integrator that asks for them
        once a step: MuJoCo's own loop then holds them."""
        return force.is_over_time and self._stages == 1

    def _axis_of(self, place: str) -> tuple[int, int]:
        """Index of the position and of the velocity of a joint that turns or slides about one axis.

        Raises:
            ValueError: there is no such joint, or it has several axes.
        """
        joint = self.numbers.find("joint", place, "hooks.force")
        if (count := self.numbers.num_axes(joint)) > 1:
            raise ValueError(several_axes(place, count))
        return int(self.plain.jnt_qposadr[joint]), int(self.plain.jnt_dofadr[joint])

    def _pushes(self, force: PlaceForces, times: Array) -> Array | None:
        """Forces of each degree of freedom over steps, (num_steps, nv); None: not known before."""
        if not self._is_known(force):
            return None
        out = np.zeros((len(times), self.plain.nv))
        for place, values in force.over(times).items():
            out[:, self._axis_of(force.places[place])[1]] += values
        return out

    def _push_joints(self, force: PlaceForces) -> Callable[[Any, Any], None]:
        """What MuJoCo calls for passive forces: the forces at the joints that are the places."""
        acting = [(*self._axis_of(force.places[i]), at) for i, at in force.acting]

        def push(model: Any, data: Any) -> None:  # thousands of times a run: plain numbers alone
            time, positions, rates, passive = data.time, data.qpos, data.qvel, data.qfrc_passive
            for place, rate, at in acting:
                passive[rate] += at(time, positions.item(place), rates.item(rate))

        return push


def _alike(job: _Job, is_read: Mask, *, alone: bool) -> Iterator[tuple[int, int]]:
    """First and end of steps of one length under one command, after which a sample may be read.

    Args:
        job: What is stepped.
        is_read: Whether sensors are read at each step, (num_steps,).
        alone: Each step by itself.
    """
    ends = np.full(len(is_read), alone)
    ends |= is_read
    ends[:-1] |= is_read[1:]
    ends[:-1] |= (job.controls[1:] != job.controls[:-1]).any(axis=1)
    ends[:-1] |= np.diff(job.steps.lengths) != 0.0
    ends[-1:] = True
    first = 0
    for end in (np.flatnonzero(ends) + 1).tolist():
        yield first, end
        first = end


def _joints_without_sensor(
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


def _with_sensors(text: str, sensors: Iterable[tuple[str, dict[str, str]]]) -> str:
    """The text of a model with more sensors, by their kinds and attributes."""
    root = ElementTree.fromstring(text)
    section = ElementTree.SubElement(root, "sensor")
    for kind, attributes in sensors:
        ElementTree.SubElement(section, kind, attributes)
    return ElementTree.tostring(root, encoding="unicode")


def _can_touch(model: Any) -> bool:
    """Whether shapes of two bodies may touch, as far as their masks say, or a flex may."""
    both = model.geom_contype[:, None] & model.geom_conaffinity[None, :]
    apart = model.geom_bodyid[:, None] != model.geom_bodyid[None, :]
    return bool(both[apart].any() or model.npair or getattr(model, "nflex", 0))


def _ignore(_: str) -> None:
    """What MuJoCo warns of is looked at after each run."""


def _find_rollout() -> Any:
    """MuJoCo's own loop over many simulations; None: the version has none yet."""
    try:
        from mujoco import rollout
    except ImportError:
        return None
    return getattr(rollout, "Rollout", None)


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
    """What a file means otherwise under other versions of MuJoCo, a sentence each.

    Args:
        text: The file with what it includes.
        version: Version that is installed.
    """
    own = tuple(int(n) for n in re.findall(r"\d+", version)[:2])
    out = []
    for since, word, meaning in MEANS_OTHERWISE:
        if re.search(rf"\b{word}\b", text):
            number = ".".join(map(str, since))
            side = "this is so here" if own >= since else "this is not so here yet"
            out.append(f"`{word}`: since MuJoCo {number} {meaning}; {side} ({version})")
    return out
