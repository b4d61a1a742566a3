"""Logs of vehicles and robots: PX4 ULog, rosbags (ROS 1 and 2), MCAP; a topic is a table.

Every table has ``time_s``, seconds since the log began, so that topics share a clock. What a log
lost, as when its battery was pulled, is said; what its own checksums refute is refused.
"""

from __future__ import annotations

import io
import json
import zlib
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from diffsim.core.optional import optional
from diffsim.data.formats.columns import (
    Columns,
    fields_left_out,
    most_unpacked,
    of_messages,
    require_room,
)

TIME = "time_s"
_ULOG_HEADER = 16  # bytes before the first record
_ULOG_KINDS = b"BFIMPQARDLCSO"  # the format's letters of records
_ULOG_FIRST = b"FB"  # of definitions: they come before the first sample
_ULOG_LEVELS = b"01234567"  # of a logged text
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_MCAP_CHUNK = 6  # the format's number of such records
_MCAP_PIECE = 1 << 20  # bytes that are unpacked at once, to count them
_MCAP_FOOTER = 8 + 8 + 4 + 8  # bytes at the end: two offsets, a checksum, the magic


def ulog_parts(path: Path) -> list[str]:
    """Topics of a ULog; further instances are ``topic.1``, ``topic.2``."""
    return list(_topics(path))


def read_ulog(path: Path, part: str) -> Columns:
    """Columns of a topic; ``timestamp`` is in microseconds."""
    log, topic = _ulog(path), _topics(path)[part]
    start = min(log.start_timestamp, int(topic.data["timestamp"][0]))
    seconds = (topic.data["timestamp"].astype(np.int64) - start) / 1e6
    return {TIME: seconds, **topic.data}


def ulog_lost(path: Path, part: str) -> list[str]:
    """What a ULog lacks, whatever the topic: records that are damaged, cut off or dropped."""
    log, lost = _ulog(path), []
    unknown, lacking, samples = _walk_records(path)
    unread = samples - sum(len(next(iter(t.data.values()), ())) for t in log.data_list)
    if log.file_corruption or unknown or unread > 0:
        lost.append("damaged: records that cannot be read are left out")
    lost += [
        f"topic {topic.name}: has no timestamp, so its definition is damaged"
        for topic in log.data_list
        if "timestamp" not in topic.data
    ]
    if lacking and not log.has_data_appended:
        last = (log.last_timestamp - log.start_timestamp) / 1e6
        lost.append(
            f"ends inside of a record, {lacking} bytes before its end; the last sample is of "
            f"{last:.3f} s, what came after is lost (was the battery pulled?)"
        )
    if log.dropouts:
        total = sum(dropout.duration for dropout in log.dropouts) / 1e3
        lost.append(f"the logger dropped {total:.3f} s of samples, {len(log.dropouts)} times")
    return lost


def _walk_records(path: Path) -> tuple[int, int, int]:
    """Records of no known kind, how many bytes the last one lacks, and whole samples.

    A record states its size in two bytes and its kind in one; pyulog skips others in silence. A
    flipped bit may make a sample a definition, or a text of a level that there is not.
    """
    size, at, unknown, samples = path.stat().st_size, _ULOG_HEADER, 0, 0
    with path.open("rb") as file:
        while at < size:
            file.seek(at)
            head = file.read(4)
            kind, begin = head[2:3], head[3:]
            is_late = kind != b"" and kind in _ULOG_FIRST and samples > 0
            is_odd = kind == b"L" and begin not in _ULOG_LEVELS
            unknown += kind not in _ULOG_KINDS or is_late or is_odd
            at += 3 + int.from_bytes(head[:2], "little")
            samples += kind == b"D" and at <= size
    return unknown, max(at - size, 0), samples


def mcap_parts(path: Path) -> list[str]:
    """Topics of an MCAP file that hold messages."""
    with path.open("rb") as file:
        summary = _summary(path, file)
        counts = summary.statistics.channel_message_counts
        return sorted({c.topic for c in summary.channels.values() if counts.get(c.id)})


def read_mcap(path: Path, part: str) -> Columns:
    """Columns of a topic: JSON messages, and ROS 2 ones where ``mcap-ros2-support`` is there."""
    times: list[float] = []
    with path.open("rb") as file:
        summary = _summary(path, file)
        start = summary.statistics.message_start_time
        counts: dict[int, int] = {}
        # without chunks the reader that seeks would check nothing
        kind = _mcap().SeekingReader if summary.chunk_indexes else _mcap().NonSeekingReader
        file.seek(0)

        def messages() -> Iterator[Any]:
            reader = kind(file, validate_crcs=True)
            for schema, channel, message in reader.iter_messages(topics=[part]):
                times.append((message.log_time - start) / 1e9)
                counts[channel.id] = counts.get(channel.id, 0) + 1
                yield _decode_message(schema, channel, message)

        columns = of_messages(messages())
    stated = summary.statistics.channel_message_counts
    if any(stated.get(channel, 0) != count for channel, count in counts.items()):
        raise ValueError(
            f"{part} has {sum(counts.values())} messages, its summary says another number; "
            "`mcap recover` writes what can be read"
        )
    return {TIME: np.array(times), **columns}


