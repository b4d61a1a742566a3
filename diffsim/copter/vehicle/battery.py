"""Batteries: open-circuit voltage against charge, internal resistance, endurance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.vehicle.effects import BatterySag
from diffsim.copter.vehicle.rotor import RotorModel, doubles
from diffsim.core.check import require_count, require_number, require_range
from diffsim.core.checked import checked
from diffsim.core.numbers import anywhere, values_of
from diffsim.core.values import scalar

# Resting voltage of a lithium-polymer cell against its charge: the table that hobby chargers and
# battery alarms print, 0 to 100 % in steps of 5 %.
LIPO_CELL_VOLTAGE = (
    *(3.27, 3.61, 3.69, 3.71, 3.73, 3.75, 3.77, 3.79, 3.80, 3.82, 3.84),
    *(3.85, 3.87, 3.91, 3.95, 3.98, 4.02, 4.08, 4.11, 4.15, 4.20),
)
LIPO_NOMINAL = 3.7  # [V] per cell
# Thrust against voltage at the six strongest signals, mean of twelve small motors (rotor_bench).
USUAL_SAG_EXPONENT = 1.77


@checked(open_circuit_coefficients=(4,))
@dataclass(frozen=True, kw_only=True, eq=False)
class Battery:
    """A battery pack: voltage = open_circuit(charge) - resistance current.

    Not modeled: temperature, recovery after a load, aging, a capacity that depends on current.

    Attributes:
        capacity: Charge of a full battery, () [A s].
        resistance: Resistance of the pack, () [ohm].
        open_circuit_coefficients: Coefficients of V = sum_j c_j charge^j, charge 0 to 1, (4,) [V].
        nominal_voltage: Nominal voltage, () [V].
    """

    capacity: Tensor
    resistance: Tensor
    open_circuit_coefficients: Tensor
    nominal_voltage: Tensor

    def __post_init__(self) -> None:
        scalar("capacity", self.capacity, above=0.0, hint="unit is A s")
        scalar("resistance", self.resistance, at_least=0.0, hint="unit is ohm")
        scalar("nominal_voltage", self.nominal_voltage, above=0.0, hint="unit is V")

    @classmethod
    @checked
    def lipo(cls, *, cells: int, capacity_mah: float, resistance: float = 0.012) -> Battery:
        """A lithium-polymer pack of cells in series, 3.7 V nominal each.

        The cubic is a least-squares fit of the usual table of resting voltages from 5 to 100 %
        charge (within 0.04 V per cell); the drop below 5 % is left out: land before.

        Args:
            cells: Number of cells in series.
            capacity_mah: Capacity of each cell [mA h].
            resistance: Resistance of each cell [ohm]; 0.012 is usual for 2 A h at 20 C, more when
                old or cold.
        """
        cells = require_count("cells", cells, at_least=1)
        require_number("capacity_mah", capacity_mah, above=0.0)
        charge = np.linspace(0.05, 1.0, 20)
        per_cell = np.polynomial.polynomial.polyfit(charge, LIPO_CELL_VOLTAGE[1:], 3)
        return cls(
            capacity=doubles(3.6 * capacity_mah),
            resistance=doubles(cells * resistance),
            open_circuit_coefficients=doubles(cells * per_cell),
            nominal_voltage=doubles(cells * LIPO_NOMINAL),
        )

    @checked
    def open_circuit(self, charge: Tensor) -> Tensor:
        """Voltage without load [V] at a charge, 0 to 1, any shape."""
        c = self.open_circuit_coefficients
        return c[0] + charge * (c[1] + charge * (c[2] + charge * c[3]))

    @checked
    def voltage(self, charge: Tensor, current: Tensor) -> Tensor:
        """Voltage [V] at a charge, 0 to 1, and a current [A]."""
        return self.open_circuit(charge) - self.resistance * current

    @checked
    def current_for_power(self, charge: Tensor, power: Tensor) -> Tensor:
        """Current [A] that delivers a power [W]: the smaller root of (E - R I) I = P.

        Raises:
            ValueError: more power than the battery can give.
        """
        open_circuit = self.open_circuit(charge)
        inside = open_circuit**2 - 4.0 * self.resistance * power
        if anywhere(inside < 0.0):
            limit = float(values_of(open_circuit**2 / (4.0 * self.resistance)).min())
            raise ValueError(
                f"power must not exceed E^2 / (4 R) = {limit:.0f} W of the battery, got up to "
                f"{float(values_of(power).max()):.0f} W; lower it or take one of less resistance"
            )
        return 2.0 * power / (open_circuit + torch.sqrt(inside))

    @checked(power=())
    def endurance(self, power: Tensor, *, reserve: float = 0.05, num_points: int = 200) -> Tensor:
        """Time [s] at a constant power until the charge has fallen from 1 to ``reserve``.

        t = capacity int d charge / I(charge, power), by Simpson's rule.

        Args:
            power: () [W], > 0.
            reserve: Charge that is kept.
            num_points: Intervals of the rule, even.

        Raises:
            ValueError: more power than the battery can give near the reserve.
        """
        require_number("reserve", reserve, at_least=0.0, below=1.0)
        if num_points < 2 or num_points % 2:
            raise ValueError(f"num_points must be even and >= 2, got {num_points}")
        require_range("power", power, above=0.0, hint="unit is W")
        charge = torch.linspace(reserve, 1.0, num_points + 1, dtype=torch.float64)
        weights = torch.ones_like(charge)
        weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
        slowness = 1.0 / self.current_for_power(charge, power)
        return self.capacity * (1.0 - reserve) / (3.0 * num_points) * (weights * slowness).sum()

    @checked
    def sag(
        self, rotors: Sequence[RotorModel], *, exponent: float | None = None, idle: float = 0.0
    ) -> BatterySag:
        """The sag as an effect of flight.

        Args:
            rotors: One model per rotor; their nominal voltages say where thrust is as commanded.
            exponent: Exponent of thrust against voltage at one signal; 0 for a controller that
                makes up for the voltage. By default thrust exponent times speed exponent of each
                rotor, 1.77 where its table has no voltages, and their mean.
            idle: Current of everything else on board [A].
        """
        if not rotors:
            raise ValueError("rotors is empty; give one model per rotor")
        nominal = {float(r.nominal_voltage) for r in rotors}
        if len(nominal) > 1:
            raise ValueError(f"rotors must share a nominal voltage, got {sorted(nominal)} V")
        slopes = [
            doubles(USUAL_SAG_EXPONENT)
            if "nominal_voltage" in r.assumed
            else doubles(r.thrust_exponent) * doubles(r.speed_exponent)
            for r in rotors
        ]
        offsets = [doubles(r.current_offset) for r in rotors]
        return BatterySag(
            resistance=self.resistance,
            capacity=self.capacity,
            nominal_voltage=doubles(rotors[0].nominal_voltage),
            exponent=torch.stack(slopes).mean() if exponent is None else doubles(exponent),
            open_circuit=self.open_circuit_coefficients,
            current_coefficients=torch.stack([doubles(r.current_coefficient) for r in rotors]),
            current_exponents=torch.stack([doubles(r.current_exponent) for r in rotors]),
            idle_current=torch.stack(offsets).sum().clamp(min=0.0) + idle,
        )
