"""A first ``model`` of a study for an MJCF that lies beside recordings: what belongs to what."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.copter.exchange.xml_nodes import Node, read_nodes
from diffsim.core.arrays import Array
from diffsim.core.figures import list_first
from diffsim.core.units import GRAVITY, to_si
from diffsim.data.folder_tables import files_below
from diffsim.data.guess import Guess, GuessedColumn
from diffsim.data.names import spelled
from diffsim.systems.outside.mjcf import Mjcf
from diffsim.systems.outside.mjcf_wiring import JOINT, JOINT_SENSORS
from diffsim.systems.outside.starts import BEGIN

MAX_FILES = 50  # of the folders beside recordings, that are looked into
MAX_XML_BYTES = 5_000_000  # of a file that is looked into
AT_REST = 2  # rows of a run, in which a joint has not moved yet
STILL = 0.05  # of the way that a joint makes: less is rest
MASS_PERCENT, DAMPING_PERCENT, GAIN_PERCENT = 10, 50, 20  # of a file that nobody measured
LIMIT_PERCENT = 10  # of a largest force: 0.7 of what a maker states is a finding
SHARE_OF_DRIVE = 0.05  # of what a drive pushes with: a force that would be no surprise
SHARE_OF_WEIGHT = 0.01  # [m] times the weight that a joint carries: the same without a drive
SMALLEST_SD = 1e-4  # of a start [rad or m]
MOVING_SD = 5.0  # sd from which a run begins in motion
SIMULATOR = "diffsim.systems.outside.mjcf:Mjcf"
#: Entries of a free joint's place and orientation by what loggers call them
_PLACE = re.compile(r"(?:(?:p|pos|position|base|root)_?)?([xyz])(?:_m|_mm|_cm)?")
_TURN = re.compile(r"(?:(?:q|quat|quaternion|orientation)_?)([wxyz])")
_OF_JOINTS = (0, 1)  # mjtTrn: of actuators on joints
#: What actuators of joints that turn and that slide take: a position, a speed, a push
_TAKES = (("rad", "rad/s", "N m"), ("m", "m/s", "N"))
_VELOCITIES, _PUSHES = ("rad/s", "m/s"), ("N", "N m", "A")


@dataclass
class GuessedModel:
    """Keys of ``model`` and what is said of them."""

    keys: dict[str, Any] = field(default_factory=dict)  # keys of the outside description
    said: list[str] = field(default_factory=list)  # what was guessed, a sentence each
    todo: list[str] = field(default_factory=list)  # what the user must say, a sentence each


def find_mjcf(folder: Path) -> tuple[Path, ...]:
    """MJCF files of a folder that no other one of them includes or attaches; where it has none,
    those of the folders in it that lie highest, as collections of models are laid out."""
    roots = _read_roots(folder)
    inner = set().union(*(_parts_of(path, root) for path, root in roots.items()))
    whole = [path for path in roots if path.resolve() not in inner]
    return tuple(path for path in whole if len(path.parts) == len(whole[0].parts))


def find_robot(folder: Path, columns: Sequence[str]) -> Path | None:
    """Of several MJCF files the smallest one in which columns find as many joints and actuators as
    in any: the robot that scenes include; None: columns find none, or as many in several.

    Args:
        folder: Folder with recordings.
        columns: Names of what was recorded and commanded.
    """
    found = _read_roots(folder)
    roots = {path.resolve(): root for path, root in found.items()}
    parts = {path: _parts_of(path, root) for path, root in roots.items()}
    called = [_words(name) for name in columns]
    shown = {path: _num_shown(path, roots, parts, called) for path in roots}
    most = max(shown.values(), default=0)
    told = {path for path, number in shown.items() if number == most}
    robots = [p for p in found if p.resolve() in told and not parts[p.resolve()] & told]
    return robots[0] if most and len(robots) == 1 else None


def _read_roots(folder: Path) -> dict[Path, Node]:
    """Roots of the MJCF files of a folder, the highest first."""
    below = [path for path in files_below(folder) if path.suffix.lower() == ".xml"]
    paths = sorted(below, key=lambda path: (len(path.parts), path))[:MAX_FILES]
    return {path: root for path in paths if (root := _root_of(path))}


def _parts_of(path: Path, root: Node) -> set[Path]:
    """Files that an MJCF includes or attaches."""
    return {
        (path.parent / node.attributes["file"]).resolve()
        for node in _below(root)
        if node.tag in ("include", "model") and "file" in node.attributes
    }


def _num_shown(
    path: Path,
    roots: Mapping[Path, Node],
    parts: Mapping[Path, set[Path]],
    called: Sequence[set[str]],
) -> int:
    """Number of columns that a joint of an MJCF fits by its words, and that an actuator fits.

    Args:
        roots, parts: Of every file that may belong to it.
        called: Words of each column.
    """
    seen, left = set[Path](), [path]
    while left:
        seen.add(here := left.pop())
        left += [part for part in parts[here] if part in roots and part not in seen]
    held = [node for one in seen for node in roots[one].children]
    kinds = (
        [n for top in held for n in _below(top) if n.tag == "joint"],
        [n for top in held if top.tag == "actuator" for n in top.children],
    )
    called_so = ([n.attributes["name"] for n in nodes if "name" in n.attributes] for nodes in kinds)
    names = [_telling({name: _words(name) for name in names}).values() for names in called_so]
    return sum(any(words <= own for words in kind if words) for kind in names for own in called)


def _root_of(path: Path) -> Node | None:
    """The root of a file that is an MJCF; what is broken, too large or something else is none."""
    if not path.is_file() or path.stat().st_size > MAX_XML_BYTES:
        return None
    try:
        root = read_nodes(path)
    except ValueError:
        return None
    return root if root.tag == "mujoco" else None


def _below(node: Node) -> Iterator[Node]:
    for child in node.children:
        yield child
        yield from _below(child)


def guess_model(path: Path, stated: str, guess: Guess) -> GuessedModel:
    """Channels, commands and numbers of an MJCF by their names, else by their order.

    Args:
        stated: The same as the study calls it.
        guess: What the recordings seem to hold.

    Raises:
        ImportError: MuJoCo is not installed.
        ValueError: the file is no model that MuJoCo reads.
    """
    simulator = Mjcf(str(path), folder=str(guess.folder))
    made = GuessedModel()
    _command_drives(simulator, guess, made)
    channels = _name_channels(simulator, guess, made)
    commands = _name_commands(simulator, guess, made)
    made.said += _find_before(simulator, channels, commands, guess)
    options = {"model": stated, "held": True, "channels": channels, "commands": commands}
    made.keys = {
        "system": "outside",
        "simulator": SIMULATOR,
        "commands_are": "held",
        "options": options,
        "parameters": _parameters(simulator, channels, commands, guess, made),
        "start": _starts(simulator, channels, guess),
        "hooks": _without_empty(
            {
                "command": {actuator: [name] for name, actuator in commands.items()},
                "force": _places(simulator, channels, commands, guess),
            }
        ),
    }
    made.keys = _without_empty(made.keys)
    made.todo.append(
        f"model: numbers of {stated} are guessed to be good to {MASS_PERCENT} % (mass, "
        f"largest force), {DAMPING_PERCENT} % (damping, friction, armature), {GAIN_PERCENT} % "
        "(gain): state what you know of them"
    )
    return made


def _without_empty(keys: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in keys.items() if value}


def _words(name: str) -> set[str]:
    """Words and numbers of a name: shoulder, pan and 2 of "shoulderPan_2"."""
    return {word.lower() for word in re.findall(r"[A-Za-z]+|\d+", spelled(name))}


def _match(
    columns: Sequence[GuessedColumn], targets: dict[str, set[str]], what: str, made: GuessedModel
) -> dict[str, str]:
    """Targets of columns by shared words, or all by their order; those without one are told."""
    found: dict[str, str] = {}
    targets = _telling(targets)
    for column in columns:
        own = _words(column.name)
        fits = [t for t, words in targets.items() if words and words <= own]
        best = max((len(targets[t]) for t in fits), default=0)
        fits = [t for t in fits if len(targets[t]) == best]
        if len(fits) == 1 and fits[0] not in found.values():
            found[column.name] = fits[0]
    if len(found) == len(columns):
        made.said.append(f"{what}s of the MJCF by their names: {_pairs(found)}")
        return found
    if len(columns) == len(targets):
        found = dict(zip((c.name for c in columns), targets, strict=True))
        made.said.append(f"{what}s of the MJCF by their order: {_pairs(found)}")
        made.todo.append(f"model.options: {what}s were taken by their order: {_pairs(found)}")
        return found
    missing = [c.name for c in columns if c.name not in found]
    made.todo.append(
        f"model.options: {what} of the MJCF for {', '.join(missing)}; it has {', '.join(targets)}"
    )
    return found


def _telling(targets: dict[str, set[str]]) -> dict[str, set[str]]:
    """The same without words that all share, where each has others: FR_hip_joint, FR_calf_joint."""
    shared = set.intersection(*targets.values()) if len(targets) > 1 else set()
    told = {target: words - shared for target, words in targets.items()}
    return told if all(told.values()) else targets


def _pairs(found: dict[str, str]) -> str:
    return ", ".join(f"{name} is {target}" for name, target in found.items())


def _command_drives(simulator: Any, guess: Guess, made: GuessedModel) -> None:
    """Columns of force, torque and current, or called like an actuator and no joint or sensor, are
    commands where actuators lack theirs; so are those without a unit that have a u before what
    tells actuators apart, as ux, u_y and u1, where each such actuator has one."""
    plain = simulator.plain
    lacking = plain.nu - len(guess.those("command"))
    columns = guess.those("channel")
    drives = [_words(plain.actuator(i).name) for i in range(plain.nu)]
    shown = [_words(plain.joint(i).name) for i in range(plain.njnt)]
    shown += [_words(plain.sensor(i).name) for i in range(plain.nsensor)]
    pushes = [c for c in columns if _unit(c) in _PUSHES]
    named = [c for c in columns if _is_called(c, drives) and not _is_called(c, shown)]
    ends = set().union(*_telling({str(i): d for i, d in enumerate(drives)}).values())
    inputs = [c for c in columns if _unit(c) == "-" and _is_input(c, ends)]
    for found, why in (
        (pushes, "what actuators push with"),
        (named, "called like actuators"),
        (inputs if len(inputs) == lacking else [], "u before what tells actuators apart"),
    ):
        if 0 < len(found) <= lacking and len(found) < len(columns):
            for column in found:
                column.role = "command"
            made.said.append(f"commands: {', '.join(c.name for c in found)}, {why}")
            return


def _is_input(column: GuessedColumn, ends: set[str]) -> bool:
    own = _words(column.name)
    return any(f"u{end}" in own or {"u", end} <= own for end in ends)


def _is_called(column: GuessedColumn, names: Sequence[set[str]]) -> bool:
    own = _words(column.name)
    return any(words and words <= own for words in names)


def _name_channels(simulator: Any, guess: Guess, made: GuessedModel) -> dict[str, str]:
    """Sensor of each channel, or joint where the sensors' names fit none."""
    plain = simulator.plain
    columns = guess.those("channel")
    sensors = {
        plain.sensor(i).name: _words(plain.sensor(i).name)
        for i in range(plain.nsensor)
        if int(plain.sensor_dim[i]) == 1 and plain.sensor(i).name
    }
    if all(any(words <= _words(c.name) for words in sensors.values()) for c in columns):
        return _match(columns, sensors, "sensor", made)
    joints = [plain.joint(i).name for i in range(plain.njnt) if simulator.numbers.num_axes(i) == 1]
    free = _name_pose(simulator, columns, made)
    found = dict(free)
    for kind in JOINT_SENSORS:
        own = [c for c in columns if c.name not in free]
        own = [c for c in own if (_unit(c) in _VELOCITIES) == (kind == "velocity")]
        targets = {f"joint.{name}.{kind}": _words(name) for name in joints if name}
        found |= _match(own, targets, "joint", made) if own else {}
    return {c.name: found[c.name] for c in columns if c.name in found}


