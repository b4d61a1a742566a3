"""The quality of a record: faults that are named before any physics is asked.

Each rule looks at channels and commands as the files hold them, and says where they are wrong, by
which rows and values, and which keys of study.yaml mend it.
"""

from __future__ import annotations

from dataclasses import replace

from diffsim.core.checked import checked
from diffsim.core.memo import Memo
from diffsim.core.progress import say_stage
from diffsim.data.record.clocks import find_drift, find_gaps, find_stamps, find_unstamped
from diffsim.data.record.columns import (
    find_copies,
    find_laws,
    find_shifted,
    find_unit_changes,
    find_units,
)
from diffsim.data.record.doubled import find_doubled
from diffsim.data.record.encodings import find_codes, find_folded, find_signs, find_wraps
from diffsim.data.record.finding import Finding, RecordRule
from diffsim.data.record.shapes import (
    find_far,
    find_flat,
    find_frozen,
    find_jumps,
    find_lasting,
    find_lines,
    find_misread,
    find_repeats,
)
from diffsim.data.record.signals import Record
from diffsim.data.study import Study

RULES: tuple[RecordRule, ...] = (
    RecordRule("stamps", "stamps that cannot be right", "stamps, duplicates", find_stamps),
    RecordRule("doubled", "rows of a run that were written twice", "until_s", find_doubled),
    RecordRule("signs", "words whose sign is a bit, or was not read", "decode", find_signs),
    RecordRule("wraps", "counts and angles that wrap", "decode: {wrap}", find_wraps),
    RecordRule("codes", "numbers for nothing measured", "decode: {missing}", find_codes),
    RecordRule("shifted", "cells that stand in the next column", "until_s", find_shifted),
    RecordRule("unit_changes", "a unit that changes in a run", "columns", find_unit_changes),
    RecordRule("units", "a run or a channel in another unit", "columns, unit", find_units),
    RecordRule("far", "values far outside of all others", "decode: {valid}", find_far),
    RecordRule("gaps", "rows lost in a sweep, clocks that were set", "gaps, stamps", find_gaps),
    RecordRule("unstamped", "rows lost where rows are counted", "stamps", find_unstamped),
    RecordRule("drift", "clocks of two files that run apart", "stamps: {drift}", find_drift),
    RecordRule("copies", "columns that are copies of others", "column", find_copies),
    RecordRule("laws", "columns that a controller computed", "channels", find_laws),
    RecordRule("repeats", "readings that are repeated", "decode: {repeats}", find_repeats),
    RecordRule("lines", "rows between those that were measured", "every", find_lines),
    RecordRule("folded", "sizes without their sign", "decode: {folded}", find_folded),
    RecordRule("frozen", "a channel that stands still for a while", "missing_if", find_frozen),
    RecordRule("flat", "readings that end at a value", "ranges of the model", find_flat),
    RecordRule("lasting", "jumps that stay", "columns: {formula}", find_lasting),
    RecordRule("misread", "samples off both sides", "", find_misread),
    RecordRule("jumps", "jumps that nobody commanded", "is_measured", find_jumps),
)
"""All rules, those first that explain what later ones would see, too."""

_EXPLAINS = {
    "stamps": ("gaps", "unstamped", "drift", "lines", "lasting", "misread", "frozen", "jumps"),
    "doubled": ("lines", "repeats", "lasting", "misread", "jumps"),
    "signs": (
        "wraps",
        "far",
        "codes",
        "units",
        "lasting",
        "flat",
        "misread",
        "unit_changes",
        "laws",
    ),
    "wraps": ("far", "codes", "units", "lasting", "flat", "misread", "frozen", "folded"),
    "codes": ("far", "misread", "flat", "frozen", "units", "lasting", "unit_changes"),
    "shifted": ("unit_changes", "units", "lasting", "far", "misread", "unstamped", "flat"),
    "unit_changes": ("units", "far", "lasting", "misread", "flat", "codes"),
    "units": ("far", "lasting", "flat", "misread"),
    "far": ("misread", "units", "flat"),
    "unstamped": ("lasting", "misread"),
    "copies": ("laws", "units", "lines", "flat", "folded", "misread", "frozen"),
    "lines": ("laws", "misread", "frozen"),
    "repeats": ("laws", "misread", "frozen", "flat"),
    "laws": ("misread",),
}
"""Rules that are silent on a channel or run of which another rule has spoken."""


_KNOWN: Memo[tuple[Finding, ...]] = Memo(1)  # a command asks for the same study again


@checked
def record_findings(study: Study) -> tuple[Finding, ...]:
    """All faults of a record, those that stop first.

    Args:
        study: Study as it was read, test runs too: of these only what is no physics is looked at.
    """
    return _KNOWN(study, lambda: _find(study))


def _find(study: Study) -> tuple[Finding, ...]:
    record = Record.of(study)
    out: list[Finding] = []
    silent: set[str] = set()
    for rule in RULES:
        if rule.name in silent:
            continue
        say_stage(f"record: looking for {rule.sees}")
        found = [replace(finding, rule=rule.name) for finding in rule.find(record)]
        out += found
        if found:
            silent |= set(_EXPLAINS.get(rule.name, ()))
    return tuple(sorted(out, key=lambda finding: not finding.stops))


__all__ = ["RULES", "Finding", "RecordRule", "record_findings"]
