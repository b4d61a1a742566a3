"""Times of day and dates as loggers write them, in seconds; of no time zone but the stated one."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import datetime, timedelta, timezone
from re import Match

_STAMP = re.compile(
    r"(?:(?P<a>\d{1,4})(?P<mark>[./-])(?P<b>\d{1,2})(?P=mark)(?P<c>\d{4}|\d{1,2})(?:[T,; ]\s*|$))?"
    r"(?:(?P<h>\d{1,2}):(?P<min>\d\d)(?::(?P<s>\d\d)(?:[.,](?P<part>\d+))?)?\s*(?P<half>[AP]M)?)?"
    r"\s*(?:Z|(?P<zone>[+-]\d\d)(?::?(?P<zone_min>\d\d))?)?",
    re.IGNORECASE,
)
#: Without colons: 20240501T123005.25Z, 2024-05-01_12-30-05.
_BARE = re.compile(
    r"(\d{4})([-_]?)(\d\d)\2(\d\d)[T_ -](\d\d)([-_.]?)(\d\d)(?:\6(\d\d))?"
    r"((?:[.,]\d+)?\s*(?:Z|[+-]\d\d.*)?)",
    re.IGNORECASE,
)
#: What MATLAB writes of a timetable whose times are durations
_DURATION = re.compile(r"([-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?) (sec|min|hr|days?)", re.IGNORECASE)
_SECONDS = {"sec": 1.0, "min": 60.0, "hr": 3600.0, "day": 86400.0, "days": 86400.0}
_FIRST_CELLS = 3  # of which one says that these are durations
_EXPECTED = "expected 12:30:05.25, 2024-05-01 12:30:05.25 or 01.05.2024 12:30:05.25"


def seconds_of_stamps(cells: Sequence[str]) -> list[float]:
    """Seconds since midnight, or since 1970 where a date is written, or of durations [s].

    Durations are written 0.02 sec.

    Dates are written 2024-05-01, 20240501T123005, 01.05.2024 or, with the month first where a day
    of any cell says so, 5/13/2024 and 5-13-2024. A clock without a zone is taken as UTC, so that
    no machine's own zone moves it.

    Raises:
        ValueError: a cell is no time, or nothing says whether the day or the month stands first;
            the exception's second argument is the index of the cell.
    """
    if any(map(_DURATION.fullmatch, filter(None, cells[:_FIRST_CELLS]))):
        return [_duration(cell, k) for k, cell in enumerate(cells)]
    found = [_STAMP.fullmatch(_with_colons(cell)) for cell in cells]
    for k, (one, cell) in enumerate(zip(found, cells, strict=True)):
        if one is None or not cell or (one["h"] is None and one["a"] is None):
            raise ValueError(f"{cell!r} is no time; {_EXPECTED}", k)
    stamps = [one for one in found if one is not None]
    day_first = _is_day_first(stamps)
    out = []
    for k, one in enumerate(stamps):
        try:
            out.append(_seconds(one, day_first))
        except ValueError:
            raise ValueError(f"{cells[k]!r} is no time; {_EXPECTED}", k) from None
    return out


def _duration(cell: str, place: int) -> float:
    """Seconds of a duration; NaN of an empty cell, and of one that says so."""
    matched = _DURATION.fullmatch(cell)
    if matched is None and cell and cell.lower() not in ("nan", "nan sec"):
        raise ValueError(f"{cell!r} is no duration; expected 0.02 sec", place)
    return math.nan if matched is None else float(matched[1]) * _SECONDS[matched[2].lower()]


def _with_colons(cell: str) -> str:
    """A stamp with the marks that ISO 8601 lets one leave out."""
    bare = _BARE.fullmatch(cell)
    if bare is None:
        return cell
    year, _, month, day, hour, _, minute, second, rest = bare.groups()
    return f"{year}-{month}-{day} {hour}:{minute}:{second or '00'}{rest}"


def _is_day_first(stamps: Sequence[Match[str]]) -> bool:
    """Whether 5/6/2024 or 5-6-2024 is in June; it must be known where such dates differ."""
    dates = {(int(s["a"]), int(s["b"])) for s in stamps if _has_two_orders(s)}
    if any(first > 12 for first, _ in dates):
        return True
    if any(second > 12 for _, second in dates):
        return False
    if len(dates) > 1 and any(first != second for first, second in dates):
        k = next(
            k for k, s in enumerate(stamps) if _has_two_orders(s) and int(s["a"]) != int(s["b"])
        )
        raise ValueError(
            f"{stamps[k][0]!r} may have the day or the month first, and no other row tells; write "
            "dates as 2024-05-01",
            k,
        )
    return True


def _has_two_orders(stamp: Match[str]) -> bool:
    """Whether its day or its month may stand first; with points the day does."""
    return stamp["mark"] in ("/", "-") and len(stamp["a"]) < 3


def _seconds(stamp: Match[str], day_first: bool) -> float:
    hour, minute, second = (int(stamp[name] or 0) for name in ("h", "min", "s"))
    if stamp["half"]:
        if not 1 <= hour <= 12:
            raise ValueError
        hour = hour % 12 + 12 * (stamp["half"].upper() == "PM")
    part = float(f"0.{stamp['part'] or 0}")
    if stamp["a"] is None:
        if hour > 23 or minute > 59 or second > 59:
            raise ValueError
        return 3600.0 * hour + 60.0 * minute + second + part
    first, second_number, last = (int(stamp[name]) for name in ("a", "b", "c"))
    if len(stamp["a"]) == 4:
        year, month, day = first, second_number, last
    else:
        if len(stamp["c"]) == 1:
            raise ValueError
        year = last if len(stamp["c"]) == 4 else 2000 + last
        day, month = (first, second_number) if day_first else (second_number, first)
    zone = timedelta(hours=int(stamp["zone"] or 0))
    zone += timedelta(minutes=int(f"{(stamp['zone'] or '+')[0]}{stamp['zone_min'] or 0}"))
    at = datetime(year, month, day, hour, minute, second, tzinfo=timezone(zone))
    return at.timestamp() + part