def _name_pose(
    simulator: Any, columns: Sequence[GuessedColumn], made: GuessedModel
) -> dict[str, str]:
    """Entries of the pose of the one body that moves freely, where columns are called so."""
    plain, free = simulator.plain, int(simulator.mujoco.mjtJoint.mjJNT_FREE)
    joints = [i for i in range(plain.njnt) if int(plain.jnt_type[i]) == free]
    if len(joints) != 1 or not plain.body(int(plain.jnt_bodyid[joints[0]])).name:
        return {}
    joint = plain.joint(joints[0]).name
    found: dict[str, str] = {}
    for column in columns:
        for pattern, what, letters in ((_PLACE, "position", "xyz"), (_TURN, "orientation", "wxyz")):
            if entry := pattern.fullmatch(column.name.lower()):
                target = f"joint.{joint}.{what}[{letters.index(entry[1])}]"
                if target not in found.values():
                    found[column.name] = target
    if found and not joint:
        made.todo.append("model: the free joint needs a name: <freejoint name='root'/>")
        return {}
    if found:
        made.said.append(f"the pose of the free joint by their names: {_pairs(found)}")
    return found


def _unit(column: GuessedColumn) -> str:
    return to_si(column.unit).unit


def _name_commands(simulator: Any, guess: Guess, made: GuessedModel) -> dict[str, str]:
    """Actuator of each command, by its own name or that of its joint."""
    plain = simulator.plain
    actuators = [plain.actuator(i).name for i in range(plain.nu)]
    columns = guess.those("command")
    if not (all(actuators) and columns):
        return {}
    by_name = {a: _words(a) for a in actuators}
    by_joint = {a: _words(_joint_of(plain, i)) for i, a in enumerate(actuators)}
    tried = GuessedModel()
    found = _match(columns, by_joint, "actuator", tried)
    if len(found) < len(columns) or tried.todo:
        tried = GuessedModel()
        found = _match(columns, by_name, "actuator", tried)
    made.said += tried.said
    made.todo += tried.todo
    made.todo += _other_units(simulator, columns, found)
    return found