def _summary(path: Path, file: BinaryIO) -> Any:
    """The summary of an MCAP file, held against its checksum: clocks begin by what it says."""
    file.seek(-min(_MCAP_FOOTER, file.seek(0, io.SEEK_END)), io.SEEK_END)
    footer = file.read()
    if not footer.endswith(_MCAP_MAGIC):
        raise ValueError("it is cut off; `mcap recover` writes what can be read")
    file.seek(int.from_bytes(footer[:8], "little"))
    content = file.read()[: -(_MCAP_FOOTER - 16)]  # up to the checksum
    stated = int.from_bytes(footer[16:20], "little")
    if stated and zlib.crc32(content) != stated:
        raise ValueError("its summary is damaged (checksum); `mcap recover` writes another")
    file.seek(0)
    summary = _mcap().make_reader(file).get_summary()
    if summary is None or summary.statistics is None:
        raise ValueError("no summary section; `mcap recover` writes one")
    named = tuple(index.chunk_start_offset for index in summary.chunk_indexes)
    _require_small_chunks(path, (now := path.stat()).st_size, now.st_mtime_ns, named)
    return summary


@lru_cache(maxsize=1)  # a recording has many topics
def _require_small_chunks(path: Path, size: int, changed_ns: int, named: tuple[int, ...]) -> None:
    """Refuse chunks that unpack to more than is read, before one is unpacked.

    Args:
        size, changed_ns: Its bytes, and when it was changed.
        named: Where its index says that chunks begin.
    """
    with path.open("rb") as file:
        places = {*named, *_mcap_chunks(file)}
        require_room(path, sum(_bytes_in_chunk(file, at, most_unpacked(path)) for at in places))


def _mcap_chunks(file: BinaryIO) -> Iterator[int]:
    """Where the records of chunks begin."""
    at = len(_MCAP_MAGIC)
    while len(head := _read_at(file, at, 9)) == 9:
        if head[0] == _MCAP_CHUNK:
            yield at
        at += 9 + int.from_bytes(head[1:], "little")


def _bytes_in_chunk(file: BinaryIO, at: int, most: int) -> int:
    """What a chunk unpacks to, at least; its own statement may be wrong, zstd's is held to."""
    head = _read_at(file, at, 9 + 28 + 4)
    stated, length = int.from_bytes(head[25:33], "little"), int.from_bytes(head[37:41], "little")
    name = file.read(min(length, _MCAP_FOOTER))
    data = file.read(min(int.from_bytes(file.read(8), "little"), most))
    if name == b"zstd":
        size = int(optional("zstandard", purpose="an MCAP file").frame_content_size(data))
        return stated if size < 0 else size
    if name == b"lz4":
        unpacked = optional("lz4.frame", purpose="an MCAP file").LZ4FrameDecompressor()
        size = len(unpacked.decompress(data, _MCAP_PIECE))
        while not (unpacked.eof or unpacked.needs_input or size > most):
            size += len(unpacked.decompress(b"", _MCAP_PIECE))
        return size
    return len(data)


def _read_at(file: BinaryIO, at: int, size: int) -> bytes:
    if at >= 1 << 63:
        return b""
    file.seek(at)
    return file.read(size)


def mcap_left_out(path: Path, part: str) -> list[str]:
    """Fields of a topic's first message that are no columns, such as a picture."""
    with path.open("rb") as file:
        _summary(path, file)
        file.seek(0)
        for message in _mcap().make_reader(file).iter_messages(topics=[part]):
            return list(fields_left_out(_decode_message(*message)))
    return []


def rosbag_parts(path: Path) -> list[str]:
    """Topics of a rosbag."""
    with _rosbag(path) as bag:
        return sorted(c.topic for c in bag.connections if c.msgcount)


def read_rosbag(path: Path, part: str) -> Columns:
    """Columns of a topic."""
    times: list[float] = []
    with _rosbag(path) as bag:

        def messages() -> Iterator[Any]:
            wanted = [c for c in bag.connections if c.topic == part]
            for connection, stamp, raw in bag.messages(connections=wanted):
                times.append((stamp - bag.start_time) / 1e9)
                yield _flatten_message(bag.deserialize(raw, connection.msgtype))

        columns = of_messages(messages())
    return {TIME: np.array(times), **columns}


def rosbag_left_out(path: Path, part: str) -> list[str]:
    """Fields of a topic's first message that are no columns, such as a picture."""
    with _rosbag(path) as bag:
        for connection, _, raw in bag.messages(
            connections=[c for c in bag.connections if c.topic == part]
        ):
            message = _flatten_message(bag.deserialize(raw, connection.msgtype))
            return list(fields_left_out(message))
    return []


def _ulog(path: Path) -> Any:
    return _read_once(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)  # a log is read whole, and has a hundred topics
def _read_once(path: Path, changed_ns: int) -> Any:
    pyulog = optional("pyulog", purpose="a PX4 log")
    try:
        with redirect_stdout(io.StringIO()):  # what it prints of damage, ``ulog_lost`` says
            return pyulog.ULog(str(path))
    except OSError as error:
        if error.filename is not None:
            raise
        raise ValueError("damaged: a record leads to a place before the file begins") from error


def _topics(path: Path) -> dict[str, Any]:
    return {
        topic.name if topic.multi_id == 0 else f"{topic.name}.{topic.multi_id}": topic
        for topic in _ulog(path).data_list
        if "timestamp" in topic.data  # else its definition is damaged, as ``ulog_lost`` says
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
    if path.suffix == ".db3" and not (path.parent / "metadata.yaml").is_file():
        raise ValueError(
            "metadata.yaml of its bag is not beside it; `ros2 bag reindex FOLDER -s sqlite3` "
            "writes it, a folder for each bag"
        )
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
