"""What data sheets should have said: a finding that holds the truth is neither cause nor alarm.

Rigs draw their base parameters, and a draw three standard deviations off its data sheet is what
such an answer is for. Models call some parameters otherwise than laboratories do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from labs.virtual.common import Base

#: Factors on what was designed, by the laboratory's name.
GAINS = {
    "mass_gain": "mass",
    "thrust_gain": "thrust_gain",
    "inertia_gain": "inertia_scale",
    "torque_gain": "torque_ratio",
}
#: Components of a placement or a zero, by the laboratory's name, and what is added to each.
PLACES = {
    "camera_to_body_rad": ("attitude_offset_{}", "xyz", 0.0),
    "accelerometer_offset_m_s2": ("specific_force_offset_{}", "xyz", 0.0),
    "meter_gain": ("flow_gain_{}", "123", 1.0),
    "pressure_zero_Pa": ("pressure_zero_{}", "12", 0.0),
    "marker_place_m": ("place_{}", ("tip_y_m", "mid_y_m"), 0.0),
}


def true_base(known: Mapping[str, Base], truth: Mapping[str, Any]) -> dict[str, float]:
    """True values of a laboratory's base parameters by the names of its model.

    Args:
        known: What the experimenter believes of them.
        truth: What the laboratory drew.
    """
    drawn, places = truth.get("base", {}), truth.get("nuisances", {})
    out = {name: float(value) for name, value in drawn.items()}
    out |= {
        gain: float(drawn[name] / known[name].value)
        for gain, name in GAINS.items()
        if name in drawn and name in known
    }
    for place, (words, components, added) in PLACES.items():
        if place in places:
            values = zip(components, places[place], strict=False)
            out |= {words.format(c): added + float(v) for c, v in values}
    return out


def held_sheets(
    base: Mapping[str, float], said: Mapping[str, Sequence[float]]
) -> dict[str, dict[str, Any]]:
    """Findings on data sheets beside the truth, and whether their intervals hold it.

    Args:
        base: True values of base parameters by name.
        said: Value and both ends of the 90 % interval of each finding.
    """
    out: dict[str, dict[str, Any]] = {}
    for name, (value, low, high) in said.items():
        true = base.get(name)
        inside = true is not None and low <= true <= high
        out[name] = {"true": true, "found": value, "low": low, "high": high, "inside": inside}
    return out