def _other_units(
    simulator: Any, columns: Sequence[GuessedColumn], found: Mapping[str, str]
) -> Iterator[str]:
    """Commands in another unit than their actuator takes, such as a current for a torque."""
    plain, slide = simulator.plain, int(simulator.mujoco.mjtJoint.mjJNT_SLIDE)
    for column in columns:
        if column.name not in found or _unit(column) == "-":
            continue
        i = int(plain.actuator(found[column.name]).id)
        joint = int(plain.actuator_trnid[i, 0])
        if not _joint_of(plain, i) or plain.actuator_gear[i, 0] != 1.0:
            continue
        gain, bias = plain.actuator_gainprm[i, 0], plain.actuator_biasprm[i]
        is_kind = (bias[1] == -gain, bias[2] == -gain, gain == 1.0 and not bias.any())
        takes = next(compress(_TAKES[int(plain.jnt_type[joint]) == slide], is_kind), None)
        if takes is not None and _unit(column) != takes:
            yield (
                f"commands: {column.name} is in {column.unit}, but actuator {found[column.name]} "
                f"takes {takes}: state unit: {takes}, and scale: how many a {column.unit} makes"
            )


def _joint_of(plain: Any, actuator: int) -> str:
    """Name of the joint that an actuator acts on; empty: on a tendon, a site or something else."""
    joint = int(plain.actuator_trnid[actuator, 0])
    is_joint = int(plain.actuator_trntype[actuator]) in _OF_JOINTS and 0 <= joint < plain.njnt
    return str(plain.joint(joint).name) if is_joint else ""


