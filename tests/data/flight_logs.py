"""Flights as logs of robots, each written by its format's own library."""

import struct
from pathlib import Path

import numpy as np
import pytest

from tests.systems.small_copter import Flight

LATE = 3_000_000  # of the rotors' topic behind the odometry [ns]
START = 1_700_000_000_000_000_000  # [ns]


def write_rosbag(folder: Path, flight: Flight, *, as_mcap: bool = False) -> None:
    """A ROS 2 bag with nav_msgs/Odometry and the rotors' speeds as a JointState."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = rosbag2.StoragePlugin.MCAP if as_mcap else rosbag2.StoragePlugin.SQLITE3
    types = store.types
    with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as writer:
        names = {"/odom": "nav_msgs/msg/Odometry", "/rotor_commands": "sensor_msgs/msg/JointState"}
        names["/battery"] = "std_msgs/msg/Float64"
        lines = {t: writer.add_connection(t, n, typestore=store) for t, n in names.items()}

        def send(topic: str, stamp: int, message: object) -> None:
            writer.write(lines[topic], stamp, store.serialize_cdr(message, names[topic]))

        for k, t in enumerate(flight.time):
            stamp = START + round(1e9 * float(t))
            header = _header(types, stamp)
            send("/odom", stamp, _odometry(types, header, flight, k))
            asked = types["sensor_msgs/msg/JointState"](
                header=_header(types, stamp + LATE),
                name=["n1", "n2", "n3", "n4"],
                position=np.zeros(0),
                velocity=flight.speeds[k],
                effort=np.zeros(0),
            )
            send("/rotor_commands", stamp + LATE, asked)
            if k % 10 == 0:
                send("/battery", stamp, types["std_msgs/msg/Float64"](data=15.0 - 0.01 * k))


def _header(types: dict, stamp: int) -> object:
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return types["std_msgs/msg/Header"](stamp=time, frame_id="world")


def _odometry(types: dict, header: object, flight: Flight, k: int) -> object:
    """Pose in the world; velocities in the body, as REP 147 has them."""
    point, vector = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Vector3"]
    w, x, y, z = (float(v) for v in flight.quaternion[k])
    turn = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    velocity = flight.rotation[k].T @ flight.velocity[k]
    pose = types["geometry_msgs/msg/Pose"](
        position=point(*(float(v) for v in flight.position[k])), orientation=turn
    )
    twist = types["geometry_msgs/msg/Twist"](
        linear=vector(*(float(v) for v in velocity)),
        angular=vector(*(float(v) for v in flight.rates[k])),
    )
    none = np.zeros(36)
    return types["nav_msgs/msg/Odometry"](
        header=header,
        child_frame_id="body",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=none),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=none),
    )


def write_ulog(path: Path, flight: Flight) -> None:
    """A PX4 log with its topics' names and fields; written again by pyulog itself."""
    pyulog = pytest.importorskip("pyulog")
    swap = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # ENU to NED
    turned = swap @ flight.rotation @ np.diag([1.0, -1.0, -1.0])
    from scipy.spatial.transform import Rotation

    q = np.roll(Rotation.from_matrix(turned).as_quat(), 1, axis=-1)
    place, speed = flight.position @ swap.T, flight.velocity @ swap.T
    rates = flight.rates * [1.0, -1.0, -1.0]
    topics = {
        "vehicle_local_position": ("float x;float y;float z;float vx;float vy;float vz;",
                                   np.column_stack([place, speed])),
        "vehicle_attitude": ("float[4] q;", q),
        "vehicle_angular_velocity": ("float[3] xyz;", rates),
        "actuator_motors": ("float[4] control;", flight.speeds / 1200.0),
    }  # fmt: skip
    start = 5_000_000

    def message(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start) + message("B", bytes(40))
    for name, (fields, _) in topics.items():
        out += message("F", f"{name}:uint64_t timestamp;{fields}".encode())
    for i, name in enumerate(topics):
        out += message("A", struct.pack("<BH", 0, i) + name.encode())
    for k, t in enumerate(flight.time):
        for i, (_, values) in enumerate(topics.values()):
            stamp = start + round(1e6 * float(t)) + 500 * i
            row = struct.pack(f"<HQ{values.shape[1]}f", i, stamp, *values[k])
            out += message("D", row)
    path.write_bytes(out)
    log = pyulog.ULog(str(path))
    if hasattr(log, "write_ulog"):
        log.write_ulog(str(path))
