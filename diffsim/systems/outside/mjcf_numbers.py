"""Numbers of a MuJoCo model that parameters set, by path; each as the file with that number has it.

| path | number |
|---|---|
| ``gravity``, ``density``, ``viscosity`` | of the world; gravity points down |
| ``body.NAME.mass`` | mass; the inertia grows alike |
| ``body.NAME.inertia``, ``.inertia[k]`` | largest principal moment, the others grow alike; or one |
| ``body.NAME.pos[k]`` | place in the frame of the body that carries it |
| ``body.NAME.payload``, ``.payload_at`` | point mass more; where on the way from joint to far end |
| ``body.NAME.unbalance[k]`` | mass times what its center of mass is off, payload included |
| ``joint.NAME.damping``, ``.armature``, ``.frictionloss``, ``.stiffness`` | of all its axes |
| ``joint.NAME.solreffriction`` | time in which its friction takes hold; damped as usual |
| ``joint.NAME.dampingpoly[k]``, ``.stiffnesspoly[k]`` | terms by powers, of later versions |
| ``joint.NAME.start``, ``.start_rate`` | at the first sample; ``[k]`` of a free or ball joint |
| ``actuator.NAME.kp``, ``.kv`` | gains of a servo |
| ``actuator.NAME.gain`` | gain with the bias that belongs to it: of a position servo its kp |
| ``actuator.NAME.gainprm[k]``, ``.biasprm[k]`` | an entry of MuJoCo's own, nothing else |
| ``actuator.NAME.forcerange`` | largest force either way |
| ``actuator.NAME.weakness`` | 1 over a largest force below that of the file; 0: there is none |
| ``actuator.NAME.delay`` | time by which it hears its command late |
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.check import did_you_mean, require_number
from diffsim.systems.outside.mjcf_payloads import put_payload, put_unbalance, reach_of

KINDS = {
    "body": ("mass", "inertia", "pos", "payload", "payload_at", "unbalance"),
    "joint": (
        "damping",
        "armature",
        "frictionloss",
        "solreffriction",
        "stiffness",
        "start",
        "start_rate",
        "dampingpoly",
        "stiffnesspoly",
    ),
    "actuator": ("kp", "kv", "gain", "gainprm", "biasprm", "forcerange", "delay", "weakness"),
}
WORLD = ("gravity", "density", "viscosity")
FIRST = ("mass", "kp", "gain", "forcerange")  # set before what others say of the same arrays
NOT_NEGATIVE = (
    "mass",
    "inertia",
    "payload",
    "armature",
    "frictionloss",
    "solreffriction",
    "damping",
    "forcerange",
    "weakness",
    "delay",
)
_VECTORS = {
    **dict.fromkeys(("inertia", "pos", "unbalance"), 3),
    **{"start": 7, "start_rate": 6},
    **dict.fromkeys(("gainprm", "biasprm"), 10),
    **dict.fromkeys(("dampingpoly", "stiffnesspoly"), 2),
}
_OF_DOF = {
    "damping": "dof_damping",
    "armature": "dof_armature",
    "frictionloss": "dof_frictionloss",
    "solreffriction": "dof_solref",
}
# of springs and losses by powers of what moves
_OF_POWERS = {"dampingpoly": "dof_dampingpoly", "stiffnesspoly": "jnt_stiffnesspoly"}
ENTRIES_ONLY = ("pos", "unbalance", "gainprm", "biasprm", *_OF_POWERS)
_ARRAYS = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_sameframe",
    "geom_sameframe",
    "site_sameframe",
    "body_pos",
    *_OF_DOF.values(),
    *_OF_POWERS.values(),
    "jnt_stiffness",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
    "actuator_forcelimited",
    "actuator_delay",  # of MuJoCo 3.5 and later
)
_PATH = re.compile(r"(\w+)\.(.+)\.(\w+)(?:\[(\d+)\])?")
_DOFS = {0: (7, 6), 1: (4, 3), 2: (1, 1), 3: (1, 1)}  # by mjtJoint: of position, of rate


def several_axes(joint: str, count: int) -> str:
    """That a joint is no place of forces, which act about one axis."""
    return (
        f"hooks.force: joint {joint!r} has {count} axes, and a force acts about one; places are "
        "hinges and slides, of which several move a body freely, too"
    )


@dataclass(frozen=True)
class Path:
    """A parameter, taken apart."""

    text: str  # the whole path
    # kind, name, what: such as joint, elbow and damping
    kind: str
    name: str
    what: str
    entry: int | None  # entry of a vector; None: the number itself

    @classmethod
    def of(cls, text: str) -> Path:
        """The parts of a path.

        Raises:
            ValueError: there is no such path.
        """
        found = _PATH.fullmatch(text)
        if found is None or found[1] not in KINDS:
            numbers = "; ".join(f"{k}.NAME.{', .'.join(w)}" for k, w in KINDS.items())
            raise ValueError(f"parameter {text!r} is none of {numbers}; {', '.join(WORLD)}")
        kind, name, what, entry = found.groups()
        known = KINDS[kind]
        if what not in known:
            raise ValueError(
                f"parameter {text!r}: {what!r} of a {kind} cannot be set"
                f"{did_you_mean(what, known)}; what can be is {', '.join(known)}"
            )
        if entry is not None and int(entry) >= _VECTORS.get(what, 0):
            raise ValueError(f"parameter {text!r}: {what} has no entry {entry}")
        if entry is None and what in ENTRIES_ONLY:
            raise ValueError(f"parameter {text!r}: name one entry, such as {text}[0]")
        return cls(text, kind, name, what, None if entry is None else int(entry))


@dataclass
class Setting:
    """What parameters mean beside the numbers of the model."""

    # positions, rates: start values by their entry of qpos and qvel
    positions: dict[int, float] = field(default_factory=dict)
    rates: dict[int, float] = field(default_factory=dict)
    # time by which an actuator hears its command late, by its index [s]
    delays: dict[int, float] = field(default_factory=dict)
    # mass that a body carries more, by the body's index [kg]
    payloads: dict[int, float] = field(default_factory=dict)
    # where it hangs, 0 at the body's joint, 1 at its far end
    payloads_at: dict[int, float] = field(default_factory=dict)
    # mass times what its center of mass is off, by the body's index, (3,) [kg m]
    unbalances: dict[int, Array] = field(default_factory=dict)


class Numbers:
    """The numbers of one MJCF.

    Args:
        mujoco: The module.
        plain: The model as the file has it, never changed.
        by_ratio: Actuators whose kv is stated as a damping ratio.
    """

    def __init__(self, mujoco: Any, plain: Any, by_ratio: tuple[int, ...]):
        self.mujoco, self.plain, self.by_ratio = mujoco, plain, by_ratio
        self._arrays = tuple(name for name in _ARRAYS if hasattr(plain, name))
        self._names = {kind: tuple(_names(plain, kind)) for kind in (*KINDS, "sensor")}
        self._data = mujoco.MjData(plain)
        self._reflected = self._list_reflected(plain) if by_ratio else {}
        self._reaches: dict[int, tuple[Array, Array]] = {}
        # asked for at each call
        self._servos = [self._servo(i) for i in range(len(plain.actuator_gaintype))]

    def find(self, kind: str, name: str, where: str) -> int:
        """Index of a body, joint, actuator or sensor.

        Raises:
            ValueError: there is none of that name; the message names the closest.
        """
        known = self._names[kind]
        if name not in known:
            raise ValueError(
                f"{where}: the MJCF has no {kind} {name!r}{did_you_mean(name, known)}; "
                f"it has {', '.join(known)}"
            )
        return known.index(name)

    def num_axes(self, joint: int) -> int:
        """Axes of a joint, by its index: one of slides and hinges, 3 of balls, 6 of free ones."""
        return _DOFS[int(self.plain.jnt_type[joint])][1]

    def has(self, what: str) -> bool:
        """Whether the version of MuJoCo knows a number of joints, such as "dampingpoly[0]"."""
        return hasattr(self.plain, _OF_POWERS.get(what.partition("[")[0], "jnt_stiffness"))

    def value_of(self, text: str) -> float:
        """What the file states for damping, armature, friction or stiffness of a joint; a payload
        or unbalance of a body, or weakness of an actuator, is none.

        Raises:
            ValueError: there is no such parameter.
        """
        path = Path.of(text)
        if path.what in ("payload", "unbalance", "weakness"):
            return 0.0
        joint = self.find(path.kind, path.name, "parameters")
        if path.what == "stiffness":
            return float(self.plain.jnt_stiffness[joint])
        if path.what in _OF_POWERS:
            return float(self._powers_of(self.plain, path, joint)[0, path.entry])
        of_axis = getattr(self.plain, _OF_DOF[path.what])[self.plain.jnt_dofadr[joint]]
        return float(of_axis[0] if path.what == "solreffriction" else of_axis)

    def put(self, model: Any, parameters: Mapping[str, float]) -> Setting:
        """Set a model's numbers, all others as the file has them.

        Args:
            model: A copy of the plain model.
            parameters: Values by path.

        Raises:
            ValueError: a path or a value cannot be set; the message says why.
        """
        self._reset(model)
        out = Setting()
        paths: list[tuple[Path, float]] = []
        for text, value in parameters.items():
            require_number(f"parameter {text}", value)
            if text in WORLD:
                _put_world(model.opt, text, value)
            else:
                paths.append((Path.of(text), value))
        for path, value in sorted(paths, key=lambda p: p[0].what not in FIRST):
            if path.what in NOT_NEGATIVE and value < 0.0:
                raise ValueError(f"parameter {path.text} must be at least 0, got {value:g}")
            index = self.find(path.kind, path.name, "parameters")
            act: Callable[..., None] = getattr(self, f"_put_{path.kind}")
            act(model, path, index, value, out)
        for body, mass in out.payloads.items():
            put_payload(self.mujoco, model, body, mass, self._reach(body, out.payloads_at))
        for body, moment in out.unbalances.items():
            put_unbalance(model, body, moment)
        stated = {p.name for p, _ in paths if p.what in ("kv", "biasprm", "gainprm")}
        self._put_ratios(model, [p for p, _ in paths], stated)
        self.mujoco.mj_setConst(model, self._data)
        return out

    def start_state(self, model: Any, setting: Setting, time: float) -> Array:
        """The state at the first sample, as MuJoCo lays it out.

        Args:
            model: Model with its numbers.
            setting: What ``put`` returned.
            time: Time of the first sample [s].
        """
        data, whole = self._data, self.mujoco.mjtState.mjSTATE_FULLPHYSICS
        self.mujoco.mj_resetData(model, data)
        data.time = time
        for entry, value in setting.positions.items():
            data.qpos[entry] = value
        for entry, value in setting.rates.items():
            data.qvel[entry] = value
        out = np.zeros(self.mujoco.mj_stateSize(model, whole))
        self.mujoco.mj_getState(model, data, out, whole)
        return out

    def begin(self, model: Any, state: Array) -> Any:
        """MuJoCo's data at a start."""
        self.mujoco.mj_resetData(model, self._data)
        self.mujoco.mj_setState(model, self._data, state, self.mujoco.mjtState.mjSTATE_FULLPHYSICS)
        return self._data

    def _reset(self, model: Any) -> None:
        for name in self._arrays:
            getattr(model, name)[:] = getattr(self.plain, name)
        for name in ("density", "viscosity", "timestep"):
            setattr(model.opt, name, getattr(self.plain.opt, name))
        model.opt.gravity[:] = self.plain.opt.gravity

    def _reach(self, body: int, shares: Mapping[int, float]) -> Array:
        """Where a body carries a payload, in its frame, (3,) [m]; without a word at its far end."""
        if body not in self._reaches:
            self._reaches[body] = reach_of(self.mujoco, self.plain, self._data, body)
        joint, end = self._reaches[body]
        return np.asarray(joint + shares.get(body, 1.0) * (end - joint))

    def _put_body(self, m: Any, path: Path, i: int, value: float, out: Setting) -> None:
        if path.what == "pos":
            m.body_pos[i, path.entry] = value
            return
        if path.what == "payload_at":
            out.payloads_at[i] = value
            return
        if not self.plain.body_mass[i] > 0.0:
            raise ValueError(
                f"parameter {path.text}: the file gives body {path.name!r} no mass, so there is "
                "no inertia to scale; give it <inertial> or a shape with mass"
            )
        if path.what == "payload":
            out.payloads[i] = value
        elif path.what == "unbalance":
            out.unbalances.setdefault(i, np.zeros(3))[path.entry] = value
        elif path.what == "mass":
            m.body_inertia[i] = self.plain.body_inertia[i] * value / self.plain.body_mass[i]
            m.body_mass[i] = value
        elif path.entry is not None:
            m.body_inertia[i, path.entry] = value
        else:
            m.body_inertia[i] = (
                self.plain.body_inertia[i] * value / self.plain.body_inertia[i].max()
            )

    def _put_joint(self, m: Any, path: Path, j: int, value: float, out: Setting) -> None:
        width = _DOFS[int(m.jnt_type[j])]
        if path.what == "stiffness":
            m.jnt_stiffness[j] = value
        elif path.what in _OF_POWERS:
            self._powers_of(m, path, j)[:, path.entry] = value
        elif path.what in _OF_DOF:
            first = int(m.jnt_dofadr[j])
            of_axes = getattr(m, _OF_DOF[path.what])[first : first + width[1]]
            of_axes[:] = (value, 1.0) if path.what == "solreffriction" else value
        else:
            is_rate = path.what == "start_rate"
            number, entry = width[is_rate], path.entry or 0
            if entry >= number or (path.entry is None and number > 1):
                raise ValueError(
                    f"parameter {path.text}: joint {path.name!r} has {number} numbers; "
                    f"name one, {path.what}[0] to [{number - 1}]"
                )
            target, first = (
                (out.rates, m.jnt_dofadr[j]) if is_rate else (out.positions, m.jnt_qposadr[j])
            )
            target[int(first) + entry] = value

    def _powers_of(self, m: Any, path: Path, joint: int) -> Any:
        """Terms of a joint by powers, (num_axes, 2); of its spring (1, 2).

        Raises:
            ValueError: this version of MuJoCo has none.
        """
        if not self.has(path.what):
            raise ValueError(f"parameter {path.text}: MuJoCo is too old for it; update it")
        first, count = joint, 1
        if path.what == "dampingpoly":
            first, count = int(m.jnt_dofadr[joint]), self.num_axes(joint)
        return getattr(m, _OF_POWERS[path.what])[first : first + count]

    def _put_actuator(self, m: Any, path: Path, i: int, value: float, out: Setting) -> None:
        what = path.what
        if what == "delay":
            out.delays[i] = value
            if hasattr(m, "actuator_delay"):
                m.actuator_delay[i] = 0.0  # the command comes late already
        elif what == "forcerange":
            low, high = self.plain.actuator_forcerange[i]
            if self.plain.actuator_forcelimited[i] and not np.isclose(low, -high):
                raise ValueError(
                    f"parameter {path.text}: the file states {low:g} to {high:g}, which one "
                    "number does not; make them alike in the file"
                )
            m.actuator_forcerange[i] = (-value, value)
            m.actuator_forcelimited[i] = True
        elif what == "weakness":
            if value > 0.0:
                stated = (
                    m.actuator_forcerange[i] if m.actuator_forcelimited[i] else (-np.inf, np.inf)
                )
                m.actuator_forcerange[i] = np.clip(stated, -1.0 / value, 1.0 / value)
                m.actuator_forcelimited[i] = True
        elif what in ("gainprm", "biasprm"):
            getattr(m, f"actuator_{what}")[i, path.entry] = value
        else:
            _put_gain(m, path, i, value, self._servos[i])

    def is_servo(self, i: int) -> bool:
        """Whether an actuator pushes by what is left to its goal, by its index."""
        return self._servos[i] in ("position", "velocity")

    def _servo(self, i: int) -> str | None:
        """What the first gain of an actuator belongs to: its bias, or nothing; None: neither."""
        gains, biases = self.mujoco.mjtGain, self.mujoco.mjtBias
        gain, bias = int(self.plain.actuator_gaintype[i]), int(self.plain.actuator_biastype[i])
        first, prm = self.plain.actuator_gainprm[i], self.plain.actuator_biasprm[i]
        if gain == gains.mjGAIN_AFFINE and bias == biases.mjBIAS_NONE and not first[:2].any():
            return "damper"
        if gain != gains.mjGAIN_FIXED or bias not in (biases.mjBIAS_NONE, biases.mjBIAS_AFFINE):
            return None
        if not prm[:3].any() or bias == biases.mjBIAS_NONE:
            return "motor"
        if np.isclose(prm[1], -first[0]) and prm[0] == 0.0 and first[0] != 0.0:
            return "position"
        if np.isclose(prm[2], -first[0]) and not prm[:2].any():
            return "velocity"
        return None

    def _put_ratios(self, m: Any, paths: list[Path], stated: set[str]) -> None:
        """Where the file states a damping ratio, kv follows kp and the inertia that it moves."""
        if not self.by_ratio:
            return
        heavier = any(p.kind == "body" or p.what == "armature" for p in paths)
        now = self._list_reflected(m) if heavier else self._reflected
        for i in self.by_ratio:
            if self._names["actuator"][i] not in stated:
                share = m.actuator_gainprm[i, 0] / self.plain.actuator_gainprm[i, 0]
                share *= now[i] / self._reflected[i]
                m.actuator_biasprm[i, 2] = self.plain.actuator_biasprm[i, 2] * np.sqrt(share)

    def _list_reflected(self, model: Any) -> dict[int, float]:
        """Inertia that an actuator moves at the file's own posture, by its index."""
        data = self._data
        self.mujoco.mj_setConst(model, data)
        self.mujoco.mj_resetData(model, data)
        self.mujoco.mj_forward(model, data)
        arms = np.zeros((model.nu, model.nv))
        self.mujoco.mju_sparse2dense(
            arms, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
        out = {}
        for i in self.by_ratio:
            moved = np.zeros((1, model.nv))
            self.mujoco.mj_solveM(model, data, moved, arms[i : i + 1])
            out[i] = 1.0 / max(float(arms[i] @ moved[0]), 1e-15)
        return out


def _put_world(option: Any, name: str, value: float) -> None:
    if name == "gravity":
        option.gravity[:] = (0.0, 0.0, -value)
    else:
        setattr(option, name, value)


def _put_gain(m: Any, path: Path, i: int, value: float, servo: str | None) -> None:
    """Gain and the bias that belongs to it, as the file with that number has them."""
    fits = {"motor": ("gain",), "position": ("gain", "kp", "kv"), "velocity": ("gain", "kv")}
    fits["damper"] = ("gain", "kv")
    if servo is None or path.what not in fits[servo]:
        kind = "a bias of its own" if servo is None else f"the form of a {servo}"
        gain, bias = m.actuator_gainprm[i, :3], m.actuator_biasprm[i, :3]
        raise ValueError(
            f"parameter {path.text}: actuator {path.name!r} has {kind} (gainprm "
            f"{' '.join(f'{v:g}' for v in gain)}, biasprm {' '.join(f'{v:g}' for v in bias)}), "
            f"so it has no {path.what}; set an entry, such as actuator.{path.name}.gainprm[0]"
        )
    if servo == "damper":
        m.actuator_gainprm[i, 2] = -value
    elif servo == "position" and path.what == "kv":
        m.actuator_biasprm[i, 2] = -value
    else:
        m.actuator_gainprm[i, 0] = value
        if servo != "motor":
            m.actuator_biasprm[i, 1 if servo == "position" else 2] = -value


def _names(model: Any, kind: str) -> Iterator[str]:
    count = {"body": "nbody", "joint": "njnt", "sensor": "nsensor", "actuator": "nactuator"}[kind]
    number = getattr(model, count, None)
    objects: Callable[[int], Any] = getattr(model, kind)
    for i in range(int(model.nu if number is None else number)):
        yield objects(i).name
