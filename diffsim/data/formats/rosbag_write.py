"""Tables as ROS 2 bags (SQLite), by rosbags: a topic whose message type the bag itself defines."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.optional import optional
from diffsim.data.formats.messages import CLOCKS, Field, Record, fields_of, stamps

TOPIC = "/recording"
PACKAGE = "diffsim_msgs"
_TOPIC = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_TYPES = {
    "f8": "float64", "f4": "float32", "b1": "bool",
    **{f"{sign}{size}": f"{'u' if sign == 'u' else ''}int{8 * size}"
       for sign in "iu" for size in (1, 2, 4, 8)},
}  # fmt: skip


def write(path: Path, columns: Mapping[str, NDArray[Any]], topic: str = "") -> Path:
    """Write a table as a topic with a message per row.

    Args:
        path: ``FOLDER/NAME.db3`` is written as ``FOLDER/NAME/NAME.db3``, with its metadata beside.
        columns: Columns by name, each (num_rows,); ``time_s``, ``t`` or ``time`` [s] is the clock,
            to a nanosecond, and ``time_s`` is written as that clock alone.
        topic: What it is called; empty: "/recording".

    Returns:
        The file that was written.

    Raises:
        FileExistsError: the bag's folder is there, and holds something else.
        ImportError: rosbags is not installed.
        ValueError: no clock, or a name that the format does not have.
    """
    rosbag2 = optional("rosbags.rosbag2", purpose="a ROS 2 bag")
    typesys = optional("rosbags.typesys", purpose="a ROS 2 bag")
    topic = topic or TOPIC
    if not _TOPIC.fullmatch(topic):
        raise ValueError(f"topic {topic!r}: ROS takes words of letters, digits and _, divided by /")
    ticks = stamps(columns, 10**9, "a ROS 2 bag")
    held = {name: values for name, values in columns.items() if name != CLOCKS[0]}
    if not held:
        raise ValueError("a ROS 2 bag needs a column beside the clock")
    fields = fields_of(held, word)
    kind = f"{PACKAGE}/msg/Recording"
    types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in _definitions(kind, fields, held):
        types.register(typesys.get_types_from_msg(text, name))
    folder = path.with_suffix("")
    _refuse_others(folder, path.name)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as beside:
        made = Path(beside) / folder.name
        with rosbag2.Writer(made, version=9) as bag:
            line = bag.add_connection(topic, kind, typestore=types)
            for row, tick in enumerate(ticks.tolist()):
                message = _message(types.types, kind, fields, held, row)
                bag.write(line, tick, types.serialize_cdr(message, kind))
        if folder.exists():
            shutil.rmtree(folder)
        made.replace(folder)
    return folder / path.name


def word(name: str) -> str:
    """A name as ROS 2 has fields: lower case, digits, single underscores, a letter first."""
    spelled = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return spelled if spelled[:1].isalpha() else f"x{spelled}"


def _refuse_others(folder: Path, name: str) -> None:
    if folder.exists() and (
        not folder.is_dir() or {p.name for p in folder.iterdir()} - {name, "metadata.yaml"}
    ):
        raise FileExistsError(
            f"{folder}: is there and is not this bag; a ROS 2 bag is a folder of its own: name "
            "another file, or move that one"
        )


def _type_of(values: NDArray[Any]) -> str:
    if values.dtype.kind in "US":
        return "string"
    kind = f"{values.dtype.kind}{values.dtype.itemsize}"
    if kind not in _TYPES:
        raise ValueError(f"ROS messages hold numbers and text, got {values.dtype}")
    return _TYPES[kind]


def _definitions(
    kind: str, fields: Sequence[Field | Record], columns: Mapping[str, NDArray[Any]]
) -> Iterator[tuple[str, str]]:
    """Message types by name, those inside of others first."""
    lines = []
    for field in fields:
        if isinstance(field, Record):
            inner = _kind_inside(kind, field)
            yield from _definitions(inner, field.fields, columns)
            lines.append(f"{inner} {field.name}")
        else:
            size = f"[{len(field.columns)}]" if field.is_list else ""
            lines.append(f"{_type_of(columns[field.columns[0]])}{size} {field.name}")
    yield kind, "\n".join(lines)


def _kind_inside(kind: str, field: Record) -> str:
    return kind + "".join(part.capitalize() for part in field.name.split("_"))


def _message(
    types: Mapping[str, Any],
    kind: str,
    fields: Sequence[Field | Record],
    columns: Mapping[str, NDArray[Any]],
    row: int,
) -> Any:
    content: dict[str, Any] = {}
    for field in fields:
        if isinstance(field, Record):
            inner = _kind_inside(kind, field)
            content[field.name] = _message(types, inner, field.fields, columns, row)
            continue
        cells = [columns[name][row] for name in field.columns]
        if _type_of(columns[field.columns[0]]) == "string":
            texts = [c.decode() if isinstance(c, bytes) else str(c) for c in cells]
            content[field.name] = texts if field.is_list else texts[0]
        else:
            content[field.name] = np.array(cells) if field.is_list else cells[0].item()
    return types[kind](**content)


__all__ = ["TOPIC", "word", "write"]
