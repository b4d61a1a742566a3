"""Stamps as loggers of several countries write them."""

from __future__ import annotations

import os
import time

import pytest

from diffsim.data.dates import seconds_of_stamps

DAY = 86400.0


@pytest.mark.parametrize(
    ("cells", "apart"),
    [
        (("24.10.2026 23:59:58", "25.10.2026 00:00:00,5"), 2.5),
        (("24.10.26 09:12", "24.10.26 09:13"), 60.0),
        (("2026-10-24T09:12:04Z", "2026-10-24T09:12:04.25Z"), 0.25),
        (("2026-10-24 09:12:04+02:00", "2026-10-24 09:12:04+01:30"), 1800.0),
        (("2026/10/24 09:12:04", "2026/10/25 09:12:04"), DAY),
        (("12/31/2026 11:59:59 PM", "1/1/2027 12:00:01 AM"), 2.0),
        (("31/12/2026 11:59:59", "1/1/2027 11:59:59"), DAY),
        (("12-31-2026 23:59:59", "01-01-2027 00:00:01"), 2.0),
        (("5/5/2026 10:00:00", "6/6/2026 10:00:00"), 32 * DAY),  # either way the same
        (("2026-10-24 09:12:04+02", "2026-10-24 09:12:04+00"), 7200.0),
        (("5/6/2026 10:00:00", "5/6/2026 10:00:01"), 1.0),  # whichever it is, it is one day
        (("9:05:00", "9:05:00.250"), 0.25),
        (("20240501T123005", "20240501T123006"), 1.0),
        (("20240501T123005Z", "20240501T143005.250+0200"), 0.25),
        (("20240430_235959,5", "20240501_000000"), 0.5),
        (("2024-05-01_12-30-05", "2024-05-01_12-31-05.125"), 60.125),
        (("20240501 1230", "20240501 1231"), 60.0),
    ],
)
def test_the_ways_people_write_dates(cells: tuple[str, str], apart: float) -> None:
    first, second = seconds_of_stamps(cells)
    assert second - first == pytest.approx(apart, abs=1e-6)


@pytest.mark.parametrize("mark", ["/", "-"])
def test_day_or_month_first_is_not_guessed(mark: str) -> None:
    cells = [f"5{mark}6{mark}2026 23:59:00", f"6{mark}6{mark}2026 00:01:00"]
    with pytest.raises(ValueError, match=f"'{cells[0]}' may have the day or the month first"):
        seconds_of_stamps(cells)


@pytest.mark.parametrize(
    "cell",
    [
        "",
        "31.02.2026 10:00:00",
        "25:00:00",
        "13:00 PM",
        "1.2.3",
        "on",
        "20241301T000000",
        "20240501T250000",
    ],
)
def test_what_is_no_time_is_refused(cell: str) -> None:
    with pytest.raises(ValueError, match="is no time; expected") as error:
        seconds_of_stamps(["10:00:00", cell] if ":" in cell else ["24.10.2026 09:12", cell])
    assert error.value.args[1] == 1


@pytest.mark.skipif(not hasattr(time, "tzset"), reason="the zone cannot be set")
def test_the_zone_of_the_machine_moves_no_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """In Berlin 2026-10-25 has 25 hours, in a record without a zone none does."""
    before = os.environ.get("TZ")
    try:
        monkeypatch.setenv("TZ", "Europe/Berlin")
        time.tzset()
        first, second = seconds_of_stamps(["2026-10-25 00:00:00", "2026-10-25 12:00:00"])
    finally:
        monkeypatch.delenv("TZ") if before is None else monkeypatch.setenv("TZ", before)
        time.tzset()
    assert second - first == 12 * 3600.0