def _parameters(
    simulator: Any,
    channels: Mapping[str, str],
    commands: Mapping[str, str],
    guess: Guess,
    made: GuessedModel,
) -> dict[str, Any]:
    """Masses of what moves; damping, dry friction and armature that are stated; gains of servos and
    largest forces, which with damping make the speed that a drive keeps. Numbers of what drives
    without a recorded command hold stay as the file has them: each is one more to be fitted."""
    plain = simulator.plain
    trees = _trees_recorded(simulator, channels, commands, guess)
    held = _joints_held(simulator, commands)
    held -= {JOINT.sub(r"\1", _joint_shown(simulator, shown)) for shown in channels.values()}
    out: dict[str, Any] = {}
    for i in range(1, plain.nbody):
        body = plain.body(i)
        if body.name and plain.body_mass[i] > 0.0 and _tree_of(plain, i) in trees:
            out[f"body.{body.name}.mass"] = _quantity(float(plain.body_mass[i]), MASS_PERCENT)
    joints = [
        i
        for i in range(plain.njnt)
        if plain.joint(i).name not in {"", *held}
        and _tree_of(plain, int(plain.jnt_bodyid[i])) in trees
    ]
    for i in joints:
        name = plain.joint(i).name
        first = int(plain.jnt_dofadr[i])
        stated = {
            "damping": plain.dof_damping,
            "frictionloss": plain.dof_frictionloss,
            "armature": plain.dof_armature,
        }
        for number, values in stated.items():
            if values[first] > 0.0:
                out[f"joint.{name}.{number}"] = _quantity(float(values[first]), DAMPING_PERCENT)
    for i in range(plain.nu):
        gain, bias = plain.actuator_gainprm[i], plain.actuator_biasprm[i]
        name = plain.actuator(i).name
        if (joint := _joint_of(plain, i)) and joint not in {plain.joint(k).name for k in joints}:
            continue
        if name and gain[0] > 0.0 and bias[1] == -gain[0]:
            out[f"actuator.{name}.kp"] = _quantity(float(gain[0]), GAIN_PERCENT)
            if bias[2] < 0.0:  # above, a damping ratio is
                out[f"actuator.{name}.kv"] = _quantity(-float(bias[2]), DAMPING_PERCENT)
        elif name and gain[0] > 0.0 and bias[1] == 0.0 and bias[2] == -gain[0]:
            out[f"actuator.{name}.kv"] = _quantity(float(gain[0]), GAIN_PERCENT)
        low, high = plain.actuator_forcerange[i]
        if name and plain.actuator_forcelimited[i] and 0.0 < high == -low:
            out[f"actuator.{name}.forcerange"] = _quantity(float(high), LIMIT_PERCENT)
    kept = {plain.joint(i).name for i in joints}
    left = [n for i in range(plain.njnt) if (n := plain.joint(i).name) and n not in kept]
    if left:
        them = list_first(left)
        made.said.append(f"joints of drives without a recorded command stay as in the file: {them}")
    return out


