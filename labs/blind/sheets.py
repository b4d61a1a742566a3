"""What data sheets should have said: a finding that holds the truth is neither cause nor alarm.

Laboratories draw their base parameters, and a draw three standard deviations off its data sheet is
what such an answer is for. Models call some parameters otherwise than laboratories do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from labs.blind.sealed import Bench

#: Factors on what was designed, by the laboratory's name.
GAINS = {
    "mass_gain": "mass",
    "thrust_gain": "thrust_gain",
    "inertia_gain": "inertia_scale",
    "torque_gain": "torque_ratio",
}
#: Components of a placement or a zero: the laboratory's name, and what is added to it.
PLACES = {
    "attitude_offset_": ("camera_to_body_rad", 0.0),
    "accelerometer_offset_": ("accelerometer_offset_m_s2", 0.0),
    "flow_gain_": ("meter_gain", 1.0),
    "pressure_zero_": ("pressure_zero_Pa", 0.0),
    "place_": ("marker_place_m", 0.0),
}
COMPONENTS = {"x": 0, "y": 1, "z": 2, "1": 0, "2": 1, "3": 2, "tip_y_m": 0, "mid_y_m": 1}


def true_value(bench: Bench, truth: Mapping[str, Any], name: str) -> float | None:
    """True value of a model's base parameter; None where the laboratory does not state it.

    Args:
        bench: Laboratory that made the case.
        truth: What it drew, as sealed.
        name: Of the parameter.
    """
    drawn, known = truth.get("base", {}), getattr(bench.lab(), "base", {})
    if name in GAINS and GAINS[name] in drawn:
        return float(drawn[GAINS[name]] / known[GAINS[name]].value)
    if name in drawn:
        return float(drawn[name])
    for stem, (place, added) in PLACES.items():
        k = COMPONENTS.get(name.removeprefix(stem)) if name.startswith(stem) else None
        if k is not None and place in truth.get("nuisances", {}):
            return added + float(truth["nuisances"][place][k])
    return None


def held_sheets(
    bench: Bench, truth: Mapping[str, Any], said: Mapping[str, Sequence[float]]
) -> dict[str, dict[str, Any]]:
    """Findings on data sheets beside the truth, and whether their intervals hold it.

    Args:
        bench: Laboratory that made the case.
        truth: What it drew, as sealed.
        said: Value and both ends of the 90 % interval of each finding.
    """
    out: dict[str, dict[str, Any]] = {}
    for name, (value, low, high) in said.items():
        true = true_value(bench, truth, name)
        inside = true is not None and low <= true <= high
        out[name] = {"true": true, "found": value, "low": low, "high": high, "inside": inside}
    return out
