"""What names of columns, files and topics say: a clock, a command, a sensor, a motion, a flag.

Columns of robots' logs are known by convention. ROS messages are in SI units (REP 103), PX4's
topics in those of their definitions (https://docs.px4.io/main/en/msg_docs/). Headers of logs state
no units.
"""

from __future__ import annotations

import re
from dataclasses import replace

from diffsim.core.units import to_si
from diffsim.data.table_guess import TIME, Column, column_of

#: What a file states of its clock beside the samples: rows a second, or seconds between two rows.
RATE = re.compile(
    r"(^|[._ ])(fs|fps|hz|(sample|sampling|recording|control|action|loop|frame)s?[_ ]?"
    r"(rate|freq|frequency|hz|fps)|abtastrate)([._ ]hz)?$",
    re.I,
)
PERIOD = re.compile(
    r"(^|[._ ])(dt|delta[_ ]?t|ts|(sample|sampling|time|control|frame)[_ ]?"
    r"(step|time|period|interval)|abtastzeit)$",
    re.I,
)
#: What people call a clock by its unit alone.
_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sekunden"), "s"),
    **dict.fromkeys(("ms", "millis", "msec", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "micros", "usec", "microseconds"), "us"),
    **dict.fromkeys(("min", "mins", "minute", "minutes", "minuten"), "min"),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours", "stunden"), "h"),
}
CLOCK = re.compile(r"time$", re.I)  # a clock if it only grows, as systime; settling_time does not
COUNTER = re.compile(
    r"^((\w+_header_)?(frame|sample|index|idx|row|count|counter|seq|pose|image|bild|zeile|schritt|messpunkt"
    r"|loop_?iteration|iteration)"
    r"(_?(id|nr|no|num|number|index|count))?|(data|packet|msg|message)_?(id|nr|no|number)|i|n|nr|no)$",
    re.I,
)
TRIAL = re.compile(
    r"^(run|trial|test|sweep|pass|series|cycle|rep|repeat|repetition|experiment|exp|throw|toss|"
    r"shot|episode|lauf|versuch|messung)(_?(no|nr|id|number|index|\d))?$",
    re.I,
)
_DESIRED = (
    r"cmd|command|commanded|set|setpoint|sp|goal|desired|des|ref|reference|target|soll|sollwert"
)
COMMAND = re.compile(
    rf"(^|_)({_DESIRED}|input|pwm|duty|"
    r"throttle|esc|signal|demand|actions?|control|controller|drive|pump|pumpe|valve|ventil|"
    r"contraction|"
    r"consigne|voltage)(_|\d|$)"
    r"|^u\d*$|^((motor|actuator|servo)s?_)?(m|mot|motor|rotor|rpm|servo|rc|out)_?\d+$",
    re.I,
)
VOLTAGE = re.compile(r"^u\d*$|(^|_)voltage(_|\d|$)", re.I)  # commanded, or what a current leaves
_ACTUAL = r"measured|meas|ist|istwert|actual|present|observed|obs|feedback"
#: Sensors by their names, and motion by names that mean it with a unit of motion.
SENSOR = re.compile(
    rf"(^|_)({_ACTUAL}|observations?|gyro|acc|accel|accelerometer|imu|mocap|vicon|optitrack|"
    r"encoder|odom|gps|baro|bat|battery|emf|temp|temperatur[ea]?|température)(_|\d|$)",
    re.I,
)
_MOTION = re.compile(
    r"^(p|q|r|[xyz]|[vapgw][xyz]|d?(phi|theta|psi))(_?\d)?(_(pos|ned|enu|world|body|b|w))?$"
    r"|(^|_)(pos|position|vel|velocity|acc|acceleration|height|altitude|displacement|"
    r"(ang(ular|le)?_?)(rate|vel|velocity|speed|acc)?|(body_?)?rates?|omega|"
    r"(roll|pitch|yaw|nick|gier|heading|tilt)(_?rate|_?speed)?)(_?[xyzpqr\d])?(_|$)",
    re.I,
)
_MOTION_UNITS = ("m", "rad", "m/s", "rad/s", "m/s^2", "rad/s^2")
QUATERNION = re.compile(r"(^|_)(q|quat|quaternion)_?[wxyz0-3]$", re.I)  # has no unit
IDLE = re.compile(  # further clocks of a log, and flags
    r"(^|_)(time)?stamp(_|$)|(^|_)(repeated|valid|invalid|flag|status|missing|ok|error)(_|\d|$)",
    re.I,
)
GIVEN_OUT = re.compile(r"control|controller|pwm|duty|feedback", re.I)
DRIVING = re.compile(r"(^|_)(torques?|tau|moment|drehmoment|efforts?|current|strom)(_|\d|$)", re.I)
DRIVES = re.compile(r"motor|rotor|actuator", re.I)  # rather than what a controller aimed at
#: Files and topics: what was asked for, by words that leave no doubt, or by others.
_ASKED = re.compile(rf"(^|[^a-z])({_DESIRED}|input|action)s?([^a-z]|$)|setpoint|cmd", re.I)
_DRIVEN = re.compile(r"actuator|control|motor|thrust", re.I)
STATE = re.compile(
    r"odom|pose|position|joint_?states|(^|[/_])states?($|[/_.])|attitude|mocap", re.I
)
_RECORD = re.compile(
    r"(^|_)(out|outputs?|response|trajectory|measurements?|force|camera|tracking|sensors?|log|data)"
    r"(_|\d|$)",
    re.I,
)


