"""The glossary names what exists: its names stand in the rooms of their rows."""

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

import diffsim

FOLDER = Path(diffsim.__file__).parent
PAGE = Path(__file__).parents[2] / "docs" / "glossary.md"
BESIDE = ("examples", "labs")
# what "where" says instead of a room, where a term is not of one room
NO_ROOM = frozenset(("every layer", "every solver", "everywhere", "tests"))
NOT_CODE = re.compile(r'"""(?s:.*?)"""|#.*')  # docstrings and comments
WORD = re.compile(r"[^\W\d]\w*")


class Row(NamedTuple):
    term: str
    names: tuple[str, ...]  # what stands in backticks as name in code
    rooms: tuple[str, ...]  # none: the term is not of one room


def rows_of(text: str) -> list[Row]:
    """Rows of all tables of the glossary."""
    rows, heads = [], []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if not line.startswith("|"):
            heads = []
        elif not heads:
            heads = cells
        elif not set(line) <= set("|-"):
            by_head = dict(zip(heads, cells, strict=True))
            code = by_head.get("symbol, name in code", by_head.get("name in code", ""))
            where = by_head["where"]
            rooms = [] if where in NO_ROOM else [room.strip("` ") for room in where.split(",")]
            rows.append(Row(by_head["term"], tuple(re.findall("`([^`]+)`", code)), tuple(rooms)))
    return rows


@cache
def words_in(room: str) -> frozenset[str]:
    """Identifiers and words of strings of a room; "" is all rooms; a missing room has none.

    A room may stand beside the package, as ``examples.applications`` does.
    """
    parts = room.split(".")
    place = FOLDER.parent.joinpath(*parts) if parts[0] in BESIDE else FOLDER.joinpath(*parts)
    files = sorted(place.rglob("*.py")) or [place.with_suffix(".py")]
    text = "\n".join(f.read_text(encoding="utf-8") for f in files if f.is_file())
    return frozenset(WORD.findall(NOT_CODE.sub("", text)))


def is_known(word: str, known: frozenset[str]) -> bool:
    """Whether a word is among those of the code; one after a star is the end of one."""
    return word in known or any(k.endswith(word[1:]) for k in known if word[0] == "*")


def wrong_in(row: Row) -> list[str]:
    """What a row says that is not so."""
    missing = [f"no room {room}" for room in row.rooms if not words_in(room)]
    known = frozenset().union(*(words_in(room) for room in row.rooms or ("",)))
    for name in row.names:
        words = re.findall(r"\*?[^\W\d]\w*", name)
        missing += [f"no {w} in {name}" for w in words if not is_known(w, known | {"diffsim"})]
    return missing


ROWS = rows_of(PAGE.read_text(encoding="utf-8"))


def test_every_name_and_every_room_of_the_glossary_exists():
    found = {row.term: wrong for row in ROWS if (wrong := wrong_in(row))}
    assert found == {}


def test_every_term_stands_once():
    terms = [row.term for row in ROWS]
    assert sorted(terms) == sorted(set(terms))


@pytest.mark.parametrize(
    "row",
    [
        Row("material", ("no_such_name",), ("soft",)),
        Row("material", ("Material", "no_such_name"), ("soft", "mesh")),
        Row("material", ("Material",), ("no_such_room",)),
        Row("material", ("Material",), ("soft", "no_such_room")),
        Row("material", ("*_no_such_end",), ()),
    ],
)
def test_a_name_or_room_that_is_not_there_is_seen(row):
    assert wrong_in(row) != []
