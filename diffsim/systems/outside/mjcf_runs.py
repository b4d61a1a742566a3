"""Calls of a MuJoCo model, stepped: by MuJoCo's own loop on its threads, or one by one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffsim.core.arrays import Array, Mask
from diffsim.systems.outside.forces import PlaceForces
from diffsim.systems.outside.mjcf_numbers import Numbers
from diffsim.systems.outside.mjcf_pushes import Pushes
from diffsim.systems.outside.mjcf_steps import Steps


@dataclass(frozen=True, eq=False)
class Job:
    """A call of the simulator, ready to be stepped."""

    model: Any  # model with the numbers of the call
    steps: Steps  # steps over the run
    start: Array  # state at the first sample
    controls: Array  # commands over the steps, (num_steps, num_controls)
    # commands at the samples, where sensors depend on them; None: they do not
    at_samples: Array | None
    readers: Sequence[int]  # entry of ``sensordata`` for each channel
    force: PlaceForces | None  # forces that Python adds; None: none
    # the same over the steps, of each degree of freedom, (num_steps, nv), where they are known
    # before; None: they are not
    pushes: Array | None
    can_roll: bool  # whether MuJoCo's own loop does it


class DivergedError(ArithmeticError):
    """A simulation left all bounds; the message has the joint, the time and the value."""


class Stepper:
    """Steps calls of a model.

    Args:
        mujoco: The package.
        plain: The model.
        numbers: Its numbers.
        pushes: Forces at its joints.
    """

    def __init__(self, mujoco: Any, plain: Any, numbers: Numbers, pushes: Pushes):
        self.mujoco, self.plain, self.numbers, self.pushes = mujoco, plain, numbers, pushes
        self._rollouts: dict[int, tuple[Any, list[Any]]] = {}  # with a state for each thread
        self._make_rollout = _find_rollout()

    @property
    def has_loop(self) -> bool:
        """Whether this version of MuJoCo has a loop of its own."""
        return self._make_rollout is not None

    def roll(self, jobs: Sequence[Job], threads: int) -> list[Array | Exception]:
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

    def step_through(self, job: Job, watch: bool = False) -> Array:
        """One step after the other, for what MuJoCo's own loop does not do."""
        force = job.force
        if force is None or not force.acts:
            return self._loop(job, watch)
        # called at every stage of an integrator, so that forces are as exact as the step
        before = self.mujoco.get_mjcb_passive()
        self.mujoco.set_mjcb_passive(self.pushes.at_stages(force))
        try:
            return self._loop(job, watch)
        finally:
            self.mujoco.set_mjcb_passive(before)

    def _loop(self, job: Job, watch: bool = False) -> Array:
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

    def _explain_divergence(self, job: Job) -> DivergedError:
        try:
            self.step_through(job, watch=True)
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


def _alike(job: Job, is_read: Mask, *, alone: bool) -> Iterator[tuple[int, int]]:
    """First and end of steps of one length under one command, after which a sample may be read.

    Args:
        is_read: Whether sensors are read at each step, (num_steps,).
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


def _find_rollout() -> Any:
    """MuJoCo's own loop over many simulations; None: the version has none yet."""
    try:
        from mujoco import rollout
    except ImportError:
        return None
    return getattr(rollout, "Rollout", None)