def _tree_of(plain: Any, body: int) -> int:
    """Kinematic tree that a body moves with; -1: it does not move."""
    while body and not plain.body_dofnum[body]:
        body = int(plain.body_parentid[body])
    return int(plain.dof_treeid[int(plain.body_dofadr[body])]) if body else -1


def _trees_recorded(
    simulator: Any, channels: Mapping[str, str], commands: Mapping[str, str], guess: Guess
) -> set[int]:
    """Kinematic trees but those of other robots: with drives, none of them commanded, and without a
    joint that is shown. All where a channel or a command is of no known joint, or where constraints
    tie parts of the model."""
    plain, find = simulator.plain, simulator.numbers.find
    every = set(map(int, plain.dof_treeid))
    shown = [JOINT.fullmatch(_joint_shown(simulator, name)) for name in channels.values()]
    numbers = [find("actuator", name, "") for name in commands.values()]
    driven = [_joint_of(plain, i) for i in numbers or range(plain.nu)]  # by their order: all
    is_open = len(channels) < len(guess.those("channel")) or plain.ntendon
    if is_open or _ties_trees(simulator) or not all(shown) or not all(driven):
        return every

    def tree_of(name: str) -> int:
        return _tree_of(plain, int(plain.jnt_bodyid[find("joint", name, "")]))

    with_drives = {_joint_of(plain, i) for i in range(plain.nu)} - {""}
    told = {tree_of(name) for name in (*(found[1] for found in shown if found), *driven)}
    return every - ({tree_of(name) for name in with_drives} - told)


def _ties_trees(simulator: Any) -> bool:
    """Whether an equality constraint acts between kinematic trees, or on what has none."""
    plain, m = simulator.plain, simulator.mujoco
    kinds = getattr(plain, "eq_objtype", None)  # an older MuJoCo ties bodies alone
    for i in range(plain.neq):
        bodies: Callable[[int], int]
        if int(plain.eq_type[i]) == int(m.mjtEq.mjEQ_JOINT):
            bodies = plain.jnt_bodyid.__getitem__
        elif kinds is None or int(kinds[i]) == int(m.mjtObj.mjOBJ_BODY):
            bodies = int
        elif int(kinds[i]) == int(m.mjtObj.mjOBJ_SITE):
            bodies = plain.site_bodyid.__getitem__
        else:
            return True
        ends = (int(k) for k in (plain.eq_obj1id[i], plain.eq_obj2id[i]) if k >= 0)
        if len({_tree_of(plain, int(bodies(k))) for k in ends} - {-1}) > 1:
            return True
    return False


