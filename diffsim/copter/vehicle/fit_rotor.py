"""Fit rotor models to bench tables.

diffsim fit-rotors [--data FOLDER] [--output FOLDER] [--figures FOLDER]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from scipy.optimize import least_squares

from diffsim.copter.vehicle.rotor import SIGNAL_HIGH, SIGNAL_LOW, RotorModel
from diffsim.copter.vehicle.rotor_table import RotorTable
from diffsim.core.arrays import Array
from diffsim.core.files import write_text_atomic

# Not in the tables. A first-order lag of 50 ms is usual for 10 to 14 inch propellers, 25 ms for
# 5 inch ones; take your own where it matters.
ASSUMED_TIME_CONSTANT = {True: 0.05, False: 0.025}  # by radius above 0.1 m
MIN_ROWS = 6


@dataclass(frozen=True, eq=False)
class CurveFit:
    """One least-squares fit."""

    values: dict[str, float]  # parameters by name
    # standard errors of the values, from the residuals; same names
    standard_errors: dict[str, float]
    x: Array  # abscissa of the rows, (num_rows,)
    y: Array  # measured, (num_rows,)
    residuals: Array  # measured less fitted, (num_rows,)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    def summary(self) -> dict[str, Any]:
        """Plain numbers for a file."""
        return {
            "values": self.values,
            "standard_errors": self.standard_errors,
            "rms": self.rms,
            "max": float(np.abs(self.residuals).max()),
            "rows": len(self.y),
        }


@dataclass(frozen=True, eq=False)
class RotorFit:
    """A model and how well it fits."""

    table: RotorTable  # the rows
    model: RotorModel
    # ``thrust`` and ``thrust_offset`` (without and with a free offset), ``torque``, ``current`` (at
    # the nominal voltage) and ``speed``
    curves: dict[str, CurveFit]
    # up against down sweep where there are both: exponents with standard errors, thrust down / up -
    # 1 at equal speed and at equal signal
    hysteresis: dict[str, float] = field(default_factory=dict)


def fit_rotor(table: RotorTable) -> RotorFit:
    """Fit thrust, torque, current and speed, each by least squares in its own unit.

    Thrust keeps its offset only if that is more than two standard errors from zero. Current is
    that at the nominal voltage: power / nominal voltage where the voltage was recorded.

    Args:
        table: A table of at least six rows in which the rotor turns.

    Raises:
        ValueError: too few rows.
    """
    rows = table.turning
    if len(rows.speed) < MIN_ROWS:
        raise ValueError(
            f"{table.name} has {len(rows.speed)} rows with speed and thrust above zero, needs "
            f"{MIN_ROWS}"
        )
    current = rows.current
    if rows.voltage is not None:
        current = current * rows.voltage / table.nominal_voltage
    curves = {
        "thrust": fit_power(rows.speed, rows.thrust, offset=False),
        "thrust_offset": fit_power(rows.speed, rows.thrust, offset=True),
        "current": fit_power(rows.thrust, current, offset=True),
        "speed": _fit_speed(rows),
    }
    if rows.torque is not None:
        curves["torque"] = _least_squares(
            {"ratio": 0.01}, rows.thrust, rows.torque, lambda p: p["ratio"] * rows.thrust
        )
    model = _model(table, curves)
    return RotorFit(table, model, curves, _hysteresis(table, model))


def fit_power(x: Array, y: Array, *, offset: bool) -> CurveFit:
    """y = coefficient x^exponent (+ offset), all free, x > 0."""
    # in units of the largest x: else coefficient and exponent are all but one parameter
    top = float(x.max())
    start = {"top": float(y.max()), "exponent": 1.5} | ({"offset": 0.0} if offset else {})
    fit = _least_squares(
        start, x, y, lambda p: p["top"] * (x / top) ** p["exponent"] + p.get("offset", 0.0)
    )
    values, errors = dict(fit.values), dict(fit.standard_errors)
    values["coefficient"] = values["top"] / top ** values["exponent"]
    errors["top_relative"] = errors["top"] / values["top"]
    return CurveFit(values, errors, fit.x, fit.y, fit.residuals)


def _fit_speed(rows: RotorTable) -> CurveFit:
    """speed = coefficient (voltage (duty - duty_offset))^exponent."""
    voltage = np.full_like(rows.speed, rows.nominal_voltage)
    voltage = voltage if rows.voltage is None else rows.voltage
    duty = (rows.signal - SIGNAL_LOW) / (SIGNAL_HIGH - SIGNAL_LOW)

    def speed(p: dict[str, float]) -> Array:
        passed = np.maximum(voltage * (duty - p["duty_offset"]), 1e-9)
        return p["coefficient"] * passed ** p["exponent"]

    start = {"duty_offset": 0.0, "coefficient": 0.1 * float(rows.speed.max()), "exponent": 0.9}
    return _least_squares(start, rows.signal, rows.speed, speed)


def _least_squares(
    start: dict[str, float], x: Array, y: Array, curve: Callable[[dict[str, float]], Array]
) -> CurveFit:
    names = list(start)
    scale = np.array([abs(v) or 0.1 for v in start.values()])

    def residuals(scaled: Array) -> Array:
        return curve(dict(zip(names, scaled * scale, strict=True))) - y

    first = np.array(list(start.values())) / scale
    solution = least_squares(residuals, first, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    if not solution.success:
        raise ValueError(f"the fit of {names} did not converge: {solution.message}")
    variance = np.sum(solution.fun**2) / (len(y) - len(names))
    covariance = variance * np.linalg.inv(solution.jac.T @ solution.jac)
    errors = np.sqrt(np.diag(covariance)) * scale
    return CurveFit(
        dict(zip(names, (float(v) for v in solution.x * scale), strict=True)),
        dict(zip(names, map(float, errors), strict=True)),
        x,
        y,
        -solution.fun,
    )


def _model(table: RotorTable, curves: dict[str, CurveFit]) -> RotorModel:
    free = curves["thrust_offset"]
    significant = abs(free.values["offset"]) > 2.0 * free.standard_errors["offset"]
    thrust = free.values if significant else curves["thrust"].values | {"offset": 0.0}
    current, speed = curves["current"].values, curves["speed"].values
    assumed = ["time_constant"] + (["nominal_voltage"] if table.voltage is None else [])
    return RotorModel(
        name=table.name,
        radius=table.radius,
        thrust_coefficient=thrust["coefficient"],
        thrust_exponent=thrust["exponent"],
        thrust_offset=thrust["offset"],
        torque_ratio=curves["torque"].values["ratio"] if "torque" in curves else None,
        max_thrust=float(table.thrust.max()),
        current_coefficient=current["coefficient"],
        current_exponent=current["exponent"],
        current_offset=current["offset"],
        nominal_voltage=table.nominal_voltage,
        duty_offset=speed["duty_offset"],
        speed_coefficient=speed["coefficient"],
        speed_exponent=speed["exponent"],
        time_constant=ASSUMED_TIME_CONSTANT[table.radius > 0.1],
        assumed=tuple(assumed),
    )


def _hysteresis(table: RotorTable, model: RotorModel) -> dict[str, float]:
    up, down = table.rows(~table.down).turning, table.rows(table.down).turning
    if min(len(up.speed), len(down.speed)) < MIN_ROWS:
        return {}
    result = {}
    for name, sweep in (("up", up), ("down", down)):
        fit = fit_power(sweep.speed, sweep.thrust, offset=False)
        result[f"exponent_{name}"] = fit.values["exponent"]
        result[f"exponent_{name}_error"] = fit.standard_errors["exponent"]

    def ratio(sweep: RotorTable) -> float:
        return float(sweep.thrust.sum() / model.thrust(torch.as_tensor(sweep.speed)).sum())

    _, of_up, of_down = np.intersect1d(up.signal, down.signal, return_indices=True)
    result["thrust_at_equal_speed"] = ratio(down) / ratio(up) - 1.0
    result["thrust_at_equal_signal"] = float(
        down.thrust[of_down].sum() / up.thrust[of_up].sum() - 1.0
    )
    return result


def write_rotor(fit: RotorFit, folder: Path) -> Path:
    """Write a model with its fit and provenance as YAML; returns the file."""
    model = {name: value for name, value in vars(fit.model).items()}
    record = {
        "model": model | {"assumed": list(fit.model.assumed)},
        "fit": {name: curve.summary() for name, curve in fit.curves.items()}
        | ({"hysteresis": fit.hysteresis} if fit.hysteresis else {}),
        "provenance": {
            "title": fit.table.title,
            "source": fit.table.source,
            "command": "diffsim fit-rotors",
        },
    }
    text = yaml.safe_dump(_round_numbers(record), sort_keys=False, width=100)
    return write_text_atomic(folder / f"{fit.table.name}.yaml", text)


def _round_numbers(value: Any) -> Any:
    """Ten digits: what is behind them changes with the version of the least-squares solver."""
    if isinstance(value, dict):
        return {k: _round_numbers(v) for k, v in value.items()}
    return float(f"{value:.10g}") if isinstance(value, float) else value
