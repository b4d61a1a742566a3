"""What a simulated flight leaves: samples, numbers, and a tidy CSV with its YAML."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from diffsim.core.arrays import Array, Mask
from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.core.files import csv_text, to_plain, write_text_atomic

_UP = np.diag([1.0, -1.0, -1.0])  # north-east-down to north-west-up


@checked(kinds_only=True)
@dataclass(frozen=True, kw_only=True, eq=False)
class FlightSample:
    """One control period, NED; the state is that at its start.

    Attributes:
        time: Time since the start [s].
        position, velocity: World frame, (3,) [m], [m/s].
        quaternion: World from body, (w, x, y, z), (4,).
        rpy: Roll, pitch, yaw, (3,) [rad].
        target: Position asked for, (3,) [m]; x and y of the vehicle itself where attitude is held.
        target_yaw: Yaw angle that is asked for [rad].
        estimate: Position that the controller believes in, (3,) [m].
        pwm: Pulse widths for the period, (n_rotors,) [us].
        thrusts: Thrusts of the rotors, lag included, (n_rotors,) [N].
        saturated: Whether a motor's command exceeds its limit, (n_rotors,).
        motors_on: Whether they turn.
        voltage: Voltage of the battery under load [V].
        current: Current of the battery [A].
        charge: 0 to 1.
        lag: Behind the wall clock [s].
    """

    time: float
    position: Array
    velocity: Array
    quaternion: Array
    rpy: Array
    target: Array
    target_yaw: float
    estimate: Array
    pwm: Array
    thrusts: Array
    saturated: Mask
    motors_on: bool
    voltage: float
    current: float
    charge: float
    lag: float = 0.0


@checked(kinds_only=True)
@dataclass(eq=False)
class FlightLog:
    """Samples of one flight.

    Attributes:
        metadata: What flew, with what.
        samples: One per control period.
        outcome: "flying", "done", "interrupted", or why it ended early.
    """

    metadata: dict[str, Any] = field(default_factory=dict)
    samples: list[FlightSample] = field(default_factory=list)
    outcome: str = "flying"

    def series(self, name: str) -> NDArray[Any]:
        """One attribute of all samples, (T, ...)."""
        require_choice("name", name, FlightSample.__dataclass_fields__)
        if not self.samples:
            raise ValueError("the flight has no samples; run it first")
        return np.array([getattr(sample, name) for sample in self.samples])

    @property
    def position_error(self) -> Array:
        """Distance of the center of mass from its target, (T,) [m]."""
        error: Array = np.linalg.norm(self.series("position") - self.series("target"), axis=1)
        return error

    @property
    def saturated_share(self) -> Array:
        """Share of the time with motors on in which each was saturated, (n_rotors,)."""
        on = self.series("motors_on")
        saturated = self.series("saturated")
        share: Array = saturated[on].mean(axis=0) if on.any() else np.zeros(saturated.shape[1])
        return share

    def summary(self) -> dict[str, Any]:
        """The flight in numbers."""
        on = self.series("motors_on")
        error, height = self.position_error, -self.series("position")[:, 2]
        return {
            "outcome": self.outcome,
            "seconds": float(self.samples[-1].time),
            "greatest_height_m": float(height.max()),
            "rms_position_error_m": float(np.sqrt(np.mean(error[on] ** 2))) if on.any() else 0.0,
            "greatest_position_error_m": float(error.max()),
            "greatest_pwm_us": self.series("pwm").max(axis=0).round(1).tolist(),
            "saturated_share": self.saturated_share.round(5).tolist(),
            "least_voltage_V": float(self.series("voltage").min()),
            "greatest_current_A": float(self.series("current").max()),
            "charge_left": float(self.samples[-1].charge),
            "greatest_lag_s": float(self.series("lag").max()),
        }

    @checked
    def save(self, folder: str | Path, *, name: str = "flight") -> Path:
        """Write ``name.csv`` (``MARKER_x_m``, ... a row each; z up) and ``name.yaml``.

        Returns:
            The folder.
        """
        folder = Path(folder)
        write_text_atomic(folder / f"{name}.csv", self._csv())
        text = yaml.safe_dump(
            to_plain(
                {
                    "name": name,
                    "frame": "north-west-up, origin at the take-off point; attitude: roll, pitch "
                    "and yaw of the body (forward-right-down) against north-east-down",
                    **self.metadata,
                    "summary": self.summary(),
                }
            ),
            sort_keys=False,
        )
        write_text_atomic(folder / f"{name}.yaml", text)
        return folder

    def _csv(self) -> str:
        groups: list[tuple[list[str], str, Array]] = [
            (_axes("body"), ".6f", self.series("position") @ _UP),
            (_axes("target"), ".6f", self.series("target") @ _UP),
            (["roll_rad", "pitch_rad", "yaw_rad"], ".6f", self.series("rpy")),
            (self._per_motor("pwm", "_us"), ".2f", self.series("pwm")),
            (self._per_motor("thrust", "_N"), ".4f", self.series("thrusts")),
            (self._per_motor("saturated", ""), ".0f", self.series("saturated").astype(float)),
        ]
        for name, column in (("voltage", "voltage_V"), ("current", "current_A")):
            groups.append(([column], ".4f", self.series(name)[:, None]))
        groups.append((["charge"], ".6f", self.series("charge")[:, None]))
        header = ["frame", "time_s", *(n for names, _, _ in groups for n in names)]
        rows = []
        for frame, time in enumerate(self.series("time")):
            cells = [f"{v + 0.0:{form}}" for _, form, values in groups for v in values[frame]]
            rows.append([frame, f"{time:.6f}", *cells])
        return csv_text(header, rows)

    def _per_motor(self, name: str, unit: str) -> list[str]:
        return [f"{name}_{k + 1}{unit}" for k in range(len(self.samples[0].pwm))]


def _axes(marker: str) -> list[str]:
    return [f"{marker}_{axis}_m" for axis in "xyz"]