def _joints_held(simulator: Any, commands: Mapping[str, str]) -> set[str]:
    """Joints that a position servo holds, as none of its commands was recorded; none where commands
    drive actuators by their order."""
    plain = simulator.plain
    if not commands:
        return set()
    idle = [i for i in range(plain.nu) if plain.actuator(i).name not in commands.values()]
    gain, bias = plain.actuator_gainprm, plain.actuator_biasprm
    return {_joint_of(plain, i) for i in idle if 0.0 < gain[i, 0] == -bias[i, 1]} - {""}


def _quantity(value: float, percent: int) -> dict[str, float]:
    return {"value": float(f"{value:.6g}"), "percent": percent}


def _positions(
    simulator: Any, channels: Mapping[str, str], guess: Guess
) -> Iterator[tuple[str, str, list[Array], list[Array], float]]:
    """Joints whose position is recorded: channel, course and clock in each run, and the noise, in
    SI units; of a free joint its entries, as starts have them."""
    for column in guess.those("channel"):
        found = JOINT.fullmatch(_joint_shown(simulator, channels.get(column.name, "")))
        if found and found[2] != "velocity":
            entry = "" if found[3] is None else f"[{int(found[3]) + 3 * (found[2] != 'position')}]"
            times = to_si(column.unit).factor
            yield (
                found[1] + entry,
                column.name,
                [times * c for c in guess.pieces(column)],
                guess.seconds(column),
                times * (column.sd or 0.0),
            )


def _joint_shown(simulator: Any, channel: str) -> str:
    """What a channel shows; of a sensor of a joint's position as without a sensor."""
    plain, m = simulator.plain, simulator.mujoco
    i = m.mj_name2id(plain, m.mjtObj.mjOBJ_SENSOR, channel)
    if i < 0 or int(plain.sensor_type[i]) != int(m.mjtSensor.mjSENS_JOINTPOS):
        return channel
    return f"joint.{plain.joint(int(plain.sensor_objid[i])).name}.position"


def _starts(simulator: Any, channels: Mapping[str, str], guess: Guess) -> dict[str, Any]:
    """Where joints begin, by the first samples of their channels, a value of each run; and how
    fast, where a run begins in motion."""
    out: dict[str, Any] = {}
    for joint, shown, courses, clocks, noise in _positions(simulator, channels, guess):
        first = np.array([course[np.isfinite(course)][0] for course in courses])
        # an offset of the sensor is as likely as a start elsewhere: no narrower than starts differ
        sd = max(3.0 * noise, 2.0 * float(np.abs(first - first.mean()).max()), SMALLEST_SD)
        name, bracket, entry = joint.partition("[")
        path = f"joint.{name}.start{bracket}{entry}"
        out[path] = {"first": shown, "sd": float(f"{sd:.2g}"), "per": "run"}
        if not bracket and (rate := _first_rate(courses, clocks, noise)) > 0.0:
            out[f"joint.{name}.start_rate"] = {
                "value": 0.0,
                "sd": float(f"{2.0 * rate:.2g}"),
                "per": "run",
            }
    return out