def spelled(name: str) -> str:
    """A name with the words of camelCase apart: goalPosition is goal_Position."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)


def is_asked(name: str) -> bool:
    """Whether a file or topic of this name holds what was commanded."""
    return bool(_ASKED.search(name) or (_DRIVEN.search(name) and not STATE.search(name)))


def has_role(name: str) -> bool:
    """Whether a file's name says what of a run it holds, rather than which run."""
    patterns = (TIME, SENSOR, STATE, _RECORD)
    return is_asked(name) or any(pattern.search(spelled(name)) for pattern in patterns)


def is_command(column: Column) -> bool:
    """Whether a column is called a command."""
    return bool(COMMAND.search(column.base) or COMMAND.search(spelled(column.base)))


def is_motion(column: Column) -> bool:
    """Whether a column is called a motion and has a unit of one."""
    if column.unit is None or not _MOTION.search(column.base):
        return False
    return to_si(column.unit).unit in _MOTION_UNITS


def without_role(base: str) -> tuple[str, str]:
    """A name without the word that says desired or measured, and which of them it says."""
    for role, words in (("desired", _DESIRED), ("measured", _ACTUAL)):
        rest = re.sub(rf"(^|_)({words})(?=_|$)", "", spelled(base), flags=re.I).strip("_").lower()
        if rest != spelled(base).lower():
            return rest, role
    return base.lower(), ""


def may_be_time(column: Column) -> bool:
    """Whether the unit of a column is one of time, or is not stated: T_wall [degC] is no clock."""
    return column.unit in (None, "-") or to_si(column.unit).unit == "s"


def unit_of_clock(header: str) -> str | None:
    """Unit of a clock whose header is its unit, such as ``min``; None: it says none."""
    return _UNITS.get(header.strip().lower())


#: Endings of fields of ROS messages, and their unit.
_ROS = (
    (r"(^|\.)linear_acceleration\.[xyz]$", "m/s^2"),
    (r"(^|\.)angular(_velocity)?\.[xyz]$", "rad/s"),
    (r"(^|\.)(linear|velocity)\.[xyz]$", "m/s"),
    (r"(^|\.)(position|translation)\.[xyz]$", "m"),
    (r"(^|\.)(orientation|rotation)\.[xyzw]$", "-"),
    (r"(^|\.)force\.[xyz]$", "N"),
    (r"(^|\.)torque\.[xyz]$", "N m"),
)
#: PX4's topics: fields that are of use, and their unit.
_PX4 = {
    "vehicle_local_position": ((r"[xyz]", "m"), (r"v[xyz]", "m/s"), (r"a[xyz]", "m/s^2")),
    "vehicle_odometry": (
        (r"position\[\d\]", "m"),
        (r"velocity\[\d\]", "m/s"),
        (r"q\[\d\]", "-"),
        (r"angular_velocity\[\d\]", "rad/s"),
    ),
    "vehicle_attitude": ((r"q\[\d\]", "-"), (r"(roll|pitch|yaw)speed", "rad/s")),
    "vehicle_angular_velocity": ((r"xyz\[\d\]", "rad/s"),),
    "vehicle_acceleration": ((r"xyz\[\d\]", "m/s^2"),),
    "sensor_combined": ((r"gyro_rad\[\d\]", "rad/s"), (r"accelerometer_m_s2\[\d\]", "m/s^2")),
    "actuator_motors": ((r"control\[\d+\]", "-"),),
    "actuator_outputs": ((r"output\[\d+\]", "us"),),
    "battery_status": ((r"voltage_(filtered_)?v", "V"), (r"current_(filtered_)?a", "A")),
}
_UNUSED = re.compile(r"covariance|(^|[._])header\.|child_frame_id", re.I)
#: Topics that belong to a record whose own topic shows a part of the motion only.
BESIDE = {"vehicle_local_position": ("vehicle_attitude", "vehicle_angular_velocity")}


def px4_topic(tag: str) -> str:
    """The topic of PX4 that a table exported from a log holds, by the end of its name, such as
    vehicle_attitude_0; empty: none."""
    name = re.sub(r"_\d+$", "", tag)
    return next((topic for topic in _PX4 if name.endswith(topic)), "")


def log_column(name: str, part: str) -> Column | None:
    """A column of a topic; None where nobody needs it, such as a covariance.

    Args:
        name: Field as the log has it, such as "pose.position.x" or "q[0]".
    """
    topic, column = part.rpartition("/")[2].partition(".")[0], column_of(name)
    if _UNUSED.search(name):
        return None
    column = replace(column, is_asked=is_asked(topic))
    if topic in _PX4 and name == "timestamp":
        return replace(column, unit="us")
    if topic in _PX4 and name != "time_s":
        for field, unit in _PX4[topic]:
            if re.fullmatch(field, name):
                return replace(column, unit=unit)
        return None
    if column.unit is None:
        for field, unit in _ROS:
            if re.search(field, name):
                return replace(column, unit=unit)
    return column
