"""The answer of one gate: a check before any physics is blamed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GateResult:
    """One check before any physics is blamed.

    Attributes:
        name: Such as "time_step".
        passed: Whether.
        value: Measured, such as lambda.
        limit: What it is held against.
        note: In words.
    """

    name: str
    passed: bool
    value: float
    limit: float
    note: str = ""
