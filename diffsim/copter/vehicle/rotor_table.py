"""Bench tables of rotors: what a thrust stand measured, one row per setting."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from diffsim.core.arrays import Array, Mask
from diffsim.data.table import Table

INCH = 0.0254
# Motors of small_motors.csv by the first word of their short name.
_SMALL_MOTORS = {
    "EMAX RS2205S 2600kv": "rs2205s",
    "Lumenier RX2206-11 2350kv": "rx2206",
    "Tiger Motor F40 III 2400kv": "f40iii",
}
_SMALL_PROPELLERS = {
    "Cyclone T5040C 3-blade": "cyclone5040x3",
    "Gemfan 5x4.5 3-blade": "gemfan5045x3",
    "Gemfan 5x4 2-blade": "gemfan5040x2",
    "Lumenier 5x5.3 3-blade": "lumenier5053x3",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class RotorTable:
    """Rows of one motor and propeller."""

    name: str  # short name
    title: str  # motor and propeller in words
    radius: float  # radius of the propeller [m]
    nominal_voltage: float  # nominal voltage [V]
    signal: Array  # pulse width, (num_rows,) [us]
    speed: Array  # speed of the rotor, (num_rows,) [rad/s]
    thrust: Array  # thrust, (num_rows,) [N]
    current: Array  # current, (num_rows,) [A]
    torque: Array | None  # (num_rows,) [N m], or None
    voltage: Array | None  # (num_rows,) [V], or None where it was not recorded
    down: Mask  # rows of the sweep down, (num_rows,) bool
    source: str  # reference of the rows

    def __post_init__(self) -> None:
        columns = [self.signal, self.speed, self.thrust, self.current, self.down]
        columns += [c for c in (self.torque, self.voltage) if c is not None]
        if len({len(c) for c in columns}) != 1:
            raise ValueError(f"columns of {self.name} differ in length: {list(map(len, columns))}")
        if not all(np.isfinite(c).all() for c in columns):
            raise ValueError(f"columns of {self.name} must be finite")

    def rows(self, keep: Mask) -> RotorTable:
        """Some of the rows."""

        def some(column: Array | None) -> Array | None:
            return None if column is None else column[keep]

        return replace(
            self,
            signal=self.signal[keep],
            speed=self.speed[keep],
            thrust=self.thrust[keep],
            current=self.current[keep],
            torque=some(self.torque),
            voltage=some(self.voltage),
            down=self.down[keep],
        )

    @property
    def turning(self) -> RotorTable:
        """The rows in which the rotor turns and pulls."""
        return self.rows((self.speed > 0.0) & (self.thrust > 0.0))


def read_rotor_bench(folder: Path) -> dict[str, RotorTable]:
    """All tables of the data set ``rotor_bench``, by name.

    Small motors were measured at two supply voltages; the rows of both make one table. The KDE
    motors' rows are read as the public tool has them (data set ``copter_reference``, beside this
    one): there the 14-inch table has its sweep down, too, which ``rotor_bench`` lacks.

    Raises:
        FileNotFoundError: a file of the data set is not there.
    """
    public = folder.parent / "copter_reference" / "measurement"
    tables = [_kde(public, inches) for inches in (10, 14)]
    tables += list(_small_motors(folder))
    return {table.name: table for table in tables}


def _kde(folder: Path, inches: int) -> RotorTable:
    file = f"motor_{inches}inch_prop.txt"
    signal, torque, thrust, rpm, current = np.loadtxt(folder / file, unpack=True)
    return RotorTable(
        name=f"kde2814_{inches}in",
        title=f"KDE2814XF-775, {inches} inch propeller",
        radius=inches * INCH / 2,
        nominal_voltage=11.1,
        signal=signal,
        speed=rpm * 2.0 * np.pi / 60.0,
        thrust=thrust,
        current=current,
        torque=torque,
        voltage=None,
        down=np.arange(len(signal)) > np.argmax(signal),  # the strongest setting comes twice
        source=f"copter_reference/measurement/{file}, "
        "github.com/mit-gfx/multicopter_design (GPL-2.0)",
    )


def _small_motors(folder: Path) -> Iterator[RotorTable]:
    columns = Table(folder / "small_motors.csv", "table of motors").columns()
    for motor, short in _SMALL_MOTORS.items():
        for propeller, blade in _SMALL_PROPELLERS.items():
            keep = (columns["motor"] == motor) & (columns["propeller"] == propeller)
            yield RotorTable(
                name=f"{short}_{blade}",
                title=f"{motor}, {propeller}",
                radius=5 * INCH / 2,
                nominal_voltage=11.1,
                signal=columns["esc_signal_us"][keep],
                speed=columns["electrical_speed_rpm"][keep] * 2.0 * np.pi / 60.0,
                thrust=columns["thrust_N"][keep],
                current=columns["current_A"][keep],
                torque=None,
                voltage=columns["voltage_V"][keep],
                down=np.zeros(int(keep.sum()), dtype=bool),
                source="rotor_bench/small_motors.csv, "
                "github.com/StrawsonDesign/motor_propeller_testing (MIT)",
            )
