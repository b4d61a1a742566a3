"""Logs of vehicles and robots: PX4 ULog, rosbags (ROS 1 and 2), MCAP; a topic is a table.

Every table has ``time_s``, seconds since the log began, so that topics share a clock.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.optional import optional
from diffsim.data.formats.columns import Columns, of_messages

TIME = "time_s"


def ulog_parts(path: Path) -> list[str]:
    """Topics of a ULog; further instances are ``topic.1``, ``topic.2``."""
    return list(_topics(path))


def read_ulog(path: Path, part: str) -> Columns:
    """Columns of a topic; ``timestamp`` is in microseconds."""
    log, topic = _ulog(path), _topics(path)[part]
    start = min(log.start_timestamp, int(topic.data["timestamp"][0]))
    seconds = (topic.data["timestamp"].astype(np.int64) - start) / 1e6
    return {TIME: seconds, **topic.data}


def mcap_parts(path: Path) -> list[str]:
    """Topics of an MCAP file that hold messages."""
    with path.open("rb") as file:
        summary = _mcap().make_reader(file).get_summary()
        if summary is None or summary.statistics is None:
            raise ValueError("no summary section; `mcap recover` writes one")
        counts = summary.statistics.channel_message_counts
        return sorted({c.topic for c in summary.channels.values() if counts.get(c.id)})


def read_mcap(path: Path, part: str) -> Columns:
    """Columns of a topic: JSON messages, and ROS 2 ones where ``mcap-ros2-support`` is there."""
    times, messages = [], []
    with path.open("rb") as file:
        reader = _mcap().make_reader(file)
        start = reader.get_summary().statistics.message_start_time
        for schema, channel, message in reader.iter_messages(topics=[part]):
            times.append((message.log_time - start) / 1e9)
            messages.append(_decode_message(schema, channel, message))
    return {TIME: np.array(times), **of_messages(messages)}


def rosbag_parts(path: Path) -> list[str]:
    """Topics of a rosbag."""
    with _rosbag(path) as bag:
        return sorted(c.topic for c in bag.connections if c.msgcount)


def read_rosbag(path: Path, part: str) -> Columns:
    """Columns of a topic."""
    times, messages = [], []
    with _rosbag(path) as bag:
        wanted = [c for c in bag.connections if c.topic == part]
        for connection, stamp, raw in bag.messages(connections=wanted):
            times.append((stamp - bag.start_time) / 1e9)
            messages.append(_flatten_message(bag.deserialize(raw, connection.msgtype)))
    return {TIME: np.array(times), **of_messages(messages)}


def _ulog(path: Path) -> Any:
    return _read_once(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)  # a log is read whole, and has a hundred topics
def _read_once(path: Path, changed_ns: int) -> Any:
    return optional("pyulog", purpose="a PX4 log").ULog(str(path))


def _topics(path: Path) -> dict[str, Any]:
    return {
        topic.name if topic.multi_id == 0 else f"{topic.name}.{topic.multi_id}": topic
        for topic in _ulog(path).data_list
    }


def _mcap() -> Any:
    return optional("mcap.reader", purpose="an MCAP file")


def _decode_message(schema: Any, channel: Any, message: Any) -> Any:
    if channel.message_encoding == "json":
        content = json.loads(message.data)
        return content if isinstance(content, dict) else {"value": content}
    if channel.message_encoding == "cdr":
        factory = optional("mcap_ros2.decoder", purpose=f"topic {channel.topic}").DecoderFactory()
        return _flatten_message(factory.decoder_for("cdr", schema)(message.data))
    raise ValueError(
        f"topic {channel.topic} is encoded as {channel.message_encoding!r}; json and cdr (ROS 2) "
        "are read"
    )


def _rosbag(path: Path) -> Any:
    highlevel = optional("rosbags.highlevel", purpose="a rosbag")
    store = optional("rosbags.typesys", purpose="a rosbag")
    # a ROS 2 bag is a folder: the file lies in it, beside metadata.yaml
    where = path.parent if path.suffix == ".db3" else path
    types = store.get_typestore(store.Stores.ROS2_HUMBLE)
    return highlevel.AnyReader([where], default_typestore=types)


def _flatten_message(message: Any) -> Any:
    """Fields of a decoded message, nested ones too."""
    names = getattr(message, "__slots__", None) or getattr(message, "__dataclass_fields__", None)
    if names is None or isinstance(message, (str, bytes, int, float)):
        if isinstance(message, (list, tuple)):
            return [_flatten_message(m) for m in message]
        return message
    return {
        name.lstrip("_"): _flatten_message(getattr(message, name))
        for name in names
        if name[:2] != "__"
    }