def _first_rate(courses: Sequence[Array], clocks: Sequence[Array], noise: float) -> float:
    """Largest speed with which a run begins; 0 where it is no more than noise."""
    fastest = 0.0
    for course, clock in zip(courses, clocks, strict=True):
        time, seen = clock[:BEGIN] - clock[0], course[:BEGIN]
        powers = np.vander(time, 3, increasing=True)  # it may speed up from rest
        is_told = len(time) == BEGIN and np.isfinite(powers).all() and np.isfinite(seen).all()
        if is_told and np.linalg.matrix_rank(powers) == powers.shape[1]:
            inverse, least = np.linalg.pinv(powers)[1], MOVING_SD * max(noise, SMALLEST_SD)
            rate, sd = abs(float(inverse @ seen)), float(np.linalg.norm(inverse))
            rests = np.ptp(seen[: BEGIN // 2]) <= least  # it may set off a little later
            if rate > sd * least and not rests:
                fastest = max(fastest, rate)
    return fastest


def _places(
    simulator: Any, channels: Mapping[str, str], commands: Mapping[str, str], guess: Guess
) -> dict[str, Any]:
    """Joints whose position is recorded, as places of forces, with usual sizes."""
    out: dict[str, Any] = {}
    plain, m = simulator.plain, simulator.mujoco
    for name, _, courses, clocks, _ in _positions(simulator, channels, guess):
        if "[" in name:  # a free body has no axis
            continue
        joint = simulator.numbers.find("joint", name, "")
        is_slide = int(plain.jnt_type[joint]) == int(m.mjtJoint.mjJNT_SLIDE)
        reach = max(0.5 * float(np.nanmax(c) - np.nanmin(c)) for c in courses)
        weight = GRAVITY * float(plain.body_subtreemass[int(plain.jnt_bodyid[joint])])
        pushes = [SHARE_OF_WEIGHT * weight]
        for command, actuator in commands.items():
            if _joint_of(plain, simulator.numbers.find("actuator", actuator, "")) == name:
                pushes.append(_push_of(simulator, command, actuator, guess, reach))
        sizes = {
            "typical": SHARE_OF_DRIVE * max(pushes),
            "distance": reach,
            "speed": max(map(_usual_speed, courses, clocks)),
        }
        out[name] = {"unit": "N" if is_slide else "N m"} | {
            key: float(f"{value:.2g}") for key, value in sizes.items() if value > 0.0
        }
    return out


def _find_before(
    simulator: Any, channels: Mapping[str, str], commands: Mapping[str, str], guess: Guess
) -> Iterator[str]:
    """What servos were told before the runs, where their joints begin at rest in one place and the
    first goals lie elsewhere: that place. A sentence for each."""
    plain, columns = simulator.plain, {c.name: c for c in guess.those("command")}
    courses = {name: found for name, _, found, _, _ in _positions(simulator, channels, guess)}
    for command, actuator in commands.items():
        i, column = simulator.numbers.find("actuator", actuator, ""), columns[command]
        joint = _joint_of(plain, i)
        if plain.actuator_biasprm[i, 1] == 0.0 or joint not in courses:
            continue
        times = to_si(column.unit).factor
        goals = np.array([times * values[0] for values in guess.pieces(column)])
        seen = [course[np.isfinite(course)] for course in courses[joint]]
        first = np.array([course[0] for course in seen])
        moved = max(float(np.abs(course[:AT_REST] - course[0]).max()) for course in seen)
        reach = max(float(np.ptp(course)) for course in seen)
        at_rest = max(moved, float(np.ptp(first))) < STILL * reach
        if at_rest and np.mean(np.abs(goals - first) > STILL * reach) >= 0.5:
            column.before = float(f"{first.mean() / times:.4g}")
            if abs(first.mean()) < STILL * reach:
                column.before = 0.0
            yield (
                f"command {command} before the runs: {column.before:g}, where the joint rests "
                "while first goals lie elsewhere"
            )


def _usual_speed(course: Array, clock: Array) -> float:
    """Speed that nine of ten samples of a run stay below."""
    steps = np.diff(clock)
    rates = np.diff(course)[steps > 0.0] / steps[steps > 0.0]
    return float(np.nanquantile(np.abs(rates), 0.9)) if rates.size else 0.0


def _push_of(simulator: Any, command: str, actuator: str, guess: Guess, reach: float) -> float:
    """What an actuator pushes with: its gain times the largest command, of a servo the way."""
    plain = simulator.plain
    i = simulator.numbers.find("actuator", actuator, "")
    gain = abs(float(plain.actuator_gainprm[i, 0] * plain.actuator_gear[i, 0]))
    if plain.actuator_biasprm[i, 1] != 0.0:
        return gain * reach
    column = next(c for c in guess.those("command") if c.name == command)
    largest = max(float(np.nanmax(np.abs(values))) for values in guess.samples(column))
    return gain * largest * to_si(column.unit).factor
