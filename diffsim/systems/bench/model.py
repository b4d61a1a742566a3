"""Static readings of a rotor on a thrust stand, in closed form.

    thrust = c w^2,   torque = lambda thrust,   current = a thrust^1.5 / V + current_0,
    speed = 2 K u / (1 + sqrt(1 + 4 L u)),   u = V (duty - duty_0)^b

with the *measured* speed w in thrust, the measured thrust in current, the nominal voltage V of the
supply, and duty from 0 at a pulse of 1000 us to 1 at 2000 us: quadratic thrust as a flight
controller assumes it, a torque as in thesis eq. 3.1, the power of an ideal rotor. The speed solves
the motor's equation u = w / K + R I with I ~ torque ~ w^2, L = R I / u at w = K u; b is the
throttle curve of the controller.
(``copter.RotorModel`` has g (V (duty - duty_0))^b, which gives signal and voltage one exponent.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from diffsim.data.importers.rotor_bench import COMMAND, SCATTER
from diffsim.data.study import Run
from diffsim.identify import Parameter
from diffsim.identify.model import Numerics, SimModel

Change = Callable[["BenchScene", Tensor], Tensor]
LEAST_DUTY = 1e-3


def rotor_of(run: Run) -> str:
    """Motor and propeller of a run: "kde2814_10in", "a1", ..."""
    return run.name.rsplit("_", 1)[0]


def propeller_of(run: Run) -> str:
    """ "10in", "14in", or "prop1" and so on of the small motors."""
    rotor = rotor_of(run)
    return rotor.split("_")[1] if rotor.startswith("kde") else f"prop{rotor[1:]}"


def stand_of(run: Run) -> str:
    """Name of the stand of a motor, "kde" or "small"."""
    return "kde" if run.name.startswith("kde") else "small"


@dataclass(frozen=True, eq=False)
class BenchScene:
    """One sweep of a motor with its propeller.

    Attributes:
        run: Recorded sweep of one motor with its propeller.
        values: Base parameters by name without the rotor's, () or (K,) each.
        columns: Names of the measured quantities, keys of ``SCATTER``, in the order of the
            channels.
        changes: Functions by which effects change each quantity, in this order, by name of the
            quantity.
    """

    run: Run
    values: Mapping[str, Tensor]
    columns: tuple[str, ...]
    changes: Mapping[str, tuple[Change, ...]] = field(default_factory=dict)

    def with_change(self, quantity: str, change: Change) -> BenchScene:
        """A copy in which ``quantity`` becomes change(scene, quantity)."""
        so_far = self.changes.get(quantity, ())
        return replace(self, changes={**self.changes, quantity: (*so_far, change)})

    def command(self, name: str) -> Tensor:
        """(num_samples,) a measured or commanded column."""
        return torch.from_numpy(self.run.command[name])

    @property
    def duty(self) -> Tensor:
        """Duty cycle of the motor, (num_samples,) from 0 to 1."""
        return (self.command(COMMAND) - 1000.0) / 1000.0

    def of(self, quantity: str) -> Tensor:
        """(..., num_samples) a quantity [SI unit] with the changes made to it."""
        value: Tensor = getattr(self, f"_{quantity}")()
        for change in self.changes.get(quantity, ()):
            value = change(self, value)
        return value

    def simulate(self) -> Tensor:
        """(..., num_samples, num_channels) in units of their scatter."""
        shown_quantities = [self.of(name.split("_")[0]) for name in self.columns]
        shape = torch.broadcast_shapes(*(x.shape for x in shown_quantities))
        out = []
        for name, x in zip(self.columns, shown_quantities, strict=True):
            floor, share = SCATTER[name]
            out.append(torch.asinh(share / floor * x.expand(shape)) / share)
        return torch.stack(out, -1)

    def _voltage(self) -> Tensor:
        return torch.full_like(self.duty, self.run.setup["supply_nominal_V"])

    def _thrust(self) -> Tensor:
        return self._value("thrust_coefficient") * self.command("speed_rad_s") ** 2

    def _torque(self) -> Tensor:
        return self._value("torque_ratio") * self.of("thrust")

    def _current(self) -> Tensor:
        thrust = self.command("thrust_N").clamp(min=1e-6)
        power = self._value("power_coefficient") * thrust**1.5
        return power / self.of("voltage") + self._value("current_offset")

    def _speed(self) -> Tensor:
        duty = (self.duty - self._value("duty_offset")).clamp(min=LEAST_DUTY)
        u = self.of("voltage") * duty ** self._value("throttle_exponent")
        load = self._value("load_slope")
        return 2.0 * self._value("speed_constant") * u / (1.0 + (1.0 + 4.0 * load * u).sqrt())

    def _value(self, name: str) -> Tensor:
        return self.values[name][..., None]


def bench_model(runs: Sequence[Run], columns: Sequence[str] = tuple(SCATTER)) -> SimModel:
    """Parameters of each motor with its propeller; the torque ratio where torque was measured.

    Args:
        runs: Sweeps of the study.
        columns: Names of the measured quantities, keys of ``SCATTER``.
    """
    rotors = {rotor_of(r): r for r in runs}
    base = [p for rotor, run in rotors.items() for p in _parameters(rotor, run, columns)]

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> BenchScene:
        prefix = f"{rotor_of(run)}."
        own = {k.removeprefix(prefix): v for k, v in values.items() if k.startswith(prefix)}
        own.setdefault("torque_ratio", torch.zeros_like(next(iter(own.values()))))
        return BenchScene(run, own, tuple(columns))

    return SimModel(build, base, "rotors on a stand", batched=True)


def _parameters(rotor: str, run: Run, columns: Sequence[str]) -> list[Parameter]:
    """Wide priors: of the size of the propeller (thrust ~ D^4, power ~ 1 / D)."""
    size = run.setup["propeller_diameter_m"] / 0.254
    small = stand_of(run) == "small"
    out = []
    if "thrust_N" in columns:
        c = 9e-6 * size**4
        out.append(Parameter(f"{rotor}.thrust_coefficient", c, 0.7, "N s2/rad2", log=True))
    if "torque_Nm" in columns and not small:
        out.append(Parameter(f"{rotor}.torque_ratio", 0.015, 0.3, "m", log=True))
    if "speed_rad_s" in columns:
        k = 270.0 if small else 81.0
        out += [
            Parameter(f"{rotor}.speed_constant", k, 0.3, "rad/s/V", log=True),
            Parameter(f"{rotor}.throttle_exponent", 0.8, 0.3, "-", log=True),
            Parameter(f"{rotor}.load_slope", 0.05, 1.0, "1/V", log=True),
            Parameter(f"{rotor}.duty_offset", 0.0, 0.1, "-", upper=0.04 if small else 0.14),
        ]
    if "current_A" in columns:
        out += [
            Parameter(f"{rotor}.power_coefficient", 6.0 / size, 0.5, "W/N^1.5", log=True),
            Parameter(f"{rotor}.current_offset", 0.1, 0.3, "A"),
        ]
    return out
