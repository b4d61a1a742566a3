"""Metrics of a finished design."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffsim.copter.codesign.metrics import METRICS
from diffsim.copter.codesign.program import Program
from diffsim.copter.codesign.task import Point, Task
from diffsim.core.arrays import Array


def design_metrics(task: Task, program: Program, x: Array) -> dict[str, float]:
    """Relative metrics of a program's unknowns: those asked for, and those of shape and thrusts."""
    s, _, _, aux, _ = program.split(x)
    thrusts = program.hover_thrusts(x)
    shape, scales = program.shape(s), task.scales
    values = {
        "payload": float((thrusts / program.rotors.max_thrusts).max()) * scales.mass / shape.mass,
        "size": shape.size / scales.size,
        "flight_time": -shape.size / scales.size,
        "cost": shape.cost / scales.cost,
        "mass": shape.mass / scales.mass,
    }
    if task.currents is not None:
        current = task.currents.current(thrusts)
        values["current"] = float(current.sum() / scales.current)
        values["max_current"] = float(current.max() / scales.max_current)
    for name, value in aux.items():
        if name in task.weights:
            sign = -1.0 if name == "authority" else 1.0
            values[name] = sign * value
    if "response" in task.weights:
        values["response"] = float(np.sqrt(scales.response / max(aux["response"], 1e-12)))
    return {name: values[name] for name in METRICS if name in values}


def largest_weight(task: Task, point: Point) -> float:
    """Overall weight that shape, directions and spins of a point lift [N]; nan if they cannot.

    Thrusts and attitude are optimized; a demanded authority is kept.
    """
    lifting = replace(task.lifting(), scales=task.scales)
    best = np.nan
    for free in ((), ("attitude",)):
        solution, program = lifting.solve(point, free=free)
        if solution.violation < 1e-7 and solution.value > 0.0:
            best = float(np.nanmax([best, program.rotors.weight / solution.value]))
    return best
