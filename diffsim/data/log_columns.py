"""What columns of robots' logs are by convention: units, what was commanded, what nobody needs.

ROS messages are in SI units (REP 103), PX4's topics in those of their definitions
(https://docs.px4.io/main/en/msg_docs/). Headers of logs state no units.
"""

from __future__ import annotations

import re
from dataclasses import replace

from diffsim.data.names import is_asked
from diffsim.data.table_guess import Column, column_of

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


def log_column(name: str, part: str) -> Column | None:
    """A column of a topic; None where nobody needs it, such as a covariance.

    Args:
        name: Field as the log has it, such as "pose.position.x" or "q[0]".
        part: Topic of the log that the column is in.
    """
    topic, column = part.rpartition("/")[2].partition(".")[0], column_of(name)
    if _UNUSED.search(name):
        return None
    column = replace(column, is_asked=is_asked(topic))
    if topic in _PX4 and name not in ("time_s", "timestamp"):
        for field, unit in _PX4[topic]:
            if re.fullmatch(field, name):
                return replace(column, unit=unit)
        return None
    if column.unit is None:
        for field, unit in _ROS:
            if re.search(field, name):
                return replace(column, unit=unit)
    return column
